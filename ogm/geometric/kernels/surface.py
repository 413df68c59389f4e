"""Surfaces of heights: ground under a scan, interpolation, filled gaps."""

import math

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import Cells, GroundLimits, Points, Surface
from ogm.jit import kernel

__all__ = ["corner_heights", "fill", "ground_heights", "lower_envelope", "sample", "sample_corners", "sample_many"]


@kernel
def sample(surface: Surface, x: np.float32, y: np.float32) -> np.float32:
    """Interpolate a `Surface` bilinearly at (x, y), with constant heights beyond the outermost middles of cells."""
    height, half, zero = surface.height, np.float32(0.5), np.float32(0.0)
    u = min(max((x - surface.x0) * surface.per_metre - half, zero), np.float32(height.shape[0] - 1))
    v = min(max((y - surface.y0) * surface.per_metre - half, zero), np.float32(height.shape[1] - 1))
    # In all kernels a mask shows the compiler that an index is not negative, which saves the wrap-around.
    i, j = min(int(u), height.shape[0] - 2) & 0xFFFF, min(int(v), height.shape[1] - 2) & 0xFFFF
    a, b = u - np.float32(i), v - np.float32(j)
    low = height[i, j] + (height[i, j + 1] - height[i, j]) * b
    high = height[i + 1, j] + (height[i + 1, j + 1] - height[i + 1, j]) * b
    between: np.float32 = low + (high - low) * a
    return between


@kernel
def corner_heights(surface: Surface) -> NDArray[np.float32]:
    """Return the coefficients of `sample` for each cell and its next neighbours, (4 (gx - 1) (gy - 1),)."""
    height, place = surface.height, 0
    corners = np.empty(4 * (height.shape[0] - 1) * (height.shape[1] - 1), np.float32)
    for i in range(height.shape[0] - 1):
        for j in range(height.shape[1] - 1):
            corners[place], corners[place + 1] = height[i, j], height[i, j + 1] - height[i, j]
            corners[place + 2], corners[place + 3] = height[i + 1, j], height[i + 1, j + 1] - height[i + 1, j]
            place += 4
    return corners


@kernel
def sample_corners(corners: NDArray[np.float32], surface: Surface, x: np.float32, y: np.float32) -> np.float32:
    """Interpolate like `sample`, from the result of `corner_heights`."""
    nx, ny, half, zero = surface.height.shape[0], surface.height.shape[1], np.float32(0.5), np.float32(0.0)
    u = min(max((x - surface.x0) * surface.per_metre - half, zero), np.float32(nx - 1))
    v = min(max((y - surface.y0) * surface.per_metre - half, zero), np.float32(ny - 1))
    i, j = min(np.int32(u), np.int32(nx - 2)), min(np.int32(v), np.int32(ny - 2))
    a, b = u - np.float32(i), v - np.float32(j)
    place = ((i * (ny - 1) + j) & 0x1FFFFFFF) << 2
    low, high = corners[place] + corners[place + 1] * b, corners[place + 2] + corners[place + 3] * b
    between: np.float32 = low + (high - low) * a
    return between


@kernel
def sample_many(surface: Surface, x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float32]:
    """Interpolate like `sample` at each point."""
    result = np.empty(x.shape[0], np.float32)
    for n in range(x.shape[0]):
        result[n] = sample(surface, x[n], y[n])
    return result


@kernel
def ground_heights(
    points: Points, ground_point: tuple[float, float, float], cells: Cells, shape: tuple[int, int], limits: GroundLimits
) -> NDArray[np.float32]:
    """Estimate the ground by the four steps of `ogm.geometric.local_ground`.

    Parameters
    ----------
    points : Points
    ground_point : (x, y, z)
        The ground under the sensor [m], inside the grid.
    cells : Cells, shape : (nx, ny)
        The grid of heights.
    limits : GroundLimits

    Returns
    -------
    (nx, ny) float32
        Heights [m].
    """
    gx, gy, gz = np.float32(ground_point[0]), np.float32(ground_point[1]), np.float32(ground_point[2])
    inverse = np.float32(1.0 / cells.resolution)
    i0 = min(max(int((gx - np.float32(cells.x0)) * inverse), 0), shape[0] - 1)
    j0 = min(max(int((gy - np.float32(cells.y0)) * inverse), 0), shape[1] - 1)

    # 1. lowest return of each cell, without returns below the steepest road
    cell, lowest = _lowest_returns(points, ground_point, cells, shape, limits)
    descent = np.float32(limits.max_descent * cells.resolution)
    _drop_strays(lowest, i0, j0, gz, descent, np.float32(limits.low_tolerance))

    # 2. lower envelope of these and the ground point under the slope limit; heights on the envelope are ground
    lowest[i0, j0] = min(lowest[i0, j0], gz)
    envelope = lowest.copy()
    lower_envelope(envelope, np.float32(limits.max_slope * cells.resolution))
    for i in range(shape[0]):
        for j in range(shape[1]):
            if lowest[i, j] > envelope[i, j]:
                lowest[i, j] = np.inf

    # 3. mean of the lowest layer of these cells, or of the layer above
    height, weight = _layer_means(points.z, cell, lowest, np.float32(1.0 / limits.band))
    if weight[i0, j0] == 0 and math.isfinite(lowest[i0, j0]):
        height[i0, j0], weight[i0, j0] = gz, np.float32(1.0)

    # 4. smooth surface through the means, no steeper than the slope limit
    limit = height.copy()
    for i in range(shape[0]):
        for j in range(shape[1]):
            if not weight[i, j] > 0:
                limit[i, j] = np.inf
    lower_envelope(limit, np.float32(limits.max_slope * cells.resolution))
    fill(height, weight, gz)
    for i in range(shape[0]):
        for j in range(shape[1]):
            if not weight[i, j] > 0:
                height[i, j] = min(height[i, j], limit[i, j])
    return height


