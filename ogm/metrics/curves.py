"""Curves from the counts of a frame or of many, short enough to plot.

All are NamedTuples of 1-D float64 arrays of one length, empty where the counts have no cell for the curve.
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.metrics.areas import above, by_error, by_unknown, detection_curve
from ogm.metrics.counts import LEVELS, ConfusionSums

POINTS = 200  # of a curve, at most
WHICH = ("all", "predicted_known", "relative")  # rows of ConfusionSums.reliability


class Reliability(NamedTuple):
    """Predicted probability against frequency, per bin of P(occupied) that has cells.

    Attributes
    ----------
    claimed : (bins,)
        Mean P(occupied).
    happened : (bins,)
        Share of the cells that are occupied.
    cells : (bins,)
    """

    claimed: NDArray[np.float64]
    happened: NDArray[np.float64]
    cells: NDArray[np.float64]


class Intervals(NamedTuple):
    """Belief, plausibility and frequency of occupied, per bin of Bel(occupied) with cells.

    Attributes
    ----------
    belief, plausibility : (bins,)
        Means of Bel(occupied) = m(occupied) and Pl(occupied) = 1 - m(free).
    happened : (bins,)
        Share of the cells that are occupied; the grid is consistent where it lies between the two.
    cells : (bins,)
    """

    belief: NDArray[np.float64]
    plausibility: NDArray[np.float64]
    happened: NDArray[np.float64]
    cells: NDArray[np.float64]


class RiskCoverage(NamedTuple):
    """Share of wrong cells among the most certain ones, known cells being taken by ascending mass of unknown.

    Attributes
    ----------
    coverage : (points,)
        Share of the known cells that are taken, ascending to 1.
    risk : (points,)
        Share of those that are wrong: P(occupied) beyond 1/2 on the side that is not true; P = 1/2 is half wrong.
    oracle : (points,)
        The risk if cells were sorted by their error, the wrong ones last: the least possible one.
    """

    coverage: NDArray[np.float64]
    risk: NDArray[np.float64]
    oracle: NDArray[np.float64]


class FreeSpace(NamedTuple):
    """Recall of free space against its risk, known cells with Bel(free) >= threshold being detected as free.

    Attributes
    ----------
    false_free : (points,)
        Share of the occupied cells that are detected as free, ascending.
    recall : (points,)
        Share of the free cells that are.
    threshold : (points,)
        Of Bel(free), descending.
    """

    false_free: NDArray[np.float64]
    recall: NDArray[np.float64]
    threshold: NDArray[np.float64]


class PrecisionRecall(NamedTuple):
    """Precision and recall of occupied, known cells with P(occupied) >= threshold being detected.

    Attributes
    ----------
    precision : (points,)
        Share of the detected known cells that are right; 1 where none is detected.
    recall : (points,)
        Share of the occupied cells that are found, ascending.
    threshold : (points,)
        Of P(occupied), descending.
    """

    precision: NDArray[np.float64]
    recall: NDArray[np.float64]
    threshold: NDArray[np.float64]


def reliability(counts: ConfusionSums, which: Literal["all", "predicted_known", "relative"] = "all") -> Reliability:
    """Return how often known cells are occupied, by bins of P(occupied).

    Parameters
    ----------
    counts : ConfusionSums
    which : {"all", "predicted_known", "relative"}
        P(occupied) of all known cells, of those predicted free or occupied; or occupied / (free + occupied) of all.
    """
    if which not in WHICH:
        raise ValueError(f"which must be one of {', '.join(WHICH)}, got {which!r}")
    bins = counts.reliability[WHICH.index(which)]
    cells, claimed, happened = bins[bins[:, 0] > 0].T
    return Reliability(claimed / cells, happened / cells, cells)


def intervals(counts: ConfusionSums) -> Intervals:
    """Return how often known cells are occupied, against [Bel(occupied), Pl(occupied)]."""
    cells, belief, plausibility, happened = counts.intervals[counts.intervals[:, 0] > 0].T
    return Intervals(belief / cells, plausibility / cells, happened / cells, cells)


def risk_coverage(counts: ConfusionSums) -> RiskCoverage:
    """Return the risk of the most certain known cells, by unknown, against their share. See `RiskCoverage`.

    Cells of one of the 4097 levels of unknown are taken together, in equal parts.
    """
    taken, wrong = by_unknown(counts)
    total = taken[-1]
    if total == 0:
        return RiskCoverage(*np.zeros((3, 0)))
    some = np.arange(1, POINTS + 1) / POINTS * total
    risk, oracle = (np.interp(some, *ends) / some for ends in ((taken, wrong), by_error(counts)))
    return RiskCoverage(some / total, risk, oracle)


def free_space(counts: ConfusionSums) -> FreeSpace:
    """Return the recall of free cells against the share of occupied ones detected as free. See `FreeSpace`."""
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
        In cells, diagonals included. With 1, a detected cell is right if an occupied cell lies within one cell, and
        an occupied cell is found if a detected one does. Detections count for precision on known cells only; one on
        a cell whose truth is unknown can find an occupied cell next to it, one on an ignored cell has no effect.
    """
    precision, recall = detection_curve(counts, tolerance)
    shown = _thinned(precision, recall) if len(recall) else np.zeros(0, np.intp)
    thresholds = _thresholds(LEVELS)[: len(recall)]
    return PrecisionRecall(precision[shown], recall[shown], thresholds[shown])


def _thresholds(levels: int) -> NDArray[np.float64]:
    """Return the least number that is rounded to each level or above, from the highest level down."""
    return np.maximum((np.arange(levels)[::-1] - 0.5) / (levels - 1), 0.0)


def _thinned(*coordinates: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the indices of points to plot: both ends, and between them even steps along the curve."""
    steps = np.sqrt(sum(np.diff(one) ** 2 for one in coordinates))
    along = np.concatenate([np.zeros(1), np.cumsum(steps)])
    wanted = np.searchsorted(along, np.linspace(0, along[-1], POINTS))
    return np.unique(np.minimum(wanted, len(along) - 1))
