"""Kernels over the cells in the error ellipses of detections."""

import math

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.dynamic.cells import DynamicCells
from ogm.jit import inline, kernel

WIDTH = 2.0  # standard deviations
LEAST_MASS = np.float32(0.1)  # of occupied in a scan


@inline
def _box(row: NDArray[np.float64], shape: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return the cells [i0, i1) x [j0, j1) around an ellipse."""
    i0, i1 = max(math.floor(row[0] - row[6]), 0), min(math.floor(row[0] + row[6]) + 1, shape[0])
    j0, j1 = max(math.floor(row[1] - row[6]), 0), min(math.floor(row[1] + row[6]) + 1, shape[1])
    return i0, i1, j0, j1


@inline
def _squared(row: NDArray[np.float64], i: int, j: int) -> float:
    """Return the squared Mahalanobis distance of a cell's middle, but 0 in the cell of the detection."""
    dx, dy = i + 0.5 - row[0], j + 0.5 - row[1]
    if abs(dx) <= 0.5 and abs(dy) <= 0.5:
        return 0.0
    along, across = row[2] * dx + row[3] * dy, row[4] * dx + row[5] * dy
    squared: float = along * along + across * across
    return squared


def ellipses(place: np.ndarray, direction: np.ndarray, extent: np.ndarray) -> np.ndarray:
    """Return rows (N, 7) for the kernels.

    Parameters
    ----------
    place : (N, 2) float64
        Middles [cells].
    direction : (N, 2) float64
        Unit vectors.
    extent : (N, 2) float64
        Standard deviations along and across the direction [cells].
    """
    (ux, uy), (along, across) = direction.T, np.maximum(extent, 0.5).T
    reach = WIDTH * np.maximum(along, across)
    return np.column_stack([place, ux / along, uy / along, -uy / across, ux / across, reach])


@kernel
def mark_within(rows: np.ndarray, measured: np.ndarray, cells: DynamicCells, out: np.ndarray) -> None:
    """Set cells in ellipses of detections to 1: those that the scan measures as occupied, or that are dynamic.

    Parameters
    ----------
    rows : (N, 7) float64
        `ellipses`.
    measured : (nx, 2 ny) float32
        Masses of free and occupied of the scan.
    cells : DynamicCells
    out : (nx, ny) uint8
    """
    for k in range(len(rows)):
        i0, i1, j0, j1 = _box(rows[k], out.shape)
        for i in range(i0, i1):
            for j in range(j0, j1):
                if out[i, j] == 0 and _squared(rows[k], i, j) <= WIDTH * WIDTH:
                    marked = measured[i, 2 * j + 1] > max(measured[i, 2 * j], LEAST_MASS)
                    dynamic = cells.surviving[i, j] + cells.born[i, j]
                    if marked or dynamic > max(cells.static[i, j], cells.free[i, j]):
                        out[i, j] = 1


@kernel
def nearest_labels(rows: np.ndarray, label: np.ndarray, out: np.ndarray) -> None:
    """Fill (N,) with the label of the nearest cell that has one in each ellipse, by standard deviations; 0 for none."""
    for k in range(len(rows)):
        out[k], least = 0, np.inf
        i0, i1, j0, j1 = _box(rows[k], label.shape)
        for i in range(i0, i1):
            for j in range(j0, j1):
                if label[i, j] > 0:
                    distance = _squared(rows[k], i, j)
                    if distance < least and distance <= WIDTH * WIDTH:
                        out[k], least = label[i, j], distance


@kernel
def sum_evidence(
    rows: np.ndarray, group: np.ndarray, turn_rate: float, information: np.ndarray, weighted: np.ndarray
) -> None:
    """Sum the evidence of detections by group; the formula is that of `ogm.fusion.dynamic.radial.radial_evidence`.

    Parameters
    ----------
    rows : (N, 6) float64
        Place (2) [m], direction (2), speed [m/s], weight [s²/m²].
    group : (N,) int32
        From 1 on; 0 for none.
    turn_rate : float
        Standard deviation [rad/s].
    information, weighted : (G, 2, 2), (G, 2) float64
        Zeros, which are filled.
    """
    count = len(weighted)
    middle, turn = np.zeros((count, 3)), np.zeros((count, 4))  # sums of w (x, y, 1), of w q (ux, uy, q, speed)
    for k in range(len(rows)):
        if group[k] > 0:
            x, y, _, _, _, w = rows[k]
            one = middle[group[k] - 1]
            one[0] += w * x
            one[1] += w * y
            one[2] += w
    for k in range(len(rows)):
        if group[k] > 0:
            x, y, ux, uy, speed, w = rows[k]
            m, info, b, t = middle[group[k] - 1], information[group[k] - 1], weighted[group[k] - 1], turn[group[k] - 1]
            q = ux * (m[1] / m[2] - y) - uy * (m[0] / m[2] - x) if w > 0 else 0.0
            info[0, 0] += w * ux * ux
            info[0, 1] += w * ux * uy
            info[1, 1] += w * uy * uy
            b[0] += w * speed * ux
            b[1] += w * speed * uy
            t[0] += w * q * ux
            t[1] += w * q * uy
            t[2] += w * q * q
            t[3] += w * q * speed
    for one in range(count):
        info, b, t = information[one], weighted[one], turn[one]
        share = turn_rate * turn_rate / (1 + turn_rate * turn_rate * t[2])
        info[0, 0] -= share * t[0] * t[0]
        info[0, 1] -= share * t[0] * t[1]
        info[1, 1] -= share * t[1] * t[1]
        info[1, 0] = info[0, 1]
        b[0] -= share * t[3] * t[0]
        b[1] -= share * t[3] * t[1]
