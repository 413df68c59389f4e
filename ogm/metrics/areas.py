"""Areas and other summaries of curves from counts, and common columns of the curves.

`auroc`, `average_precision` and `false_positive_rate` take histograms of a number over positive and negative cells:
counts per level, ascending. Cells in the same level are ties. Results are in [0, 1], or NaN without positive or without
negative cells.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.metrics.counts import BINS, ConfusionSums


def interval_violation(counts: ConfusionSums) -> float:
    """Return the mean distance of shares of occupied cells outside [Bel, Pl], over bins of known cells."""
    cells, belief, plausibility, observed = counts.intervals.T  # sums over the cells of a bin
    outside = np.maximum(np.maximum(belief - observed, observed - plausibility), 0.0)
    return float(outside.sum() / cells.sum()) if cells.any() else float("nan")


def equal_mass_error(counts: ConfusionSums) -> float:
    """Return the adaptive calibration error: mean distance of P(occupied) from the share of occupied cells, 15 bins.

    The bins have equal weights: known cells are sorted by P and cut into 15 equal parts. Cells in one of the 4097
    levels of P are ties, spread evenly over their parts.
    """
    cells = counts.p_occupied_hist[0] + counts.p_occupied_hist[1]
    total = cells.sum()
    if total == 0:
        return float("nan")
    filled = cells > 0
    ends = np.concatenate([[0.0], np.cumsum(cells[filled])])
    gap = np.concatenate([[0.0], np.cumsum((counts.p_occupied_hist[2] - counts.p_occupied_hist[1])[filled])])
    cuts = np.interp(np.linspace(0, total, BINS + 1), ends, gap)
    return float(np.abs(np.diff(cuts)).sum() / total)


def risk_areas(counts: ConfusionSums) -> tuple[float, float]:
    """Return the area under the risk-coverage curve (AURC), and its excess over the oracle's area (AUSE)."""
    area = _area(*by_unknown(counts))
    return area, area - _area(*by_error(counts))


def free_recall(hist: NDArray[np.float64], false_free: float) -> float:
    """Return the largest recall of free cells for a bounded share of occupied cells detected as free.

    Parameters
    ----------
    hist : (2, levels)
        Histograms of Bel(free) for free and for occupied cells.
    false_free : float
        Bound of the share.

    Returns
    -------
    float
        0 if even the highest threshold exceeds the bound; NaN without free or occupied cells.
    """
    free, occupied = above(hist[0]), above(hist[1])
    if free[-1] == 0 or occupied[-1] == 0:
        return float("nan")
    kept = np.count_nonzero(occupied <= false_free * occupied[-1])
    return float(free[kept - 1] / free[-1]) if kept else 0.0


def average_precision_of(counts: ConfusionSums, tolerance: int) -> float:
    """Return the average precision of occupied, see `precision_recall`."""
    precision, recall = detection_curve(counts, tolerance)
    return float(precision @ np.diff(recall, prepend=0.0)) if len(recall) else float("nan")


def overlaps(confusion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return intersection over union of unknown, free, occupied from a (truth, predicted) confusion.

    NaN for states without true cells.
    """
    predicted, true, both = confusion.sum(axis=0), confusion.sum(axis=1), np.diag(confusion)
    return parts(both, np.where(true > 0, predicted + true - both, 0.0))


def parts(some: NDArray[Any] | float, whole: NDArray[Any] | float) -> NDArray[np.float64]:
    """Return some / whole; NaN if the whole is 0."""
    return np.asarray(some, np.float64) / np.where(np.asarray(whole) > 0, whole, np.nan)


def above(histogram: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the counts at each level or above, from the highest level down."""
    return np.cumsum(histogram[::-1])


def by_unknown(counts: ConfusionSums) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return cumulated numbers of known cells and of wrong cells over the filled levels of unknown, both from 0."""
    known, _, wrong = counts.unknown_hist
    return _ends(known, wrong)


def by_error(counts: ConfusionSums) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return these numbers for cells sorted by error: correct cells, cells with P = 1/2, wrong cells."""
    known, _, wrong = counts.unknown_hist
    half = counts.confusion_by_probability[1:, 0].sum()
    all_wrong = max(wrong.sum() - 0.5 * half, 0.0)
    cells = np.array([known.sum() - half - all_wrong, half, all_wrong])
    return _ends(cells, np.array([0.0, 0.5, 1.0]) * cells)


def _ends(cells: NDArray[np.float64], wrong: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    filled, zero = cells > 0, np.zeros(1)
    return np.concatenate([zero, np.cumsum(cells[filled])]), np.concatenate([zero, np.cumsum(wrong[filled])])


def _area(taken: NDArray[np.float64], wrong: NDArray[np.float64]) -> float:
    """Return the mean risk, wrong / taken, over coverage, in closed form: between two ends the risk is a / n + b."""
    if taken[-1] == 0:
        return float("nan")
    slope = np.diff(wrong) / np.diff(taken)
    offset = wrong[:-1] - slope * taken[:-1]
    logs = np.log(taken[1:] / np.where(taken[:-1] > 0, taken[:-1], taken[1:]))  # the offset of the first is 0
    return float((offset * logs + slope * np.diff(taken)).sum() / taken[-1])


def detection_curve(counts: ConfusionSums, tolerance: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return precision and recall from the highest threshold down; empty without free or occupied cells."""
    if tolerance not in (0, 1):
        raise ValueError(f"tolerance must be 0 or 1 cells, got {tolerance}")
    free, occupied, _ = counts.p_occupied_hist
    if not free.any() or not occupied.any():
        return np.zeros(0), np.zeros(0)
    right, wrong, found = (occupied, free, occupied) if tolerance == 0 else counts.p_occupied_hist_tol1
    detected = above(right + wrong)
    precision = np.where(detected > 0, above(right) / np.maximum(detected, 1.0), 1.0)
    return precision, above(found) / found.sum()


def auroc(positive: NDArray[Any], negative: NDArray[Any]) -> float:
    """Return the probability that a positive cell has a higher number than a negative cell; ties count 1/2."""
    p, n = np.asarray(positive, np.float64), np.asarray(negative, np.float64)
    pairs = p.sum() * n.sum()
    if pairs == 0:
        return float("nan")
    below = np.cumsum(n) - n
    return float(p @ (below + 0.5 * n) / pairs)


def average_precision(positive: NDArray[Any], negative: NDArray[Any]) -> float:
    """Return the mean precision over recall, with cells detected from the highest number down.

    This is the sum of precision times gain of recall over all thresholds, without interpolation, as in scikit-learn.
    """
    p, n = np.asarray(positive, np.float64)[::-1], np.asarray(negative, np.float64)[::-1]
    if p.sum() == 0 or n.sum() == 0:
        return float("nan")
    right, detected = np.cumsum(p), np.cumsum(p + n)
    return float(p @ (right / np.maximum(detected, 1e-300)) / right[-1])


def false_positive_rate(positive: NDArray[Any], negative: NDArray[Any]) -> float:
    """Return the share of negative cells above the highest threshold that detects 95 % of positive cells."""
    p, n = np.asarray(positive, np.float64)[::-1], np.asarray(negative, np.float64)[::-1]
    if p.sum() == 0 or n.sum() == 0:
        return float("nan")
    found = np.cumsum(p)
    threshold = int(np.searchsorted(found, 0.95 * found[-1] * (1 - 1e-12)))  # the factor: rounding
    return float(n[: threshold + 1].sum() / n.sum())
