"""Breaks of the ground: steps, falls and holes along profiles of its height."""

import math

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import Breaks, PolarGrid, RayLimits, RayNumbers, Rays
from ogm.geometric.kernels.polar import ROW_BITS
from ogm.jit import kernel

__all__ = ["FALL", "HOLE", "LEVEL", "PROFILE_BITS", "STEP", "agree", "empty_breaks", "find_breaks", "ground_breaks"]

LEVEL, FALL, STEP, HOLE = 0, 1, 2, 3

PROFILE_BITS = 1  # a profile covers 2**1 neighbouring sectors
PROFILE_RADII = 1.5  # length of a profile, in radii of the polar grid
DEPTH = 0.25  # [m] depth of a bin of a profile
MIN_RETURNS = np.float32(2.0)  # smallest number of returns of a bin
GAP = 0.8  # [m] of run between a bin and the nearer ground that it is compared with
MAX_GAP = 8.0  # [m] of run between these, from which a rise is no step and a fall no kerb
BASELINE = 5.0  # [m] of run for the incline of the nearer ground
MAX_INCLINE = 0.25  # largest rise over run of ground
MIN_ROUGHNESS_BINS = 5  # smallest number of bins for the roughness of the ground
ROUGHNESS_FACTOR = 4.0  # standard deviations of the ground about the line
BEND = 0.005  # largest change of the rise over run of ground
ONSET = 0.03  # [m] height of a bin above the continued ground, from which a step may begin
RISE = 0.05  # [m] smallest height of a step
RISE_ANGLE = 0.001  # [rad] error of a beam's elevation, added to the smallest height per metre of run
OBSTACLE_STEP = 0.2  # [m] smallest height of a step that marks
FACE = 0.05  # [m] height in the face of a step from which returns mark
HOLE_ONSET = 0.15  # [m] depth of a bin below the continued ground, from which a hole may begin
DESCENT, DESCENT_GAP = 0.05, 6.0  # descent of ground (rise over run) from this distance on [m]
MIN_JUMP_SHARE = 0.5  # smallest share of a step or fall between two neighbouring bins
MAX_RISE_RUN, MAX_RISE = 6.0, 0.5  # [m] largest run and height of a step; a larger rise is a slope
BUMP = 2.0  # [m] of run within which a rise that ends at once is noise
EDGE = 0.3  # [m] of run of the ground before a break
DOUBTFUL_RELIABILITY = np.float32(0.5)  # reliability between a step or fall and the ground before it
NO_BREAK = -1  # a slope, or noise


