"""Kernels that move the dynamic mass of a grid and compute masses and velocities at a later time.

They check nothing.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.dynamic.particles import Particles
from ogm.jit import kernel

NORMALS = 4096  # draws of four independent normals, reused cyclically


class Horizon(NamedTuple):
    """Parameters of the predicted time.

    Attributes
    ----------
    seconds : float
    acceleration : float
        Standard deviation of the change of velocities within one second, along each axis [m/s²].
    kept_free, moved_static : float
        Remaining share of free, and share of static in objects' cells that moves with them, [0, 1].
    """

    seconds: float
    acceleration: float
    kept_free: float
    moved_static: float


class Bodies(NamedTuple):
    """Motion of objects; row 0 is for particles without an object, which move straight.

    Attributes
    ----------
    center, velocity : (B + 1, 2) float32
        Relative to the grid's corner [m]; over ground [m/s].
    chord, rotation : (B + 1, 2, 2) float32
        See `arc`: matrices from a velocity to the shift, and to its end value.
    root : (B + 1, 2, 2) float32
        Matrix from two standard normals to an error of the velocity [m/s].
    rigidity : (B + 1,) float32
    """

    center: NDArray[np.float32]
    velocity: NDArray[np.float32]
    chord: NDArray[np.float32]
    rotation: NDArray[np.float32]
    root: NDArray[np.float32]
    rigidity: NDArray[np.float32]


class Arrivals(NamedTuple):
    """Mass and velocity moments that arrive in the cells.

    Attributes
    ----------
    row : (nx, ny) int32
        Row of `moments` of each cell; 0 for cells without arrivals.
    moments : (rows, 6) float32
        Sums of the arriving mass times 1, vx, vy, vx², vx vy and vy². Row 0 is 0. Memory is touched only for cells with
        arrivals.
    """

    row: NDArray[np.int32]
    moments: NDArray[np.float32]


@kernel
def move_mass(
    mass: NDArray[Any],
    label: NDArray[Any],
    particles: Particles,
    bodies: Bodies,
    normals: NDArray[Any],
    horizon: Horizon,
    resolution: float,
    out: Arrivals,
) -> None:
    """Move the dynamic mass of cells with their particles.

    Parameters
    ----------
    mass : (nx, ny, 3) float32
    label : (nx, ny) int32
        1 + the object of a cell, 0 for none.
    particles : Particles
    bodies : Bodies
    normals : (4096, 4) float32
    horizon : Horizon
    resolution : float
        Side of a cell [m].
    out : Arrivals
        Output. `row` must be zeros; `moments` needs min(cells, particles) + 1 rows.
    """
    nx, ny = label.shape
    scale, dt, q = np.float32(1 / resolution), horizon.seconds, horizon.acceleration
    # A white acceleration q shifts by q sqrt(dt³ / 3) n; the velocity changes by q sqrt(dt) (sqrt(3) n + m) / 2.
    shifted = np.float32(q * math.sqrt(dt**3 / 3))
    changed = np.float32(q * math.sqrt(0.75 * dt))
    one, zero = np.float32(1), np.float32(0)
    row, moments = out.row, out.moments
    moments[0] = 0
    rows = 1
    for c in range(nx * ny):
        first, last = particles.start[c], particles.start[c + 1]
        if first == last:
            continue
        b = label[c // ny, c % ny]
        m = mass[c // ny, c % ny, 2] + (np.float32(horizon.moved_static) * mass[c // ny, c % ny, 1] if b else zero)
        m /= np.float32(last - first)
        loose = one - bodies.rigidity[b]
        ux, uy = bodies.velocity[b, 0], bodies.velocity[b, 1]
        cx, cy = bodies.center[b, 0], bodies.center[b, 1]
        cosine, sine = bodies.rotation[b, 0, 0], bodies.rotation[b, 1, 0]
        p, q = bodies.chord[b, 0, 0], bodies.chord[b, 1, 0]
        rxx, rxy, ryy = bodies.root[b, 0, 0], bodies.root[b, 0, 1], bodies.root[b, 1, 1]
        for k in range(first, last):
            d = k % NORMALS
            n0, n1, n2, n3 = normals[d, 0], normals[d, 1], normals[d, 2], normals[d, 3]
            vx = ux + loose * (particles.vx[k] - ux) + rxx * n0 + rxy * n1
            vy = uy + loose * (particles.vy[k] - uy) + rxy * n0 + ryy * n1
            rx, ry = particles.x[k] - cx, particles.y[k] - cy
            x = (cx + cosine * rx - sine * ry + p * vx - q * vy + shifted * n2) * scale
            y = (cy + sine * rx + cosine * ry + q * vx + p * vy + shifted * n3) * scale
            if not (zero <= x < np.float32(nx) and zero <= y < np.float32(ny)):
                continue
            to_i, to_j = np.uint32(x), np.uint32(y)
            wx, wy = cosine * vx - sine * vy + changed * n2, sine * vx + cosine * vy + changed * n3
            r = row[to_i, to_j]
            if r == 0:
                r = row[to_i, to_j] = rows
                moments[r] = 0
                rows += 1
            moments[r, 0] += m
            moments[r, 1] += m * wx
            moments[r, 2] += m * wy
            moments[r, 3] += m * wx * wx
            moments[r, 4] += m * wx * wy
            moments[r, 5] += m * wy * wy


@kernel
def cells_later(
    mass: NDArray[Any],
    label: NDArray[Any],
    arrivals: Arrivals,
    horizon: Horizon,
    result: NDArray[Any],
    velocity: NDArray[Any],
    covariance: NDArray[Any],
) -> None:
    """Compute masses, velocities and covariances of cells from their present masses and the arrivals.

    Parameters
    ----------
    mass, label, horizon
        See `move_mass`.
    arrivals : Arrivals
    result, velocity, covariance : (nx, ny, 3), (nx, ny, 2), (nx, ny, 2, 2) float32
        Output.
    """
    nx, ny = label.shape
    one, zero = np.float32(1), np.float32(0)
    independent = np.float32(horizon.acceleration**2 * horizon.seconds / 4)
    row, moments = arrivals.row, arrivals.moments
    for i in range(nx):
        for j in range(ny):
            r = row[i, j]
            m0 = moments[r, 0]
            static = mass[i, j, 1] * (one - np.float32(horizon.moved_static) if label[i, j] else one)
            dynamic = min(m0, one - static)
            left = min((one - dynamic) / max(one - mass[i, j, 2], np.float32(1e-6)), one)  # less if more mass arrives
            free = min(mass[i, j, 0] * np.float32(horizon.kept_free) * left, one - static - dynamic)
            result[i, j, 0], result[i, j, 1], result[i, j, 2] = free, static, dynamic
            if m0 > zero:
                vx, vy = moments[r, 1] / m0, moments[r, 2] / m0
                velocity[i, j, 0], velocity[i, j, 1] = vx, vy
                covariance[i, j, 0, 0] = max(moments[r, 3] / m0 - vx * vx, zero) + independent
                covariance[i, j, 1, 1] = max(moments[r, 5] / m0 - vy * vy, zero) + independent
                covariance[i, j, 0, 1] = covariance[i, j, 1, 0] = moments[r, 4] / m0 - vx * vy
            else:
                velocity[i, j, :] = np.nan
                covariance[i, j, :, :] = np.nan
