"""What the rays of a sector hit: ground, an obstacle, a step in the ground, a hole in it."""

# mypy: allow-untyped-defs
import math

import numpy as np

from ogm.jit import inline, kernel

__all__ = ["DEEP", "NONE", "NO_RETURN", "OBSTACLE", "STEP", "SUNK", "classify_rays"]

NONE = 0  # no effect: multipath, or straight up or down
GROUND = 1
OVERHEAD = 2  # above the clearance
OBSTACLE = 3
RAISED = 4  # ground that rises suddenly, by less than an obstacle
DEEP = 5  # in a hole, or beyond a drop
NO_RETURN = 6
STEP = 7  # ground that rises suddenly, by as much as an obstacle
SUNK = 8  # ground that falls suddenly, by less than a hole

SUPPORT_GAP = np.float32(0.8)  # [m] between a return and the nearer ground that it is compared with
BASELINE = np.float32(5.0)  # [m] run over which the slope of that ground is taken
SUPPORT_REACH = np.float32(4.0)  # [m] beyond which a rise is no step
STEEPEST = 0.25  # rise over run of ground
RISE = np.float32(0.075)  # [m] of a return above the continued ground, that may be a step
BEND = np.float32(0.005)  # rise over run by which ground may bend upwards
LONGEST = np.float32(6.0)  # [m] run of a rise that may be a step
HIGHEST = np.float32(0.5)  # [m] of a rise that the ground map may follow
STEP_HEIGHT = np.float32(0.1)  # [m] of a rise that is an obstacle
SINK = np.float32(0.1)  # [m] of a return below the continued ground, that may be in a hole
FALL = np.float32(0.05)  # rise over run by which ground may fall from `FALL_GAP` on
FALL_GAP = np.float32(6.0)  # [m]
ROUGH = np.float32(4.0)  # standard deviations of the ground about the line
EDGE = np.float32(0.3)  # [m] in run, of the returns from a step's face
BUMP = np.float32(2.0)  # [m] in run, within which a rise that ends at once is noise
MANY = 4  # returns that show how rough the ground is
SAME = np.float32(0.5)  # [m] in run, of returns from one surface


