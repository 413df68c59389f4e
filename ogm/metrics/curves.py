"""Curves from counts of one or more frames, short enough to plot.

All curves are NamedTuples of 1-D float64 arrays of equal length, empty if the counts have no cells for the curve.
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.metrics.areas import above, by_error, by_unknown, detection_curve
from ogm.metrics.counts import LEVELS, ConfusionSums

MAX_POINTS = 200  # of a curve
WHICH = ("all", "predicted_known", "relative")  # rows of ConfusionSums.reliability


class Reliability(NamedTuple):
    """Predicted probability against frequency, per bin of P(occupied) with cells.

    Attributes
    ----------
    predicted : (bins,)
        Mean P(occupied).
    observed : (bins,)
        Share of occupied cells.
    cells : (bins,)
    """

    predicted: NDArray[np.float64]
    observed: NDArray[np.float64]
    cells: NDArray[np.float64]


class Intervals(NamedTuple):
    """Belief, plausibility and frequency of occupied, per bin of Bel(occupied) with cells.

    Attributes
    ----------
    belief, plausibility : (bins,)
        Means of Bel(occupied) = m(occupied) and Pl(occupied) = 1 - m(free).
    observed : (bins,)
        Share of occupied cells; the grid is consistent if it lies between belief and plausibility.
    cells : (bins,)
    """

    belief: NDArray[np.float64]
    plausibility: NDArray[np.float64]
    observed: NDArray[np.float64]
    cells: NDArray[np.float64]


class RiskCoverage(NamedTuple):
    """Share of wrong cells among the most certain known cells, which have least mass of unknown.

    Attributes
    ----------
    coverage : (points,)
        Share of known cells taken, ascending to 1.
    risk : (points,)
        Share of wrong cells among them: P(occupied) on the wrong side of 1/2; P = 1/2 is half wrong.
    oracle : (points,)
        Least possible risk: of cells sorted by error, wrong cells last.
    """

    coverage: NDArray[np.float64]
    risk: NDArray[np.float64]
    oracle: NDArray[np.float64]


class FreeSpace(NamedTuple):
    """Recall of free space against its risk, with known cells detected as free if Bel(free) >= threshold.

    Attributes
    ----------
    false_free : (points,)
        Share of occupied cells detected as free, ascending.
    recall : (points,)
        Share of free cells detected as free.
    threshold : (points,)
        Threshold of Bel(free), descending.
    """

    false_free: NDArray[np.float64]
    recall: NDArray[np.float64]
    threshold: NDArray[np.float64]


class PrecisionRecall(NamedTuple):
    """Precision and recall of occupied, with known cells detected if P(occupied) >= threshold.

    Attributes
    ----------
    precision : (points,)
        Share of occupied cells among detected known cells; 1 without detections.
    recall : (points,)
        Share of occupied cells that are detected, ascending.
    threshold : (points,)
        Threshold of P(occupied), descending.
    """

    precision: NDArray[np.float64]
    recall: NDArray[np.float64]
    threshold: NDArray[np.float64]


def reliability(counts: ConfusionSums, which: Literal["all", "predicted_known", "relative"] = "all") -> Reliability:
    """Return the share of occupied cells among known cells, by bins of P(occupied). See `Reliability`.

    Parameters
    ----------
    counts : ConfusionSums
    which : {"all", "predicted_known", "relative"}
        P(occupied) of all known cells; P(occupied) of known cells predicted free or occupied; or
        occupied / (free + occupied) of all known cells.
    """
    if which not in WHICH:
        raise ValueError(f"which must be one of {', '.join(WHICH)}, got {which!r}")
    bins = counts.reliability[WHICH.index(which)]
    cells, predicted, observed = bins[bins[:, 0] > 0].T
    return Reliability(predicted / cells, observed / cells, cells)


def intervals(counts: ConfusionSums) -> Intervals:
    """Return the share of occupied cells among known cells, by bins of Bel(occupied). See `Intervals`."""
    cells, belief, plausibility, observed = counts.intervals[counts.intervals[:, 0] > 0].T
    return Intervals(belief / cells, plausibility / cells, observed / cells, cells)


def risk_coverage(counts: ConfusionSums) -> RiskCoverage:
    """Return the risk of the most certain known cells against their share. See `RiskCoverage`.

    Cells in one of the 4097 levels of unknown are ties, taken in equal parts.
    """
    taken, wrong = by_unknown(counts)
    total = taken[-1]
    if total == 0:
        return RiskCoverage(*np.zeros((3, 0)))
    some = np.arange(1, MAX_POINTS + 1) / MAX_POINTS * total
    risk, oracle = (np.interp(some, *ends) / some for ends in ((taken, wrong), by_error(counts)))
    return RiskCoverage(some / total, risk, oracle)


def free_space(counts: ConfusionSums) -> FreeSpace:
    """Return the recall of free cells against the share of occupied cells detected as free. See `FreeSpace`."""
    free, occupied = above(counts.bel_free_hist[0]), above(counts.bel_free_hist[1])
    if free[-1] == 0 or occupied[-1] == 0:
        return FreeSpace(*np.zeros((3, 0)))
    false_free, recall = occupied / occupied[-1], free / free[-1]
    shown = _thinned(np.log10(false_free + 1e-5) / 5, recall)
    return FreeSpace(false_free[shown], recall[shown], _thresholds(LEVELS)[shown])


def precision_recall(counts: ConfusionSums, tolerance: int = 0) -> PrecisionRecall:
    """Return precision and recall of occupied. See `PrecisionRecall`.

    Parameters
    ----------
    counts : ConfusionSums
    tolerance : {0, 1}
        Tolerance [cells], diagonals included. With 1, a detection is correct with an occupied cell within one cell, and
        an occupied cell is found with a detection within one cell. Precision counts detections in known cells only. A
        detection in a truly unknown cell can find an occupied neighbour; detections in ignored cells have no effect.
    """
    precision, recall = detection_curve(counts, tolerance)
    shown = _thinned(precision, recall) if len(recall) else np.zeros(0, np.intp)
    thresholds = _thresholds(LEVELS)[: len(recall)]
    return PrecisionRecall(precision[shown], recall[shown], thresholds[shown])


def _thresholds(levels: int) -> NDArray[np.float64]:
    """Return the smallest number that is rounded to each level, from the highest level down."""
    return np.maximum((np.arange(levels)[::-1] - 0.5) / (levels - 1), 0.0)


def _thinned(*coordinates: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return indices of points at even steps along the curve, with both ends."""
    steps = np.sqrt(sum(np.diff(axis) ** 2 for axis in coordinates))
    along = np.concatenate([np.zeros(1), np.cumsum(steps)])
    wanted = np.searchsorted(along, np.linspace(0, along[-1], MAX_POINTS))
    return np.unique(np.minimum(wanted, len(along) - 1))