@kernel
def _lowest_returns(
    points: Points, ground_point: tuple[float, float, float], cells: Cells, shape: tuple[int, int], limits: GroundLimits
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return the cell of each point (nx * ny if outside), and each cell's lowest return above the steepest descent."""
    x, y, z = points
    nx, ny = shape
    x0, y0, inverse = np.float32(cells.x0), np.float32(cells.y0), np.float32(1.0 / cells.resolution)
    gx, gy = np.float32(ground_point[0]), np.float32(ground_point[1])
    bottom, zero = np.float32(ground_point[2] - limits.low_tolerance), np.float32(0.0)
    steepest = np.float32(limits.max_descent * limits.max_descent)
    wide, long, outside = np.float32(nx), np.float32(ny), np.int32(nx * ny)
    lowest = np.full(nx * ny + 1, np.inf, np.float32)
    cell, shallow = np.empty(x.shape[0], np.int32), np.empty(x.shape[0], np.bool_)
    for n in range(x.shape[0]):  # without branches
        u, v = (x[n] - x0) * inverse, (y[n] - y0) * inverse
        inside = (u >= 0) & (u < wide) & (v >= 0) & (v < long)
        cell[n] = np.int32(u if inside else zero) * np.int32(ny) + np.int32(v if inside else zero)
        cell[n] = cell[n] if inside else outside
        dx, dy, depth = x[n] - gx, y[n] - gy, bottom - z[n]
        shallow[n] = (depth <= 0) | (depth * depth <= steepest * (dx * dx + dy * dy))
    for n in range(x.shape[0]):
        c = cell[n] & 0x7FFFFFFF
        if z[n] < lowest[c] and shallow[n]:
            lowest[c] = z[n]
    return cell, lowest[: nx * ny].reshape((nx, ny))


@kernel
def _layer_means(
    z: NDArray[np.float32], cell: NDArray[np.int32], lowest: NDArray[np.float32], layers_per_metre: np.float32
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return mean height [m] and weight (at most 8 returns) of the lowest layer of returns of each ground cell.

    The second layer replaces the first if the first and third layer each have at most a tenth of its returns.
    """
    nx, ny = lowest.shape
    flat = np.full(nx * ny + 1, np.inf, np.float32)  # the last entry is for points outside
    for i in range(nx):
        for j in range(ny):
            flat[i * ny + j] = lowest[i, j]
    places, heights, kept = np.empty(z.shape[0], np.int32), np.empty(z.shape[0], np.float32), 0
    for n in range(z.shape[0]):  # no branches, because obstacles and ground may alternate
        c = cell[n] & 0x7FFFFFFF
        above = z[n] - flat[c]
        layer = above * layers_per_metre
        inside = (layer >= 0) & (layer < 3)
        k = kept & 0x7FFFFFFF
        places[k], heights[k] = (c << 2) + np.int32(layer if inside else np.float32(0.0)), above
        kept += int(inside)
    total, count = np.zeros((nx * ny, 4), np.float32), np.zeros((nx * ny, 4), np.float32)
    sums, counts = total.reshape(-1), count.reshape(-1)
    for k in range(kept):
        sums[places[k] & 0x7FFFFFFF] += heights[k]
        counts[places[k] & 0x7FFFFFFF] += np.float32(1.0)
    height, weight = np.zeros((nx, ny), np.float32), np.zeros((nx, ny), np.float32)
    for i in range(nx):
        for j in range(ny):
            c = i * ny + j
            k = 1 if count[c, 1] >= 10 * count[c, 0] and count[c, 1] >= 10 * count[c, 2] else 0
            if count[c, k] > 0:
                height[i, j] = lowest[i, j] + total[c, k] / count[c, k]
                weight[i, j] = min(count[c, k], np.float32(8.0))
    return height, weight


@kernel
def _drop_strays(
    lowest: NDArray[np.float32], i0: int, j0: int, ground_z: np.float32, rise: np.float32, tolerance: np.float32
) -> None:
    """Set cells with a lowest return under the ground to inf: multipath and ghost returns.

    Square rings of cells are visited outward from cell (i0, j0) with known ground. The expected height of a cell is the
    weighted mean of its up to three inner neighbours. Neighbours fewer steps away from ground have more weight. A cell
    may lie below the expected height by `tolerance` plus `rise` for each of these steps. A stray return therefore
    affects only the cells behind it.
    """
    nx, ny = lowest.shape
    ground = np.full((nx, ny), ground_z, np.float32)
    steps = np.zeros((nx, ny), np.float32)
    one = np.float32(1.0)
    for ring in range(1, max(i0, nx - 1 - i0, j0, ny - 1 - j0) + 1):
        for i in range(max(i0 - ring, 0), min(i0 + ring + 1, nx)):
            stride = 1 if abs(i - i0) == ring else 2 * ring  # a whole edge, or the two ends of a row
            for j in range(j0 - ring, j0 + ring + 1, stride):
                if j < 0 or j >= ny:
                    continue
                expected, total, since = np.float32(0.0), np.float32(0.0), np.float32(np.inf)
                for k in range(max(i - 1, 0), min(i + 2, nx)):
                    for l in range(max(j - 1, 0), min(j + 2, ny)):  # noqa: E741
                        if max(abs(k - i0), abs(l - j0)) == ring - 1:
                            weight = one / (one + steps[k, l])
                            expected += weight * ground[k, l]
                            total += weight
                            since = min(since, steps[k, l])
                expected /= total
                above, allowed = lowest[i, j] - expected, tolerance + rise * (since + one)
                if abs(above) <= allowed:
                    ground[i, j], steps[i, j] = lowest[i, j], np.float32(0.0)
                    continue
                ground[i, j], steps[i, j] = expected, since + one
                if above < 0:
                    lowest[i, j] = np.inf


@kernel
def lower_envelope(height: NDArray[np.float32], rise: np.float32) -> None:
    """Lower every cell until it rises at most `rise` per cell from its neighbours (two-pass chamfer transform)."""
    nx, ny = height.shape
    diagonal = rise * np.float32(math.sqrt(2.0))
    for step in (1, -1):  # from the first corner to the last, and back
        for row in range(nx):
            i = row if step > 0 else nx - 1 - row
            for column in range(ny):
                j = column if step > 0 else ny - 1 - column
                low = height[i, j]
                if 0 <= i - step < nx:
                    low = min(low, height[i - step, j] + rise)
                    if j > 0:
                        low = min(low, height[i - step, j - 1] + diagonal)
                    if j < ny - 1:
                        low = min(low, height[i - step, j + 1] + diagonal)
                if 0 <= j - step < ny:
                    low = min(low, height[i, j - step] + rise)
                height[i, j] = low


@kernel
def fill(height: NDArray[np.float32], weight: NDArray[np.float32], otherwise: np.float32) -> None:
    """Fill cells of weight 0 with a smooth surface through the other cells (pull-push), in place."""
    nx, ny = height.shape
    if nx <= 2 and ny <= 2:
        known, mean = np.float32(0.0), np.float32(0.0)
        for i in range(nx):
            for j in range(ny):
                known += weight[i, j]
                mean += weight[i, j] * height[i, j]
        mean = mean / known if known > 0 else otherwise
        for i in range(nx):
            for j in range(ny):
                if weight[i, j] == 0:
                    height[i, j] = mean
        return
    mx, my = max((nx + 1) // 2, 2), max((ny + 1) // 2, 2)
    coarse, total = np.zeros((mx, my), np.float32), np.zeros((mx, my), np.float32)
    for i in range(nx):  # pull: weighted means of 2 x 2 cells
        for j in range(ny):
            coarse[i // 2, j // 2] += weight[i, j] * height[i, j]
            total[i // 2, j // 2] += weight[i, j]
    for i in range(mx):
        for j in range(my):
            if total[i, j] > 0:
                coarse[i, j] /= total[i, j]
                total[i, j] = min(total[i, j], np.float32(8.0))
    fill(coarse, total, otherwise)
    half, zero = np.float32(0.5), np.float32(0.0)
    surface = Surface(coarse, zero, zero, half)
    for i in range(nx):  # push: empty cells are interpolated from the coarser level
        for j in range(ny):
            if weight[i, j] == 0:
                height[i, j] = sample(surface, np.float32(i) + half, np.float32(j) + half)