def ground_breaks(rays: Rays, limits: RayLimits, polar: PolarGrid, numbers: RayNumbers) -> Breaks:
    """Find the sudden rises and falls of the ground.

    A *profile* is the mean height of the ground returns of a few neighbouring sectors, in bins of `DEPTH`. Each bin
    is compared with the *continued ground*: the line through the nearer bins. A sudden rise above this line, with
    level ground behind, is a step, even if the ground map follows the rise. A bin below the line is a fall, or a hole
    if deep, provided that the beams to the bin pass over all nearer ground. Otherwise the bin is multipath. A
    continuous rise or fall is a slope. A break counts only if a neighbouring profile has a break there, too.

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
    """Return memory for the breaks of all profiles, without breaks."""
    rows, wide = polar.sectors >> PROFILE_BITS, max(int(DEPTH / polar.step + 0.5), 1)
    shape = rows, int(PROFILE_RADII * polar.bins) // wide + 1
    return Breaks(
        np.zeros(shape, np.int8), np.empty(shape, np.float32), np.empty(shape, np.int32), np.empty(shape, np.int32),
        np.ones((rows, polar.bins), np.float32), np.zeros(rows, np.bool_), wide,
    )  # fmt: skip


@kernel
def find_breaks(
    rays: Rays, limits: RayLimits, polar: PolarGrid, numbers: RayNumbers, sectors: tuple[int, int], breaks: Breaks
) -> None:
    """Find the breaks of each profile of the sectors from ``sectors[0]`` to ``sectors[1] - 1``."""
    count, wide = breaks.kind.shape[1], breaks.width
    sums, profile, support = np.empty((count + 1, 3), np.float32), np.empty((count, 3)), np.empty((count, 6))
    for row in range(sectors[0] >> PROFILE_BITS, sectors[1] >> PROFILE_BITS):
        first, last = rays.starts[row << PROFILE_BITS], rays.starts[(row + 1) << PROFILE_BITS]
        _add_up(rays, first, last, np.float32(1.0 / (wide * polar.step)), np.float32(numbers.obstacle_height), sums)
        found = 0
        for k in range(count):
            if sums[k, 0] >= MIN_RETURNS:
                profile[found, 0], profile[found, 1] = sums[k, 1] / sums[k, 0], sums[k, 2] / sums[k, 0]
                profile[found, 2] = k
                found += 1
        ground = limits.ground[row >> (ROW_BITS - PROFILE_BITS), 0] * 0.5 * polar.step  # under the sensor
        _compare(profile[:found], support, row, polar.step, numbers.below_ground, ground, breaks)


@kernel
def _add_up(
    rays: Rays, first: int, last: int, per_metre: np.float32, obstacle_height: np.float32, sums: NDArray[np.float32]
) -> None:
    """Fill in number, sum of runs and sum of heights of the returns below `obstacle_height` in each bin.

    The last row of `sums` collects all other rays.
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
    """Compare the bins of a profile (run, height, number), sorted by run, with the continued ground.

    `lowest` is the height of the ground under the sensor.
    """
    zero = int(np.int64(0))  # a constant would be compiled separately
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
            if rise > ONSET or rise < -HOLE_ONSET:
                rough = _roughness(support, base, at, incline)
                edge = max(int(support[_last_before(support, count, count - 1, run - EDGE), 0] / step) - 1, 0)
            slack = BEND * gap + ROUGHNESS_FACTOR * rough

            if gap < MAX_GAP and rise > ONSET + slack:
                end = _end_of_change(profile, k, line, 1.0)
                high = _above(line, profile[end, 0], profile[end, 1])
                is_high = end != NO_BREAK and high > RISE + RISE_ANGLE * run + ROUGHNESS_FACTOR * rough
                if is_high and _jump(profile, k, end, incline, 1.0) > MIN_JUMP_SHARE * high:
                    face = height - rise + FACE + ROUGHNESS_FACTOR * rough if high > OBSTACLE_STEP else np.inf
                    _note(breaks, row, number, zero + STEP, face, edge, int(profile[end, 2]))
                    start, resume, begin = count, end + 1, -1  # a new line begins
                    count = _add_support(support, count, profile[end, 0], profile[end, 1])

            elif rise < -HOLE_ONSET - slack:
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
                    if gap < MAX_GAP and _jump(profile, k, k, incline, -1.0) > -MIN_JUMP_SHARE * rise:
                        _note(breaks, row, number, zero + FALL, -np.inf, edge, number)
                        start = count
        horizon = max(horizon, slope)
        if k >= resume:
            begin, lowest = -1, min(lowest, height)
            count = _add_support(support, count, run, height)


@kernel
def _above(line: tuple[float, float, float], run: float, height: float) -> float:
    """Return the height above a line (run, height, incline) [m]."""
    return height - line[1] - line[2] * (run - line[0])


@kernel
def _note(breaks: Breaks, row: int, number: int, kind: int, limit: float, begin: int, end: int) -> None:
    """Record a break."""
    breaks.kind[row, number], breaks.limit[row, number] = kind, limit
    breaks.begin[row, number], breaks.end[row, number] = begin, end
    breaks.broken[row] = True


@kernel
def _add_support(support: NDArray[np.float64], count: int, run: float, height: float) -> int:
    """Append a bin and the cumulative sums for a line; return the new number of supports."""
    support[count, 0], support[count, 1], support[count, 2] = run, run, height
    support[count, 3], support[count, 4], support[count, 5] = run * run, run * height, height * height
    if count > 0:
        for k in range(1, 6):
            support[count, k] += support[count - 1, k]
    return count + 1


