"""Steps and slopes of the heights, by rows of cells."""

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.height_sums import NO_SURFACE
from ogm.geometric.kernels.polar import azimuth
from ogm.jit import kernel, vector

__all__ = [
    "BOTTOM_SURFACE",
    "HIGH",
    "LOW",
    "RISE",
    "TOP_SURFACE",
    "WIDTH",
    "rises",
    "slopes_of_row",
    "steps_of_row",
    "widen",
]

WIDTH = 16400  # cells of a row; parts begin at constants, so that the compiler knows that they do not overlap
HIGH, LOW, RISE, TOP_SURFACE, BOTTOM_SURFACE = (WIDTH * k for k in range(1, 6))


@kernel
def rises(height: NDArray[np.float32], scale: np.float32) -> NDArray[np.float32]:
    """Return the median rise along the first axis over five pairs of cells around each cell, times `scale`."""
    nx, ny = height.shape
    result, five = np.empty((nx, ny), np.float32), np.empty(5, np.float32)
    for k in range(nx):
        for l in range(ny):  # noqa: E741
            for t in range(5):
                first = min(max(k + t - 3, 0), nx - 2)
                five[t] = height[first + 1, l] - height[first, l]
            for t in range(1, 5):
                value, s = five[t], t
                while s > 0 and five[s - 1] > value:
                    five[s] = five[s - 1]
                    s -= 1
                five[s] = value
            result[k, l] = five[2] * scale
    return result


@vector
def widen(part: NDArray[np.float32], count: int, reach: int) -> None:
    """Fill in the highest and lowest surface within `reach` cells along a row, without the rise of the slope."""
    zero = np.float32(0.0)
    for j in range(count & 0x7FFF):  # masks show the compiler that no index is negative
        part[TOP_SURFACE + j], part[BOTTOM_SURFACE + j] = part[HIGH + j], part[LOW + j]
    for t in range(-reach, reach + 1):
        away, high, low = np.float32(t), (HIGH + t) & 0x7FFFF, (LOW + t) & 0x7FFFF
        first, last = max(-t, 0) & 0x7FFF, (count - max(t, 0)) & 0x7FFF
        for j in range(first, last):
            part[TOP_SURFACE + j] += max(part[high + j] - part[RISE + j] * away - part[TOP_SURFACE + j], zero)
        for j in range(first, last):
            part[BOTTOM_SURFACE + j] -= max(part[BOTTOM_SURFACE + j] - part[low + j] + part[RISE + j] * away, zero)


@kernel
def steps_of_row(
    wide: NDArray[np.float32], i: int, reach: int, part: NDArray[np.float32], out: NDArray[np.float32]
) -> None:
    """Fill in the largest rise within `reach` cells of a row's cells, without the slope; NaN without a surface."""
    count, nan = out.shape[1] & 0x7FFF, np.float32(np.nan)
    for j in range(count):
        part[TOP_SURFACE + j], part[BOTTOM_SURFACE + j] = wide[0, i, j], wide[1, i, j]
    for t in range(max(-reach, -i), min(reach + 1, wide.shape[1] - i)):
        _extend(wide, i + t, np.float32(t), count, part)
    for j in range(count):
        step = part[TOP_SURFACE + j] - part[BOTTOM_SURFACE + j]
        out[i, j] = step if step > -NO_SURFACE else nan


@vector
def _extend(wide: NDArray[np.float32], k: int, away: np.float32, count: int, part: NDArray[np.float32]) -> None:
    """Extend the highest and lowest surface of the cells of a row by the surfaces of row `k`."""
    k, count, zero = k & 0x7FFFFFFF, count & 0x7FFF, np.float32(0.0)
    for j in range(count):
        part[TOP_SURFACE + j] += max(wide[0, k, j] - part[RISE + j] * away - part[TOP_SURFACE + j], zero)
    for j in range(count):
        part[BOTTOM_SURFACE + j] -= max(part[BOTTOM_SURFACE + j] - wide[1, k, j] + part[RISE + j] * away, zero)


@vector
def slopes_of_row(
    height: NDArray[np.float32],
    i: int,
    reach: int,
    side: np.float32,
    part: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    """Fill in the inclination [rad] of a row's cells, by the rise across `reach` cells on either side."""
    nx, count, one = height.shape[0], height.shape[1] & 0x7FFF, np.float32(1.0)
    first, last, i = max(i - reach, 0) & 0x7FFFFFFF, min(i + reach, nx - 1) & 0x7FFFFFFF, i & 0x7FFFFFFF
    for j in range(count):
        a, b = max(j - reach, 0) & 0x7FFF, min(j + reach, count - 1) & 0x7FFF
        part[RISE + j] = (height[i, b] - height[i, a]) / (np.float32(b - a) * side)
    scale = one / (np.float32(last - first) * side)
    for j in range(count):
        gx, gy = (height[last, j] - height[first, j]) * scale, part[RISE + j]
        out[i, j] = azimuth(one, np.sqrt(gx * gx + gy * gy))
