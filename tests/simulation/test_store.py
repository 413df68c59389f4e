"""Data sets on disk: what was written is read, and what is damaged is told."""

import json
import pickle
import shutil
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from cases import each, refused
from stand_in import BEAMS, stand_in

from ogm.simulation import store as store_module
from ogm.simulation.sample import LABELS, OBJECT_DTYPE, RANGE_STEP, Beams, SimulatedSample
from ogm.simulation.split import OBJECTS
from ogm.simulation.store import FORMAT, GAPS, OLDER, SHARD, Damaged, Store
from ogm.simulation.workers import swept


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two shards of training samples, the second of three; validation planned but not made."""
    path = tmp_path_factory.mktemp("store") / "data"
    store = Store.create(path, {"seed": 7}, {"training": 13, "validation": 4}, BEAMS, {"ogm": "0"})
    store.write("training", 0, [stand_in(None, "training", i) for i in range(10)])
    store.write("training", 1, [stand_in(None, "training", i) for i in range(10, 13)])
    return path


@pytest.fixture
def store(written: Path, tmp_path: Path) -> Store:
    """A copy of `written`."""
    return Store.open(shutil.copytree(written, tmp_path / "data"))


def assert_same(a: SimulatedSample, b: SimulatedSample) -> None:
    for name in ("steps", "intensities", "objects", "T_world_sensor", "T_vehicle_sensor", "velocity"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    np.testing.assert_array_equal(a.truth.state, b.truth.state)
    np.testing.assert_array_equal(a.truth.height_cm, b.truth.height_cm)
    for name in ("beams", "yaw_rate", "stamp", "split", "index", "scenario", "weather"):
        assert getattr(a, name) == getattr(b, name), name


def test_what_was_written_is_read(store: Store) -> None:
    split = Store.open(store.path)["training"]
    assert len(split) == 13
    for i in (0, 1, 9, 10, 12):
        assert_same(split[i], stand_in(None, "training", i))
    assert_same(split[-1], split[12])
    assert [one.index for one in split[4:12:3]] == [4, 7, 10]


def test_data_sets_without_heights_are_read_but_do_not_grow(store: Store) -> None:
    new = store["training"][3].truth
    shutil.rmtree(store.path / "training" / "heights")
    shutil.rmtree(store.path / "training" / "checksums")
    text = json.loads((store.path / "zarr.json").read_text())
    text["attributes"]["format"] = OLDER
    del text["attributes"]["sha256"]
    (store.path / "zarr.json").write_text(json.dumps(text))
    old = Store.open(store.path)["training"][3].truth
    assert old.height_cm is None
    np.testing.assert_array_equal(old.state, new.state)
    with pytest.raises(ValueError, match="format ogm.samples/2, which .* does not write: give a new folder"):
        Store.create(store.path, {"seed": 7}, {"training": 23, "validation": 4}, BEAMS, {"ogm": "0"})


def test_data_sets_of_recipes_keep_which_beams_were_measured(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "data", {"recipe": "gen2"}, {"training": 3}, BEAMS, {})
    made = []
    for i in range(3):
        one = stand_in(None, "training", i)
        measured = np.random.default_rng(i).random(one.steps.shape) < (0.6, 1.0, 0.0)[i]
        steps = np.minimum(np.where(measured, one.steps, 0), 65534).astype(np.uint16)
        intensities = np.where(steps > 0, one.intensities, 0).astype(np.uint8)
        weather = one.weather._replace(dust=0.1 * i)
        made.append(replace(one, steps=steps, intensities=intensities, measured=measured, weather=weather))
    store.write("training", 0, made)
    again = Store.open(store.path)
    assert again.format == GAPS
    for one, other in zip(again["training"], made, strict=True):
        assert_same(one, other)
        np.testing.assert_array_equal(one.measured, other.measured)
        assert other.measured is not None
        assert len(one.points) + len(one.no_returns) == other.measured.sum()
    assert again["training"].facts.shape == (3, 37)
    grown = Store.create(store.path, {"recipe": "gen2"}, {"training": 5}, BEAMS, {})
    assert_same(grown["training"][2], made[2])


def test_heights_that_are_not_known_are_not_zero(tmp_path: Path) -> None:
    one = stand_in(None, "training", 0)
    store = Store.create(tmp_path / "data", {}, {"training": 1}, BEAMS, {})
    store.write("training", 0, [replace(one, truth=replace(one.truth, height_cm=None))])
    assert store["training"][0].truth.height_cm is None


def test_points_are_range_times_direction() -> None:
    for i in (0, 1):
        sample = stand_in(None, "training", i)
        where = np.nonzero(sample.steps)
        distance = sample.steps[where] * np.float32(RANGE_STEP)
        expected = distance[:, None] * sample.beams.directions[where] + sample.beams.origins[where[0]]
        np.testing.assert_allclose(sample.points[:, :3], expected, atol=2e-5)
        np.testing.assert_allclose(sample.points[:, 3], sample.intensities[where] * np.float32(1 / 255))
        np.testing.assert_array_equal(sample.ring, where[0])
        np.testing.assert_array_equal(sample.column, where[1])
        turn = (where[1] + 0.5) / sample.beams.columns - 0.5
        np.testing.assert_allclose(sample.time, turn / sample.beams.rate, rtol=1e-5)
        assert sample.points.dtype == np.float32


def test_beams_turn_the_way_of_their_step() -> None:
    clockwise = BEAMS[0].directions[0]
    assert clockwise[0, 0] > 0.9
    assert clockwise[1, 1] < 0
    np.testing.assert_allclose(np.linalg.norm(clockwise, axis=-1), 1, atol=1e-6)
    assert Beams.from_dict(json.loads(json.dumps(asdict(BEAMS[0])))) == BEAMS[0]


def test_only_finished_samples_can_be_read(store: Store) -> None:
    assert store["training"].finished.tolist() == list(range(13))
    assert store["validation"].finished.tolist() == []
    with pytest.raises(ValueError, match="is not made yet.*--resume"):
        store["validation"][0]
    with pytest.raises(IndexError, match="beyond the 4 samples"):
        store["validation"][4]
    with pytest.raises(KeyError, match="no split 'rain'"):
        store["rain"]


def test_a_data_set_grows_and_does_not_shrink(store: Store) -> None:
    grown = Store.create(store.path, {}, {"training": 21, "validation": 4}, store.beams, {})
    assert grown["training"].finished.tolist() == list(range(13))
    assert_same(grown["training"][12], stand_in(None, "training", 12))
    grown.write("training", 2, [stand_in(None, "training", 20)])
    assert grown["training"].finished.tolist() == [*range(13), 20]
    with pytest.raises(ValueError, match="21 planned samples of training, got 5"):
        Store.create(store.path, {}, {"training": 5, "validation": 4}, store.beams, {})
    refused("other lidars", Store.create, store.path, {}, {"training": 21, "validation": 4}, store.beams[:1], {})


def test_a_shard_is_written_whole(store: Store) -> None:
    refused("needs the samples 10 to 12", store.write, "training", 1, [stand_in(None, "training", 10)])


def test_a_shard_whose_facts_are_missing_is_not_there(store: Store) -> None:
    """The facts are written last: a writer that was killed before leaves none."""
    (store.path / "training" / "facts" / "c" / "0" / "0").unlink()
    assert Store.open(store.path)["training"].finished.tolist() == [10, 11, 12]


@pytest.mark.slow
@each("name, damage", [("steps", "flip"), ("intensities", "cut"), ("truth", "gone"), ("objects", "flip"),
                       ("facts", "cut")])  # fmt: skip
def test_damage_is_reported_with_the_way_out(written: Path, tmp_path: Path, name: str, damage: str) -> None:
    store = Store.open(shutil.copytree(written, tmp_path / "data"))
    (file,) = (path for path in (store.path / "training" / name / "c" / "0").rglob("*") if path.is_file())
    content = bytearray(file.read_bytes())
    if damage == "flip":
        content[40] ^= 255
    else:
        del content[len(content) // 2 :]
    file.write_bytes(content)
    if damage == "gone":
        file.unlink()
    with pytest.raises(Damaged, match=rf"training in .*{name} is damaged on disk") as told:
        [Store.open(store.path)["training"][i] for i in range(SHARD)]
    marker = str(told.value).split("`rm ")[1].split("`")[0]
    Path(marker).unlink()
    assert Store.open(store.path)["training"].finished.tolist() == [10, 11, 12]
    store.write("training", 0, [stand_in(None, "training", i) for i in range(10)])
    for i in range(SHARD):
        assert_same(Store.open(store.path)["training"][i], stand_in(None, "training", i))


def test_a_missing_array_is_reported(store: Store) -> None:
    (store.path / "training" / "truth" / "zarr.json").unlink()
    with pytest.raises(Damaged, match="truth is missing"):
        store["training"][0]


def test_what_is_no_data_set_is_reported(tmp_path: Path, store: Store) -> None:
    refused("holds no dataset; make one with `ogm simulate", Store.open, tmp_path / "nowhere", error=FileNotFoundError)
    (tmp_path / "file").write_text("x")
    refused("is a file", Store.open, tmp_path / "file")
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "zarr.json").write_text('{"zarr_format": 3, "node_type": "group", "attributes": {}}')
    refused("is not a dataset made by", Store.open, foreign)
    text = (store.path / "zarr.json").read_text()
    (store.path / "zarr.json").write_text(text.replace(FORMAT, "ogm.samples/99"))
    refused("has the format ogm.samples/99, this version of ogm reads", Store.open, store.path)
    holds = tmp_path / "holds"
    holds.mkdir()
    (holds / "thesis.tex").write_text("dear")
    refused("holds other files", Store.create, holds, {}, {"training": 1}, BEAMS, {})
    assert [file.name for file in holds.iterdir()] == ["thesis.tex"]


def test_what_a_killed_create_left_is_begun_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "begun"
    grow = store_module._grow

    def killed(root: object, name: str, *arguments: object) -> None:
        if name == "test":
            raise KeyboardInterrupt
        grow(root, name, *arguments)

    monkeypatch.setattr(store_module, "_grow", killed)
    with pytest.raises(KeyboardInterrupt):
        Store.create(path, {}, {"training": 3, "test": 1}, BEAMS[:1], {})
    refused("interrupted dataset .* start again with `ogm simulate", Store.open, path, error=FileNotFoundError)
    assert not Store.exists(path)
    monkeypatch.undo()
    again = Store.create(path, {}, {"training": 13, "test": 1}, BEAMS, {})
    assert Store.exists(path)
    assert len(again["training"].finished) == 0
    fresh = Store.create(tmp_path / "fresh", {}, {"training": 13, "test": 1}, BEAMS, {})
    files = [sorted(file for file in one.path.rglob("*") if file.is_file()) for one in (again, fresh)]
    assert [file.read_bytes() for file in files[0]] == [file.read_bytes() for file in files[1]]


LIDAR = {"name": "x", "elevation": [0.1], "azimuth": [0.0], "step": 0.1, "rate": 10.0, "origin": [[0, 0, 0]]}
LIDAR |= {"columns": 600}


@each("nonsense", [
        {"splits": {"../data/training": 13}},
        {"splits": {"training": -1}},
        {"splits": {"training": "13"}},
        {"splits": {"training": 10**15}},
        {"splits": {"training": 14}},
        {"splits": ["training"]},
        {"plan": 3},
        {"versions": None},
        {"lidars": []},
        {"lidars": "abc"},
        {"lidars": [LIDAR | {"columns": 10**6}]},
        {"lidars": [LIDAR | {"columns": -5}]},
        {"lidars": [LIDAR | {"origin": []}]},
        {"lidars": [LIDAR | {"azimuth": [0.0, 0.0]}]},
        {"lidars": [LIDAR | {"elevation": ["up"], "rate": 1.0}]},
        {"lidars": [LIDAR | {"rate": 0.0}]},
        {"lidars": [LIDAR]},  # samples name the second of the lidars, and there is one
    ])  # fmt: skip
def test_attributes_with_nonsense_are_reported(written: Path, tmp_path: Path, nonsense: dict) -> None:
    store = Store.open(shutil.copytree(written, tmp_path / "data"))
    file = store.path / "zarr.json"
    text = json.loads(file.read_text())
    text["attributes"] |= nonsense
    file.write_text(json.dumps(text))
    with pytest.raises(Damaged):
        Store.open(store.path)["training"][1]


def test_an_interrupt_leaves_no_temporary_file(store: Store) -> None:
    left = store.path / "training" / "truth" / "c" / "0" / "0" / "0.abc.partial"
    left.write_bytes(b"half")
    with pytest.raises(KeyboardInterrupt), swept(store.path, alone=True):
        raise KeyboardInterrupt
    assert not left.exists()
    assert store["training"].finished.tolist() == list(range(13))


def test_splits_go_to_other_processes(store: Store) -> None:
    split = store["training"]
    _ = split[3]
    assert_same(pickle.loads(pickle.dumps(split))[3], split[3])


def test_describe_counts_what_is_there(store: Store) -> None:
    facts = store.describe()
    assert facts["training"] == "13 samples (7 small, 6 tall)"
    assert facts["validation"] == "0 of 4 samples"
    assert "kB per sample" in facts["size"]
    assert "seed 7" in facts["plan"]


def test_as_many_objects_fit_as_are_listed(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "crowd", {}, {"test": 1}, BEAMS, {})
    crowd = np.zeros(OBJECTS + 40, OBJECT_DTYPE)
    crowd["x"], crowd["length"] = np.arange(len(crowd)), 1
    store.write("test", 0, [replace(stand_in(None, "test", 0), objects=crowd)])
    np.testing.assert_array_equal(store["test"][0].objects["x"], np.arange(OBJECTS))


def test_labels_fit_their_column() -> None:
    assert len(LABELS) == len(set(LABELS)) < 256


def test_reading_needs_neither_open3d_nor_dask(store: Store) -> None:
    code = f"""
import sys
for name in ("open3d", "dask", "distributed", "shapely", "matplotlib"):
    sys.modules[name] = None
from ogm.simulation.store import Store
sample = Store.open({str(store.path)!r})["training"][5]
print(len(sample.points), sample.truth.state.shape)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("(624, 624)\n")


def test_a_missing_zarr_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(ImportError, match=r'pip install .*\[sim\]"'):
        Store.create(tmp_path / "data", {}, {"training": 1}, BEAMS, {})
