"""Sums over the returns of each cell and each block of cells, and their reference surface."""

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import Cells, Points, RayNumbers
from ogm.geometric.kernels.surface import fill, lower_envelope
from ogm.jit import kernel

__all__ = ["add_row", "find_bulges", "finish_blocks", "ground_cells", "mended_surface", "sum_returns"]

DEEP, COUNT, SUM, SQUARE, TOP, HANG = 1, 2, 3, 4, 5, 6  # layers that at first hold sums over the returns of a cell
BULGE = np.float32(0.25)  # [m] largest height of ground above the ground within 5 m
MAX_WEIGHT = np.float32(8.0)  # [returns] largest weight of a block
NO_SURFACE = np.float32(1e3)  # [m] height or distance without a surface; float32 resolves 0.06 mm there


@kernel
def sum_returns(
    points: Points, above: NDArray[np.float32], cells: Cells, numbers: RayNumbers, sums: NDArray[np.float32]
) -> None:
    """Fill in sums over the returns of each cell, by their heights above the ground [m].

    Parameters
    ----------
    points : Points
        N returns.
    above : (N or more,) float32
    cells : Cells
    numbers : RayNumbers
    sums : (7, nx, ny) float32
        The layers from the second on are filled: number of returns below the ground by more than `below_ground`;
        number, sum and sum of squares of the returns up to `obstacle_height`; the highest return between that height
        and the clearance; the lowest return above that height. 0 without such returns.
    """
    sums[DEEP:] = 0
    shape = sums.shape[1:]
    x0, y0, inverse = np.float32(cells.x0), np.float32(cells.y0), np.float32(1.0 / cells.resolution)
    low, high = np.float32(numbers.obstacle_height), np.float32(numbers.clearance)
    below = np.float32(-numbers.below_ground)
    for n in range(points.x.shape[0]):
        u, v, a = (points.x[n] - x0) * inverse, (points.y[n] - y0) * inverse, above[n]
        if not (u >= 0 and u < shape[0] and v >= 0 and v < shape[1]):
            continue
        i, j = int(u) & 0x7FFFFFFF, int(v) & 0x7FFFFFFF
        if a < below:
            sums[DEEP, i, j] += np.float32(1.0)
            continue
        if a <= low:
            sums[COUNT, i, j] += np.float32(1.0)
            sums[SUM, i, j] += a
            sums[SQUARE, i, j] += a * a
            continue
        if a < high:
            sums[TOP, i, j] = max(sums[TOP, i, j], a)
        if sums[HANG, i, j] == 0 or a < sums[HANG, i, j]:
            sums[HANG, i, j] = a


