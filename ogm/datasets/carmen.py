"""CARMEN logs of planar lasers as recordings, with the stamps, poses and range limits in the log."""

import logging
from bisect import bisect_left
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.clocks import ClockFinding
from ogm.datasets.frames import FrameRef, RawFrame, SensorPlace
from ogm.datasets.log_scans import NO_FOOTPRINT, PLANE_HEIGHT
from ogm.datasets.recording import OpenOptions, Recording
from ogm.datasets.scans import ending_of
from ogm.io.carmen import CarmenLog, LaserLine, is_carmen, read_carmen
from ogm.io.logs import log_ending
from ogm.pose import inverse, pose
from ogm.storage.files import OgmError

_log = logging.getLogger(__name__)

_DEFAULT_RATE = 10.0  # [Hz] scan rate where the log has no scan times
_MIN_TIMED_SHARE = 0.25  # share of scans with rising times, below which the times of the log are not used
_MAX_SPEED, _MAX_TURN_RATE = 5.0, 2.0  # [m/s], [rad/s] upper limits for robots with planar lasers
_MAX_STEP = 10.0  # [s] longest time that is inserted for a jump of the pose
_MAX_TIME = 2.0**33  # [s] since 1970: larger numbers are no times
_REAR_SHARE = 0.9  # share of rear-laser poses with the robot's heading, above which the poses lack the laser's yaw


class CarmenRecording(Recording):
    """Scans of the planar lasers in a CARMEN log, with the poses in their messages."""

    format = "CARMEN log"
    wanted_labels = "poses of the scans"
    ego_footprint = None
    motion_distorted = aggregated = False
    own_options = ("topic",)
    known_height = assumed_height = True

    @classmethod
    def open(cls, paths: Sequence[Path], options: OpenOptions) -> "CarmenRecording | None":
        """Return the scans of a CARMEN log, or None if no path has the content of one.

        Raises
        ------
        OgmError
            If there are several files, a topic does not exist, or no scan can be read.
        ValueError
            If a fixed frame is chosen: the log has only one.
        """
        files = [path for path in paths if isinstance(path, Path) and path.is_file()]
        if not any(not ending_of(path) and not log_ending(path) and is_carmen(path) for path in files):
            return None
        if len(paths) > 1:
            raise OgmError(f"{paths[0]} is a CARMEN log, got {len(paths)} paths: give one alone")
        if options.frame is not None:
            raise ValueError(f"`frame` is for logs with transforms, {paths[0]} is a CARMEN log: leave it out")
        return cls(paths[0], read_carmen(paths[0]), options.topic)

    def __init__(self, path: Path, log: CarmenLog, topics: Sequence[str]) -> None:
        counts = Counter(line.kind for line in log.lines)
        self.topics = _chosen(path, counts, topics, log)
        numbers = [n for n, line in enumerate(log.lines) if line.kind in self.topics]
        lines = [log.lines[n] for n in numbers]
        stamps, fault = _stamps(lines, path.name)
        self._turned, name = _is_behind(lines), path.name.split(".")[0]
        order = np.argsort(stamps, kind="stable").tolist()
        refs = [FrameRef(f"{n:06d}", name, float(stamps[n]), self._pose(lines[n])) for n in order]
        super().__init__(path, refs, name)
        self._numbers = [numbers[n] for n in order]
        self._content = log, {kind: log.limits(kind) for kind in self.topics}
        self.stamped = fault is None or fault.kind != "missing stamps"
        self.clock_findings = [fault] if fault else []
        odd = [f"{len(log.odd)} lines are left out: {log.odd[0]}"] if log.odd else []
        self.warnings = tuple(f"{path}: {text}" for text in (*filter(None, [log.damage]), *odd))
        self.frame_notes = self._notes({kind: n for kind, n in counts.items() if kind not in self.topics})
        for warning in (*self.warnings, *self.clock_findings):
            _log.warning("%s", warning)
        known = sum(ref.T_map_sensor is not None for ref in refs)
        self.facts = {
            "format": self.format, "frames": len(refs), "topics": list(self.topics),
            "poses": f"{known} of {len(refs)} scans, by the log", "other lines": dict(log.others),
        }  # fmt: skip

    @cached_property
    def _content(self) -> tuple[CarmenLog, dict[str, tuple[float | None, float | None]]]:
        """Log and range limits of its lasers."""
        log = read_carmen(self.path)
        return log, {kind: log.limits(kind) for kind in self.topics}

    def read(self, n: int) -> RawFrame:
        """Return scan n."""
        log, limits = self._content
        kind = log.lines[self._numbers[n]].kind
        return RawFrame(replace(log.scan(self._numbers[n], *limits[kind]), sensor=kind))

    def place(self, n: int) -> SensorPlace:
        """Return the place of a laser; its position on the robot only if there are several lasers."""
        line = self._content[0].lines[self._numbers[n]]
        place = SensorPlace(line.kind, height=PLANE_HEIGHT, ego_footprint=NO_FOOTPRINT)
        if len(self.topics) == 1 or not np.isfinite(line.robot).all() or (T_map_laser := self._pose(line)) is None:
            return place
        T = inverse(pose(*line.robot[:2], yaw=line.robot[2])) @ T_map_laser
        return place._replace(origin=(float(T[0, 3]), float(T[1, 3])), yaw=float(np.arctan2(T[1, 0], T[0, 0])))

    def _pose(self, line: LaserLine) -> NDArray[np.float64] | None:
        """Return ``T_map_sensor`` of a scan, (4, 4), or None if it is not known."""
        if not np.isfinite(line.pose).all():
            return None
        x, y, heading = line.pose
        return pose(x, y, yaw=heading + np.pi * (self._turned and line.kind == "RLASER"))

    def _notes(self, left_out: Mapping[str, int]) -> list[tuple[str, str]]:
        """Return notes on missing or unusual properties of the log, each with the way out or ""."""
        height = f"the height of the laser is not recorded: {PLANE_HEIGHT:g} m is assumed"
        notes = [(f"{height} as the height of the plane of free cells (--sensor-height)", "")]
        if self._turned:
            notes.append(("poses of RLASER have the robot's heading: its beams are turned to the rear", ""))
        if left_out:
            listed = ", ".join(f"{kind} ({count})" for kind, count in left_out.items())
            notes.append((f"scans of {listed} are left out (--topic)", ""))
        return notes


