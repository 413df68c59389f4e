"""Statistics over frames: intervals of means and ratios, and paired comparisons of two methods.

Frames of one drive are alike, so that drives are what is counted: the spread of a mean is estimated by taking one
drive away at a time (jackknife), and its interval is Student's. One long drive is cut into parts that take the place
of drives; the interval then holds for this drive alone. ``benchmarks/interval_coverage.py`` measures how often
intervals hold the truth.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.extras import import_extra

Drives = Sequence[str] | NDArray[Any] | None
LEVEL = 0.95
MIN_DRIVES = 4  # that an interval needs, and the parts that one drive is cut into
PART = 25  # frames: parts of fewer are alike, as scans within a drive are
TIE = 1e-9  # values nearer than this, relative to the larger one, are equal


class Interval(NamedTuple):
    """A value and the interval that holds it with 95 % confidence; NaN limits where drives are too few."""

    value: float
    low: float
    high: float


class Comparison(NamedTuple):
    """Two methods on the same frames.

    Attributes
    ----------
    frames : int
        Frames in which both have a value; the others are left out of everything here.
    wins, ties, losses : int
        Frames in which the first is better, equal, worse.
    difference : Interval
        Mean of first minus second.
    ratio : Interval
        Mean of the first over mean of the second.
    p : float
        Of Student's t test over drives, two-sided, that the mean difference is 0: below 0.05 where the interval of the
        difference leaves out 0. NaN where that has no limits, or all frames are ties.
    """

    frames: int
    wins: int
    ties: int
    losses: int
    difference: Interval
    ratio: Interval
    p: float


def compare_paired(first: ArrayLike, second: ArrayLike, better: str, drives: Drives = None) -> Comparison:
    """Compare two methods frame by frame.

    Parameters
    ----------
    first, second : (frames,) float array
        A metric of both on the same frames; NaN where a frame has no value.
    better : {"lower", "higher"}
        Which values are better.
    drives : sequence of str, optional
        The drive of every frame, see `mean_interval`.

    Returns
    -------
    Comparison
        With NaN intervals if no frame has both values.
    """
    if better not in ("lower", "higher"):
        raise ValueError(f'better must be "lower" or "higher", got {better!r}')
    a, b, groups = _both(first, second, drives)
    gain = b - a if better == "lower" else a - b
    ties = np.abs(gain) <= TIE * np.maximum(np.abs(a), np.abs(b))
    difference, p = _student(a - b, np.ones(len(a)), groups, _PLAIN)
    return Comparison(
        frames=len(a),
        wins=int((~ties & (gain > 0)).sum()),
        ties=int(ties.sum()),
        losses=int((~ties & (gain < 0)).sum()),
        difference=difference,
        ratio=_student(a, b, groups, _scale_of(a, b))[0],
        p=p if not ties.all() else float("nan"),
    )


def mean_interval(values: ArrayLike, drives: Drives = None) -> Interval:
    """Return the mean over frames with its 95 % interval: Student's t of the jackknife over drives.

    It is taken on the scale of log-odds where all values lie in [0, 1], of logarithms where none is negative, as shares
    and errors spread unevenly; so differences belong to `compare_paired`. Drives of many frames count more: the degrees
    of freedom are those of Kish's effective number of drives, less one.

    Parameters
    ----------
    values : (frames,) float array
        NaN is left out.
    drives : sequence of str, optional
        The drive of every frame, in order. Without it, frames count as independent. One drive of 100 frames or more is
        cut into four parts: the interval then holds for this drive, not for others.

    Returns
    -------
    Interval
        NaN if no frame is left; without limits for fewer than four drives, one drive of fewer than 100 frames, or where
        the value rests on a single drive.
    """
    kept = np.asarray(values, np.float64)
    return ratio_interval(kept, np.where(np.isnan(kept), np.nan, 1.0), drives)


def ratio_interval(first: ArrayLike, second: ArrayLike, drives: Drives = None) -> Interval:
    """Return the ratio of two means over the same frames, with its 95 % interval, see `mean_interval`.

    Parameters
    ----------
    first, second : (frames,) float array
        A frame that lacks one of them (NaN) is left out.
    drives : sequence of str, optional

    Returns
    -------
    Interval
        As of `mean_interval`; NaN where the second mean is 0.
    """
    a, b, groups = _both(first, second, drives)
    return _student(a, b, groups, _scale_of(a, b))[0]


def drives_of(frames: Sequence[Any]) -> list[str]:
    """Return the drive of every `FrameInfo`; one that stands alone is its own."""
    return [frame.sequence or f"frame {k}" for k, frame in enumerate(frames)]


def has_parts(drives: Sequence[str]) -> bool:
    """Return whether the frames are of one drive that is long enough to be cut into parts."""
    return len(set(drives)) == 1 and len(drives) >= MIN_DRIVES * PART


class _Scale(NamedTuple):
    there: Callable[[NDArray[Any]], NDArray[Any]]
    back: Callable[[NDArray[Any]], NDArray[Any]]


_PLAIN = _Scale(np.asarray, np.asarray)
_LOG = _Scale(np.log, np.exp)
_LOG_ODDS = _Scale(lambda p: np.log(p / (1 - p)), lambda z: 1 / (1 + np.exp(-z)))


def _scale_of(a: NDArray[Any], b: NDArray[Any]) -> _Scale:
    """Return the scale on which the spread of a ratio is even."""
    if (a < 0).any() or (b < 0).any():
        return _PLAIN
    return _LOG_ODDS if (b == 1).all() and (a <= 1).all() else _LOG


def _student(a: NDArray[Any], b: NDArray[Any], groups: NDArray[Any], scale: _Scale) -> tuple[Interval, float]:
    """Return sum(a) / sum(b) with its interval over groups, and the p value that it is 0 on the scale."""
    special = import_extra("scipy.special", "evaluate")

    nothing = float("nan")
    if not len(a) or b.sum() == 0:
        return Interval(nothing, nothing, nothing), nothing
    value = a.sum() / b.sum()
    frames, first, second = (np.bincount(groups, one) for one in (None, a, b))
    count, effective = len(frames), len(a) ** 2 / (frames**2).sum()
    if count < MIN_DRIVES or effective < 2:
        return Interval(float(value), nothing, nothing), nothing
    with np.errstate(divide="ignore", invalid="ignore"):  # on the scale; also of 0 / 0 and log 0
        without = (first.sum() - first) / (second.sum() - second)  # one group each
        if np.allclose(without, value, rtol=1e-12, atol=0):  # no spread
            return Interval(*[float(value)] * 3), 0.0 if value else nothing
        middle, each = scale.there(value), scale.there(without)
        error = np.sqrt((count - 1) / count * ((each - each.mean()) ** 2).sum())
        reach = special.stdtrit(effective - 1, 0.5 + LEVEL / 2) * error
        low, high = scale.back(np.array([middle - reach, middle + reach]))
        p = 2 * special.stdtr(effective - 1, -abs(middle) / error)
    return Interval(float(value), float(low), float(high)), float(p)


def _both(first: ArrayLike, second: ArrayLike, drives: Drives) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return the values of the frames that have both, and the number of the group of each."""
    a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
    if a.ndim != 1 or a.shape != b.shape:
        raise ValueError(f"both methods need one value per frame, got shapes {a.shape} and {b.shape}")
    if drives is not None and len(drives) != len(a):
        raise ValueError(f"drives must name the drive of each of {len(a)} frames, got {len(drives)}")
    kept = ~(np.isnan(a) | np.isnan(b))
    count = np.count_nonzero(kept)
    if drives is None:
        return a[kept], b[kept], np.arange(count)
    names = np.asarray(drives)[kept]
    if has_parts(names.tolist()):
        return a[kept], b[kept], np.arange(count) * MIN_DRIVES // count
    return a[kept], b[kept], np.unique(names, return_inverse=True)[1]
