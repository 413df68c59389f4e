"""From returns, and from beams without echo, to rays; and the marks that obstacles leave."""

# mypy: allow-untyped-defs
import math

import numpy as np

from ogm.geometric.kernels.arguments import Rays
from ogm.geometric.kernels.polar import ROW_BITS, azimuth, polar_coordinates
from ogm.geometric.kernels.surface import sample
from ogm.jit import kernel, vector

__all__ = ["aim_no_returns", "mark_and_aim"]


@vector
def mark_and_aim(points, origin, ground, level, polar, cells, numbers, work):
    """Let obstacle returns mark their cells, and turn every return into the ray that led to it.

    A ray clears its sector from the sensor to its end: up to the bin of a ground return, to two standard
    deviations before an obstacle, and no further than it stays below `clearance`. An obstacle return is
    spread over the two points one standard deviation before and behind it (two-point Gauss-Hermite rule),
    each marking its cell with half a hit. Returns further than `below_ground` under the ground are multipath
    and have no effect.

    Parameters
    ----------
    points : Points
    origin : (3,) float32
        The sensor [m].
    ground : Surface
    level : (rows, bins) float32
        From `level_ray_weight`.
    polar : PolarGrid
    cells : Cells
    numbers : RayNumbers
    work : WorkSpace
        `hits` is filled with half hits, two for every obstacle return.

    Returns
    -------
    Rays
    """
    x, y, z = points
    sx, sy, _ = origin
    low, high = np.float32(numbers.obstacle_height), np.float32(numbers.clearance)
    below, noise = -np.float32(numbers.below_ground), np.float32(numbers.range_noise)
    margin, most, zero = np.float32(2.0) * noise, np.float32(polar.bins), np.float32(0.0)
    half, near, one = np.float32(0.5), np.float32(polar.step), np.float32(1.0)
    per_metre, scale = np.float32(1.0 / polar.step), np.float32(polar.step / numbers.clearance)
    highest = _highest(level, polar.sectors)
    polar_coordinates(points, origin, polar.sectors, work)
    sector, slope, run, table, hits = work.sector, work.slope, work.run, work.table, work.hits
    starts = _starts(sector, polar.sectors)
    hits[:] = 0
    for n in range(x.shape[0]):
        # Where the ray ends, in bins, by the height of its return above the ground
        r = run[n]
        above = z[n] - sample(ground, x[n], y[n])
        if above < below or r < near:  # multipath, or straight up or down
            reach = zero
        elif above <= low:
            reach = r * per_metre + one
        elif above >= high:
            reach = r * per_metre
        else:
            reach = max((r - margin) * per_metre, zero)
            share = noise / r
            du, dv = (x[n] - sx) * share, (y[n] - sy) * share
            _mark(hits, cells, x[n] - du, y[n] - dv)
            _mark(hits, cells, x[n] + du, y[n] + dv)

        # The bins in which it is below clearance
        s = sector[n] & 0x7FFF
        tilt, start, stop, row = slope[n] * scale, 0, int(min(reach, most)), s >> ROW_BITS
        first, last = tilt * half, tilt * (np.float32(stop) - half)
        if stop > 0 and not (level[row, 0] > first and level[row, (stop - 1) & 0x7FFF] > last):
            start, stop = _clip_below_clearance(level, row, tilt, stop, highest[s])

        # File it in its sector (a counting sort)
        to = starts[s + 1] & 0x7FFFFFFF
        starts[s + 1] += 1
        table[to, 0], table[to, 1], table[to, 2] = slope[n], start, stop
    return Rays(table, starts[: polar.sectors + 1])


@vector
def _mark(hits, cells, x, y):
    """Add half a hit to the cell at (x, y), if it lies in the grid."""
    inverse = np.float32(1.0 / cells.resolution)
    u, v = (x - np.float32(cells.x0)) * inverse, (y - np.float32(cells.y0)) * inverse
    if u >= 0 and u < hits.shape[0] and v >= 0 and v < hits.shape[1]:
        hits[int(u) & 0x7FFFFFFF, int(v) & 0x7FFFFFFF] += 1


@kernel
def aim_no_returns(directions, level, polar, numbers):
    """Turn beams without echo into rays that end where they meet the ground, or at `max_range`.

    Parameters
    ----------
    directions : (M, 3) float32
        Unit vectors, in the frame of the grid; those that are no directions clear nothing.
    level : (rows, bins) float32
        From `level_ray_weight`.
    polar : PolarGrid
    numbers : RayNumbers

    Returns
    -------
    Rays
    """
    count, bins, sectors = directions.shape[0], polar.bins, polar.sectors
    to_sector, scale = np.float32(sectors / (2 * math.pi)), np.float32(polar.step / numbers.clearance)
    highest = _highest(level, sectors)
    sector, rays = np.zeros(count, np.int32), np.zeros((count, 3), np.float32)
    for n in range(count):
        dx, dy, dz = directions[n, 0], directions[n, 1], directions[n, 2]
        across = math.sqrt(dx * dx + dy * dy)
        if not (across > 1e-3 and across < 2 and abs(dz) < 2):
            continue
        s = min(int(azimuth(dx, dy) * to_sector), sectors - 1)
        tilt = dz / across * scale
        stop = int(min(numbers.max_range * across / polar.step, bins))
        for k in range(stop):
            if level[s >> ROW_BITS, k] - tilt * (np.float32(k) + np.float32(0.5)) > 1:
                stop = k
                break
        start, stop = _clip_below_clearance(level, s >> ROW_BITS, tilt, stop, highest[s])
        sector[n], rays[n, 0], rays[n, 1], rays[n, 2] = s, dz / across, start, stop
    starts, table = _starts(sector, sectors), np.empty((count, 3), np.float32)
    for n in range(count):
        s = (sector[n] & 0x7FFF) + 1
        table[starts[s]] = rays[n]
        starts[s] += 1
    return Rays(table, starts[: sectors + 1])


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
def _clip_below_clearance(level, row, tilt, stop, highest):
    """Return the bins, of the first `stop`, in which a ray is below clearance: the first, and the first after."""
    start = 0
    if tilt > 0 and tilt * stop > highest:
        stop = min(stop, int(max(highest, np.float32(0.0)) / tilt) + 1)
    while stop > 0 and not level[row, stop - 1] > tilt * (np.float32(stop) - np.float32(0.5)):
        stop -= 1
    if stop > 0 and not level[row, 0] > tilt * np.float32(0.5):  # it begins above clearance: a tall mount
        if tilt < 0:
            start = min(int(level[row, 0] / tilt), stop - 1)  # where it comes down over flat ground
        while start > 0 and level[row, start - 1] > tilt * (np.float32(start) - np.float32(0.5)):
            start -= 1
        while start < stop and not level[row, start] > tilt * (np.float32(start) + np.float32(0.5)):
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
