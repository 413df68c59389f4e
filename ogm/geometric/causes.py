"""Why cells of one scan are unknown: what `RayISM`, `PlanarISM` and `RadarISM` know of their beams, cell by cell."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import PolarGrid
from ogm.geometric.kernels.causes import WEDGES, cell_causes, polar_causes
from ogm.geometric.ray import RayTrace
from ogm.grid import EvidentialGrid
from ogm.scan import Mount

__all__ = ["SECTOR", "SectorTrace", "unknown_causes"]

SECTOR = 2 * math.pi / 1024  # [rad] width of the sectors of a `SectorTrace`
WEAKEST = 0.25  # mass of occupied of an echo that counts half, as others contradict it, and is no known cell


class SectorTrace(NamedTuple):
    """The masses of a scan, and why each sector around the sensor ends where it does.

    Attributes
    ----------
    grid : EvidentialGrid
    mount : Mount
    mass : (nx, ny, 2) float32
        Masses of the model alone; `grid` may hold several models combined.
    polar : PolarGrid
        S sectors.
    ends : (S, 2) float
        Ranges at which the first of three parts of a sector ends, and the second [m].
    causes : (S, 3) uint8
        Why cells of these parts are unknown, `UnknownCause`.
    weakest : float
        Mass of occupied from which an unknown cell is so by contradiction.
    """

    grid: EvidentialGrid
    mount: Mount
    mass: NDArray[np.float32]
    polar: PolarGrid
    ends: NDArray[np.float64]
    causes: NDArray[np.uint8]
    weakest: float = WEAKEST


def unknown_causes(trace: RayTrace | SectorTrace) -> NDArray[np.uint8]:
    """Return why each cell of a scan is unknown.

    Parameters
    ----------
    trace : RayTrace or SectorTrace
        Result of `RayISM.trace`, `PlanarISM.trace` or `RadarISM.trace`. Where `trace.grid` holds the masses of several
        models, these decide which cells are unknown, and the rays why.

    Returns
    -------
    (nx, ny) uint8
        `ogm.UnknownCause`.
    """
    if isinstance(trace, RayTrace):
        causes = polar_causes(trace.rays, trace.limits, trace.polar, trace.numbers, _view(trace))
    else:
        bins = trace.polar.bins
        ends = np.searchsorted((np.arange(bins) + 0.5) * trace.polar.step, trace.ends)  # the first bin beyond
        counts = np.diff(ends, prepend=0, append=bins, axis=1)
        causes = np.repeat(trace.causes.ravel(), counts.ravel()).reshape(-1, bins)
    weakest = WEAKEST if isinstance(trace, RayTrace) else trace.weakest
    return cell_causes(trace.grid.mass, trace.mass, causes, trace.polar, weakest)


def _view(trace: RayTrace) -> NDArray[np.float32]:
    """Return the slopes of the lowest and of the highest ray around each sector, (sectors, 2)."""
    starts, sectors = trace.rays.starts, trace.polar.sectors
    seen = np.flatnonzero(np.diff(starts))
    wedge = np.arange(sectors) * WEDGES // sectors
    low, high = np.full(WEDGES, np.inf, np.float32), np.full(WEDGES, -np.inf, np.float32)
    np.minimum.at(low, wedge[seen], trace.rays.slope[starts[seen]])
    np.maximum.at(high, wedge[seen], trace.rays.slope[starts[seen + 1] - 1])
    low = np.minimum(low, np.minimum(np.roll(low, 1), np.roll(low, -1)))
    high = np.maximum(high, np.maximum(np.roll(high, 1), np.roll(high, -1)))
    return np.stack([low, high], axis=-1)[wedge]
