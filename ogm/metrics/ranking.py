"""How well a number separates two kinds of cells.

The number is known by histograms of two kinds of cells, positive and negative: counts per level, ascending. Cells of
one level are ties. The results lie in [0, 1], and are NaN if one of the two kinds is absent.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def auroc(positive: NDArray[Any], negative: NDArray[Any]) -> float:
    """Return the chance that a positive cell has the higher number of two, a tie counting one half."""
    p, n = np.asarray(positive, np.float64), np.asarray(negative, np.float64)
    pairs = p.sum() * n.sum()
    if pairs == 0:
        return float("nan")
    below = np.cumsum(n) - n
    return float(p @ (below + 0.5 * n) / pairs)


def average_precision(positive: NDArray[Any], negative: NDArray[Any]) -> float:
    """Return the mean precision over the recall, cells being detected from the highest number down.

    The sum of precision times gain of recall over all thresholds, without interpolation: the area under the
    precision-recall curve as scikit-learn defines it.
    """
    p, n = np.asarray(positive, np.float64)[::-1], np.asarray(negative, np.float64)[::-1]
    if p.sum() == 0 or n.sum() == 0:
        return float("nan")
    right, detected = np.cumsum(p), np.cumsum(p + n)
    return float(p @ (right / np.maximum(detected, 1e-300)) / right[-1])


def false_positive_rate(positive: NDArray[Any], negative: NDArray[Any]) -> float:
    """Return the share of negative cells above the highest threshold that finds 95 % of the positive ones."""
    p, n = np.asarray(positive, np.float64)[::-1], np.asarray(negative, np.float64)[::-1]
    if p.sum() == 0 or n.sum() == 0:
        return float("nan")
    found = np.cumsum(p)
    threshold = int(np.searchsorted(found, 0.95 * found[-1] * (1 - 1e-12)))  # the factor: rounding
    return float(n[: threshold + 1].sum() / n.sum())
