"""Kernels that draw the new particles of each cell, by measured velocities of its group if there are any."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.dynamic.hashed_noise import UNIT, hashed, index
from ogm.fusion.dynamic.particles import Particles, Step
from ogm.fusion.dynamic.velocity_evidence import HALF, GroupVelocities, likelihood
from ogm.jit import kernel

_CELL = np.uint64(0x5851F42D4C957F2D)  # makes random numbers of cells differ from random numbers of particles


class Moments(NamedTuple):
    """Mean and covariance (xx, xy, yy) of the velocity in each cell, (nx, ny, 2) and (nx, ny, 3) float32."""

    mean: NDArray[np.float32]
    covariance: NDArray[np.float32]


@kernel
def mean_velocities(p: Particles, wanted: np.ndarray, out: np.ndarray) -> None:
    """Fill (cells, 2) with the mean velocity of each wanted cell's particles; NaN without particles and elsewhere.

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
    """Draw each cell's new particles: systematically from its old ones, and the rest as births.

    Survivors are drawn with equal weights, in cells of a group with ``1 - a + a g``, with the probability of
    association a and the likelihood g of the measured velocity. Births are uniform in the cell. With probability a
    their velocity is drawn from the group's normal distribution, else from the distribution for cells without a group.

    Parameters
    ----------
    p : Particles
        Predicted particles, sorted by cell.
    cells : (int, int)
        The cells [cells[0], cells[1]).
    survivors : (nx * ny,) int32
        Number of a cell's new particles that are drawn from its old ones.
    groups : GroupVelocities
    step : Step
    normals : (4096,) float32
    out : Particles
        `start` is input, the other arrays are output.
    moments : Moments
        Weighted moments of the old particles, filled for cells with particles.
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
    """Fill the weights of a cell's particles; return their sum."""
    total = np.float32(0)
    for k in range(n if a > 0 else 0):
        weight[k] = np.float32(1) - a + a * likelihood(p.vx[first + k] - g[0], p.vy[first + k] - g[1], g)
        total += weight[k]
    if total > 0:
        return total
    for k in range(n):  # there is no measurement, or no particle explains it
        weight[k] = 1
    return np.float32(n)


@kernel
def _moments(p: Any, first: int, n: int, weight: Any, total: Any, mean: Any, covariance: Any) -> None:
    if n == 0 or total <= 0:
        return
    x0, y0 = p.vx[first], p.vy[first]  # near the mean, to avoid cancellation in float32
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
    """Draw survivors of a cell by systematic resampling; `target` is the first new particle and their number."""
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
