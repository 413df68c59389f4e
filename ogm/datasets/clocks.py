"""Clocks of a log: where stamps go back, jump or are wrong against the order in which messages were recorded."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

BACK = 0.5  # [s] by which stamps fall behind the log time in one step, and go back, where a clock was put back
AHEAD = 60.0  # [s] by which stamps run ahead of the log time in one step where a clock was put ahead
AGREE = 3  # scans in a row that agree with each other, from which a clock is believed to be another
LATE = 10.0  # [s] behind the newest stamp, up to which a message is late and not wrong
_NEAR = 2.0  # [s] of log time within which topics that are cut are cut together
_SPEEDS = (0.5, 2.0)  # of stamps against log time, between which they are taken for 1
_APART = 1000.0  # [s] between two parts on the time line: more than any transform is interpolated over
_SLACK = 1.0  # [s] by which messages of one time are recorded one after the other
_COARSE = 2.0**-9  # [s] the least step of stamps that are too coarse: that of 32 bits is a power of 2
_START = 10.0  # [s] after 0, up to which the scan after one of stamp 0 shows that its clock began at 0
_TWICE = 0.3  # of the step of stamps, at least, that messages of one coarse stamp last
_EXAMPLES = 100  # stamps
_OFFSET = 2.0  # [s] between two clocks: more than most transforms take to be computed
_VARIES = 0.1  # [s] of the middle half of delays: those of a slow computation vary, those of a clock are constant
STRAY = -1
"""Part of a scan with a stamp that agrees with no other."""


class ClockFinding(NamedTuple):
    """A fault of the clock of a topic.

    Attributes
    ----------
    kind : str
        "clock put back", "clock put ahead", "wrong stamps", "missing stamps", "coarse stamps", or "clock
        offset" between scans and transforms.
    what : str
        The fault, in words.
    where : str
        Topic and log time.
    way_out : str
        What becomes of it, and what the user can do.
    """

    kind: str
    what: str
    where: str
    way_out: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}; {self.way_out}"


def clock_parts(log_times: NDArray[np.float64], stamps: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the part of a drive that each message of a topic belongs to, by its clock; `STRAY` for wrong stamps.

    A part ends where stamps go back while log time goes on (a simulation or a recording that began anew, a clock that
    was put back), or run far ahead of it, and at least three stamps in a row then agree with each other. Fewer are
    wrong stamps. A single stamp of up to 10 s behind the newest is that of a late message.

    Parameters
    ----------
    log_times : (K,) float64
        When messages were recorded [s], in rising order.
    stamps : (K,) float64
        Of their headers [s]; NaN where unset.

    Returns
    -------
    (K,) int64
        Parts count from 0, in the order of log time.
    """
    parts = np.full(len(stamps), STRAY)
    known = np.flatnonzero(np.isfinite(stamps))
    speed = _speed(log_times[known], stamps[known])
    if speed is None:
        parts[known] = 0
        return parts
    t, s = (log_times * speed).tolist(), stamps.tolist()

    def follows(k: int, last: int) -> bool:
        """Return whether message k has a stamp of the clock of an earlier message."""
        step, passed = s[k] - s[last], t[k] - t[last]
        return not (step < 0 and passed - step > BACK) and step - passed <= AHEAD

    def drift(k: int, last: int) -> float:
        """Return by how much stamps went apart from log time between two messages [s]."""
        return float(abs(s[k] - s[last] - t[k] + t[last]))

    part, newest = 0, -1
    waiting: list[int] = []  # messages that do not follow the newest of the part, but each other
    for k in known.tolist():
        catches_up = bool(waiting) and follows(k, waiting[-1]) and drift(k, waiting[-1]) < drift(k, newest)
        if newest < 0 or (follows(k, newest) and not catches_up):
            parts[k] = part
            newest = k if newest < 0 or s[k] >= s[newest] else newest
            waiting = []
            continue
        waiting = [*waiting, k] if waiting and follows(k, waiting[-1]) else [k]
        if 0 < s[newest] - s[k] <= LATE:
            parts[k] = part  # a late message, unless more follow
        if len(waiting) == AGREE:
            alone = np.flatnonzero(parts == part)
            alone = alone[alone < waiting[0]]
            if len(alone) < AGREE:  # before a driver had its clock set
                parts[alone] = STRAY
            else:
                part += 1
            parts[waiting] = part
            newest, waiting = waiting[-1], []
    return parts


def _speed(log_times: NDArray[np.float64], stamps: NDArray[np.float64]) -> float | None:
    """Return how fast stamps run against log time; None where log times do not tell the order of messages."""
    steps, passed = np.diff(stamps), np.diff(log_times)
    if len(steps) < AGREE or not np.count_nonzero(passed > 0) > len(passed) / 2:
        return None
    speed = float(np.median(steps[passed > 0] / passed[passed > 0]))
    return speed if speed > _SPEEDS[1] or 0 < speed < _SPEEDS[0] else 1.0


