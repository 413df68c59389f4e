"""`ogm check`: findings about drives, and the file of setups that mends them."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import odd_logs
import pytest
import random_logs
from cases import each
from commands import completed, ogm
from odd_logs import MAST, TF, tilted, way, write_log
from random_logs import Message, clouds, column, exchange, made_scans, messages_of, write

from ogm.datasets import open_dataset, read_setups
from ogm.io.logs import LogWriter, open_log
from ogm.io.messages import StampedTransform, tf_message
from ogm.pose import pose
from ogm.workflows import DriveCheck, check_drive, check_log

SMALL = (-0.5, 0.5, -0.3, 0.3)


def ring(distance: float, count: int = 1500) -> np.ndarray:
    """Return beams upwards at one distance, as drivers report those without echo."""
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(count, 3))
    ways[:, 2] = np.abs(ways[:, 2])
    return distance * ways / np.linalg.norm(ways, axis=1, keepdims=True)


def kinds(check: DriveCheck, severity: str = "wrong map") -> set[str]:
    return {finding.kind for finding in check.findings if finding.severity == severity}


def only(path: Path, **options: Any) -> DriveCheck:
    (check,) = check_log(path, **options)
    return check


@each("mount, extra, options, wanted", [
        (pose(z=1.2), None, {}, {"ego footprint"}),  # pillars beside the way
        (pose(z=1.2), MAST, {}, {"ego footprint"}),
        (pose(z=1.2), MAST - [2.3, 0, 0], {}, {"ego footprint", "ego returns"}),
        (pose(z=1.2), ring(30.0), {}, {"ego footprint", "ranges"}),
        (pose(z=1.2), None, {"sensor_height": 2.5}, {"ego footprint", "height"}),
        (tilted(roll=180), None, {}, {"ego footprint"}),  # levelled by the poses
    ])  # fmt: skip
def test_findings_name_what_makes_a_map_wrong(
    tmp_path: Path, mount: np.ndarray, extra: np.ndarray | None, options: dict[str, Any], wanted: set[str]
) -> None:
    check = only(write_log(tmp_path / "a.mcap", way(16, 0.5), mount, extra=extra), **options)
    assert kinds(check) == wanted
    assert [finding.severity for finding in check.findings] == sorted(
        (finding.severity for finding in check.findings), key=("wrong map", "lost data", "note").index
    )


@each("roll, pitch", [(0, 15), (-20, 12)])
def test_three_faults_at_once_are_mended_by_one_file(tmp_path: Path, roll: int, pitch: int) -> None:
    """A tilted sensor whose transforms are those of a level one, a ring at 30 m, and a small vehicle."""
    extra = np.concatenate([MAST, ring(30.0)])
    path = write_log(tmp_path / "a.mcap", way(16, 0.5), tilted(roll, pitch), extra=extra, pose_mount=pose(z=1.2))
    file = tmp_path / "vehicle.yaml"
    first = ogm("check", path, "--write", file)
    assert first.exit_code == 2
    assert all(kind in first.output for kind in ("tilt:", "ranges:", "ego footprint:", "--max-range 30"))
    assert completed("check", path, "--sensors", file).output.count("wrong map") == 0
    (setup,) = read_setups(file)
    assert setup.sensor_height == pytest.approx(1.2, abs=0.05)
    assert setup.mount is not None
    np.testing.assert_allclose(np.degrees(setup.mount[3:]), [roll, pitch, 0], atol=0.5)
    x_min, x_max, y_min, y_max = setup.ego_footprint  # type: ignore[misc]
    assert -1 < x_min < -0.4 < x_max < 0.3
    assert -0.7 < y_min < -0.2 < 0.2 < y_max < 0.7


@each("yaw, axes", [(90, "-y,+x,+z"), (-60, "+y,-x,+z"), (180, "")])
def test_a_drive_across_the_x_axis_is_told_with_the_axes(tmp_path: Path, yaw: int, axes: str) -> None:
    """Transforms without the mount: the sensor's axes count as those of the vehicle. Driving backwards is right."""
    path = write_log(tmp_path / "a.mcap", way(7, 1.0), tilted(yaw=yaw))
    texts = [str(finding) for finding in only(path).findings if finding.kind == "axes"]
    assert len(texts) == bool(axes)
    if axes:
        assert f"axes: the vehicle moves 6 m by its poses to its {'right' if yaw > 0 else 'left'}" in texts[0]
        assert f"--axes={axes}," in texts[0]
        assert not any(finding.kind == "axes" for finding in only(path, axes=axes.split(",")).findings)
    stated = write_log(
        tmp_path / "b.mcap", way(7, 1.0), tilted(yaw=yaw), chain=(("map", "base_link"), ("base_link", "os_lidar"))
    )
    assert "axes" not in kinds(only(stated))


