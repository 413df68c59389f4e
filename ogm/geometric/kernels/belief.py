"""Masses of the cells, by the classified rays of a scan."""

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

# Begin of each part of the work space of a sector; with constants the compiler knows that the parts do not overlap
PASS, SLOPE, SUM, HIDDEN, BLOCKED, POWER, PARTS = 0, 32848, 65696, 98544, 131392, 164240, 197088
LANES = 0xFFF8  # loops run over groups of eight bins, and a mask drops the bins outside the ray: no scalar remainder
LOWEST_SLOPE = np.float32(-3e38)  # rise over run below every ray
NEGLIGIBLE_CHANCE = np.float32(1e-4)  # chance below which further rays through a bin are ignored


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
    """Fill in the belief in free of every polar bin, and the hits of steps and holes.

    Let an obstacle on the ground have an unknown height H, uniformly distributed up to `clearance`. A ray at a
    height below H passes the obstacle unnoticed with probability p, independently of the other rays. All rays pass
    it with probability E[p ** N(H)]. Here N(H) is the number of rays below H, and

        free = 1 - E_H[p ** N(H)],       E_H = (sum_i (h_i+1 - h_i) * p ** i) / clearance,

    for the heights h_1 <= h_2 <= ... of the rays, with h_0 = 0 and the clearance as the last height. The sum is exact
    except for terms below `NEGLIGIBLE_CHANCE`.

    An obstacle may also hang in a gap of heights, behind a nearer obstacle that stops the rays. Let its thickness be
    uniformly distributed up to `hidden_height`. It fits into a gap of height d between two neighbouring rays with
    probability ``min(d / hidden_height, 1)``, if other rays between the two were stopped. A second factor is the
    chance that the nearer obstacle extends to the cell, which falls to 0 at `hidden_depth`. A gap that ends at the
    clearance counts twice. The largest of these chances reduces belief. In a gap without stopped rays the chance is
    `p_hidden`. Belief is also reduced by `p_hidden` times the share of the heights above the highest ray, up to the
    clearance.

    Beams without echo are a second source of evidence. Its reliability is `no_return_weight` times the result of
    `silence_reliability`. Belief without these beams is raised by this share of their contribution.

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
        Part k: sectors from `first` to ``last - 1``.
    work : WorkSpace
        The sectors' entries in `free` are filled. Returns from steps and holes add half hits to `hits[k]`.
    """
    sectors, bins, largest_count, (first_sector, last_sector, part_number) = polar.sectors, polar.bins, 0, part
    for s in range(first_sector, last_sector):
        largest_count = max(largest_count, rays.starts[s + 1] - rays.starts[s])
    bin_memory = np.empty((3, largest_count), np.int32)
    found = SectorRays(np.empty(largest_count, np.int8), bin_memory[0], bin_memory[1], bin_memory[2])
    part_space, hits = np.empty(PARTS, np.float32), work.hits[part_number]
    for k in range(bins):  # chance that a ray misses an obstacle in a cell, which subtends a part of the sector
        part_space[POWER + k] = numbers.p_miss ** (sectors / (math.pi * (2 * k + 1)))
    weight = np.float32(numbers.no_return_weight)
    hidden_bins = (
        *(np.float32(numbers.hidden_height / polar.step), np.float32(numbers.hidden_depth / polar.step)),
        np.float32(numbers.p_hidden),
    )
    false = sectors < 0  # False as a variable: each constant would be compiled separately
    for s in range(first_sector, last_sector):
        first, row, profile = rays.starts[s], s >> ROW_BITS, s >> PROFILE_BITS
        end = classify_rays(rays, s, limits, polar, breaks, numbers, found)
        work.free[s, end:] = 0
        if end == 0:
            continue
        if breaks.broken[profile]:
            _mark_breaks(rays, s, points, cells, found, hits)
        free, slopes = work.free[s, :end], rays.slope[first : rays.starts[s + 1]]
        if _free_belief(slopes, found, limits, row, hidden_bins, false, part_space, free):
            returns_only = free.copy()
            _free_belief(slopes, found, limits, row, hidden_bins, not false, part_space, free)
            for k in range(end):
                free[k] = returns_only[k] + weight * silence[k] * max(free[k] - returns_only[k], np.float32(0.0))
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
    """Fill in the belief of a sector's bins, and return whether beams without echo were skipped.

    With `silent` these beams count. `hidden_bins` holds `hidden_height` and `hidden_depth` in bins, and `p_hidden`.
    """
    end, first_block, near, blocked, last_block = free.shape[0], free.shape[0], 0, PARTS, PARTS
    one, two = np.float32(1.0), np.float32(2.0)
    zero = int(np.int64(0))  # a constant would be compiled separately
    skipped, pending, pending_slope = False, (zero, zero), np.float32(0.0)  # bins and slope of a ray still to record
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
            skipped = True
            continue
        slope, start, stop = slopes[n], found.start[n] & 0x7FFF, found.stop[n] & 0x7FFF
        first = max(start, near)
        if first < min(stop, first_block):
            _pass(part, slope, first, min(stop, first_block))
        # Behind an obstacle: bins without a ray stopped since the last ray, and with enough rays, need heights only
        first = max(start, first_block)
        if first < stop:
            plain = first if gaps_count else min(max(min(near, blocked), first), stop)
            if first > pending[0] or plain < pending[1]:
                _raise(part, pending_slope, pending[0], pending[1])
            pending, pending_slope = (first, plain), slope
            if plain < stop:
                _pass_obstacles(part, slope, plain, stop, p_hidden)
                blocked = max(blocked, stop) if first <= blocked else blocked
        if stop > last_block:
            last_block = PARTS
        if kind == OBSTACLE and found.block[n] != last_block:
            last_block = found.block[n]
            blocked = min(blocked, last_block)
            _block(part, last_block, max(min(end, last_block + int(1.0 / fade) + 1), last_block), fade)
        while near < end and part[PASS + near] < NEGLIGIBLE_CHANCE:
            near += 1
    _raise(part, pending_slope, pending[0], pending[1])
    for k in range(end):
        up = max(clearance[k] - part[SLOPE + k], np.float32(0.0))
        missed = (part[SUM + k] + up * part[PASS + k]) / (clearance[k] - ground[k])
        hidden = max(part[HIDDEN + k], two * part[BLOCKED + k] * up) * (np.float32(k) + np.float32(0.5)) * scale
        above = one - p_hidden * up / (clearance[k] - ground[k])
        free[k] = (one - min(missed, one)) * max(one - hidden, np.float32(0.0)) * above
    return skipped


