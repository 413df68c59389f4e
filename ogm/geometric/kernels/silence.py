"""How far beams without echo tell anything: estimated from those of the same scan that point at the ground."""

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import PolarGrid, RayLimits, Rays
from ogm.geometric.kernels.polar import ROW_BITS
from ogm.jit import kernel

__all__ = ["silence_reliability"]


@kernel
def silence_reliability(rays: Rays, limits: RayLimits, polar: PolarGrid) -> NDArray[np.float32]:
    """Return how much the silence of a beam tells about each polar bin.

    A beam that points at the ground has a surface to answer it, at the distance r where it meets the ground. If it
    gives no echo, a surface at r was not seen; an echo from r, whatever of, is a surface that was. Let q(r) be the
    chance that a surface at r gives no echo. Air lets exp(-2 s r) of a beam's light come back, and less with distance
    the more it absorbs, so that q does not fall with r. The likelihood

        prod over surfaces not seen of q(r) * prod over surfaces seen of (1 - q(r)),      q(r) <= q(r') for r < r',

    is greatest for the monotone regression of the shares in the bins (Ayer et al. 1955): neighbours are pooled until
    the share falls nowhere. Where a surface is as likely seen as not, silence tells nothing; the reliability is

        max(P(seen) - P(not seen), 0) = max(1 - 2 q(r), 0).

    Parameters
    ----------
    rays : Rays
    limits : RayLimits
    polar : PolarGrid

    Returns
    -------
    (bins,) float32
        In [0, 1], falling with distance; 1 up to the first surface that was not seen, and for a scan without such.
        Bins without surfaces are as reliable as the next that has some; the last is also for all beyond.
    """
    seen, lost = np.zeros(polar.bins, np.int64), np.zeros(polar.bins, np.int64)
    _count_surfaces(rays, limits, polar, seen, lost)
    reliability = np.ones(polar.bins, np.float32)
    # Pool neighbouring bins until the share that is lost falls nowhere: begin, lost and all of each pool
    begin, few, all_ = np.empty(polar.bins, np.int64), np.empty(polar.bins), np.empty(polar.bins)
    pools, empty = 0, 0  # bins without surfaces before the next that has some
    for k in range(polar.bins):
        if seen[k] + lost[k] == 0:
            empty += 1
            continue
        begin[pools], few[pools], all_[pools] = k - empty, lost[k], lost[k] + seen[k]
        empty = 0
        while pools > 0 and few[pools - 1] * all_[pools] >= few[pools] * all_[pools - 1]:
            few[pools - 1] += few[pools]
            all_[pools - 1] += all_[pools]
            pools -= 1
        pools += 1
    for n in range(pools):
        end = begin[n + 1] if n + 1 < pools else polar.bins
        reliability[begin[n] : end] = max(1.0 - 2.0 * few[n] / all_[n], 0.0)
    return reliability


@kernel
def _count_surfaces(
    rays: Rays, limits: RayLimits, polar: PolarGrid, seen: NDArray[np.int64], lost: NDArray[np.int64]
) -> None:
    """Count the surfaces in each bin that gave an echo, and those of the ground that a beam met without one.

    Echoes from beyond the grid count in the last bin; ground beyond `max_range` is not expected to give one.
    """
    per_metre, last = np.float32(1.0 / polar.step), np.float32(polar.bins - 1)
    for s in range(polar.sectors):
        ground, k = limits.ground[s >> ROW_BITS], 0
        for n in range(rays.starts[s], rays.starts[s + 1]):
            slope, run = rays.slope[n], rays.run[n] * per_metre
            if rays.point[n] >= 0:
                if run >= 1:
                    seen[int(min(run, last)) & 0x7FFF] += 1
                continue
            # Rays are sorted by slope: the next meets the ground no nearer
            while k < polar.bins and slope >= ground[k & 0x7FFF]:
                k += 1
            if k < polar.bins and k < int(min(run, np.float32(1e6))):
                lost[k & 0x7FFF] += 1
