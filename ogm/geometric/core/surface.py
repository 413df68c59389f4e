"""Surfaces of heights: the ground under a scan, and looking it up."""

import math

import numpy as np

from ogm.geometric.core.jit import inline, kernel

__all__ = ["fill", "local_ground", "lower_envelope", "sample", "sample_many"]


@inline
def sample(height, x0, y0, inverse_resolution, x, y):
    """Interpolate `height`, at least 2 x 2 cells, bilinearly at (x, y); the edge's value holds outside (kernel)."""
    u = min(
        max((x - x0) * inverse_resolution - np.float32(0.5), np.float32(0.0)), np.float32(height.shape[0] - 1)
    )
    v = min(
        max((y - y0) * inverse_resolution - np.float32(0.5), np.float32(0.0)), np.float32(height.shape[1] - 1)
    )
    # The masks tell the compiler that an index is not negative, which saves numba's wrap-around.
    i, j = min(int(u), height.shape[0] - 2) & 0xFFFF, min(int(v), height.shape[1] - 2) & 0xFFFF
    a, b = u - np.float32(i), v - np.float32(j)
    low = height[i, j] + (height[i, j + 1] - height[i, j]) * b
    high = height[i + 1, j] + (height[i + 1, j + 1] - height[i + 1, j]) * b
    return low + (high - low) * a


@kernel
def sample_many(height, x0, y0, resolution, x, y, result):
    """Do `sample` for each of many points."""
    x0, y0, inverse = np.float32(x0), np.float32(y0), np.float32(1.0 / resolution)
    for n in range(x.shape[0]):
        result[n] = sample(height, x0, y0, inverse, x[n], y[n])


@kernel
def local_ground(
    px, py, pz, ground_point, x0, y0, resolution, max_slope, max_descent, low_tolerance, band, height
):
    """Estimate the ground: see `ogm.geometric.local_ground`, whose four steps these are.

    Parameters
    ----------
    px, py, pz : (N,) float32
        Points [m].
    foot : (x, y, z)
        The ground under the sensor [m], inside the grid.
    x0, y0, resolution : float
        Corner and cell side of the grid of heights [m].
    max_slope, max_descent : float
        Rise over run: from cell to cell, and on average down from the foot.
    low_tolerance, band : float
        [m]; see the constants of `ogm.geometric.ground`.
    height : (nx, ny) float32
        Filled.
    """
    nx, ny = height.shape
    rise = np.float32(max_slope * resolution)
    x0, y0, inverse = np.float32(x0), np.float32(y0), np.float32(1.0 / resolution)
    foot_x, foot_y = np.float32(ground_point[0]), np.float32(ground_point[1])

    # 1. lowest return of each cell, but for what no road could lead down to
    flat = np.full(nx * ny, np.inf, np.float32)
    cell = np.empty(px.shape[0], np.int32)
    bottom, steepest = np.float32(ground_point[2] - low_tolerance), np.float32(max_descent * max_descent)
    for n in range(px.shape[0]):
        x, y, z = px[n], py[n], pz[n]
        u, v = (x - x0) * inverse, (y - y0) * inverse
        cell[n] = -1
        if u >= 0 and u < nx and v >= 0 and v < ny:
            c = (
                int(u) * ny + int(v)
            ) & 0x7FFFFFFF  # the mask says "not negative", which saves numba's wrap-around
            cell[n] = c
            if z < flat[c]:
                dx, dy, depth = x - foot_x, y - foot_y, bottom - z
                if depth <= 0 or depth * depth <= steepest * (dx * dx + dy * dy):
                    flat[c] = z
    lowest = flat.reshape((nx, ny))  # a view
    i0 = min(max(int((foot_x - x0) * inverse), 0), nx - 1)
    j0 = min(max(int((foot_y - y0) * inverse), 0), ny - 1)
    _drop_strays(
        lowest,
        i0,
        j0,
        np.float32(ground_point[2]),
        np.float32(max_descent * resolution),
        np.float32(low_tolerance),
    )

    # 2. lower envelope under the slope limit, from these and from the foot: only cells that touch it are ground
    lowest[i0, j0] = min(lowest[i0, j0], np.float32(ground_point[2]))
    envelope = lowest.copy()
    lower_envelope(envelope, rise)
    for i in range(nx):
        for j in range(ny):
            if lowest[i, j] > envelope[i, j]:
                lowest[i, j] = np.inf

    # 3. mean of their lowest layer, or of the one above it
    total, count = np.zeros((nx * ny, 3), np.float32), np.zeros((nx * ny, 3), np.float32)
    layers = np.float32(1.0 / band)
    for n in range(px.shape[0]):
        if cell[n] >= 0:
            c = cell[n] & 0x7FFFFFFF
            above = pz[n] - flat[c]
            layer = above * layers
            if layer >= 0 and layer < 3:
                total[c, int(layer) & 3] += above
                count[c, int(layer) & 3] += np.float32(1.0)
    weight = np.zeros((nx, ny), np.float32)
    for i in range(nx):
        for j in range(ny):
            c = i * ny + j
            k = 1 if count[c, 1] >= 10 * count[c, 0] and count[c, 1] >= 10 * count[c, 2] else 0
            height[i, j] = 0
            if count[c, k] > 0:
                height[i, j] = lowest[i, j] + total[c, k] / count[c, k]
                weight[i, j] = min(count[c, k], np.float32(8.0))
            elif i == i0 and j == j0 and math.isfinite(lowest[i, j]):
                height[i, j], weight[i, j] = ground_point[2], np.float32(1.0)

    # 4. a smooth surface through them
    fill(height, weight, np.float32(ground_point[2]))


