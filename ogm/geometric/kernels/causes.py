"""Causes of the unknown cells of a scan: by the rays of each sector, and from polar bins to cells."""

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import PolarGrid, RayLimits, RayNumbers, Rays
from ogm.geometric.kernels.polar import ROW_BITS
from ogm.jit import kernel, vector
from ogm.unknown_cause import UnknownCause

__all__ = ["cell_causes", "polar_causes"]

OUTSIDE_VIEW, BEHIND_OBSTACLE = int(UnknownCause.OUTSIDE_VIEW), int(UnknownCause.BEHIND_OBSTACLE)
BETWEEN_BEAMS, NO_ECHO = int(UnknownCause.BETWEEN_BEAMS), int(UnknownCause.NO_ECHO)
NEAR_VEHICLE, ABOVE_CLEARANCE = int(UnknownCause.NEAR_VEHICLE), int(UnknownCause.ABOVE_CLEARANCE)
CONTRADICTED = int(UnknownCause.CONTRADICTED)

WEDGES = 16  # wedges of a turn; the view of a wedge ranges from the lowest to the highest ray in it and its neighbours
GAP = 36  # parts of a turn: the widest gap between two beams is 10 degrees; a wider gap is outside the view
FLAT = np.float32(1e9)  # slope that no ray has