@kernel
def classify_rays(rays, first, last, limits, row, polar, numbers, found):
    """Fill in what the rays of a sector hit, and the bins in which they are below clearance.

    A ray clears from the sensor to its end: up to and with the bin of a ground return, to two standard deviations
    before an obstacle, and no further than it stays below `clearance`. A return is compared with the ground map,
    and with the *continued ground*: the line through the ground returns of the sector that lie nearer, by at least
    `SUPPORT_GAP`. What rises above it is a step, also where the map follows the step. What lies under it is in a
    hole, if no other ray of the sector met ground on its way there; else it is multipath.

    Parameters
    ----------
    rays : Rays
    first, last : int
        Of the sector, in `rays`.
    limits : RayLimits, row : int
    polar : PolarGrid
    numbers : RayNumbers
    found : SectorRays
        Filled for ``last - first`` rays.

    Returns
    -------
    int
        First bin that no ray reaches.
    """
    step, bins = np.float32(polar.step), np.float32(polar.bins)
    per_metre, margin = np.float32(1.0 / polar.step), np.float32(2.0 * numbers.range_noise)
    low, high = np.float32(numbers.obstacle_height), np.float32(numbers.clearance)
    below, zero, half, one = np.float32(numbers.below_ground), np.float32(0.0), np.float32(0.5), np.float32(1.0)
    table, support, count, at, base, end = rays.table[first:last], found.support, 0, 0, 0, 0
    count = _add_support(support, 0, zero, limits.ground[row, 0] * half * step)  # the ground under the sensor
    # The rise (1) or fall (-1) that is followed: its last returns, and the ground before it
    sign, since, begin, first_run, last_run, last_height = 0, 0, 0, zero, zero, zero
    from_run, from_height, from_incline = zero, zero, zero
    _nearest_ground(rays, first, last, low, found.nearest)
    for n in range(last - first):
        slope, run, above = table[n, 0], table[n, 1], table[n, 2]
        found.kind[n], found.start[n], found.stop[n], found.begin[n] = NONE, 0, 0, -1
        if run < step:
            continue
        reach = min(run * per_metre, bins)
        if rays.point[first + n] < 0:
            found.kind[n] = NO_RETURN
            found.start[n], stop = _below_clearance(limits, row, slope, int(reach), step)
            found.stop[n] = _above_ground(limits, row, slope, found.start[n], stop)
            end = max(end, found.stop[n])
            continue
        if above > low:
            found.kind[n] = OVERHEAD
            if above < high:
                found.kind[n] = OBSTACLE
                reach = min(max((run - margin) * per_metre, zero), bins)
                found.block[n] = int(reach)
            found.start[n], found.stop[n] = _below_clearance(limits, row, slope, int(reach), step)
            end = max(end, found.stop[n])
            continue

        # The ground continued from nearer returns of the sector
        height = slope * run
        at = _last_before(support, count, at, run - SUPPORT_GAP)
        base = _last_before(support, at + 1, min(base, at), np.float32(support[at, 0]) - BASELINE)
        gap = run - np.float32(support[at, 0])
        level, incline, rough = _continue(support, base, at, run)
        rise = height - level
        slack = BEND * gap + ROUGH * rough
        low_down = rise < -SINK - slack

        # A rise or fall is a slope if it goes on, a step or a hole if not, and nothing if it ends at once
        if sign != 0 and run > last_run + SUPPORT_GAP:
            rest = height - from_height - from_incline * (run - from_run)
            before = last_height - from_height - from_incline * (last_run - from_run)
            if sign * rest > sign * before * (one + half * (run - last_run) / (last_run - from_run)):
                last_run, last_height = run, height
                if run - from_run > LONGEST or rest > HIGHEST:
                    end = max(end, _level(rays, first, since, n, limits, row, polar, found))
                    if sign < 0:
                        count = _add_support(support, count, run, height)
                    sign = 0
            else:
                if sign > 0 and rest < half * before and run - last_run < BUMP:
                    end = max(end, _level(rays, first, since, n, limits, row, polar, found))
                sign = 0

        # Does one begin here?
        if sign == 0 and at > 0:
            if gap < SUPPORT_REACH and rise > RISE + slack:
                sign = 1
            elif low_down and found.nearest[n] > run - SAME:
                sign = -1
            if sign != 0:
                edge = np.float32(support[_last_before(support, count, at, run - EDGE), 0])
                since, begin, first_run, last_run, last_height = n, max(int(edge * per_metre) - 1, 0), run, run, height
                from_run, from_height, from_incline = run - gap, level - incline * gap, incline

        # What was hit, and where the ray ends
        rest = height - from_height - from_incline * (run - from_run)
        if sign < 0 and low_down and rest < -below - FALL * max(run - from_run - FALL_GAP, zero) - slack:
            found.kind[n], found.begin[n] = DEEP, begin
            reach = np.float32(begin)
        elif above < -below:
            continue
        elif sign > 0:
            high_up = rest > STEP_HEIGHT + ROUGH * rough and run < first_run + EDGE
            found.kind[n], found.begin[n] = STEP if high_up else RAISED, begin
        else:
            found.kind[n] = GROUND
            reach = min(reach + one, bins)
            if sign < 0 and low_down:
                found.kind[n], found.begin[n] = SUNK, begin
        if not low_down:
            count = _add_support(support, count, run, height)
        found.start[n], found.stop[n] = _below_clearance(limits, row, slope, int(reach), step)
        end = max(end, found.stop[n])
    return end


