"""Clock faults of a log, found by comparing header stamps with recording times."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

MAX_BACK = 0.5  # [s] a clock was put back if stamps go back and lose more than this against log time in one step
MAX_AHEAD = 60.0  # [s] a clock was put ahead if stamps gain more than this against log time in one step
MIN_AGREEING = 3  # consecutive scans that must agree with each other to start a new part
MAX_LATE = 10.0  # [s] a message up to this much behind the newest stamp is late, not wrong
_JOINT_CUT = 2.0  # [s] of log time within which the cuts of several topics count as one cut
_REAL_TIME = (0.5, 2.0)  # speeds of stamps against log time that count as 1
_PART_GAP = 1000.0  # [s] between two parts on the time line, longer than any interpolation of transforms
_LOG_JITTER = 1.0  # [s] difference between the log times of simultaneous messages
_COARSE_STEP = 2.0**-9  # [s] smallest step of coarse stamps; stamps of 32 bits have steps of a power of 2
_ZERO_START = 10.0  # [s] a clock began at 0 if a scan of stamp 0 is followed by a scan before this time
_MIN_LASTING = 0.3  # shortest duration of messages with equal coarse stamps, as a share of the step of the stamps
_MAX_SAMPLED = 100  # stamps
_MAX_OFFSET = 2.0  # [s] between two clocks, longer than most transforms take to compute
_DELAY_SPREAD = 0.1  # [s] interquartile range: delays of a slow computation vary, offsets of a clock are constant
STRAY = -1
"""Part of a scan with a wrong stamp, which agrees with no other stamp."""


class ClockFinding(NamedTuple):
    """Fault of the clock of a topic.

    Attributes
    ----------
    kind : str
        "clock put back", "clock put ahead", "wrong stamps", "missing stamps", "coarse stamps", or "clock
        offset" between scans and transforms.
    fault : str
        Description of the fault.
    where : str
        Topic and log time.
    way_out : str
        Consequence of the fault, and the remedy.
    """

    kind: str
    fault: str
    where: str
    way_out: str

    def __str__(self) -> str:
        return f"{self.where}: {self.fault}; {self.way_out}"


def clock_parts(log_times: NDArray[np.float64], stamps: NDArray[np.float64]) -> NDArray[np.int64]:
    """Divide the messages of a topic into parts with a continuous clock.

    A part ends where stamps go back while log time advances, or run far ahead of log time, and at least three
    consecutive stamps then agree with each other. Causes are a restarted simulation or recording, or a clock that was
    put back. Fewer than three such stamps are wrong stamps. A single stamp up to 10 s behind the newest belongs to a
    late message.

    Parameters
    ----------
    log_times : (K,) float64
        Recording times of the messages [s], ascending.
    stamps : (K,) float64
        Header stamps [s]; NaN if unset.

    Returns
    -------
    (K,) int64
        Part of each message, counted from 0 in the order of log time; `STRAY` for wrong stamps.
    """
    parts = np.full(len(stamps), STRAY)
    known = np.flatnonzero(np.isfinite(stamps))
    speed = _speed(log_times[known], stamps[known])
    if speed is None:
        parts[known] = 0
        return parts
    t, s = (log_times * speed).tolist(), stamps.tolist()

    def follows(k: int, last: int) -> bool:
        """Return whether the stamp of message k fits the clock of an earlier message."""
        step, passed = s[k] - s[last], t[k] - t[last]
        return not (step < 0 and passed - step > MAX_BACK) and step - passed <= MAX_AHEAD

    def drift(k: int, last: int) -> float:
        """Return the difference between stamp step and log time step of two messages [s]."""
        return float(abs(s[k] - s[last] - t[k] + t[last]))

    part, newest = 0, -1
    waiting: list[int] = []  # messages that follow each other, but not the newest of the part
    for k in known.tolist():
        catches_up = bool(waiting) and follows(k, waiting[-1]) and drift(k, waiting[-1]) < drift(k, newest)
        if newest < 0 or (follows(k, newest) and not catches_up):
            parts[k] = part
            newest = k if newest < 0 or s[k] >= s[newest] else newest
            waiting = []
            continue
        waiting = [*waiting, k] if waiting and follows(k, waiting[-1]) else [k]
        if 0 < s[newest] - s[k] <= MAX_LATE:
            parts[k] = part  # a late message, unless more such messages follow
        if len(waiting) == MIN_AGREEING:
            alone = np.flatnonzero(parts == part)
            alone = alone[alone < waiting[0]]
            if len(alone) < MIN_AGREEING:  # before the driver's clock was set
                parts[alone] = STRAY
            else:
                part += 1
            parts[waiting] = part
            newest, waiting = waiting[-1], []
    return parts


def _speed(log_times: NDArray[np.float64], stamps: NDArray[np.float64]) -> float | None:
    """Return the speed of stamps against log time, or None if log times do not give the order of messages."""
    steps, passed = np.diff(stamps), np.diff(log_times)
    if len(steps) < MIN_AGREEING or not np.count_nonzero(passed > 0) > len(passed) / 2:
        return None
    speed = float(np.median(steps[passed > 0] / passed[passed > 0]))
    return speed if speed > _REAL_TIME[1] or 0 < speed < _REAL_TIME[0] else 1.0


def joint_parts(
    log_times: Sequence[NDArray[np.float64]], parts: Sequence[NDArray[np.int64]]
) -> list[NDArray[np.int64]]:
    """Join the parts of several topics to common parts, cut where any topic is cut.

    Parameters
    ----------
    log_times : sequence of (K,) float64
        Log times of each topic [s].
    parts : sequence of (K,) int64
        Result of `clock_parts` for each topic.

    Returns
    -------
    list of (K,) int64
        Part of each message, for each topic.
    """
    starts = [
        (float(times[np.argmax(own == number)]), topic, number)
        for topic, (times, own) in enumerate(zip(log_times, parts, strict=True))
        for number in range(1, int(own.max(initial=0)) + 1)
    ]
    cuts: list[list[tuple[float, int, int]]] = []
    for start in sorted(starts):
        if cuts and start[0] - cuts[-1][-1][0] <= _JOINT_CUT and start[1] not in [topic for _, topic, _ in cuts[-1]]:
            cuts[-1].append(start)
        else:
            cuts.append([start])
    joined = []
    for topic, (times, own) in enumerate(zip(log_times, parts, strict=True)):
        passed = np.zeros(len(own), np.int64)
        for cut in cuts:
            mine = [number for _, cut_topic, number in cut if cut_topic == topic]
            passed += own >= mine[0] if mine else times >= cut[0][0]
        joined.append(np.where(own == STRAY, STRAY, passed))
    return joined


def _begun_at_zero(stamps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return stamps in log order, with 0 instead of NaN for the first message of a clock that began at 0."""
    unset = np.isnan(stamps)
    after = np.append(stamps[1:], np.nan)
    with np.errstate(invalid="ignore"):
        return np.where(unset & (after > 0) & (after < _ZERO_START), 0.0, stamps)


