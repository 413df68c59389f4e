"""From returns, and from beams that came back empty, to rays; and the marks that obstacles leave."""

import math

import numpy as np

from ogm.geometric.core.jit import kernel, vector
from ogm.geometric.core.polar import ROW_BITS, azimuth, polar_coordinates
from ogm.geometric.core.surface import sample

__all__ = ["aim_missing", "mark_and_aim", "sort_rays"]


@vector
def mark_and_aim(
    x,
    y,
    z,
    origin,
    height,
    ground_x0,
    ground_y0,
    ground_resolution,
    level,
    obstacle_height,
    clearance,
    below_ground,
    range_noise,
    radial_step,
    sectors,
    x0,
    y0,
    resolution,
    hits,
    sector,
    slope,
    run,
    rays,
):
    """Let obstacle returns mark their cells, and turn every return into the ray that led to it.

    A ray clears its sector from the sensor to its end: up to the bin of a ground return, to two standard
    deviations before an obstacle, and no further than it stays below `clearance`. An obstacle return is
    spread over the two points one standard deviation before and behind it (two-point Gauss-Hermite rule),
    each marking its cell with half a hit. Returns further than `below_ground` under the ground are mirror
    images and say nothing.

    Parameters
    ----------
    x, y, z : (N,) float32
        Points in the frame of the grid [m].
    origin : (3,) float32
        The sensor [m].
    height : (gx, gy) float32; ground_x0, ground_y0, ground_resolution : float
        Ground heights and where they lie [m].
    level : (rows, bins) float32
        From `level_ray_weight`.
    obstacle_height, clearance, below_ground, range_noise, radial_step : float
        [m]; see `RayISM`.
    sectors : int
    x0, y0, resolution : float
        Corner and cell side of the grid [m].
    hits : (nx, ny) int32
        Added to: half hits, two for every obstacle return.
    sector : (N,) int32; slope, run : (N,) float32
        Work space.
    rays : (N, 3) float32
        Filled, sector by sector: a ray's rise over run, the first bin that it clears, and the first after
        these that it does not.

    Returns
    -------
    starts : (sectors + 1,) int32
        Where each sector begins in `rays`.
    """
    nx, ny = hits.shape
    bins = level.shape[1]
    inverse_step, inverse = np.float32(1.0 / radial_step), np.float32(1.0 / resolution)
    gx0, gy0, ginverse = np.float32(ground_x0), np.float32(ground_y0), np.float32(1.0 / ground_resolution)
    low, high, below = np.float32(obstacle_height), np.float32(clearance), -np.float32(below_ground)
    noise, x0, y0 = np.float32(range_noise), np.float32(x0), np.float32(y0)
    margin, most, zero = np.float32(2.0) * noise, np.float32(bins), np.float32(0.0)
    half = np.float32(0.5)
    near, one, scale = np.float32(radial_step), np.float32(1.0), np.float32(radial_step / clearance)
    sx, sy, sz = origin
    highest = _highest(level, sectors)
    polar_coordinates(
        x, y, z, sx, sy, sz, np.float32(sectors / (2 * math.pi)), np.int32(sectors - 1), sector, slope, run
    )
    starts = _starts(sector, sectors)
    for n in range(x.shape[0]):
        r = run[n]
        above = z[n] - sample(height, gx0, gy0, ginverse, x[n], y[n])
        if above < below or r < near:  # a mirror image, or straight up or down
            reach = zero
        elif above <= low:
            reach = r * inverse_step + one
        elif above >= high:
            reach = r * inverse_step
        else:
            reach = max((r - margin) * inverse_step, zero)
            share = noise / r
            du, dv = (x[n] - sx) * share, (y[n] - sy) * share
            u, v = (x[n] - du - x0) * inverse, (y[n] - dv - y0) * inverse
            if u >= 0 and u < nx and v >= 0 and v < ny:
                hits[int(u) & 0x7FFFFFFF, int(v) & 0x7FFFFFFF] += 1
            u, v = (x[n] + du - x0) * inverse, (y[n] + dv - y0) * inverse
            if u >= 0 and u < nx and v >= 0 and v < ny:
                hits[int(u) & 0x7FFFFFFF, int(v) & 0x7FFFFFFF] += 1
        s = sector[n] & 0x7FFF
        to = starts[s + 1] & 0x7FFFFFFF
        starts[s + 1] += 1
        tilt, start, stop, row = slope[n] * scale, 0, int(min(reach, most)), s >> ROW_BITS
        first, last = tilt * half, tilt * (np.float32(stop) - half)
        if stop > 0 and not (level[row, 0] > first and level[row, (stop - 1) & 0x7FFF] > last):
            start, stop = _clip_below_clearance(level, row, tilt, stop, highest[s])
        rays[to, 0], rays[to, 1], rays[to, 2] = slope[n], start, stop
    return starts[: sectors + 1]


