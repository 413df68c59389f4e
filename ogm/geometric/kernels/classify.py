"""Class of each ray of a sector, and its bins below clearance."""

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
    """Fill in the classes of the rays of sector `s`, and their bins below clearance.

    A ray clears from the sensor to its end, while it stays below `clearance`. The end is the bin of a ground return,
    two standard deviations before an obstacle, or the edge of a hole.

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
    first, row, profile = rays.starts[s] & 0x7FFFFFFF, s >> ROW_BITS, s >> PROFILE_BITS
    _find_ends(rays, first, rays.starts[s + 1], polar, numbers, found)
    if breaks.broken[profile]:
        _find_broken(rays, first, rays.starts[s + 1], profile, polar, breaks, numbers, found)
    ground, clearance, near, far, meets, end = limits.ground[row], limits.clearance[row], 0, polar.bins, 0, 0
    for n in range(rays.starts[s + 1] - first):
        kind = found.kind[n]
        if kind == NONE:
            continue
        slope = rays.slope[first + n]
        # This ray and all following rays are below clearance between these bins only
        if far > 0 and not clearance[(far - 1) & 0x7FFF] > slope:
            far = _last_below(clearance, far, slope)
        while near < far and not clearance[near & 0x7FFF] > slope:
            near += 1
        stop = min(found.stop[n], far)
        while stop > near and not clearance[(stop - 1) & 0x7FFF] > slope:
            stop -= 1
        if kind == NO_RETURN:  # up to the ground, which the following rays meet no nearer
            meets = max(meets, near)
            while meets < polar.bins and slope >= ground[meets & 0x7FFF]:
                meets += 1
            stop = min(stop, meets)
        found.start[n], found.stop[n] = near, stop
        end = max(end, stop)
    return end


@kernel
def _last_below(clearance: NDArray[np.float32], far: int, slope: np.float32) -> int:
    """Return the end of the last bin before `far` in which a ray is below clearance; 0 if there is no such bin."""
    while far >= 8:  # groups of eight for the vector units
        begin, below = (far - 8) & 0x7FFF, 0
        for k in range(8):
            below += int(clearance[begin + k] > slope)
        if below > 0:
            break
        far -= 8
    while far > 0 and not clearance[(far - 1) & 0x7FFF] > slope:
        far -= 1
    return far


@kernel
def _find_ends(rays: Rays, first: int, last: int, polar: PolarGrid, numbers: RayNumbers, found: SectorRays) -> None:
    """Fill in classes and end bins of rays over ground without breaks; `block` gets the end bin, too."""
    first, step, per_metre = first & 0x7FFFFFFF, np.float32(polar.step), np.float32(1.0 / polar.step)
    noise, growth = np.float32(numbers.range_noise), np.float32(numbers.noise_growth)
    low, high = np.float32(numbers.obstacle_height), np.float32(numbers.clearance)
    below = np.float32(-numbers.below_ground)
    zero, one, two, bins = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(polar.bins)
    for n in range(last - first):
        run, above = rays.run[first + n], rays.above[first + n]
        here = min(run * per_metre, bins)
        before = min(max((run - two * (noise + growth * run * run)) * per_metre, zero), bins)
        kind = NONE if above < below else GROUND
        kind = OBSTACLE if above > low else kind
        kind = OVERHEAD if above >= high else kind
        kind = NO_RETURN if rays.point[first + n] < 0 else kind
        kind = NONE if run < step else kind
        reach = min(here + one, bins) if kind == GROUND else here
        stop = np.int32(before if kind == OBSTACLE else reach)
        found.kind[n], found.start[n], found.stop[n], found.block[n] = kind, 0, stop, stop


@kernel
def _find_broken(
    rays: Rays,
    first: int,
    last: int,
    profile: int,
    polar: PolarGrid,
    breaks: Breaks,
    numbers: RayNumbers,
    found: SectorRays,
) -> None:
    """Reclassify the rays that hit the face of a step or end in a hole."""
    step, per_metre, far_out = np.float32(polar.step), np.float32(1.0 / polar.step), np.float32(1e6)
    low, below = np.float32(numbers.obstacle_height), np.float32(-numbers.below_ground)
    first, inverse = first & 0x7FFFFFFF, 2**32 // breaks.width + 1
    for n in range(last - first):
        slope, run, above = rays.slope[first + n], rays.run[first + n], rays.above[first + n]
        k = ((int(min(run * per_metre, far_out)) * inverse) >> 32) & 0x7FFFFFFF  # divided by the width
        if (rays.point[first + n] < 0) | (run < step) | (above > low) | (k >= breaks.kind.shape[1]):
            continue
        broken, height = breaks.kind[profile, k], slope * run
        if broken == STEP and height > breaks.limit[profile, k] and above >= below:
            found.kind[n] = FACE_OF_STEP
        elif broken == HOLE and height < breaks.limit[profile, k]:
            found.kind[n], found.stop[n] = DEEP, breaks.begin[profile, k]
