"""What is counted of every cell, compiled by numba."""

import math
from typing import Any

import numpy as np
from numba import njit

__all__ = ["count_cells", "count_ranges", "look_around"]

LOG_2 = math.log(2.0)
TINY = 1e-300  # in place of 0 in logarithms that are multiplied by it


@njit(cache=True, nogil=True, inline="always")
def _level(number: float, levels: int) -> int:
    """Return which of evenly spaced levels from 0 to 1 is nearest."""
    return int(min(max(number, 0.0), 1.0) * (levels - 1) + 0.5)


@njit(cache=True, nogil=True, inline="always")
def _call(free: float, occupied: float, unknown: float) -> int:
    """Return what a cell is called, as `ogm.metrics.called`: 0 unknown, 1 free, 2 occupied."""
    if occupied > unknown and occupied >= free:
        return 2
    return 1 if free > unknown and free > occupied else 0


@njit(cache=True, nogil=True)
def look_around(mass: Any, state: Any, near: Any, found: Any, obstacles: Any) -> None:
    """Look at every occupied cell, its eight neighbours, and the obstacle that it belongs to.

    Parameters
    ----------
    mass : (nx, ny, 2) float array
    state : (nx, ny) uint8
    near : (nx, ny) uint8
        Zeros; set to 1 where an occupied cell lies within one cell, and to 2 where one has been looked at.
    found : (levels,) float64
        Added to: occupied cells by the largest P(occupied) within one cell, ignored cells left out.
    obstacles : (2,) float64
        Added to: groups of occupied cells that touch at a side or corner; those without a cell of P > 1/2 within
        one cell of theirs.
    """
    nx, ny = state.shape
    stack = np.empty(nx * ny, np.int64)
    for start in range(nx * ny):
        if state[start // ny, start % ny] != 2 or near[start // ny, start % ny] == 2:
            continue
        near[start // ny, start % ny] = 2
        stack[0], waiting, largest = start, 1, 0.0
        while waiting:
            waiting -= 1
            i, j = stack[waiting] // ny, stack[waiting] % ny
            best = 0.0
            for a in range(max(i - 1, 0), min(i + 2, nx)):
                for b in range(max(j - 1, 0), min(j + 2, ny)):
                    if state[a, b] <= 2:
                        best = max(best, 0.5 * (1.0 + max(mass[a, b, 1], 0.0) - max(mass[a, b, 0], 0.0)))
                    if state[a, b] == 2 and near[a, b] != 2:
                        near[a, b] = 2
                        stack[waiting] = a * ny + b
                        waiting += 1
                    near[a, b] = max(near[a, b], 1)
            found[_level(best, found.shape[0])] += 1.0
            largest = max(largest, best)
        obstacles[0] += 1.0
        obstacles[1] += largest <= 0.5


@njit(cache=True, nogil=True)
def count_cells(
    mass: Any,
    state: Any,
    near: Any,
    least: float,
    sure: float,
    cells: Any,
    masses: Any,
    calls: Any,
    likelier: Any,
    claims: Any,
    reliability: Any,
    intervals: Any,
    squared: Any,
    surprise: Any,
    entropy: Any,
    dissonance: Any,
    doubt: Any,
    likely: Any,
    close: Any,
    clear: Any,
) -> None:
    """Count what `ogm.metrics.ConfusionSums` has of the cells. States: 0 unknown, 1 free, 2 occupied, else left out.

    Parameters
    ----------
    mass : (N, 2) float array
    state : (N,) uint8
    near : (N,) uint8
        As `look_around` leaves it.
    least, sure : float
        Floor of P(true state) in `surprise`, and the mass beyond which a claim is one.
    cells, ..., clear : float64 arrays
        Added to, as `ConfusionSums` has them; of `close` the first two rows.
    """
    bins, levels, log_least = reliability.shape[1], doubt.shape[1], math.log(least)
    for k in range(state.shape[0]):
        truth = state[k]
        if truth > 2:
            continue
        free, occupied = max(float(mass[k, 0]), 0.0), max(float(mass[k, 1]), 0.0)
        unknown = max(1.0 - free - occupied, 0.0)
        probability = 0.5 * (1.0 + occupied - free)
        cells[truth] += 1.0
        masses[truth, 0] += free
        masses[truth, 1] += occupied
        log_occupied = log_free = -LOG_2
        if free != occupied:
            log_occupied = math.log(max(probability, TINY))
            log_free = math.log(max(1.0 - probability, TINY))
        entropy[truth] -= (probability * log_occupied + (1.0 - probability) * log_free) / LOG_2
        dissonance[truth] += 2.0 * min(free, occupied)

        # Calls
        call = _call(free, occupied, unknown)
        calls[truth, call] += 1.0
        likelier[truth, 2 if occupied > free else 1 if free > occupied else 0] += 1.0
        claims[truth, 0] += free > sure
        claims[truth, 1] += occupied > sure
        vague = _level(unknown, levels)
        doubt[0 if truth > 0 else 1, vague] += 1.0

        # What is known to be free or occupied
        if truth == 0:
            continue
        happened = 1.0 if truth == 2 else 0.0
        error = abs(probability - happened)
        relative = occupied / (free + occupied) if free + occupied > 0.0 else 0.5
        doubt[2, vague] += 0.5 if free == occupied else 1.0 if (occupied > free) != (truth == 2) else 0.0
        squared[0] += error * error
        squared[1] += (relative - happened) ** 2
        squared[2] += error * error + probability * (1.0 - probability) * unknown / (2.0 + unknown)
        surprise[truth] -= max(log_occupied if truth == 2 else log_free, log_least)
        level = _level(probability, levels)
        likely[truth - 1, level] += 1.0
        likely[2, level] += probability
        close[0 if near[k] > 0 else 1, level] += 1.0
        clear[truth - 1, _level(free, levels)] += 1.0
        for n in range(3):
            if n == 1 and call == 0:
                continue
            claimed = relative if n == 2 else probability
            place = min(int(claimed * bins), bins - 1)
            reliability[n, place, 0] += 1.0
            reliability[n, place, 1] += claimed
            reliability[n, place, 2] += happened
        place = min(int(occupied * bins), bins - 1)
        intervals[place, 0] += 1.0
        intervals[place, 1] += occupied
        intervals[place, 2] += occupied + unknown
        intervals[place, 3] += happened


@njit(cache=True, nogil=True)
def count_ranges(
    mass: Any, state: Any, distance: Any, edges: Any, sure: float, calls: Any, claims: Any, clear: Any
) -> None:
    """Count calls and claims by the distance of the cells, as `count_cells` does.

    Parameters
    ----------
    mass : (N, 2) float array
    state : (N,) uint8
    distance : (N,) float array
    edges : (ranges + 1,) float64
    sure : float
    calls : (ranges, 3, 3), claims : (ranges, 3, 2), clear : (ranges, 2, levels)
        Added to.
    """
    last, levels = edges.shape[0] - 2, clear.shape[2]
    for k in range(state.shape[0]):
        truth = state[k]
        if truth > 2:
            continue
        r = 0
        while r < last and distance[k] >= edges[r + 1]:
            r += 1
        free, occupied = max(float(mass[k, 0]), 0.0), max(float(mass[k, 1]), 0.0)
        unknown = max(1.0 - free - occupied, 0.0)
        call = _call(free, occupied, unknown)
        calls[r, truth, call] += 1.0
        claims[r, truth, 0] += free > sure
        claims[r, truth, 1] += occupied > sure
        if truth > 0:
            clear[r, truth - 1, _level(free, levels)] += 1.0