@kernel
def _last_before(support: NDArray[np.float64], count: int, at: int, run: float) -> int:
    """Return the last of the first `count` supports within `run`, searched from `at`."""
    while at > 0 and support[at, 0] > run:
        at -= 1
    while at + 1 < count and support[at + 1, 0] <= run:
        at += 1
    return at


@kernel
def _moments(support: NDArray[np.float64], base: int, at: int) -> tuple[float, float, float, float]:
    """Return mean run and height of the supports from `base` to `at`, and the central sums of r r and r z."""
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

    Supports too close together for an incline get `before`.
    """
    r, z, rr, rz = _moments(support, base, at)
    incline = min(max(rz / rr, -MAX_INCLINE), MAX_INCLINE) if rr > 0.5 else before
    run = support[at, 0]
    return run, z + incline * (run - r), incline


@kernel
def _roughness(support: NDArray[np.float64], base: int, at: int, incline: float) -> float:
    """Return the standard deviation [m] of the supports from `base` to `at` about a line with `incline`."""
    count = float(at - base + 1)
    _, z, _, rz = _moments(support, base, at)
    zz = support[at, 5] - (support[base - 1, 5] if base > 0 else 0.0)
    rest = max(zz - count * z * z - incline * rz, 0.0) / max(count - 2.0, 1.0)
    return math.sqrt(rest) if count >= MIN_ROUGHNESS_BINS else 0.0


@kernel
def _jump(profile: NDArray[np.float64], first: int, last: int, incline: float, sign: float) -> float:
    """Return the largest rise (`sign` 1) or fall (-1) into a bin from `first` to `last`, less the incline [m]."""
    largest = 0.0
    for k in range(max(first, 1), last + 1):
        rise = profile[k, 1] - profile[k - 1, 1] - incline * (profile[k, 0] - profile[k - 1, 0])
        largest = max(largest, sign * rise)
    return largest


@kernel
def _end_of_change(profile: NDArray[np.float64], k: int, line: tuple[float, float, float], sign: float) -> int:
    """Return the last bin of a rise (`sign` 1) or fall (-1) that begins in bin `k`, or `NO_BREAK`.

    The change continues while it grows at least half as fast as from the ground before it.
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
        if run - line[0] > MAX_RISE_RUN or rest > MAX_RISE:
            return NO_BREAK
    return last


@kernel
def agree(breaks: Breaks) -> None:
    """Keep the breaks that a neighbouring profile confirms, and reduce the reliability there."""
    rows, count = breaks.kind.shape
    wide, bins, unconfirmed = breaks.width, breaks.reliability.shape[1], []
    for row in range(rows):
        for k in range(count if breaks.broken[row] else 0):
            if breaks.kind[row, k] == LEVEL:
                continue
            begin, end = breaks.begin[row, k], (breaks.end[row, k] + 1) * wide
            if not (_has_break(breaks, row - 1, k, row) or _has_break(breaks, (row + 1) % rows, k, row)):
                unconfirmed.append((row, k))
                continue
            share = np.float32(0.0) if breaks.kind[row, k] == HOLE else DOUBTFUL_RELIABILITY
            for n in range(begin, min(end + 1, bins)):
                breaks.reliability[row, n] = min(breaks.reliability[row, n], share)
    for row, k in unconfirmed:
        breaks.kind[row, k] = LEVEL


@kernel
def _has_break(breaks: Breaks, side: int, k: int, row: int) -> bool:
    """Return whether profile `side` has an overlapping break in the direction of the break in bin `k` of `row`."""
    wide, is_step = breaks.width, breaks.kind[row, k] == STEP
    begin, end = breaks.begin[row, k], (breaks.end[row, k] + 1) * wide
    for j in range(breaks.kind.shape[1] if breaks.broken[side] else 0):
        kind = breaks.kind[side, j]
        overlaps = breaks.begin[side, j] < end and (breaks.end[side, j] + 1) * wide > begin
        if overlaps and kind != LEVEL and (kind == STEP) == is_step:
            return True
    return False