def coarse_stamps(
    where: str, noun: str, log_times: NDArray[np.float64], stamps: NDArray[np.float64]
) -> list[ClockFinding]:
    """Return a finding if stamps are coarse.

    Coarse stamps are all 0, or most of them repeat the stamp before and all are multiples of 1/512 s. Messages that
    were recorded twice also have equal stamps, but in pairs that follow each other quickly.

    Parameters
    ----------
    where, noun : str
        Name of the messages, and their kind in words.
    log_times, stamps : (K,) float64
        Log times and header stamps of the messages, in the order of log time [s].

    Returns
    -------
    list of ClockFinding
        Empty if the stamps are fine.
    """
    if len(stamps) > 1 and not stamps.any():
        fault = f"all {len(stamps)} {noun} have the stamp 0"
        return [ClockFinding("coarse stamps", fault, where, "the sender must set the stamps")]
    same = (np.diff(stamps) == 0) & (np.diff(log_times) > 0)
    if len(same) < MIN_AGREEING or 2 * np.count_nonzero(same) <= len(same) or (stamps % _COARSE_STEP).any():
        return []
    different = np.unique(stamps)
    lasting = float(np.median([np.ptp(log_times[stamps == stamp]) for stamp in different[:_MAX_SAMPLED]]))
    if len(different) > 1 and lasting < _MIN_LASTING * float(np.median(np.diff(different))):
        return []
    fault = f"{len(stamps)} {noun} have {len(different)} different stamps in {np.ptp(log_times):.3g} s"
    way = "the stamps are too coarse for poses: record or convert the log again with stamps of 64 bits"
    return [ClockFinding("coarse stamps", fault, where, way)]


