"""Intensities, rings and times of points, converted from a file's units to known units."""

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
"""Intensities of a file that become 0 and 1."""
IntensityScale = float | IntensityRange | Callable[[IntensityRange], IntensityRange]
"""The intensity that becomes 1, a pair that becomes 0 and 1, or a function from the range of one scan to this pair."""

_SCALES = (1.0, 255.0, 65535.0)  # full-scale intensities of reflectances, bytes and photon counts
_SAMPLE = 4096  # approximate number of intensities used for quantiles
_SWEEP = 10.0  # [s] longer than any sweep: times that begin later belong to a clock
_FLASH = 1e-3  # [s] shorter than a sweep
_USUAL = (2e-3, 2.0)  # [s] duration of a sweep; three decades, so that only one unit fits
_UNITS = (1.0, 1e-3, 1e-6, 1e-9)  # [s] units of clocks
_COUNTER, _HOUR = 2.0**32, 3600.0  # ticks of a 32-bit counter, and [s] after which clocks of sensors wrap around
_STRAY = (0.5, 4.0)  # [s] and interquartile ranges from the median; a time beyond both is wrong
_STRAYS = 0.25  # largest share of wrong times at which the others are used


def intensity_range(raw: NDArray[Any], least: float | None = None) -> IntensityRange:
    """Return the intensities that become 0 and 1, by type and values.

    Unsigned 8-bit and 16-bit integers have the range of their type. Otherwise 0 becomes 0, and the smallest of 1, 255
    and 65535 that covers 99 % of the intensities becomes 1; if none does, the 99 % quantile does. If most intensities
    are negative, they are decibels: the 1 % and 99 % quantiles become 0 and 1.

    Parameters
    ----------
    raw : (N,) numbers
    least : float, optional
        Smallest full-scale intensity, defined by the format. Default 1.
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
    """Return intensities in [0, 1], and the value that became 1; NaN and infinite intensities become 0.

    Parameters
    ----------
    raw : (N,) numbers
    given : IntensityScale, optional
        Scale of the intensities; a function is used if the scan's own range is not 0 to 1. Default: the scan's range.
    least : float, optional
        See `intensity_range`.
    path : Path or str
        Name of the file or message, for log messages.
    """
    if raw.size and not np.isfinite([raw.min(), raw.max()]).all():
        known = np.isfinite(raw)
        text = "%s: %d of %d intensities are NaN or infinite and become 0"
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
        text = "%s: %d of %d intensities lie outside of %g ... %g and become 0 or 1"
        notice(log, "intensities beyond", text, path, beyond, raw.size, low, high, level=logging.INFO)
        scaled = np.clip(scaled, 0.0, 1.0)
    return scaled, float(high)


def note_range(found: IntensityRange, where: Path | str) -> None:
    """Log the range assumed for intensities without a stated scale."""
    low, high = found
    if low < 0:
        text = "%s: most intensities are negative (decibels?): %g ... %g become 0 ... 1"
        notice(log, "decibels", text, where, low, high)
    elif high > 1.0:
        text = "%s: intensities are divided by %g; give intensity_max for another scale"
        notice(log, "intensity scale", text, where, high, level=logging.INFO if high <= _SCALES[1] else logging.WARNING)


def check_rings(raw: NDArray[Any] | None, path: Path | str) -> NDArray[np.uint16] | None:
    """Return rings as uint16; None if missing, or if one of them is no integer from 0 to 65535."""
    raw = check_whole(raw, "rings", path)
    if raw is None or raw.dtype in (np.uint8, np.uint16):
        return raw if raw is None else raw.astype(np.uint16, copy=False)
    ring = np.clip(raw.astype(np.float64), 0, 2**16 - 1).astype(np.uint16)
    if not np.array_equal(ring, raw):
        text = "%s: rings from %g to %g are not all integers from 0 to 65535; all rings are left out"
        notice(log, "wrong rings", text, path, raw.min(), raw.max())
        return None
    return ring


def split_times(
    raw: NDArray[Any] | None, unit: float | None, path: Path
) -> tuple[NDArray[np.float64] | None, float | None]:
    """Return the times of the points, counted from the stamp, and the stamp [s]; None if missing.

    Parameters
    ----------
    raw : (N,) numbers, optional
    unit : float, optional
        Unit of the times [s]; by default see `sweep_times`.
    path : Path
        File name, which may contain the stamp.
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

    Times nearer to the stamp than to 0 belong to its clock: the stamp is subtracted, and gives their unit. Times that
    begin more than 10 s from both belong to another clock and are counted from the earliest, which replaces a missing
    stamp (0). All other times already count from the stamp.

    Parameters
    ----------
    raw : (N,) numbers, optional
    unit : float, optional
        Unit of the times [s]. Default: seconds, milliseconds, microseconds or nanoseconds if one of them gives the
        stamp within 10 s; else see `sweep_times`.
    where : str
        Name of the message, for log messages.
    stamp : float
        Stamp of the header [s]; 0 if not set.
    """
    if raw is None or not raw.size:
        return raw if raw is None else raw.astype(np.float64), stamp
    if unit is None and abs(stamp) > _SWEEP:
        sample = float(raw.min() if _is_short(raw, _usual_unit(raw)) else _middle(raw))
        unit = next((tick for tick in _UNITS if abs(sample * tick - stamp) <= _SWEEP), None)
    if (found := sweep_times(raw, unit, where)) is None:
        return None, stamp
    since, earliest, of_clock = found
    if abs(earliest - stamp) < min(abs(earliest), _SWEEP):
        return since + (earliest - stamp), stamp
    if of_clock:
        log.info("%s: its points and its stamp have different clocks; times count from the earliest point", where)
        return since, stamp or earliest
    return since + earliest, stamp


class SweepTimes(NamedTuple):
    """Times (N,) of a sweep from its earliest on [s], the earliest [s], and whether it belongs to a clock."""

    since: NDArray[np.float64]
    earliest: float
    of_clock: bool


def sweep_times(raw: NDArray[Any], unit: float | None, where: Path | str) -> SweepTimes | None:
    """Return the times of points; None if they do not fit a sweep.

    A time that is NaN, infinite, or far from the others is wrong: it is interpolated between the neighbouring points.
    Counters of 32 bits and clocks of an hour may wrap around within the sweep.

    Parameters
    ----------
    raw : (N,) numbers
    unit : float, optional
        Unit of the times [s]. Default: nanoseconds for integers, seconds for floats, if the sweep then lasts at most
        10 s; else the unit by which it lasts 2 ms to 2 s; else the times are left out.
    where : Path or str
        Name of the file or message, for log messages.
    """
    # Subtract before 64-bit integers become floats, which cannot represent them.
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
            text = "%s: %d of %d times are NaN or far from the others; they are interpolated between neighbours"
            notice(log, "wrong times", text, where, wrong, raw.size)
            numbers = np.arange(raw.size)
            since = np.interp(numbers, numbers[good], since[good])
        _note_unit(count, usual, float(since.max()) * count, unit is not None, where)
        return SweepTimes(since * count, earliest * count, bool(period) or abs(earliest * count) > _SWEEP)
    notice(
        log, "times of no sweep",
        "%s: its times fit no sweep in s, ms, us or ns (they last %.3g s in units of %g s, %s), and are left out; "
        "give their unit as time_unit [s]: 1e-9 for nanoseconds, 1 for seconds",
        where, float(np.ptp(ticks[np.isfinite(ticks)])) * (unit or usual), unit or usual, raw.dtype,
    )  # fmt: skip
    return None


def _usual_unit(raw: NDArray[Any]) -> float:
    """Return the usual unit of times [s]: nanoseconds for integers, seconds for floats."""
    return 1e-9 if raw.dtype.kind in "iu" else 1.0


def _is_short(raw: NDArray[Any], unit: float) -> bool:
    """Return whether all times are finite and lie within a second."""
    first, last = raw.min(), raw.max()
    return bool(np.isfinite(first) and np.isfinite(last) and (float(last) - float(first)) * unit <= 1.0)


def _middle(raw: NDArray[Any]) -> Any:
    """Return the upper median of the finite numbers."""
    known = raw[np.isfinite(raw)]
    return np.partition(known, known.size // 2)[known.size // 2] if known.size else 0


def _folded(ticks: NDArray[np.float64], period: float) -> NDArray[np.float64]:
    """Return times folded into half a clock period around 0; period 0 for a clock that never wraps."""
    return (ticks + period / 2) % period - period / 2 if period else ticks


def _readings(
    ticks: NDArray[np.float64], unit: float | None, usual: float
) -> Iterator[tuple[float, float, NDArray[np.bool_]]]:
    """Yield plausible readings of times from their median: unit [s], clock period [unit], mask of valid times."""
    finite = np.isfinite(ticks)
    lasts = float(np.ptp(ticks[finite]))
    if unit is not None:
        yield unit, 0.0, finite
        return
    for count in (usual, *(tick for tick in _UNITS if tick != usual)):
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
    """Log an assumed unit of times."""
    if given:
        return
    if count != usual:
        text = "%s: its times are taken in units of %g s, so that they last %.3g s; time_unit sets the unit"
        notice(log, "unit of times", text, where, count, lasts)
    elif count < 1.0 and 0.0 < lasts < _FLASH:
        text = "%s: its times last %.3g s as nanoseconds; if that is wrong, give time_unit (1e-6: microseconds)"
        notice(log, "short times", text, where, lasts)


def unknown_as_nan(raw: NDArray[Any] | None, quantity: str, path: Path | str) -> NDArray[np.float32] | None:
    """Return a column as float32, with NaN for all values that are not finite."""
    if raw is None:
        return None
    if unknown := int(np.count_nonzero(~np.isfinite(raw))):
        text = "%s: %d of %d points have %s that are NaN or infinite, and count as unknown"
        notice(log, f"unknown {quantity}", text, path, unknown, raw.size, quantity, level=logging.INFO)
        raw = np.where(np.isfinite(raw), raw, np.nan)
    return raw.astype(np.float32, copy=False)


def check_whole(raw: NDArray[Any] | None, quantity: str, path: Path | str) -> NDArray[Any] | None:
    """Return a column if it is finite for every point, else None: integers have no value for unknown."""
    if raw is None or np.isfinite(raw).all():
        return raw
    text = "%s: %d of %d points have %s that are NaN or infinite; all %s are left out"
    unknown = np.count_nonzero(~np.isfinite(raw))
    notice(log, f"unknown {quantity}", text, path, unknown, raw.size, quantity, quantity)
    return None
