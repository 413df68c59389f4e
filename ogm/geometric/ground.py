"""Where the ground is: from one scan to a map of ground heights.

A ground estimate is a function ``(xyz, spec, foot) -> height``: points in the vehicle frame, the coarse grid
to fill and the spot of ground under the sensor go in, one height per cell comes out. `RayISM` takes any;
`flat_ground`, `local_ground` and `patchwork_ground` are the ones at hand.
"""

import math
from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ogm.grid import GridSpec

__all__ = ["GroundEstimate", "flat_ground", "ground_height", "local_ground", "patchwork_ground"]

Foot = tuple[float, float, float]
GroundEstimate = Callable[[NDArray[np.float32], GridSpec, Foot], NDArray[np.float32]]

MAX_SLOPE = 0.25  # rise over run that still counts as ground; public roads reach 0.15, ramps and banks more
DESCENT = 0.15  # average descent from the vehicle below which returns are taken for mirror images
LOW_TOLERANCE = 0.4  # [m] what a cell may lie below its surroundings beyond that descent
SENSOR_HEIGHT = 1.8  # [m] where Patchwork++ is told the sensor is
ENOUGH = 65536  # [points] of a larger cloud every second, third, ... return is looked at
BAND = 0.25  # [m] thickness of the layer of returns that is averaged into a cell's ground height


def flat_ground(xyz: NDArray[np.float32], spec: GridSpec, foot: Foot) -> NDArray[np.float32]:
    """Take the ground to be the plane under the sensor, whatever the points say.

    Parameters
    ----------
    xyz : (N, 3) float32
        Points in the vehicle frame [m].
    spec : GridSpec
        Cells to fill.
    foot : (float, float, float)
        x, y, z of the ground under the sensor, in the vehicle frame [m]; inside `spec`.

    Returns
    -------
    (nx, ny) float32
        Height of the ground at each cell's middle [m].
    """
    return np.full(spec.shape, foot[2], np.float32)


