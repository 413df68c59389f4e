"""Intensities, rings and times of a file's points, brought to known units."""

import logging
import re
from pathlib import Path

import numpy as np

from ogm.storage.files import OgmError

log: logging.Logger = logging.getLogger(__name__)

_SWEEP = 10.0  # [s] longer than any sweep: times that begin later are a clock's
_FLASH = 1e-3  # [s] shorter than a sweep
_UNITS = (1.0, 1e-3, 1e-6, 1e-9)  # [s] that clocks count in


def scale_intensities(
    raw: np.ndarray, chosen: float | None, of_format: float | None, path: Path | str
) -> tuple[np.ndarray, float]:
    """Return intensities in [0, 1], and the value that became 1; what is no number becomes 0.

    Parameters
    ----------
    raw : (N,) numbers
    chosen : float, optional
        The value that means 1, where the user gave it; else `of_format`, else it is guessed from `raw`.
    of_format : float, optional
    path : Path or str
        The file's name, or what a message is, for errors.
    """
    known = np.isfinite(raw)
    if not known.all():
        log.info("%s: %d of %d intensities are no number and become 0", path, np.sum(~known), raw.size)
        raw = np.where(known, raw, 0)
    low, high = float(raw.min(initial=0)), float(raw.max(initial=0))
    if low < 0.0:
        raise OgmError(f"{path} has intensities down to {low:g}, wanted none below 0: is its name right?")
    if chosen is not None:
        if high > chosen:
            log.info("%s: %d intensities above %g count as 1", path, np.count_nonzero(raw > chosen), chosen)
        return np.minimum(raw / chosen, 1.0), float(chosen)
    if of_format is not None:
        scale = of_format
    elif raw.dtype in (np.uint8, np.uint16):
        scale = float(np.iinfo(raw.dtype).max)
    else:
        scale = 1.0 if high <= 1.0 else 255.0
        if 1.0 < high <= scale:
            log.info(
                "%s: intensities up to %g are divided by 255; give intensity_max if they mean something else, "
                "or if those of another scan are not divided",
                path, high,
            )  # fmt: skip
    if high > scale:
        raise OgmError(
            f"{path} has intensities up to {high:g}, wanted at most {scale:g}: give as intensity_max the one "
            "that means 1, if the file is what its name promises"
        )
    return raw / scale, scale


def check_rings(raw: np.ndarray | None, path: Path | str) -> np.ndarray | None:
    """Return rings as uint16; None where there are none, or one of them is no number."""
    raw = check_whole(raw, "rings", path)
    if raw is None or raw.dtype in (np.uint8, np.uint16):
        return raw if raw is None else raw.astype(np.uint16, copy=False)
    ring = np.clip(raw.astype(np.float64), 0, 2**16 - 1).astype(np.uint16)
    if not np.array_equal(ring, raw):
        raise OgmError(
            f"{path} has rings from {raw.min():g} to {raw.max():g}, wanted whole numbers from 0 to 65535: "
            "is its name right?"
        )
    return ring


def split_times(raw: np.ndarray | None, unit: float | None, path: Path) -> tuple[np.ndarray | None, float | None]:
    """Return the times of the points, counted from the stamp, and the stamp [s]; None where there are none.

    Parameters
    ----------
    raw : (N,) numbers, optional
    unit : float, optional
        What they count in [s]; by default whole numbers count nanoseconds, others seconds.
    path : Path
        The file's name, which may hold the stamp.
    """
    raw = check_whole(raw, "times", path)
    digits = re.search(r"(?<!\d)(\d{16}|\d{18,19})$", path.name.split(".")[0])
    stamp = None if digits is None else int(digits[1]) * (1e-6 if len(digits[1]) == 16 else 1e-9)
    if raw is None or not raw.size:
        return raw if raw is None else raw.astype(np.float64), stamp
    unit = _known_unit(raw, unit, path)
    earliest = float(raw.min()) * unit
    if abs(earliest) > _SWEEP:
        return _since_earliest(raw) * unit, earliest
    return raw.astype(np.float64) * unit, stamp


def times_from_stamp(
    raw: np.ndarray | None, unit: float | None, where: str, stamp: float
) -> tuple[np.ndarray | None, float]:
    """Return the times of a message's points, counted from its stamp, and the stamp [s].

    Times that are nearer to the stamp than to 0 are of its clock: the stamp is subtracted. Such times show their
    unit, too. Times of another clock, which begin over 10 s from both, are counted from the earliest; the
    stamp is then the earliest only where the message has none (0). All others count from the stamp already.

    Parameters
    ----------
    raw : (N,) numbers, optional
    unit : float, optional
        What they count in [s]; by default seconds, milliseconds, microseconds or nanoseconds if one of them
        gives the stamp, within 10 s; else whole numbers count nanoseconds, others seconds.
    where : str
        What the message is, for errors.
    stamp : float
        Of the header [s]; 0 where it was not set.
    """
    raw = check_whole(raw, "times", where)
    if raw is None or not raw.size:
        return raw if raw is None else raw.astype(np.float64), stamp
    first = float(raw.min())
    if unit is None and abs(stamp) > _SWEEP:
        unit = next((one for one in _UNITS if abs(first * one - stamp) <= _SWEEP), None)
    unit = _known_unit(raw, unit, where)
    earliest = first * unit
    if abs(earliest - stamp) < min(abs(earliest), _SWEEP):
        return _since_earliest(raw) * unit + (earliest - stamp), stamp
    if abs(earliest) > _SWEEP:
        log.info("%s: its points have times of another clock than its stamp; they count from the earliest", where)
        return _since_earliest(raw) * unit, stamp or earliest
    return raw.astype(np.float64) * unit, stamp


def _known_unit(raw: np.ndarray, unit: float | None, path: Path | str) -> float:
    """Return what times count in [s]; raise where it is not given and they last too long for the usual one."""
    if unit is not None:
        return unit
    guess = 1e-9 if raw.dtype.kind in "iu" else 1.0
    lasts = float(_since_earliest(raw).max()) * guess
    if lasts > _SWEEP:
        raise OgmError(
            f"{path} has times that last {lasts:.3g} s if they count in {guess:g} s ({raw.dtype}), "
            f"wanted at most {_SWEEP:g} s for one sweep: give as time_unit [s] what they count in, 1e-9 for "
            "nanoseconds, 1e-6 for microseconds, 1e-3 for milliseconds (1 to take seconds as they are)"
        )
    if guess < 1.0 and 0.0 < lasts < _FLASH:
        log.warning(
            "%s: its times last %.3g s if they count nanoseconds; if not, give time_unit (1e-6: microseconds)",
            path, lasts,
        )  # fmt: skip
    return guess


def _since_earliest(raw: np.ndarray) -> np.ndarray:
    """Subtract the earliest time before whole numbers of 64 bits become floats, which cannot hold them."""
    exact = raw if raw.dtype.itemsize == 8 else raw.astype(np.float64)
    return np.asarray((exact - exact.min()).astype(np.float64))


def check_whole(raw: np.ndarray | None, what: str, path: Path | str) -> np.ndarray | None:
    """Leave a column out that is not known of every point: there is no number for the unknown."""
    if raw is None or np.isfinite(raw).all():
        return raw
    log.warning(
        "%s: %d of %d points have %s that are no number; all %s are left out",
        path, np.count_nonzero(~np.isfinite(raw)), raw.size, what, what,
    )  # fmt: skip
    return None
