"""Kernels that match groups of occupied cells with the occupied cells of earlier scans.

The cost of a displacement is a sum over the cells of a group. A sum of interpolated values equals the interpolated sum,
so each group needs one table of sums per earlier scan, from which the cost of any velocity is interpolated. The sums
are of integers, so their order does not matter.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.dynamic.groups import LEVELS, Groups
from ogm.jit import kernel, vector

MAX_CELLS = 655  # of one group, so that sums of levels fit in 16 bits
UNSEEN = LEVELS // 2  # level of cells that were not measured: the group may have been there or not
NEAR = 2  # [nodes] from the best that enter the mean
FAR = np.float32(12.0)  # exponent beyond which a velocity is left out of the moments


class MatchNumbers(NamedTuple):
    """Parameters of a search, in cells and seconds.

    Attributes
    ----------
    reach : int
        Greatest displacement since the oldest scan [cells].
    step : float
        Speed of one cell since the oldest scan [m/s].
    cap : float
        Upper bound of the distance [cells].
    speed_cost : float
        Distance added per speed [cells / (m/s)].
    spread : float
        A velocity that costs spread / sqrt(cells) more than the minimum is e times less likely [cells].
    gate : float
        Greatest difference from the expected velocity [m/s].
    margin : int
        Cells within this distance of cells that others still occupy do not match [cells].
    max_cells : int
        Greatest number of cells that are matched in a group.
    """

    reach: int
    step: float
    cap: float
    speed_cost: float
    spread: float
    gate: float
    margin: int
    max_cells: int


@vector
def _sum_levels(
    field: NDArray[np.uint8], x: NDArray[Any], y: NDArray[Any], reach: int, out: NDArray[np.uint16]
) -> None:
    """Fill out[a, b] with the sum of the levels at cells (x + a - reach, y + b - reach)."""
    width, side = field.shape[1], len(out)
    flat, fours = field.reshape(-1), x.size - x.size % 4
    for a in range(side):
        line = out[a]
        for b in range(side):
            line[b] = 0
        start = (a - reach) * width - reach
        for k in range(0, fours, 4):
            # Unsigned: code for negative indices would slow the loop down.
            p, q = np.uint64(start + x[k] * width + y[k]), np.uint64(start + x[k + 1] * width + y[k + 1])
            r, s = np.uint64(start + x[k + 2] * width + y[k + 2]), np.uint64(start + x[k + 3] * width + y[k + 3])
            for b in range(np.uint64(side)):
                first, third = np.uint16(flat[p + b]) + np.uint16(flat[q + b]), np.uint16(flat[r + b])
                line[b] += first + third + np.uint16(flat[s + b])
        for k in range(fours, x.size):
            p = np.uint64(start + x[k] * width + y[k])
            for b in range(np.uint64(side)):
                line[b] += np.uint16(flat[p + b])


@vector
def _add_interpolated(sums: NDArray[np.uint16], ratio: float, weight: np.float32, total: NDArray[np.float32]) -> None:
    """Add the sums of a scan to the cost of velocities, at `ratio` times the displacements of the oldest scan."""
    side, inner = len(total), len(sums) // 2
    low, share = np.empty(side, np.int32), np.empty(side, np.float32)
    for j in range(side):
        at = inner + (j - side // 2) * ratio
        low[j] = min(int(at), 2 * inner - 1)
        share[j] = at - low[j]
    columns = np.empty((len(sums), side), np.float32)
    for a in range(len(sums)):
        for j in range(side):
            left, right = np.float32(sums[a, low[j]]), np.float32(sums[a, low[j] + 1])
            columns[a, j] = weight * (left + share[j] * (right - left))
    for i in range(side):
        _add_between(columns[low[i]], columns[low[i] + 1], share[i], total[i])


@vector
def _add_between(
    lower: NDArray[np.float32], upper: NDArray[np.float32], share: np.float32, out: NDArray[np.float32]
) -> None:
    for j in range(out.size):
        out[j] += lower[j] + share * (upper[j] - lower[j])


@kernel
def match_groups(
    occupied: NDArray[np.uint8],
    groups: Groups,
    fields: NDArray[np.uint8],
    ratios: NDArray[np.float64],
    expected: NDArray[np.float64],
    numbers: MatchNumbers,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Find the velocity of least cost for each group.

    Parameters
    ----------
    occupied : (nx, ny) uint8
        Occupied cells now, 0 or 1.
    groups : Groups
        Groups of these cells.
    fields : (K, nx, ny) uint8
        Output of `capped_distance` for each earlier scan.
    ratios : (K,) float64
        Age of each scan over the age of the oldest.
    expected : (G, 2) float64
        Centre of the search [m/s]; NaN for none.
    numbers : MatchNumbers

    Returns
    -------
    velocity : (G, 2) float64
        [m/s]
    covariance : (G, 2, 2) float64
        Second moments about the velocity [m²/s²].
    cost : (G, 2) float64
        Mean distance at the velocity and at 0 [cells], without the speed cost.
    unseen : (G, 2) float64
        Share of the cells, over all earlier scans, that were not measured at these velocities.
    """
    count, R, step = len(groups.start) - 1, numbers.reach, numbers.step
    side = 2 * R + 1
    total, surcharge = np.empty((side, side), np.float32), np.empty((side, side), np.float32)
    for i in range(side):
        for j in range(side):
            speed = step * np.sqrt((i - R) ** 2 + (j - R) ** 2)
            surcharge[i, j] = numbers.speed_cost * speed if speed <= (R + 1e-6) * step else np.inf
    nx, ny = occupied.shape
    left = np.full((len(fields), nx + 2 * R, ny + 2 * R), np.uint8(UNSEEN))  # with a border of R cells
    for k in range(len(fields)):
        for i in range(nx):
            for j in range(ny):
                left[k, i + R, j + R] = fields[k, i, j]
    now_x, now_y = np.nonzero(occupied)
    _block_near(left, now_x, now_y, numbers.margin, R)  # objects that are still there have not moved
    velocity, covariance = np.zeros((count, 2)), np.zeros((count, 2, 2))
    cost, unseen = np.empty((count, 2)), np.empty((count, 2))
    for g in range(count):
        x, y = groups.x[groups.start[g] : groups.start[g + 1]], groups.y[groups.start[g] : groups.start[g + 1]]
        _restore_near(left, fields, x, y, numbers.margin, R)
        few_x, few_y = _some(x, numbers.max_cells, R), _some(y, numbers.max_cells, R)
        total[:] = 0
        weight = np.float32(numbers.cap / (LEVELS * len(few_x) * len(fields)))
        for k in range(len(fields)):
            reach = int(np.ceil(R * ratios[k] - 1e-9))
            sums = np.empty((2 * reach + 1, 2 * reach + 1), np.uint16)
            _sum_levels(left[k], few_x, few_y, reach, sums)
            _add_interpolated(sums, ratios[k], weight, total)
        p, q = _least(total, surcharge, expected[g], numbers)
        for n, (i, j) in enumerate(((p, q), (R, R))):
            unseen[g, n] = _unseen(left, few_x, few_y, ratios, (i - R, j - R)) / (len(few_x) * len(fields))
            cost[g, n] = total[i, j]
        _block_near(left, x, y, numbers.margin, R)
        mean = _moments(total, surcharge, (p, q), np.sqrt(len(x)) / numbers.spread, covariance[g])
        velocity[g, 0], velocity[g, 1] = (
            -step * (p - R + mean[0]),
            -step * (q - R + mean[1]),
        )  # displacements are backward
        for i in range(2):
            for j in range(2):
                covariance[g, i, j] *= step * step
    return velocity, covariance, cost, unseen


