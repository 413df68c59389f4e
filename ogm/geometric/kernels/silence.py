"""Reliability of beams without echo, estimated from the beams of a scan that point at the ground."""

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import PolarGrid, RayLimits, Rays
from ogm.geometric.kernels.polar import ROW_BITS
from ogm.jit import kernel

__all__ = ["silence_reliability"]


@kernel
def silence_reliability(rays: Rays, limits: RayLimits, polar: PolarGrid) -> NDArray[np.float32]:
    """Return the reliability of beams without echo in each polar bin.

    A beam that points at the ground meets a surface at a distance r. Without an echo, a surface at r was not seen. An
    echo from r, of the ground or of an obstacle, is a surface that was seen. Let q(r) be the chance that a surface at r
    gives no echo. Air returns a share exp(-2 s r) of a beam's light, for an absorption s, so that q does not fall with
    r. The likelihood

        prod over surfaces not seen of q(r) * prod over surfaces seen of (1 - q(r)),      q(r) <= q(r') for r < r',

    is greatest for the monotone regression of the shares in the bins (Ayer et al. 1955). It pools neighbours until the
    share does not fall. If a surface is seen with a chance of 0.5, the absence of an echo has no information. The
    reliability is

        max(P(seen) - P(not seen), 0) = max(1 - 2 q(r), 0).

    Parameters
    ----------
    rays : Rays
    limits : RayLimits
    polar : PolarGrid

    Returns
    -------
    (bins,) float32
        In [0, 1], falling with distance; 1 up to the first surface that was not seen. Bins without surfaces have the
        reliability of the next bin with surfaces. The last bin with surfaces also sets all bins beyond.
    """
    seen, lost = np.zeros(polar.bins, np.int64), np.zeros(polar.bins, np.int64)
    _count_surfaces(rays, limits, polar, seen, lost)
    reliability = np.ones(polar.bins, np.float32)
    # Pool neighbouring bins until the lost share does not fall; each pool has a first bin, a lost count and a total
    begin, lost_counts, totals = np.empty(polar.bins, np.int64), np.empty(polar.bins), np.empty(polar.bins)
    pools, empty = 0, 0  # number of bins without surfaces before the current bin
    for k in range(polar.bins):
        if seen[k] + lost[k] == 0:
            empty += 1
            continue
        begin[pools], lost_counts[pools], totals[pools] = k - empty, lost[k], lost[k] + seen[k]
        empty = 0
        while pools > 0 and lost_counts[pools - 1] * totals[pools] >= lost_counts[pools] * totals[pools - 1]:
            lost_counts[pools - 1] += lost_counts[pools]
            totals[pools - 1] += totals[pools]
            pools -= 1
        pools += 1
    for n in range(pools):
        end = begin[n + 1] if n + 1 < pools else polar.bins
        reliability[begin[n] : end] = max(1.0 - 2.0 * lost_counts[n] / totals[n], 0.0)
    return reliability


@kernel
def _count_surfaces(
    rays: Rays, limits: RayLimits, polar: PolarGrid, seen: NDArray[np.int64], lost: NDArray[np.int64]
) -> None:
    """Count the echoes in each bin, and the beams without echo that meet the ground in it.

    Echoes from beyond the grid count in the last bin. Ground beyond `max_range` does not count.
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
            # Rays are sorted by slope: the next ray meets the ground no nearer
            while k < polar.bins and slope >= ground[k & 0x7FFF]:
                k += 1
            if k < polar.bins and k < int(min(run, np.float32(1e6))):
                lost[k & 0x7FFF] += 1
