"""What is counted of one grid against the truth.

Counts add up: the scores of one frame's counts are that frame's scores, and the scores of the sum of all frames'
counts are those of the pooled cells (micro averages).
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

STRENGTHS = (1.0, 10.0)  # E, the evidence of the truth that divergences are taken for
BINS = 15  # of P(occupied) and of Bel(occupied), for reliability
LEVELS = 4097  # of histograms: 0, 1/4096, ..., 1
RANGES = (0.0, 10.0, 20.0, 30.0, 40.0, inf)  # [m] edges of bins; a cell on an edge is in the farther
HEIGHTS = (0.10, 0.50)  # [m] from which on obstacles count in metrics that leave lower ones out
RANGE_LEVELS = 1025  # of those by range: 0, 1/1024, ..., 1
ROUNDING = 1e-6  # how far a mass may lie outside [0, 1], as float32 makes it


class ConfusionSums(NamedTuple):
    """Sums over cells; those that the truth ignores are in none of them. Add two with `plus`.

    The axes `truth` and `predicted` are the states 0 unknown, 1 free, 2 occupied. A *known* cell is one whose truth is
    free or occupied. A histogram has 4097 levels, 0, 1/4096, ..., 1; a number counts at the nearest one. The sums of
    one grid take 0.4 MB, most of it zeros.

    Attributes
    ----------
    cells : (truth,)
        Number of cells.
    mass : (truth, 2)
        Sums of the masses of free and occupied.
    to_truth : (3, truth)
        Sums of KL[grid || truth] for a truth of evidence 1, of 10, and of 1 with a tenth of the grid's evidence.
    from_truth : (2, truth)
        Sums of KL[truth || grid] for a truth of evidence 1 and of 10.
    evilog_kl : (truth,)
        Sums of `evilog_kl`.
    confusion : (truth, predicted)
        Cells by the state of greatest mass, see `ogm.state.predict_state`.
    confusion_by_probability : (truth, predicted)
        Cells by P(occupied) below, above 1/2; 0 where it is 1/2.
    detections : (truth, 2)
        Cells with a mass of free, of occupied, above 1/2.
    reliability : (3, 15, 3)
        For P(occupied) on all known cells, on those predicted free or occupied, and for the relative P(occupied) on all
        known cells: in bins of it, cells, sum of P, cells that are occupied.
    intervals : (15, 4)
        In bins of Bel(occupied) on known cells: cells, sums of Bel(occupied) and Pl(occupied), cells that are
        occupied.
    squared_error : (3,)
        Sums over known cells of (P - occupied)**2 for P(occupied) and for the relative one, and of the first's
        expectation under the grid's Beta density.
    log_loss : (truth,)
        Sums of -ln P(true state) over known cells [nats], P being at least 1e-5.
    entropy : (truth,)
        Sums of Shannon's entropy of P(occupied) [bit].
    dissonance : (truth,)
        Sums of 2 min(free, occupied).
    unknown_hist : (3, 4097)
        Histograms of the mass of unknown, of known cells, of cells whose truth is unknown, and of the known ones that
        are wrong by P(occupied); one of P = 1/2 is half wrong.
    p_occupied_hist : (3, 4097)
        Histograms of P(occupied), of free cells and of occupied ones, and the sum of P over both.
    p_occupied_hist_tol1 : (3, 4097)
        Histograms of P(occupied), of known cells with and without an occupied cell within one cell (their eight
        neighbours and themselves); and occupied cells by the largest P(occupied) within one cell that is not
        ignored.
    bel_free_hist : (2, 4097)
        Histograms of Bel(free), of free cells and of occupied ones.
    obstacles : (2,)
        Groups of occupied cells that touch at a side or corner, and those of them without a cell of
        P(occupied) > 1/2 within one cell.
    range_confusion : (ranges, truth, predicted)
    range_detections : (ranges, truth, 2)
    range_bel_free_hist : (ranges, 2, 1025)
        As without `range_`, by the bins of `RANGES`; zeros if no distances were given.
    high_confusion : (heights, predicted)
    high_detections : (heights, 2)
        Of occupied cells whose obstacle is at least as high as each of `HEIGHTS`; zeros if heights are not known.
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
        """Return the sums of no cell."""
        ranges = len(RANGES) - 1
        shapes = [
            *((3,), (3, 2), (3, 3), (2, 3), (3,), (3, 3), (3, 3), (3, 2), (3, BINS, 3), (BINS, 4), (3,), (3,), (3,)),
            *((3,), (3, LEVELS), (3, LEVELS), (3, LEVELS), (2, LEVELS), (2,)),
            *((ranges, 3, 3), (ranges, 3, 2), (ranges, 2, RANGE_LEVELS), (len(HEIGHTS), 3), (len(HEIGHTS), 2)),
        ]
        return cls(*map(np.zeros, shapes))

    def plus(self, other: Self) -> "ConfusionSums":
        """Return the sums of both."""
        return ConfusionSums(*map(add, self, other))


