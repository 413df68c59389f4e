"""Clocks of logs: resets, loops, jumps and single wrong stamps cut a drive, and nothing of two parts is mixed."""

import logging
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cases import each, refused
from commands import completed

from ogm import Scan
from ogm.datasets import open_dataset
from ogm.datasets.clocks import STRAY, clock_findings, clock_offset, clock_parts, joint_parts
from ogm.fusion import EvidentialMapper, fuse
from ogm.geometric import RayISM
from ogm.grid import EvidentialGrid, GridSpec
from ogm.io.logs import LogWriter
from ogm.io.messages import StampedTransform, point_cloud2, tf_message
from ogm.pose import pose
from ogm.storage.files import OgmError

CLOUD, TF = "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"
T0 = 1_700_000_000.0
TIME = 0.1 * np.arange(40)  # [s]
WHOLE = [0] * 40


def shifted(*changes: tuple[slice, float], log: bool = False) -> np.ndarray:
    """Return stamps, or log times, of which some are later."""
    times = T0 + TIME + 0.05 * log
    for numbers, seconds in changes:
        times[numbers] += seconds
    return times


def parts(*runs: tuple[int, int]) -> list[int]:
    """Return the parts of runs of scans: number and part."""
    return [part for count, part in runs for _ in range(count)]


JITTER = np.random.default_rng(0).uniform(0, 0.3, 40)
TURNS = np.array([2, 0, 1] + list(range(3, 40)))


@each("log_times, stamps, expected", [
        (shifted(log=True), shifted(), WHOLE),
        (np.sort(shifted(log=True) + JITTER), shifted(), WHOLE),
        (shifted(log=True), shifted()[TURNS], WHOLE),  # recorded in another order
        (shifted((slice(20, None), 600), log=True), shifted((slice(20, None), 600)), WHOLE),  # a pause
        (T0 + 0.1 * TIME, shifted(), WHOLE),  # converted ten times as fast as it was measured
        (np.full(40, T0), shifted((slice(20, None), -30)), WHOLE),  # log times that tell nothing
        (shifted(log=True)[:2], np.array([T0, 5.0]), [0, 0]),  # too few to tell
        (shifted((slice(20, None), 100), log=True), np.tile(T0 + TIME[:20], 2), parts((20, 0), (20, 1))),  # a loop
        (shifted((slice(3, None), 9), log=True), np.r_[T0 + TIME[:3], T0 + TIME[:37]], parts((3, 0), (37, 1))),
        (shifted(log=True), shifted((slice(20, None), -T0)), parts((20, 0), (20, 1))),  # a simulation began anew
        (shifted(log=True), shifted((slice(20, None), -1.0)), parts((20, 0), (20, 1))),  # a leap second
        (shifted(log=True), shifted((slice(20, None), 2 * 86_400)), parts((20, 0), (20, 1))),
        (shifted(log=True), shifted((slice(10, None), -30), (slice(20, None), -30), (slice(30, None), 900)),
         parts((10, 0), (10, 1), (10, 2), (10, 3))),
        (shifted(log=True), shifted((slice(20, 21), -3600)), parts((20, 0), (1, STRAY), (19, 0))),
        (shifted(log=True), shifted((slice(20, 21), 400 * 86_400)), parts((20, 0), (1, STRAY), (19, 0))),
        (shifted(log=True), shifted((slice(20, 22), -3600), (slice(30, 31), 1e5)),
         parts((20, 0), (2, STRAY), (8, 0), (1, STRAY), (9, 0))),
        (shifted(log=True), np.r_[0.5, 0.6, T0 + TIME[2:]], parts((2, STRAY), (38, 0))),  # before the clock was set
        (shifted(log=True), np.r_[TIME[:5], T0 + TIME[5:]], parts((5, 0), (35, 1))),
        (shifted(log=True), shifted((slice(38, None), -3600)), parts((38, 0), (2, STRAY))),
        (shifted(log=True), np.where(np.arange(40) % 9 == 4, np.nan, shifted()),
         [STRAY if k % 9 == 4 else 0 for k in range(40)]),
        (shifted((slice(20, 21), 0.04), log=True), shifted((slice(20, 21), -1.5)), WHOLE),  # late
        (shifted(log=True), np.full(40, np.nan), [STRAY] * 40),
    ])  # fmt: skip
def test_clock_parts(log_times: np.ndarray, stamps: np.ndarray, expected: list[int]) -> None:
    assert clock_parts(log_times, stamps).tolist() == expected


def test_topics_that_are_cut_together_have_the_same_parts() -> None:
    one, other = (shifted((slice(20, None), 50), log=True) + late for late in (0.0, 0.7))
    looped = np.tile(T0 + TIME[:20], 2)
    joined = joint_parts([one, other, one], [clock_parts(t, looped) for t in (one, other)] + [np.zeros(40, int)])
    assert [found.tolist() for found in joined] == [parts((20, 0), (20, 1))] * 3


