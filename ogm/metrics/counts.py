"""Counts of a grid against the truth.

Counts are additive: the counts of a frame give its scores, and the sum of the counts of all frames gives scores of the
pooled cells (micro averages).
"""

from math import inf
from operator import add
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ogm.evidence import check_mass
from ogm.extras import import_extra
from ogm.metrics.counting import DETECTION, count_cells, count_neighbours, count_ranges
from ogm.metrics.divergence import MIN_EVIDENCE, from_truth, sum_divergences, to_truth
from ogm.state import CellState, predict_state

STRENGTHS = (1.0, 10.0)  # E, the evidence of the truth in divergences
BINS = 15  # of P(occupied) and of Bel(occupied), for reliability
LEVELS = 4097  # of histograms: 0, 1/4096, ..., 1
RANGES = (0.0, 10.0, 20.0, 30.0, 40.0, inf)  # [m] edges of bins; a cell on an edge is in the farther bin
HEIGHTS = (0.10, 0.50)  # [m] least heights of obstacles in metrics without low obstacles
RANGE_LEVELS = 1025  # of histograms by range: 0, 1/1024, ..., 1
ROUNDING = 1e-6  # of masses outside [0, 1], by float32


class ConfusionSums(NamedTuple):
    """Sums over cells, without ignored cells. Add two with `plus`.

    The axes `truth` and `predicted` are the states 0 unknown, 1 free, 2 occupied. A *known* cell is truly free or
    occupied. A histogram has 4097 levels, 0, 1/4096, ..., 1; numbers are rounded to the nearest level. The sums of a
    grid take 0.4 MB, most of it zeros.

    Attributes
    ----------
    cells : (truth,)
        Number of cells.
    mass : (truth, 2)
        Sums of the masses of free and occupied.
    to_truth : (3, truth)
        Sums of KL[grid || truth] for a truth of evidence 1; 10; and 1 with a tenth of the grid's evidence.
    from_truth : (2, truth)
        Sums of KL[truth || grid] for a truth of evidence 1 and 10.
    evilog_kl : (truth,)
        Sums of `evilog_kl`.
    confusion : (truth, predicted)
        Cells by the state of greatest mass, see `ogm.state.predict_state`.
    confusion_by_probability : (truth, predicted)
        Cells by P(occupied): predicted free below 1/2, occupied above 1/2, unknown at 1/2.
    detections : (truth, 2)
        Cells with a mass above 1/2 of free, of occupied.
    reliability : (3, 15, 3)
        In bins of P(occupied) on known cells, of P(occupied) on known cells predicted free or occupied, and of the
        relative P(occupied) on known cells: number of cells, sum of P, number of occupied cells.
    intervals : (15, 4)
        In bins of Bel(occupied) on known cells: number of cells, sums of Bel(occupied) and Pl(occupied), number of
        occupied cells.
    squared_error : (3,)
        Sums over known cells of (P - occupied)**2 for P(occupied); for the relative P(occupied); and of the expectation
        for P under the grid's Beta density.
    log_loss : (truth,)
        Sums of -ln P(true state) over known cells [nats], P being at least 1e-5.
    entropy : (truth,)
        Sums of Shannon's entropy of P(occupied) [bit].
    dissonance : (truth,)
        Sums of 2 min(free, occupied).
    unknown_hist : (3, 4097)
        Histograms of the mass of unknown in known cells, in truly unknown cells, and in known cells with wrong
        P(occupied); P = 1/2 is half wrong.
    p_occupied_hist : (3, 4097)
        Histograms of P(occupied) in free cells and in occupied cells, and the sum of P over both.
    p_occupied_hist_tol1 : (3, 4097)
        Histograms of P(occupied) in known cells with and without an occupied cell within one cell (eight neighbours and
        the cell itself); and of occupied cells by the largest P(occupied) within one cell, ignored cells left out.
    bel_free_hist : (2, 4097)
        Histograms of Bel(free) in free cells and in occupied cells.
    obstacles : (2,)
        Number of groups of occupied cells that touch at a side or corner, and of groups without P(occupied) > 1/2
        within one cell.
    range_confusion : (ranges, truth, predicted)
    range_detections : (ranges, truth, 2)
    range_bel_free_hist : (ranges, 2, 1025)
        These sums by the bins of `RANGES`; zeros without distances.
    high_confusion : (heights, predicted)
    high_detections : (heights, 2)
        These sums over occupied cells with obstacles at least as high as each of `HEIGHTS`; zeros without heights.
    """

    cells: NDArray[np.float64]
    mass: NDArray[np.float64]
    to_truth: NDArray[np.float64]
    from_truth: NDArray[np.float64]
    evilog_kl: NDArray[np.float64]
    confusion: NDArray[np.float64]
    confusion_by_probability: NDArray[np.float64]
    detections: NDArray[np.float64]
    reliability: NDArray[np.float64]
    intervals: NDArray[np.float64]
    squared_error: NDArray[np.float64]
    log_loss: NDArray[np.float64]
    entropy: NDArray[np.float64]
    dissonance: NDArray[np.float64]
    unknown_hist: NDArray[np.float64]
    p_occupied_hist: NDArray[np.float64]
    p_occupied_hist_tol1: NDArray[np.float64]
    bel_free_hist: NDArray[np.float64]
    obstacles: NDArray[np.float64]
    range_confusion: NDArray[np.float64]
    range_detections: NDArray[np.float64]
    range_bel_free_hist: NDArray[np.float64]
    high_confusion: NDArray[np.float64]
    high_detections: NDArray[np.float64]

    @classmethod
    def zeros(cls) -> Self:
        """Return sums of zero."""
        ranges = len(RANGES) - 1
        shapes = [
            *((3,), (3, 2), (3, 3), (2, 3), (3,), (3, 3), (3, 3), (3, 2), (3, BINS, 3), (BINS, 4), (3,), (3,), (3,)),
            *((3,), (3, LEVELS), (3, LEVELS), (3, LEVELS), (2, LEVELS), (2,)),
            *((ranges, 3, 3), (ranges, 3, 2), (ranges, 2, RANGE_LEVELS), (len(HEIGHTS), 3), (len(HEIGHTS), 2)),
        ]
        return cls(*map(np.zeros, shapes))

    def plus(self, other: Self) -> "ConfusionSums":
        """Return the added sums of both."""
        return ConfusionSums(*map(add, self, other))


