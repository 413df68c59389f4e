"""Causes of the unknown cells of a scan, from the beams of `RayISM`, `PlanarISM` and `RadarISM`."""

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
CONTRADICTED_MASS = 0.25  # least mass of occupied of a cell that is unknown because other beams contradict its echo


class SectorTrace(NamedTuple):
    """Masses of a scan, and the causes of unknown cells by sector around the sensor.

    Attributes
    ----------
    grid : EvidentialGrid
    mount : Mount
    mass : (nx, ny, 2) float32
        Masses of this model; `grid` may hold several models combined.
    polar : PolarGrid
        S sectors.
    ends : (S, 2) float
        A sector has three parts. Ranges at which the first and the second part end [m].
    causes : (S, 3) uint8
        Cause of the unknown cells of each part, `UnknownCause`.
    contradicted_mass : float
        Least mass of occupied of an unknown cell with contradiction as its cause; infinity for no such cells.
    """

    grid: EvidentialGrid
    mount: Mount
    mass: NDArray[np.float32]
    polar: PolarGrid
    ends: NDArray[np.float64]
    causes: NDArray[np.uint8]
    contradicted_mass: float = CONTRADICTED_MASS


def unknown_causes(trace: RayTrace | SectorTrace) -> NDArray[np.uint8]:
    """Return the cause of each unknown cell of a scan.

    Parameters
    ----------
    trace : RayTrace or SectorTrace
        Result of `RayISM.trace`, `PlanarISM.trace` or `RadarISM.trace`. If `trace.grid` holds several models combined,
        its masses decide which cells are unknown, and the rays of the trace give the cause.

    Returns
    -------
    (nx, ny) uint8
        Values of `ogm.UnknownCause`.
    """
    if isinstance(trace, RayTrace):
        causes = polar_causes(trace.rays, trace.limits, trace.polar, trace.numbers, _view(trace))
    else:
        bins = trace.polar.bins
        ends = np.searchsorted((np.arange(bins) + 0.5) * trace.polar.step, trace.ends)  # the first bin beyond
        counts = np.diff(ends, prepend=0, append=bins, axis=1)
        causes = np.repeat(trace.causes.ravel(), counts.ravel()).reshape(-1, bins)
    contradicted = CONTRADICTED_MASS if isinstance(trace, RayTrace) else trace.contradicted_mass
    return cell_causes(trace.grid.mass, trace.mass, causes, trace.polar, contradicted)


def _view(trace: RayTrace) -> NDArray[np.float32]:
    """Return the slopes of the lowest and the highest ray around each sector, (sectors, 2)."""
    starts, sectors = trace.rays.starts, trace.polar.sectors
    seen = np.flatnonzero(np.diff(starts))
    wedge = np.arange(sectors) * WEDGES // sectors
    low, high = np.full(WEDGES, np.inf, np.float32), np.full(WEDGES, -np.inf, np.float32)
    np.minimum.at(low, wedge[seen], trace.rays.slope[starts[seen]])
    np.maximum.at(high, wedge[seen], trace.rays.slope[starts[seen + 1] - 1])
    low = np.minimum(low, np.minimum(np.roll(low, 1), np.roll(low, -1)))
    high = np.maximum(high, np.maximum(np.roll(high, 1), np.roll(high, -1)))
    return np.stack([low, high], axis=-1)[wedge]