def clock_offset(
    topic: str,
    log_times: NDArray[np.float64],
    stamps: NDArray[np.float64],
    other: str,
    other_times: NDArray[np.float64],
    others: NDArray[np.float64],
) -> list[ClockFinding]:
    """Return a finding if the clocks of scans and other messages differ by more than 2 s.

    Messages up to 10 s behind are late, not of another clock, in two cases: their delay varies by more than 0.1 s
    between its quartiles (a slow SLAM), or their first stamp is not before the first stamp of the scans.

    Parameters
    ----------
    topic : str
        Topic of the scans.
    log_times, stamps : (K,) float64
        Log times and stamps of the scans [s].
    other : str
        Name of the other messages.
    other_times, others : (M,) float64
        Log times and stamps of the other messages [s].

    Returns
    -------
    list of ClockFinding
        Empty if the clocks agree.
    """
    if min(len(others), len(stamps)) < 2 or not np.ptp(other_times) or not np.ptp(log_times):
        return []
    inside = (log_times >= other_times.min()) & (log_times <= other_times.max()) & np.isfinite(stamps)
    if not inside.any():
        return []
    order = np.argsort(other_times)
    behind = np.interp(log_times[inside], other_times[order], (other_times - others)[order])
    quartile, offset, other_quartile = np.percentile(behind - (log_times - stamps)[inside], [25, 50, 75]).tolist()
    begins_late = others.min() >= np.nanmin(stamps) - _LOG_JITTER
    is_late = 0 < offset <= MAX_LATE and (begins_late or other_quartile - quartile > _DELAY_SPREAD)
    if abs(offset) <= _MAX_OFFSET or is_late:
        return []
    side = "ahead of" if offset > 0 else "behind"
    fault = f"stamps are {abs(offset):.4g} s {side} the stamps of the {other}, by log times"
    way = "scans get poses of another time: record both with one clock, or give --odometry kiss-icp"
    return [ClockFinding("clock offset", fault, topic, way)]


def clock_findings(
    topic: str, log_times: NDArray[np.float64], stamps: NDArray[np.float64], parts: NDArray[np.int64]
) -> list[ClockFinding]:
    """Return the faults of the clock of a topic, worst first.

    Parameters
    ----------
    topic : str
    log_times, stamps : (K,) float64
        Arguments of `clock_parts`.
    parts : (K,) int64
        Result of `clock_parts`.
    """
    found = list[ClockFinding]()
    known = np.isfinite(stamps)
    found += coarse_stamps(topic, "scans", log_times[known], stamps[known])
    numbers = [n for n in np.unique(parts) if n != STRAY]
    for before, after in zip(numbers, numbers[1:], strict=False):
        last, first = np.flatnonzero(parts == before)[-1], np.flatnonzero(parts == after)[0]
        old, new, passed = stamps[parts == before].max(), stamps[first], log_times[first] - log_times[last]
        back = new < old
        fault = f"stamps {'go back' if back else 'jump'} from {old:.6f} to {new:.6f} s while {passed:.3g} s pass"
        way = "the drive is cut into parts there; --sequence selects a part"
        where = f"{topic} at log time {log_times[first]:.3f} s"
        found.append(ClockFinding("clock put back" if back else "clock put ahead", fault, where, way))
    strays = known & (parts == STRAY)
    if strays.any():
        k = int(np.argmax(strays))
        fault = f"{np.count_nonzero(strays)} of {len(stamps)} stamps agree with no other, the first: {stamps[k]:.6f} s"
        where = f"{topic} at log time {log_times[k]:.3f} s"
        found.append(ClockFinding("wrong stamps", fault, where, "these scans are left out"))
    if not known.all():
        fault = f"{np.count_nonzero(~known)} of {len(stamps)} headers have no stamp (0)"
        way = "these scans are left out" if known.any() else "poses cannot be looked up: estimate them by `odometry`"
        found.append(ClockFinding("missing stamps", fault, topic, way))
    return found