def accumulate(
    mass: NDArray[np.floating],
    state: NDArray[np.uint8],
    distance: NDArray[np.floating] | None = None,
    height_cm: NDArray[np.uint8] | None = None,
) -> ConfusionSums:
    """Return the sums of a grid for scores and curves.

    Parameters
    ----------
    mass : (nx, ny, 2) float array
        Masses of free and occupied, see `EvidentialGrid.mass`.
    state : (nx, ny) uint8
        True states, see `Truth.state`: 0 unknown, 1 free, 2 occupied, 3 ignored.
    distance : (nx, ny) float array, optional
        Distances of the cells from the sensor [m], see `distances`; needed for sums by range.
    height_cm : (nx, ny) uint8, optional
        Heights of obstacles in occupied cells [cm], see `Truth.height_cm`; needed for sums by height.

    Raises
    ------
    ValueError
        If the shapes do not fit, a mass is invalid (NaN, below 0, a sum above 1), a state is above 3, or a distance is
        negative or NaN.
    TypeError
        If the masses are not floating-point numbers.
    """
    _check(mass, state)
    sums = ConfusionSums.zeros()
    mass, state = np.ascontiguousarray(mass), np.ascontiguousarray(state)
    cells, states = mass.reshape(-1, 2), state.ravel()
    near = _count_obstacles(mass, state, sums)
    count_cells(cells, states, near.ravel(), sums)
    if distance is not None:
        _check_distance(distance, state)
        far = np.ascontiguousarray(distance.ravel())
        count_ranges(cells, states, far, np.array(RANGES), sums)
    if height_cm is not None:
        _count_high(mass, state, height_cm, sums)

    divergence = sum_divergences(cells, states, np.array([1.0, STRENGTHS[0] / STRENGTHS[1]]))
    sums.to_truth[:2] = [to_truth(divergence, 0, sums.cells, strength) for strength in STRENGTHS]
    sums.to_truth[2] = to_truth(divergence, 1, sums.cells, STRENGTHS[0])
    sums.from_truth[:] = [from_truth(divergence, 0, sums.cells, strength) for strength in STRENGTHS]
    # `evilog_kl` is linear in two logarithms.
    weights = np.array([[MIN_EVIDENCE, 1.0, MIN_EVIDENCE], [MIN_EVIDENCE, MIN_EVIDENCE, 1.0]])
    logs = np.stack([divergence.clipped_log_free, divergence.clipped_log_occupied])
    constant = MIN_EVIDENCE * np.log(MIN_EVIDENCE) * np.array([2.0, 1.0, 1.0])
    sums.evilog_kl[:] = constant * sums.cells - (weights * logs).sum(axis=0)
    return sums


