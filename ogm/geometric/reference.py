"""Reference of `HeightBandISM`: a line of cells for every return."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.height_band import HeightBandISM
from ogm.grid import GridSpec

__all__ = ["height_band_mass", "line_cells"]

Point = tuple[float, float, float]


def line_cells(start: tuple[int, int], end: tuple[int, int]) -> Iterator[tuple[int, int]]:
    """Yield the cells of Bresenham's line from `start` to `end`, both included.

    The shorter axis is rounded to the nearest cell, halves away from the start.
    """
    (i0, j0), (i1, j1) = start, end
    di, dj = i1 - i0, j1 - j0
    steps = max(abs(di), abs(dj))
    for n in range(steps + 1):
        if steps == 0:
            yield start
            continue
        a, b = (2 * n * abs(di) + steps) // (2 * steps), (2 * n * abs(dj) + steps) // (2 * steps)
        yield i0 + (a if di >= 0 else -a), j0 + (b if dj >= 0 else -b)


def height_band_mass(xyz: NDArray[Any], ism: HeightBandISM) -> NDArray[np.float32]:
    """Return the masses of `HeightBandISM` without supersampling, from a line per return.

    Parameters
    ----------
    xyz : (N, 3) float array
        Points in the frame of the grid [m].
    ism : HeightBandISM
        Model with a mount.

    Returns
    -------
    (nx, ny, 2) float32
    """
    assert ism.mount is not None
    spec, (x0, y0, ground) = ism.spec, ism.mount.ground_point
    origin = (x0, y0, float(ism.mount.origin[2]))
    low, high = ground + ism.z_min, ground + ism.z_max
    occupied, free = np.zeros(spec.shape, bool), np.zeros(spec.shape, bool)
    ends = []
    for x, y, z in xyz.tolist():
        if not low < z < high or math.dist((x, y, z), origin) <= ism.min_range:
            continue
        if spec.contains(x, y):
            ends.append(cell_of(spec, x, y))
            occupied[ends[-1]] = True
        else:
            ends.append(_leave(spec, origin, x, y))
    for end in ends:
        for cell in line_cells(cell_of(spec, x0, y0), end):
            if occupied[cell]:
                break
            free[cell] = True
    mass = np.zeros((*spec.shape, 2), np.float32)
    mass[free, 0] = mass[occupied, 1] = ism.evidence / (ism.evidence + 2)
    return mass


def cell_of(spec: GridSpec, x: float, y: float) -> tuple[int, int]:
    """Return the cell of a point, also beyond the grid."""
    i, j = spec.index(x, y, unbounded=True)
    return int(i), int(j)


def _leave(spec: GridSpec, origin: Point, x: float, y: float) -> tuple[int, int]:
    """Return the last grid cell on the ray from `origin` to a point beyond the grid."""
    x0, x1, y0, y1 = spec.extent
    share = 1.0
    for start, end, low, high in ((origin[0], x, x0, x1), (origin[1], y, y0, y1)):
        if end < low:
            share = min(share, (start - low) / (start - end))
        elif end >= high:
            share = min(share, (high - start) / (end - start))
    i, j = cell_of(spec, origin[0] + share * (x - origin[0]), origin[1] + share * (y - origin[1]))
    return min(max(i, 0), spec.shape[0] - 1), min(max(j, 0), spec.shape[1] - 1)
