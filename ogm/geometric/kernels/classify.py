"""What each ray of a sector hits, and the bins in which it is below clearance."""

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import Breaks, PolarGrid, RayLimits, RayNumbers, Rays, SectorRays
from ogm.geometric.kernels.breaks import HOLE, PROFILE_BITS, STEP
from ogm.geometric.kernels.polar import ROW_BITS
from ogm.jit import kernel

__all__ = ["DEEP", "FACE_OF_STEP", "GROUND", "NONE", "NO_RETURN", "OBSTACLE", "OVERHEAD", "classify_rays"]

NONE = 0  # no effect: multipath, or straight up or down
GROUND = 1
OVERHEAD = 2  # above the clearance
OBSTACLE = 3
FACE_OF_STEP = 4
DEEP = 5  # in a hole, or beyond a drop
NO_RETURN = 6


@kernel
def classify_rays(
    rays: Rays, s: int, limits: RayLimits, polar: PolarGrid, breaks: Breaks, numbers: RayNumbers, found: SectorRays
) -> int:
    """Fill in what the rays of sector `s` hit, and the bins in which they are below clearance.

    A ray clears from the sensor to its end: up to and with the bin of a ground return, to two standard deviations
    before an obstacle, to the edge of a hole, and no further than it stays below `clearance`.

    Parameters
    ----------
    rays : Rays
    s : int
    limits : RayLimits
    polar : PolarGrid
    breaks : Breaks
    numbers : RayNumbers
    found : SectorRays
        Filled for the rays of the sector.

    Returns
    -------
    int
        First bin that no ray reaches.
    """
    first, row, profile, step = rays.starts[s], s >> ROW_BITS, s >> PROFILE_BITS, np.float32(polar.step)
    per_metre, margin = np.float32(1.0 / polar.step), np.float32(2.0 * numbers.range_noise)
    low, high = np.float32(numbers.obstacle_height), np.float32(numbers.clearance)
    below = np.float32(-numbers.below_ground)
    zero, one, bins, far_out = np.float32(0.0), np.float32(1.0), np.float32(polar.bins), np.float32(1e6)
    clearance, near, far, end = limits.clearance[row], 0, polar.bins, 0
    for n in range(rays.starts[s + 1] - first):
        slope, run, above = rays.table[first + n, 0], rays.table[first + n, 1], rays.table[first + n, 2]
        found.kind[n], found.start[n], found.stop[n] = NONE, 0, 0
        # This ray, and all that are flatter, are below clearance between these bins only
        while far > 0 and not clearance[far - 1] > slope:
            far -= 1
        while near < far and not clearance[near] > slope:
            near += 1
        if run < step:
            continue
        here = min(run * per_metre, bins)
        kind, reach = OBSTACLE, here
        if rays.point[first + n] < 0:
            kind = NO_RETURN
        elif above >= high:
            kind = OVERHEAD
        elif above > low:
            reach = min(max((run - margin) * per_metre, zero), bins)
            found.block[n] = int(reach)
        else:
            kind, reach = GROUND, min(here + one, bins)
            k = int(min(run * per_metre, far_out)) // breaks.width
            if k < breaks.kind.shape[1]:
                k &= 0x7FFFFFFF
                broken, height = breaks.kind[profile, k], slope * run
                if broken == STEP and height > breaks.limit[profile, k]:
                    kind = FACE_OF_STEP
                elif broken == HOLE and height < breaks.limit[profile, k]:
                    kind, reach = DEEP, np.float32(breaks.begin[profile, k])
            if above < below and kind != DEEP:
                continue
        stop = min(int(reach), far)
        while stop > near and not clearance[stop - 1] > slope:
            stop -= 1
        if kind == NO_RETURN:
            stop = _above_ground(limits.ground[row], slope, near, stop)
        found.kind[n], found.start[n], found.stop[n] = kind, near, stop
        end = max(end, stop)
    return end


@kernel
def _above_ground(ground: NDArray[np.float32], slope: np.float32, start: int, stop: int) -> int:
    """Return the first bin, from `start` to `stop`, in whose middle a ray is below the ground."""
    for k in range(start, stop):
        if slope < ground[k]:
            return k
    return stop
