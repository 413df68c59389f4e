"""Straight lines of cells, for `HeightBandISM`."""

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import Cells, HeightBand, Points
from ogm.jit import kernel

__all__ = ["draw_lines", "height_band_states", "state_mass"]

UNKNOWN, FREE, OCCUPIED, BEYOND = 0, 1, 2, 3  # states of a cell while `height_band_states` draws


@kernel
def draw_lines(state: NDArray[np.uint8], ends: NDArray[np.int32], i0: int, j0: int) -> None:
    """Mark cells as free on the straight line from (i0, j0) to each end, up to the first occupied cell.

    Lines follow Bresenham: a cell per step along the longer axis, rounded to the nearest cell along the other (half
    up, away from the start). The fixed-point numbers (32.32) are exact for lines of up to 2**16 cells.

    Parameters
    ----------
    state : (nx, ny) uint8, changed in place
        An end in state BEYOND (a ray leaves the grid) becomes FREE if its line reaches the end.
    ends : (M, 2) int32
        Cell indices ix, iy.
    i0, j0 : int
        The sensor's cell.
    """
    flat = state.reshape(-1)
    stride = state.shape[1]
    for n in range(ends.shape[0]):
        di, dj = ends[n, 0] - i0, ends[n, 1] - j0
        steps_i, steps_j = abs(di), abs(dj)
        up_i = stride if di > 0 else -stride
        up_j = 1 if dj > 0 else -1
        if steps_i >= steps_j:
            long, short, up_long, up_short = steps_i, steps_j, up_i, up_j
        else:
            long, short, up_long, up_short = steps_j, steps_i, up_j, up_i
        slope = ((np.int64(short) << 32) // long + 1) if long > 0 else np.int64(0)
        cell = np.int64(i0) * stride + j0
        fraction = np.int64(1) << 31
        for _ in range(long):
            if flat[cell] == OCCUPIED:
                break
            flat[cell] = FREE
            cell += up_long
            fraction += slope
            if fraction >> 32:
                fraction -= np.int64(1) << 32
                cell += up_short
        else:
            if flat[cell] == BEYOND:
                flat[cell] = FREE


@kernel
def height_band_states(
    points: Points,
    origin: NDArray[np.float32],
    start: tuple[int, int],
    cells: Cells,
    shape: tuple[int, int],
    band: HeightBand,
) -> NDArray[np.uint8]:
    """Mark the cells of returns in a height band as occupied, and the cells between them and the sensor as free.

    Van Kempen et al. 2021, Sec. VI-A: "cells with returns between 0.5 and 2.0 m above ground". A line per distinct
    cell gives the same states as a line per return. The ray of a return beyond the grid ends at the edge of the
    grid, and marks no cell.

    Parameters
    ----------
    points : Points
    origin : (3,) float32
        The sensor [m].
    start : (i0, j0)
        The sensor's cell.
    cells : Cells, shape : (nx, ny)
    band : HeightBand

    Returns
    -------
    (nx, ny) uint8
        UNKNOWN, FREE, OCCUPIED, or BEYOND for the exit of a ray that an occupied cell stops.
    """
    x, y, z = points
    x0, y0, resolution = cells
    nx, ny = shape
    low, high = np.float32(band.low), np.float32(band.high)
    near = np.float32(band.min_range) * np.float32(band.min_range)
    state, ends, count = np.zeros(shape, np.uint8), np.empty((min(x.shape[0], nx * ny), 2), np.int32), 0
    for n in range(x.shape[0]):
        if not (z[n] > low and z[n] < high):
            continue
        dx, dy, dz = x[n] - origin[0], y[n] - origin[1], z[n] - origin[2]
        if not dx * dx + dy * dy + dz * dz > near:
            continue
        u, v = (x[n] - x0) / resolution, (y[n] - y0) / resolution
        mark = OCCUPIED
        if not (u >= 0 and u < nx and v >= 0 and v < ny):
            a, b = (origin[0] - x0) / resolution, (origin[1] - y0) / resolution
            share = 1.0
            if u < 0:
                share = min(share, a / (a - u))
            elif u >= nx:
                share = min(share, (nx - a) / (u - a))
            if v < 0:
                share = min(share, b / (b - v))
            elif v >= ny:
                share = min(share, (ny - b) / (v - b))
            u, v = a + share * (u - a), b + share * (v - b)
            mark = BEYOND
        i, j = min(max(int(u), 0), nx - 1), min(max(int(v), 0), ny - 1)
        before = state[i, j]
        if before == UNKNOWN:
            ends[count, 0], ends[count, 1] = i, j
            count += 1
        if mark == OCCUPIED or before == UNKNOWN:
            state[i, j] = mark
    draw_lines(state, ends[:count], start[0], start[1])
    return state


@kernel
def state_mass(state: NDArray[np.uint8], evidence: float, factor: int) -> NDArray[np.float32]:
    """Turn states into masses e / (2 + sum of e), with the mean evidence e of `factor` x `factor` cells.

    Parameters
    ----------
    state : (nx * factor, ny * factor) uint8
    evidence : float
        Dirichlet evidence of a free or occupied cell, > 0.
    factor : int
        Cells of `state` per cell of the result along each axis.

    Returns
    -------
    (nx, ny, 2) float32
        Free and occupied.
    """
    nx, ny = state.shape[0] // factor, state.shape[1] // factor
    mass = np.empty((nx, ny, 2), np.float32)
    if factor == 1:
        table = np.zeros((4, 2), np.float32)
        table[FREE, 0] = table[OCCUPIED, 1] = evidence / (2 + evidence)
        for i in range(nx):
            for j in range(ny):
                s = state[i, j]
                mass[i, j, 0], mass[i, j, 1] = table[s, 0], table[s, 1]
        return mass
    for i in range(nx):
        for j in range(ny):
            free, occupied = 0, 0
            for k in range(i * factor, (i + 1) * factor):
                for l in range(j * factor, (j + 1) * factor):  # noqa: E741
                    free += state[k, l] == FREE
                    occupied += state[k, l] == OCCUPIED
            strength = 2 * factor * factor / evidence + free + occupied
            mass[i, j, 0], mass[i, j, 1] = free / strength, occupied / strength
    return mass
