"""Polar grid around the sensor: bins of each cell, coordinates of points, slopes of rays."""

import math

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import Cells, Points, PolarGrid, RayLimits, Surface, WorkSpace
from ogm.geometric.kernels.surface import sample
from ogm.jit import inline, kernel, vector

__all__ = ["ROW_BITS", "azimuth", "polar_coordinates", "polar_lookup", "ray_limits"]

TAU = np.float32(2 * math.pi)
ROW_BITS = 3  # 2**3 neighbouring sectors share the samples of the ground
# Fitted coefficients of the odd powers of the arc tangent
_ATAN = (0.99999611, -0.33317370, 0.19807826, -0.13233361, 0.07962379, -0.03360420, 0.00681176)


@kernel
def polar_lookup(
    cells: Cells,
    shape: tuple[int, int],
    origin: NDArray[np.float32],
    footprint: NDArray[np.float32],
    sectors: int,
    bins: int,
) -> tuple[NDArray[np.int16], NDArray[np.int16], NDArray[np.int16]]:
    """Return the polar bins around the sensor that cover each cell.

    Parameters
    ----------
    cells : Cells, shape : (nx, ny)
        The grid; a polar bin is one cell deep.
    origin : (3,) float32
        The sensor [m].
    footprint : (4,) float32
        x_min, x_max, y_min, y_max of the ego vehicle [m]; cells with their middle inside get no ring.
    sectors, bins : int
        Size of the polar grid.

    Returns
    -------
    sector, span, ring : (nx, ny) int16
        See `PolarGrid`.
    """
    sector, span, ring = np.empty(shape, np.int16), np.empty(shape, np.int16), np.empty(shape, np.int16)
    x0, y0, resolution = cells
    for i in range(shape[0]):
        for j in range(shape[1]):
            x, y = x0 + (i + 0.5) * resolution, y0 + (j + 0.5) * resolution
            dx, dy = x - origin[0], y - origin[1]
            r = math.sqrt(dx * dx + dy * dy)
            if x > footprint[0] and x < footprint[1] and y > footprint[2] and y < footprint[3]:
                ring[i, j], sector[i, j], span[i, j] = -1, 0, 1
                continue
            ring[i, j] = min(int(r / resolution), bins - 1)
            middle = math.atan2(dy, dx) * sectors / (2 * math.pi)
            width = min(resolution / max(r, resolution / 8) / (2 * math.pi), 1.0) * sectors
            span[i, j] = max(round(width), 1)
            sector[i, j] = round(middle - span[i, j] / 2) % sectors
    return sector, span, ring


@inline
def azimuth(x: np.float32, y: np.float32) -> np.float32:
    """Return the angle from the x axis to the left in [0, 2 pi), by a polynomial with an error below 1e-6 rad."""
    ax: np.float32 = abs(x)
    ay: np.float32 = abs(y)
    long = max(ax, ay)
    q = min(ax, ay) / max(long, np.float32(1e-30))
    s = q * q
    a = np.float32(_ATAN[6])
    a = a * s + np.float32(_ATAN[5])
    a = a * s + np.float32(_ATAN[4])
    a = a * s + np.float32(_ATAN[3])
    a = a * s + np.float32(_ATAN[2])
    a = a * s + np.float32(_ATAN[1])
    a = (a * s + np.float32(_ATAN[0])) * q
    a = np.float32(math.pi / 2) - a if ay > ax else a
    a = np.float32(math.pi) - a if x < 0 else a
    return TAU - a if y < 0 else a


@vector
def polar_coordinates(
    points: Points, origin: NDArray[np.float32], sectors: int, first: int, last: int, work: WorkSpace
) -> None:
    """Fill in sector, slope (rise over run) and run [m] of points from `first` to ``last - 1``, without branches."""
    x, y, z = points
    sx, sy, sz = origin
    to_sector, top = np.float32(sectors / (2 * math.pi)), np.int32(sectors - 1)
    sector, slope, run = work.sector, work.slope, work.run
    for n in range(first & 0x7FFFFFFF, last & 0x7FFFFFFF):  # a mask shows the compiler that an index is not negative
        dx, dy, dz = x[n] - sx, y[n] - sy, z[n] - sz
        r = np.sqrt(dx * dx + dy * dy)
        sector[n] = min(np.int32(azimuth(dx, dy) * to_sector), top)
        slope[n] = dz / max(r, np.float32(1e-30))
        run[n] = r


@kernel
def ray_limits(ground: Surface, origin: NDArray[np.float32], clearance: float, polar: PolarGrid) -> RayLimits:
    """Return the slopes of the rays that meet the ground and the clearance in the middle of each bin.

    Parameters
    ----------
    ground : Surface
    origin : (3,) float32
        The sensor [m].
    clearance : float
        Height above ground from which a ray has no effect [m].
    polar : PolarGrid

    Returns
    -------
    RayLimits
        The ground is sampled in every fourth bin and interpolated linearly.
    """
    rows, bins, step = polar.rows, polar.bins, polar.step
    low, high = np.empty((rows, bins), np.float32), np.empty((rows, bins), np.float32)
    above = np.float32(clearance)
    for s in range(rows):
        angle = (s + 0.5) * 2 * math.pi / rows
        cx, cy = np.float32(math.cos(angle) * step), np.float32(math.sin(angle) * step)
        before = np.float32(0.0)
        for k in range(0, bins + 3, 4):
            middle = np.float32(k) + np.float32(0.5)
            now = sample(ground, origin[0] + cx * middle, origin[1] + cy * middle) - origin[2]
            if k > 0:
                for part in range(4):
                    if k - 4 + part < bins:
                        low[s, k - 4 + part] = before + (now - before) * np.float32(part) * np.float32(0.25)
            if k < bins:
                low[s, k] = now
            before = now
        for k in range(bins):
            per_metre = np.float32(1.0) / ((np.float32(k) + np.float32(0.5)) * np.float32(step))
            high[s, k] = (low[s, k] + above) * per_metre
            low[s, k] *= per_metre
    return RayLimits(low, high)
