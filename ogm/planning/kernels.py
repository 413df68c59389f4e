"""Kernels for distances to obstacles, and for footprints on a grid."""

import numpy as np
from numpy.typing import NDArray

from ogm.jit import kernel, vector


@kernel
def squared_distances(obstacle: NDArray[np.bool_], out: NDArray[np.int64]) -> None:
    """Fill `out` with the squared distance of each cell to the nearest obstacle [cells²].

    Algorithm of Meijster, Roerdink and Hesselink, "A general algorithm for computing distance transforms in linear
    time" (2000): distances along x, then along y the lower envelope of one parabola per cell.

    Parameters
    ----------
    obstacle : (nx, ny) bool
        At least one cell is True.
    out : (nx, ny) int64
    """
    nx, ny = obstacle.shape
    far = np.int32(nx + ny)  # further than any distance in the grid
    along = np.empty((nx, ny), np.int32)
    for j in range(ny):
        along[0, j] = 0 if obstacle[0, j] else far
    for i in range(1, nx):
        for j in range(ny):
            along[i, j] = 0 if obstacle[i, j] else min(along[i - 1, j] + 1, far)
    for i in range(nx - 2, -1, -1):
        for j in range(ny):
            along[i, j] = min(along[i, j], along[i + 1, j] + 1)
    square, site, start = np.empty(ny, np.int64), np.empty(ny, np.int64), np.empty(ny, np.int64)
    for i in range(nx):
        for j in range(ny):
            square[j] = np.int64(along[i, j]) * along[i, j]
        last, site[0], start[0] = 0, 0, 0  # parabola of column site[k] is the least from column start[k] on
        for j in range(1, ny):
            while last >= 0:
                at, s = start[last], site[last]
                if (at - s) * (at - s) + square[s] <= (at - j) * (at - j) + square[j]:
                    break
                last -= 1
            if last < 0:
                last, site[0] = 0, j
                continue
            s = site[last]
            first = 1 + (j * j - s * s + square[j] - square[s]) // (2 * (j - s))
            if first < ny:
                last += 1
                site[last], start[last] = j, first
        for j in range(ny - 1, -1, -1):
            s = site[last]
            out[i, j] = (j - s) * (j - s) + square[s]
            if j == start[last]:
                last -= 1


@vector
def footprint_extremes(
    mass: NDArray[np.float32], corners: NDArray[np.float64], convex: bool, out: NDArray[np.float32]
) -> None:
    """Fill `out` with extremes of the masses in all cells that polygons touch.

    A polygon touches the cells that its edges pass through, and the cells with their centre inside.

    Parameters
    ----------
    mass : (nx, ny, 2) float32
        Masses of free and occupied; beyond the grid both are 0.
    corners : (K, V, 2) float64
        Corners of each polygon [cells], finite; two corners are a line.
    convex : bool
        Whether the polygons are convex: each row of cells is then read only once.
    out : (K, 3) float32
        Greatest mass of occupied, least mass of free, least sum of both.
    """
    nx, ny, count = mass.shape[0], mass.shape[1], corners.shape[1]
    crossings = np.empty(count, np.float64)
    for k in range(corners.shape[0]):
        polygon, found = corners[k], out[k]
        u_min, u_max, v_min, v_max = np.inf, -np.inf, np.inf, -np.inf
        for e in range(count):
            u_min, u_max = min(u_min, polygon[e, 0]), max(u_max, polygon[e, 0])
            v_min, v_max = min(v_min, polygon[e, 1]), max(v_max, polygon[e, 1])
        found[0] = 0
        found[1:] = 1 if u_min >= 0 and v_min >= 0 and u_max < nx and v_max < ny else 0
        for i in range(int(min(max(u_min, 0.0), float(nx))), int(min(max(u_max + 1, 0.0), float(nx)))):
            crossed, lowest, highest = 0, np.inf, -np.inf
            for e in range(count):
                before = e - 1 if e else count - 1
                u, v, p, q = polygon[before, 0], polygon[before, 1], polygon[e, 0], polygon[e, 1]
                if max(u, p) < i or min(u, p) >= i + 1:
                    continue
                low, high = min(v, q), max(v, q)
                if u != p:  # the part of the edge in this row of cells
                    slope = (q - v) / (p - u)
                    v_begin = v + slope * (max(min(u, p), float(i)) - u)
                    v_end = v + slope * (min(max(u, p), i + 1.0) - u)
                    low, high = max(low, min(v_begin, v_end)), min(high, max(v_begin, v_end))
                    if (u <= i + 0.5) != (p <= i + 0.5):
                        crossings[crossed] = v + slope * (i + 0.5 - u)
                        crossed += 1
                lowest, highest = min(lowest, low), max(highest, high)
                if not convex:
                    _add_cells(mass, i, low, high, found)
            if convex:
                _add_cells(mass, i, lowest, highest, found)
                continue
            crossings[:crossed].sort()
            for c in range(0, crossed - 1, 2):
                _add_cells(mass, i, crossings[c], crossings[c + 1], found)


@vector
def _add_cells(mass: NDArray[np.float32], i: int, low: float, high: float, found: NDArray[np.float32]) -> None:
    """Update the extremes by the cells of row i from `low` to `high` [cells]."""
    ny = float(mass.shape[1])
    cells = mass[i, int(min(max(low, 0.0), ny)) : int(min(max(high + 1, 0.0), ny))]
    occupied, free, known = found[0], found[1], found[2]
    for j in range(cells.shape[0]):
        occupied = max(occupied, cells[j, 1])
        free = min(free, cells[j, 0])
        known = min(known, cells[j, 0] + cells[j, 1])
    found[0], found[1], found[2] = occupied, free, known
