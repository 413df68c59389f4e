"""From rays and marks to masses."""

# mypy: allow-untyped-defs
import math

import numpy as np

from ogm.jit import kernel, vector

__all__ = ["clear_sectors", "ray_mass"]


@kernel
def clear_sectors(rays, no_return_rays, level, polar, numbers, free):
    """Fill in the belief in free of every polar bin, from the rays that passed it.

    Let a cell be occupied by something of unknown height, equally likely anywhere up to `clearance`. Then
    ``w(h) = 1 - h / clearance`` is the chance that it reaches a ray at height h above ground, and a ray that
    it reaches passes unnoticed with probability p. All rays together give no more than the chance that it
    reaches the lowest one, w_1, and a higher one counts w_i / w_1 of it:

        T = sum_i w_i / w_1,        free = w_1 * (1 - p**T),

    which is the count-based ``1 - p**n`` for n rays at the ground, discounted (Shafer) by w_1: many rays over
    a roof do not show what is below it. A ray counts only where it is below clearance. The sums need no
    loop over rays and bins: the rays that pass a bin are those that stop further out, less those that start
    further out.

    Parameters
    ----------
    rays, no_return_rays : Rays
        From `mark_and_aim` and `aim_no_returns`; the latter count `no_return_weight` each.
    level : (rows, bins) float32
        From `level_ray_weight`.
    polar : PolarGrid
    numbers : RayNumbers
        p is `p_miss`.
    free : (sectors, bins) float32
        Filled.
    """
    sectors, bins = polar.sectors, polar.bins
    per_row, cell_sectors = (sectors // polar.rows, sectors / math.pi)  # T is counted for cells, not for sectors
    scale, zero, one = np.float32(polar.step / numbers.clearance), np.float32(0.0), np.float32(1.0)
    weight = np.float32(numbers.no_return_weight)
    # Of the rays that stop before a bin, later of those that pass the bin before: number, sum and least of slopes
    count, rise = np.zeros(bins + 1, np.float32), np.zeros(bins + 1, np.float32)
    lowest = np.empty(bins + 1, np.float32)
    reach, share = np.empty(bins, np.float32), np.empty(bins, np.float32)
    for k in range(bins):
        reach[k] = (k + 0.5) * scale
        share[k] = -math.log(numbers.p_miss) * cell_sectors / (2 * k + 1) / 64
    for s in range(sectors):
        count[:], rise[:], lowest[:] = zero, zero, np.inf
        end = max(
            _count_rays(rays, s, one, count, rise, lowest), _count_rays(no_return_rays, s, weight, count, rise, lowest)
        )
        through, climb, least = zero, zero, np.float32(np.inf)
        for k in range(end, 0, -1):
            through += count[k]
            climb += rise[k]
            least = min(least, lowest[k])
            count[k], rise[k], lowest[k] = through, climb, least
        free[s, end:] = zero
        passing = count[1 : end + 1], rise[1 : end + 1], lowest[1 : end + 1]
        _belief(passing, level[s // per_row, :end], reach[:end], share[:end], free[s, :end])


@kernel
def _count_rays(rays, s, weight, count, rise, lowest):
    """Add a sector's rays to the bins before which they stop, subtract them where they start; return the last bin."""
    end = 0
    for n in range(rays.starts[s], rays.starts[s + 1]):
        slope, start, stop = rays.table[n, 0], int(rays.table[n, 1]) & 0x7FFF, int(rays.table[n, 2]) & 0x7FFF
        count[stop] += weight
        rise[stop] += weight * slope
        lowest[stop] = min(lowest[stop], slope)
        end = max(end, stop)
        if start > 0:
            count[start] -= weight
            rise[start] -= weight * slope
    return end


@vector
def _belief(passing, level, reach, share, free):
    """``w_1 * (1 - p**T)`` for the bins of one sector, with ``exp(x)`` as a power: error below 1e-6."""
    count, rise, lowest = passing
    for k in range(free.shape[0]):
        first = max(min(level[k] - lowest[k] * reach[k], np.float32(1.0)), np.float32(0.0))
        total = (count[k] * level[k] - rise[k] * reach[k]) / max(first, np.float32(1e-6))
        z = min(min(max(total, np.float32(0.0)), count[k]) * share[k], np.float32(0.5))
        q = np.float32(1.0) + z * (
            np.float32(1.0) + z * (np.float32(0.5) + z * (np.float32(1.0 / 6) + z * np.float32(1.0 / 24)))
        )
        for _ in range(6):  # ** 64
            q *= q
        free[k] = first * (np.float32(1.0) - np.float32(1.0) / q)


@kernel
def ray_mass(free, hits, polar, false_alarm, numbers):
    """Turn polar belief in free and counts of returns into masses.

    R returns give occupied the mass ``1 - p_false_alarm**R``: that of R simple masses ``1 - p_false_alarm``,
    combined. Free is the mean over the polar bins that a cell covers. Where a cell has both, the two are combined
    by the conjunctive rule, the conflict going to unknown (Yager), after free is discounted to
    `free_reliability_at_hits`.

    Parameters
    ----------
    free : (sectors, bins) float32
        From `clear_sectors`.
    hits : (nx, ny) int32
        From `mark_and_aim`.
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
            if k < 0:
                mass[i, j, 0] = mass[i, j, 1] = 0
                continue
            k, s, count = k & 0x7FFF, polar.sector[i, j] & 0x7FFF, polar.span[i, j]
            cleared = free[s, k]
            if count > 1:
                for _ in range(count - 1):
                    s = s + 1 if s + 1 < polar.sectors else 0
                    cleared += free[s & 0x7FFF, k]
                cleared /= np.float32(count)
            if hits[i, j] > 0:
                alarm = false_alarm[min(hits[i, j], false_alarm.shape[0] - 1)]
                mass[i, j, 0] = min(reliability * cleared * alarm, limit)
                mass[i, j, 1] = min((one - alarm) * (one - reliability * cleared), limit)
            else:
                mass[i, j, 0] = min(cleared, limit)
                mass[i, j, 1] = 0
    return mass
