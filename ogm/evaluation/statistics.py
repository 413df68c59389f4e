"""Statistics over frames: bootstrap intervals of means and ratios, and paired comparisons of two methods."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

__all__ = ["MIN_SAMPLES", "Comparison", "Interval", "bootstrap_mean", "bootstrap_ratio", "compare_paired"]

Groups = Sequence[str] | NDArray | None
RESAMPLES = 2000
LEVEL = 0.95
MIN_SAMPLES = 5  # frames or drives that a bootstrap interval needs
TIE = 1e-9  # values nearer than this, relative to the larger one, are equal


class Interval(NamedTuple):
    """A value and the interval that holds it with 95 % confidence."""

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
        Of Wilcoxon's signed rank test, two-sided, that the differences lie around 0; ties are left out. Frames
        count as independent, see `bootstrap_mean`. NaN if all frames are ties.
    """

    frames: int
    wins: int
    ties: int
    losses: int
    difference: Interval
    ratio: Interval
    p: float


def compare_paired(
    first: ArrayLike, second: ArrayLike, better: str, rng: Generator, resamples: int = RESAMPLES, groups: Groups = None
) -> Comparison:
    """Compare two methods frame by frame.

    Parameters
    ----------
    first, second : (frames,) float array
        A metric of both on the same frames; NaN where a frame has no value.
    better : {"lower", "higher"}
        Which values are better.
    rng : numpy.random.Generator
        Draws the frames of the bootstrap.
    resamples : int
    groups : sequence of str, optional
        The drive of every frame, see `bootstrap_mean`.

    Returns
    -------
    Comparison
        With NaN intervals if no frame has both values.
    """
    from scipy.stats import wilcoxon  # doubles the time of the import

    if better not in ("lower", "higher"):
        raise ValueError(f'better must be "lower" or "higher", got {better!r}')
    a, b, kept = _both(first, second, groups)
    gain = b - a if better == "lower" else a - b
    ties = np.abs(gain) <= TIE * np.maximum(np.abs(a), np.abs(b))
    return Comparison(
        frames=len(a),
        wins=int((~ties & (gain > 0)).sum()),
        ties=int(ties.sum()),
        losses=int((~ties & (gain < 0)).sum()),
        difference=bootstrap_mean(a - b, rng, resamples, kept),
        ratio=bootstrap_ratio(a, b, rng, resamples, kept),
        p=float(wilcoxon(gain[~ties]).pvalue) if not ties.all() else float("nan"),
    )


def bootstrap_mean(values: ArrayLike, rng: Generator, resamples: int = RESAMPLES, groups: Groups = None) -> Interval:
    """Return the mean over frames with its 95 % interval: percentiles over frames drawn with replacement.

    Without groups, frames count as independent of each other. Those of one drive are not quite, so that the
    interval is rather too narrow than too wide; with groups, whole drives are drawn.

    Parameters
    ----------
    values : (frames,) float array
        NaN is left out.
    rng : numpy.random.Generator
    resamples : int
    groups : sequence of str, optional
        The drive of every frame: drives are drawn with all their frames. Needs some ten drives to mean much.
    """
    kept = np.asarray(values, np.float64)
    return bootstrap_ratio(kept, np.where(np.isnan(kept), np.nan, 1.0), rng, resamples, groups)


def bootstrap_ratio(
    first: ArrayLike, second: ArrayLike, rng: Generator, resamples: int = RESAMPLES, groups: Groups = None
) -> Interval:
    """Return the ratio of two means over the same frames, with its 95 % interval, see `bootstrap_mean`.

    Parameters
    ----------
    first, second : (frames,) float array
        A frame that lacks one of them (NaN) is left out.
    rng : numpy.random.Generator
    resamples : int
    groups : sequence of str, optional
        The drive of every frame, see `bootstrap_mean`.

    Returns
    -------
    Interval
        NaN if no frame is left, or where the second mean is 0; without limits if fewer than five frames, or
        drives, are left: so few do not show the spread.
    """
    if resamples < 1:
        raise ValueError(f"resamples must be at least 1, got {resamples}")
    a, b, kept = _both(first, second, groups)
    if not len(a):
        return Interval(np.nan, np.nan, np.nan)
    value = float(_ratio(a.mean(), b.mean()))
    if kept is not None:  # sums over drives: the ratio of means over their frames is that of their sums
        _, drive = np.unique(kept, return_inverse=True)
        a, b = (np.bincount(drive, one).astype(np.float64) for one in (a, b))
    drawn = rng.integers(len(a), size=(resamples, len(a)))
    ratios = _ratio(a[drawn].mean(axis=1), b[drawn].mean(axis=1))
    if len(a) < MIN_SAMPLES or np.isnan(ratios).any():
        return Interval(value, np.nan, np.nan)
    return Interval(value, *np.quantile(ratios, [(1 - LEVEL) / 2, 1 - (1 - LEVEL) / 2]).tolist())


def _both(first: ArrayLike, second: ArrayLike, groups: Groups) -> tuple[NDArray, NDArray, NDArray | None]:
    """Return the values and groups of the frames that have both values."""
    a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
    if a.ndim != 1 or a.shape != b.shape:
        raise ValueError(f"both methods need one value per frame, got shapes {a.shape} and {b.shape}")
    if groups is not None and len(groups) != len(a):
        raise ValueError(f"groups must name the drive of each of {len(a)} frames, got {len(groups)}")
    kept = ~(np.isnan(a) | np.isnan(b))
    return a[kept], b[kept], None if groups is None else np.asarray(groups)[kept]


def _ratio(a: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    b = np.asarray(b, np.float64)
    return np.asarray(a) / np.where(b == 0, np.nan, b)
