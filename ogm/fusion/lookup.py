"""Kernels that read a measurement grid at the cells of a window, through an affine map between their cells."""

from typing import NamedTuple

import numpy as np

from ogm.jit import vector

EPS_CELL = 1e-6  # [cells] added to centres of cells, so that rounding does not decide on which side of an edge they lie


class ScanLookup(NamedTuple):
    """A measurement grid and its position relative to the cells of a window.

    Attributes
    ----------
    values : (mx, my, 2) or (mx, my) float32
        Masses of free and occupied, or log-odds.
    affine : (2, 3) float64
        Takes the centre of a window cell, (i + 1/2, j + 1/2, 1), to cell coordinates of the grid.
    samples : int
        Sampling points per cell and axis; a cell takes their mean.
    """

    values: np.ndarray
    affine: np.ndarray
    samples: int


@vector
def gather(scan: ScanLookup, ring: tuple[int, int], out: np.ndarray) -> None:
    """Fill `out` (nx, 2 ny) with the pairs of a grid at the cells of a window; 0 outside the grid."""
    nx, ny = out.shape[0], out.shape[1] // 2
    row, column = ring
    z = np.zeros(2 * ny, np.float32)
    first = 2 * (ny - column)
    for i in range(nx):
        look_up(z, scan.values, scan.affine, scan.samples, i, ny)
        line = out[(i + row) % nx]
        _copy(z[:first], line[2 * column :])
        _copy(z[first:], line[: 2 * column])
        z[:] = 0


@vector
def _copy(numbers: np.ndarray, out: np.ndarray) -> None:  # faster than numba's assignment of slices
    for k in range(numbers.size):
        out[k] = numbers[k]


@vector
def look_up(z: np.ndarray, values: np.ndarray, affine: np.ndarray, samples: int, i: int, ny: int) -> tuple[int, int]:
    """Fill row i of the window from a grid; return the range of cells [low, high) that the grid may cover."""
    mx, my = values.shape[0], values.shape[1]
    flat = values.reshape(-1)
    du, dv = affine[0, 1], affine[1, 1]
    u0 = affine[0, 0] * (i + 0.5) + affine[0, 1] * 0.5 + affine[0, 2] + EPS_CELL
    v0 = affine[1, 0] * (i + 0.5) + affine[1, 1] * 0.5 + affine[1, 2] + EPS_CELL
    if samples == 1:
        low, high = _span(u0, du, mx, 0.0, 0, ny)
        low, high = _span(v0, dv, my, 0.0, low, high)
        for j in range(low, high):
            # Unsigned, so that no code for negative indices slows the loop down fourfold.
            at = np.uint64(np.int32(u0 + j * du) * np.int32(my) + np.int32(v0 + j * dv))
            if values.ndim == 3:  # resolved at compile time
                z[2 * j], z[2 * j + 1] = flat[np.uint64(2) * at], flat[np.uint64(2) * at + np.uint64(1)]
            else:
                z[j] = flat[at]
        return low, high
    reach_u = 0.5 * (abs(affine[0, 0]) + abs(du))
    reach_v = 0.5 * (abs(affine[1, 0]) + abs(dv))
    low, high = _span(u0, du, mx, reach_u, 0, ny)
    low, high = _span(v0, dv, my, reach_v, low, high)
    share = np.float32(1.0 / (samples * samples))
    for j in range(low, high):
        first, second = np.float32(0), np.float32(0)
        for p in range(samples):
            s = (p + 0.5) / samples - 0.5
            for q in range(samples):
                t = (q + 0.5) / samples - 0.5
                u = u0 + j * du + s * affine[0, 0] + t * du
                v = v0 + j * dv + s * affine[1, 0] + t * dv
                if 0 <= u < mx and 0 <= v < my:
                    if values.ndim == 3:
                        first += values[int(u), int(v), 0]
                        second += values[int(u), int(v), 1]
                    else:
                        first += values[int(u), int(v)]
        if values.ndim == 3:
            z[2 * j], z[2 * j + 1] = share * first, share * second
        else:
            z[j] = share * first
    return low, high


@vector
def _span(start: float, step: float, size: int, reach: float, low: int, high: int) -> tuple[int, int]:
    """Narrow [low, high) to the j for which -reach <= start + j step < size + reach."""
    if step == 0:
        return (low, high) if -reach <= start < size + reach else (low, low)
    a, b = (-reach - start) / step, (size + reach - start) / step
    if a > b:
        a, b = b, a
    low = max(low, int(np.floor(min(max(a, -1.0), 2.0**31))) - 1)
    high = min(high, int(np.ceil(max(min(b, 2.0**31), -1.0))) + 2)
    while low < high and not -reach <= start + low * step < size + reach:
        low += 1
    while low < high and not -reach <= start + (high - 1) * step < size + reach:
        high -= 1
    return (low, high) if low < high else (0, 0)