@kernel
def _unseen(
    left: NDArray[np.uint8],
    x: NDArray[np.int64],
    y: NDArray[np.int64],
    ratios: NDArray[np.float64],
    shift: tuple[int, int],
) -> int:
    """Return the number of unmeasured cells over all scans, at a displacement since the oldest scan."""
    count = 0
    for k in range(len(left)):
        a, b = int(np.rint(shift[0] * ratios[k])), int(np.rint(shift[1] * ratios[k]))
        for n in range(len(x)):
            count += left[k, x[n] + a, y[n] + b] == UNSEEN
    return count


@kernel
def _block_near(left: NDArray[np.uint8], x: NDArray[Any], y: NDArray[Any], margin: int, border: int) -> None:
    """Set cells, and all cells within `margin` of them, to the cap."""
    nx, ny = left.shape[1] - 2 * border, left.shape[2] - 2 * border
    for k in range(len(left)):
        for n in range(len(x)):
            for i in range(max(x[n] - margin, 0), min(x[n] + margin + 1, nx)):
                for j in range(max(y[n] - margin, 0), min(y[n] + margin + 1, ny)):
                    left[k, i + border, j + border] = LEVELS


@kernel
def _restore_near(
    left: NDArray[np.uint8],
    fields: NDArray[np.uint8],
    x: NDArray[np.int32],
    y: NDArray[np.int32],
    margin: int,
    border: int,
) -> None:
    """Restore the distances of cells, and of all cells within `margin` of them."""
    nx, ny = fields.shape[1:]
    for k in range(len(left)):
        for n in range(len(x)):
            for i in range(max(x[n] - margin, 0), min(x[n] + margin + 1, nx)):
                for j in range(max(y[n] - margin, 0), min(y[n] + margin + 1, ny)):
                    left[k, i + border, j + border] = fields[k, i, j]


