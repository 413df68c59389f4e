"""Kernels that draw the particles of each cell anew, by measured velocities of groups of cells where there are any."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.dynamic.cells import DynamicCells
from ogm.fusion.dynamic.hashed_noise import UNIT, hashed, index
from ogm.fusion.dynamic.particles import Particles, Step
from ogm.jit import inline, kernel

HALF = np.float32(0.5)
_CELL = np.uint64(0x5851F42D4C957F2D)  # other random numbers for cells than for particles


class GroupVelocities(NamedTuple):
    """Measured velocities of groups of cells: matched, or any others.

    Attributes
    ----------
    label : (nx, ny) int32
        Row of `rows` for every cell; row 0, which measures nothing, where there is no measurement.
    rows : (groups + 1, 11) float32
        Velocity (2) [m/s] and information, its inverse covariance (xx, xy, yy) [s²/m²]; mean (2) and Cholesky factor
        (xx, yx, yy) of the velocity of particles that are born in the group; factor on the odds of dynamic against
        static.
    association : float32
        Probability that a group's particles made the measurement, [0, 1].
    """

    label: NDArray[np.int32]
    rows: NDArray[np.float32]
    association: np.float32


class Moments(NamedTuple):
    """Mean and covariance (xx, xy, yy) of the velocity in each cell, (nx, ny, 2) and (nx, ny, 3) float32."""

    mean: NDArray[np.float32]
    covariance: NDArray[np.float32]


def group_velocities(
    label: NDArray[np.int32],
    velocity: NDArray[np.floating],
    information: NDArray[np.floating],
    resting: NDArray[np.bool_],
    birth_speed: float,
    association: float,
    max_odds: float = 1.0,
) -> GroupVelocities:
    """Return what `resample` needs to know of measured velocities.

    Parameters
    ----------
    label : (nx, ny) int32
        Number of each cell's group, from 1 to G; 0 for none.
    velocity : (G, 2) float array
        [m/s].
    information : (G, 2, 2) float array
        The inverse covariance of the velocity [s²/m²], positive semi-definite: 0 along directions that are not
        measured, as all but the radial one by Doppler, and 0 where nothing is measured.
    resting : (G,) bool
        Whether the measurement may be evidence of rest.
    birth_speed : float
        Standard deviation of each component of a velocity that is not measured [m/s].
    association : float
    max_odds : float
        Greatest factor on the odds of dynamic, at least 1. The least is 1, or 1 / max_odds for evidence of rest.

    Notes
    -----
    Velocities of births have the posterior N(0, birth_speed²) times N(velocity, information⁻¹). The factor on the odds
    is the likelihood of the measurement if the velocity is of that prior over that if it is 0.
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
        most = math.log(max_odds)
        rows[1:, 10] = np.exp(np.clip(log_odds, np.where(resting, -most, 0), most))
    return GroupVelocities(label, rows, np.float32(association))


