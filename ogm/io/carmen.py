"""CARMEN logs, text with one message per line: scans of planar lasers and their poses."""

import gzip
import logging
import lzma
import math
import re
import zlib
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.io.beams import BeamRanges, echoes, planar_scan
from ogm.io.labels import REACH
from ogm.io.reading import read_bytes
from ogm.scan import Scan
from ogm.storage.files import OgmError
from ogm.storage.limits import current_limits

log: logging.Logger = logging.getLogger(__name__)

_HEAD = 2**16  # [byte] at the beginning of a file in which a log is recognised
_FIRST = re.compile(rb"(?m)^[ \t]*(?:[FR]LASER|RAWLASER\d|ROBOTLASER\d) +\S|^ODOM +\S+ +\S+ +\S+ +|^PARAM +\w+ +\S")
_LASER = re.compile(r"[FR]LASER|ROBOTLASER\d")
_MAX_BEAMS = 2**16
_KNOWN = {  # beams: increment and field of view [deg], as in CARMEN, for lasers that state none
    **dict.fromkeys((180, 181), (1.0, 180.0)), **dict.fromkeys((360, 361), (0.5, 180.0)), 401: (0.25, 100.0),
    541: (0.5, 270.0), **dict.fromkeys((1080, 1081), (0.25, 270.0)),
}  # fmt: skip
_CODES = 0.0015  # share of the greatest range; values of a SICK LMS without echo lie so near to it, 8183 to 8191
_BAND = 0.05  # share of the greatest range below the codes, in which echoes would also lie
_SHARE = 1e-3  # least share of ranges without echo; fewer are echoes at the greatest range
_APART = 4  # least ratio of the counts at the greatest range and in the band below


class LaserLine(NamedTuple):
    """Scan of a laser as stated by its line.

    Attributes
    ----------
    kind : str
        First word of the line, such as FLASER.
    ranges : (B,) float64
        [m]
    start, step : float
        Angle of the first beam, and angle between beams [rad].
    pose, robot : (3,) float64
        x, y [m] and heading [rad] of the laser and of the robot, on the map.
    times : (2,) float64
        Times of measurement and of logging [s].
    max_range : float
        Range stated by the line [m]; NaN if missing.
    remission : (B,) float64, optional
    """

    kind: str
    ranges: NDArray[np.float64]
    start: float
    step: float
    pose: NDArray[np.float64]
    robot: NDArray[np.float64]
    times: NDArray[np.float64]
    max_range: float = math.nan
    remission: NDArray[np.float64] | None = None


@dataclass
class CarmenLog:
    """Scans of a CARMEN log, in the order of their lines.

    Attributes
    ----------
    lines : list of LaserLine
    others : Counter of str
        Number of lines of other messages, by their first words.
    odd : list of str
        Unreadable lines: number, beginning and reason.
    damage : str
        Reason why the file ends early; "" for a complete file.
    stated_range : float
        Greatest range of the front laser by a parameter of the log [m]; inf if missing.
    """

    lines: list[LaserLine] = field(default_factory=list)
    others: Counter[str] = field(default_factory=Counter)
    odd: list[str] = field(default_factory=list)
    damage: str = ""
    stated_range: float = math.inf

    def limits(self, kind: str) -> tuple[float | None, float | None]:
        """Return the least range without echo and the greatest range of a laser [m].

        Beams without echo share one value at the top of the distribution, apart from all others: at least 0.1 % of
        the ranges lie within 0.15 % of the greatest, and four times as many there as in the 5 % below. The greatest
        range is the greatest echo of the log, or the stated range if that is less.

        Parameters
        ----------
        kind : str
            First word of the laser's lines.

        Returns
        -------
        no_echo, max_range : float or None
            None if no range repeats; None without echoes.
        """
        rows = [line.ranges for line in self.lines if line.kind == kind]
        ranges = np.concatenate([np.empty(0), *rows])
        ranges = ranges[(ranges > 0) & (ranges <= REACH)]
        if not len(ranges):
            return None, None
        top = float(ranges.max())
        at_top = np.count_nonzero(ranges >= (1 - _CODES) * top)
        below = np.count_nonzero(ranges >= (1 - _BAND) * top) - at_top
        no_echo = (1 - _CODES) * top if at_top >= max(2, _SHARE * len(ranges)) and at_top > _APART * below else None
        with_echo = ranges if no_echo is None else ranges[ranges < no_echo]
        if not len(with_echo):
            return no_echo, None
        return no_echo, min(float(with_echo.max()), self.stated_range)

    def scan(self, n: int, no_echo: float | None, max_range: float | None) -> Scan:
        """Return the scan of a line, with the limits of its laser and without a stamp.

        Parameters
        ----------
        n : int
            Number of the line in `lines`.
        no_echo, max_range : float or None
            See `limits`.
        """
        line = self.lines[n]
        ranges = line.ranges
        silent = np.zeros(len(ranges), np.bool_) if no_echo is None else ranges >= no_echo
        if line.max_range > 0:
            silent |= echoes(ranges, 0.0, line.max_range)[1]
            max_range = min(line.max_range, line.max_range if max_range is None else max_range)
        angles = np.asarray(line.start + line.step * np.arange(len(ranges)))
        beams = BeamRanges(np.where(silent, np.inf, ranges), angles, intensity=line.remission)
        scan = planar_scan(beams, f"{line.kind} {n}", None)
        return Scan(scan.points, no_returns=scan.no_returns, kind=scan.kind, max_range=max_range)


