"""From classified rays to masses."""

import math

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import Cells, Points, PolarGrid, RayLimits, RayNumbers, Rays, SectorRays, WorkSpace
from ogm.geometric.kernels.breaks import PROFILE_BITS, ground_breaks
from ogm.geometric.kernels.classify import DEEP, FACE_OF_STEP, NO_RETURN, NONE, OBSTACLE, classify_rays
from ogm.geometric.kernels.polar import ROW_BITS
from ogm.geometric.kernels.silence import silence_reliability
from ogm.jit import kernel, vector

__all__ = ["clear_sectors", "ray_mass"]

# Where the parts of the work space of a sector begin; constants, so that the compiler sees them apart
PASS, SLOPE, SUM, HIDDEN, BLOCKED, POWER, PARTS = 0, 32848, 65696, 98544, 131392, 164240, 197088
NEGLIGIBLE = np.float32(1e-4)  # chance, below which more rays through a bin are not counted


@kernel
def clear_sectors(
    rays: Rays,
    points: Points,
    origin: NDArray[np.float32],
    limits: RayLimits,
    polar: PolarGrid,
    cells: Cells,
    numbers: RayNumbers,
    work: WorkSpace,
) -> None:
    """Fill in the belief in free of every polar bin, and what marks the cells.

    Let a cell be occupied by something that stands on the ground and has an unknown height H, equally likely
    anywhere up to `clearance`. A ray at a height below H passes it unnoticed with probability p, each for
    itself. Then the chance that all rays pass it is E[p ** N(H)], with N(H) the number of rays below H, and

        free = 1 - E_H[p ** N(H)],       E_H = (sum_i (h_i+1 - h_i) * p ** i) / clearance,

    for the heights h_1 <= h_2 <= ... of the rays, h_0 = 0 and the clearance as the last. It is exact, but for
    terms below `NEGLIGIBLE`.

    Something may also hang at a height that no ray passes, because an obstacle before it stops them. Let such a
    thing be as thick as some height, equally likely anywhere up to `hidden_height`. It fits between two
    neighbouring rays that are d apart, if others between them were stopped, with probability
    ``min(d / hidden_height, 1)``, times the chance that the obstacle reaches so far back, which falls to 0 at
    `hidden_depth`. A gap that ends at the clearance counts twice. Belief is reduced by the largest of these.

    Beams without echo are one source of evidence. Its reliability is `no_return_weight` times what
    `silence_reliability` gives: belief is that without them, plus this share of what they add.

    Parameters
    ----------
    rays : Rays
    points : Points
    origin : (3,) float32
    limits : RayLimits
    polar : PolarGrid
    cells : Cells
    numbers : RayNumbers
        p is `p_miss`.
    work : WorkSpace
        `free` and `hits` are filled: belief in free, and half hits of obstacles and of returns from steps and holes.
    """
    sectors, bins, most = polar.sectors, polar.bins, 0
    for s in range(sectors):
        most = max(most, rays.starts[s + 1] - rays.starts[s])
    whole = np.empty((3, most), np.int32)
    found = SectorRays(np.empty(most, np.int8), whole[0], whole[1], whole[2])
    breaks = ground_breaks(rays, limits, polar, numbers)
    weight = np.full(bins, np.float32(numbers.no_return_weight))
    if rays.point.shape[0] > points.x.shape[0]:
        weight *= silence_reliability(rays, limits, polar)
    part = np.empty(PARTS, np.float32)
    for k in range(bins):  # of a ray that passes a bin: chance to pass a cell there, which sees some of the sector's
        part[POWER + k] = numbers.p_miss ** (sectors / (math.pi * (2 * k + 1)))
    hidden_bins = np.float32(numbers.hidden_height / polar.step), np.float32(numbers.hidden_depth / polar.step)
    no = sectors < 0  # False as a variable: constants would be compiled twice
    work.hits[:] = 0
    _mark_obstacles(points, origin, cells, numbers, work)
    for s in range(sectors):
        first, last, row = rays.starts[s], rays.starts[s + 1], s >> ROW_BITS
        end = classify_rays(rays, s, limits, polar, breaks, numbers, found)
        work.free[s, end:] = 0
        if end == 0:
            continue
        _mark_breaks(rays.point[first:last], points, cells, found, work.hits)
        free = work.free[s, :end]
        if _free_belief(rays.table[first:last], found, limits, row, hidden_bins, no, part, free):
            alone = free.copy()
            _free_belief(rays.table[first:last], found, limits, row, hidden_bins, not no, part, free)
            for k in range(end):
                free[k] = alone[k] + weight[k] * max(free[k] - alone[k], np.float32(0.0))
        for k in range(end):
            free[k] *= breaks.reliability[s >> PROFILE_BITS, k]