@inline
def _add_support(support, count, run, height):
    """Add a return, and the sums for a line through the last ones; return the new number of supports."""
    r, z = float(run), float(height)
    support[count, 0], support[count, 1] = r, r
    support[count, 2], support[count, 3], support[count, 4], support[count, 5] = z, r * r, r * z, z * z
    if count > 0:
        for k in range(1, 6):
            support[count, k] += support[count - 1, k]
    return count + 1


@inline
def _continue(support, base, at, run):
    """Fit a line to the supports after `base` up to `at`: height at `run`, rise over run, standard deviation."""
    if at - base < 2:
        base -= 1
    count = float(at - base)
    r, z, rr, rz, zz = support[at, 1], support[at, 2], support[at, 3], support[at, 4], support[at, 5]
    if base >= 0:
        r, z, rr = r - support[base, 1], z - support[base, 2], rr - support[base, 3]
        rz, zz = rz - support[base, 4], zz - support[base, 5]
    r, z = r / count, z / count
    rr, rz, zz = rr - count * r * r, rz - count * r * z, zz - count * z * z
    incline = min(max(rz / rr, -STEEPEST), STEEPEST) if rr > 0.5 else 0.0
    rest = max(zz - incline * rz, 0.0) / max(count - 2.0, 1.0)
    return (
        np.float32(z + incline * (run - r)),
        np.float32(incline),
        np.float32(math.sqrt(rest) if count >= MANY else 0.0),
    )


@kernel
def _level(rays, first, since, count, limits, row, polar, found):
    """Take a rise for a slope: its returns are ground; return the first bin that none of them reaches."""
    end, per_metre = 0, np.float32(1.0 / polar.step)
    for n in range(since, count):
        if found.begin[n] >= 0:
            slope, run = rays.table[first + n, 0], rays.table[first + n, 1]
            reach = min(int(run * per_metre + np.float32(1.0)), polar.bins)
            found.kind[n], found.begin[n] = GROUND, -1
            found.start[n], found.stop[n] = _below_clearance(limits, row, slope, reach, np.float32(polar.step))
            end = max(end, found.stop[n])
    return end


@inline
def _last_before(support, count, at, run):
    """Return the last of the first `count` supports that is no further than `run`, searched from `at`."""
    while at > 0 and support[at, 0] > run:
        at -= 1
    while at + 1 < count and support[at + 1, 0] <= run:
        at += 1
    return at


@kernel
def _nearest_ground(rays, first, last, low, nearest):
    """Fill in, for each ray, the least run of the ground returns that steeper rays of the sector have."""
    least = np.float32(np.inf)
    for n in range(last - first - 1, -1, -1):
        nearest[n] = least
        if rays.point[first + n] >= 0 and abs(rays.table[first + n, 2]) <= low:
            least = min(least, rays.table[first + n, 1])


@kernel
def _below_clearance(limits, row, slope, stop, step):
    """Return the bins, of the first `stop`, in which a ray is below clearance: the first, and the first after."""
    clearance, start = limits.clearance, 0
    if stop > 0 and clearance[row, 0] > slope and clearance[row, stop - 1] > slope:
        return start, stop
    if slope > 0 and slope * step * stop > limits.highest[row]:
        stop = min(stop, int(max(limits.highest[row], np.float32(0.0)) / (slope * step)) + 1)
    while stop > 0 and not clearance[row, stop - 1] > slope:
        stop -= 1
    if stop > 0 and not clearance[row, 0] > slope:  # it begins above clearance: a tall mount
        if slope < 0:
            start = min(int(clearance[row, 0] * np.float32(0.5) / slope), stop - 1)  # where it is, over flat ground
        while start > 0 and clearance[row, start - 1] > slope:
            start -= 1
        while start < stop and not clearance[row, start] > slope:
            start += 1
    return start, stop


@kernel
def _above_ground(limits, row, slope, start, stop):
    """Return the first bin, from `start` to `stop`, in whose middle a ray is below the ground."""
    for k in range(start, stop):
        if slope < limits.ground[row, k]:
            return k
    return stop
