"""Intensities, rings and times of a file's points, brought to known units."""

import logging
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.io.notices import notice

log: logging.Logger = logging.getLogger(__name__)

IntensityRange = tuple[float, float]
"""Intensities of a file that mean 0 and 1."""
IntensityScale = float | IntensityRange | Callable[[IntensityRange], IntensityRange]
"""Intensity that means 1, those that mean 0 and 1, or a function that returns these by the range of one scan."""

_SCALES = (1.0, 255.0, 65535.0)  # intensities that mean 1, of reflectances, bytes and counts of photons
_SAMPLE = 4096  # intensities, about, of which quantiles are taken
_SWEEP = 10.0  # [s] longer than any sweep: times that begin later are a clock's
_FLASH = 1e-3  # [s] shorter than a sweep
_USUAL = (2e-3, 2.0)  # [s] of a sweep: three decades, so that times fit one of the units
_UNITS = (1.0, 1e-3, 1e-6, 1e-9)  # [s] that clocks count in
_COUNTER, _HOUR = 2.0**32, 3600.0  # ticks of a counter of 32 bits, and [s] after which clocks of sensors begin anew
_STRAY = (0.5, 4.0)  # [s] and interquartile ranges from the median, beyond both of which a single time is wrong
_STRAYS = 0.25  # share of wrong times up to which the others are used