def joint_parts(
    log_times: Sequence[NDArray[np.float64]], parts: Sequence[NDArray[np.int64]]
) -> list[NDArray[np.int64]]:
    """Return the parts of several topics as those of one drive, which ends a part where one of them does.

    Parameters
    ----------
    log_times : sequence of (K,) float64
        Of each topic [s].
    parts : sequence of (K,) int64
        Of `clock_parts`.

    Returns
    -------
    list of (K,) int64
    """
    starts = [
        (float(times[np.argmax(own == number)]), topic, number)
        for topic, (times, own) in enumerate(zip(log_times, parts, strict=True))
        for number in range(1, int(own.max(initial=0)) + 1)
    ]
    cuts: list[list[tuple[float, int, int]]] = []
    for start in sorted(starts):
        if cuts and start[0] - cuts[-1][-1][0] <= _NEAR and start[1] not in [one[1] for one in cuts[-1]]:
            cuts[-1].append(start)
        else:
            cuts.append([start])
    joined = []
    for topic, (times, own) in enumerate(zip(log_times, parts, strict=True)):
        passed = np.zeros(len(own), np.int64)
        for cut in cuts:
            mine = [number for _, one, number in cut if one == topic]
            passed += own >= mine[0] if mine else times >= cut[0][0]
        joined.append(np.where(own == STRAY, STRAY, passed))
    return joined