def local_ground(
    xyz: NDArray[np.float32], spec: GridSpec, foot: Foot, max_slope: float = MAX_SLOPE
) -> NDArray[np.float32]:
    """Estimate the ground as the highest surface below the points that nowhere climbs faster than a road can.

    1. the lowest return of each cell; what lies too far below the ground around it is stray and dropped;
    2. the lower envelope of these heights, and of the foot, under the slope limit (a cone grown from every
       cell): walls, cars and crowns stand above it, ramps and hills do not;
    3. cells whose lowest return touches the envelope are ground; the mean of their lowest layer of returns is the
       height, or of the layer above it, where that is thin and holds ten times the returns (the lowest are
       stray);
    4. cells without ground take a smooth surface through the known ones (pull-push, Gortler et al. 1996).

    Parameters, returns : see `flat_ground`
    max_slope : float
        Steepest rise over run that is ground.
    """
    height = np.empty(spec.shape, np.float32)
    _local_ground(
        *(np.ascontiguousarray(xyz[:: 1 + len(xyz) // ENOUGH, k]) for k in range(3)),
        foot,
        spec.origin[0],
        spec.origin[1],
        spec.resolution,
        max_slope,
        DESCENT,
        LOW_TOLERANCE,
        BAND,
        height,
    )
    return height


def patchwork_ground(xyz: NDArray[np.float32], spec: GridSpec, foot: Foot) -> NDArray[np.float32]:
    """Estimate the ground with Patchwork++ (Lee et al. 2022), if ``pypatchworkpp`` is installed.

    Parameters, returns : see `flat_ground`

    Raises
    ------
    ImportError
        If the package is absent; the message holds the pip command that adds it.
    """
    try:
        import pypatchworkpp
    except ImportError as error:
        raise ImportError(
            'patchwork_ground needs pypatchworkpp: pip install "ogm-toolkit[ground]"'
        ) from error
    parameters = pypatchworkpp.Parameters()
    parameters.verbose = False
    parameters.sensor_height = SENSOR_HEIGHT
    estimator = pypatchworkpp.patchworkpp(parameters)
    shift = np.array(
        [foot[0], foot[1], foot[2] + SENSOR_HEIGHT], np.float32
    )  # it wants the sensor at (0, 0, 0)
    estimator.estimateGround(np.pad(xyz - shift, ((0, 0), (0, 1))))  # intensity 0 for all
    ground = xyz[np.asarray(estimator.getGroundIndices(), np.int64)]
    total, count = np.zeros(spec.shape), np.zeros(spec.shape)
    inside = spec.contains(ground[:, 0], ground[:, 1])
    cell = spec.index(ground[inside, 0], ground[inside, 1])
    np.add.at(total, cell, ground[inside, 2])
    np.add.at(count, cell, 1)
    height = np.zeros(spec.shape, np.float32)
    height[count > 0] = total[count > 0] / count[count > 0]
    _fill(height, np.minimum(count, 8).astype(np.float32), np.float32(foot[2]))
    return height


def ground_height(
    height: NDArray[np.float32], spec: GridSpec, xyz: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the ground's height under each point, bilinear between the cells' middles.

    Parameters
    ----------
    height : (nx, ny) float32
        What a ground estimate returned for `spec` [m].
    spec : GridSpec
    xyz : (N, 3 or more) float32
        Points in the frame of `spec` [m]. Beyond the outermost middles the edge's height holds.

    Returns
    -------
    (N,) float32
        Height of the ground [m]; ``xyz[:, 2]`` minus this is the height above ground.
    """
    result = np.empty(len(xyz), np.float32)
    x, y = np.ascontiguousarray(xyz[:, 0], np.float32), np.ascontiguousarray(xyz[:, 1], np.float32)
    _sample_many(height, spec.origin[0], spec.origin[1], spec.resolution, x, y, result)
    return result


@njit(cache=True, error_model="numpy", inline="always")
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


@njit(cache=True, error_model="numpy")
def _sample_many(height, x0, y0, resolution, x, y, result):
    x0, y0, inverse = np.float32(x0), np.float32(y0), np.float32(1.0 / resolution)
    for n in range(x.shape[0]):
        result[n] = sample(height, x0, y0, inverse, x[n], y[n])


@njit(cache=True, error_model="numpy")
def _local_ground(px, py, pz, foot, x0, y0, resolution, max_slope, max_descent, low_tolerance, band, height):
    nx, ny = height.shape
    rise = np.float32(max_slope * resolution)
    x0, y0, inverse = np.float32(x0), np.float32(y0), np.float32(1.0 / resolution)
    foot_x, foot_y = np.float32(foot[0]), np.float32(foot[1])

    # 1. lowest return of each cell, but for what no road could lead down to
    flat = np.full(nx * ny, np.inf, np.float32)
    cell = np.empty(px.shape[0], np.int32)
    bottom, steepest = np.float32(foot[2] - low_tolerance), np.float32(max_descent * max_descent)
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
    i0, j0 = int((foot_x - x0) * inverse), int((foot_y - y0) * inverse)
    _drop_strays(
        lowest, i0, j0, np.float32(foot[2]), np.float32(max_descent * resolution), np.float32(low_tolerance)
    )

    # 2. lower envelope under the slope limit, from these and from the foot: only cells that touch it are ground
    lowest[i0, j0] = min(lowest[i0, j0], np.float32(foot[2]))
    envelope = lowest.copy()
    _lower_envelope(envelope, rise)
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
            elif i == i0 and j == j0:
                height[i, j], weight[i, j] = foot[2], np.float32(1.0)

    # 4. a smooth surface through them
    _fill(height, weight, np.float32(foot[2]))


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def _lower_envelope(height, rise):
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


@njit(cache=True, error_model="numpy")
def _fill(height, weight, otherwise):
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
    _fill(coarse, total, otherwise)
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