def intensity_range(raw: NDArray[Any], least: float | None = None) -> IntensityRange:
    """Return the intensities that mean 0 and 1, by type and values.

    Whole numbers of 8 and 16 bits without sign have the range of their type. Else 0 means 0, and the first of 1, 255
    and 65535 that 99 % of the intensities do not exceed means 1; beyond that, what 99 % do not exceed. Where most are
    negative they are decibels: those that 1 % and 99 % do not exceed mean 0 and 1.

    Parameters
    ----------
    raw : (N,) numbers
    least : float, optional
        Least intensity that may mean 1: that of the format. 1 by default.
    """
    if raw.dtype in (np.uint8, np.uint16):
        return 0.0, float(np.iinfo(raw.dtype).max)
    least = least or 1.0
    if not raw.size or (raw.min() >= 0 and raw.max() <= least):
        return 0.0, least
    some = raw[:: raw.size // _SAMPLE | 1]
    known = some[np.isfinite(some)]
    if not known.size:
        return 0.0, least
    if 2 * np.count_nonzero(known < 0) > known.size:
        low, high = (float(value) for value in np.percentile(known, (1, 99)))
        return low, max(high, low + 1.0)
    high = max(float(np.percentile(known, 99)), least)
    return 0.0, next((scale for scale in _SCALES if high <= scale), high)


def scale_intensities(
    raw: NDArray[Any], given: IntensityScale | None, least: float | None, path: Path | str
) -> tuple[NDArray[Any], float]:
    """Return intensities in [0, 1], and the value that became 1; what is no number becomes 0.

    Parameters
    ----------
    raw : (N,) numbers
    given : IntensityScale, optional
        A function is called where the scan's own range is not 0 to 1. By default that range counts.
    least : float, optional
        See `intensity_range`.
    path : Path or str
        The file's name, or what a message is, for messages.
    """
    if raw.size and not np.isfinite([raw.min(), raw.max()]).all():
        known = np.isfinite(raw)
        text = "%s: %d of %d intensities are no number and become 0"
        notice(log, "unknown intensities", text, path, np.sum(~known), raw.size, level=logging.INFO)
        raw = np.where(known, raw, 0)
    if given is None or callable(given):
        low, high = own = intensity_range(raw, least)
        if given is not None and own != (0.0, 1.0) and raw.dtype not in (np.uint8, np.uint16):
            low, high = given(own)
        if raw.dtype not in (np.uint8, np.uint16) and high != least:
            note_range((low, high), path)
    else:
        low, high = given if isinstance(given, tuple) else (0.0, given)
    scaled = (raw - low) / (high - low) if low else raw / high
    if raw.size and not low <= raw.min() <= raw.max() <= high:
        beyond = np.count_nonzero((raw < low) | (raw > high))
        text = "%s: %d of %d intensities outside of %g ... %g count as 0 or 1"
        notice(log, "intensities beyond", text, path, beyond, raw.size, low, high, level=logging.INFO)
        scaled = np.clip(scaled, 0.0, 1.0)
    return scaled, float(high)


def note_range(found: IntensityRange, where: Path | str) -> None:
    """Log what intensities without a stated scale are taken for."""
    low, high = found
    if low < 0:
        text = "%s: most intensities are negative (decibels?): %g ... %g become 0 ... 1"
        notice(log, "decibels", text, where, low, high)
    elif high > 1.0:
        text = "%s: intensities are divided by %g; give intensity_max if another one means 1"
        notice(log, "intensity scale", text, where, high, level=logging.INFO if high <= _SCALES[1] else logging.WARNING)


def check_rings(raw: NDArray[Any] | None, path: Path | str) -> NDArray[np.uint16] | None:
    """Return rings as uint16; None where there are none, or one of them is no number from 0 to 65535."""
    raw = check_whole(raw, "rings", path)
    if raw is None or raw.dtype in (np.uint8, np.uint16):
        return raw if raw is None else raw.astype(np.uint16, copy=False)
    ring = np.clip(raw.astype(np.float64), 0, 2**16 - 1).astype(np.uint16)
    if not np.array_equal(ring, raw):
        text = "%s: rings from %g to %g are no whole numbers from 0 to 65535; all rings are left out"
        notice(log, "wrong rings", text, path, raw.min(), raw.max())
        return None
    return ring


def split_times(
    raw: NDArray[Any] | None, unit: float | None, path: Path
) -> tuple[NDArray[np.float64] | None, float | None]:
    """Return the times of the points, counted from the stamp, and the stamp [s]; None where there are none.

    Parameters
    ----------
    raw : (N,) numbers, optional
    unit : float, optional
        What they count in [s]; by default see `sweep_times`.
    path : Path
        The file's name, which may hold the stamp.
    """
    digits = re.search(r"(?<!\d)(\d{16}|\d{18,19})$", path.name.split(".")[0])
    stamp = None if digits is None else int(digits[1]) * (1e-6 if len(digits[1]) == 16 else 1e-9)
    if raw is None or not raw.size:
        return raw if raw is None else raw.astype(np.float64), stamp
    if (found := sweep_times(raw, unit, path)) is None:
        return None, stamp
    since, earliest, of_clock = found
    if of_clock:
        return since, earliest if abs(earliest) > _SWEEP else stamp
    return since + earliest, stamp


def times_from_stamp(
    raw: NDArray[Any] | None, unit: float | None, where: str, stamp: float
) -> tuple[NDArray[np.float64] | None, float]:
    """Return the times of a message's points, counted from its stamp, and the stamp [s].

    Times that are nearer to the stamp than to 0 are of its clock: the stamp is subtracted. Such times show their
    unit, too. Times of another clock, which begin over 10 s from both, are counted from the earliest; the
    stamp is then the earliest only where the message has none (0). All others count from the stamp already.

    Parameters
    ----------
    raw : (N,) numbers, optional
    unit : float, optional
        What they count in [s]; by default seconds, milliseconds, microseconds or nanoseconds if one of them
        gives the stamp, within 10 s; else see `sweep_times`.
    where : str
        What the message is, for messages.
    stamp : float
        Of the header [s]; 0 where it was not set.
    """
    if raw is None or not raw.size:
        return raw if raw is None else raw.astype(np.float64), stamp
    if unit is None and abs(stamp) > _SWEEP:
        some = float(raw.min() if _is_short(raw, _usual_unit(raw)) else _middle(raw))
        unit = next((one for one in _UNITS if abs(some * one - stamp) <= _SWEEP), None)
    if (found := sweep_times(raw, unit, where)) is None:
        return None, stamp
    since, earliest, of_clock = found
    if abs(earliest - stamp) < min(abs(earliest), _SWEEP):
        return since + (earliest - stamp), stamp
    if of_clock:
        log.info("%s: its points have times of another clock than its stamp; they count from the earliest", where)
        return since, stamp or earliest
    return since + earliest, stamp


class SweepTimes(NamedTuple):
    """Times of the points of one sweep: (N,) [s] from the earliest on, the earliest [s], and if that is a clock's."""

    since: NDArray[np.float64]
    earliest: float
    of_clock: bool


def sweep_times(raw: NDArray[Any], unit: float | None, where: Path | str) -> SweepTimes | None:
    """Return the times of points; None where they are of no sweep.

    A time that is no number, or far from all others, is wrong: its point gets a time between those of the points before
    and after it. Counters of 32 bits and clocks of an hour may begin anew within the sweep.

    Parameters
    ----------
    raw : (N,) numbers
    unit : float, optional
        What they count in [s]. By default whole numbers count nanoseconds and others seconds, if they then last 10 s at
        most; else the unit by which they last 2 ms to 2 s; else the times are left out.
    where : Path or str
        The file's name, or what a message is, for messages.
    """
    # Subtract before whole numbers of 64 bits become floats, which cannot hold them.
    exact, usual = raw if raw.dtype.itemsize == 8 else raw.astype(np.float64), _usual_unit(raw)
    if _is_short(raw, unit or usual):
        since, count = (exact - exact.min()).astype(np.float64), unit or usual
        _note_unit(count, usual, float(since.max()) * count, unit is not None, where)
        return SweepTimes(since * count, float(raw.min()) * count, abs(float(raw.min()) * count) > _SWEEP)
    if np.count_nonzero(~np.isfinite(raw)) > _STRAYS * raw.size:
        check_whole(raw, "times", where)
        return None
    middle = _middle(raw)
    with np.errstate(invalid="ignore", over="ignore"):
        ticks = exact - exact.dtype.type(middle)
    ticks = (ticks.view(np.int64) if ticks.dtype == np.uint64 else ticks).astype(np.float64)
    for count, period, good in _readings(ticks, unit, usual):
        wrong = int(np.count_nonzero(~good))
        if wrong > _STRAYS * raw.size:
            continue
        read = _folded(ticks, period)
        since, earliest = read - read[good].min(), float(middle) + float(read[good].min())
        if period:
            earliest %= period
        elif not wrong:  # without the median there is one rounding less
            since, earliest = (exact - exact.min()).astype(np.float64), float(raw.min())
        if wrong:
            text = "%s: %d of %d times are no number or far from the others; their points get times of those around"
            notice(log, "wrong times", text, where, wrong, raw.size)
            numbers = np.arange(raw.size)
            since = np.interp(numbers, numbers[good], since[good])
        _note_unit(count, usual, float(since.max()) * count, unit is not None, where)
        return SweepTimes(since * count, earliest * count, bool(period) or abs(earliest * count) > _SWEEP)
    notice(
        log, "times of no sweep",
        "%s: its times are of no sweep in s, ms, us or ns (they last %.3g s if they count in %g s, %s), and left out; "
        "give as time_unit [s] what they count in: 1e-9 for nanoseconds, 1 to take seconds as they are",
        where, float(np.ptp(ticks[np.isfinite(ticks)])) * (unit or usual), unit or usual, raw.dtype,
    )  # fmt: skip
    return None


def _usual_unit(raw: NDArray[Any]) -> float:
    """Return what times usually count in [s]: whole numbers nanoseconds, others seconds."""
    return 1e-9 if raw.dtype.kind in "iu" else 1.0


def _is_short(raw: NDArray[Any], unit: float) -> bool:
    """Return whether all times are numbers that lie within a second."""
    first, last = raw.min(), raw.max()
    return bool(np.isfinite(first) and np.isfinite(last) and (float(last) - float(first)) * unit <= 1.0)


def _middle(raw: NDArray[Any]) -> Any:
    """Return the median of the numbers, which is one of them."""
    known = raw[np.isfinite(raw)]
    return np.partition(known, known.size // 2)[known.size // 2] if known.size else 0


def _folded(ticks: NDArray[np.float64], period: float) -> NDArray[np.float64]:
    """Return times of a clock that begins anew after a period, 0 for never, as the nearest to 0."""
    return (ticks + period / 2) % period - period / 2 if period else ticks


def _readings(
    ticks: NDArray[np.float64], unit: float | None, usual: float
) -> Iterator[tuple[float, float, NDArray[np.bool_]]]:
    """Yield plausible readings of times from their median: unit [s], period of the clock [unit], which are good."""
    finite = np.isfinite(ticks)
    lasts = float(np.ptp(ticks[finite]))
    if unit is not None:
        yield unit, 0.0, finite
        return
    for count in (usual, *(one for one in _UNITS if one != usual)):
        folds = [] if lasts <= _COUNTER / 2 else [_COUNTER]
        for period in (*folds, 0.0, _HOUR / count):
            read, good = _folded(ticks, period), finite
            if not finite.all() or np.ptp(read) * count > 1.0:
                low, high = np.percentile(read[finite], (25, 75))
                good = finite & (np.abs(read) <= max(_STRAY[0] / count, _STRAY[1] * (high - low)))
            length = float(np.ptp(read[good])) * count
            known = count == usual and not period
            fits = length <= _SWEEP if known else _USUAL[0] <= length < _USUAL[1]
            if fits and (not period or length <= period * count / 4):
                yield count, period, good


def _note_unit(count: float, usual: float, lasts: float, given: bool, where: Path | str) -> None:
    """Log a unit that is a guess."""
    if given:
        return
    if count != usual:
        text = "%s: its times are taken to count in %g s, so that they last %.3g s; time_unit sets the unit"
        notice(log, "unit of times", text, where, count, lasts)
    elif count < 1.0 and 0.0 < lasts < _FLASH:
        text = "%s: its times last %.3g s if they count nanoseconds; if not, give time_unit (1e-6: microseconds)"
        notice(log, "short times", text, where, lasts)


def unknown_as_nan(raw: NDArray[Any] | None, what: str, path: Path | str) -> NDArray[np.float32] | None:
    """Return a column as float32 in which what is no number is NaN."""
    if raw is None or np.isfinite(raw).all():
        return raw if raw is None else raw.astype(np.float32, copy=False)
    text = "%s: %d of %d points have %s that are no number, and count as unknown"
    notice(log, f"unknown {what}", text, path, np.count_nonzero(~np.isfinite(raw)), raw.size, what, level=logging.INFO)
    return np.where(np.isfinite(raw), raw, np.nan).astype(np.float32)


def check_whole(raw: NDArray[Any] | None, what: str, path: Path | str) -> NDArray[Any] | None:
    """Leave a column out that is not known of every point: there is no number for the unknown."""
    if raw is None or np.isfinite(raw).all():
        return raw
    text = "%s: %d of %d points have %s that are no number; all %s are left out"
    notice(log, f"unknown {what}", text, path, np.count_nonzero(~np.isfinite(raw)), raw.size, what, what)
    return None