@each("stamps, kinds, what", [
        (shifted(), [], ""),
        (shifted((slice(20, None), -1000)), ["clock put back"], "go back from 1700000001.900000 to 1699999002.0"),
        (shifted((slice(20, None), 1e5)), ["clock put ahead"], "jump from .* while 0.1 s pass"),
        (shifted((slice(20, 21), 1e5), (slice(3, 4), -1e5)), ["wrong stamps"], "2 of 40 stamps agree with no other"),
        (np.where(TIME < 0.05, np.nan, shifted()), ["missing stamps"], "1 of 40 headers have no stamp"),
        (np.floor(shifted()), ["coarse stamps"], "40 scans have 4 different stamps in 3.9 s"),
        (shifted().astype("f4").astype("f8"), ["coarse stamps"], "40 scans have 1 different stamps"),
    ])  # fmt: skip
def test_clock_findings(stamps: np.ndarray, kinds: list[str], what: str) -> None:
    log_times = shifted(log=True)
    found = clock_findings("/points", log_times, stamps, clock_parts(log_times, stamps))
    assert [finding.kind for finding in found] == kinds
    for finding in found:
        assert re.search(what, finding.fault), finding
        assert finding.where.startswith("/points")
        assert finding.way_out


SPREAD = np.random.default_rng(1).uniform(-0.4, 0.4, 40)


@each("stamps, log_times, found", [
        (T0 + TIME, T0 + TIME + 2.5, ""),  # a slow SLAM that began with the log
        (T0 - 4.0 + TIME, np.sort(T0 - 1.5 + TIME + SPREAD), ""),  # one that ran before
        (T0 - 4.0 + TIME, T0 - 1.5 + TIME, "2.45 s ahead of the stamps of the transforms"),
        (T0 - 20.0 + TIME, np.sort(T0 + TIME + SPREAD), "s ahead"),  # later than anything is computed
        (T0 + 2.5 + TIME, np.sort(T0 + TIME + SPREAD), "s behind"),
        (T0 - 1.5 + TIME, T0 + TIME, ""),
    ])  # fmt: skip
def test_late_transforms_are_no_offset_of_clocks(stamps: np.ndarray, log_times: np.ndarray, found: str) -> None:
    findings = clock_offset("/points", T0 + TIME + 0.05, T0 + TIME, "transforms", log_times, stamps)
    assert [found in str(one) for one in findings] == [True] * bool(found)


# --- Logs --------------------------------------------------------------------------------------------


X, Y = (a.ravel() for a in np.meshgrid(np.arange(-12, 12, 0.4), np.arange(-12, 8, 0.4)))
WALL = [(a, 8.2, z) for a in np.arange(-12, 12, 0.2) for z in (0.5, 1.0, 1.5)]
WORLD = np.r_[np.c_[X, Y, 0 * X], WALL]
SPEC = GridSpec.centered(24, 24, 0.4)


@pytest.fixture
def log(tmp_path: Path) -> Callable[..., Path]:
    """Give a function that writes scans by (log time, stamp, y of the vehicle), each with its transform."""

    def write(rows: list[tuple[float, float, float]], tf_late: float = 0.02, name: str = "drive.mcap") -> Path:
        messages = []
        for time, stamp, y in rows:
            at = np.array([0.0, y, 1.8])
            cloud = point_cloud2(Scan((WORLD - at).astype("f4")), frame_id="lidar", stamp=stamp)
            moved = tf_message([StampedTransform("map", "lidar", stamp, pose(*at))])
            messages += [("/points", CLOUD, cloud, time), ("/tf", TF, moved, time + tf_late)]
        with LogWriter(tmp_path / name) as writer:
            for message in sorted(messages, key=lambda row: row[3]):
                writer.write(*message)
        return tmp_path / name

    return write


def two_runs(gap: float, start: float) -> list[tuple[float, float, float]]:
    """Return a run at y = 0 with stamps from 5 s on, and some time later one at y = 3.2 with stamps from `start` on."""
    first = [(1000 + t, 5 + t, 0.0) for t in TIME[:9]]
    return first + [(1000 + TIME[8] + gap + t, start + t, 3.2) for t in TIME[:6]]


def wall(frames: list) -> float:
    """Return the y of the occupied cells of the map of some frames, which must be one row."""
    mapper = EvidentialMapper(GridSpec(0.4, (80, 80), (-16, -16)), half_life=float("inf"))
    assert [step.error for step in fuse(frames, RayISM(SPEC), mapper)] == [None] * len(frames)
    occupied = np.argwhere(mapper.grid.occupied > 0.5)
    assert len(occupied) > 30
    assert np.ptp(occupied[:, 1]) == 0
    return float(mapper.grid.spec.origin[1] + 0.4 * (occupied[0, 1] + 0.5))


