"""From classified rays to masses."""

import math

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import (
    Breaks,
    Cells,
    Points,
    PolarGrid,
    RayLimits,
    RayNumbers,
    Rays,
    SectorRays,
    WorkSpace,
)
from ogm.geometric.kernels.breaks import PROFILE_BITS
from ogm.geometric.kernels.classify import DEEP, FACE_OF_STEP, NO_RETURN, NONE, OBSTACLE, classify_rays
from ogm.geometric.kernels.polar import ROW_BITS
from ogm.geometric.kernels.rays import hit_cell
from ogm.jit import kernel, vector

__all__ = ["clear_sectors", "ray_mass"]

# Where the parts of the work space of a sector begin; constants, so that the compiler sees them apart
PASS, SLOPE, SUM, HIDDEN, BLOCKED, POWER, PARTS = 0, 32848, 65696, 98544, 131392, 164240, 197088
LANES = 0xFFF8  # bins are passed in eights, from which those beside a ray's are masked: no remainder without vectors
LOWEST = np.float32(-3e38)  # slope
NEGLIGIBLE = np.float32(1e-4)  # chance, below which more rays through a bin are not counted


@kernel
def clear_sectors(
    rays: Rays,
    points: Points,
    limits: RayLimits,
    polar: PolarGrid,
    cells: Cells,
    breaks: Breaks,
    silence: NDArray[np.float32],
    numbers: RayNumbers,
    part: tuple[int, int, int],
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
    Where nothing was stopped in a gap, the chance is `p_hidden`; and belief is reduced by `p_hidden` times the share of
    the heights up to the clearance that lie above the highest ray.

    Beams without echo are one source of evidence. Its reliability is `no_return_weight` times what
    `silence_reliability` gives: belief is that without them, plus this share of what they add.

    Parameters
    ----------
    rays : Rays
    points : Points
    limits : RayLimits
    polar : PolarGrid
    cells : Cells
    breaks : Breaks
    silence : (bins,) float32
        From `silence_reliability`.
    numbers : RayNumbers
        p is `p_miss`.
    part : (first, last, k)
        Sectors from `first` up to but without `last` are part k.
    work : WorkSpace
        The sectors' entries in `free` are filled, and half hits of returns from steps and holes added to `hits[k]`.
    """
    sectors, bins, most, (first_sector, last_sector, part_number) = polar.sectors, polar.bins, 0, part
    for s in range(first_sector, last_sector):
        most = max(most, rays.starts[s + 1] - rays.starts[s])
    whole = np.empty((3, most), np.int32)
    found = SectorRays(np.empty(most, np.int8), whole[0], whole[1], whole[2])
    part_space, hits = np.empty(PARTS, np.float32), work.hits[part_number]
    for k in range(bins):  # of a ray that passes a bin: chance to pass a cell there, which sees some of the sector's
        part_space[POWER + k] = numbers.p_miss ** (sectors / (math.pi * (2 * k + 1)))
    weight = np.float32(numbers.no_return_weight)
    hidden_bins = (
        *(np.float32(numbers.hidden_height / polar.step), np.float32(numbers.hidden_depth / polar.step)),
        np.float32(numbers.p_hidden),
    )
    no = sectors < 0  # False as a variable: constants would be compiled twice
    for s in range(first_sector, last_sector):
        first, row, profile = rays.starts[s], s >> ROW_BITS, s >> PROFILE_BITS
        end = classify_rays(rays, s, limits, polar, breaks, numbers, found)
        work.free[s, end:] = 0
        if end == 0:
            continue
        if breaks.broken[profile]:
            _mark_breaks(rays, s, points, cells, found, hits)
        free, slopes = work.free[s, :end], rays.slope[first : rays.starts[s + 1]]
        if _free_belief(slopes, found, limits, row, hidden_bins, no, part_space, free):
            alone = free.copy()
            _free_belief(slopes, found, limits, row, hidden_bins, not no, part_space, free)
            for k in range(end):
                free[k] = alone[k] + weight * silence[k] * max(free[k] - alone[k], np.float32(0.0))
        if breaks.broken[profile]:
            for k in range(end):
                free[k] *= breaks.reliability[profile, k]


@kernel
def _free_belief(
    slopes: NDArray[np.float32],
    found: SectorRays,
    limits: RayLimits,
    row: int,
    hidden_bins: tuple[np.float32, np.float32, np.float32],
    silent: bool,
    part: NDArray[np.float32],
    free: NDArray[np.float32],
) -> bool:
    """Fill in the belief of one sector's bins, with the beams without echo or without them.

    `hidden_bins` are `hidden_height` and `hidden_depth` in bins, and `p_hidden`.
    """
    end, first_block, near, blocked, last_block = free.shape[0], free.shape[0], 0, PARTS, PARTS
    one, two = np.float32(1.0), np.float32(2.0)
    zero = int(np.int64(0))  # a constant would be compiled once more
    left_out, noted, noted_slope = False, (zero, zero), np.float32(0.0)  # a ray not yet noted as passing, and where
    ground, clearance = limits.ground[row], limits.clearance[row]
    scale, fade, p_hidden = one / hidden_bins[0], one / hidden_bins[1], hidden_bins[2]
    gaps_count = p_hidden > 0
    for k in range(end):
        part[PASS + k], part[SLOPE + k] = 1, ground[k]
        part[SUM + k], part[HIDDEN + k], part[BLOCKED + k] = 0, 0, 0
    for n in range(slopes.shape[0]):
        if found.kind[n] == OBSTACLE:
            first_block = min(first_block, found.block[n])
    if gaps_count:
        first_block = 0
    for n in range(slopes.shape[0]):
        kind = found.kind[n]
        if kind == NONE:
            continue
        if kind == NO_RETURN and not silent:
            left_out = True
            continue
        slope, start, stop = slopes[n], found.start[n] & 0x7FFF, found.stop[n] & 0x7FFF
        first = max(start, near)
        if first < min(stop, first_block):
            _pass(part, slope, first, min(stop, first_block))
        # Behind an obstacle: where nothing was stopped since the last ray, and enough have passed, only heights count
        first = max(start, first_block)
        if first < stop:
            plain = first if gaps_count else min(max(min(near, blocked), first), stop)
            if first > noted[0] or plain < noted[1]:
                _raise(part, noted_slope, noted[0], noted[1])
            noted, noted_slope = (first, plain), slope
            if plain < stop:
                _pass_obstacles(part, slope, plain, stop, p_hidden)
                blocked = max(blocked, stop) if first <= blocked else blocked
        if stop > last_block:
            last_block = PARTS
        if kind == OBSTACLE and found.block[n] != last_block:
            last_block = found.block[n]
            blocked = min(blocked, last_block)
            _block(part, last_block, max(min(end, last_block + int(1.0 / fade) + 1), last_block), fade)
        while near < end and part[PASS + near] < NEGLIGIBLE:
            near += 1
    _raise(part, noted_slope, noted[0], noted[1])
    for k in range(end):
        up = max(clearance[k] - part[SLOPE + k], np.float32(0.0))
        missed = (part[SUM + k] + up * part[PASS + k]) / (clearance[k] - ground[k])
        hidden = max(part[HIDDEN + k], two * part[BLOCKED + k] * up) * (np.float32(k) + np.float32(0.5)) * scale
        above = one - p_hidden * up / (clearance[k] - ground[k])
        free[k] = (one - min(missed, one)) * max(one - hidden, np.float32(0.0)) * above
    return left_out


@vector
def _pass(part: NDArray[np.float32], slope: np.float32, start: int, stop: int) -> None:
    """Let a ray pass some bins before any obstacle."""
    zero, one, first, count = np.float32(0.0), np.float32(1.0), np.int32(start), np.uint32(stop - start)
    for k in range(start & LANES, (stop + 7) & LANES):
        inside = np.uint32(np.int32(k) - first) < count
        up = max(slope - part[SLOPE + k], zero)
        up = up if inside else zero
        part[SUM + k] += up * part[PASS + k]
        part[PASS + k] *= max(part[POWER + k], zero if inside else one)
        part[SLOPE + k] += up


@vector
def _raise(part: NDArray[np.float32], slope: np.float32, start: int, stop: int) -> None:
    """Note that a ray passes some bins."""
    first, count = np.int32(start), np.uint32(stop - start)
    for k in range(start & LANES, (stop + 7) & LANES):
        inside = np.uint32(np.int32(k) - first) < count
        part[SLOPE + k] = max(part[SLOPE + k], slope if inside else LOWEST)


@vector
def _pass_obstacles(part: NDArray[np.float32], slope: np.float32, start: int, stop: int, p_hidden: np.float32) -> None:
    """Let a ray pass some bins behind an obstacle that stops other rays of the sector."""
    zero, one, first, count = np.float32(0.0), np.float32(1.0), np.int32(start), np.uint32(stop - start)
    for k in range(start & LANES, (stop + 7) & LANES):
        inside = np.uint32(np.int32(k) - first) < count
        blocked, up = part[BLOCKED + k], max(slope - part[SLOPE + k], zero)
        up = up if inside else zero
        part[HIDDEN + k] += max(max(blocked, p_hidden) * up - part[HIDDEN + k], zero)
        part[BLOCKED + k] = min(blocked, zero if inside else -LOWEST)  # no store under a mask, which takes longer
        part[SUM + k] += up * part[PASS + k]
        part[PASS + k] *= max(part[POWER + k], zero if inside else one)
        part[SLOPE + k] += up


@vector
def _block(part: NDArray[np.float32], start: int, stop: int, fade: np.float32) -> None:
    """Let an obstacle stop a ray: the chance that it is still there falls behind it."""
    first, count = np.int32(start), np.uint32(stop - start)
    for k in range(start & LANES, (stop + 7) & LANES):
        place = np.int32(k) - first
        here = np.float32(1.0) - np.float32(place) * fade
        here = here if np.uint32(place) < count else np.float32(0.0)
        part[BLOCKED + k] += max(here - part[BLOCKED + k], np.float32(0.0))


@kernel
def _mark_breaks(rays: Rays, s: int, points: Points, cells: Cells, found: SectorRays, hits: NDArray[np.int32]) -> None:
    """Let the returns from steps and holes of a sector mark their cells."""
    first = rays.starts[s]
    for n in range(rays.starts[s + 1] - first):
        if found.kind[n] == FACE_OF_STEP or found.kind[n] == DEEP:
            at = rays.point[first + n] & 0x7FFFFFFF
            hit_cell(hits, cells, points.x[at], points.y[at])
            hit_cell(hits, cells, points.x[at], points.y[at])


@kernel
def ray_mass(
    work: WorkSpace,
    polar: PolarGrid,
    false_alarm: NDArray[np.float32],
    numbers: RayNumbers,
    first: int,
    last: int,
    mass: NDArray[np.float32],
) -> None:
    """Turn polar belief in free and counts of returns into masses of some rows of cells.

    R returns give occupied the mass ``1 - p_false_alarm**R``: that of R simple masses ``1 - p_false_alarm``,
    combined. Free is the mean over the polar bins that a cell covers. Where a cell has both, the two are combined
    by the conjunctive rule, the conflict going to unknown (Yager), after free is discounted to
    `free_reliability_at_hits`.

    Parameters
    ----------
    work : WorkSpace
        `free` and `hits`, from `clear_sectors`.
    polar : PolarGrid
    false_alarm : (entries,) float32
        ``p_false_alarm ** (n / 2)`` for n half hits; the last entry holds beyond.
    numbers : RayNumbers
    first, last : int
        Rows from `first` up to but without `last`.
    mass : (nx, ny, 2) float32
        Free and occupied; the rows are filled.
    """
    ny, free = mass.shape[1], work.free
    one, limit = np.float32(1.0), np.float32(numbers.max_mass)
    reliability = np.float32(numbers.free_reliability_at_hits)
    cleared, marked = np.empty(ny, np.float32), np.empty(ny, np.int32)
    for i in range(first & 0x7FFFFFFF, last & 0x7FFFFFFF):
        _average_bins(free, polar, i, cleared)
        for j in range(ny):
            marked[j] = work.hits[0, i, j]
        for k in range(1, work.hits.shape[0]):
            for j in range(ny):
                marked[j] += work.hits[k, i, j]
        row = mass[i].reshape(-1)
        for j in range(ny):
            row[2 * j], row[2 * j + 1] = min(cleared[j], limit), np.float32(0.0)
        for j in range(ny):
            if marked[j] > 0 and polar.ring[i, j] >= 0:
                alarm, here = false_alarm[min(marked[j], false_alarm.shape[0] - 1)], cleared[j]
                mass[i, j, 0] = min(reliability * here * alarm, limit)
                mass[i, j, 1] = min((one - alarm) * (one - reliability * here), limit)


@kernel
def _average_bins(free: NDArray[np.float32], polar: PolarGrid, i: int, cleared: NDArray[np.float32]) -> None:
    """Fill in the mean belief in free of the polar bins that each cell of row `i` covers; 0 under the ego vehicle."""
    for j in range(cleared.shape[0]):
        cleared[j] = free[polar.sector[i, j] & 0x7FFF, max(polar.ring[i, j], 0) & 0x7FFF]
    for j in range(cleared.shape[0]):
        k, s, count = polar.ring[i, j], polar.sector[i, j] & 0x7FFF, polar.span[i, j] & 0x7FFF
        if k < 0:
            cleared[j] = np.float32(0.0)
        elif count > 1:
            total, k = cleared[j], k & 0x7FFF
            for _ in range(count - 1):
                s = s + 1 if s + 1 < polar.sectors else 0
                total += free[s & 0x7FFF, k]
            cleared[j] = total / np.float32(count)