class DriveClock:
    """Clock of the scans of a log, with the parts of the drive on a common time line.

    Parameters
    ----------
    topics : sequence of K str
        Topic of each scan, in the order of log time.
    log_times, stamps : (K,) float64
        Log times and stamps of the scans [s]; NaN for a header without stamp.

    Attributes
    ----------
    stamps : (K,) float64
        Stamps of the scans [s]; 0 instead of NaN for the first scan of a clock that began at 0.
    parts : (K,) int64
        Part of each scan, from 0; `STRAY` for scans that are left out.
    findings : list of ClockFinding
        Faults, worst first.
    """

    def __init__(self, topics: Sequence[str], log_times: NDArray[np.float64], stamps: NDArray[np.float64]) -> None:
        self.stamps, self.parts = stamps.copy(), np.zeros(len(stamps), np.int64)
        self.findings: list[ClockFinding] = []
        rows, times, own = [], [], []
        for name in dict.fromkeys(topics):
            mine = np.flatnonzero([topic == name for topic in topics])
            self.stamps[mine] = _begun_at_zero(stamps[mine])
            parts = clock_parts(log_times[mine], self.stamps[mine])
            self.findings += clock_findings(name, log_times[mine], self.stamps[mine], parts)
            rows.append(mine)
            times.append(log_times[mine])
            own.append(parts)
        if np.isnan(self.stamps).all():
            return
        for mine, parts in zip(rows, joint_parts(times, own), strict=True):
            self.parts[mine] = parts
        self._spans, self._offsets = [], []  # log times of each part, and median of log time minus stamp [s]
        self._shifts, end = [], -np.inf
        for number in range(int(self.parts.max()) + 1):
            mine = self.parts == number
            first, last = float(self.stamps[mine].min()), float(self.stamps[mine].max())
            shift = float(np.ceil(end + _PART_GAP - first)) if first < end + _PART_GAP else 0.0
            self._shifts.append(shift)
            end = max(end, last + shift)
            self._spans.append((float(log_times[mine].min()), float(log_times[mine].max())))
            self._offsets.append(float(np.median(log_times[mine] - self.stamps[mine])))

    @property
    def is_cut(self) -> bool:
        """Whether the drive has several parts."""
        return int(self.parts.max(initial=0)) > 0

    def shifted(self, stamps: NDArray[np.float64], parts: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return stamps of given parts on the time line, (M,) [s]."""
        return stamps + np.array(self._shifts)[parts] if self.is_cut else stamps

    def on_line(self, log_times: NDArray[np.float64], stamps: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the stamps of messages of another topic on the time line, (M,) [s].

        A message belongs to the part of the scans recorded at its log time. Near a cut, it belongs to the part with
        the same difference between log time and stamp, apart from the usual delay of the topic.

        Parameters
        ----------
        log_times, stamps : (M,) float64
            Log times and stamps of the messages [s].
        """
        if not self.is_cut or not len(stamps):
            return stamps
        (first, last), offsets = np.array(self._spans).T, np.array(self._offsets)
        part = np.clip(np.searchsorted(first, log_times, "right") - 1, 0, None)
        behind = log_times - stamps
        behind = behind - np.median(behind - offsets[part])
        best, found = np.full(len(stamps), np.inf), part.copy()
        for n, offset in enumerate(offsets):
            possible = (n == part) | ((n == part - 1) & (log_times <= first[part] + _LOG_JITTER))
            if n:
                possible |= (n == part + 1) & (log_times >= last[n - 1] - _LOG_JITTER)
            distance = np.where(possible, np.abs(behind - offset), np.inf)
            found, best = np.where(distance < best, n, found), np.minimum(distance, best)
        return np.asarray(stamps + np.array(self._shifts)[found])