@each("gap, start", [(100.0, 5.0), (0.1, 5.0), (0.1, 5.33), (30.0, 0.0), (0.1, 4.9), (0.1, 90_000.0)])
@each("tf_late", [-0.03, 0.02, 0.4])
def test_nothing_of_two_runs_is_mixed(
    log: Callable[..., Path], gap: float, start: float, tf_late: float, caplog: pytest.LogCaptureFixture
) -> None:
    dataset = open_dataset(log(two_runs(gap, start), tf_late))
    assert {name: len(rows) for name, rows in dataset.sequences.items()} == {"drive part 1": 9, "drive part 2": 6}
    for name, y in (("drive part 1", 0.0), ("drive part 2", 3.2)):
        frames = dataset.select(dataset.sequences[name])
        assert [ref.T_map_sensor[1, 3] for ref in frames.refs] == [y] * len(frames)
        assert [ref.stamp for ref in frames.refs] == pytest.approx((5.0 if y == 0 else start) + TIME[: len(frames)])
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "the drive is cut into parts there" in caplog.text


def test_a_cut_drive_is_fused_part_by_part(log: Callable[..., Path], tmp_path: Path) -> None:
    path = log(two_runs(100.0, 5.0))
    dataset = open_dataset(path)
    assert [wall(dataset.select(rows)) for rows in dataset.sequences.values()] == pytest.approx([8.2, 8.2])
    steps = list(fuse(dataset, RayISM(SPEC), EvidentialMapper(SPEC)))
    assert [step.restart for step in steps] == [""] * 9 + ["sequence"] + [""] * 5
    options = ("--ism", "ray", "--resolution", 0.4, "--length", 24, "--width", 24, "--out")
    result = completed("fuse", path, *options, tmp_path / "longest.npz")
    assert "drive: drive part 1, the longest of 2; --sequence picks another" in result.output
    completed("fuse", path, "--sequence", 2, *options, tmp_path / "second.npz")
    assert EvidentialGrid.load(tmp_path / "second.npz").spec != EvidentialGrid.load(tmp_path / "longest.npz").spec
    assert "stamps go back from 5.800000 to 5.000000 s while 100 s pass" in " ".join(
        completed("info", path).output.split()
    )


@each("bad", [{4: 0.0}, {4: 3600.0}, {0: 0.0, 1: 0.1}, {7: T0, 3: 1.0}])
def test_single_wrong_stamps_cost_their_scans_alone(
    log: Callable[..., Path], bad: dict[int, float], caplog: pytest.LogCaptureFixture
) -> None:
    rows = [(1000 + t, bad.get(k, 2000 + t), 0.0) for k, t in enumerate(TIME[:9])]
    dataset = open_dataset(log(rows))
    assert len(dataset) == 9 - len(bad)
    assert len(dataset.sequences) == 1
    assert wall(list(dataset)) == pytest.approx(8.2)
    assert all(record.levelname == "WARNING" for record in caplog.records)
    assert "these scans are left out" in caplog.text


def test_a_clock_may_begin_at_zero(log: Callable[..., Path], caplog: pytest.LogCaptureFixture) -> None:
    dataset = open_dataset(log([(1000 + t, float(t), 0.0) for t in TIME[:5]]))
    assert [ref.stamp for ref in dataset.refs] == pytest.approx(TIME[:5])
    assert all(ref.T_map_sensor is not None for ref in dataset.refs)
    assert not caplog.records


def test_coarse_stamps_are_refused(log: Callable[..., Path]) -> None:
    path = log([(1000 + t, float(np.floor(2000 + t)), 0.0) for t in TIME[:20]])
    refused("20 scans have 2 different stamps in 1.9 s; the stamps are too coarse", open_dataset, path, error=OgmError)
    assert "too coarse" in " ".join(completed("info", path).output.split())


# --- Numbers that are not needed ---------------------------------------------------------------------


@each("scale", [1.0, 50.0, 3000.0])
def test_scans_of_a_drive_have_one_scale_and_one_line(
    tmp_path: Path, scale: float, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    with LogWriter(tmp_path / "drive.mcap") as writer:
        for k, brightest in enumerate((0.2, 1.0, 0.1, 0.5, 0.9, 0.3, 1.0)):
            points = np.c_[WORLD - (0, 0, 1.8), np.linspace(0, scale * brightest, len(WORLD))].astype("f4")
            scan = Scan(points, time=np.linspace(0, 0.1, len(points)), ring=np.zeros(len(points)))
            cloud = point_cloud2(scan, frame_id="lidar", stamp=T0 + k)
            values = cloud.data.reshape(len(points), -1)
            values[5, -4:] = np.frombuffer(np.float32(np.nan).tobytes(), np.uint8)  # one time
            writer.write("/points", CLOUD, cloud, T0 + k)
    dataset = open_dataset(tmp_path / "drive.mcap")
    unit = {1.0: 1.0, 50.0: 255.0, 3000.0: 65535.0}[scale]
    found = [float(frame.scan.points[:, 3].max()) * unit / scale for frame in dataset]
    assert found == pytest.approx([0.2, 1.0, 0.1, 0.5, 0.9, 0.3, 1.0], rel=1e-4)
    assert all(np.isfinite(frame.scan.time).all() for frame in dataset)
    kinds = [record.getMessage().split(": ")[1] for record in caplog.records]
    assert len(kinds) == len(set(kinds)) <= 3