@kernel
def _some(values: NDArray[np.int32], max_count: int, shift: int) -> NDArray[np.int64]:
    """Return at most `max_count` of the values, evenly chosen, plus `shift`."""
    some = np.empty(min(len(values), max_count), np.int64)
    for n in range(len(some)):
        some[n] = values[n * len(values) // len(some)] + shift
    return some


@kernel
def _least(
    total: NDArray[np.float32], surcharge: NDArray[np.float32], expected: NDArray[np.float64], numbers: MatchNumbers
) -> tuple[int, int]:
    """Return the node of least cost, within `gate` of the expected velocity if this is finite."""
    R, step = numbers.reach, numbers.step
    gated = np.isfinite(expected[0]) and np.isfinite(expected[1])
    least, p, q = np.inf, R, R
    for i in range(len(total)):
        for j in range(len(total)):
            value = total[i, j] + surcharge[i, j]
            if value < least:
                if gated and np.hypot(step * (R - i) - expected[0], step * (R - j) - expected[1]) > numbers.gate:
                    continue
                least, p, q = value, i, j
    return p, q


@vector
def _moments(
    total: NDArray[np.float32],
    surcharge: NDArray[np.float32],
    best: tuple[int, int],
    sharpness: float,
    out: NDArray[np.float64],
) -> tuple[float, float]:
    """Return the weighted mean near the best node, relative to it; fill `out` (2, 2) with the moments about the mean.

    Weights are exp(-sharpness excess). The mean is over nodes within `NEAR`, the moments [nodes²] over all nodes.
    """
    side = len(total)
    p, q = best
    least = total[p, q] + surcharge[p, q]
    scale, limit = np.float32(sharpness), FAR / np.float32(sharpness)
    weights = x = y = xx = xy = yy = 0.0
    near = near_x = near_y = 0.0
    for i in range(side):
        for j in range(side):
            excess = total[i, j] + surcharge[i, j] - least
            if excess < limit:
                weight = np.exp(-scale * max(excess, np.float32(0)))
                a, b = i - p, j - q
                weights += weight
                x += weight * a
                y += weight * b
                xx += weight * a * a
                xy += weight * a * b
                yy += weight * b * b
                if abs(a) <= NEAR and abs(b) <= NEAR:
                    near += weight
                    near_x += weight * a
                    near_y += weight * b
    u, v = near_x / near, near_y / near
    x, y = x / weights, y / weights
    out[0, 0] = xx / weights - 2 * u * x + u * u
    out[0, 1] = out[1, 0] = xy / weights - u * y - v * x + u * v
    out[1, 1] = yy / weights - 2 * v * y + v * v
    return u, v
