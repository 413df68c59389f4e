"""Planar lasers and depth cameras of the simulator, in a hall of boxes: made, stored, read, mapped, evaluated."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cases import each, needs, refused
from commands import completed
from scipy.ndimage import binary_dilation

from ogm import GridSpec, open_dataset
from ogm.cli.evaluate_command import usual_models
from ogm.models import load_model
from ogm.models.named import for_all_kinds
from ogm.pose import pose, transform_points
from ogm.simulation.mounts import single_sensor
from ogm.simulation.plan import DatasetPlan
from ogm.simulation.robot_sensors import ROBOT_SENSORS, depth_camera, planar_laser, sensor_spec
from ogm.simulation.sample import Beams
from ogm.simulation.store import KINDS, Store
from ogm.state import CellState
from ogm.truth import TRUTH_SPEC

needs("zarr", "open3d")
ROOM = (-8.0, -3.0, 12.0, 3.0)  # x, y from and to [m]
THINGS = (
    (7.0, -1.0, 0.70, 8.4, 1.0, 0.75),  # a table
    *((x, y, 0.0, x + 0.08, y + 0.08, 0.7) for x in (7.0, 8.32) for y in (-1.0, 0.92)),
    (5.5, 2.0, 0.0, 5.9, 2.4, 1.8),  # a person
    (9.5, -2.6, 0.0, 10.5, -1.8, 2.0),
)


@pytest.fixture(scope="module")
def hall() -> Any:
    """The hall as the world of a sample."""
    from ogm.simulation.materials import Material
    from ogm.simulation.mesh import box, merge
    from ogm.simulation.scene import Scene

    x0, y0, x1, y1 = ROOM
    floor = box([x0 - 1, y0 - 1, -0.2], [x1 + 1, y1 + 1, 0.0], Material.ASPHALT)
    sides = [(x0 - 1, y0, x0, y1), (x1, y0, x1 + 1, y1), (x0, y0 - 1, x1, y0), (x0, y1, x1, y1 + 1)]
    walls = [box([a, b, 0.0], [c, d, 2.6], Material.CONCRETE) for a, b, c, d in sides]
    things = [box(one[:3], one[3:], Material.CONCRETE) for one in THINGS]
    return SimpleNamespace(scene=Scene(merge([floor, *walls, *things]), threads=1), ground=Scene(floor, threads=1))


@pytest.fixture
def drive(hall: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Write two scans, 0.3 m apart, of a sensor that drives through the hall."""
    from ogm.simulation import dataset
    from ogm.simulation.moments import SceneSetup, draw_mount

    def set_up(plan: DatasetPlan, split: str, index: int, threads: int = 0) -> SceneSetup:
        mount, (height, forward, _, _) = draw_mount(plan, split, index)
        ego, T = pose(0.3 * index, 0.1), pose(forward, 0.0, height)
        state = SimpleNamespace(ego=ego, ego_velocity=np.array([3.0, 0.0, 0.0]), ego_yaw_rate=0.0, objects=())
        return SceneSetup(hall, state, (), sensor_spec(mount.lidar), T, ego @ T)

    def written(words: str, truth: str = "none") -> Path:
        plan = DatasetPlan(samples=0, validation=0, test=0, sequences=1, mounts=single_sensor(words), truth=truth)
        path, counts = tmp_path / words, {"sequences": 2}
        store = Store.create(path, asdict(plan), counts, dataset.lidars(plan), {"ogm": "0"})
        store.write("sequences", 0, [dataset.make_sample(plan, "sequences", k, threads=1) for k in range(2)])
        return path

    monkeypatch.setattr(dataset, "set_up", set_up)
    return written


@each(
    "words, kind, height, error",
    [
        ("utm-30lx", "planar", 0.3, 0.05),
        ("lds-01@0.2", "planar", 0.2, 0.05),
        ("lms-291@1", "planar", 1.0, 0.05),
        ("d435", "depth", 0.8, 0.5),
        ("xtion@0.5", "depth", 0.5, 0.3),
    ],
)
def test_a_simulated_drive_reads_back(
    words: str, kind: str, height: float, error: float, drive: Callable[..., Path]
) -> None:
    path, spec = drive(words), sensor_spec(words.partition("@")[0])
    assert Store.open(path).format == KINDS
    frames = open_dataset(path)
    for k in range(2):
        scan, mount = frames[k].scan, frames[k].mount
        assert (scan.kind, scan.max_range, scan.sensor) == (kind, spec.range_max, spec.name)
        assert mount.sensor_height == height
        assert mount.ego_footprint == (-5.0, 0.0, -1.1, 1.1)  # behind the bumper
        if kind == "planar":
            assert len(scan) + len(scan.no_returns) == spec.azimuths
            assert np.ptp(scan.time) <= 1 / spec.rate
            assert np.abs(scan.points[:, 2]).max() < 1e-6
        else:
            assert scan.no_returns is None
            assert 0.3 * spec.azimuths * spec.layers < len(scan) < spec.azimuths * spec.layers
        x, y, z = transform_points(frames[k].T_map_sensor, scan.points)[:, :3].T
        off = np.minimum.reduce([abs(x - ROOM[0]), abs(x - ROOM[2]), abs(y - ROOM[1]), abs(y - ROOM[3]), abs(z)])
        for x0, y0, z0, x1, y1, z1 in THINGS:
            beyond = np.maximum.reduce([x0 - x, x - x1, y0 - y, y - y1, z0 - z, z - z1, 0 * x])
            off = np.minimum(off, beyond)
        own = np.hypot(*scan.points[:, :2].T) < 0.5  # the bumper
        assert np.quantile(off[~own], 0.98) < error