def _chosen(path: Path, counts: Mapping[str, int], wanted: Sequence[str], log: CarmenLog) -> tuple[str, ...]:
    """Return the kinds of messages to read; by default the kind with most scans."""
    listed = ", ".join(f"{kind} ({count})" for kind, count in counts.items()) or "none"
    if missing := [kind for kind in wanted if kind not in counts]:
        raise OgmError(f"{path} has no scans {missing[0]}; its topics are {listed}")
    if not counts:
        others = ", ".join(log.others) or "none"
        odd = f"; {len(log.odd)} lines cannot be read, the first: {log.odd[0]}" if log.odd else ""
        raise OgmError(f"{path} has no scans; wanted FLASER, RLASER or ROBOTLASER1, got messages {others}{odd}")
    return tuple(dict.fromkeys(wanted)) or (max(counts, key=lambda kind: counts[kind]),)


def _is_behind(lines: Sequence[LaserLine]) -> bool:
    """Return whether rear-laser poses have the robot's heading instead of the laser's."""
    rear = [line for line in lines if line.kind == "RLASER"]
    same = [abs(np.sin((line.pose[2] - line.robot[2]) / 2)) < 1e-3 for line in rear]
    return bool(rear) and sum(same) > _REAR_SHARE * len(rear)


def _stamps(lines: Sequence[LaserLine], where: str) -> tuple[NDArray[np.float64], ClockFinding | None]:
    """Return the time of each scan [s] and the fault of the clock, if any.

    The measurement time is used, else the logging time, else a count at 10 Hz. Times that do not rise with the lines
    of a laser are wrong and are interpolated. Where the poses would move faster than robots do, later scans are
    delayed. The poses do not depend on the times, so no scan is left out.
    """
    times = np.array([line.times for line in lines])
    kinds = np.array([line.kind for line in lines])
    for column in times.T:
        rising = np.zeros(len(lines), np.bool_)
        for kind in np.unique(kinds):
            mine = np.flatnonzero(kinds == kind)
            rising[mine[_rising(column[mine])]] = True
        wrong = int(np.count_nonzero(~rising))
        if wrong > (1 - _MIN_TIMED_SHARE) * len(lines):
            continue
        stamps = column.copy()
        for kind in np.unique(kinds):
            mine = kinds == kind
            stamps[mine] = _evenly(column[mine], np.flatnonzero(rising[mine]))
        stamps, hurried = _within_speeds(stamps, lines)
        text = (
            f"{wrong} of {len(lines)} scans have no time, or a time that goes back; {hurried} would need more than "
            f"{_MAX_SPEED:g} m/s or {_MAX_TURN_RATE:g} rad/s since the scan before"
        )
        way = "the former get interpolated times, the latter are delayed"
        return stamps, ClockFinding("wrong stamps", text, where, way) if wrong or hurried else None
    known = len(np.unique(times[:, 0]))
    text = f"the log has {known} different time{'s' * (known != 1)} for {len(lines)} scans"
    way = f"they are counted at up to {_DEFAULT_RATE:g} Hz: velocities and half-lives refer to that rate"
    counted, _ = _within_speeds(np.arange(len(lines)) / _DEFAULT_RATE, lines)
    return counted, ClockFinding("missing stamps", text, where, way)


