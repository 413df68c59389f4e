"""CARMEN logs of planar lasers as recordings: stamps, poses and limits by the log itself."""

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

_RATE = 10.0  # [Hz] at which scans are counted where the log has no times of theirs
_OWN = 0.25  # of the scans, at least, have times of their own that rise, or the log has none
_SPEED, _TURN_RATE = 5.0, 2.0  # [m/s], [rad/s] that robots with planar lasers do not exceed
_LONGEST = 10.0  # [s] that a jump of the pose takes
_LATEST = 2.0**33  # [s] that no time in seconds since 1970 exceeds
_BEHIND = 0.9  # of the rear laser's poses with the robot's heading, from which on the heading is not the laser's


class CarmenRecording(Recording):
    """Scans of the planar lasers in a CARMEN log, with the poses that stand beside them."""

    format = "CARMEN log"
    wanted_labels = "poses of the scans"
    ego_footprint = None
    motion_distorted = aggregated = False
    own_options = ("topic",)
    known_height = assumed_height = True

    @classmethod
    def open(cls, paths: Sequence[Path], options: OpenOptions) -> "CarmenRecording | None":
        """Return the scans of a CARMEN log; None if no path is one by its content.

        Raises
        ------
        OgmError
            If there are several files, a topic does not exist, or no scan can be read.
        ValueError
            If a fixed frame is chosen: the log has one alone.
        """
        files = [path for path in paths if isinstance(path, Path) and path.is_file()]
        if not any(not ending_of(path) and not log_ending(path) and is_carmen(path) for path in files):
            return None
        if len(paths) > 1:
            raise OgmError(f"{paths[0]} is a CARMEN log; give one alone")
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
        """The log, and the limits of its lasers."""
        log = read_carmen(self.path)
        return log, {kind: log.limits(kind) for kind in self.topics}

    def read(self, n: int) -> RawFrame:
        """Return a scan."""
        log, limits = self._content
        kind = log.lines[self._numbers[n]].kind
        return RawFrame(replace(log.scan(self._numbers[n], *limits[kind]), sensor=kind))

    def place(self, n: int) -> SensorPlace:
        """Return the place of a laser: that on the robot where there are several."""
        line = self._content[0].lines[self._numbers[n]]
        place = SensorPlace(line.kind, height=PLANE_HEIGHT, ego_footprint=NO_FOOTPRINT)
        if len(self.topics) == 1 or not np.isfinite(line.robot).all() or (T_map_laser := self._pose(line)) is None:
            return place
        T = inverse(pose(*line.robot[:2], yaw=line.robot[2])) @ T_map_laser
        return place._replace(origin=(float(T[0, 3]), float(T[1, 3])), yaw=float(np.arctan2(T[1, 0], T[0, 0])))

    def _pose(self, line: LaserLine) -> NDArray[np.float64] | None:
        """Return T_map_sensor of a scan; None if it is not known."""
        if not np.isfinite(line.pose).all():
            return None
        x, y, heading = line.pose
        return pose(x, y, yaw=heading + np.pi * (self._turned and line.kind == "RLASER"))

    def _notes(self, left_out: Mapping[str, int]) -> list[tuple[str, str]]:
        """Return what is not known of the log, or unusual, each with the way out ("" for none)."""
        height = f"the height of the laser is not recorded: {PLANE_HEIGHT:g} m is assumed"
        notes = [(f"{height}, which names the plane of free cells (--sensor-height)", "")]
        if self._turned:
            notes.append(("RLASER has the robot's heading: its beams are turned to the rear", ""))
        if left_out:
            listed = ", ".join(f"{kind} ({count})" for kind, count in left_out.items())
            notes.append((f"scans of {listed} are left out (--topic)", ""))
        return notes


def _chosen(path: Path, counts: Mapping[str, int], wanted: Sequence[str], log: CarmenLog) -> tuple[str, ...]:
    """Return the messages to read scans of: by default those with most scans."""
    listed = ", ".join(f"{kind} ({count})" for kind, count in counts.items()) or "none"
    if missing := [kind for kind in wanted if kind not in counts]:
        raise OgmError(f"{path} has no scans {missing[0]}; there are {listed}")
    if not counts:
        others = ", ".join(log.others) or "none"
        odd = f"; {len(log.odd)} lines cannot be read, the first: {log.odd[0]}" if log.odd else ""
        raise OgmError(f"{path} has no scans with poses (FLASER, RLASER, ROBOTLASER1); its messages are {others}{odd}")
    return tuple(dict.fromkeys(wanted)) or (max(counts, key=lambda kind: counts[kind]),)


