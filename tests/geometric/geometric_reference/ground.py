"""`local_ground` cell by cell."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.reference import cell_of
from ogm.grid import GridSpec

__all__ = ["ground_map", "lower_envelope", "pull_push"]

Point = tuple[float, float, float]


def lower_envelope(height: NDArray[Any], rise: float) -> NDArray[Any]:
    """Return the minimum over all cells of their height plus `rise` times their chamfer distance, for each cell.

    Chamfer distance: sqrt(2) per diagonal step, 1 per straight step.
    """
    result = np.full(height.shape, np.inf)
    cells = [(i, j, height[i, j]) for i, j in np.ndindex(*height.shape) if np.isfinite(height[i, j])]
    for i, j in np.ndindex(*height.shape):
        for k, l, h in cells:  # noqa: E741
            a, b = sorted((abs(i - k), abs(j - l)))
            result[i, j] = min(result[i, j], h + rise * (b - a + math.sqrt(2) * a))
    return result


def ground_map(
    xyz: NDArray[Any],
    ground_point: Point,
    spec: GridSpec,
    max_slope: float,
    max_descent: float,
    low_tolerance: float,
    band: float,
) -> NDArray[Any]:
    """Return the heights of `local_ground`, cell by cell, in the same four steps.

    Parameters
    ----------
    xyz : (N, 3) float array
        Points [m].
    ground_point : (x, y, z)
        Ground under the sensor [m].
    spec : GridSpec
    max_slope, max_descent : float
        Rise over run, from cell to cell and on average down from the ground point.
    low_tolerance, band : float
        See `ogm.geometric.ground.LOW_TOLERANCE` and `BAND` [m].

    Returns
    -------
    (nx, ny) float64
        Heights [m].
    """
    home = cell_of(spec, ground_point[0], ground_point[1])
    cells: dict[tuple[int, int], list[float]] = {}
    lowest = np.full(spec.shape, np.inf)
    for x, y, z in xyz.tolist():
        if spec.contains(x, y):
            cell = cell_of(spec, x, y)
            cells.setdefault(cell, []).append(z)
            if ground_point[2] - low_tolerance - z <= max_descent * math.dist((x, y), ground_point[:2]):
                lowest[cell] = min(lowest[cell], z)

    # Stray returns, ring by ring of cells away from the ground point
    def ring_of(cell: tuple[int, ...]) -> int:
        return max(abs(cell[0] - home[0]), abs(cell[1] - home[1]))

    ground, steps = {home: ground_point[2]}, {home: 0}
    for cell in sorted(np.ndindex(*spec.shape), key=ring_of):
        if cell == home:
            continue
        inner = [c for c in ground if ring_of(c) == ring_of(cell) - 1 and math.dist(c, cell) < 1.5]
        weights = [1 / (1 + steps[c]) for c in inner]
        expected = sum(w * ground[c] for w, c in zip(weights, inner, strict=True)) / sum(weights)
        since = min(steps[c] for c in inner) + 1
        above, allowed = lowest[cell] - expected, low_tolerance + max_descent * spec.resolution * since
        ground[cell], steps[cell] = (lowest[cell], 0) if abs(above) <= allowed else (expected, since)
        if above < -allowed:
            lowest[cell] = np.inf

    # Ground: cells that touch the envelope, at the mean of the lowest layer or of a thin dense layer above it
    lowest[home] = min(lowest[home], ground_point[2])
    envelope = lower_envelope(lowest, max_slope * spec.resolution)
    height, weight = np.zeros(spec.shape), np.zeros(spec.shape)
    for cell, low in np.ndenumerate(lowest):
        if low > envelope[cell] + 1e-6 or not np.isfinite(low):
            continue
        above = np.array(cells.get(cell, [])) - low
        layers = [above[(above >= k * band) & (above < (k + 1) * band)] for k in range(3)]
        dense = len(layers[1]) >= 10 * len(layers[0]) and len(layers[1]) >= 10 * len(layers[2])
        layer = layers[1] if dense else layers[0]
        if len(layer):
            height[cell], weight[cell] = low + layer.mean(), min(len(layer), 8)
        elif cell == home:
            height[cell], weight[cell] = ground_point[2], 1
    limit = lower_envelope(np.where(weight > 0, height, np.inf), max_slope * spec.resolution)
    return np.where(weight > 0, height, np.minimum(pull_push(height, weight, ground_point[2]), limit))


def pull_push(height: NDArray[Any], weight: NDArray[Any], otherwise: float) -> NDArray[Any]:
    """Fill cells of weight 0 by interpolated means over blocks of 2 x 2, 4 x 4, ... cells (recursive)."""
    if max(height.shape) <= 2:
        mean = (weight * height).sum() / weight.sum() if weight.sum() else otherwise
        return np.where(weight > 0, height, mean)
    half = tuple(max((n + 1) // 2, 2) for n in height.shape)
    pad = [(0, 2 * h - n) for h, n in zip(half, height.shape, strict=True)]
    blocks = (half[0], 2, half[1], 2)
    total = np.pad(weight, pad).reshape(blocks).sum((1, 3))
    known = np.pad(weight * height, pad).reshape(blocks).sum((1, 3)) / np.maximum(total, 1e-9)
    coarse = pull_push(known, np.minimum(total, 8), otherwise)
    result = height.copy()
    for i, j in np.argwhere(weight == 0):
        u, v = (min(max((k + 0.5) / 2 - 0.5, 0), n - 1) for k, n in zip((i, j), half, strict=True))
        a, b = min(int(u), half[0] - 2), min(int(v), half[1] - 2)
        p, q = u - a, v - b
        corners = coarse[a : a + 2, b : b + 2]
        result[i, j] = np.array([1 - p, p]) @ corners @ np.array([1 - q, q])
    return result