def accumulate(
    mass: NDArray[np.floating],
    state: NDArray[np.uint8],
    distance: NDArray[np.floating] | None = None,
    height_cm: NDArray[np.uint8] | None = None,
) -> ConfusionSums:
    """Return the sums of one grid that the scores and the curves need.

    Parameters
    ----------
    mass : (nx, ny, 2) float array
        Masses of free and occupied, as `EvidentialGrid.mass`.
    state : (nx, ny) uint8
        True states, as `Truth.state`: 0 unknown, 1 free, 2 occupied, 3 ignored.
    distance : (nx, ny) float array, optional
        Distances of the cells from the sensor [m], see `distances`; without them nothing is counted by range.
    height_cm : (nx, ny) uint8, optional
        Heights of the occupied cells' obstacles, as `Truth.height_cm`; without them nothing is counted by height.

    Raises
    ------
    ValueError
        If the shapes do not fit, a mass is invalid (NaN, below 0, a sum above 1), a state is none of the four,
        or a distance is negative or NaN.
    TypeError
        If the masses are not floating numbers.
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
    """Count the occupied cells whose obstacle is not lower than each of `HEIGHTS`."""
    if height_cm.shape != state.shape:
        raise ValueError(f"height_cm must have the cells' shape {state.shape}, got {height_cm.shape}")
    occupied = state == CellState.OCCUPIED
    found, heights = mass[occupied], height_cm[occupied]
    predicted, detected = predict_state(found), found > DETECTION
    for k, least in enumerate(HEIGHTS):
        high = heights >= round(100 * least)
        sums.high_confusion[k] = np.bincount(predicted[high], minlength=3)
        sums.high_detections[k] = detected[high].sum(axis=0)


def _count_obstacles(mass: NDArray[Any], state: NDArray[np.uint8], sums: ConfusionSums) -> NDArray[np.uint8]:
    """Count what needs the eight neighbours of a cell; return where an occupied cell lies within one cell."""
    ndimage = import_extra("scipy.ndimage", "evaluate")  # here, as it would double the time that the import takes

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
    least, most = float(mass.min(initial=0)), float((mass[..., 0] + mass[..., 1]).max(initial=0))
    if not (least >= -ROUNDING and most <= 1 + ROUNDING):
        check_mass(mass, ROUNDING)


def _check_distance(distance: NDArray[Any], state: NDArray[Any]) -> None:
    if distance.shape != state.shape or distance.dtype.kind != "f":
        raise ValueError(
            f"distance must be a float array of the cells' shape {state.shape}, got {distance.dtype} "
            f"{distance.shape}; see ogm.metrics.distances"
        )
    if not distance.min(initial=0.0) >= 0:
        raise ValueError(f"distances [m] are at least 0, got {distance.min()}")