def _is_behind(lines: Sequence[LaserLine]) -> bool:
    """Return whether the rear laser's poses have the heading of the robot, and not its own."""
    rear = [line for line in lines if line.kind == "RLASER"]
    same = [abs(np.sin((line.pose[2] - line.robot[2]) / 2)) < 1e-3 for line in rear]
    return bool(rear) and sum(same) > _BEHIND * len(rear)


def _stamps(lines: Sequence[LaserLine], where: str) -> tuple[NDArray[np.float64], ClockFinding | None]:
    """Return the time of each scan [s]: when it was measured, else when it was logged, else counted at 10 Hz.

    Times that do not rise with the lines of their laser are wrong: those scans lie evenly between others. Where the
    poses would move faster than robots do, later scans are put later. The poses do not depend on the times, so that no
    scan is left out.
    """
    times = np.array([line.times for line in lines])
    kinds = np.array([line.kind for line in lines])
    for column in times.T:
        rising = np.zeros(len(lines), np.bool_)
        for kind in np.unique(kinds):
            mine = np.flatnonzero(kinds == kind)
            rising[mine[_rising(column[mine])]] = True
        wrong = int(np.count_nonzero(~rising))
        if wrong > (1 - _OWN) * len(lines):
            continue
        stamps = column.copy()
        for kind in np.unique(kinds):
            mine = kinds == kind
            stamps[mine] = _evenly(column[mine], np.flatnonzero(rising[mine]))
        stamps, hurried = _within_speeds(stamps, lines)
        text = (
            f"{wrong} of {len(lines)} scans have no time of their own, or one that goes back; {hurried} follow the one"
        )
        text = f"{text} before faster than {_SPEED:g} m/s and {_TURN_RATE:g} rad/s allow"
        way = "the former are put evenly between others, the latter later"
        return stamps, ClockFinding("wrong stamps", text, where, way) if wrong or hurried else None
    known = len(np.unique(times[:, 0]))
    text = f"the log has {known} different time{'s' * (known != 1)} for {len(lines)} scans"
    way = f"they are counted at up to {_RATE:g} Hz: velocities and half-lives are of that clock"
    counted, _ = _within_speeds(np.arange(len(lines)) / _RATE, lines)
    return counted, ClockFinding("missing stamps", text, where, way)


def _within_speeds(stamps: NDArray[np.float64], lines: Sequence[LaserLine]) -> tuple[NDArray[np.float64], int]:
    """Return times between which the robot moves no faster than robots do, and how many steps were too short."""
    order = np.argsort(stamps, kind="stable")
    poses = np.array([lines[n].robot for n in order])
    with np.errstate(invalid="ignore", over="ignore"):
        moved = np.diff(poses, axis=0)
        turn = np.abs((moved[:, 2] + np.pi) % (2 * np.pi) - np.pi)
        least = np.maximum(np.hypot(moved[:, 0], moved[:, 1]) / _SPEED, turn / _TURN_RATE)
    least = np.where(np.isfinite(least), np.minimum(least, _LONGEST), 0.0)
    steps = np.diff(stamps[order])
    result = stamps.copy()
    if (short := steps < least - 1e-9).any():
        result[order[1:]] = stamps[order[0]] + np.cumsum(np.maximum(steps, least))
    return result, int(np.count_nonzero(short))


def _rising(times: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the numbers of the longest row of times of a clock that rise strictly, (K,)."""
    least: list[float] = []  # of the last times of rows, by their length
    last: list[int] = []
    before = np.full(len(times), -1)
    for n, time in enumerate(times.tolist()):
        if not 0 < time < _LATEST:
            continue
        at = bisect_left(least, time)
        if least[at : at + 1] == [time]:
            continue  # the first scan of a time has it
        before[n] = last[at - 1] if at else -1
        least[at : at + 1], last[at : at + 1] = [time], [n]
    row = last[-1:]
    while row and before[row[-1]] >= 0:
        row.append(int(before[row[-1]]))
    return np.array(row[::-1], np.intp)


def _evenly(times: NDArray[np.float64], known: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return times of which those that are not known lie evenly between, before and after the others."""
    if not len(known):
        return np.arange(len(times)) / _RATE
    own = times[known]
    step = float(np.median(np.diff(own) / np.diff(known))) if len(known) > 1 else 1 / _RATE
    places = [-1, *known, len(times)]
    ends = own[0] - step * (known[0] + 1), own[-1] + step * (len(times) - known[-1])
    return np.asarray(np.interp(np.arange(len(times)), places, [ends[0], *own, ends[1]]))