@kernel
def _free_belief(
    table: NDArray[np.float32],
    found: SectorRays,
    limits: RayLimits,
    row: int,
    hidden_bins: tuple[np.float32, np.float32],
    silent: bool,
    part: NDArray[np.float32],
    free: NDArray[np.float32],
) -> bool:
    """Fill in the belief of one sector's bins, with the beams without echo or without them.

    `hidden_bins` are `hidden_height` and `hidden_depth` in bins.
    """
    end, first_block, near, blocked, last_block = free.shape[0], free.shape[0], 0, PARTS, PARTS
    one, two = np.float32(1.0), np.float32(2.0)
    left_out, noted, noted_slope = False, (0, 0), np.float32(0.0)  # a ray whose passing is not yet noted, and where
    ground, clearance = limits.ground[row], limits.clearance[row]
    scale, fade = one / hidden_bins[0], one / hidden_bins[1]
    for k in range(end):
        part[PASS + k], part[SLOPE + k] = 1, ground[k]
        part[SUM + k], part[HIDDEN + k], part[BLOCKED + k] = 0, 0, 0
    for n in range(table.shape[0]):
        if found.kind[n] == OBSTACLE:
            first_block = min(first_block, found.block[n])
    for n in range(table.shape[0]):
        kind = found.kind[n]
        if kind == NONE:
            continue
        if kind == NO_RETURN and not silent:
            left_out = True
            continue
        slope, start, stop = table[n, 0], found.start[n] & 0x7FFF, found.stop[n] & 0x7FFF
        first = max(start, near)
        if first < min(stop, first_block):
            _pass(part, slope, first, min(stop, first_block))
        # Behind an obstacle: where nothing was stopped since the last ray, and enough have passed, only heights count
        first = max(start, first_block)
        if first < stop:
            plain = min(max(min(near, blocked), first), stop)
            if first > noted[0] or plain < noted[1]:
                _raise(part, noted_slope, noted[0], noted[1])
            noted, noted_slope = (first, plain), slope
            if plain < stop:
                _pass_obstacles(part, slope, plain, stop)
                blocked = max(blocked, stop) if first <= blocked else blocked
        if stop > last_block:
            last_block = PARTS
        if kind == OBSTACLE and found.block[n] != last_block:
            last_block = found.block[n]
            blocked = min(blocked, last_block)
            _block(part, last_block, min(end, last_block + int(1.0 / fade) + 1), fade)
        while near < end and part[PASS + near] < NEGLIGIBLE:
            near += 1
    _raise(part, noted_slope, noted[0], noted[1])
    for k in range(end):
        up = max(clearance[k] - part[SLOPE + k], np.float32(0.0))
        missed = (part[SUM + k] + up * part[PASS + k]) / (clearance[k] - ground[k])
        hidden = max(part[HIDDEN + k], two * part[BLOCKED + k] * up) * (np.float32(k) + np.float32(0.5)) * scale
        free[k] = (one - min(missed, one)) * max(one - hidden, np.float32(0.0))
    return left_out


@vector
def _pass(part: NDArray[np.float32], slope: np.float32, start: int, stop: int) -> None:
    """Let a ray pass some bins before any obstacle."""
    for k in range(start & 0x7FFF, stop & 0x7FFF):
        up = max(slope - part[SLOPE + k], np.float32(0.0))
        part[SUM + k] += up * part[PASS + k]
        part[PASS + k] *= part[POWER + k]
        part[SLOPE + k] += up


@vector
def _raise(part: NDArray[np.float32], slope: np.float32, start: int, stop: int) -> None:
    """Note that a ray passes some bins."""
    for k in range(start & 0x7FFF, stop & 0x7FFF):
        part[SLOPE + k] = max(part[SLOPE + k], slope)


@vector
def _pass_obstacles(part: NDArray[np.float32], slope: np.float32, start: int, stop: int) -> None:
    """Let a ray pass some bins behind an obstacle that stops other rays of the sector."""
    zero = np.float32(0.0)
    for k in range(start & 0x7FFF, stop & 0x7FFF):
        up = max(slope - part[SLOPE + k], zero)
        part[HIDDEN + k] += max(part[BLOCKED + k] * up - part[HIDDEN + k], zero)
        part[BLOCKED + k] = zero
        part[SUM + k] += up * part[PASS + k]
        part[PASS + k] *= part[POWER + k]
        part[SLOPE + k] += up