def test_walls_along_the_way_are_not_of_the_vehicle(tmp_path: Path) -> None:
    x = np.arange(-20, 30, 0.1)
    wall = np.array([(a, b, z) for a in x for b in (-1.5, 1.5) for z in (0.5, 1.0)]) - [0, 0, 1.2]
    straight = [pose(0.5 * k) for k in range(16)]
    check = only(write_log(tmp_path / "a.mcap", straight, pose(z=1.2), extra=wall))
    assert "ego returns" not in kinds(check)


def test_scans_that_are_odd_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    good = write_log(tmp_path / "good.mcap", way(8), pose(z=1.2))
    with open_log(good) as log, LogWriter(path) as out:
        for message in log.messages():
            k = round((message.log_time - odd_logs.START) / odd_logs.STEP)
            if k == 3:
                continue
            decoded = message.decode()
            if k == 5 and message.topic == "/points":
                decoded.width, decoded.data = 10, decoded.data[: 10 * decoded.point_step]
                decoded.row_step = len(decoded.data)
            if k == 6 and message.topic == "/points":
                decoded.data = decoded.data[:-7]
            if k == 7 and message.topic == "/tf":
                continue
            out.write(message.topic, message.type, decoded, message.log_time)
    lost = {finding.kind: finding.text for finding in only(path).findings if finding.severity == "lost data"}
    assert lost["gaps"].startswith("about 1 scans are missing in 1 gaps, the longest of 0.25 s")
    assert lost["damage"].startswith("1 of 7 scans cannot be read: ")
    assert lost["points"] == "1 of 6 scans have less than a tenth of the usual number of points"
    assert lost["poses"].startswith("1 of 7 scans without a pose: ")


def test_planar_scans_and_scans_without_ground_are_named(tmp_path: Path) -> None:
    a = np.linspace(-math.pi, math.pi, 1440)
    np.save(tmp_path / "planar.npy", np.column_stack([8 * np.cos(a), 6 * np.sin(a), 0 * a]).astype(np.float32))
    assert {"ground", "height"} <= kinds(only(tmp_path / "planar.npy"))
    assert kinds(only(tmp_path / "planar.npy", sensor_height=0.8)) == {"ground"}


def _switched(cloud: Any, k: int) -> None:
    column(cloud, "intensity")[:] *= 0.004 if k < 3 else 1