@kernel
def _drop_strays(lowest, i0, j0, ground_z, rise, tolerance):
    """Set cells to inf whose lowest return lies under the ground: mirror images and multipath.

    Square rings of cells are visited outward from cell (i0, j0), where the ground is known. Each cell expects
    the height of its up to three inner neighbours, the more the fewer steps ago they saw ground, and may lie
    below it by `tolerance` plus `rise` for each of these steps. What a stray return spoils stays behind it.
    """
    nx, ny = lowest.shape
    ground = np.full((nx, ny), ground_z, np.float32)
    steps = np.zeros((nx, ny), np.float32)
    one = np.float32(1.0)
    for ring in range(1, max(i0, nx - 1 - i0, j0, ny - 1 - j0) + 1):
        for i in range(max(i0 - ring, 0), min(i0 + ring + 1, nx)):
            stride = 1 if abs(i - i0) == ring else 2 * ring  # whole edge, or the two ends of a row
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
def lower_envelope(height, rise):
    """Lower every cell to what its neighbours allow: a two-pass chamfer distance transform in height."""
    nx, ny = height.shape
    diagonal = rise * np.float32(math.sqrt(2.0))
    for i in range(nx):
        for j in range(ny):
            low = height[i, j]
            if i > 0:
                low = min(low, height[i - 1, j] + rise)
                if j > 0:
                    low = min(low, height[i - 1, j - 1] + diagonal)
                if j < ny - 1:
                    low = min(low, height[i - 1, j + 1] + diagonal)
            if j > 0:
                low = min(low, height[i, j - 1] + rise)
            height[i, j] = low
    for i in range(nx - 1, -1, -1):
        for j in range(ny - 1, -1, -1):
            low = height[i, j]
            if i < nx - 1:
                low = min(low, height[i + 1, j] + rise)
                if j > 0:
                    low = min(low, height[i + 1, j - 1] + diagonal)
                if j < ny - 1:
                    low = min(low, height[i + 1, j + 1] + diagonal)
            if j < ny - 1:
                low = min(low, height[i, j + 1] + rise)
            height[i, j] = low


@kernel
def fill(height, weight, otherwise):
    """Give cells of weight 0 the height of a smooth surface through the others (pull-push), in place."""
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
    for i in range(nx):  # push: what is missing comes from the level above, interpolated
        for j in range(ny):
            if weight[i, j] == 0:
                height[i, j] = sample(
                    coarse,
                    np.float32(0.0),
                    np.float32(0.0),
                    np.float32(0.5),
                    np.float32(i) + np.float32(0.5),
                    np.float32(j) + np.float32(0.5),
                )
