"""The measurement of velocities that the dynamic map makes itself: groups of cells matched with earlier scans."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.dynamic.cells import DynamicCells
from ogm.fusion.dynamic.matching import MatchSettings, match_velocities
from ogm.fusion.dynamic.particles import Particles
from ogm.fusion.dynamic.resampling import mean_velocities
from ogm.fusion.dynamic.scan_history import EarlierScan, Extent

SCAN_AGES = 0.1, 0.2, 0.3  # [s] of the earlier scans with which cells are matched
MIN_CONFLICT = 0.2  # of free -> occupied, at which a cell may hold something that moves


class MeasuredVelocities(NamedTuple):
    """Velocities of groups of cells.

    Attributes
    ----------
    label : (nx, ny) int32
        Number of each cell's group, from 1 to G; 0 for none.
    velocity : (G, 2) float64
        [m/s]
    information : (G, 2, 2) float64
        Inverse covariance of the velocity [s²/m²], positive semi-definite; 0 where nothing is measured.
    """

    label: NDArray[np.int32]
    velocity: NDArray[np.float64]
    information: NDArray[np.float64]


def matched_velocities(
    occupied: NDArray[np.bool_],
    cells: DynamicCells,
    particles: Particles,
    earlier: Sequence[EarlierScan],
    extent: Extent,
    resolution: float,
) -> MeasuredVelocities:
    """Return the velocities of groups of cells that match earlier scans.

    A group that the border of the measurement grid cuts, now or in an earlier scan, has no velocity: where it seems to
    end moves with the vehicle.

    Parameters
    ----------
    occupied : (nx, ny) bool
        Cells that the scan measures as occupied.
    cells : DynamicCells
        After the update by the scan. Only groups are matched with a cell that holds more dynamic than static, or that
        was free and became occupied.
    particles : Particles
        Predicted: a match must agree with the particles of its group, where these agree with each other.
    earlier : sequence of EarlierScan
    extent : Extent
        Where the grid of this scan lies in the window.
    resolution : float
        Side of a cell [m].
    """
    settings = MatchSettings()
    dynamic = cells.surviving > cells.static + cells.born
    candidates = occupied & (dynamic | (cells.to_occupied >= MIN_CONFLICT))
    prior = np.empty((*occupied.shape, 2), np.float32)
    mean_velocities(particles, (occupied & dynamic).reshape(-1), prior.reshape(-1, 2))
    matches = match_velocities(occupied, candidates, [scan[:2] for scan in earlier], resolution, settings, prior)
    grids = [(extent,), *(scan.extents for scan in earlier)]
    valid = matches.valid & ~_cut(matches.label, len(matches.valid), grids, settings.link / resolution)
    information = np.zeros((len(valid), 2, 2))
    information[valid] = np.linalg.inv(matches.covariance[valid])
    return MeasuredVelocities(matches.label, matches.velocity, information)


def _cut(label: NDArray[np.int32], groups: int, grids: Sequence[Sequence[Extent]], margin: float) -> NDArray[np.bool_]:
    """Return which groups have a cell that the grids of one of the scans do not hold, with a margin [cells]; (G,)."""
    cells = np.nonzero(label)
    outside = np.zeros(len(cells[0]), bool)
    for extents in grids:
        outside |= ~np.any([extent.holds(np.stack(cells), margin) for extent in extents], axis=0)
    return np.bincount(label[cells][outside], minlength=groups + 1)[1:] > 0