@kernel
def aim_missing(directions, level, clearance, radial_step, max_range, sectors, sector, rays):
    """Turn beams that came back empty into rays that end where they meet the ground, or at `max_range`.

    Parameters
    ----------
    directions : (M, 3) float32
        Unit vectors, in the frame of the grid; those that are not finite clear nothing.
    level : (rows, bins) float32
        From `level_ray_weight`.
    clearance, radial_step, max_range : float
        [m]; see `RayISM`.
    sectors : int
    sector : (M,) int32
        Filled.
    rays : (M, 3) float32
        Filled as by `mark_and_aim`, but in the order of the beams.
    """
    bins = level.shape[1]
    to_sector, scale = np.float32(sectors / (2 * math.pi)), np.float32(radial_step / clearance)
    highest = _highest(level, sectors)
    for n in range(directions.shape[0]):
        dx, dy, dz = directions[n, 0], directions[n, 1], directions[n, 2]
        across = math.sqrt(dx * dx + dy * dy)
        sector[n], rays[n, 0], rays[n, 1], rays[n, 2] = 0, 0, 0, 0
        if not (across > 1e-3 and across < 2 and abs(dz) < 2):
            continue
        s = min(int(azimuth(dx, dy) * to_sector), sectors - 1)
        tilt = dz / across * scale
        stop = int(min(max_range * across / radial_step, bins))
        for k in range(stop):
            if level[s >> ROW_BITS, k] - tilt * (np.float32(k) + np.float32(0.5)) > 1:
                stop = k
                break
        start, stop = _clip_below_clearance(level, s >> ROW_BITS, tilt, stop, highest[s])
        sector[n], rays[n, 0], rays[n, 1], rays[n, 2] = s, dz / across, start, stop


@kernel
def sort_rays(sector, rays, sectors, ordered):
    """Bring the rays of each sector together (a counting sort).

    Parameters
    ----------
    sector : (N,) int32; rays : (N, 3) float32
        From `aim_missing`.
    sectors : int
    ordered : (N, 3) float32
        Filled.

    Returns
    -------
    starts : (sectors + 1,) int32
        Where each sector begins in `ordered`.
    """
    starts = _starts(sector, sectors)
    for n in range(sector.shape[0]):
        s = (sector[n] & 0x7FFF) + 1
        ordered[starts[s]] = rays[n]
        starts[s] += 1
    return starts[: sectors + 1]


@kernel
def _starts(sector, sectors):
    """Begin a counting sort: entry s + 1 is where the next ray of sector s goes, and in the end where s ends."""
    starts = np.zeros(sectors + 2, np.int32)
    for n in range(sector.shape[0]):
        starts[(sector[n] & 0x7FFF) + 2] += 1
    for s in range(sectors + 1):
        starts[s + 1] += starts[s]
    return starts


@kernel
def _clip_below_clearance(level, s, tilt, stop, highest):
    """Cut a ray to the bins in which it is below clearance: first, and first not (up to `stop`)."""
    start = 0
    if tilt > 0 and tilt * stop > highest:
        stop = min(stop, int(max(highest, np.float32(0.0)) / tilt) + 1)
    while stop > 0 and not level[s, stop - 1] > tilt * (np.float32(stop) - np.float32(0.5)):
        stop -= 1
    if stop > 0 and not level[s, 0] > tilt * np.float32(0.5):  # it begins above clearance: a tall mount
        if tilt < 0:
            start = min(int(level[s, 0] / tilt), stop - 1)  # where it comes down over flat ground
        while start > 0 and level[s, start - 1] > tilt * (np.float32(start) - np.float32(0.5)):
            start -= 1
        while start < stop and not level[s, start] > tilt * (np.float32(start) + np.float32(0.5)):
            start += 1
    return start, stop


@kernel
def _highest(level, sectors):
    """Return the largest value of each row, for each sector."""
    rows, bins = level.shape
    highest = np.empty(sectors, np.float32)
    for s in range(rows):
        most = level[s, 0]
        for k in range(bins):
            most = max(most, level[s, k])
        highest[s * (sectors // rows) : (s + 1) * (sectors // rows)] = most
    return highest
