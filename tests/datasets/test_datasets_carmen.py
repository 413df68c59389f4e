"""CARMEN logs: lines of lasers, their poses and times, ranges without echo, and what is odd about such files."""

import gzip
import logging
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cases import each, refused

from ogm.datasets import open_dataset
from ogm.datasets.carmen import CarmenRecording
from ogm.io.carmen import is_carmen, read_carmen
from ogm.pose import pose
from ogm.workflows.describe import describe_path

RNG = np.random.default_rng(0)
WALLS = RNG.uniform(0.5, 12.0, (8, 181)).round(2)
NO_ECHO = WALLS.copy()
NO_ECHO[:, ::20] = 81.83
NO_ECHO[:, 10::20] = 81.91


def flaser(k: int, ranges: np.ndarray, word: str = "FLASER", times: str | None = None, heading: float = 0.1) -> str:
    """Return the line of a scan from 0.5 m farther than the one before."""
    values = " ".join(f"{one:g}" for one in ranges)
    times = f"{100 + 0.5 * k:.3f} host {0.5 * k:.3f}" if times is None else times
    return f"{word} {len(ranges)} {values} {0.5 * k:g} 0 {heading} {0.5 * k:g} 0 0.1 {times}"


def robot_laser(k: int, ranges: np.ndarray) -> str:
    values, bright = " ".join(f"{one:g}" for one in ranges), " ".join(["127.5"] * len(ranges))
    head = f"ROBOTLASER1 0 -2.356194 4.712389 {4.712389 / (len(ranges) - 1):.8f} 10 0.01 0"
    poses = f"{0.5 * k + 0.2:g} 0 0 {0.5 * k:g} 0 0"
    return f"{head} {len(ranges)} {values} {len(ranges)} {bright} {poses} 0.4 0 0 0 0 {100 + k} host {k}"


@pytest.fixture
def log(tmp_path: Path) -> Callable[..., Path]:
    def write(lines: list[str], name: str = "hall.log", end: str = "\n") -> Path:
        text = (end.join(lines) + end).encode("latin-1")
        (tmp_path / name).write_bytes(gzip.compress(text) if name.endswith(".gz") else text)
        return tmp_path / name

    return write


def lines(ranges: np.ndarray = NO_ECHO) -> list[str]:
    """Return a log as the program writes it."""
    found = ["# CARMEN Logfile", "PARAM robot_length 0.5 nohost 0", "", "NEFF 0.5"]
    for k, row in enumerate(ranges):
        found += [f"ODOM {0.5 * k:g} 0 0.1 0.4 0 0 {100 + 0.5 * k:.3f} host {0.5 * k:.3f}", flaser(k, row)]
    return found


@each("name, end", [("hall.log", "\n"), ("hall.clf", "\r\n"), ("hall.log.gz", "\n"), ("hall", "\n")])
def test_a_log_is_known_by_its_content(log: Callable[..., Path], name: str, end: str) -> None:
    path = log(lines(), name, end)
    dataset = open_dataset(path)
    assert (len(dataset), dataset.format, dataset.facts["topics"]) == (8, "CARMEN log", ["FLASER"])
    assert [frame.stamp for frame in dataset] == [100 + 0.5 * k for k in range(8)]
    assert {frame.sequence for frame in dataset} == {"hall"}
    np.testing.assert_allclose(dataset[3].T_map_sensor, pose(1.5, yaw=0.1), atol=1e-9)
    assert describe_path(path)["format"] == "CARMEN log"
    again = pickle.loads(pickle.dumps(dataset.recording))
    assert len(again.read(2).scan) == len(dataset[2].scan)


def test_beams_without_echo_are_those_whose_range_repeats_at_the_top(log: Callable[..., Path]) -> None:
    for frame, row in zip(open_dataset(log(lines())), NO_ECHO, strict=True):
        scan = frame.scan
        np.testing.assert_allclose(np.hypot(*scan.points[:, :2].T), row[row < 80], atol=1e-6)
        silent = np.degrees(np.arctan2(scan.no_returns[:, 1], scan.no_returns[:, 0]))
        np.testing.assert_allclose(silent, np.arange(-90, 91)[row > 80], atol=1e-4)
        assert scan.kind == "planar"
        assert scan.max_range == NO_ECHO[NO_ECHO < 80].max()  # not 81.91, which no echo had
        assert (frame.mount.sensor_height, frame.mount.ego_footprint) == (0.3, (0, 0, 0, 0))
    bounded = [*lines(), "PARAM robot_front_laser_max 5 nohost 0"]
    assert open_dataset(log(bounded))[0].scan.max_range == 5.0


