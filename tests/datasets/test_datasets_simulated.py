"""The simulator's store as a data set."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cases import refused
from samples import BEAMS, flat_sample, flat_steps

from ogm.datasets import open_dataset, with_poses
from ogm.pose import pose
from ogm.scan import Mount
from ogm.simulation.sample import LABELS, OBJECT_DTYPE, SimulatedSample
from ogm.simulation.store import Store
from ogm.state import CellState
from ogm.storage.files import OgmError
from ogm.truth import TRUTH_SPEC


def sample(split: str, index: int) -> SimulatedSample:
    """Flat ground around a vehicle that goes 0.4 m forward per sample; a car ahead turns by 0.05 rad."""
    state = np.zeros(TRUTH_SPEC.shape, np.uint8)
    state[200:400], state[400:410] = CellState.FREE, CellState.OCCUPIED
    car = np.zeros(1, OBJECT_DTYPE)
    car[["x", "y", "z", "length", "width", "height"]] = [(9.0, 1.0, -1.1, 4.0, 2.0, 1.5)]
    car["track"], car["vx"], car["yaw"] = 7, 3.0, 0.25 + 0.05 * (index - 3)
    places = {"T_world_sensor": pose(0.4 * index, 0, 1.9), "T_vehicle_sensor": pose(1.0, 0.1, 1.9, pitch=0.02)}
    facts = {"objects": car, "stamp": 20 + 0.1 * index, "scenario": index // 5, **places}
    return flat_sample(split, index, flat_steps(), state, **facts)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Samples of training and two sequences; validation is planned but not made, of the test there is none."""
    folder = tmp_path_factory.mktemp("simulated") / "data"
    counts = {"training": 10, "validation": 10, "test": 0, "sequences": 102}
    made = Store.create(folder, {"seed": 1, "truth": "aimed"}, counts, [BEAMS], {"ogm": "0"})
    made.write("training", 0, [sample("training", k) for k in range(10)])
    made.write("sequences", 0, [sample("sequences", k) for k in range(10)])
    made.write("sequences", 10, [sample("sequences", 100 + k) for k in range(2)])
    return folder


def test_without_a_split_the_one_that_has_samples_is_taken_and_named(store: Path) -> None:
    dataset = open_dataset(store)
    assert (dataset.name, dataset.format) == ("data, sequences", "simulated dataset")
    assert dataset.facts["split"] == "sequences"
    assert dataset.facts["samples"] == [*range(10), 100, 101]
    assert dataset.facts["plan"] == {"seed": 1, "truth": "aimed"}
    assert dataset.files == (store / "zarr.json", store / "sequences")
    assert not dataset.motion_distorted
    assert {name: len(frames) for name, frames in dataset.sequences.items()} == {"sequence 0": 10, "sequence 1": 2}
    assert dataset[11].name == "sequence 1 frame 1"
    assert dataset[3].stamp == pytest.approx(20.3)
    assert "rays from the sensor's position, aimed at every cell, hit" in dataset.description


def test_drives_without_truth_have_none(tmp_path: Path) -> None:
    made = Store.create(tmp_path, {"seed": 1, "truth": "none"}, {"sequences": 1}, [BEAMS], {"ogm": "0"})
    made.write("sequences", 0, [sample("sequences", 0)])
    dataset = open_dataset(tmp_path)
    assert (dataset.with_truth, dataset.description) == ([], "")
    with pytest.raises(OgmError, match="without truth"):
        dataset[0].truth  # noqa: B018


def test_splits_have_short_names(store: Path) -> None:
    dataset = open_dataset(store, split="train")
    assert (dataset.name, len(dataset)) == ("data, training", 10)
    frame = dataset[3]
    assert (frame.name, frame.sequence, frame.stamp) == ("training 3", "drive 0", None)


def test_a_default_split_counts_where_none_is_given(store: Path) -> None:
    assert open_dataset(store, default_split="train").name == "data, training"
    assert open_dataset(store, split="sequences", default_split="train").name == "data, sequences"


def test_samples_belong_to_their_drives_so_that_statistics_can_group_them(store: Path) -> None:
    assert open_dataset(store, split="train").sequences == {"drive 0": [*range(5)], "drive 1": [*range(5, 10)]}


def test_splits_without_samples_are_refused(store: Path) -> None:
    refused("has no sample of validation; resume with `ogm simulate", open_dataset, store, split="val")
    refused("has no sample of test$", open_dataset, store, split="test")
    message = "has no split 'lanes'; it has training, validation, test, sequences$"
    refused(message, open_dataset, store, split="lanes")


def test_a_store_without_sequences_names_the_command_that_makes_one(tmp_path: Path) -> None:
    Store.create(tmp_path, {"seed": 1}, {"training": 10}, [BEAMS], {"ogm": "0"})
    refused("`ogm simulate .* --resume --sequences 1`", open_dataset, tmp_path, split="sequences")
    refused("has no finished sample", open_dataset, tmp_path)


