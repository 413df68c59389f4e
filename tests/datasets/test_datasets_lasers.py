"""Planar lasers and range sensors in logs: alone, beside a lidar, tilted, de-skewed."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cases import each, refused

from ogm.datasets import SensorSetup, open_dataset
from ogm.fusion.pipeline import deskew_frame
from ogm.io.logs import LogWriter
from ogm.io.messages import StampedTransform, point_cloud2, tf_message
from ogm.io.messages.plain import header
from ogm.pose import Trajectory, inverse, pose, transform_points
from ogm.scan import Scan
from ogm.workflows import check_log

TF = "tf2_msgs/msg/TFMessage"
START, SCANS, BEAMS, WALL = 1_700_000_000.0, 4, 181, 5.0
AZIMUTHS = np.radians(np.arange(-90, 91))
PLACES = [pose(0.25 * k) for k in range(SCANS)]
RANGES = [np.minimum((WALL - 0.25 * k) / np.maximum(np.cos(AZIMUTHS), 1e-9), 9.0) for k in range(SCANS)]
T_BASE_LASER = pose(0.2, 0.0, 0.35)

Row = tuple[str, str, Any, float]


def laser(k: int, ranges: np.ndarray, topic: str = "/scan", **changed: Any) -> Row:
    """Return what a planar laser measures before a wall across the way, beyond 8 m nothing."""
    stamp, step = START + k / 8, float(AZIMUTHS[1] - AZIMUTHS[0])
    given = {"angle_min": -np.pi / 2, "angle_max": np.pi / 2, "angle_increment": step, "time_increment": 2.0**-12,
             "scan_time": 0.125, "range_min": 0.1, "range_max": 8.0,
             "intensities": np.full(len(ranges), 100.0 + k, np.float32), **changed}  # fmt: skip
    message = SimpleNamespace(header=header(stamp, topic[1:]), ranges=ranges.astype(np.float32), **given)
    return topic, "sensor_msgs/msg/LaserScan", message, stamp


def sonar(k: int) -> Row:
    given = {"radiation_type": 0, "field_of_view": 0.4, "min_range": 0.2, "max_range": 4.0, "range": 4.1}
    message = SimpleNamespace(header=header(START + k / 8, "sonar"), variance=0.0, **given)
    return "/sonar", "sensor_msgs/msg/Range", message, START + k / 8


def cloud(k: int) -> Row:
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-4, 4, 0.2), np.arange(-4, 4, 0.2)))
    ground = np.column_stack([x, y, np.full(len(x), -0.9), np.zeros(len(x))]).astype(np.float32)
    message = point_cloud2(Scan(ground), frame_id="points", stamp=START + k / 8)
    return "/points", "sensor_msgs/msg/PointCloud2", message, START + k / 8


def transforms(*mounts: tuple[str, np.ndarray]) -> list[Row]:
    static = [StampedTransform("base_link", child, 0.0, T) for child, T in mounts]
    moves = [StampedTransform("map", "base_link", START + k / 8, T) for k, T in enumerate(PLACES)]
    return [("/tf_static", TF, tf_message(static), START), ("/tf", TF, tf_message(moves), START)]


def scans() -> list[Row]:
    return [laser(k, ranges) for k, ranges in enumerate(RANGES)]


@pytest.fixture
def log(tmp_path: Path) -> Callable[..., Path]:
    def write(rows: list[Row], name: str = "drive.mcap") -> Path:
        with LogWriter(tmp_path / name) as writer:
            for row in sorted(rows, key=lambda row: row[3]):
                writer.write(*row)
        return tmp_path / name

    return write


@each("name", ["drive.mcap", "drive.db3", "drive.bag"])
def test_a_planar_laser_alone_is_read_with_poses_and_an_assumed_height(log: Callable[..., Path], name: str) -> None:
    dataset = open_dataset(log([*scans(), *transforms(("scan", T_BASE_LASER))], name))
    for k, frame in enumerate(dataset):
        points = transform_points(frame.T_map_sensor, frame.scan.points.astype(np.float64))
        np.testing.assert_allclose(points[:, 0], WALL + 0.2, atol=1e-5)
        assert (frame.scan.kind, frame.scan.max_range) == ("planar", 8.0)
        assert len(frame.scan) + len(frame.scan.no_returns) == BEAMS
        np.testing.assert_allclose(frame.scan.points[:, 3], (100 + k) / 255, atol=1e-6)
        assert frame.scan.time is not None
        assert (frame.mount.sensor_height, frame.mount.ego_footprint) == (pytest.approx(0.35), (0, 0, 0, 0))
    (text, way), *_ = dataset.recording.frame_notes
    assert (text[:62], way) == ("the height of /scan above ground is not known: 0.35 m is assum", "")
    assert open_dataset(dataset.files[0], sensor_height=0.2)[0].mount.sensor_height == 0.2
    assert open_dataset(log(scans(), "bare.mcap"))[0].mount.sensor_height == 0.3


def test_beside_a_lidar_a_laser_is_named_and_both_go_into_one_map(log: Callable[..., Path]) -> None:
    mounts = (("scan", T_BASE_LASER), ("points", pose(z=0.8)), ("sonar", pose(x=0.3, z=0.2)))
    rows = [*scans(), *(cloud(k) for k in range(SCANS)), *(sonar(k) for k in range(SCANS)), *transforms(*mounts)]
    path = log(rows)
    assert open_dataset(path).facts["topics"] == ["/points"]
    checked = {check.name: [str(one) for one in check.findings] for check in check_log(path, topic=["/points"])}
    assert any("scans of /scan, /sonar are left out" in one for one in checked["/points"])
    assert all("wrong map" not in one.severity for check in check_log(path, topic=["/scan"]) for one in check.findings)
    setups = [SensorSetup("/scan", max_range=6.0), SensorSetup("/points", ego_footprint=(-0.3, 0.3, -0.3, 0.3))]
    dataset = open_dataset(path, topic=["/points", "/scan", "/sonar"], setups=setups)
    mounts_of = {frame.scan.sensor: frame.mount for frame in dataset}
    heights = {name: mount.sensor_height for name, mount in mounts_of.items()}
    assert heights == {"points": pytest.approx(0.9), "scan": pytest.approx(0.45), "sonar": pytest.approx(0.3)}
    assert {frame.scan.max_range for frame in dataset} == {None, 6.0, 4.0}
    T_map_vehicle = [frame.T_map_sensor @ inverse(frame.mount.T_vehicle_sensor) for frame in dataset]
    np.testing.assert_allclose([T[:2, 3] for T in T_map_vehicle], np.repeat(PLACES, 3, axis=0)[:, :2, 3], atol=1e-9)
    cones = [frame.scan for frame in dataset if frame.scan.kind == "cone"]
    assert [(len(scan), len(scan.no_returns)) for scan in cones] == [(0, 1)] * SCANS  # beyond its range


def test_without_lidars_the_laser_is_the_default_and_several_must_be_chosen(log: Callable[..., Path]) -> None:
    mounts = (("scan", T_BASE_LASER), ("rear", pose(-0.2, z=0.25, yaw=np.pi)), ("sonar", pose(z=0.2)))
    rows = [*scans(), *(sonar(k) for k in range(SCANS)), *transforms(*mounts)]
    assert open_dataset(log(rows)).facts["topics"] == ["/scan"]
    both = log([*rows, *(laser(k, ranges, "/rear") for k, ranges in enumerate(RANGES))], "both.mcap")
    refused("several topics with scans", open_dataset, both)
    dataset = open_dataset(both, topic=["/scan", "/rear"])
    assert sorted({frame.mount.sensor_height for frame in dataset}) == pytest.approx([0.25, 0.35])
    behind = next(frame for frame in dataset if frame.scan.sensor == "rear")
    assert behind.scan.points[:, 0].max() < 0
    assert len(open_dataset(both, topic="/sonar")) == SCANS


def test_beams_of_a_laser_on_its_head_are_turned(log: Callable[..., Path]) -> None:
    turned = pose(z=0.3, roll=np.pi)
    ranges = np.where(AZIMUTHS > 0.3, 2.0, np.inf)  # to the left of the laser, to the right of the vehicle
    (frame,) = open_dataset(log([laser(0, ranges), *transforms(("scan", turned))]))
    assert frame.scan.points[:, 1].max() < 0 < frame.scan.no_returns[:, 1].max()
    np.testing.assert_allclose(frame.scan.points[:, 2], 0, atol=1e-6)


def test_beams_are_deskewed_by_their_times(log: Callable[..., Path]) -> None:
    """A wall ahead of a vehicle that drives 1 m/s while the laser turns."""
    time = 2.0**-12 * np.arange(BEAMS)
    ranges = (WALL - time) / np.cos(AZIMUTHS)
    (frame,) = open_dataset(log([laser(0, ranges), *transforms(("scan", pose(z=0.3)))]))
    assert np.ptp(frame.scan.points[:, 0]) > 0.02
    t = np.array([-1.0, 1.0])
    moved = deskew_frame(frame, Trajectory(START + t, np.array([pose(x) for x in t]))).scan
    np.testing.assert_allclose(moved.points[:, 0], WALL, atol=1e-3)
    assert (moved.kind, moved.max_range) == ("planar", 8.0)


def test_a_damaged_scan_is_refused_alone(log: Callable[..., Path]) -> None:
    rows = [*scans()[:3], laser(3, RANGES[3], angle_min=np.nan)]
    dataset = open_dataset(log(rows))
    assert len(dataset[2].scan)
    refused("drive.mcap: LaserScan of scan at .* wanted radians", lambda: dataset[3].scan)
