"""Breaks of the ground: steps, falls and holes, found along profiles of its height."""

import math

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import Breaks, PolarGrid, RayLimits, RayNumbers, Rays
from ogm.geometric.kernels.polar import ROW_BITS
from ogm.jit import kernel

__all__ = ["FALL", "HOLE", "LEVEL", "PROFILE_BITS", "STEP", "agree", "empty_breaks", "find_breaks", "ground_breaks"]

LEVEL, FALL, STEP, HOLE = 0, 1, 2, 3

PROFILE_BITS = 1  # a profile is that of 2**1 neighbouring sectors
BEYOND = 1.5  # how far profiles reach, in parts of the polar grid
DEPTH = 0.25  # [m] of the bins of a profile
FEW = np.float32(2.0)  # returns that a bin needs at least
GAP = 0.8  # [m] in run, between a bin and the nearer ground that it is compared with
REACH = 8.0  # [m] in run, beyond which a rise is no step, and a fall no kerb
BASELINE = 5.0  # [m] of run, over which the incline of that ground is taken
STEEPEST = 0.25  # rise over run of ground
MANY = 5  # bins that show how rough the ground is
ROUGH = 4.0  # standard deviations of the ground about the line
BEND = 0.005  # rise over run by which ground may bend
ONSET = 0.03  # [m] of a bin above the continued ground, where a step may begin
RISE = 0.05  # [m] of a step
RISE_ANGLE = 0.001  # [rad] and as much more per metre of run: error of a beam's elevation
OBSTACLE_STEP = 0.2  # [m] of a step that marks
FACE = 0.05  # [m] from which on the returns of its face mark
SINK = 0.15  # [m] of a bin below the continued ground, where a hole may begin
DESCENT, DESCENT_GAP = 0.05, 6.0  # rise over run by which ground may fall from so far on [m]
SUDDEN = 0.5  # share of a step or fall between two neighbouring bins
LONGEST, HIGHEST = 6.0, 0.5  # [m] run and height of a rise, beyond which it is a slope
BUMP = 2.0  # [m] in run, within which a rise that ends at once is noise
EDGE = 0.3  # [m] in run, of the ground before a break
DOUBTFUL = np.float32(0.5)  # reliability of belief between a step or fall and the ground before it
NO_BREAK = -1  # a slope, or noise


def ground_breaks(rays: Rays, limits: RayLimits, polar: PolarGrid, numbers: RayNumbers) -> Breaks:
    """Find where the ground rises or falls suddenly.

    A *profile* is the mean height of the ground returns of a few neighbouring sectors, in bins of `DEPTH`. Each bin
    is compared with the *continued ground*: the line through the nearer bins. What rises above it suddenly and is
    then level is a step, also where the ground map follows it. What lies under it is a fall or, if it is deep, a
    hole, if the beams to it pass over all nearer ground; else it is multipath. A rise or fall that goes on is a
    slope. A break counts if a neighbouring profile has one there, too.

    Parameters
    ----------
    rays : Rays
    limits : RayLimits
    polar : PolarGrid
    numbers : RayNumbers

    Returns
    -------
    Breaks
    """
    breaks = empty_breaks(polar)
    find_breaks(rays, limits, polar, numbers, (0, polar.sectors), breaks)
    agree(breaks)
    return breaks


def empty_breaks(polar: PolarGrid) -> Breaks:
    """Return memory for the breaks of all profiles, without any."""
    rows, wide = polar.sectors >> PROFILE_BITS, max(int(DEPTH / polar.step + 0.5), 1)
    shape = rows, int(BEYOND * polar.bins) // wide + 1
    return Breaks(
        np.zeros(shape, np.int8), np.empty(shape, np.float32), np.empty(shape, np.int32), np.empty(shape, np.int32),
        np.ones((rows, polar.bins), np.float32), np.zeros(rows, np.bool_), wide,
    )  # fmt: skip


@kernel
def find_breaks(
    rays: Rays, limits: RayLimits, polar: PolarGrid, numbers: RayNumbers, sectors: tuple[int, int], breaks: Breaks
) -> None:
    """Find the breaks of the profiles of sectors from the first of `sectors` up to the second, each on its own."""
    count, wide = breaks.kind.shape[1], breaks.width
    sums, profile, support = np.empty((count + 1, 3), np.float32), np.empty((count, 3)), np.empty((count, 6))
    for row in range(sectors[0] >> PROFILE_BITS, sectors[1] >> PROFILE_BITS):
        first, last = rays.starts[row << PROFILE_BITS], rays.starts[(row + 1) << PROFILE_BITS]
        _add_up(rays, first, last, np.float32(1.0 / (wide * polar.step)), np.float32(numbers.obstacle_height), sums)
        found = 0
        for k in range(count):
            if sums[k, 0] >= FEW:
                profile[found, 0], profile[found, 1] = sums[k, 1] / sums[k, 0], sums[k, 2] / sums[k, 0]
                profile[found, 2] = k
                found += 1
        ground = limits.ground[row >> (ROW_BITS - PROFILE_BITS), 0] * 0.5 * polar.step  # under the sensor
        _compare(profile[:found], support, row, polar.step, numbers.below_ground, ground, breaks)


