"""How well a number tells two kinds of cells apart."""

import numpy as np
from numpy.typing import NDArray

__all__ = ["auroc", "auroc_of_histograms"]


def auroc(score: NDArray[np.floating], positive: NDArray[np.bool_]) -> float:
    """Return the chance that a positive cell has the higher score of two, a tie counting one half. Exact.

    Parameters
    ----------
    score : (...) float array, finite
    positive : (...) bool

    Returns
    -------
    float
        Area under the receiver operating characteristic, [0, 1]; NaN if one of the two kinds is absent.
    """
    values, rank = np.unique(np.asarray(score).ravel(), return_inverse=True)
    positive = np.asarray(positive, np.bool_).ravel()
    return auroc_of_histograms(
        np.bincount(rank[positive], minlength=len(values)),
        np.bincount(rank[~positive], minlength=len(values)),
    )


def auroc_of_histograms(positive: NDArray, negative: NDArray) -> float:
    """Return the same from counts per score, ascending; scores that share a bin count as ties.

    Parameters
    ----------
    positive, negative : (bins,) counts

    Returns
    -------
    float
        In [0, 1]; NaN if one of the two kinds is absent.
    """
    p, n = np.asarray(positive, np.float64), np.asarray(negative, np.float64)
    pairs = p.sum() * n.sum()
    if pairs == 0:
        return float("nan")
    below = np.cumsum(n) - n
    return float(p @ (below + 0.5 * n) / pairs)
