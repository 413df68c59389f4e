"""Kernels that find the moving cells of a grid and join them to groups. They check nothing."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.dynamic.groups import find_root
from ogm.jit import kernel


@kernel
def moving_cells(
    mass: NDArray[Any], velocity: NDArray[Any], dynamic: float, share: float, speed: float
) -> NDArray[Any]:
    """Return the indices of the moving cells, (K, 2) int64, row by row."""
    nx, ny = mass.shape[:2]
    found = np.empty((nx * ny, 2), np.int64)
    count = 0
    for i in range(nx):
        for j in range(ny):
            d = mass[i, j, 2]
            if d < dynamic or d <= 0 or d < share * (d + mass[i, j, 1]):
                continue
            vx, vy = velocity[i, j, 0], velocity[i, j, 1]
            if vx * vx + vy * vy >= speed * speed:  # false for NaN
                found[count, 0], found[count, 1] = i, j
                count += 1
    return found[:count].copy()


@kernel
def join_cells(
    cells: NDArray[Any], velocity: NDArray[Any], place: NDArray[Any], reach: int, gate: tuple[float, float]
) -> NDArray[Any]:
    """Return the group number of each cell, (K,) int64, in the order of their first cells.

    Groups are joined by union-find: the root of a group is its first cell.

    Parameters
    ----------
    cells : (K, 2) int64
        Sorted row by row.
    velocity : (nx, ny, 2) float32
        Velocity [m/s], finite in the cells.
    place : (nx, ny) int32
        Zeros; set to 1 + index in `cells`.
    reach : int
        Distance along each axis up to which cells are neighbours [cells].
    gate : (float, float)
        Greatest difference between velocities of neighbours [m/s], and its growth with the greater of their speeds.
    """
    count = len(cells)
    root = np.arange(count)
    for k in range(count):
        i, j = cells[k]
        place[i, j] = k + 1
        vx, vy = velocity[i, j, 0], velocity[i, j, 1]
        for a in range(max(i - reach, 0), i + 1):
            for b in range(max(j - reach, 0), min(j + reach + 1, place.shape[1])):
                other = place[a, b] - 1
                if other < 0 or other == k:
                    continue
                ux, uy = velocity[a, b, 0], velocity[a, b, 1]
                limit = gate[0] + gate[1] * np.sqrt(max(vx * vx + vy * vy, ux * ux + uy * uy))
                if (vx - ux) ** 2 + (vy - uy) ** 2 > limit * limit:
                    continue
                p, q = find_root(root, k), find_root(root, other)
                root[max(p, q)] = min(p, q)
    number = np.empty(count, np.int64)
    groups = 0
    for k in range(count):
        first = find_root(root, k)
        if first == k:
            number[k] = groups
            groups += 1
        else:
            number[k] = number[first]
    return number