def test_frames_hold_all_that_a_sample_holds(store: Path) -> None:
    frame, made = open_dataset(store)[3], sample("sequences", 3)
    assert np.array_equal(frame.scan.points, made.points)
    assert np.array_equal(frame.scan.time, made.time)
    assert np.array_equal(frame.scan.ring, made.ring)
    assert (frame.scan.sensor, frame.scan.stamp) == ("test-16", made.stamp)
    assert np.array_equal(frame.scan.no_returns, BEAMS.directions[made.steps == 0])
    assert np.array_equal(frame.T_map_sensor, made.T_world_sensor)
    T = made.T_vehicle_sensor.copy()
    T[:2, 3] = 0
    assert frame.mount == Mount(1.9, T)
    assert np.array_equal(frame.truth.state, made.truth.state)
    (label,), (track,) = frame.boxes.label, frame.boxes.track
    assert (label, track) == (LABELS[0], "7")
    np.testing.assert_allclose(frame.boxes.center, [[9.0, 1.0, -1.1]], rtol=1e-6)
    np.testing.assert_allclose(frame.boxes.size, [[4.0, 2.0, 1.5]])
    assert (frame.boxes.yaw[0], frame.boxes.velocity.tolist()) == (0.25, [[3.0, 0.0]])


def test_cells_of_sequences_have_the_velocity_of_the_box_in_them(store: Path) -> None:
    """Those of the car turn by 0.5 rad/s, also in the first and the last frame; what has no box stands still."""
    dataset = open_dataset(store)
    x, y = TRUTH_SPEC.cell_centers
    for n in (0, 3, 9, 10):
        motion = dataset[n].truth.motion
        under = motion.box == 0
        assert np.count_nonzero(under) * 0.16**2 == pytest.approx(4.3 * 2.3, abs=0.5)
        want = np.stack(np.broadcast_arrays(3.0 - 0.5 * (y - 1.0), 0.5 * (x - 9.0)), axis=-1)
        np.testing.assert_allclose(motion.velocity[under], want[under], atol=1e-4)
        assert (motion.velocity[~under & motion.known] == 0).all()
        own = ~motion.known
        assert own[TRUTH_SPEC.index(0.0, 0.0)]
        assert np.count_nonzero(own) * 0.16**2 == pytest.approx(5.0 * 2.2, abs=1)
        assert dataset[n].boxes.label[motion.box[under][0]] == LABELS[0]


def test_samples_that_stand_alone_have_no_motion(store: Path) -> None:
    assert open_dataset(store, split="train")[3].truth.motion is None


def test_for_maps_what_a_frame_cannot_see_is_ignored(store: Path) -> None:
    scans, maps = (open_dataset(store, others=others) for others in ("all", "later"))
    own, known = scans[3].truth.state, maps[3].truth.state
    assert set(np.unique(own)) == {CellState.UNKNOWN, CellState.FREE, CellState.OCCUPIED}
    assert (known[own == CellState.UNKNOWN] == CellState.IGNORE).all()
    assert (known[own != CellState.UNKNOWN] == own[own != CellState.UNKNOWN]).all()
    assert "left out" in maps.description
    assert "left out" not in scans.description
    refused("others must be one of all, later, got 'earlier'", open_dataset, store, others="earlier")


def test_kerbs_have_the_state_that_is_asked_for(tmp_path: Path) -> None:
    one = sample("training", 0)
    height = np.where(one.truth.state == CellState.OCCUPIED, np.uint8(40), np.uint8(0))
    height[400:405] = 12
    made = Store.create(tmp_path, {"seed": 1, "truth": "aimed"}, {"training": 1}, [BEAMS], {"ogm": "0"})
    made.write("training", 0, [replace(one, truth=replace(one.truth, height_cm=height))])
    for kerbs, want in (("occupied", CellState.OCCUPIED), ("ignore", CellState.IGNORE)):
        dataset = open_dataset(tmp_path, kerbs=kerbs)
        state = dataset[0].truth.state
        assert (state[400:405] == want).all()
        np.testing.assert_array_equal(
            np.delete(state, np.s_[400:405], 0), np.delete(one.truth.state, np.s_[400:405], 0)
        )
        assert ("Obstacles up to 0.15 m: ignore." in dataset.description) == (kerbs == "ignore")
    assert (open_dataset(tmp_path)[0].truth.state[400:405] == CellState.IGNORE).all()
    refused("kerbs must be one of", open_dataset, tmp_path, kerbs="low")


def test_what_the_store_states_is_not_given(store: Path, tmp_path: Path) -> None:
    refused("leave out `sensor_height`", open_dataset, store, sensor_height=2.0)
    refused("leave out `axes`", open_dataset, store, axes="nuscenes")
    refused("holds its truth", open_dataset, store, truth="boxes")
    refused("states its poses", with_poses, open_dataset(store), tmp_path / "poses.txt")


def test_a_store_goes_to_another_process(store: Path) -> None:
    dataset = pickle.loads(pickle.dumps(open_dataset(store, split="train")[4:]))
    assert [frame.name for frame in dataset] == [f"training {k}" for k in range(4, 10)]
    assert np.array_equal(dataset[0].scan.points, sample("training", 4).points)