@kernel
def _add_up(
    rays: Rays, first: int, last: int, per_metre: np.float32, obstacle_height: np.float32, sums: NDArray[np.float32]
) -> None:
    """Fill in the number of returns that are no obstacles, the sum of their runs and of their heights, by bins.

    The last row of `sums` is of all other rays.
    """
    sums[:] = 0
    other = sums.shape[0] - 1
    for n in range(first & 0x7FFFFFFF, last & 0x7FFFFFFF):
        slope, run = rays.slope[n], rays.run[n]
        k = min(int(min(run * per_metre, np.float32(1e6))), other)
        k = (k if (rays.above[n] <= obstacle_height) & (rays.point[n] >= 0) else other) & 0x7FFFFFFF
        sums[k, 0] += np.float32(1.0)
        sums[k, 1] += run
        sums[k, 2] += slope * run


@kernel
def _compare(
    profile: NDArray[np.float64],
    support: NDArray[np.float64],
    row: int,
    step: float,
    below_ground: float,
    lowest: float,
    breaks: Breaks,
) -> None:
    """Compare the bins of a profile (run, height, number), the nearest first, with the continued ground.

    `lowest` is the height of the ground under the sensor.
    """
    zero = int(np.int64(0))  # constants would be compiled once more
    count, start, at, base, resume, begin, end = zero, zero, zero, zero, zero, -1, NO_BREAK
    horizon, incline, edge_of_hole = -np.inf, 0.0, (0.0, 0.0, 0.0)
    for k in range(profile.shape[0]):
        run, height, number = profile[k, 0], profile[k, 1], int(profile[k, 2])
        slope = height / run
        if count > 0 and k >= resume:
            at = max(_last_before(support, count, at, run - GAP), start)
            base = max(_last_before(support, at + 1, min(base, at), support[at, 0] - BASELINE), start)
            line = _continue(support, base, at, incline)
            incline, gap = line[2], run - line[0]
            rise, rough, edge = _above(line, run, height), 0.0, 0
            if rise > ONSET or rise < -SINK:
                rough = _roughness(support, base, at, incline)
                edge = max(int(support[_last_before(support, count, count - 1, run - EDGE), 0] / step) - 1, 0)
            slack = BEND * gap + ROUGH * rough

            if gap < REACH and rise > ONSET + slack:
                end = _end_of_change(profile, k, line, 1.0)
                high = _above(line, profile[end, 0], profile[end, 1])
                is_high = end != NO_BREAK and high > RISE + RISE_ANGLE * run + ROUGH * rough
                if is_high and _jump(profile, k, end, incline, 1.0) > SUDDEN * high:
                    face = height - rise + FACE + ROUGH * rough if high > OBSTACLE_STEP else np.inf
                    _note(breaks, row, number, zero + STEP, face, edge, int(profile[end, 2]))
                    start, resume, begin = count, end + 1, -1  # the line begins anew
                    count = _add_support(support, count, profile[end, 0], profile[end, 1])

            elif rise < -SINK - slack:
                if slope < horizon:
                    continue  # multipath
                if begin < 0:
                    edge_of_hole, end = line, _end_of_change(profile, k, line, -1.0)
                if begin >= 0 or end != NO_BREAK:
                    descent = DESCENT * max(run - edge_of_hole[0] - DESCENT_GAP, 0.0)
                    floor = min(height - _above(edge_of_hole, run, height), lowest) - below_ground - descent - slack
                    if height < floor:
                        begin = edge if begin < 0 else begin
                        _note(breaks, row, number, zero + HOLE, floor, begin, number)
                        continue
                    if gap < REACH and _jump(profile, k, k, incline, -1.0) > -SUDDEN * rise:
                        _note(breaks, row, number, zero + FALL, -np.inf, edge, number)
                        start = count
        horizon = max(horizon, slope)
        if k >= resume:
            begin, lowest = -1, min(lowest, height)
            count = _add_support(support, count, run, height)


@kernel
def _above(line: tuple[float, float, float], run: float, height: float) -> float:
    """Return how far a height lies above a line (run, height, incline) [m]."""
    return height - line[1] - line[2] * (run - line[0])


@kernel
def _note(breaks: Breaks, row: int, number: int, kind: int, limit: float, begin: int, end: int) -> None:
    """Write down a break."""
    breaks.kind[row, number], breaks.limit[row, number] = kind, limit
    breaks.begin[row, number], breaks.end[row, number] = begin, end
    breaks.broken[row] = True


@kernel
def _add_support(support: NDArray[np.float64], count: int, run: float, height: float) -> int:
    """Add a bin, and the sums for a line through the last ones; return the new number of supports."""
    support[count, 0], support[count, 1], support[count, 2] = run, run, height
    support[count, 3], support[count, 4], support[count, 5] = run * run, run * height, height * height
    if count > 0:
        for k in range(1, 6):
            support[count, k] += support[count - 1, k]
    return count + 1