def _within_speeds(stamps: NDArray[np.float64], lines: Sequence[LaserLine]) -> tuple[NDArray[np.float64], int]:
    """Return times delayed to keep the speed limits of robots, and the number of short steps."""
    order = np.argsort(stamps, kind="stable")
    poses = np.array([lines[n].robot for n in order])
    with np.errstate(invalid="ignore", over="ignore"):
        moved = np.diff(poses, axis=0)
        turn = np.abs((moved[:, 2] + np.pi) % (2 * np.pi) - np.pi)
        min_steps = np.maximum(np.hypot(moved[:, 0], moved[:, 1]) / _MAX_SPEED, turn / _MAX_TURN_RATE)
    min_steps = np.where(np.isfinite(min_steps), np.minimum(min_steps, _MAX_STEP), 0.0)
    steps = np.diff(stamps[order])
    result = stamps.copy()
    if (short := steps < min_steps - 1e-9).any():
        result[order[1:]] = stamps[order[0]] + np.cumsum(np.maximum(steps, min_steps))
    return result, int(np.count_nonzero(short))


def _rising(times: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the indices of the longest strictly rising subsequence of times, (K,)."""
    least: list[float] = []  # smallest last time of the subsequences of each length
    last: list[int] = []
    before = np.full(len(times), -1)
    for n, time in enumerate(times.tolist()):
        if not 0 < time < _MAX_TIME:
            continue
        at = bisect_left(least, time)
        if least[at : at + 1] == [time]:
            continue  # the first scan with a time keeps it
        before[n] = last[at - 1] if at else -1
        least[at : at + 1], last[at : at + 1] = [time], [n]
    row = last[-1:]
    while row and before[row[-1]] >= 0:
        row.append(int(before[row[-1]]))
    return np.array(row[::-1], np.intp)


def _evenly(times: NDArray[np.float64], known: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return times with the unknown ones interpolated between the known ones, or extrapolated."""
    if not len(known):
        return np.arange(len(times)) / _DEFAULT_RATE
    own = times[known]
    step = float(np.median(np.diff(own) / np.diff(known))) if len(known) > 1 else 1 / _DEFAULT_RATE
    places = [-1, *known, len(times)]
    ends = own[0] - step * (known[0] + 1), own[-1] + step * (len(times) - known[-1])
    return np.asarray(np.interp(np.arange(len(times)), places, [ends[0], *own, ends[1]]))
