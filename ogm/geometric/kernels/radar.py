"""Kernels of the radar model: cleared cells and marked ellipses."""

import math

import numpy as np
from numpy.typing import NDArray

from ogm.jit import kernel

__all__ = ["clear_cells", "mark_ellipses"]

REACH = 3.0  # [standard deviations] radius of an ellipse


@kernel
def clear_cells(
    sector: NDArray[np.int32],
    distance: NDArray[np.float32],
    until: NDArray[np.float32],
    table: NDArray[np.float32],
    free: NDArray[np.float32],
) -> None:
    """Write the mass of free of each cell.

    Parameters
    ----------
    sector, distance : (nx, ny) int32, float32
        Sector, -1 for an unseen cell, and distance [m] of each cell.
    until : (sectors,) float32
        Range of the cleared part of each sector [m].
    table : (metres,) float32
        Mass of free by range [m].
    free : (nx, ny) float32
        0 before the call.
    """
    for i in range(sector.shape[0]):
        for j in range(sector.shape[1]):
            s = sector[i, j]
            if s >= 0 and distance[i, j] < until[s]:
                free[i, j] = table[int(distance[i, j])]


@kernel
def mark_ellipses(
    rows: NDArray[np.float64],
    place: NDArray[np.float64],
    free: NDArray[np.float32],
    ego: NDArray[np.bool_],
    mass: NDArray[np.float32],
) -> None:
    """Write masses: occupied from all ellipses as independent sources, free scaled by the remaining mass.

    Parameters
    ----------
    rows : (N, 6) float64
        For each detection x, y, cosine and sine of the bearing, standard deviation across the beam [m], largest mass.
    place : (4,) float64
        Origin and resolution of the grid, standard deviation along the beam [m].
    free : (nx, ny) float32
    ego : (nx, ny) bool
        Cells that stay unknown.
    mass : (nx, ny, 2) float32
        0 before the call.
    """
    x0, y0, cell, along = place
    nx, ny = free.shape
    for n in range(len(rows)):
        x, y, c, s, across, peak = rows[n]
        wide = REACH * math.sqrt((c * along) ** 2 + (s * across) ** 2) + cell
        high = REACH * math.sqrt((s * along) ** 2 + (c * across) ** 2) + cell
        first, last = max(int((x - wide - x0) / cell), 0), min(int((x + wide - x0) / cell) + 1, nx)
        low, top = max(int((y - high - y0) / cell), 0), min(int((y + high - y0) / cell) + 1, ny)
        for i in range(first, last):
            dx = x0 + (i + 0.5) * cell - x
            for j in range(low, top):
                dy = y0 + (j + 0.5) * cell - y
                a, b = (c * dx + s * dy) / along, (c * dy - s * dx) / across
                squared = a * a + b * b
                if squared < REACH * REACH:
                    m = np.float32(peak * math.exp(-0.5 * squared))
                    mass[i, j, 1] += (1 - mass[i, j, 1]) * m
    for i in range(nx):
        for j in range(ny):
            if ego[i, j]:
                mass[i, j, 1] = 0
            else:
                mass[i, j, 0] = free[i, j] * (1 - mass[i, j, 1])