@kernel
def weigh_motion(cells: DynamicCells, groups: GroupVelocities, rows: tuple[int, int], dynamic: np.ndarray) -> None:
    """Divide what is occupied anew where a velocity was measured: the odds of dynamic times the factor of the group.

    Parameters
    ----------
    cells : DynamicCells
        Rows of static, surviving and born are changed.
    groups : GroupVelocities
    rows : (int, int)
        The rows [rows[0], rows[1]).
    dynamic : (nx,) float64
        Sums of the masses of dynamic, which follow.
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
    cells: DynamicCells, p: Particles, groups: GroupVelocities, change: float, rows: tuple[int, int]
) -> None:
    """Turn what survives into births where its particles cannot have made the measurement: the group has accelerated.

    Of a cell's surviving mass the share association change / (change + g) is born anew, where g is the mean over its
    particles of the likelihood of the measured velocity, relative to that of the most likely particle.

    Parameters
    ----------
    cells : DynamicCells
        Rows of surviving and born are changed.
    p : Particles
        Predicted and sorted.
    groups : GroupVelocities
    change : float
        See `DynamicSettings`.
    rows : (int, int)
        The rows [rows[0], rows[1]).
    """
    ny = cells.free.shape[1]
    for i in range(rows[0], rows[1]):
        for j in range(ny):
            group, first, last = groups.label[i, j], p.start[i * ny + j], p.start[i * ny + j + 1]
            g = groups.rows[group]
            if last > first and g[2] + g[4] > 0:
                likely = np.float32(0)
                for k in range(first, last):
                    likely += _likelihood(p.vx[k] - g[0], p.vy[k] - g[1], g)
                renewed = groups.association * np.float32(change / (change + likely / (last - first)))
                cells.born[i, j] += renewed * cells.surviving[i, j]
                cells.surviving[i, j] *= np.float32(1) - renewed


@inline
def _likelihood(dx: Any, dy: Any, g: Any) -> Any:
    """Return exp(-m² / 2), m being the Mahalanobis distance from the velocity of a group."""
    return np.exp(-HALF * (g[2] * dx * dx + np.float32(2) * g[3] * dx * dy + g[4] * dy * dy))


@kernel
def mean_velocities(p: Particles, wanted: np.ndarray, out: np.ndarray) -> None:
    """Fill (cells, 2) with the mean velocity of each cell's particles; NaN where there are none, or it is not wanted.

    Parameters
    ----------
    p : Particles
        Sorted by cell.
    wanted : (cells,) bool
    out : (cells, 2) float32
    """
    for c in range(len(wanted)):
        first, last = p.start[c], p.start[c + 1]
        vx = vy = np.float32(0)
        if wanted[c]:
            for k in range(first, last):
                vx += p.vx[k]
                vy += p.vy[k]
            n = np.float32(last - first)
            out[c, 0], out[c, 1] = vx / n, vy / n  # 0 / 0 is NaN
        else:
            out[c, 0], out[c, 1] = np.nan, np.nan


@kernel
def resample(
    p: Particles,
    cells: tuple[int, int],
    survivors: np.ndarray,
    groups: GroupVelocities,
    step: Step,
    normals: np.ndarray,
    out: Particles,
    moments: Moments,
) -> None:
    """Draw each cell's particles anew: systematically from its own, and the rest as births.

    Survivors are drawn with equal chances, in cells of a group by ``1 - a + a g``, with the probability of association
    a and the likelihood g of the measured velocity. Births lie uniformly in the cell; with probability a their velocity
    is drawn from the group's normal distribution, else from that of cells without a group.

    Parameters
    ----------
    p : Particles
        Predicted and sorted.
    cells : (int, int)
        The cells [cells[0], cells[1]).
    survivors : (nx * ny,) int32
        How many of a cell's new particles are drawn from its old ones.
    groups : GroupVelocities
    step : Step
    normals : (4096,) float32
    out : Particles
        `start` is read, the rest is filled.
    moments : Moments
        Of the cells' old particles, by the same weights: filled where there are any.
    """
    ny = step.shape[1]
    label, rows = groups.label.reshape(-1), groups.rows
    mean, covariance = moments.mean.reshape(-1, 2), moments.covariance.reshape(-1, 3)
    weight = np.empty(256, np.float32)
    for c in range(cells[0], cells[1]):
        first, last, at = p.start[c], p.start[c + 1], out.start[c]
        n, kept, end = last - first, survivors[c], out.start[c + 1]
        if n == 0 and at == end:
            continue
        h = hashed(np.uint64(c), ~step.key ^ _CELL)
        group = label[c]
        a = groups.association if group > 0 else np.float32(0)
        if n > weight.size:
            weight = np.empty(2 * n, np.float32)
        total = _weigh(p, first, n, a, rows[group], weight)
        _moments(p, first, n, weight, total, mean[c], covariance[c])
        if kept > 0:
            offset = (np.float32(index(h, 0)) + HALF) * UNIT
            _draw(p, (first, n), weight, total, offset, out, (at, kept))
        i, j = np.float32(c // ny), np.float32(c % ny)
        for k in range(at + kept, end):
            h = hashed(np.uint64(k), ~step.key)
            g = rows[group if np.float32(index(h, 4)) * UNIT < a else 0]
            s, t = normals[index(h, 0)], normals[index(h, 1)]
            out.x[k] = (i + (np.float32(index(h, 2)) + HALF) * UNIT) * step.resolution
            out.y[k] = (j + (np.float32(index(h, 3)) + HALF) * UNIT) * step.resolution
            out.vx[k] = g[5] + g[7] * s
            out.vy[k] = g[6] + g[8] * s + g[9] * t


@kernel
def _weigh(p: Any, first: int, n: int, a: Any, g: Any, weight: Any) -> Any:
    """Fill the weights of a cell's particles, and return their sum."""
    total = np.float32(0)
    for k in range(n if a > 0 else 0):
        weight[k] = np.float32(1) - a + a * _likelihood(p.vx[first + k] - g[0], p.vy[first + k] - g[1], g)
        total += weight[k]
    if total > 0:
        return total
    for k in range(n):  # nothing is measured, or nothing that a particle can have caused
        weight[k] = 1
    return np.float32(n)


@kernel
def _moments(p: Any, first: int, n: int, weight: Any, total: Any, mean: Any, covariance: Any) -> None:
    if n == 0 or total <= 0:
        return
    x0, y0 = p.vx[first], p.vy[first]  # near the mean, so that float32 does not cancel
    sx = sy = sxx = sxy = syy = np.float32(0)
    for k in range(n):
        w, dx, dy = weight[k], p.vx[first + k] - x0, p.vy[first + k] - y0
        sx += w * dx
        sy += w * dy
        sxx += w * dx * dx
        sxy += w * dx * dy
        syy += w * dy * dy
    sx, sy = sx / total, sy / total
    mean[0], mean[1] = x0 + sx, y0 + sy
    covariance[0] = max(sxx / total - sx * sx, np.float32(0))
    covariance[1] = sxy / total - sx * sy
    covariance[2] = max(syy / total - sy * sy, np.float32(0))


@kernel
def _draw(p: Any, span: Any, weight: Any, total: Any, offset: Any, out: Any, target: Any) -> None:
    """Systematic resampling within a cell: `target` is the first new particle and their number."""
    first, n = span
    at, kept = target
    spacing = total / np.float32(kept)
    k, summed = 0, weight[0]
    for m in range(kept):
        wanted = (np.float32(m) + offset) * spacing
        while summed <= wanted and k < n - 1:
            k += 1
            summed += weight[k]
        out.x[at + m], out.y[at + m] = p.x[first + k], p.y[first + k]
        out.vx[at + m], out.vy[at + m] = p.vx[first + k], p.vy[first + k]
