"""How well a number separates two kinds of cells.

Every function comes for numbers and for histograms of them; the first are exact, in the second numbers that share
a bin are ties.
"""

import numpy as np
from numpy.typing import NDArray


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
    return auroc_of_histograms(*_histograms(score, positive))


def average_precision(score: NDArray[np.floating], positive: NDArray[np.bool_]) -> float:
    """Return the mean precision over the recall, cells being detected from the highest score down. Exact.

    The sum of precision times gain of recall over all thresholds, without interpolation: the area under the
    precision-recall curve as scikit-learn defines it.

    Parameters
    ----------
    score : (...) float array, finite
    positive : (...) bool

    Returns
    -------
    float
        In [0, 1], the share of positive cells by chance; NaN if one of the two kinds is absent.
    """
    return average_precision_of_histograms(*_histograms(score, positive))


def auroc_of_histograms(positive: NDArray, negative: NDArray) -> float:
    """Return the same as `auroc` from counts per score, ascending; scores that share a bin count as ties.

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


def average_precision_of_histograms(positive: NDArray, negative: NDArray) -> float:
    """Return the same as `average_precision` from counts per score, ascending.

    Parameters
    ----------
    positive, negative : (bins,) counts

    Returns
    -------
    float
        In [0, 1]; NaN if one of the two kinds is absent.
    """
    p, n = np.asarray(positive, np.float64)[::-1], np.asarray(negative, np.float64)[::-1]
    if p.sum() == 0 or n.sum() == 0:
        return float("nan")
    right, detected = np.cumsum(p), np.cumsum(p + n)
    return float(p @ (right / np.maximum(detected, 1e-300)) / right[-1])


def false_positive_rate_of_histograms(positive: NDArray, negative: NDArray, recall: float = 0.95) -> float:
    """Return the share of negative cells above the highest threshold that reaches a recall.

    Parameters
    ----------
    positive, negative : (bins,) counts
        Per score, ascending.
    recall : float
        Share of the positive cells to reach at least, in (0, 1].

    Returns
    -------
    float
        In [0, 1]; NaN if one of the two kinds is absent.
    """
    if not 0 < recall <= 1:
        raise ValueError(f"recall must be in (0, 1], got {recall}")
    p, n = np.asarray(positive, np.float64)[::-1], np.asarray(negative, np.float64)[::-1]
    if p.sum() == 0 or n.sum() == 0:
        return float("nan")
    found = np.cumsum(p)
    threshold = int(np.searchsorted(found, recall * found[-1] * (1 - 1e-12)))  # the factor: rounding
    return float(n[: threshold + 1].sum() / n.sum())


def _histograms(score: NDArray, positive: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the counts of positive and negative cells per score, ascending."""
    given, kind = np.asarray(score), np.asarray(positive, np.bool_).ravel()
    if given.size != kind.size or not np.isfinite(given).all():
        raise ValueError(
            f"score must be finite and have one number per cell, got {given.size} for {kind.size} cells"
            + ("" if np.isfinite(given).all() else ", some of them NaN or inf")
        )
    values, rank = np.unique(given.ravel(), return_inverse=True)
    rank = rank.ravel()
    return (np.bincount(rank[kind], minlength=len(values)), np.bincount(rank[~kind], minlength=len(values)))
