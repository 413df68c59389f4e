"""Kernels for cells in the error ellipses of detections."""

import math

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.dynamic.cells import DynamicCells
from ogm.jit import inline, kernel

WIDTH = 2.0  # [standard deviations] radius of an ellipse
MIN_OCCUPIED = np.float32(0.1)  # mass of occupied in the scan of a marked cell


@inline
def _box(row: NDArray[np.float64], shape: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return the bounding cells [i0, i1) x [j0, j1) of an ellipse."""
    i0, i1 = max(math.floor(row[0] - row[6]), 0), min(math.floor(row[0] + row[6]) + 1, shape[0])
    j0, j1 = max(math.floor(row[1] - row[6]), 0), min(math.floor(row[1] + row[6]) + 1, shape[1])
    return i0, i1, j0, j1


@inline
def _squared(row: NDArray[np.float64], i: int, j: int) -> float:
    """Return the squared Mahalanobis distance of a cell's centre; 0 for the cell of the detection."""
    dx, dy = i + 0.5 - row[0], j + 0.5 - row[1]
    if abs(dx) <= 0.5 and abs(dy) <= 0.5:
        return 0.0
    along, across = row[2] * dx + row[3] * dy, row[4] * dx + row[5] * dy
    squared: float = along * along + across * across
    return squared


def ellipses(place: np.ndarray, direction: np.ndarray, extent: np.ndarray) -> np.ndarray:
    """Return ellipses as rows (N, 7) for the kernels.

    Parameters
    ----------
    place : (N, 2) float64
        Centres [cells].
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
    """Set cells in ellipses of detections to 1 that the scan measures as occupied, or that are dynamic.

    Parameters
    ----------
    rows : (N, 7) float64
        Output of `ellipses`.
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
                    marked = measured[i, 2 * j + 1] > max(measured[i, 2 * j], MIN_OCCUPIED)
                    dynamic = cells.surviving[i, j] + cells.born[i, j]
                    if marked or dynamic > max(cells.static[i, j], cells.free[i, j]):
                        out[i, j] = 1


@kernel
def nearest_labels(rows: np.ndarray, label: np.ndarray, out: np.ndarray) -> None:
    """Fill (N,) with the label of the nearest labelled cell in each ellipse, by Mahalanobis distance; 0 for none."""
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
    """Sum the evidence of detections by group; the formula is in `ogm.fusion.dynamic.radial.radial_evidence`.

    Parameters
    ----------
    rows : (N, 6) float64
        Place (2) [m], direction (2), speed [m/s], weight [s²/m²].
    group : (N,) int32
        Group of each detection, from 1; 0 for none.
    turn_rate : float
        Standard deviation of turn rates [rad/s].
    information, weighted : (G, 2, 2), (G, 2) float64
        Zeros on input; filled.
    """
    count = len(weighted)
    middle, turn = np.zeros((count, 3)), np.zeros((count, 4))  # sums of w (x, y, 1), and of w q (ux, uy, q, speed)
    for k in range(len(rows)):
        if group[k] > 0:
            x, y, _, _, _, w = rows[k]
            total = middle[group[k] - 1]
            total[0] += w * x
            total[1] += w * y
            total[2] += w
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
    for k in range(count):
        info, b, t = information[k], weighted[k], turn[k]
        share = turn_rate * turn_rate / (1 + turn_rate * turn_rate * t[2])
        info[0, 0] -= share * t[0] * t[0]
        info[0, 1] -= share * t[0] * t[1]
        info[1, 1] -= share * t[1] * t[1]
        info[1, 0] = info[0, 1]
        b[0] -= share * t[3] * t[0]
        b[1] -= share * t[3] * t[1]