@each("words", ["ust-10lx@0.3", "d435"])
def test_nothing_that_was_hit_is_free_and_the_truth_agrees(words: str, drive: Callable[..., Path]) -> None:
    frames = open_dataset(drive(words, "aimed"))
    for k in range(2):
        frame = frames[k]
        grid_spec = GridSpec.centered(25.6, 19.2, 0.16)
        free, occupied = np.moveaxis(load_model(for_all_kinds("ray"), grid_spec, None)(frame.scan).mass, -1, 0)
        x, y, z = (frame.scan.points[:, :3] + [0, 0, frame.mount.sensor_height]).T
        standing = (z > 0.2) & (z < 1.9) & (np.abs(x) < 12) & (np.abs(y) < 9) & (x > 0.1)
        hit = np.zeros(grid_spec.shape, bool)
        hit[grid_spec.index(x[standing], y[standing])] = True
        counts = np.zeros(grid_spec.shape, int)
        np.add.at(counts, grid_spec.index(x[standing], y[standing]), 1)
        hit &= counts >= (1 if frame.scan.kind == "planar" else 5)  # one pixel of noise is no hit
        assert (free[hit] < 0.5).all()
        truth = frame.truth.crop(grid_spec).state
        known = np.isin(truth, [CellState.FREE, CellState.OCCUPIED])
        beside = binary_dilation(truth == CellState.OCCUPIED, np.ones((3, 3)))  # as ranges have noise
        assert beside[hit & known].mean() > 0.9
        says_free = (free > 0.5) & known
        assert says_free.sum() > 300
        assert (truth[says_free] == CellState.FREE).mean() > 0.95
        assert ((occupied > 0.5) & (truth == CellState.OCCUPIED)).sum() > 30


def test_commands_read_a_planar_drive_by_default(drive: Callable[..., Path], tmp_path: Path) -> None:
    path = drive("utm-30lx")
    assert "2 samples (2 utm-30lx)" in completed("info", path).output
    result = completed("map", path, "--out", tmp_path / "grids", "--first", 1)
    assert "planar, free at 0.30 m" in result.output + result.stderr
    result = completed("fuse", path, "--out", tmp_path / "map.npz")
    assert "0.05" in result.output + result.stderr
    assert usual_models(GridSpec.centered(), open_dataset(path)[0]) == ["planar"]
    assert usual_models(GridSpec.centered(), open_dataset(drive("d435"))[0]) == ["depth"]


def test_numbers_that_describe_no_sensor_are_refused() -> None:
    assert planar_laser("mine", 190, 1.0).azimuths == 191
    assert depth_camera("mine", 64, 48, 50.0).shape == (48, 64)
    refused("columns must be at least 2 and fit in a turn", planar_laser, "mine", 400, 1.0)
    refused("unknown lidar 'd4'; .*planar lasers: lds-01.*; depth cameras: d435, xtion", single_sensor, "d4")
    refused("@ after d435 must be followed by a height", single_sensor, "d435@roof")
    refused("height of d435", single_sensor, "d435@9")
    from ogm.simulation import dataset

    refused('truth "hd" needs a lidar', dataset.lidars, DatasetPlan(mounts=single_sensor("d435"), truth="hd"))
    beams = dataset.beams_of(ROBOT_SENSORS["d435"]).to_dict()
    assert Beams.from_dict(beams) == dataset.beams_of(ROBOT_SENSORS["d435"])
    for odd in ({"kind": "cone"}, {"range_max": 0.1}, {"step": 0.1}, {"elevation": [2.0] * 240}):
        with pytest.raises(ValueError, match="must"):
            Beams.from_dict(beams | odd)


@pytest.mark.slow
@pytest.mark.usefixtures("kept_towns")
@each("words, occupied", [("tim571", 50), ("xtion", 0)])  # nothing stands within 5 m of the camera
def test_drives_through_towns_have_truth(words: str, occupied: int) -> None:
    from ogm.simulation.dataset import make_sample

    plan = DatasetPlan(town_size=240.0, mounts=single_sensor(words))
    sample = make_sample(plan, "training", 3)
    assert sample.lidar == words
    states = np.bincount(sample.truth.state.ravel(), minlength=4)
    assert states[CellState.FREE] > 50
    assert states[CellState.OCCUPIED] >= occupied
    assert states[:3].sum() + states[3] == TRUTH_SPEC.shape[0] * TRUTH_SPEC.shape[1]