@vector
def _pass(part: NDArray[np.float32], slope: np.float32, start: int, stop: int) -> None:
    """Update bins before any obstacle for a ray that passes them."""
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
    """Raise the highest slope in bins to the slope of a passing ray."""
    first, count = np.int32(start), np.uint32(stop - start)
    for k in range(start & LANES, (stop + 7) & LANES):
        inside = np.uint32(np.int32(k) - first) < count
        part[SLOPE + k] = max(part[SLOPE + k], slope if inside else LOWEST_SLOPE)


@vector
def _pass_obstacles(part: NDArray[np.float32], slope: np.float32, start: int, stop: int, p_hidden: np.float32) -> None:
    """Update bins behind an obstacle, which stops other rays of the sector, for a ray that passes them."""
    zero, one, first, count = np.float32(0.0), np.float32(1.0), np.int32(start), np.uint32(stop - start)
    for k in range(start & LANES, (stop + 7) & LANES):
        inside = np.uint32(np.int32(k) - first) < count
        blocked, up = part[BLOCKED + k], max(slope - part[SLOPE + k], zero)
        up = up if inside else zero
        part[HIDDEN + k] += max(max(blocked, p_hidden) * up - part[HIDDEN + k], zero)
        part[BLOCKED + k] = min(blocked, zero if inside else -LOWEST_SLOPE)  # a masked store would take longer
        part[SUM + k] += up * part[PASS + k]
        part[PASS + k] *= max(part[POWER + k], zero if inside else one)
        part[SLOPE + k] += up


@vector
def _block(part: NDArray[np.float32], start: int, stop: int, fade: np.float32) -> None:
    """Update the bins behind an obstacle that stops a ray; the chance of its presence falls with distance."""
    first, count = np.int32(start), np.uint32(stop - start)
    for k in range(start & LANES, (stop + 7) & LANES):
        place = np.int32(k) - first
        here = np.float32(1.0) - np.float32(place) * fade
        here = here if np.uint32(place) < count else np.float32(0.0)
        part[BLOCKED + k] += max(here - part[BLOCKED + k], np.float32(0.0))


@kernel
def _mark_breaks(rays: Rays, s: int, points: Points, cells: Cells, found: SectorRays, hits: NDArray[np.int32]) -> None:
    """Add the hits of the returns from steps and holes of a sector to their cells."""
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

    R returns give occupied the mass ``1 - p_false_alarm**R``, the combination of R simple masses
    ``1 - p_false_alarm``. Free is the mean over the polar bins that a cell covers. In a cell with both, free is
    discounted by `free_reliability_at_hits`, then combined by the conjunctive rule. The conflict becomes unknown
    (Yager).

    Parameters
    ----------
    work : WorkSpace
        With `free` and `hits` of `clear_sectors`.
    polar : PolarGrid
    false_alarm : (entries,) float32
        ``p_false_alarm ** (n / 2)`` for n half hits; the last entry also for more.
    numbers : RayNumbers
    first, last : int
        Rows from `first` to ``last - 1``.
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