@kernel
def polar_causes(
    rays: Rays, limits: RayLimits, polar: PolarGrid, numbers: RayNumbers, view: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Return the cause of each polar bin if it is unknown, by the rays of its sector.

    The first rule that holds decides:

    1. `BEHIND_OBSTACLE`: a ray that an obstacle stops before the bin would pass the bin above the ground, or a return
       from under the ground lies beyond the bin.
    2. `NEAR_VEHICLE`: all rays of the view pass above half the clearance, before the lowest ray meets the ground.
    3. `NO_ECHO` or `BETWEEN_BEAMS`: the lowest ray below clearance has no echo, or has an echo.
    4. `ABOVE_CLEARANCE`: a ray passes above clearance.
    5. `NO_ECHO` or `OUTSIDE_VIEW`: the view contains the ground of the bin, or does not.

    A sector without rays is `BETWEEN_BEAMS` in a gap of at most 10 degrees, else `OUTSIDE_VIEW`.

    Parameters
    ----------
    rays : Rays
    limits : RayLimits
    polar : PolarGrid
    numbers : RayNumbers
    view : (sectors, 2) float32
        Slopes of the lowest and the highest ray of the view around each sector.

    Returns
    -------
    (sectors, bins) uint8
    """
    sectors, bins = polar.sectors, polar.bins
    causes = np.empty((sectors, bins), np.uint8)
    slopes = np.full((3, bins + 1), FLAT, np.float32)
    slopes[2] = -FLAT
    last = sectors - 1  # the last sector with rays precedes the first sector of the turn
    while last > 0 and rays.starts[last] == rays.starts[last + 1]:
        last -= 1
    before, after = last - sectors, -1
    for s in range(sectors):
        if rays.starts[s] == rays.starts[s + 1]:
            if after < s:
                after = s + 1
                while after < s + sectors and rays.starts[after % sectors] == rays.starts[after % sectors + 1]:
                    after += 1
            narrow = (after - before - 1) * GAP <= sectors
            for k in range(bins):
                causes[s, k] = BETWEEN_BEAMS if narrow else OUTSIDE_VIEW
            continue
        before = s
        ground, clearance = limits.ground[s >> ROW_BITS], limits.clearance[s >> ROW_BITS]
        first, last = rays.starts[s], rays.starts[s + 1]
        top = _find_slopes(rays, (first, last), ground, polar.step, numbers, slopes)
        _name_causes(slopes, ground, clearance, view[s], top, causes[s])
    return causes


@vector
def _find_slopes(
    rays: Rays,
    sector: tuple[int, int],
    ground: NDArray[np.float32],
    step: float,
    numbers: RayNumbers,
    slopes: NDArray[np.float32],
) -> int:
    """Fill in the decisive slopes of a sector for each bin; return the end of the farthest ray.

    Rows of `slopes`: the lowest ray with echo that reaches the bin, the lowest ray without echo above the ground in
    the bin, and the highest ray that an obstacle in the bin stops. Before the call they hold `FLAT`, `FLAT` and
    `-FLAT`.
    """
    bins, per_metre = ground.shape[0], np.float32(1.0 / step)
    low, high = np.float32(numbers.obstacle_height), np.float32(numbers.clearance)
    below, before = np.float32(-numbers.below_ground), np.float32(2 * numbers.range_noise)
    growth, limit, zero, one = np.float32(2 * numbers.noise_growth), np.float32(bins), np.float32(0.0), np.float32(1.0)
    passed, silent, meets = 0, 0, 0
    for n in range(sector[0], sector[1]):  # in order of slope: the first ray that reaches a bin is the lowest
        slope, run, above = rays.slope[n], rays.run[n], rays.above[n]
        here = run * per_metre
        if here < 1:
            continue
        if rays.point[n] < 0 or above < below:
            while meets < bins and slope >= ground[meets]:
                meets += 1
            end = int(min(here, limit))
            if rays.point[n] >= 0:  # from under the ground: stopped at the ground
                for k in range(meets, end):
                    slopes[2, k] = max(slopes[2, k], ground[k])
                continue
            for k in range(silent, min(end, meets)):
                slopes[1, k] = slope
            silent = max(silent, min(end, meets))
            continue
        stops = above > low and above < high
        here += -(before + growth * run * run) * per_metre if stops else one if above <= low else zero
        end = int(min(max(here, zero), limit))
        slopes[2, (end if stops else bins) & 0x7FFF] = slope
        if end > passed:
            for k in range(passed, end):
                slopes[0, k] = slope
            passed = end
    return passed


@vector
def _name_causes(
    slopes: NDArray[np.float32],
    ground: NDArray[np.float32],
    clearance: NDArray[np.float32],
    view: NDArray[np.float32],
    top: int,
    causes: NDArray[np.uint8],
) -> None:
    """Fill in the causes of a sector's bins, and reset the slopes."""
    bins, lowest, highest, stopped = causes.shape[0], view[0], view[1], -FLAT
    meets = bins  # bin in which the lowest ray of the view meets the ground
    while meets > 0 and lowest < ground[meets - 1]:
        meets -= 1
    meets = meets if meets < bins else 0
    for k in range(bins):
        stopped = max(stopped, slopes[2, k])
        slopes[2, k] = stopped
    for k in range(bins):  # from the last rule to the first, without branches
        cause = NO_ECHO if highest >= ground[k] else OUTSIDE_VIEW
        cause = ABOVE_CLEARANCE if k < top else cause
        cause = BETWEEN_BEAMS if slopes[0, k] < clearance[k] else cause
        cause = NO_ECHO if slopes[1, k] < min(clearance[k], slopes[0, k]) else cause
        cause = NEAR_VEHICLE if (k < meets) & (2 * lowest >= ground[k] + clearance[k]) else cause
        causes[k] = BEHIND_OBSTACLE if slopes[2, k] >= ground[k] else cause
        slopes[0, k] = slopes[1, k] = FLAT
        slopes[2, k] = -FLAT


@kernel
def cell_causes(
    mass: NDArray[np.float32], own: NDArray[np.float32], causes: NDArray[np.uint8], polar: PolarGrid, min_mass: float
) -> NDArray[np.uint8]:
    """Return the causes of unknown cells, from the polar bin at the middle of each; 0 for known cells.

    Parameters
    ----------
    mass : (nx, ny, 2) float32
        Masses that decide which cells are known.
    own : (nx, ny, 2) float32
        Masses of the rays alone.
    causes : (sectors, bins) uint8
    polar : PolarGrid
        A cell under the ego vehicle has no ring.
    min_mass : float
        Mass of occupied, in `mass` or `own`, from which an unknown cell is contradicted.

    Returns
    -------
    (nx, ny) uint8
    """
    nx, ny = polar.ring.shape
    found = np.zeros((nx, ny), np.uint8)
    for i in range(nx):
        for j in range(ny):
            free, occupied = mass[i, j, 0], mass[i, j, 1]
            if max(free, occupied) + free + occupied > 1:
                continue
            k = polar.ring[i, j]
            if k < 0:
                found[i, j] = NEAR_VEHICLE
                continue
            if max(occupied, own[i, j, 1]) >= min_mass:
                found[i, j] = CONTRADICTED
                continue
            s = (polar.sector[i, j] & 0x7FFF) + (polar.span[i, j] >> 1)
            s = s - polar.sectors if s >= polar.sectors else s
            found[i, j] = causes[s & 0x7FFF, k & 0x7FFF]
    return found