def _saturated(cloud: Any, k: int) -> None:
    column(cloud, "intensity")[: cloud.width // 4] = 1


def _decibels(cloud: Any, k: int) -> None:
    column(cloud, "intensity")[:] = -150 + 140 * column(cloud, "intensity")


def _same_rings(cloud: Any, k: int) -> None:
    column(cloud, "ring", "<u2")[:] = 7


def _numbers(cloud: Any, k: int) -> None:
    column(cloud, "ring", "<u2")[:] = np.arange(cloud.width)


def _crossed(cloud: Any, k: int) -> None:
    column(cloud, "ring", "<u2")[:] = np.random.default_rng(k).integers(0, 16, cloud.width)


def _falling(cloud: Any, k: int) -> None:
    x, y, z = (column(cloud, name).astype(float) for name in "xyz")
    column(cloud, "ring", "<u2")[:] = np.clip(40 - np.degrees(np.arctan2(z, np.hypot(x, y))), 0, 80)


@each("change, kind, text", [
        (_switched, "intensities", "their scale changes: in 3 of 6 scans they are at least 248 times smaller"),
        (_saturated, "intensities", "25 % of the points have the greatest intensity: they are saturated"),
        (
            _decibels,
            "intensities",
            "all 6 scans have negative intensities (decibels?), with the range scaled to 0 to 1",
        ),
        (_same_rings, "rings", "all points of a scan have the same"),
        (_numbers, "rings", "in a scan, but lidars have at most 256: check the field"),
        (_crossed, "rings", "their numbers do not follow elevation in all 6 scans"),
        (_falling, "rings", ""),
        (lambda cloud, k: exchange(cloud, "ring", None), "rings", "points have no rings; maps do not need rings"),
        (lambda cloud, k: exchange(cloud, "ring", np.full(cloud.width, 0.5)), "rings", "all 6 scans have rings that"),
    ])  # fmt: skip
def test_values_of_points_are_told(tmp_path: Path, change: Callable[[Any, int], None], kind: str, text: str) -> None:
    drive = messages_of(made_scans())
    for k, cloud in enumerate(clouds(drive)):
        change(cloud, k)
    texts = [finding.text for finding in only(write(tmp_path / "a.mcap", drive)).findings if finding.kind == kind]
    assert len(texts) == bool(text)
    assert all(text in found for found in texts)


@each("late, static, text", [
        (0.0, 0.0, ""),
        (0.25, 0.0, "for all 6 scans, recorded 0.2 s after the scan (median), 0.2 s at most"),
        (0.0, 0.3, "for 2 of 6 scans, recorded 0.178 s after the scan (median), 0.24 s at most"),
    ])  # fmt: skip
def test_transforms_that_come_late_are_told(tmp_path: Path, late: float, static: float, text: str) -> None:
    """Also a mount that a driver sends after the first scans."""
    drive = messages_of(made_scans())
    mount = tf_message([StampedTransform("base_link", "lidar", random_logs.START, np.eye(4))])
    drive.append(Message(topic="/tf_static", type=TF, message=mount, time=random_logs.START + static))
    for message in drive:
        if message.topic == "/tf":
            message.time += late
            if static:
                message.message.transforms[0].child_frame_id = "base_link"
    texts = [f.text for f in only(write(tmp_path / "a.mcap", drive)).findings if f.kind == "late transforms"]
    assert texts == [text] * bool(text)


def test_topics_and_drives_have_findings_of_their_own(tmp_path: Path) -> None:
    both = tmp_path / "both.mcap"
    with LogWriter(both) as out:
        for name, frame in (("/front", "os_lidar"), ("/cloud_registered", "odom")):
            with open_log(write_log(tmp_path / "a.mcap", way(4), pose(z=1.2), frame=frame)) as log:
                for message in log.messages():
                    topic = name if message.topic == "/points" else message.topic
                    out.write(topic, message.type, message.decode(), message.log_time)
    checks = check_log(both)
    assert [check.name for check in checks] == ["/cloud_registered", "/front"]
    assert "frames" in kinds(checks[0])
    (front,) = check_log(both, topic=["/front"])
    assert any("/cloud_registered" in finding.text for finding in front.findings if finding.kind == "topics")
    assert check_drive(open_dataset(both, topic="/front"), scans=2).setup.sensor_height == pytest.approx(1.2, abs=0.02)


def test_fuse_and_map_print_the_gravest_findings(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.mcap", way(8), pose(z=1.2), extra=ring(30.0))
    size = ("--ism", "ray", "--length", 24, "--width", 16, "--resolution", 0.4, "--out")
    mended = ("--max-range", 30, "--max-range-no-echo", "--ego-footprint", *SMALL)
    for command, out in (("fuse", tmp_path / "a.npz"), ("map", tmp_path)):
        text = completed(command, path, *size, out).output
        assert text.count("points lie at the greatest range, 30 m") == 1
        assert "points lie at the greatest range" not in completed(command, path, *mended, *size, out).output
