"""Transforms of a log that are unusual: the map is that of the clean log with one line, or the poses are refused."""

import copy
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cases import each
from random_logs import CLOUD, START, STEP, TF, Drive, Message, made_scans, messages_of, restamp, write

from ogm.datasets import SensorSetup, open_dataset
from ogm.io.messages import StampedTransform, tf_message
from ogm.pose import pose
from ogm.workflows import check_drive

SCANS = [(scan.select(np.arange(len(scan)) % 4 == 0), T) for scan, T in made_scans()]


def transforms(drive: Drive) -> list[SimpleNamespace]:
    """Return the transforms from map to lidar."""
    return [message.message.transforms[0] for message in drive if message.type == TF]


def mounted(drive: Drive, times: list[float], topic: str = "/tf", heights: tuple[float, ...] = (0.0,)) -> None:
    """Let the poses be those of base_link, which the lidar has its place in by messages at some times."""
    for transform in transforms(drive):
        transform.child_frame_id = "base_link"
    for k, time in enumerate(times):
        mount = tf_message([StampedTransform("base_link", "lidar", START + time, pose(z=heights[k % len(heights)]))])
        drive.append(Message(topic=topic, type=TF, message=mount, time=START + time))


def _named(drive: Drive, name: str) -> None:
    for message in drive:
        if message.type == CLOUD:
            message.message.header.frame_id = name


def _all_static(drive: Drive) -> None:
    for message in drive:
        message.topic = "/tf_static" if message.type == TF else message.topic


def _two_parents(drive: Drive) -> None:
    for message in drive:
        if message.type == TF:
            other = copy.deepcopy(message.message.transforms[0])
            other.header.frame_id, other.transform.translation.y = "odom", 9.0
            message.message.transforms.insert(0, other)


def _doubled(drive: Drive) -> None:
    drive += [Message(**{**vars(copy.deepcopy(one)), "time": one.time + 0.01}) for one in drive if one.type == TF]


@each("change, line", [
        (lambda drive: mounted(drive, [-1.0]), "the transform from lidar to base_link comes once, unchanged"),
        (lambda drive: mounted(drive, [-4.0, 0.2]), "the transform from lidar to base_link comes 2 times, unchanged"),
        (lambda drive: mounted(drive, np.arange(-1, 2, 0.5).tolist()), ""),
        (lambda drive: mounted(drive, [9.0], "/tf_static"), ""),
        (lambda drive: mounted(drive, [0.0, 0.3], "/tf_static", (5.0, 0.0)), "different static transforms from lidar"),
        (lambda drive: _named(drive, "/lidar/"), ""),
        (lambda drive: _named(drive, " lidar"), ""),
        (lambda drive: _named(drive, "LiDAR"), "the frame LiDAR of scans is taken for lidar"),
        (lambda drive: _named(drive, ""), "scans of /points without frame are taken to be in lidar, the only"),
        (lambda drive: _named(drive[:4], "/"), "without frame are taken to be in lidar, the frame of the others"),
        (_all_static, "different static transforms from lidar to map: each is used at its stamp"),
        (_two_parents, "lidar has the parents odom, map: the shortest chain is used, map <- lidar"),
        (_doubled, ""),
    ])  # fmt: skip
def test_unusual_transforms_cost_no_pose(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, change: Callable[[Drive], None], line: str
) -> None:
    drive = messages_of(SCANS)
    change(drive)
    dataset = open_dataset(write(tmp_path / "a.mcap", drive))
    np.testing.assert_allclose([ref.T_map_sensor for ref in dataset.refs], [T for _, T in SCANS], atol=1e-6)
    notes = [text for text, _ in dataset.recording.frame_notes]
    assert len(notes) == bool(line)
    assert all(line in note for note in notes)
    assert all(any(note in record.getMessage() for record in caplog.records) for note in notes)


@each("name, told", [("", "the scans of /points name no frame"), ("velo", "no transform leads to velo, the frame")])
def test_a_given_mount_joins_scans_of_an_unknown_frame(tmp_path: Path, name: str, told: str) -> None:
    drive = messages_of(SCANS)
    mounted(drive, [0.0], "/tf_static")
    other = tf_message([StampedTransform("base_link", "rear_lidar", START, pose(z=9.0))])
    drive.append(Message(topic="/tf_static", type=TF, message=other, time=START))
    _named(drive, name)
    path = write(tmp_path / "a.mcap", drive)
    assert told in (poses := open_dataset(path).facts["poses"])
    assert "`setups` with its mount joins it with base_link" in poses
    dataset = open_dataset(path, setups=SensorSetup("/points", mount=(0.0,) * 6))
    np.testing.assert_allclose([ref.T_map_sensor for ref in dataset.refs], [T for _, T in SCANS], atol=1e-6)


def _offset(drive: Drive, seconds: float) -> None:
    """Set the clock of the transforms, which go on for a minute."""
    for k in range(len(SCANS), 500):
        T = StampedTransform("map", "lidar", START + STEP * k, SCANS[-1][1])
        drive.append(Message(topic="/tf", type=TF, message=tf_message([T]), time=START + STEP * k + 0.01))
    for message in drive:
        if message.type == TF:
            restamp(message, lambda stamp: stamp + seconds)


def _whole_seconds(drive: Drive) -> None:
    for message in drive:
        if message.type == TF:
            restamp(message, np.floor)


def _zero(drive: Drive) -> None:
    for transform in transforms(drive):
        transform.header.stamp.sec = transform.header.stamp.nanosec = 0


def _two_senders(drive: Drive) -> None:
    for transform in transforms(drive)[::2]:
        transform.transform.translation.y += 3


@each("change, severity, text", [
        (lambda drive: _offset(drive, -18.0), "wrong map", "stamps are 17.95 s ahead of the stamps"),
        (lambda drive: _offset(drive, 3600.0), "wrong map", "stamps are 3600 s behind the stamps"),
        (lambda drive: _offset(drive, -1.0), "", ""),
        (_whole_seconds, "lost data", "6 transforms have 1 different stamps in 0.625 s; the stamps are too coarse"),
        (_zero, "lost data", "all 6 transforms have the stamp 0"),
        (
            _two_senders, "wrong map",
            "they alternate back and forth by 3.03 m in all 4 steps; if two nodes send the transform, record only one",
        ),
    ])  # fmt: skip
def test_clocks_and_senders_of_transforms_are_checked(
    tmp_path: Path, change: Callable[[Drive], None], severity: str, text: str
) -> None:
    drive = messages_of(SCANS)
    change(drive)
    check = check_drive(open_dataset(write(tmp_path / "a.mcap", drive)), scans=1)
    found = [one for one in check.findings if one.kind in ("clock", "poses") and "without a pose" not in one.text]
    assert [one.severity for one in found] == [severity] * bool(text)
    assert all(text in str(one) for one in found)