def _begun_at_zero(stamps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return stamps, in the order of log time, with 0 instead of NaN where a clock began at 0 with that message."""
    unset = np.isnan(stamps)
    after = np.append(stamps[1:], np.nan)
    with np.errstate(invalid="ignore"):
        return np.where(unset & (after > 0) & (after < _START), 0.0, stamps)


def coarse_stamps(
    where: str, noun: str, log_times: NDArray[np.float64], stamps: NDArray[np.float64]
) -> list[ClockFinding]:
    """Return a finding where most stamps are those of the message before, in steps of 1/512 s, or all are 0; else none.

    Messages that were recorded twice have equal stamps, too, but in pairs that follow each other quickly.

    Parameters
    ----------
    where, noun : str
        Name of the messages, and their kind in words.
    log_times, stamps : (K,) float64
        Of the messages, in the order of log time [s].
    """
    if len(stamps) > 1 and not stamps.any():
        return [
            ClockFinding(
                "coarse stamps", f"all {len(stamps)} {noun} have the stamp 0", where, "their sender must set them"
            )
        ]
    same = (np.diff(stamps) == 0) & (np.diff(log_times) > 0)
    if len(same) < AGREE or 2 * np.count_nonzero(same) <= len(same) or (stamps % _COARSE).any():
        return []
    different = np.unique(stamps)
    lasting = float(np.median([np.ptp(log_times[stamps == stamp]) for stamp in different[:_EXAMPLES]]))
    if len(different) > 1 and lasting < _TWICE * float(np.median(np.diff(different))):
        return []
    what = f"{len(stamps)} {noun} have {len(different)} different stamps in {np.ptp(log_times):.3g} s"
    way = "they are too coarse for poses: record or convert the log anew with whole stamps (64 bits)"
    return [ClockFinding("coarse stamps", what, where, way)]


def clock_offset(
    topic: str,
    log_times: NDArray[np.float64],
    stamps: NDArray[np.float64],
    what: str,
    other_times: NDArray[np.float64],
    others: NDArray[np.float64],
) -> list[ClockFinding]:
    """Return a finding where the clocks of scans and of other messages differ by over 2 s; else none.

    Stamps up to 10 s behind are those of late messages, as of a slow SLAM, where the delay varies by more than 0.1 s
    (between its quartiles), or where the stamps begin with those of the scans: a clock that is behind gives
    some from before.

    Parameters
    ----------
    topic : str
        Of the scans.
    log_times, stamps : (K,) float64
        Of the scans [s].
    what : str
        Name of the other messages.
    other_times, others : (M,) float64
        Log times and stamps of the other messages [s].
    """
    if min(len(others), len(stamps)) < 2 or not np.ptp(other_times) or not np.ptp(log_times):
        return []
    inside = (log_times >= other_times.min()) & (log_times <= other_times.max()) & np.isfinite(stamps)
    if not inside.any():
        return []
    order = np.argsort(other_times)
    behind = np.interp(log_times[inside], other_times[order], (other_times - others)[order])
    quartile, offset, other_quartile = np.percentile(behind - (log_times - stamps)[inside], [25, 50, 75]).tolist()
    begins_late = others.min() >= np.nanmin(stamps) - _SLACK
    is_late = 0 < offset <= LATE and (begins_late or other_quartile - quartile > _VARIES)
    if abs(offset) <= _OFFSET or is_late:
        return []
    text = f"stamps are {abs(offset):.4g} s {'ahead of' if offset > 0 else 'behind'} those of the {what}, by log times"
    way = (
        "scans get poses of another time: record both with one clock, or --odometry kiss-icp, which needs no transforms"
    )
    return [ClockFinding("clock offset", text, topic, way)]


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
        what = f"stamps {'go back' if back else 'jump'} from {old:.6f} to {new:.6f} s while {passed:.3g} s pass"
        way = "the drive is cut there into parts, of which --sequence picks one"
        where = f"{topic} at log time {log_times[first]:.3f} s"
        found.append(ClockFinding("clock put back" if back else "clock put ahead", what, where, way))
    strays = known & (parts == STRAY)
    if strays.any():
        k = int(np.argmax(strays))
        what = f"{np.count_nonzero(strays)} of {len(stamps)} stamps agree with no other, the first is {stamps[k]:.6f} s"
        where = f"{topic} at log time {log_times[k]:.3f} s"
        found.append(ClockFinding("wrong stamps", what, where, "these scans are left out"))
    if not known.all():
        what = f"{np.count_nonzero(~known)} of {len(stamps)} headers have no stamp (0)"
        way = "these scans are left out" if known.any() else "poses cannot be looked up: estimate them by `odometry`"
        found.append(ClockFinding("missing stamps", what, topic, way))
    return found


class DriveClock:
    """Clock of the scans of a log: the parts of the drive, and one time line on which no two parts overlap.

    Parameters
    ----------
    topics : sequence of K str
        Topic of each scan, in the order of log time.
    log_times, stamps : (K,) float64
        Of the scans [s]; a stamp is NaN where the header has none.

    Attributes
    ----------
    stamps : (K,) float64
        [s]; 0 instead of NaN where a clock began at 0 with the scan.
    parts : (K,) int64
        Part of each scan, from 0; `STRAY` for scans that are left out.
    findings : list of ClockFinding
        Faults, worst first.
    """

    def __init__(self, topics: Sequence[str], log_times: NDArray[np.float64], stamps: NDArray[np.float64]) -> None:
        self.stamps, self.parts = stamps.copy(), np.zeros(len(stamps), np.int64)
        rows = {
            name: np.array([n for n, topic in enumerate(topics) if topic == name]) for name in dict.fromkeys(topics)
        }
        for mine in rows.values():
            self.stamps[mine] = _begun_at_zero(stamps[mine])
        own = [clock_parts(log_times[mine], self.stamps[mine]) for mine in rows.values()]
        self.findings = [
            finding
            for (name, mine), parts in zip(rows.items(), own, strict=True)
            for finding in clock_findings(name, log_times[mine], self.stamps[mine], parts)
        ]
        if np.isnan(self.stamps).all():
            return
        for mine, parts in zip(
            rows.values(), joint_parts([log_times[mine] for mine in rows.values()], own), strict=True
        ):
            self.parts[mine] = parts
        self._spans, self._offsets = [], []  # log times of each part [s], and log time minus stamp
        self._shifts, end = [], -np.inf
        for number in range(int(self.parts.max()) + 1):
            mine = self.parts == number
            first, last = float(self.stamps[mine].min()), float(self.stamps[mine].max())
            shift = float(np.ceil(end + _APART - first)) if first < end + _APART else 0.0
            self._shifts.append(shift)
            end = max(end, last + shift)
            self._spans.append((float(log_times[mine].min()), float(log_times[mine].max())))
            self._offsets.append(float(np.median(log_times[mine] - self.stamps[mine])))

    @property
    def is_cut(self) -> bool:
        """Whether the drive has several parts."""
        return int(self.parts.max(initial=0)) > 0

    def shifted(self, stamps: NDArray[np.float64], parts: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return stamps of some parts on the time line, (M,) [s]."""
        return stamps + np.array(self._shifts)[parts] if self.is_cut else stamps

    def on_line(self, log_times: NDArray[np.float64], stamps: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the stamps of the messages of another topic on the time line, (M,) [s].

        The part of a message is that of the scans that were recorded at its time. Near a cut it is the part whose scans
        were recorded as long after their stamps, apart from the usual delay of the topic.

        Parameters
        ----------
        log_times, stamps : (M,) float64
            [s]
        """
        if not self.is_cut or not len(stamps):
            return stamps
        (first, last), offsets = np.array(self._spans).T, np.array(self._offsets)
        part = np.clip(np.searchsorted(first, log_times, "right") - 1, 0, None)
        behind = log_times - stamps
        behind = behind - np.median(behind - offsets[part])
        best, found = np.full(len(stamps), np.inf), part.copy()
        for n, offset in enumerate(offsets):
            possible = (n == part) | ((n == part - 1) & (log_times <= first[part] + _SLACK))
            if n:
                possible |= (n == part + 1) & (log_times >= last[n - 1] - _SLACK)
            distance = np.where(possible, np.abs(behind - offset), np.inf)
            found, best = np.where(distance < best, n, found), np.minimum(distance, best)
        return np.asarray(stamps + np.array(self._shifts)[found])
