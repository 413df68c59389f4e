"""Velocities that the dynamic map measures itself: groups of cells matched with earlier scans."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.dynamic.cells import DynamicCells
from ogm.fusion.dynamic.matching import MatchSettings, match_velocities
from ogm.fusion.dynamic.particles import Particles
from ogm.fusion.dynamic.resampling import mean_velocities
from ogm.fusion.dynamic.scan_history import ScanCells

SCAN_AGES = 0.1, 0.2, 0.3  # [s] ages of the scans with which cells are matched
NEW_REACH = 0.4  # [m] from a new cell to other cells of the same person
MIN_CONFLICT = 0.2  # of free -> occupied, from which a cell may hold a moving object


class MeasuredVelocities(NamedTuple):
    """Velocities of groups of cells.

    Attributes
    ----------
    label : (nx, ny) int32
        Number of each cell's group, from 1 to G; 0 for none.
    velocity : (G, 2) float64
        [m/s]
    information : (G, 2, 2) float64
        Inverse covariance of the velocity [s²/m²], positive semi-definite; 0 without a measurement.
    resting : (G,) bool
        Whether the measurement may be evidence of rest.
    """

    label: NDArray[np.int32]
    velocity: NDArray[np.float64]
    information: NDArray[np.float64]
    resting: NDArray[np.bool_]


def matched_velocities(
    now: ScanCells, cells: DynamicCells, particles: Particles, earlier: Sequence[ScanCells], resolution: float
) -> MeasuredVelocities:
    """Return the velocities of groups of cells, measured by matching with earlier scans.

    Parameters
    ----------
    now : ScanCells
    cells : DynamicCells
        Cells after the update by the scan. Only groups are matched that contain a cell with more dynamic than static
        mass, or a cell that was free and became occupied.
    particles : Particles
        Predicted particles. If the particles of a group agree, its match must agree with them.
    earlier : sequence of ScanCells
    resolution : float
        Side of a cell [m].
    """
    dynamic = cells.surviving > cells.static + cells.born
    candidates = now.occupied & (dynamic | (cells.to_occupied >= MIN_CONFLICT))
    prior = np.empty((*dynamic.shape, 2), np.float32)
    mean_velocities(particles, (now.occupied & dynamic).reshape(-1), prior.reshape(-1, 2))
    matches = match_velocities(now, candidates, earlier, resolution, MatchSettings(), prior)
    measured = matches.valid | matches.resting
    information = np.zeros((len(measured), 2, 2))
    information[measured] = np.linalg.inv(matches.covariance[measured])
    label = _without_new_cells(matches.label, matches.resting, earlier, int(NEW_REACH / resolution + 1e-6))
    return MeasuredVelocities(label, matches.velocity, information, matches.resting)


def _without_new_cells(
    label: NDArray[np.int32], resting: NDArray[np.bool_], earlier: Sequence[ScanCells], reach: int
) -> NDArray[np.int32]:
    """Remove cells that may be new from groups at rest: the group of a wall includes a person who walks along it.

    A cell is new if an earlier scan measured it as clear, or if the newest of them did not measure it. Cells within
    `reach` [cells] of a new cell are removed too.
    """
    x, y = np.nonzero(label)
    at_rest = resting[label[x, y] - 1]
    x, y = x[at_rest], y[at_rest]
    new = np.any([~(scan.occupied[x, y] | scan.hidden[x, y]) for scan in earlier], axis=0)
    new |= min(earlier, key=lambda scan: scan.age).hidden[x, y]
    near = np.zeros(np.add(label.shape, 2 * reach), bool)
    for i, j in np.ndindex(2 * reach + 1, 2 * reach + 1):
        near[x[new] + i, y[new] + j] = True
    left_out = near[x + reach, y + reach]
    label[x[left_out], y[left_out]] = 0
    return label
