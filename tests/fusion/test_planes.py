"""Several sensors of one robot: what the plane of a laser calls free clears nothing above or below it."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cases import each
from commands import completed
from rooms import CAMERA, MAN, ROOM, TABLE, depths, image_message, info_message, looking, ranges

from ogm import EvidentialGrid, Frame, GridSpec, Mount, Scan, fuse, load_model
from ogm.evidence.map_rules import BAYES, DYNAMIC
from ogm.fusion import make_mapper
from ogm.io import depth_scan
from ogm.io.depth import T_OPTICAL_BODY
from ogm.io.logs import LogWriter
from ogm.io.messages import StampedTransform, point_cloud2, tf_message
from ogm.io.messages.plain import header
from ogm.pose import inverse, pose

SPEC = GridSpec(0.1, (90, 60), (-3.5, -3.0))
NO_FOOTPRINT = (0.0, 0.0, 0.0, 0.0)
LOW = 0.2  # [m] height of the laser: it sees the legs of the table


def frames(order: str) -> list[Frame]:
    """Return frames of a laser (l) and of a depth camera (d) of a robot that stands, at 10 Hz in an order."""
    boxes, found = (*TABLE, MAN), []
    azimuth = np.radians(np.arange(-135, 135, 0.5))
    ways = np.column_stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth])
    laser = (ranges(np.array([0, 0, LOW]), ways, boxes)[:, None] * ways).astype(np.float32)
    for k, sensor in enumerate(order):
        T = looking(1.2, 15) if sensor == "d" else pose(z=LOW)
        scan = Scan(laser, stamp=0.1 * k, kind="planar", max_range=8.0)
        if sensor == "d":
            scan = depth_scan(depths(T, boxes), CAMERA, 1.0, stamp=0.1 * k)
        mount = Mount(T[2, 3], T, NO_FOOTPRINT)
        found.append(Frame(scan, mount, T_map_sensor=T, stamp=0.1 * k, name=str(k)))
    return found


def mapped(rule: str, order: str) -> EvidentialGrid:
    """Return the map of frames by a rule, in a fixed window."""
    mapper = make_mapper(rule, SPEC, None if rule == DYNAMIC else np.inf, "fixed", particles=20_000)
    for step in fuse(frames(order), load_model("ray+planar+depth", SPEC), mapper):
        assert step.grid is not None
    return mapper.grid


TABLE_CELLS = np.s_[55:64, 25:35]  # inside of the edges of the top


@each("rule, order", itertools.product(("revise", BAYES, DYNAMIC), ("dllllllll", "lllldllll", "lllllllld")))
def test_a_laser_between_the_legs_of_a_table_does_not_clear_its_top(
    rule: str, order: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.clear()
    grid = mapped(rule, order)
    x, y = np.broadcast_arrays(*SPEC.cell_centers)
    assert (x[TABLE_CELLS].min(), x[TABLE_CELLS].max(), abs(y[TABLE_CELLS]).max()) == pytest.approx((2.05, 2.85, 0.45))
    assert grid.free[TABLE_CELLS].max() < 0.5
    beside = (x > 0.2) & (x < 0.8) & (abs(y - 2) < 0.5)  # the view of the camera, in the plane of the laser
    assert (grid.mass.sum(-1) <= 1 + 1e-6).all()
    told = [one.message for one in caplog.records if "free cells of the laser are ignored" in one.message]
    if rule == DYNAMIC:  # the laser only marks, and a line says so
        assert len(told) == (order != "lllllllld")
        return
    assert not told
    assert grid.free[beside].min() > 0.5
    assert grid.occupied[TABLE_CELLS].min() > 0.5
    assert grid.occupied[(x > 1.7) & (x < 1.9) & (y > 0.85) & (y < 1.05)].max() > 0.9  # the man


@each("rule", ["revise", BAYES, DYNAMIC])
def test_a_laser_alone_clears_between_the_legs(rule: str) -> None:
    assert mapped(rule, "llllllll").free[TABLE_CELLS].max() > 0.7


PLACES = [pose(-1.0 + 0.2 * k, -0.3, yaw=0.05 * k) for k in range(6)]
MOUNTS = {"laser": pose(0.2, z=LOW), "camera": pose(0.1) @ looking(1.2, 15), "lidar": pose(z=1.0)}


def messages() -> Iterator[tuple[str, str, Any, float]]:
    """Yield the messages of a robot with three sensors that drives towards a table and a man."""
    static = [StampedTransform("base_link", name, 0.0, T) for name, T in MOUNTS.items() if name != "camera"]
    optical = MOUNTS["camera"] @ inverse(T_OPTICAL_BODY)
    static.append(StampedTransform("base_link", "camera_optical_frame", 0.0, optical))
    yield "/tf_static", "tf2_msgs/msg/TFMessage", tf_message(static), 100.0
    step, boxes = np.radians(0.5), (*TABLE, MAN)
    azimuth = np.arange(-135, 135.5, 0.5) * np.pi / 180
    turn, rise = (a.ravel() for a in np.meshgrid(np.arange(0, 360, 0.5) * np.pi / 180, np.radians(np.arange(-30, 10))))
    around = np.column_stack([np.cos(turn), np.sin(turn), np.tan(rise)])
    level = np.column_stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth])
    for k, T in enumerate(PLACES):
        stamp = 100 + 0.1 * k
        moved = StampedTransform("map", "base_link", stamp, T)
        yield "/tf", "tf2_msgs/msg/TFMessage", tf_message([moved]), stamp
        place = T @ MOUNTS["laser"]
        beams = {"angle_min": azimuth[0], "angle_max": azimuth[-1], "angle_increment": step, "time_increment": 0.0,
                 "scan_time": 0.1, "range_min": 0.05, "range_max": 20.0, "intensities": np.empty(0, np.float32),
                 "ranges": ranges(place[:3, 3], level @ place[:3, :3].T, boxes).astype(np.float32)}  # fmt: skip
        yield "/scan", "sensor_msgs/msg/LaserScan", SimpleNamespace(header=header(stamp, "laser"), **beams), stamp
        image = depths(T @ MOUNTS["camera"], boxes)
        sensor_msgs = "sensor_msgs/msg/"
        yield "/depth/image", f"{sensor_msgs}Image", image_message(image, "16UC1", "camera_optical_frame", stamp), stamp
        camera = info_message("camera_optical_frame", stamp, ros1=False)
        yield "/depth/camera_info", f"{sensor_msgs}CameraInfo", camera, stamp
        place = T @ MOUNTS["lidar"]
        points = ranges(place[:3, 3], around @ place[:3, :3].T, boxes)[:, None] * around
        cloud = point_cloud2(Scan(points.astype(np.float32)), frame_id="lidar", stamp=stamp)
        yield "/points", f"{sensor_msgs}PointCloud2", cloud, stamp


def test_a_laser_a_depth_camera_and_a_lidar_of_one_log_give_one_map(tmp_path: Path) -> None:
    """Table, walls and man stand, and nothing unseen is free."""
    pytest.importorskip("rosbags")
    pytest.importorskip("mcap")
    with LogWriter(tmp_path / "robot.mcap") as log:
        for message in messages():
            log.write(*message)
    size = ("--length", 12, "--width", 8, "--resolution", 0.1, "--window", "fixed", "--half-life", "inf")
    topics = [word for topic in ("/scan", "/depth/image", "/points") for word in ("--topic", topic)]
    out = tmp_path / "map.npz"
    result = completed("fuse", tmp_path / "robot.mcap", *topics, "--ism", "ray+planar+depth", *size, "--out", out)
    assert "18 mapped, 0 skipped" in result.output
    grid = EvidentialGrid.load(out)
    x, y = np.broadcast_arrays(*grid.spec.cell_centers)
    inside = (x > ROOM[0]) & (x < ROOM[3]) & (y > ROOM[1]) & (y < ROOM[4])
    table = (x > 2.0) & (x < 2.9) & (abs(y) < 0.5)
    man = (x > 1.8) & (x < 1.9) & (y > 0.8) & (y < 1.1)
    wall = (abs(x - ROOM[3]) < 0.05) & (abs(y) < 2) & ~((y > 0.9) & (y < 2.9))  # not in the shadow of the man
    # Between two rings of the lidar, rays pass above and below the top: the only free that a lidar does not promise.
    assert (grid.occupied[table] > 0.5).mean() > 0.9
    assert grid.free[table].max() < 0.7
    assert (grid.occupied[man].min(), grid.free[man].max()) == (pytest.approx(1, abs=0.4), pytest.approx(0, abs=0.4))
    assert (grid.occupied[wall] > 0.5).mean() > 0.9
    assert grid.free[wall].max() < 0.5
    assert grid.free[~inside].max() < 0.5
    assert (grid.free[(x > 0.5) & (x < 1.5) & (y > -1.5) & (y < 0.5)] > 0.5).mean() > 0.95


def test_a_map_of_a_building_keeps_the_promise_of_free_and_does_not_flicker() -> None:
    """Laws of `smooth`: a man in the free space of a laser who comes, is missed by one scan, and leaves."""
    rng, (empty, there) = np.random.default_rng(0), (TABLE, (*TABLE, MAN))
    azimuth = np.radians(np.arange(-135, 135, 0.5))
    ways = np.column_stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth])
    reach = {boxes: ranges(np.array([0, 0, LOW]), ways, boxes) for boxes in (empty, there)}
    man = (reach[there] < reach[empty] - 0.1).nonzero()[0]
    ends = reach[there][man, None] * ways[man]
    cells = SPEC.index(*ends[:, :2].T)
    model, mapper = load_model("planar", SPEC), make_mapper("smooth", SPEC, np.inf, "fixed")
    free, occupied = [], []
    for boxes in [empty] * 15 + [there] * 20 + [empty] + [there] + [empty] * 5:
        noisy = (reach[boxes] + rng.normal(0, 0.005, len(ways)))[:, None] * ways
        mount = Mount(LOW, pose(z=LOW), NO_FOOTPRINT)
        mapper.update(model(Scan(noisy.astype(np.float32), kind="planar", max_range=8.0, mount=mount)), np.eye(4))
        mass = mapper.grid.mass[cells]
        free.append((mass[:, 0] > 0.5).mean())
        occupied.append((mass[:, 1] > 0.5).mean())
    assert free[14] > 0.9
    assert free[15] <= 0.25
    assert max(free[16:35]) == 0
    assert min(occupied[18:35]) >= 0.8
    assert free[35] <= 0.1
    assert min(occupied[35:37]) >= 0.8  # one wrong scan erases nothing
    assert free[37] < 0.5
    assert free[41] > 0.9
