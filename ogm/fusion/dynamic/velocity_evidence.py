"""Measured velocities of groups of cells as evidence for motion or rest, and against particles of other velocities."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.dynamic.cells import DynamicCells
from ogm.fusion.dynamic.particles import Particles
from ogm.jit import inline, kernel

HALF = np.float32(0.5)


class GroupVelocities(NamedTuple):
    """Measured velocities of groups of cells.

    Attributes
    ----------
    label : (nx, ny) int32
        Row of `rows` for every cell; row 0 is for cells without a measurement.
    rows : (groups + 1, 11) float32
        Velocity (2) [m/s]; information, its inverse covariance (xx, xy, yy) [s²/m²]; mean (2) and Cholesky factor
        (xx, yx, yy) of the velocity of births in the group; factor on the odds of dynamic to static.
    association : float32
        Probability that a group's particles caused the measurement, [0, 1].
    """

    label: NDArray[np.int32]
    rows: NDArray[np.float32]
    association: np.float32


def group_velocities(
    label: NDArray[np.int32],
    velocity: NDArray[np.floating],
    information: NDArray[np.floating],
    resting: NDArray[np.bool_],
    birth_speed: float,
    association: float,
    max_odds: float = 1.0,
) -> GroupVelocities:
    """Return the table of measured velocities that `resample` uses.

    Parameters
    ----------
    label : (nx, ny) int32
        Number of each cell's group, from 1 to G; 0 for none.
    velocity : (G, 2) float array
        Measured velocities [m/s].
    information : (G, 2, 2) float array
        Inverse covariance of the velocity [s²/m²], positive semi-definite: 0 along unmeasured directions, such as
        across the beam with Doppler, and 0 without a measurement.
    resting : (G,) bool
        Whether the measurement may be evidence of rest.
    birth_speed : float
        Standard deviation of each component of an unmeasured velocity [m/s].
    association : float
    max_odds : float
        Greatest factor on the odds of dynamic, at least 1. The least factor is 1, or 1 / max_odds for evidence of rest.

    Notes
    -----
    Velocities of births have the posterior N(0, birth_speed²) times N(velocity, information⁻¹). The factor on the odds
    is the likelihood of the measurement under this prior, divided by its likelihood under velocity 0.
    """
    count = len(velocity)
    rows = np.zeros((count + 1, 11), np.float32)
    rows[0, [7, 9, 10]] = birth_speed, birth_speed, 1
    if count:
        measured = np.where(np.isfinite(velocity), velocity, 0.0)
        cov = np.linalg.inv(np.eye(2) / max(birth_speed, 1e-3) ** 2 + information)
        factor = np.linalg.cholesky(cov)
        rows[1:, :2] = measured
        rows[1:, 2:5] = information.reshape(count, 4)[:, [0, 1, 3]]
        weighted = np.einsum("gij,gj->gi", information, measured)
        mean = np.einsum("gij,gj->gi", cov, weighted)
        rows[1:, 5:7] = mean
        rows[1:, 7:10] = factor.reshape(count, 4)[:, [0, 2, 3]]
        spread = np.linalg.slogdet(np.eye(2) + birth_speed**2 * information)[1]
        log_odds = 0.5 * ((weighted * mean).sum(axis=1) - spread)
        max_log_odds = math.log(max_odds)
        rows[1:, 10] = np.exp(np.clip(log_odds, np.where(resting, -max_log_odds, 0), max_log_odds))
    return GroupVelocities(label, rows, np.float32(association))


@kernel
def weigh_motion(cells: DynamicCells, groups: GroupVelocities, rows: tuple[int, int], dynamic: np.ndarray) -> None:
    """Divide occupied into static and dynamic by measured velocities: the group's factor multiplies the odds.

    Parameters
    ----------
    cells : DynamicCells
        Rows of static, surviving and born are changed.
    groups : GroupVelocities
    rows : (int, int)
        The rows [rows[0], rows[1]).
    dynamic : (nx,) float64
        Sums of the dynamic masses by row, updated.
    """
    for i in range(rows[0], rows[1]):
        for j in range(cells.free.shape[1]):
            odds = groups.rows[groups.label[i, j], 10]
            s, d = cells.static[i, j], cells.surviving[i, j] + cells.born[i, j]
            if odds != 1 and d > 0:
                factor = odds * (s + d) / (odds * d + s)
                cells.static[i, j] = max(s - (factor - np.float32(1)) * d, np.float32(0))
                cells.surviving[i, j] *= factor
                cells.born[i, j] *= factor
                dynamic[i] += (factor - np.float32(1)) * d


@kernel
def renew_particles(
    cells: DynamicCells, p: Particles, groups: GroupVelocities, threshold: float, rows: tuple[int, int]
) -> None:
    """Turn surviving mass into births if its particles do not explain the measurement: the group has accelerated.

    The share association threshold / (threshold + g) of a cell's surviving mass becomes births, with the mean g over
    its particles of the likelihood of the measured velocity, relative to its maximum.

    Parameters
    ----------
    cells : DynamicCells
        Rows of surviving and born are changed.
    p : Particles
        Predicted particles, sorted by cell.
    groups : GroupVelocities
    threshold : float
        Likelihood at which half of the mass becomes births, see `DynamicSettings.renewal_likelihood`.
    rows : (int, int)
        The rows [rows[0], rows[1]).
    """
    ny = cells.free.shape[1]
    for i in range(rows[0], rows[1]):
        for j in range(ny):
            first, last = p.start[i * ny + j], p.start[i * ny + j + 1]
            if groups.label[i, j] == 0 or first == last:
                continue
            g = groups.rows[groups.label[i, j]]
            if g[2] + g[4] > 0:
                likely = np.float32(0)
                for k in range(first, last):
                    likely += likelihood(p.vx[k] - g[0], p.vy[k] - g[1], g)
                renewed = groups.association * np.float32(threshold / (threshold + likely / (last - first)))
                cells.born[i, j] += renewed * cells.surviving[i, j]
                cells.surviving[i, j] *= np.float32(1) - renewed


@inline
def likelihood(dx: Any, dy: Any, g: Any) -> Any:
    """Return exp(-m² / 2) with the Mahalanobis distance m from the velocity of a group."""
    return np.exp(-HALF * (g[2] * dx * dx + np.float32(2) * g[3] * dx * dy + g[4] * dy * dy))
