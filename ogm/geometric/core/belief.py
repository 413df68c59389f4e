"""From rays and marks to masses."""

import math

import numpy as np

from ogm.geometric.core.jit import kernel, vector

__all__ = ["clear_sectors", "ray_mass"]


@kernel
def clear_sectors(
    rays,
    starts,
    missing,
    missing_starts,
    no_return_weight,
    level,
    clearance,
    radial_step,
    cell_sectors,
    p_miss,
    free,
):
    """Belief in free for every polar bin, from the rays that passed it.

    Let a cell be occupied by something of unknown height, equally likely anywhere up to `clearance`. Then
    ``w(h) = 1 - h / clearance`` is the chance that it reaches a ray at height h above ground, and a ray that
    it reaches passes unnoticed with probability p. All rays together can say no more than the lowest one
    reaches, w_1, and a higher one counts w_i / w_1 of it:

        T = sum_i w_i / w_1,        free = w_1 * (1 - p**T),

    which is the count-based ``1 - p**n`` for n rays at the ground, discounted (Shafer) by w_1: many rays over
    a roof say nothing about what is below it. A ray counts only where it is below clearance. The sums need no
    loop over rays and bins: the rays that pass a bin are those that stop further out, less those that start
    further out.

    Parameters
    ----------
    rays : (N, 3) float32, starts : (sectors + 1,) int32
        From `mark_and_aim`.
    missing, missing_starts, missing_weight
        The same from `sort_rays`, for beams that came back empty, and what one counts against a ray that came back.
    level : (rows, bins) float32
        From `level_ray_weight`.
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
    weight = np.float32(no_return_weight)
    # Rays that end in a bin, later rays that pass the bin before: how many, the sum of slopes, the least slope.
    count, rise, lowest = (
        np.zeros(bins + 1, np.float32),
        np.zeros(bins + 1, np.float32),
        np.empty(bins + 1, np.float32),
    )
    reach, share = np.empty(bins, np.float32), np.empty(bins, np.float32)
    for k in range(bins):
        reach[k] = (k + 0.5) * scale
        share[k] = -math.log(p_miss) * cell_sectors / (2 * k + 1) / 64
    for s in range(sectors):
        count[:], rise[:], lowest[:] = zero, zero, np.inf
        furthest = _file(rays, starts[s], starts[s + 1], one, count, rise, lowest)
        furthest = max(
            furthest, _file(missing, missing_starts[s], missing_starts[s + 1], weight, count, rise, lowest)
        )
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


@kernel
def _file(rays, first, after, weight, count, rise, lowest):
    """File rays under the bins before which they stop, and take them back under those where they start."""
    furthest = 0
    for n in range(first, after):
        slope, start, stop = rays[n, 0], int(rays[n, 1]) & 0x7FFF, int(rays[n, 2]) & 0x7FFF
        count[stop] += weight
        rise[stop] += weight * slope
        lowest[stop] = min(lowest[stop], slope)
        furthest = max(furthest, stop)
        if start > 0:
            count[start] -= weight
            rise[start] -= weight * slope
    return furthest


@vector
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


@kernel
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
