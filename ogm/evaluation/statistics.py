"""Statistics over frames: intervals of means and ratios, and paired comparisons of two methods.

Frames of a drive are alike, so that drives are the independent units. The spread of a mean is estimated by the
jackknife, without one drive at a time, and its interval is Student's. A single long drive is cut into parts that
replace the drives; the interval is then valid only for this drive. ``benchmarks/interval_coverage.py`` measures the
coverage of the intervals.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.extras import import_extra

Drives = Sequence[str] | NDArray[Any] | None
LEVEL = 0.95
MIN_DRIVES = 4  # for an interval; also the number of parts of a single drive
PART = 25  # least number of frames in a part: shorter parts are as alike as scans within a drive
TIE = 1e-9  # greatest difference of equal values, relative to the larger value


class Interval(NamedTuple):
    """A value with its 95 % confidence interval; limits are NaN for too few drives."""

    value: float
    low: float
    high: float


class Comparison(NamedTuple):
    """Comparison of two methods on the same frames.

    Attributes
    ----------
    frames : int
        Number of frames with a value of both methods; other frames are left out.
    wins, ties, losses : int
        Numbers of frames in which the first method is better, equal, worse.
    difference : Interval
        Mean of first minus second.
    ratio : Interval
        Mean of the first over mean of the second.
    p : float
        p value of Student's two-sided t test over drives for a mean difference of 0: below 0.05 if the interval of the
        difference excludes 0. NaN if that interval has no limits, or all frames are ties.
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
        Values of a metric on the same frames; NaN in frames without a value.
    better : {"lower", "higher"}
        Direction of better values.
    drives : sequence of str, optional
        Drive of each frame, see `mean_interval`.

    Returns
    -------
    Comparison
        Intervals are NaN if no frame has both values.
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

    As shares and errors have skewed distributions, values in [0, 1] are transformed to log-odds, and other non-negative
    values to logarithms. Use `compare_paired` for differences. Drives with many frames have more weight: the degrees of
    freedom are Kish's effective number of drives minus one.

    Parameters
    ----------
    values : (frames,) float array
        NaN is left out.
    drives : sequence of str, optional
        Drive of each frame, in order. By default frames are independent. A single drive of 100 frames or more is cut
        into four parts; its interval is not valid for other drives.

    Returns
    -------
    Interval
        NaN without frames. Limits are NaN for fewer than four drives, a single drive of fewer than 100 frames, or a
        value that depends on a single drive.
    """
    kept = np.asarray(values, np.float64)
    return ratio_interval(kept, np.where(np.isnan(kept), np.nan, 1.0), drives)


def ratio_interval(first: ArrayLike, second: ArrayLike, drives: Drives = None) -> Interval:
    """Return the ratio of two means over the same frames, with its 95 % interval, see `mean_interval`.

    Parameters
    ----------
    first, second : (frames,) float array
        Frames with NaN in either are left out.
    drives : sequence of str, optional

    Returns
    -------
    Interval
        See `mean_interval`; NaN if the second mean is 0.
    """
    a, b, groups = _both(first, second, drives)
    return _student(a, b, groups, _scale_of(a, b))[0]


def drives_of(frames: Sequence[Any]) -> list[str]:
    """Return the drive of each `FrameInfo`; a frame without a sequence is its own drive."""
    return [frame.sequence or f"frame {k}" for k, frame in enumerate(frames)]


def has_parts(drives: Sequence[str]) -> bool:
    """Return whether the frames are of a single drive, long enough to be cut into parts."""
    return len(set(drives)) == 1 and len(drives) >= MIN_DRIVES * PART


class _Scale(NamedTuple):
    there: Callable[[NDArray[Any]], NDArray[Any]]
    back: Callable[[NDArray[Any]], NDArray[Any]]


_PLAIN = _Scale(np.asarray, np.asarray)
_LOG = _Scale(np.log, np.exp)
_LOG_ODDS = _Scale(lambda p: np.log(p / (1 - p)), lambda z: 1 / (1 + np.exp(-z)))


def _scale_of(a: NDArray[Any], b: NDArray[Any]) -> _Scale:
    """Return the scale on which a ratio has a symmetric distribution."""
    if (a < 0).any() or (b < 0).any():
        return _PLAIN
    return _LOG_ODDS if (b == 1).all() and (a <= 1).all() else _LOG


def _student(a: NDArray[Any], b: NDArray[Any], groups: NDArray[Any], scale: _Scale) -> tuple[Interval, float]:
    """Return sum(a) / sum(b) with its interval over groups, and the p value that it is 0 on the scale."""
    special = import_extra("scipy.special", "evaluate")

    nan = float("nan")
    if not len(a) or b.sum() == 0:
        return Interval(nan, nan, nan), nan
    value = a.sum() / b.sum()
    frames, first, second = (np.bincount(groups, weights) for weights in (None, a, b))
    count, effective = len(frames), len(a) ** 2 / (frames**2).sum()
    if count < MIN_DRIVES or effective < 2:
        return Interval(float(value), nan, nan), nan
    with np.errstate(divide="ignore", invalid="ignore"):  # 0 / 0 and log 0
        without = (first.sum() - first) / (second.sum() - second)  # one group each
        if np.allclose(without, value, rtol=1e-12, atol=0):  # no spread
            return Interval(*[float(value)] * 3), 0.0 if value else nan
        middle, each = scale.there(value), scale.there(without)
        error = np.sqrt((count - 1) / count * ((each - each.mean()) ** 2).sum())
        reach = special.stdtrit(effective - 1, 0.5 + LEVEL / 2) * error
        low, high = scale.back(np.array([middle - reach, middle + reach]))
        p = 2 * special.stdtr(effective - 1, -abs(middle) / error)
    return Interval(float(value), float(low), float(high)), float(p)


def _both(first: ArrayLike, second: ArrayLike, drives: Drives) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return the values of frames with both, and the group of each frame."""
    a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
    if a.ndim != 1 or a.shape != b.shape:
        raise ValueError(f"both methods need one value per frame, got shapes {a.shape} and {b.shape}")
    if drives is not None and len(drives) != len(a):
        raise ValueError(f"drives must have a name for each of {len(a)} frames, got {len(drives)}")
    kept = ~(np.isnan(a) | np.isnan(b))
    count = np.count_nonzero(kept)
    if drives is None:
        return a[kept], b[kept], np.arange(count)
    names = np.asarray(drives)[kept]
    if has_parts(names.tolist()):
        return a[kept], b[kept], np.arange(count) * MIN_DRIVES // count
    return a[kept], b[kept], np.unique(names, return_inverse=True)[1]