@vector
def _block(part: NDArray[np.float32], start: int, stop: int, fade: np.float32) -> None:
    """Let an obstacle stop a ray: the chance that it is still there falls behind it."""
    start &= 0x7FFF
    for k in range(start, stop & 0x7FFF):
        here = np.float32(1.0) - np.float32(k - start) * fade
        part[BLOCKED + k] += max(here - part[BLOCKED + k], np.float32(0.0))


@kernel
def _mark_obstacles(
    points: Points, origin: NDArray[np.float32], cells: Cells, numbers: RayNumbers, work: WorkSpace
) -> None:
    """Let the returns of obstacles mark their cells.

    Each is spread over the two points one standard deviation before and behind it (two-point Gauss-Hermite rule),
    each marking its cell with half a hit.
    """
    low, high = np.float32(numbers.obstacle_height), np.float32(numbers.clearance)
    noise, near = np.float32(numbers.range_noise), np.float32(cells.resolution)
    for n in range(points.x.shape[0]):
        if work.above[n] > low and work.above[n] < high and work.run[n] >= near:
            x, y, share = points.x[n], points.y[n], noise / work.run[n]
            du, dv = (x - origin[0]) * share, (y - origin[1]) * share
            _hit(work.hits, cells, x - du, y - dv)
            _hit(work.hits, cells, x + du, y + dv)


@kernel
def _mark_breaks(
    point: NDArray[np.int32], points: Points, cells: Cells, found: SectorRays, hits: NDArray[np.int32]
) -> None:
    """Let the returns from steps and holes of a sector mark their cells."""
    for n in range(point.shape[0]):
        if found.kind[n] == FACE_OF_STEP or found.kind[n] == DEEP:
            x, y = points.x[point[n] & 0x7FFFFFFF], points.y[point[n] & 0x7FFFFFFF]
            _hit(hits, cells, x, y)
            _hit(hits, cells, x, y)


@kernel
def _hit(hits: NDArray[np.int32], cells: Cells, x: np.float32, y: np.float32) -> None:
    """Add half a hit to the cell at (x, y), if it lies in the grid."""
    inverse = np.float32(1.0 / cells.resolution)
    u, v = (x - np.float32(cells.x0)) * inverse, (y - np.float32(cells.y0)) * inverse
    if u >= 0 and u < hits.shape[0] and v >= 0 and v < hits.shape[1]:
        hits[int(u) & 0x7FFFFFFF, int(v) & 0x7FFFFFFF] += 1


@kernel
def ray_mass(
    free: NDArray[np.float32],
    hits: NDArray[np.int32],
    polar: PolarGrid,
    false_alarm: NDArray[np.float32],
    numbers: RayNumbers,
) -> NDArray[np.float32]:
    """Turn polar belief in free and counts of returns into masses.

    R returns give occupied the mass ``1 - p_false_alarm**R``: that of R simple masses ``1 - p_false_alarm``,
    combined. Free is the mean over the polar bins that a cell covers. Where a cell has both, the two are combined
    by the conjunctive rule, the conflict going to unknown (Yager), after free is discounted to
    `free_reliability_at_hits`.

    Parameters
    ----------
    free : (sectors, bins) float32
        From `clear_sectors`, as `hits`.
    hits : (nx, ny) int32
    polar : PolarGrid
    false_alarm : (entries,) float32
        ``p_false_alarm ** (n / 2)`` for n half hits; the last entry holds beyond.
    numbers : RayNumbers

    Returns
    -------
    (nx, ny, 2) float32
        Free and occupied.
    """
    nx, ny = hits.shape
    one, limit = np.float32(1.0), np.float32(numbers.max_mass)
    reliability = np.float32(numbers.free_reliability_at_hits)
    mass = np.empty((nx, ny, 2), np.float32)
    for i in range(nx):
        for j in range(ny):
            k = polar.ring[i, j]
            mass[i, j, 0] = mass[i, j, 1] = 0
            if k < 0:
                continue
            k, s, count = k & 0x7FFF, polar.sector[i, j] & 0x7FFF, polar.span[i, j]
            cleared = np.float32(0.0)
            for _ in range(count):
                cleared += free[s & 0x7FFF, k]
                s = s + 1 if s + 1 < polar.sectors else 0
            if count > 1:
                cleared /= np.float32(count)
            number = hits[i, j]
            if number > 0:
                alarm = false_alarm[min(number, false_alarm.shape[0] - 1)]
                mass[i, j, 0] = min(reliability * cleared * alarm, limit)
                mass[i, j, 1] = min((one - alarm) * (one - reliability * cleared), limit)
            else:
                mass[i, j, 0] = min(cleared, limit)
    return mass