def _count_high(
    mass: NDArray[Any], state: NDArray[np.uint8], height_cm: NDArray[np.uint8], sums: ConfusionSums
) -> None:
    """Count occupied cells with obstacles at least as high as each of `HEIGHTS`."""
    if height_cm.shape != state.shape:
        raise ValueError(f"height_cm must have the cells' shape {state.shape}, got {height_cm.shape}")
    occupied = state == CellState.OCCUPIED
    found, heights = mass[occupied], height_cm[occupied]
    predicted, detected = predict_state(found), found > DETECTION
    for k, height in enumerate(HEIGHTS):
        high = heights >= round(100 * height)
        sums.high_confusion[k] = np.bincount(predicted[high], minlength=3)
        sums.high_detections[k] = detected[high].sum(axis=0)


def _count_obstacles(mass: NDArray[Any], state: NDArray[np.uint8], sums: ConfusionSums) -> NDArray[np.uint8]:
    """Count groups and neighbours of occupied cells; return 1 in cells within one cell of an occupied cell."""
    ndimage = import_extra("scipy.ndimage", "evaluate")  # here, as it would double the import time

    groups, count = ndimage.label(state == CellState.OCCUPIED, np.ones((3, 3)))
    near, best = np.zeros(state.shape, np.uint8), np.zeros(count + 1)
    count_neighbours(mass, state, groups, near, best, sums)
    sums.obstacles[:] = count, np.count_nonzero(best[1:] <= 0.5)
    return near


def _check(mass: NDArray[Any], state: NDArray[Any]) -> None:
    if mass.ndim != 3 or mass.shape[-1] != 2 or mass.shape[:-1] != state.shape:
        raise ValueError(
            f"mass must have shape (nx, ny, 2) and state (nx, ny) of the same cells, got {mass.shape} and "
            f"{state.shape}; crop the truth to the grid's spec"
        )
    if mass.dtype not in (np.float32, np.float64):
        raise TypeError(f"mass must be float32 or float64, got {mass.dtype}; convert it: mass.astype('float32')")
    if state.dtype != np.uint8 or (state.size and state.max() > CellState.IGNORE):
        raise ValueError(
            f"state must be uint8 with 0 unknown, 1 free, 2 occupied, 3 ignore, got {state.dtype} up to "
            f"{state.max() if state.size else 'nothing'}"
        )
    low, high = float(mass.min(initial=0)), float((mass[..., 0] + mass[..., 1]).max(initial=0))
    if not (low >= -ROUNDING and high <= 1 + ROUNDING):
        check_mass(mass, ROUNDING)


def _check_distance(distance: NDArray[Any], state: NDArray[Any]) -> None:
    if distance.shape != state.shape or distance.dtype.kind != "f":
        raise ValueError(
            f"distance must be a float array of shape {state.shape}, got {distance.dtype} "
            f"{distance.shape}; see ogm.metrics.distances"
        )
    if not distance.min(initial=0.0) >= 0:
        raise ValueError(f"distances must be at least 0 m, got {distance.min()} m")
