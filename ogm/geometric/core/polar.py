"""The polar grid around the sensor: which bins cover a cell, where a point lies, how high a ray passes."""

import math

import numpy as np

from ogm.geometric.core.jit import inline, kernel, vector
from ogm.geometric.core.surface import sample

__all__ = ["ROW_BITS", "azimuth", "level_ray_weight", "polar_coordinates", "polar_lookup"]

TAU = np.float32(2 * math.pi)
ROW_BITS = 3  # the ground is sampled once for 2**3 neighbouring sectors
_ATAN = (
    0.99999611,
    -0.33317370,
    0.19807826,
    -0.13233361,
    0.07962379,
    -0.03360420,
    0.00681176,
)  # odd powers, fitted


@kernel
def polar_lookup(x0, y0, resolution, origin, box, sectors, radial_step, bins, sector, span, ring):
    """Tell for every cell which polar bins around the sensor cover it.

    Parameters
    ----------
    x0, y0, resolution : float
        Corner and cell side of the grid [m].
    origin : (3,) float32
        The sensor [m].
    box : (4,) float32
        x_min, x_max, y_min, y_max of the own vehicle [m]: cells whose middle lies in it get no ring.
    sectors, bins : int
        Size of the polar grid.
    radial_step : float
        Depth of a polar bin [m].
    sector, span : (nx, ny) int16
        Filled: the first sector that the cell touches, counted to the left from the x axis, and how many
        sectors it subtends there, at least one.
    ring : (nx, ny) int16
        Filled: radial bin, or -1 for a cell that no ray can say anything about.
    """
    nx, ny = ring.shape
    for i in range(nx):
        for j in range(ny):
            x, y = x0 + (i + 0.5) * resolution, y0 + (j + 0.5) * resolution
            dx, dy = x - origin[0], y - origin[1]
            r = math.sqrt(dx * dx + dy * dy)
            if x > box[0] and x < box[1] and y > box[2] and y < box[3]:
                ring[i, j], sector[i, j], span[i, j] = -1, 0, 1
                continue
            ring[i, j] = min(int(r / radial_step), bins - 1)
            middle = math.atan2(dy, dx) * sectors / (2 * math.pi)
            width = min(resolution / max(r, resolution / 8) / (2 * math.pi), 1.0) * sectors
            span[i, j] = max(round(width), 1)
            sector[i, j] = round(middle - span[i, j] / 2) % sectors


@inline
def azimuth(x, y):
    """Angle from the x axis to the left in [0, 2 pi), by a polynomial with an error below 1e-6 rad."""
    ax, ay = abs(x), abs(y)
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
def polar_coordinates(x, y, z, sx, sy, sz, to_sector, last_sector, sector, slope, run):
    """Sector, rise over run and run of each point as seen from the sensor, without branches."""
    for n in range(x.shape[0]):
        dx, dy, dz = x[n] - sx, y[n] - sy, z[n] - sz
        r = np.sqrt(dx * dx + dy * dy)
        sector[n] = min(np.int32(azimuth(dx, dy) * to_sector), last_sector)
        slope[n] = dz / max(r, np.float32(1e-30))
        run[n] = r


@kernel
def level_ray_weight(height, x0, y0, resolution, origin, clearance, radial_step, say):
    """Sample the ground along sectors, as the say that a level ray from the sensor has there.

    Parameters
    ----------
    height : (gx, gy) float32
        Heights of the ground [m] on a grid with corner (x0, y0) and cells of `resolution` [m].
    origin : (3,) float32
        The sensor [m].
    clearance : float
        Height above ground from which a ray says nothing [m].
    radial_step : float
        Depth of a bin [m].
    say : (rows, bins) float32
        Filled: ``1 - (height of the sensor above the ground there) / clearance``. The ground is sampled in
        every fourth bin, linear between.
    """
    rows, bins = say.shape
    x0, y0, inverse = np.float32(x0), np.float32(y0), np.float32(1.0 / resolution)
    z, per_metre = origin[2], np.float32(1.0 / clearance)
    for s in range(rows):
        angle = (s + 0.5) * 2 * math.pi / rows
        cx, cy = np.float32(math.cos(angle) * radial_step), np.float32(math.sin(angle) * radial_step)
        before = np.float32(0.0)
        for k in range(0, bins + 3, 4):
            middle = np.float32(k) + np.float32(0.5)
            ground = sample(height, x0, y0, inverse, origin[0] + cx * middle, origin[1] + cy * middle)
            now = np.float32(1.0) - (z - ground) * per_metre
            if k > 0:
                for part in range(4):
                    if k - 4 + part < bins:
                        say[s, k - 4 + part] = before + (now - before) * np.float32(part) * np.float32(0.25)
            if k < bins:
                say[s, k] = now
            before = now
