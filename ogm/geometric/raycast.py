"""Kernels that turn points into cells: plain arrays and numbers in and out, one thread, nothing hidden.

Every kernel has a slow twin in `ogm.geometric.twins` that says the same in a few lines of Python.
"""

import math

import numpy as np
from numba import njit

from ogm.geometric.ground import sample

__all__ = [
    "aim_missing",
    "clear_sectors",
    "draw_lines",
    "height_band_states",
    "level_say",
    "mark_and_aim",
    "own_frame",
    "polar_lookup",
    "ray_mass",
    "sort_rays",
    "state_mass",
]

UNKNOWN, FREE, OCCUPIED, BEYOND = 0, 1, 2, 3  # states of a cell while `height_band_states` draws
# numpy's error model: a division is not guarded by a branch, which would keep loops off the vector units.
_kernel = njit(cache=True, error_model="numpy")
_inline = njit(cache=True, error_model="numpy", inline="always")
_vector = njit(cache=True, error_model="numpy", fastmath={"contract", "nsz", "nnan"})  # for input without NaN
_TAU = np.float32(2 * math.pi)
_ATAN = (
    0.99999611,
    -0.33317370,
    0.19807826,
    -0.13233361,
    0.07962379,
    -0.03360420,
    0.00681176,
)  # odd powers, fitted


@_kernel
def own_frame(points, T, box, xyz):
    """Take points to the vehicle frame and drop those that are not finite or lie in the vehicle's own box.

    Parameters
    ----------
    points : (N, 3 or more) float32
        x, y, z [m] in the sensor frame.
    T : (3, 4) float32
        Vehicle from sensor.
    box : (4,) float32
        x_min, x_max, y_min, y_max [m] of the own vehicle, in the vehicle frame.
    xyz : (3, N) float32
        Filled with the points that stay, in their order: a row of x, one of y, one of z.

    Returns
    -------
    kept, invalid, own : int
        Rows filled, rows dropped for NaN or inf, rows dropped as returns from the own vehicle.
    """
    r00, r01, r02, tx = T[0]
    r10, r11, r12, ty = T[1]
    r20, r21, r22, tz = T[2]
    x_min, x_max, y_min, y_max = box
    limit = np.float32(1e6)  # [m] also keeps what follows from overflowing
    kept, invalid, own = 0, 0, 0
    for n in range(points.shape[0]):
        a, b, c = points[n, 0], points[n, 1], points[n, 2]
        if not (abs(a) < limit and abs(b) < limit and abs(c) < limit):
            invalid += 1
            continue
        x, y, z = (
            r00 * a + r01 * b + r02 * c + tx,
            r10 * a + r11 * b + r12 * c + ty,
            r20 * a + r21 * b + r22 * c + tz,
        )
        if x > x_min and x < x_max and y > y_min and y < y_max:
            own += 1
            continue
        xyz[0, kept], xyz[1, kept], xyz[2, kept] = x, y, z
        kept += 1
    return kept, invalid, own


