"""A dynamic grid at a later time: objects move on as rigid bodies, other particles by their own velocities."""

import math
from functools import cache
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.fusion.dynamic.beliefs import empty_beliefs
from ogm.fusion.dynamic.object_tracker import arc
from ogm.fusion.dynamic.objects import Objects, find_objects
from ogm.fusion.dynamic.particles import Particles
from ogm.fusion.dynamic.prediction_kernels import NORMALS, Arrivals, Bodies, Horizon, cells_later, move_mass
from ogm.grid import GridSpec

_PER_CELL = 16  # particles made of a dynamic cell where none are given


class PredictionSettings(NamedTuple):
    """What is assumed of the time that is predicted.

    Attributes
    ----------
    free_half_life : float
        Time in which the mass of free halves [s], since anything may enter.
    acceleration : float
        By how much velocities change within a second, 1 sigma along each axis [m/s²]; the change grows with the root of
        time.
    rigidity : float
        Of objects, [0, 1]: 1 moves all of an object's particles by its velocity, 0 each by its own.
    uncertainty : float
        Factor on the standard deviation of objects' velocities; below 1 it trades calibration of the velocity for
        precise cells.
    moved_static : float
        Share of the static mass in an object's cells that belongs to the object, and moves with it, [0, 1].
    """

    free_half_life: float = 60.0
    acceleration: float = 0.3
    rigidity: float = 1.0
    uncertainty: float = 0.5
    moved_static: float = 0.0


def predict_dynamic(
    grid: DynamicGrid,
    particles: Particles | None,
    seconds: float,
    objects: Objects | None = None,
    settings: PredictionSettings | None = None,
) -> DynamicGrid:
    """Return a dynamic grid some time later, if nothing is measured in the meantime.

    What is static stays. The dynamic mass of a cell is carried by the particles in it, in equal shares. Particles of an
    object move with it: its centre along an arc at its velocity and turn rate, the particles turned about the centre.
    Other particles move straight on by their own velocities. White accelerations, and the error of the object's
    velocity, spread them. Mass that leaves a cell becomes unknown; mass that arrives takes from unknown and from free.

    Parameters
    ----------
    grid : DynamicGrid
    particles : Particles or None
        Of the same grid. None makes some from the cells' velocities and covariances.
    seconds : float
        How far ahead [s], 0 or more; 0 gives `grid` itself.
    objects : Objects, optional
        Of the same grid; by default those that `find_objects` finds, which have no turn rates.
    settings : PredictionSettings, optional

    Returns
    -------
    DynamicGrid
        On the same cells. Particles that leave them are lost.

    Raises
    ------
    ValueError
        If `seconds` is negative or not finite, or particles or objects are those of a grid of another shape.
    """
    if not 0 <= seconds < math.inf:
        raise ValueError(f"seconds must be 0 or more and finite, got {seconds}")
    if objects is not None and objects.label.shape != grid.spec.shape:
        raise ValueError(f"objects are those of a grid of {objects.label.shape} cells, this one has {grid.spec.shape}")
    if particles is not None and len(particles.start) != grid.mass[..., 0].size + 1:
        raise ValueError(f"particles are those of {len(particles.start) - 1} cells, the grid has {grid.spec.shape}")
    if seconds == 0:
        return grid
    moving = _from_cells(grid) if particles is None else particles
    return move_on(grid.spec, grid.mass, moving, find_objects(grid) if objects is None else objects, seconds, settings)


def move_on(
    spec: GridSpec,
    mass: NDArray[np.float32],
    particles: Particles,
    objects: Objects,
    seconds: float,
    settings: PredictionSettings | None = None,
) -> DynamicGrid:
    """Return the grid of `predict_dynamic`, which needs of the present one only its masses (nx, ny, 3)."""
    chosen = PredictionSettings() if settings is None else settings
    horizon = Horizon(seconds, chosen.acceleration, 0.5 ** (seconds / chosen.free_half_life), chosen.moved_static)
    bodies, mass = _bodies(objects, spec, seconds, chosen), np.ascontiguousarray(mass)
    space = np.empty((min(math.prod(spec.shape), len(particles.x)) + 1, 6), np.float32)
    arrivals, later = Arrivals(np.zeros(spec.shape, np.int32), space), empty_beliefs(spec.shape)
    move_mass(mass, objects.label, particles, bodies, _normals(), horizon, spec.resolution, arrivals)
    cells_later(mass, objects.label, arrivals, horizon, *later)
    return DynamicGrid.trusted(spec, *later)


def _from_cells(grid: DynamicGrid) -> Particles:
    """Return particles that stand for the dynamic cells: evenly spread over each, with normal velocities."""
    dynamic = (grid.dynamic > 0) & np.isfinite(grid.speed)
    i, j = np.nonzero(dynamic)
    start = np.concatenate([[0], _PER_CELL * np.cumsum(dynamic)]).astype(np.int32)
    draw = _normals()[np.arange(len(i) * _PER_CELL) % NORMALS].reshape(len(i), _PER_CELL, 4)
    side = math.isqrt(_PER_CELL)
    inside = (np.stack(np.meshgrid(*[np.arange(side)] * 2), -1).reshape(-1, 2) + 0.5) / side
    xy = (np.stack([i, j], -1)[:, None] + inside) * grid.spec.resolution
    root = _root_of(np.nan_to_num(grid.covariance[i, j].astype(np.float64)))
    v = grid.velocity[i, j][:, None] + draw[..., :2] @ np.swapaxes(root, 1, 2)
    x, y, vx, vy = np.ascontiguousarray(np.concatenate([xy, v], axis=-1).reshape(-1, 4).T, np.float32)
    return Particles(x, y, vx, vy, start)


def _bodies(objects: Objects, spec: GridSpec, seconds: float, settings: PredictionSettings) -> Bodies:
    """Return how the objects move within some time."""
    count = len(objects)
    center, velocity = np.zeros((2, count + 1, 2))
    center[1:] = objects.boxes.center[:, :2] - spec.origin
    velocity[1:] = objects.velocity
    arcs = [arc(rate, seconds) for rate in (0.0, *objects.turn_rate)]
    root = np.zeros((count + 1, 2, 2))
    root[1:] = settings.uncertainty * _root_of(objects.covariance)
    rigidity = np.full(count + 1, settings.rigidity)
    rigidity[0] = 0
    chord, rotation = (np.stack(matrices) for matrices in zip(*arcs, strict=True))
    return Bodies(*(a.astype(np.float32) for a in (center, velocity, chord, rotation, root, rigidity)))


def _root_of(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the symmetric square roots of covariances, (..., 2, 2)."""
    values, vectors = np.linalg.eigh(covariance)
    root: NDArray[np.float64] = (vectors * np.sqrt(np.maximum(values, 0))[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return root


@cache
def _normals() -> NDArray[np.float32]:
    """Return a table of standard normals, (4096, 4), evenly spread.

    Successive rows are successive points of an additive recurrence whose steps are powers of the root of x⁵ = x + 1
    (Roberts 2018), so that the particles of one cell, which follow each other, share few values.
    """
    root = 1.1673039782614187
    steps = root ** -np.arange(1.0, 5.0)
    uniform = (0.5 + np.arange(1, NORMALS + 1)[:, None] * steps) % 1
    normals = np.vectorize(NormalDist().inv_cdf)(uniform)
    normals -= normals.mean(axis=0)
    table = np.linalg.solve(np.linalg.cholesky(np.cov(normals.T)), normals.T).T.astype(np.float32)  # uncorrelated
    table.flags.writeable = False
    return table
