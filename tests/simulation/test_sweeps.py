"""Radars of data sets: their places and times, and sweeps that are made, stored and read."""

import json
import math
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import each, needs, refused
from stand_in import BEAMS, stand_in

from ogm import open_dataset
from ogm.pose import inverse, pose
from ogm.simulation.contents import Contents, StoredRadar
from ogm.simulation.mounts import LidarMount, RadarMount, radars_at
from ogm.simulation.plan import DatasetPlan
from ogm.simulation.radars import RADARS
from ogm.simulation.sample import Origin, PlacedSweep, RadarSweep
from ogm.simulation.store import Damaged, Store
from ogm.storage.files import OgmError

needs("zarr")
TWO = radars_at(["ars548", "corner@rear-left"])


def placed(radar: int, stamp: float, count: int, seed: int = 0) -> PlacedSweep:
    rng = np.random.default_rng(seed)
    numbers = rng.normal(size=(7, count)).astype(np.float32)
    origin, thing = rng.integers(0, 4, count).astype(np.uint8), rng.integers(-1, 900, count).astype(np.int32)
    detections = RadarSweep(numbers[:3].T, *numbers[3:], origin, thing)
    return PlacedSweep(radar, stamp, pose(3.0, 4.0 * stamp, 0.5, yaw=0.1), np.array([1.0, 2.0, 0.0]), detections)


def with_sweeps(sample: Any, index: int) -> Any:
    sweeps = (placed(0, sample.stamp, 30 + index, index), placed(0, sample.stamp + 0.05, 0), placed(1, sample.stamp, 4))
    return replace(sample, sweeps=sweeps, T_vehicle_sensor=pose(0.3, 0.0, 1.9))


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    plan = DatasetPlan(samples=0, validation=10, test=0, radars=TWO, mounts=(LidarMount("small"),))
    path = tmp_path_factory.mktemp("sweeps") / "data"
    store = Store.create(path, asdict(plan), {"validation": 10}, BEAMS, {"ogm": "0"})
    store.write("validation", 0, [with_sweeps(stand_in(None, "validation", i), i) for i in range(10)])
    return path


@pytest.fixture
def store(written: Path, tmp_path: Path) -> Store:
    """A copy of `written`."""
    return Store.open(shutil.copytree(written, tmp_path / "data"))


def test_words_for_radars_and_places() -> None:
    assert [one.name for one in radars_at(["ars548", "corner"])] == [
        "ars548-front", "corner-front-left", "corner-front-right", "corner-rear-left", "corner-rear-right"
    ]  # fmt: skip
    (rear,) = radars_at(["ars408@rear"])
    assert (rear.radar, rear.x < 0, abs(rear.yaw)) == ("ars408", True, math.pi)
    for word in ("ars", "ars408@roof", "@front", ""):
        refused("a radar must be one of", radars_at, [word])
    refused("needs a unique name", DatasetPlan, radars=radars_at(["ars548", "ars548@front"]))
    refused("yaw of a", RadarMount, "a", "ars548", 1, 0, 0.5, yaw=4)


def test_a_plan_with_radars_survives_json_and_does_not_become_another() -> None:
    plan = DatasetPlan(radars=TWO)
    assert DatasetPlan.from_dict(json.loads(json.dumps(asdict(plan)))) == plan
    older = {name: value for name, value in asdict(DatasetPlan()).items() if name != "radars"}
    assert DatasetPlan.from_dict(older) == DatasetPlan()
    refused(r"begun with radars = none, got ars548-front \+ corner-rear-left", plan.grown, DatasetPlan())