def is_carmen(path: Path) -> bool:
    """Return whether a file begins like a CARMEN log; it may be packed by gzip or xz."""
    unpack: Any = {".gz": gzip.open, ".xz": lzma.open}.get(path.suffix.lower(), open)
    with suppress(OSError, EOFError, zlib.error, lzma.LZMAError), unpack(path, "rb") as file:
        return bool(_FIRST.search(file.read(_HEAD)))
    return False


def read_carmen(path: Path) -> CarmenLog:
    """Read the scans of a CARMEN log.

    FLASER, RLASER and ROBOTLASER are read; all other messages are counted. Unreadable lines are left out.

    Raises
    ------
    OgmError
        If the file is empty or damaged.
    """
    data, damage = _unpacked(path)
    found = CarmenLog(damage=damage)
    for number, line in enumerate(data.decode("latin-1").splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            if _LASER.fullmatch(words[0]):
                found.lines.append(_robot_laser(words) if words[0][1:] != "LASER" else _laser(words))
                continue
            if words[0] == "PARAM" and words[1].endswith("front_laser_max") and (stated := float(words[2])) > 0:
                found.stated_range = stated
        except (ValueError, IndexError, OverflowError) as error:
            reason = "it is cut short" if isinstance(error, IndexError) else str(error)
            found.odd.append(f"line {number}, {' '.join(words[:3])[:40]!r}: {reason}")
            continue
        found.others[words[0][:20]] += 1
    return found


def _unpacked(path: Path) -> tuple[bytes, str]:
    """Return the content of a file and the reason for a missing end, "" if complete."""
    try:
        return read_bytes(path)[0], ""
    except OgmError as error:
        if error.__cause__ is None or path.suffix.lower() != ".gz":
            raise
        parts: list[bytes] = []
        with suppress(OSError, EOFError, zlib.error), gzip.open(path) as file:
            while (part := file.read(_HEAD)) and len(parts) * _HEAD < current_limits().file:
                parts.append(part)
        if not parts:
            raise
        return b"".join(parts), f"{error}; the lines before are read"


def _laser(words: Sequence[str]) -> LaserLine:
    """Read FLASER or RLASER: count, ranges, pose of the laser, pose of the robot, time, host, time of the logger."""
    ranges, rest = _counted(words[1:])
    if not len(ranges):
        raise ValueError("it has no ranges")
    poses = np.array([float(word) for word in rest[:6]])
    if len(poses) < 6:
        raise IndexError
    step, view = _KNOWN.get(len(ranges), (180.0 / max(len(ranges) - 1, 1), 180.0))
    return LaserLine(
        words[0], ranges, math.radians(-view / 2), math.radians(step), poses[:3], poses[3:], _times(rest[6:])
    )


def _robot_laser(words: Sequence[str]) -> LaserLine:
    """Read ROBOTLASER: configuration, ranges, remissions, pose of the laser, pose of the robot, speeds, times."""
    _, start, view, step, max_range, _, _ = (float(word) for word in words[1:8])
    ranges, rest = _counted(words[8:])
    remission, rest = _counted(rest)
    poses = np.array([float(word) for word in rest[:6]])
    if len(poses) < 6:
        raise IndexError
    if not (math.isfinite(step) and step != 0):
        step = view / max(len(ranges) - 1, 1)
    if not len(ranges) or not all(map(math.isfinite, (start, step))) or abs(step) * len(ranges) > 3 * math.pi:
        raise ValueError(f"{len(ranges)} beams from {start:g} by {step:g} rad do not fit a laser")
    return LaserLine(
        words[0], ranges, start, step, poses[:3], poses[3:], _times(rest[11:]), max_range,
        remission if len(remission) == len(ranges) else None,
    )  # fmt: skip


def _counted(words: Sequence[str]) -> tuple[NDArray[np.float64], Sequence[str]]:
    """Return the numbers of a list that begins with their count, and the following words."""
    count = int(words[0])
    if not 0 <= count <= _MAX_BEAMS:
        raise ValueError(f"it has {count} values, wanted up to {_MAX_BEAMS}")
    if len(words) < 1 + count:
        raise IndexError
    return np.array([float(word) for word in words[1 : 1 + count]]), words[1 + count :]


def _times(words: Sequence[str]) -> NDArray[np.float64]:
    """Return the times of message and logger; NaN if missing."""
    found = np.full(2, np.nan)
    for k, word in enumerate((words[:1], words[2:3])):
        with suppress(ValueError, IndexError):
            found[k] = float(word[0])
    return found
