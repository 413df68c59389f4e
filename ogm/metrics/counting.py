"""Counting of cells, compiled by numba."""

import math
from typing import TYPE_CHECKING, Any

from ogm.jit import inline, kernel
from ogm.metrics.divergence import MIN_UNKNOWN
from ogm.state import CellState

if TYPE_CHECKING:
    from ogm.metrics.counts import ConfusionSums

_LOG_2 = math.log(2.0)
_MIN_LOG = math.log(MIN_UNKNOWN / 2)  # of P(true state) in the log loss: a wrong dogmatic cell costs 11.5 nats
DETECTION = 0.5  # mass above which a state is detected
_TINY = 1e-300  # replaces 0 in logarithms that are multiplied by 0
_UNKNOWN, _FREE, _OCCUPIED = int(CellState.UNKNOWN), int(CellState.FREE), int(CellState.OCCUPIED)


@inline
def nearest_level(number: Any, levels: int) -> int:
    """Return the nearest of evenly spaced levels from 0 to 1."""
    return int(min(max(number, 0.0), 1.0) * (levels - 1) + 0.5)


@inline
def _predicted(free: float, occupied: float, unknown: float) -> int:
    """Return the predicted state of a cell, see `ogm.state.predict_state`."""
    if occupied > unknown and occupied >= free:
        return _OCCUPIED
    return _FREE if free > unknown and free > occupied else _UNKNOWN


@kernel
def count_neighbours(mass: Any, state: Any, groups: Any, near: Any, best_of_group: Any, sums: "ConfusionSums") -> None:
    """Add every occupied cell to `p_occupied_hist_tol1` by the largest P(occupied) within one cell.

    Parameters
    ----------
    mass : (nx, ny, 2) float array
    state : (nx, ny) uint8
    groups : (nx, ny) int
        Number of the group of touching occupied cells, from 1.
    near : (nx, ny) uint8
        Zeros; set to 1 in cells within one cell of an occupied cell.
    best_of_group : (groups + 1,) float64
        Zeros; set to the largest P(occupied) within one cell of the group, ignored cells left out.
    sums : ConfusionSums
    """
    nx, ny = state.shape
    levels = sums.p_occupied_hist_tol1.shape[1]
    for i in range(nx):
        for j in range(ny):
            if state[i, j] != _OCCUPIED:
                continue
            best = 0.0
            for a in range(max(i - 1, 0), min(i + 2, nx)):
                for b in range(max(j - 1, 0), min(j + 2, ny)):
                    near[a, b] = 1
                    if state[a, b] <= _OCCUPIED:
                        best = max(best, 0.5 * (1.0 + max(mass[a, b, 1], 0.0) - max(mass[a, b, 0], 0.0)))
            sums.p_occupied_hist_tol1[2, nearest_level(best, levels)] += 1.0
            best_of_group[groups[i, j]] = max(best_of_group[groups[i, j]], best)


@kernel
def count_cells(mass: Any, state: Any, near: Any, sums: "ConfusionSums") -> None:
    """Add every cell to the sums that need no neighbours; ignored cells are left out.

    Parameters
    ----------
    mass : (N, 2) float array
    state : (N,) uint8
    near : (N,) uint8
        Not 0 in cells within one cell of an occupied cell.
    sums : ConfusionSums
        Changed in place; `p_occupied_hist_tol1` in its first two rows.
    """
    bins, levels = sums.reliability.shape[1], sums.unknown_hist.shape[1]
    for k in range(state.shape[0]):
        truth = state[k]
        if truth > _OCCUPIED:
            continue
        free, occupied = max(float(mass[k, 0]), 0.0), max(float(mass[k, 1]), 0.0)
        unknown = max(1.0 - free - occupied, 0.0)
        probability = 0.5 * (1.0 + occupied - free)
        sums.cells[truth] += 1.0
        sums.mass[truth, 0] += free
        sums.mass[truth, 1] += occupied
        log_occupied = log_free = -_LOG_2
        if free != occupied:
            log_occupied = math.log(max(probability, _TINY))
            log_free = math.log(max(1.0 - probability, _TINY))
        sums.entropy[truth] -= (probability * log_occupied + (1.0 - probability) * log_free) / _LOG_2
        sums.dissonance[truth] += 2.0 * min(free, occupied)

        # Predictions
        predicted = _predicted(free, occupied, unknown)
        sums.confusion[truth, predicted] += 1.0
        by_probability = _OCCUPIED if occupied > free else _FREE if free > occupied else _UNKNOWN
        sums.confusion_by_probability[truth, by_probability] += 1.0
        sums.detections[truth, 0] += free > DETECTION
        sums.detections[truth, 1] += occupied > DETECTION
        unknown_level = nearest_level(unknown, levels)
        sums.unknown_hist[0 if truth > 0 else 1, unknown_level] += 1.0

        # Known cells
        if truth == _UNKNOWN:
            continue
        is_occupied = 1.0 if truth == _OCCUPIED else 0.0
        error = abs(probability - is_occupied)
        relative = occupied / (free + occupied) if free + occupied > 0.0 else 0.5
        wrong = 0.5 if free == occupied else 1.0 if (occupied > free) != (truth == _OCCUPIED) else 0.0
        sums.unknown_hist[2, unknown_level] += wrong
        sums.squared_error[0] += error * error
        sums.squared_error[1] += (relative - is_occupied) ** 2
        sums.squared_error[2] += error * error + probability * (1.0 - probability) * unknown / (2.0 + unknown)
        sums.log_loss[truth] -= max(log_occupied if truth == _OCCUPIED else log_free, _MIN_LOG)
        level = nearest_level(probability, levels)
        sums.p_occupied_hist[truth - 1, level] += 1.0
        sums.p_occupied_hist[2, level] += probability
        sums.p_occupied_hist_tol1[0 if near[k] > 0 else 1, level] += 1.0
        sums.bel_free_hist[truth - 1, nearest_level(free, levels)] += 1.0
        for n in range(3):
            if n == 1 and predicted == _UNKNOWN:
                continue
            value = relative if n == 2 else probability
            place = min(int(value * bins), bins - 1)
            sums.reliability[n, place, 0] += 1.0
            sums.reliability[n, place, 1] += value
            sums.reliability[n, place, 2] += is_occupied
        place = min(int(occupied * bins), bins - 1)
        sums.intervals[place, 0] += 1.0
        sums.intervals[place, 1] += occupied
        sums.intervals[place, 2] += occupied + unknown
        sums.intervals[place, 3] += is_occupied


@kernel
def count_ranges(mass: Any, state: Any, distance: Any, edges: Any, sums: "ConfusionSums") -> None:
    """Add every cell to the sums by distance, (N,), in bins with given edges, (ranges + 1,) float64."""
    last, levels = edges.shape[0] - 2, sums.range_bel_free_hist.shape[2]
    for k in range(state.shape[0]):
        truth = state[k]
        if truth > _OCCUPIED:
            continue
        r = 0
        while r < last and distance[k] >= edges[r + 1]:
            r += 1
        free, occupied = max(float(mass[k, 0]), 0.0), max(float(mass[k, 1]), 0.0)
        unknown = max(1.0 - free - occupied, 0.0)
        sums.range_confusion[r, truth, _predicted(free, occupied, unknown)] += 1.0
        sums.range_detections[r, truth, 0] += free > DETECTION
        sums.range_detections[r, truth, 1] += occupied > DETECTION
        if truth != _UNKNOWN:
            sums.range_bel_free_hist[r, truth - 1, nearest_level(free, levels)] += 1.0