@each("rate", [13.0, 20.0, 7.3])
def test_every_sweep_of_a_drive_belongs_to_one_sample(rate: float) -> None:
    pytest.importorskip("open3d")
    from ogm.simulation.moments import sweep_times

    taken = [sweep_times("sequences", 20 + 0.1 * k, rate) for k in range(100)]
    times = np.concatenate(taken)
    np.testing.assert_allclose(np.diff(times), 1 / rate, atol=1e-9)
    assert times[0] <= 19.95 + 1 / rate
    assert times[-1] >= 29.95 - 1 / rate
    most = StoredRadar.of_mount(RadarMount("a", "ars408", 0, 0, 0.5)).sweeps if rate == 13 else math.ceil(rate / 10)
    assert max(len(one) for one in taken) <= most
    assert sweep_times("test", 31.7, rate) == [31.7]


def test_sweeps_come_back_as_they_were_written(store: Store) -> None:
    assert store.format == "ogm.samples/5"
    assert [one.name for one in store.radars] == ["ars548-front", "corner-rear-left"]
    for i in (0, 9):
        wanted, found = with_sweeps(stand_in(None, "validation", i), i), store["validation"][i]
        np.testing.assert_array_equal(found.steps, wanted.steps)
        assert len(found.sweeps) == 3
        for got, sweep in zip(found.sweeps, wanted.sweeps, strict=True):
            assert (got.radar, got.stamp) == (sweep.radar, sweep.stamp)
            np.testing.assert_array_equal(got.T_world_sensor, sweep.T_world_sensor)
            np.testing.assert_array_equal(got.velocity, sweep.velocity)
            for column, other in zip(got.detections, sweep.detections, strict=True):
                assert column.dtype == other.dtype
                np.testing.assert_array_equal(column, other)