@kernel
def _last_before(support: NDArray[np.float64], count: int, at: int, run: float) -> int:
    """Return the last of the first `count` supports that is no further than `run`, searched from `at`."""
    while at > 0 and support[at, 0] > run:
        at -= 1
    while at + 1 < count and support[at + 1, 0] <= run:
        at += 1
    return at


@kernel
def _moments(support: NDArray[np.float64], base: int, at: int) -> tuple[float, float, float, float]:
    """Return mean run and height of the supports from `base` to `at`, and sums of their squares and products."""
    count = float(at - base + 1)
    r, z, rr, rz = support[at, 1], support[at, 2], support[at, 3], support[at, 4]
    if base > 0:
        r, z = r - support[base - 1, 1], z - support[base - 1, 2]
        rr, rz = rr - support[base - 1, 3], rz - support[base - 1, 4]
    r, z = r / count, z / count
    return r, z, rr - count * r * r, rz - count * r * z


@kernel
def _continue(support: NDArray[np.float64], base: int, at: int, before: float) -> tuple[float, float, float]:
    """Fit a line (run, height, incline) to the supports from `base` to `at`.

    The incline is `before` where they are too close together for one.
    """
    r, z, rr, rz = _moments(support, base, at)
    incline = min(max(rz / rr, -STEEPEST), STEEPEST) if rr > 0.5 else before
    run = support[at, 0]
    return run, z + incline * (run - r), incline


@kernel
def _roughness(support: NDArray[np.float64], base: int, at: int, incline: float) -> float:
    """Return the standard deviation of the supports from `base` to `at` about a line of some incline [m]."""
    count = float(at - base + 1)
    _, z, _, rz = _moments(support, base, at)
    zz = support[at, 5] - (support[base - 1, 5] if base > 0 else 0.0)
    rest = max(zz - count * z * z - incline * rz, 0.0) / max(count - 2.0, 1.0)
    return math.sqrt(rest) if count >= MANY else 0.0


@kernel
def _jump(profile: NDArray[np.float64], first: int, last: int, incline: float, sign: float) -> float:
    """Return the largest rise (`sign` 1) or fall (-1) from a bin to the next, up to some bins, less the incline."""
    most = 0.0
    for k in range(max(first, 1), last + 1):
        rise = profile[k, 1] - profile[k - 1, 1] - incline * (profile[k, 0] - profile[k - 1, 0])
        most = max(most, sign * rise)
    return most


@kernel
def _end_of_change(profile: NDArray[np.float64], k: int, line: tuple[float, float, float], sign: float) -> int:
    """Return the last bin of a rise (`sign` 1) or fall (-1) that begins in bin `k`, or `NO_BREAK`.

    It goes on as long as it grows at least half as fast as from the ground before it.
    """
    last, before = k, _above(line, profile[k, 0], profile[k, 1])
    for j in range(k + 1, profile.shape[0]):
        run, grown = profile[j, 0], profile[j, 0] - profile[last, 0]
        if grown <= GAP:
            continue
        rest = _above(line, run, profile[j, 1])
        if sign * rest <= sign * before * (1.0 + 0.5 * grown / (profile[last, 0] - line[0])):
            return NO_BREAK if sign > 0 and rest < 0.5 * before and grown < BUMP else last
        last, before = j, rest
        if run - line[0] > LONGEST or rest > HIGHEST:
            return NO_BREAK
    return last


@kernel
def agree(breaks: Breaks) -> None:
    """Keep the breaks that a neighbouring profile has, too, and reduce belief there."""
    rows, count = breaks.kind.shape
    wide, bins, alone = breaks.width, breaks.reliability.shape[1], []
    for row in range(rows):
        for k in range(count if breaks.broken[row] else 0):
            if breaks.kind[row, k] == LEVEL:
                continue
            begin, end = breaks.begin[row, k], (breaks.end[row, k] + 1) * wide
            if not (_has_break(breaks, row - 1, k, row) or _has_break(breaks, (row + 1) % rows, k, row)):
                alone.append((row, k))
                continue
            share = np.float32(0.0) if breaks.kind[row, k] == HOLE else DOUBTFUL
            for n in range(begin, min(end + 1, bins)):
                breaks.reliability[row, n] = min(breaks.reliability[row, n], share)
    for row, k in alone:
        breaks.kind[row, k] = LEVEL


@kernel
def _has_break(breaks: Breaks, side: int, k: int, row: int) -> bool:
    """Tell whether a profile has a break upwards, or downwards, as bin `k` of `row` has, and where it has."""
    wide, is_step = breaks.width, breaks.kind[row, k] == STEP
    begin, end = breaks.begin[row, k], (breaks.end[row, k] + 1) * wide
    for j in range(breaks.kind.shape[1] if breaks.broken[side] else 0):
        kind = breaks.kind[side, j]
        overlaps = breaks.begin[side, j] < end and (breaks.end[side, j] + 1) * wide > begin
        if overlaps and kind != LEVEL and (kind == STEP) == is_step:
            return True
    return False
