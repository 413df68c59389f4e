"""Logs whose clouds are tilted, registered or mounted unusually, and setups of sensors that the user states."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import odd_logs
import pytest
from cases import each, refused
from odd_logs import BOX, tilted, way, write_log

from ogm.datasets import SensorSetup, open_dataset, read_setups, with_poses, write_setups
from ogm.datasets.frames import RawFrame
from ogm.datasets.sensor_setup import within_limits
from ogm.fusion import fuse, make_mapper
from ogm.geometric import RayISM
from ogm.grid import GridSpec
from ogm.io import write_poses
from ogm.io.scan_table import rotation_to_flu
from ogm.pose import Trajectory, inverse, levelling, pose, tilt_of, transform_points
from ogm.scan import Frame, Mount, Scan
from ogm.state import CellState, predict_state
from ogm.storage.files import OgmError

SPEC = GridSpec.centered(40, 24, 0.25)
BOTH = (("map", "base_link"), ("base_link", "os_lidar"))


def check_map(dataset: Any) -> None:
    """The front of the box is occupied, the ground before it free."""
    mapper = make_mapper("cautious", SPEC, None, "fixed")
    assert all(step.error is None for step in fuse(dataset, RayISM(SPEC), mapper))
    state, spec = predict_state(mapper.grid.mass), mapper.grid.spec
    y = np.arange(-2.5, 2.5, 0.2)
    front = [state[spec.index(0 * y + BOX + d, y)] == CellState.OCCUPIED for d in (-0.1, 0.1)]
    assert np.mean(front[0] | front[1]) > 0.95
    x = np.linspace(4.0, 7.0, 20)
    assert np.mean(state[spec.index(x, 0 * x)] == CellState.FREE) > 0.95


# --- Tilt that only the poses hold -------------------------------------------------------------------


@each("roll, pitch, yaw", [(0, 10, 0), (-25, 0, 30), (180, 0, 0), (90, 0, 40), (0, 90, 0)])
def test_scans_are_levelled_by_the_tilt_of_their_poses(tmp_path: Path, roll: int, pitch: int, yaw: int) -> None:
    dataset = open_dataset(write_log(tmp_path / "a.mcap", [np.eye(4)] * 2, tilted(roll, pitch, yaw)))
    assert dataset[0].mount.sensor_height == pytest.approx(1.2, abs=0.01)
    check_map(dataset)


def test_each_scan_has_the_tilt_of_its_own_pose(tmp_path: Path) -> None:
    """A vehicle that sways: base_link is tilted on the map, not the sensor on base_link."""
    sway = [tilted(12 * k - 18, 10 - 8 * k, height=0.0) for k in range(4)]
    check_map(open_dataset(write_log(tmp_path / "a.mcap", sway, pose(z=1.2), chain=BOTH)))


def test_the_slope_of_the_road_is_no_tilt_of_the_sensor(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.mcap", [np.eye(4)] * 3, pose(z=1.2), pose_mount=pose(pitch=-0.1) @ pose(z=1.2))
    assert tilt_of(open_dataset(path)[0].mount.T_vehicle_sensor) == 0


def test_files_are_levelled_by_poses_beside_them(tmp_path: Path) -> None:
    T = tilted(pitch=15)
    for k in range(2):
        np.save(tmp_path / f"{k}.npy", transform_points(inverse(T), odd_logs.world()).astype(np.float32))
    write_poses(tmp_path / "given.csv", Trajectory(np.array([0.0, 0.1]), np.array([T, T])), np.arange(2))
    dataset = open_dataset([tmp_path / "0.npy", tmp_path / "1.npy"])
    refused("tilted, and neither transforms from base_link nor poses", lambda: dataset[0].mount)
    check_map(with_poses(dataset, tmp_path / "given.csv"))
    mounted = open_dataset(
        [tmp_path / "0.npy", tmp_path / "1.npy"], setups=SensorSetup(mount=(0, 0, 0, 0, math.radians(15), 0))
    )
    assert mounted[0].mount.sensor_height == pytest.approx(1.2, abs=0.01)


def test_levelling_is_a_rotation_to_the_vertical() -> None:
    rng = np.random.default_rng(0)
    for T in [pose(roll=a, pitch=b, yaw=c) for a, b, c in rng.uniform(-math.pi, math.pi, (50, 3))]:
        R = levelling(T)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
        np.testing.assert_allclose((T[:3, :3] @ R.T)[2], [0, 0, 1], atol=1e-9)


@each("axes, side", [
        ("+x,-y,-z", "above"), ("+x,-z,+y", "right of"), ("+x,+z,-y", "left of"), ("-z,+y,+x", "behind"),
        ("+z,+y,-x", "before"),
    ])  # fmt: skip
def test_a_sensor_on_its_side_is_refused_with_the_axes(tmp_path: Path, axes: str, side: str) -> None:
    points = odd_logs.world() - [0, 0, 1.2]
    np.save(tmp_path / "a.npy", (points @ rotation_to_flu(axes.split(","))).astype(np.float32))
    text = refused(f"the ground lies {side} the sensor: give axes", lambda: open_dataset(tmp_path / "a.npy")[0].mount)
    assert f"--axes={axes}" in text
    mount = open_dataset(tmp_path / "a.npy", axes=axes.split(","))[0].mount
    assert mount.sensor_height == pytest.approx(1.2, abs=0.01)
    # Axes given already are part of the answer
    wrong = lambda: open_dataset(tmp_path / "a.npy", axes=("+y", "+z", "+x"))[0].mount  # noqa: E731
    if axes.split(",")[2] != "+x":
        wanted = re.search(r"--axes=([^)]*)", refused("give axes", wrong))[1].split(",")
        assert wanted[2] == axes.split(",")[2]


# --- Clouds in other frames than their sensor's ------------------------------------------------------


@each("frame, chain", [
        ("map", (("map", "os_lidar"),)), ("map", BOTH), ("base_link", BOTH),
        ("odom", (("odom", "base_link"), ("base_link", "velodyne"))), ("map", (("map", "body"),)),
    ])  # fmt: skip
def test_rays_of_registered_clouds_start_at_the_sensor(
    tmp_path: Path, frame: str, chain: tuple[tuple[str, str], ...]
) -> None:
    mount = pose(0.9, 0.2, 1.2, pitch=0.1)
    dataset = open_dataset(write_log(tmp_path / "a.mcap", way(4), mount, frame=frame, chain=chain))
    assert f"points of /points from {frame}" in dataset.facts["poses"]
    for n, T in enumerate(way(4)):
        found = dataset[n]
        assert found.T_map_sensor is not None
        np.testing.assert_allclose(found.T_map_sensor[:3, 3], (T @ mount)[:3, 3], atol=1e-6)
        at = transform_points(found.T_map_sensor, found.scan.points.astype(np.float64))[:, :3]
        np.testing.assert_allclose(at, odd_logs.world(), atol=1e-4)
    check_map(dataset)


@each("frame, chain, message", [
        ("map", (), "transforms from it are missing"),
        ("robot/odom", (("robot/odom", "robot/base_link"),), "lead from it to robot/base_link, wanted one lidar"),
        ("map", (*BOTH, ("base_link", "rslidar")), "lead from it to os_lidar, rslidar, wanted one lidar"),
    ])  # fmt: skip
def test_a_registered_cloud_without_the_place_of_its_sensor_is_refused(
    tmp_path: Path, frame: str, chain: tuple[tuple[str, str], ...], message: str
) -> None:
    path = write_log(tmp_path / "a.mcap", way(2), pose(z=1.2), frame=frame, chain=chain)
    assert "`sensor_position`" in refused(message, open_dataset, path, error=OgmError)


def test_the_position_of_a_sensor_counts_from_base_link(tmp_path: Path) -> None:
    mount, chain = pose(0.9, 0.0, 1.2), (("map", "base_link"),)
    path = write_log(tmp_path / "a.mcap", way(4), mount, frame="map", chain=chain)
    check_map(open_dataset(path, sensor_position=(0.9, 0.0, 1.2)))
    known = write_log(tmp_path / "b.mcap", way(4), mount, chain=BOTH)
    refused("points in the vehicle's frame, but those of .* are in os_lidar", open_dataset, known,
            sensor_position=(0.9, 0.0, 1.2))  # fmt: skip


# --- Setups ------------------------------------------------------------------------------------------


def test_setups_come_back_from_their_file(tmp_path: Path) -> None:
    front = SensorSetup("/front", 1.5, (1.0, 0.2, 1.1, 0.01, 0.2, 0.3), (-0.5, 0.5, -0.3, 0.3), 0.5, 30.0, True)
    setups = (front, SensorSetup(leave_out=((2.0, 3.5), (-0.5, 0.5))))
    write_setups(tmp_path / "a.yaml", setups)
    for given, found in zip(setups, read_setups(tmp_path / "a.yaml"), strict=True):
        assert found.topic == given.topic
        assert found.ego_footprint == given.ego_footprint
        assert (found.min_range, found.max_range, found.max_range_no_echo) == (
            given.min_range, given.max_range, given.max_range_no_echo,
        )  # fmt: skip
        np.testing.assert_allclose(found.leave_out, given.leave_out, atol=1e-3)
    np.testing.assert_allclose(read_setups(tmp_path / "a.yaml")[0].mount, front.mount, atol=1e-4)


@each("text, message", [
        ("", "list `sensors`"), ("sensors: 3", "list `sensors`"), ("sensors: []", "one entry"), ("a: [", "no YAML"),
        ("sensors: [{colour: red}]", "unknown key 'colour'"), ("sensors: [{range: [3, 1]}]", "below max_range"),
        ("sensors: [{mount: {w: 1}}]", "unknown key 'w'"), ("sensors: [{footprint: [1, 2]}]", "ego_footprint"),
        ("sensors: [{no_echo_at_greatest_range: true}]", "greatest range"), ("sensors: [{}, {}]", "one entry"),
        ("sensors: [{height: high}]", "list `sensors`"), ("sensors: [{leave_out: [[0, 900]]}]", "a turn"),
    ])  # fmt: skip
def test_files_of_no_setups_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.yaml").write_text(text)
    refused(message, read_setups, tmp_path / "a.yaml", error=OgmError)


def test_points_out_of_range_and_view_are_left_out() -> None:
    points = np.array([[1, 0, 0], [0.1, 0, 0], [0, 30, 0], [-5, 0, 0], [0, 40, 3], [0, -29.9, 0]], np.float32)
    setup = SensorSetup(min_range=0.5, max_range=30, max_range_no_echo=True, leave_out=((math.radians(170), -3.0),))
    scan = setup.limit(RawFrame(Scan(points))).scan
    np.testing.assert_array_equal(scan.points[:, :3], points[[0, 5]])
    assert scan.no_returns is not None
    np.testing.assert_allclose(scan.no_returns, [[0, 1, 0], points[4] / np.linalg.norm(points[4])], atol=1e-6)
    moved = setup.limit(RawFrame(Scan(points + np.float32(7))), (7.0, 7.0, 7.0)).scan
    assert len(moved) == len(scan)
    dropped = SensorSetup(max_range=30).limit(RawFrame(Scan(points))).scan
    assert len(dropped) == len(points) - 1
    assert dropped.no_returns is None


def test_the_mount_of_a_setup_counts_instead_of_transforms(tmp_path: Path) -> None:
    """Also beside poses that are those of a level sensor."""
    mount = tilted(pitch=20)
    path = write_log(tmp_path / "a.mcap", [np.eye(4)] * 2, mount, pose_mount=pose(z=1.2))
    setup = SensorSetup("/points", mount=(0, 0, 0, 0, math.radians(20), 0))
    check_map(open_dataset(path, setups=setup))
    refused("setups. are for the topics /front, but .* /points", open_dataset, path, setups=SensorSetup("/front"))
    beside = write_log(tmp_path / "b.mcap", [np.eye(4)] * 2, mount, chain=(("map", "base_link"),), frame="scanner")
    check_map(open_dataset(beside, setups=SensorSetup(mount=(0, 0, 1.2, 0, math.radians(20), 0))))


@each("footprint, kept", [(None, 0), ((0, 0, 0, 0), 8), ((-0.5, 0.5, -0.3, 0.3), 8)])
def test_the_ego_footprint_of_a_setup_reaches_the_mount(tmp_path: Path, footprint: Any, kept: int) -> None:
    np.save(tmp_path / "a.npy", (odd_logs.world() - [0, 0, 0.9]).astype(np.float32))
    frame = open_dataset(tmp_path / "a.npy", setups=[SensorSetup(ego_footprint=footprint)])[0]
    grid = RayISM(GridSpec.centered(12, 8, 0.1))(frame.scan)
    a, b = np.meshgrid([-1.0, 0.5, 2.0], [-0.95, 0.95])
    near = predict_state(grid.mass)[grid.spec.index(a.ravel(), b.ravel())]
    assert (np.count_nonzero(near == CellState.OCCUPIED) >= 4) == bool(kept)


def test_files_in_map_coordinates_come_to_their_sensor(tmp_path: Path) -> None:
    utm, poses = np.array([367000.0, 5600000.0, 100.0]), []
    for k, T in enumerate(way(3)):
        np.save(tmp_path / f"{k}.npy", odd_logs.world() + utm)
        placed = T @ pose(z=1.2)
        placed[:3, 3] += utm
        poses.append(placed)
    files = [tmp_path / f"{k}.npy" for k in range(3)]
    refused(r"map coordinates give the sensor's position as `origin`", lambda: open_dataset(files)[0].scan)
    alone = open_dataset(files, origin=tuple(poses[0][:3, 3]))
    assert alone[0].mount.sensor_height == pytest.approx(1.2, abs=0.01)
    write_poses(tmp_path / "poses.csv", Trajectory(np.arange(3.0), np.array(poses)), np.arange(3))
    placed = with_poses(alone, tmp_path / "poses.csv")
    for n in range(3):
        at = transform_points(poses[n], placed[n].scan.points.astype(np.float64))[:, :3] - utm
        np.testing.assert_allclose(at, odd_logs.world(), atol=1e-4)
    log = write_log(tmp_path / "a.mcap", way(2), pose(z=1.2))
    refused("origin.* is for files", open_dataset, log, origin=(0.0, 0.0, 0.0))


def test_frames_of_a_driver_are_levelled_and_limited(tmp_path: Path) -> None:
    dataset = open_dataset(write_log(tmp_path / "a.mcap", [np.eye(4)] * 2, tilted(pitch=20)))
    frames = [Frame(one.scan, Mount(1.2), T_map_sensor=one.T_map_sensor, stamp=one.stamp) for one in dataset]
    check_map(within_limits(frames, SensorSetup(max_range=14)))
