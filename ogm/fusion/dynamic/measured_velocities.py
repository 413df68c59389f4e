"""The measurement of velocities that the dynamic map makes itself: groups of cells matched with earlier scans."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.dynamic.cells import DynamicCells
from ogm.fusion.dynamic.matching import MatchSettings, match_velocities
from ogm.fusion.dynamic.particles import Particles
from ogm.fusion.dynamic.resampling import mean_velocities

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
    earlier: list[tuple[NDArray[np.bool_], float]],
    resolution: float,
    settings: MatchSettings | None = None,
) -> MeasuredVelocities:
    """Return the velocities of groups of cells that match earlier scans.

    Parameters
    ----------
    occupied : (nx, ny) bool
        Cells that the scan measures as occupied.
    cells : DynamicCells
        After the update by the scan. Only groups are matched with a cell that holds more dynamic than static, or that
        was free and became occupied.
    particles : Particles
        Predicted: a match must agree with the particles of its group, where these agree with each other.
    earlier : list of ((nx, ny) bool, float)
        Occupied cells of earlier scans, and their ages [s].
    resolution : float
        Side of a cell [m].
    settings : MatchSettings, optional
    """
    dynamic = cells.surviving > cells.static + cells.born
    candidates = occupied & (dynamic | (cells.to_occupied >= MIN_CONFLICT))
    prior = np.empty((*occupied.shape, 2), np.float32)
    mean_velocities(particles, (occupied & dynamic).reshape(-1), prior.reshape(-1, 2))
    matches = match_velocities(occupied, candidates, earlier, resolution, settings, prior)
    information = np.zeros((len(matches.valid), 2, 2))
    information[matches.valid] = np.linalg.inv(matches.covariance[matches.valid])
    return MeasuredVelocities(matches.label, matches.velocity, information)