@each("ranges, silent", [
        (WALLS, 0),  # every beam has an echo
        (np.minimum(WALLS, 11.95), 0),  # a few at the greatest
        (np.tile(WALLS[:1], (8, 1)), 0),  # the robot stands, so that all ranges repeat
        (np.where(WALLS > 6, 50.0, WALLS), np.count_nonzero(WALLS > 6)),
        (np.where(WALLS > 6, np.inf, WALLS), np.count_nonzero(WALLS > 6)),
        (np.where(WALLS > 6, 0.0, WALLS), 0),  # unknown
        (np.where(WALLS > 6, np.nan, WALLS), 0),
        (np.full((8, 181), 81.91), 8 * 181),
    ])  # fmt: skip
def test_ranges_at_the_top_are_echoes_unless_they_stand_apart(
    log: Callable[..., Path], ranges: np.ndarray, silent: int
) -> None:
    scans = [frame.scan for frame in open_dataset(log(lines(ranges)))]
    assert sum(len(scan.no_returns) for scan in scans) == silent
    assert sum(map(len, scans)) == np.count_nonzero((ranges > 0) & (ranges < 13))


@each("count, first, last", [(180, -90, 89), (181, -90, 90), (360, -90, 89.5), (361, -90, 90), (401, -50, 50),
                             (541, -135, 135), (1081, -135, 135), (91, -90, 90)])  # fmt: skip
def test_beams_of_older_lines_have_the_angles_of_their_number(
    log: Callable[..., Path], count: int, first: float, last: float
) -> None:
    x, y = (
        open_dataset(log([flaser(0, np.full(count, 2.0)), flaser(1, RNG.uniform(1, 9, count))]))[0]
        .scan.points[[0, -1], :2]
        .T
    )
    np.testing.assert_allclose(np.degrees(np.arctan2(y, x)), [first, last], atol=1e-4)


def test_newer_lines_state_their_angles_range_and_remission(log: Callable[..., Path]) -> None:
    ranges = np.where(WALLS[:3, :109] > 9.0, 10.0, WALLS[:3, :109])
    dataset = open_dataset(log([robot_laser(k, row) for k, row in enumerate(ranges)]))
    scan = dataset[1].scan
    assert (scan.max_range, len(scan.no_returns)) == (ranges[ranges < 10].max(), np.count_nonzero(ranges[1] == 10))
    np.testing.assert_allclose(scan.points[:, 3], 0.5)
    assert np.degrees(np.arctan2(*scan.points[0, 1::-1])) == pytest.approx(-135, abs=1e-3)
    np.testing.assert_allclose(dataset[1].T_map_sensor, pose(0.7))


def test_the_laser_with_most_scans_is_used_and_others_on_request(log: Callable[..., Path]) -> None:
    rows = [flaser(k, row) for k, row in enumerate(WALLS)] + [flaser(k, WALLS[k], "RLASER") for k in range(7)]
    dataset = open_dataset(log(rows))
    assert [text for text, _ in dataset.recording.frame_notes][1:] == ["scans of RLASER (7) are left out (--topic)"]
    both = open_dataset(log(rows), topic=["FLASER", "RLASER"])
    assert len(both) == 15
    rear = next(frame for frame in both if frame.scan.sensor == "RLASER")  # its heading is the robot's
    np.testing.assert_allclose(rear.T_map_sensor, pose(yaw=0.1 + np.pi), atol=1e-12)
    np.testing.assert_allclose(rear.mount.T_vehicle_sensor[:2, :2], -np.eye(2), atol=1e-12)
    own = [flaser(k, WALLS[k], "RLASER", heading=0.1 + 3.14159) for k in range(7)]
    np.testing.assert_allclose(open_dataset(log(own))[0].T_map_sensor, pose(yaw=0.1 + 3.14159), atol=1e-9)
    refused(r"its topics are FLASER \(8\), RLASER \(7\)", open_dataset, log(rows), topic="ROBOTLASER1")
    refused("leave it out", open_dataset, log(rows), frame="odom")
    refused("give one alone", open_dataset, [log(rows), log(rows, "b.log")])


@each("times, expected, kind", [
        (["0 host 0"] * 8, [0.1 * k for k in range(8)], "missing stamps"),
        (["1.13486e+09 host 1.13486e+09"] * 8, [0.1 * k for k in range(8)], "missing stamps"),
        ([""] * 8, [0.1 * k for k in range(8)], "missing stamps"),
        ([f"0 host {k + 5}" for k in range(8)], [5, 6, 7, 8, 9, 10, 11, 12], ""),  # that of the logger
        ([f"{t} host 0" for t in (5, 6, 6, 6, 9, 10, 11, 12)], [5, 6, 7, 8, 9, 10, 11, 12], "wrong stamps"),
        ([f"{t} host 0" for t in (5, 6, 7, 4, 9, 10, 11, 12)], [5, 6, 7, 8, 9, 10, 11, 12], "wrong stamps"),
        ([f"{t} host 0" for t in (5, 6, 700, 8, 9, 10, 11, 12)], [5, 6, 7, 8, 9, 10, 11, 12], "wrong stamps"),
        ([f"{t} host 0" for t in ("nan", 6, "x", 8, 9, 10, 11, 0)], [5, 6, 7, 8, 9, 10, 11, 12], "wrong stamps"),
        ([f"{t} host 0" for t in (5, 6, 7, 8, 105, 106, 107, 108)], [5, 6, 7, 8, 105, 106, 107, 108], ""),
        ([f"{t} host 0" for t in (5, 6, 7, 8, 9, 1, 2, 3)], [5, 6, 7, 8, 9, 10, 11, 12], "wrong stamps"),
        ([f"{t} host 0" for t in (5, 6, 7, 7.01, 9, 10, 11, 12)], [5, 6, 7, 7.1, 9.09, 10.09, 11.09, 12.09],
         "wrong stamps"),
    ])  # fmt: skip
