"""Two models on the same frames: who wins how often, and how sure the mean difference is."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Interval", "Paired", "bootstrap_mean", "bootstrap_ratio", "paired"]

RESAMPLES = 2000
LEVEL = 0.95
TIE = 1e-9  # values nearer than this, relative to the larger one, are equal


class Interval(NamedTuple):
    """A value and the interval that holds it with 95 % confidence."""

    value: float
    low: float
    high: float


class Paired(NamedTuple):
    """What the comparison of two models on the same frames says.

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
    """

    frames: int
    wins: int
    ties: int
    losses: int
    difference: Interval
    ratio: Interval


def paired(
    first: ArrayLike, second: ArrayLike, better: str, rng: np.random.Generator, resamples: int = RESAMPLES
) -> Paired:
    """Compare two models frame by frame.

    Parameters
    ----------
    first, second : (frames,) float array
        A metric of both on the same frames; NaN where a frame has no value.
    better : {"lower", "higher"}
        Which value is the better one.
    rng : numpy.random.Generator
        Draws the frames of the bootstrap.
    resamples : int

    Returns
    -------
    Paired
        With NaN intervals if no frame has both values.
    """
    if better not in ("lower", "higher"):
        raise ValueError(f'better must be "lower" or "higher", got {better!r}')
    a, b = _both(first, second)
    gain = b - a if better == "lower" else a - b
    ties = np.abs(gain) <= TIE * np.maximum(np.abs(a), np.abs(b))
    return Paired(
        frames=len(a),
        wins=int((~ties & (gain > 0)).sum()),
        ties=int(ties.sum()),
        losses=int((~ties & (gain < 0)).sum()),
        difference=bootstrap_mean(a - b, rng, resamples),
        ratio=bootstrap_ratio(a, b, rng, resamples),
    )


def bootstrap_mean(values: ArrayLike, rng: np.random.Generator, resamples: int = RESAMPLES) -> Interval:
    """Return the mean over frames with its 95 % interval: percentiles over frames drawn with replacement.

    Frames count as independent of each other. Those of one drive are not quite, so that the interval is
    rather too narrow than too wide.

    Parameters
    ----------
    values : (frames,) float array
        NaN is left out.
    rng : numpy.random.Generator
    resamples : int
    """
    kept = np.asarray(values, np.float64)
    kept = kept[~np.isnan(kept)]
    return bootstrap_ratio(kept, np.ones_like(kept), rng, resamples)


def bootstrap_ratio(
    first: ArrayLike, second: ArrayLike, rng: np.random.Generator, resamples: int = RESAMPLES
) -> Interval:
    """Return the ratio of two means over the same frames, with its 95 % interval, see `bootstrap_mean`.

    Parameters
    ----------
    first, second : (frames,) float array
        A frame that lacks one of them (NaN) is left out.
    rng : numpy.random.Generator
    resamples : int

    Returns
    -------
    Interval
        NaN if no frame is left, or where the second mean is 0.
    """
    if resamples < 1:
        raise ValueError(f"resamples must be at least 1, got {resamples}")
    a, b = _both(first, second)
    if not len(a):
        return Interval(*[float("nan")] * 3)
    drawn = rng.integers(len(a), size=(resamples, len(a)))
    ratios = _ratio(a[drawn].mean(axis=1), b[drawn].mean(axis=1))
    edge = (1 - LEVEL) / 2
    if np.isnan(ratios).any():
        return Interval(float(_ratio(a.mean(), b.mean())), float("nan"), float("nan"))
    low, high = np.quantile(ratios, [edge, 1 - edge])
    return Interval(float(_ratio(a.mean(), b.mean())), float(low), float(high))


def _both(first: ArrayLike, second: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
    if a.ndim != 1 or a.shape != b.shape:
        raise ValueError(f"both models need one value per frame, got shapes {a.shape} and {b.shape}")
    kept = ~(np.isnan(a) | np.isnan(b))
    return a[kept], b[kept]


def _ratio(a: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    b = np.asarray(b, np.float64)
    return np.asarray(a) / np.where(b == 0, np.nan, b)
