"""Kernels over the cells in the error ellipses of detections."""

# mypy: allow-untyped-defs
import math

import numpy as np

from ogm.fusion.dynamic_cells import DynamicCells
from ogm.jit import inline, kernel

__all__ = ["mark_within", "nearest_labels"]

WIDTH = 2.0  # standard deviations
LEAST_MASS = np.float32(0.1)  # of occupied in a scan


@inline
def _box(row, shape):
    """Return the cells [i0, i1) x [j0, j1) around an ellipse."""
    reach = WIDTH * max(row[4], row[5])
    i0, i1 = max(math.floor(row[0] - reach), 0), min(math.floor(row[0] + reach) + 1, shape[0])
    j0, j1 = max(math.floor(row[1] - reach), 0), min(math.floor(row[1] + reach) + 1, shape[1])
    return i0, i1, j0, j1


@inline
def _squared(row, i, j):
    """Return the squared Mahalanobis distance of a cell's middle, but 0 in the cell of the detection."""
    dx, dy = i + 0.5 - row[0], j + 0.5 - row[1]
    if abs(dx) <= 0.5 and abs(dy) <= 0.5:
        return 0.0
    along, across = (row[2] * dx + row[3] * dy) / row[4], (row[2] * dy - row[3] * dx) / row[5]
    return along * along + across * across


@kernel
def mark_within(rows: np.ndarray, measured: np.ndarray, cells: DynamicCells, out: np.ndarray) -> None:
    """Set cells in ellipses of detections to 1: those that the scan measures as occupied, or that are dynamic.

    Parameters
    ----------
    rows : (N, 6) float64
        Place (2) [cells], direction (2), standard deviations along and across it [cells].
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