@each("array", ["sweeps", "detections"])
def test_damaged_sweeps_are_found(written: Path, tmp_path: Path, array: str) -> None:
    store = Store.open(shutil.copytree(written, tmp_path / "data"))
    file = next(one for one in (store.path / "validation" / array / "c").rglob("*") if one.is_file())
    data = bytearray(file.read_bytes())
    data[len(data) // 3] ^= 4
    file.write_bytes(bytes(data))
    split = Store.open(store.path)["validation"]
    found = [error for _, error in split.damage()]
    assert found
    assert all(isinstance(one, Damaged) for one in found)


def test_more_detections_than_a_sample_holds_are_refused(store: Store) -> None:
    part = store["validation"]
    part._small["sweeps", 0] = rows = part._shard("sweeps", 0).copy()
    rows[0, 0, 3] = 1e9
    part._compare = lambda *_: None  # type: ignore[method-assign]
    refused("values out of range", part.sweeps, 0, error=Damaged)


def test_frames_of_lidar_and_radars(store: Store) -> None:
    assert len(open_dataset(store.path)) == 10
    radars = open_dataset(store.path, sensors="radar")
    assert (len(radars), radars.facts["radars"]) == (30, {"ars548-front": "ars548", "corner-rear-left": "corner"})
    rear = open_dataset(store.path, sensors=("lidar", "corner-rear-left"))
    assert len(rear) == 20
    frame, lidar = rear[1], rear[0]
    assert frame.scan.sensor == "corner-rear-left"
    assert frame.scan.doppler is not None
    assert (frame.scan.doppler_interval, lidar.scan.doppler_interval) == (44.0, None)
    assert frame.scan.rcs is not None
    # all sensors of a vehicle share its frame, around the lidar
    sample = store["validation"][0]
    T = pose(TWO[1].x, TWO[1].y, TWO[1].z, yaw=TWO[1].yaw)
    T[:2, 3] -= sample.T_vehicle_sensor[:2, 3]
    np.testing.assert_allclose(frame.mount.T_vehicle_sensor, T)
    assert frame.mount.ego_footprint == lidar.mount.ego_footprint
    T_radar_lidar = inverse(frame.T_map_sensor) @ lidar.T_map_sensor
    expected = lidar.boxes.moved(T_radar_lidar)
    np.testing.assert_allclose(frame.boxes.center, expected.center)
    assert frame.truth.spec == lidar.truth.spec
    refused("no sensor 'side'; it has lidar, radar", open_dataset, store.path, error=OgmError, sensors="side")


def test_sweeps_between_the_turns_of_a_drive_come_in_time_and_without_truth(tmp_path: Path) -> None:
    made = Store.create(tmp_path / "d", asdict(DatasetPlan(radars=TWO)), {"sequences": 10}, BEAMS, {})
    samples = [replace(with_sweeps(stand_in(None, "sequences", i), i), stamp=20 + i / 10) for i in range(10)]
    for k, one in enumerate(samples):
        late = one.stamp - stand_in(None, "sequences", k).stamp
        samples[k] = replace(one, sweeps=[sweep._replace(stamp=sweep.stamp + late) for sweep in one.sweeps])
    made.write("sequences", 0, samples)
    every = open_dataset(made.path, sensors=("radar", "lidar"))
    stamps = [ref.stamp for ref in every.refs]
    assert (len(every), stamps) == (40, sorted(stamps))
    assert len(every.with_truth) == 30
    between = next(n for n in range(40) if n not in every.with_truth)
    assert every[between].name.endswith("ars548-front 20.050 s")
    with pytest.raises(OgmError, match="between lidar scans"):
        every[between].truth  # noqa: B018


def test_data_sets_without_radars_have_none(tmp_path: Path) -> None:
    store = Store.create(tmp_path / "d", {"radars": ()}, {"test": 1}, BEAMS, {})
    store.write("test", 0, [stand_in(None, "test", 0)])
    assert store.format == "ogm.samples/3"
    assert store["test"][0].sweeps == ()
    refused("has no radar", open_dataset, store.path, error=OgmError, split="test", sensors="radar")
    refused("for datasets that", open_dataset, tmp_path, sensors="radar")


def test_space_is_there_for_the_most_detections() -> None:
    radars = tuple(StoredRadar.of_mount(one) for one in TWO)
    layout = Contents(radars=radars).layout
    assert layout["detections"][0][0] == sum(2 * RADARS[one.radar].max_detections for one in TWO)
    refused("must be in 1 ... 100000", StoredRadar.from_dict, radars[0]._asdict() | {"sweeps": 10**9})


@pytest.mark.slow
@pytest.mark.usefixtures("kept_towns")
def test_sweeps_of_a_sample_are_the_same_every_time_and_see_the_traffic_move() -> None:
    pytest.importorskip("open3d")
    from ogm.simulation.dataset import make_sample, set_up

    plan = DatasetPlan(town_size=240, samples=0, validation=0, test=0, sequences=1, radars=TWO)
    sample = make_sample(plan, "sequences", 3, threads=1)
    again = make_sample(plan, "sequences", 3, threads=1)
    bare = make_sample(replace(plan, radars=()), "sequences", 3, threads=1)
    np.testing.assert_array_equal(sample.steps, bare.steps)
    np.testing.assert_array_equal(sample.truth.state, bare.truth.state)
    assert [(one.radar, round(one.stamp, 3)) for one in sample.sweeps] == [(0, 20.25), (0, 20.3), (1, 20.25), (1, 20.3)]
    for one, other in zip(sample.sweeps, again.sweeps, strict=True):
        np.testing.assert_array_equal(one.detections.table, other.detections.table)
    first, second = sample.sweeps[:2]
    moved = second.T_world_sensor[:3, 3] - first.T_world_sensor[:3, 3]
    np.testing.assert_allclose(moved / 0.05, first.velocity, atol=0.3)
    # standing things have no velocity over ground
    for one in sample.sweeps:
        found = one.detections
        still = (found.origin == Origin.OBJECT) & (found.object < 0)
        assert np.abs(np.median(found.compensated[still])) < 0.1
    tracks = {one.track for one in set_up(plan, "sequences", 3, 1).objects}
    assert {int(one) for one in np.concatenate([s.detections.object for s in sample.sweeps])} <= tracks | {-1}