@_kernel
def draw_lines(state, ends, i0, j0):
    """Mark cells as free on the straight line from (i0, j0) to each end, up to the first occupied one.

    Lines are Bresenham's: one cell per step along the longer axis, the other rounded to the nearest (half
    up, away from the start), in 32.32 fixed point, exact for lines of up to 2**16 cells.

    Parameters
    ----------
    state : (nx, ny) uint8, changed in place
        An end that is BEYOND (where a ray leaves the grid) becomes FREE if its line gets there.
    ends : (M, 2) int32
        Cells ix, iy.
    i0, j0 : int
        The sensor's cell.
    """
    flat = state.reshape(-1)
    stride = state.shape[1]
    for n in range(ends.shape[0]):
        di, dj = ends[n, 0] - i0, ends[n, 1] - j0
        steps_i, steps_j = abs(di), abs(dj)
        up_i = stride if di > 0 else -stride
        up_j = 1 if dj > 0 else -1
        if steps_i >= steps_j:
            long, short, up_long, up_short = steps_i, steps_j, up_i, up_j
        else:
            long, short, up_long, up_short = steps_j, steps_i, up_j, up_i
        slope = ((np.int64(short) << 32) // long + 1) if long > 0 else np.int64(0)
        cell = np.int64(i0) * stride + j0
        fraction = np.int64(1) << 31
        for _ in range(long):
            if flat[cell] == OCCUPIED:
                break
            flat[cell] = FREE
            cell += up_long
            fraction += slope
            if fraction >> 32:
                fraction -= np.int64(1) << 32
                cell += up_short
        else:
            if flat[cell] == BEYOND:
                flat[cell] = FREE


@_kernel
def height_band_states(x, y, z, origin, z_low, z_high, min_range, x0, y0, resolution, state, ends):
    """Mark the cells of returns in a height band as occupied, the cells between these and the sensor as free.

    Van Kempen et al. 2021, Sec. V: "cells with returns between 0.5 and 2.0 m above ground". One line is drawn
    per distinct cell, which gives the same states as one per return. Returns beyond the grid end where their
    ray leaves it, and mark nothing.

    Parameters
    ----------
    x, y, z : (N,) float32
        Points in the frame of the grid [m].
    origin : (3,) float32
        The sensor, inside the grid [m].
    z_low, z_high : float
        Open interval of heights that are obstacles, in the frame of the grid [m].
    min_range : float
        Returns at most this far from the sensor are ignored [m].
    x0, y0, resolution : float
        Corner and cell side of the grid [m].
    state : (nx, ny) uint8
        Zeros on entry; UNKNOWN, FREE or OCCUPIED on return (or BEYOND: a ray's exit that it did not reach).
    ends : (nx * ny, 2) int32
        Work space.
    """
    nx, ny = state.shape
    i0, j0 = int(math.floor((origin[0] - x0) / resolution)), int(math.floor((origin[1] - y0) / resolution))
    low, high, near = np.float32(z_low), np.float32(z_high), np.float32(min_range) * np.float32(min_range)
    count = 0
    for n in range(x.shape[0]):
        if not (z[n] > low and z[n] < high):
            continue
        dx, dy, dz = x[n] - origin[0], y[n] - origin[1], z[n] - origin[2]
        if not dx * dx + dy * dy + dz * dz > near:
            continue
        u, v = (x[n] - x0) / resolution, (y[n] - y0) / resolution
        mark = OCCUPIED
        if not (u >= 0 and u < nx and v >= 0 and v < ny):
            a, b = (origin[0] - x0) / resolution, (origin[1] - y0) / resolution
            share = 1.0
            if u < 0:
                share = min(share, a / (a - u))
            elif u >= nx:
                share = min(share, (nx - a) / (u - a))
            if v < 0:
                share = min(share, b / (b - v))
            elif v >= ny:
                share = min(share, (ny - b) / (v - b))
            u, v = a + share * (u - a), b + share * (v - b)
            mark = BEYOND
        i, j = min(max(int(u), 0), nx - 1), min(max(int(v), 0), ny - 1)
        before = state[i, j]
        if before == UNKNOWN:
            ends[count, 0], ends[count, 1] = i, j
            count += 1
        if mark == OCCUPIED or before == UNKNOWN:
            state[i, j] = mark
    draw_lines(state, ends[:count], i0, j0)


@_kernel
def state_mass(state, evidence, factor, mass):
    """Turn states into masses, e / (2 + sum of e), averaging evidence over `factor` x `factor` cells.

    Parameters
    ----------
    state : (nx * factor, ny * factor) uint8
    evidence : float
        Dirichlet evidence of a free or occupied cell, > 0.
    factor : int
        Cells of `state` per cell of `mass` along each axis.
    mass : (nx, ny, 2) float32
        Filled: free and occupied.
    """
    nx, ny = mass.shape[0], mass.shape[1]
    if factor == 1:
        table = np.zeros((4, 2), np.float32)
        table[FREE, 0] = table[OCCUPIED, 1] = evidence / (2 + evidence)
        for i in range(nx):
            for j in range(ny):
                s = state[i, j]
                mass[i, j, 0], mass[i, j, 1] = table[s, 0], table[s, 1]
        return
    for i in range(nx):
        for j in range(ny):
            free, occupied = 0, 0
            for k in range(i * factor, (i + 1) * factor):
                for l in range(j * factor, (j + 1) * factor):  # noqa: E741
                    free += state[k, l] == FREE
                    occupied += state[k, l] == OCCUPIED
            strength = 2 * factor * factor / evidence + free + occupied
            mass[i, j, 0], mass[i, j, 1] = free / strength, occupied / strength


@_kernel
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


@_inline
def _azimuth(x, y):
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
    return _TAU - a if y < 0 else a


@_kernel
def level_say(height, x0, y0, resolution, origin, clearance, radial_step, say):
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


@_vector
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
        From `level_say`.
    obstacle_height, clearance, below_ground, range_noise, radial_step : float
        [m]; see `RayISM`.
    sectors : int
    x0, y0, resolution : float
        Corner and cell side of the grid [m].
    hits : (nx, ny) int32
        Added to: half hits, two for every obstacle return.
    sector : (N,) int32; slope, run : (N,) float32
        Work space.
    rays : (N, 2) float32
        Filled, sector by sector: a ray's rise over run, and the first bin that it does not clear.

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
    near, one, scale = np.float32(radial_step), np.float32(1.0), np.float32(radial_step / clearance)
    sx, sy, sz = origin
    highest = _highest(level, sectors)
    _polar(
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
        rays[to, 0], rays[to, 1] = slope[n], _below_clearance(slope[n] * scale, min(reach, most), highest[s])
    return starts[: sectors + 1]


@_inline
def _below_clearance(tilt, end, highest):
    """Cut a ray where it rises above clearance."""
    return max(highest, np.float32(0.0)) / tilt if tilt * end > highest and tilt > 0 else end


@_kernel
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


@_vector
def _polar(x, y, z, sx, sy, sz, to_sector, last_sector, sector, slope, run):
    """Sector, rise over run and run of each point as seen from the sensor, without branches."""
    for n in range(x.shape[0]):
        dx, dy, dz = x[n] - sx, y[n] - sy, z[n] - sz
        r = np.sqrt(dx * dx + dy * dy)
        sector[n] = min(np.int32(_azimuth(dx, dy) * to_sector), last_sector)
        slope[n] = dz / max(r, np.float32(1e-30))
        run[n] = r


@_kernel
def aim_missing(directions, level, clearance, radial_step, max_range, sectors, sector, slope, end):
    """Turn beams that came back empty into rays that end where they meet the ground, or at `max_range`.

    Parameters
    ----------
    directions : (M, 3) float32
        Unit vectors, in the frame of the grid; those that are not finite clear nothing.
    level : (rows, bins) float32
        From `level_say`.
    clearance, radial_step, max_range : float
        [m]; see `RayISM`.
    sectors : int
    sector : (M,) int32; slope, end : (M,) float32
        Filled: a ray's sector, its rise over run, and the first bin that it does not clear.
    """
    rows, bins = level.shape
    per_row = sectors // rows
    to_sector, scale = np.float32(sectors / (2 * math.pi)), np.float32(radial_step / clearance)
    highest = _highest(level, sectors)
    for n in range(directions.shape[0]):
        dx, dy, dz = directions[n, 0], directions[n, 1], directions[n, 2]
        across = math.sqrt(dx * dx + dy * dy)
        sector[n], slope[n], end[n] = 0, 0, 0
        if not (across > 1e-3 and across < 2 and abs(dz) < 2):
            continue
        s = min(int(_azimuth(dx, dy) * to_sector), sectors - 1)
        tilt, row = dz / across * scale, level[s // per_row]
        reach = min(int(max_range * across / radial_step), bins)
        for k in range(reach):
            if row[k] - tilt * (np.float32(k) + np.float32(0.5)) > 1:
                reach = k
                break
        sector[n], slope[n] = s, dz / across
        end[n] = _below_clearance(tilt, np.float32(reach), highest[s])


@_kernel
def sort_rays(sector, slope, end, sectors, rays):
    """Bring the rays of each sector together (a counting sort).

    Parameters
    ----------
    sector : (N,) int32; slope, end : (N,) float32
        From `aim_missing`.
    sectors : int
    rays : (N, 2) float32
        Filled: slope and end.

    Returns
    -------
    starts : (sectors + 1,) int32
        Where each sector begins in `rays`.
    """
    starts = _starts(sector, sectors)
    for n in range(sector.shape[0]):
        s = (sector[n] & 0x7FFF) + 1
        to = starts[s] & 0x7FFFFFFF
        starts[s] += 1
        rays[to, 0], rays[to, 1] = slope[n], end[n]
    return starts[: sectors + 1]


@_kernel
def _starts(sector, sectors):
    """Begin a counting sort: entry s + 1 is where the next ray of sector s goes, and in the end where s ends."""
    starts = np.zeros(sectors + 2, np.int32)
    for n in range(sector.shape[0]):
        starts[(sector[n] & 0x7FFF) + 2] += 1
    for s in range(sectors + 1):
        starts[s + 1] += starts[s]
    return starts


@_kernel
def clear_sectors(
    rays,
    starts,
    missing,
    missing_starts,
    missing_weight,
    level,
    clearance,
    radial_step,
    cell_sectors,
    p_pass,
    free,
):
    """Belief in free for every polar bin, from the rays that passed it.

    Let a cell be occupied by something of unknown height, equally likely anywhere up to `clearance`. Then
    ``w(h) = 1 - h / clearance`` is the chance that it reaches a ray at height h above ground, and a ray that
    it reaches passes unnoticed with probability p. All rays together can say no more than the lowest one
    reaches, w_1, and a higher one counts w_i / w_1 of it:

        T = sum_i w_i / w_1,        free = w_1 * (1 - p**T),

    which is the count-based ``1 - p**n`` for n rays at the ground, discounted (Shafer) by w_1: many rays over
    a roof say nothing about what is below it. The sums need no loop over rays and bins: all rays of a sector
    start at the sensor, so that those that pass a bin are those that end further out.

    Parameters
    ----------
    rays : (N, 2) float32, starts : (sectors + 1,) int32
        From `mark_and_aim`.
    missing, missing_starts, missing_weight
        The same from `sort_rays`, for beams that came back empty, and what one counts against a ray that came back.
    level : (rows, bins) float32
        From `level_say`.
    clearance, radial_step : float
        [m]; see `RayISM`.
    cell_sectors : float
        How many sectors a cell subtends in the middle of the first bin; T is counted for cells, not sectors.
    p_pass : float
        p, in (0, 1).
    free : (sectors, bins) float32
        Filled.
    """
    sectors, bins = free.shape
    per_row = sectors // level.shape[0]
    scale, zero, one = np.float32(radial_step / clearance), np.float32(0.0), np.float32(1.0)
    weight = np.float32(missing_weight)
    # Rays that end in a bin, later rays that pass the bin before: how many, the sum of slopes, the least slope.
    count, rise, lowest = (
        np.zeros(bins + 1, np.float32),
        np.zeros(bins + 1, np.float32),
        np.empty(bins + 1, np.float32),
    )
    reach, share = np.empty(bins, np.float32), np.empty(bins, np.float32)
    for k in range(bins):
        reach[k] = (k + 0.5) * scale
        share[k] = -math.log(p_pass) * cell_sectors / (2 * k + 1) / 64
    for s in range(sectors):
        count[:], rise[:], lowest[:] = zero, zero, np.inf
        furthest = 0
        for n in range(starts[s], starts[s + 1]):
            slope, k = rays[n, 0], int(rays[n, 1]) & 0x7FFF
            count[k] += one
            rise[k] += slope
            lowest[k] = min(lowest[k], slope)
            furthest = max(furthest, k)
        for n in range(missing_starts[s], missing_starts[s + 1]):
            slope, k = missing[n, 0], int(missing[n, 1]) & 0x7FFF
            count[k] += weight
            rise[k] += weight * slope
            lowest[k] = min(lowest[k], slope)
            furthest = max(furthest, k)
        through, climb, least = zero, zero, np.float32(np.inf)
        for k in range(furthest, 0, -1):
            through += count[k]
            climb += rise[k]
            least = min(least, lowest[k])
            count[k], rise[k], lowest[k] = through, climb, least
        free[s, furthest:] = zero
        _belief(
            count[1 : furthest + 1],
            rise[1 : furthest + 1],
            lowest[1 : furthest + 1],
            level[s // per_row, :furthest],
            reach[:furthest],
            share[:furthest],
            free[s, :furthest],
        )


@_vector
def _belief(count, rise, lowest, level, reach, share, free):
    """``w_1 * (1 - p**T)`` for the bins of one sector, with ``exp(x)`` as a power: error below 1e-6."""
    for k in range(free.shape[0]):
        first = max(min(level[k] - lowest[k] * reach[k], np.float32(1.0)), np.float32(0.0))
        total = (count[k] * level[k] - rise[k] * reach[k]) / max(first, np.float32(1e-6))
        z = min(min(max(total, np.float32(0.0)), count[k]) * share[k], np.float32(0.5))
        q = np.float32(1.0) + z * (
            np.float32(1.0) + z * (np.float32(0.5) + z * (np.float32(1.0 / 6) + z * np.float32(1.0 / 24)))
        )
        q *= q
        q *= q
        q *= q
        q *= q
        q *= q
        q *= q  # ** 64
        free[k] = first * (np.float32(1.0) - np.float32(1.0) / q)


@_kernel
def ray_mass(free, hits, sector, span, ring, missed, reliability, most, mass):
    """Turn polar belief in free and counts of returns into masses.

    R returns give occupied the mass ``1 - p_false**R``: that of R simple masses ``1 - p_false``, combined.
    Free is the mean over the polar bins that a cell covers. Where both speak, the two are combined by the
    conjunctive rule, the conflict going to unknown (Yager), after free is discounted by `reliability`.

    Parameters
    ----------
    free : (sectors, bins) float32
        From `clear_sectors`.
    hits : (nx, ny) int32
        From `mark_and_aim`.
    sector, span, ring
        From `polar_lookup`.
    missed : (entries,) float32
        ``p_false ** (n / 2)`` for n half hits; the last entry holds beyond.
    reliability, most : float
        See `RayISM`.
    mass : (nx, ny, 2) float32
        Filled: free and occupied.
    """
    nx, ny = ring.shape
    sectors = free.shape[0]
    one, limit, trust, entries = np.float32(1.0), np.float32(most), np.float32(reliability), missed.shape[0]
    for i in range(nx):
        for j in range(ny):
            k = ring[i, j]
            if k < 0:
                mass[i, j, 0] = mass[i, j, 1] = 0
                continue
            k, s, count = k & 0x7FFF, sector[i, j] & 0x7FFF, span[i, j]
            cleared = free[s, k]
            if count > 1:
                for _ in range(count - 1):
                    s = s + 1 if s + 1 < sectors else 0
                    cleared += free[s & 0x7FFF, k]
                cleared /= np.float32(count)
            if hits[i, j] > 0:
                doubt = missed[min(hits[i, j], entries - 1)]
                mass[i, j, 0] = min(trust * cleared * doubt, limit)
                mass[i, j, 1] = min((one - doubt) * (one - trust * cleared), limit)
            else:
                mass[i, j, 0] = min(cleared, limit)
                mass[i, j, 1] = 0
