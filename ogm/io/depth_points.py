"""Kernels of depth images: nearest points of surfaces, without mixed pixels."""

import numpy as np
from numpy.typing import NDArray

from ogm.jit import kernel

__all__ = ["surface_points"]


@kernel
def _step(a: np.float32, b: np.float32, slope: np.float32) -> int:
    """Return 1 if b lies behind a by a jump, -1 if before it, 0 if it continues a, 2 if it has no depth."""
    if not b > 0:
        return 2
    jump = min(a, b) * slope
    if b - a > jump:
        return 1
    return -1 if a - b > jump else 0


@kernel
def _is_mixture(depth: NDArray[np.float32], v: int, u: int, across: np.float32, down: np.float32) -> bool:
    """Return whether a pixel lies between two surfaces, or continues no neighbour."""
    z, none = depth[v, u], np.float32(0)
    left = _step(z, depth[v, u - 1] if u > 0 else none, across)
    right = _step(z, depth[v, u + 1] if u + 1 < depth.shape[1] else none, across)
    up = _step(z, depth[v - 1, u] if v > 0 else none, down)
    low = _step(z, depth[v + 1, u] if v + 1 < depth.shape[0] else none, down)
    if (left == -1 and right >= 1) or (right == -1 and left >= 1) or (up == -1 and low >= 1) or (low == -1 and up >= 1):
        return True
    return left != 0 and right != 0 and up != 0 and low != 0


@kernel
def _nearest(
    depth: NDArray[np.float32],
    rows: tuple[int, int],
    columns: tuple[int, int],
    limits: tuple[np.float32, np.float32],
    slopes: tuple[np.float32, np.float32],
    unmixed: bool,
) -> tuple[int, int]:
    """Return row and column of the nearest (unmixed) pixel of a rectangle within limits, or (-1, -1)."""
    nearest, row, column = limits[1], -1, -1
    for v in range(rows[0], rows[1]):
        for u in range(columns[0], columns[1]):
            z = depth[v, u]
            near = z >= limits[0] and z <= nearest and z > 0
            if near and not (unmixed and _is_mixture(depth, v, u, slopes[0], slopes[1])):
                nearest, row, column = z, v, u
    return row, column


@kernel
def surface_points(
    depth: NDArray[np.float32],
    camera: tuple[np.float32, np.float32, np.float32, np.float32],
    per_tangent: np.float32,
    limits: tuple[np.float32, np.float32],
    stride: int,
) -> NDArray[np.float32]:
    """Return the nearest unmixed point of every `stride` x `stride` pixels, (N, 4).

    Parameters
    ----------
    depth : (rows, columns) float32
        [m]; no depth if not above 0.
    camera : (fx, fy, cx, cy)
    per_tangent : float
        Depth difference per lateral distance of the flattest surface.
    limits : (least, greatest)
        [m]
    stride : int
    """
    fx, fy, cx, cy = camera
    rows, columns = depth.shape
    slopes = per_tangent / fx, per_tangent / fy
    points = np.empty((((rows + stride - 1) // stride) * ((columns + stride - 1) // stride), 4), np.float32)
    count = 0
    for top in range(0, rows, stride):
        for first in range(0, columns, stride):
            bottom, last = min(top + stride, rows), min(first + stride, columns)
            row, column = _nearest(depth, (top, bottom), (first, last), limits, slopes, False)
            if row >= 0 and _is_mixture(depth, row, column, *slopes):
                row, column = _nearest(depth, (top, bottom), (first, last), limits, slopes, True)
            if row >= 0:
                nearest = depth[row, column]
                points[count, 0] = nearest
                points[count, 1] = (cx - column) * nearest / fx
                points[count, 2] = (cy - row) * nearest / fy
                points[count, 3] = 0
                count += 1
    return points[:count].copy()