@kernel
def ground_cells(sums: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return a mask (nx, ny) of cells with ground returns and without obstacle returns within one cell."""
    nx, ny = sums.shape[1:]
    marked, valid = np.zeros((nx + 2, ny), np.bool_), np.empty((nx, ny), np.bool_)
    for i in range(nx):
        for j in range(ny):
            if sums[TOP, i, j] > 0:
                marked[i + 1, max(j - 1, 0) : j + 2] = True
    for i in range(nx):
        for j in range(ny):
            valid[i, j] = (sums[COUNT, i, j] > 0) & ~(marked[i, j] | marked[i + 1, j] | marked[i + 2, j])
    return valid


@kernel
def mended_surface(
    height: NDArray[np.float32],
    valid: NDArray[np.bool_],
    bulges: NDArray[np.float32],
    corner: tuple[float, float],
    per_cell: float,
    place: tuple[float, float],
    ground_z: np.float32,
) -> NDArray[np.float32]:
    """Return a surface without obstacles: its cells without valid cells are filled from other cells.

    Lengths are in cells of the surface. Cells in bulges become invalid.
    """
    result, weight = height.copy(), np.zeros(height.shape, np.float32)
    mx, my = height.shape[0] - 1, height.shape[1] - 1
    for i in range(valid.shape[0]):
        k = min(max(int((i + 0.5) * per_cell + corner[0]), 0), mx)
        for j in range(valid.shape[1]):
            if valid[i, j]:
                l = min(max(int((j + 0.5) * per_cell + corner[1]), 0), my)  # noqa: E741
                valid[i, j] = bulges[k, l] == 0
                weight[k, l] += np.float32(1.0) - bulges[k, l]
    k, l = min(max(int(place[0]), 0), mx), min(max(int(place[1]), 0), my)  # noqa: E741
    if weight[k, l] == 0:
        result[k, l], weight[k, l] = ground_z, np.float32(1.0)
    for k in range(mx + 1):
        for l in range(my + 1):  # noqa: E741
            weight[k, l] = min(weight[k, l], MAX_WEIGHT)
    fill(result, weight, ground_z)
    return result


@kernel
def find_bulges(height: NDArray[np.float32], reach: int) -> NDArray[np.float32]:
    """Return 1 for cells above the opening of a surface by a square (Serra 1982), else 0: roofs and bonnets of cars.

    The surface is extended by point reflection at its edges, so that a slope has no bulge.
    """
    mx, my = height.shape
    wide = np.empty((mx + 2 * reach, my + 2 * reach), np.float32)
    for k in range(mx):
        for l in range(my):  # noqa: E741
            wide[reach + k, reach + l] = height[k, l]
    for t in range(1, reach + 1):
        for l in range(reach, reach + my):  # noqa: E741
            first, last, inner = reach, reach + mx - 1, min(t, mx - 1)
            wide[first - t, l] = 2 * wide[first, l] - wide[first + inner, l]
            wide[last + t, l] = 2 * wide[last, l] - wide[last - inner, l]
    for k in range(mx + 2 * reach):
        for t in range(1, reach + 1):
            first, last, inner = reach, reach + my - 1, min(t, my - 1)
            wide[k, first - t] = 2 * wide[k, first] - wide[k, first + inner]
            wide[k, last + t] = 2 * wide[k, last] - wide[k, last - inner]
    opening = _extreme(_extreme(wide, reach, np.float32(1.0)), reach, np.float32(-1.0))
    bulges = np.empty((mx, my), np.float32)
    for k in range(mx):
        for l in range(my):  # noqa: E741
            bulges[k, l] = height[k, l] - opening[k + reach, l + reach] > BULGE
    return bulges


@kernel
def _extreme(height: NDArray[np.float32], reach: int, sign: np.float32) -> NDArray[np.float32]:
    """Return the lowest height of the square of cells at most `reach` away, or the highest for a sign of -1."""
    mx, my = height.shape
    rows, result = np.empty((mx, my), np.float32), np.empty((mx, my), np.float32)
    for k in range(mx):
        for l in range(my):  # noqa: E741
            rows[k, l] = sign * height[k, l]
            for t in range(max(k - reach, 0), min(k + reach + 1, mx)):
                rows[k, l] = min(rows[k, l], sign * height[t, l])
    for k in range(mx):
        for l in range(my):  # noqa: E741
            lowest = rows[k, l]
            for t in range(max(l - reach, 0), min(l + reach + 1, my)):
                lowest = min(lowest, rows[k, t])
            result[k, l] = sign * lowest
    return result


@kernel
def add_row(
    sums: NDArray[np.float32],
    valid: NDArray[np.bool_],
    i: int,
    part: NDArray[np.float32],
    start: int,
    size: int,
    blocks: NDArray[np.float32],
) -> None:
    """Add the returns of a row's valid cells to its blocks, shifted by `part` from `start` on.

    `blocks` holds sum, sum of squares, an unused layer, number, and the number of returns below the ground.
    """
    k, start = i // size, start & 0x7FFFF
    for j in range(valid.shape[1]):
        if sums[DEEP, i, j] > 0:
            blocks[4, k, j // size] += sums[DEEP, i, j]
        if valid[i, j]:
            l, s, count, total = j // size, part[start + j], sums[COUNT, i, j], sums[SUM, i, j]  # noqa: E741
            blocks[0, k, l] += total + count * s
            blocks[1, k, l] += sums[SQUARE, i, j] + s * (total + total + count * s)
            blocks[3, k, l] += count


@kernel
def finish_blocks(blocks: NDArray[np.float32], side: np.float32) -> None:
    """Turn sums into means [m] and variances [m2] of all blocks, and distances [m] to the nearest block with returns.

    The distance is `NO_SURFACE` in blocks with most returns below the ground.
    """
    zero = np.float32(0.0)
    for k in range(blocks.shape[1]):
        for l in range(blocks.shape[2]):  # noqa: E741
            count = blocks[3, k, l]
            blocks[2, k, l] = zero if count > 0 else NO_SURFACE
            if count > 0:
                mean = blocks[0, k, l] / count
                blocks[0, k, l], blocks[1, k, l] = mean, max(blocks[1, k, l] / count - mean * mean, zero)
                blocks[3, k, l] = min(count, MAX_WEIGHT)
    fill(blocks[0], blocks[3], zero)
    fill(blocks[1], blocks[3], zero)
    lower_envelope(blocks[2], side)
    for k in range(blocks.shape[1]):
        for l in range(blocks.shape[2]):  # noqa: E741
            if blocks[4, k, l] > blocks[3, k, l]:
                blocks[2, k, l] = NO_SURFACE