def test_no_scan_is_lost_for_its_time(
    log: Callable[..., Path], times: list[str], expected: list[float], kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.clear()
    dataset = open_dataset(log([flaser(k, WALLS[k], times=text) for k, text in enumerate(times)]))
    assert [frame.stamp for frame in dataset] == pytest.approx(expected)
    assert [frame.T_map_sensor[0, 3] for frame in dataset] == [0.5 * k for k in range(8)]
    assert [finding.kind for finding in dataset.recording.clock_findings] == ([kind] if kind else [])
    assert dataset.recording.stamped == (kind != "missing stamps")
    assert len(caplog.records) == bool(kind)


def test_odd_lines_are_counted_and_named_once(log: Callable[..., Path], caplog: pytest.LogCaptureFixture) -> None:
    good = [flaser(k, row) for k, row in enumerate(WALLS)]
    odd = ["FLASER", "FLASER 3 1 2", "FLASER x 1 2 3", "FLASER 3 1 2 x 0 0 0 0 0 0 1 h 1", "FLASER 0 0 0 0 0 0 0 1 h 1",
           "FLASER -4 1 2", "FLASER 99999999 1", "ROBOTLASER1 0 nan 3 0 8 0 0 1 2 0 0 0 0 0 0 0 0 0 0 0 0 1 h 1",
           "ROBOTLASER1 0", "FLASER 2 1 1 0 0 0"]  # fmt: skip
    with caplog.at_level(logging.WARNING):
        dataset = open_dataset(log([*good[:4], *odd, "\x00\xff\x07", *good[4:], good[0][:200]], "odd.log"))
    assert len(dataset) == 8
    (warning,) = dataset.recording.warnings
    assert f"{len(odd) + 1} lines are left out: line 5, 'FLASER'" in warning
    assert len(caplog.records) == 1
    none = flaser(8, WALLS[0]).replace(" 4 0 0.1 4", " nan 0 0.1 nan")
    assert open_dataset(log([*good, none]))[8].T_map_sensor is None


def test_a_packed_log_that_was_cut_is_read_up_to_there(log: Callable[..., Path]) -> None:
    path = log(lines(np.tile(NO_ECHO, (8, 1)) + RNG.uniform(0, 0.1, (64, 181)).round(3)), "cut.log.gz")
    path.write_bytes(path.read_bytes()[:-3000])
    dataset = open_dataset(path)
    assert 20 < len(dataset) < 64
    assert "cut short or wrongly named; the lines before are read" in dataset.recording.warnings[0]


def test_what_is_no_carmen_log_is_left_to_others(log: Callable[..., Path], tmp_path: Path) -> None:
    for text in ("x y z\n1 2 3\n", "FLASER\n", "a PARAM b\n", "ODOM 1\n"):
        path = log([text], "a.log")
        assert not is_carmen(path)
        assert CarmenRecording.open([path], None) is None
    assert not is_carmen(tmp_path / "none.log")
    refused("has no scans.*got messages ODOM, PARAM", open_dataset, log(["ODOM 1 2 3 0", "PARAM a b"]))


@pytest.mark.slow
@each("name, beams, silent", [("intel", 180, 4172), ("csail", 361, 3907), ("freiburg-101", 360, 12555),
                              ("orebro", 181, 968)])  # fmt: skip
def test_recorded_logs_have_a_pose_for_every_scan(
    real: Callable[[str], Path], name: str, beams: int, silent: int
) -> None:
    path = real(f"carmen_2d/{name}-corrected.log.gz")
    dataset, log = open_dataset(path), read_carmen(path)
    assert not log.odd
    frames = list(dataset)
    assert all(frame.T_map_sensor is not None for frame in frames)
    assert (np.diff([frame.stamp for frame in frames]) > 0).all()
    assert sum(len(frame.scan.no_returns) for frame in frames) == silent
    assert all(len(frame.scan) + len(frame.scan.no_returns) == beams for frame in frames)
