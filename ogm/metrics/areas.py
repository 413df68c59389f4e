"""Numbers that sum up a curve of counts, and what they share with the curves."""

import numpy as np
from numpy.typing import NDArray

from ogm.metrics.counts import BINS, ConfusionSums

__all__ = [
    "above",
    "by_doubt",
    "by_error",
    "claims",
    "claims_precision",
    "equal_mass_error",
    "free_recall",
    "interval_violation",
    "overlaps",
    "parts",
    "risk_areas",
]


def interval_violation(counts: ConfusionSums) -> float:
    """Return how far the shares of occupied cells lie outside of [Bel, Pl], the mean over known cells' bins."""
    cells, belief, plausibility, happened = counts.intervals.T  # sums: a bin's distance times its cells
    outside = np.maximum(np.maximum(belief - happened, happened - plausibility), 0.0)
    return float(outside.sum() / cells.sum()) if cells.any() else float("nan")


def equal_mass_error(counts: ConfusionSums) -> float:
    """Return the adaptive calibration error: the mean distance of P(occupied) from what happened, over 15 bins.

    The bins have one weight: known cells are sorted by P and cut in 15 equal parts. Cells of one of the 4097
    levels of P count as equal and are spread evenly over the parts that they reach into.
    """
    cells = counts.likely[0] + counts.likely[1]
    total = cells.sum()
    if total == 0:
        return float("nan")
    there = cells > 0
    ends = np.concatenate([[0.0], np.cumsum(cells[there])])
    gap = np.concatenate([[0.0], np.cumsum((counts.likely[2] - counts.likely[1])[there])])
    cuts = np.interp(np.linspace(0, total, BINS + 1), ends, gap)
    return float(np.abs(np.diff(cuts)).sum() / total)


def risk_areas(counts: ConfusionSums) -> tuple[float, float]:
    """Return the area under the risk-coverage curve (AURC), and how much larger it is than the oracle's (AUSE)."""
    area = _area(*by_doubt(counts))
    return area, area - _area(*by_error(counts))


def free_recall(clear: NDArray[np.float64], false_free: float) -> float:
    """Return the largest share of free cells found with a share of occupied ones taken for free within a bound.

    Parameters
    ----------
    clear : (2, levels)
        Histograms of Bel(free) of free and of occupied cells.
    false_free : float
        The bound.

    Returns
    -------
    float
        0 if even the highest threshold breaks the bound; NaN if there are no free or no occupied cells.
    """
    free, occupied = above(clear[0]), above(clear[1])
    if free[-1] == 0 or occupied[-1] == 0:
        return float("nan")
    kept = np.count_nonzero(occupied <= false_free * occupied[-1])
    return float(free[kept - 1] / free[-1]) if kept else 0.0


def claims_precision(counts: ConfusionSums, tolerance: int) -> float:
    """Return the average precision of the claims of occupied, see `precision_recall` and `average_precision`."""
    precision, recall = claims(counts, tolerance)
    return float(precision @ np.diff(recall, prepend=0.0)) if len(recall) else float("nan")


def overlaps(calls: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return intersection over union of unknown, free, occupied from a (truth, call) confusion.

    NaN where the truth has no such cell: then nobody said what is of that state.
    """
    union = calls.sum(axis=0) + calls.sum(axis=1) - np.diag(calls)
    return parts(np.diag(calls), np.where(calls.sum(axis=1) > 0, union, 0.0))


def parts(some: NDArray | float, whole: NDArray | float) -> NDArray[np.float64]:
    """Return some / whole, NaN where the whole is 0."""
    return np.asarray(some, np.float64) / np.where(np.asarray(whole) > 0, whole, np.nan)


def above(histogram: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how many lie at each level or above, from the highest level down."""
    return np.cumsum(histogram[::-1])


def by_doubt(counts: ConfusionSums) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return known cells and wrong ones up to the end of each level of unknown that has some; both begin with 0."""
    known, _, wrong = counts.doubt
    return _ends(known, wrong)


def by_error(counts: ConfusionSums) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the same if cells came by their error: the right ones, those of P = 1/2, the wrong ones."""
    known, _, wrong = counts.doubt
    half = counts.likelier[1:, 0].sum()
    all_wrong = max(wrong.sum() - 0.5 * half, 0.0)
    cells = np.array([known.sum() - half - all_wrong, half, all_wrong])
    return _ends(cells, np.array([0.0, 0.5, 1.0]) * cells)


def _ends(
    cells: NDArray[np.float64], wrong: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    there = cells > 0
    zero = np.zeros(1)
    return np.concatenate([zero, np.cumsum(cells[there])]), np.concatenate([zero, np.cumsum(wrong[there])])


def _area(taken: NDArray[np.float64], wrong: NDArray[np.float64]) -> float:
    """Return the mean over coverage of the risk, wrong / taken, in closed form: between two ends it is a / n + b."""
    if taken[-1] == 0:
        return float("nan")
    slope = np.diff(wrong) / np.diff(taken)
    offset = wrong[:-1] - slope * taken[:-1]
    logs = np.log(taken[1:] / np.where(taken[:-1] > 0, taken[:-1], taken[1:]))  # the offset of the first is 0
    return float((offset * logs + slope * np.diff(taken)).sum() / taken[-1])


def claims(counts: ConfusionSums, tolerance: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return precision and recall from the highest threshold down; empty if free or occupied cells are absent."""
    if tolerance not in (0, 1):
        raise ValueError(f"tolerance must be 0 or 1 cells, got {tolerance}")
    free, occupied, _ = counts.likely
    if not free.any() or not occupied.any():
        return np.zeros(0), np.zeros(0)
    right, wrong, found = (occupied, free, occupied) if tolerance == 0 else counts.close
    claimed = above(right + wrong)
    precision = np.where(claimed > 0, above(right) / np.maximum(claimed, 1.0), 1.0)
    return precision, above(found) / found.sum()
