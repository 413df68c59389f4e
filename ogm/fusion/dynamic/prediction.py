"""Prediction of a dynamic grid: objects move as rigid bodies, other particles by their own velocities."""

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

_PER_CELL = 16  # particles that represent a dynamic cell if none are given


class PredictionSettings(NamedTuple):
    """Assumptions about the predicted time.

    Attributes
    ----------
    free_half_life : float
        Half-life of free [s], since anything may enter.
    acceleration : float
        Standard deviation of the change of velocities within one second, along each axis [m/s²]; it grows with the root
        of time.
    rigidity : float
        Rigidity of objects, [0, 1]: 1 moves all particles of an object by its velocity, 0 each by its own.
    uncertainty : float
        Factor on the standard deviation of objects' velocities. Below 1 it trades calibration of the velocity for
        precise cells.
    moved_static : float
        Share of the static mass in an object's cells that moves with the object, [0, 1].
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
    """Return a dynamic grid predicted some time later, without further measurements.

    Static mass stays. The dynamic mass of a cell is carried by its particles in equal shares. Particles of an object
    move with it: its centre along an arc at its velocity and turn rate, and the particles rotate about the centre.
    Other particles move straight at their own velocities. White accelerations, and the error of the object's velocity,
    spread them. Mass that leaves a cell becomes unknown; arriving mass reduces unknown and free.

    Parameters
    ----------
    grid : DynamicGrid
    particles : Particles or None
        Particles of the same grid. With None, particles are made from the cells' velocities and covariances.
    seconds : float
        Prediction time [s], 0 or more; 0 returns `grid` itself.
    objects : Objects, optional
        Objects of the same grid; by default from `find_objects`, without turn rates.
    settings : PredictionSettings, optional

    Returns
    -------
    DynamicGrid
        Prediction on the same cells. Particles that leave them are lost.

    Raises
    ------
    ValueError
        If `seconds` is negative or not finite, or particles or objects belong to a grid of another shape.
    """
    if not 0 <= seconds < math.inf:
        raise ValueError(f"seconds must be 0 or more and finite, got {seconds}")
    if objects is not None and objects.label.shape != grid.spec.shape:
        raise ValueError(f"objects must be of a grid of {grid.spec.shape} cells, got {objects.label.shape}")
    if particles is not None and len(particles.start) != grid.mass[..., 0].size + 1:
        raise ValueError(f"particles must be of {grid.spec.shape} cells, got {len(particles.start) - 1} cells")
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
    """Return the prediction of `predict_dynamic`, from masses (nx, ny, 3) instead of a whole grid."""
    chosen = PredictionSettings() if settings is None else settings
    horizon = Horizon(seconds, chosen.acceleration, 0.5 ** (seconds / chosen.free_half_life), chosen.moved_static)
    bodies, mass = _bodies(objects, spec, seconds, chosen), np.ascontiguousarray(mass)
    space = np.empty((min(math.prod(spec.shape), len(particles.x)) + 1, 6), np.float32)
    arrivals, later = Arrivals(np.zeros(spec.shape, np.int32), space), empty_beliefs(spec.shape)
    move_mass(mass, objects.label, particles, bodies, _normals(), horizon, spec.resolution, arrivals)
    cells_later(mass, objects.label, arrivals, horizon, *later)
    return DynamicGrid.trusted(spec, *later)


def _from_cells(grid: DynamicGrid) -> Particles:
    """Return particles that represent the dynamic cells: evenly spread over each, with normal velocities."""
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
    """Return the motion of the objects within some time."""
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
    """Return a table of evenly spread standard normals, (4096, 4).

    Successive rows are successive points of an additive recurrence whose steps are powers of the root of x⁵ = x + 1
    (Roberts 2018), so that the successive particles of a cell share few values.
    """
    root = 1.1673039782614187
    steps = root ** -np.arange(1.0, 5.0)
    uniform = (0.5 + np.arange(1, NORMALS + 1)[:, None] * steps) % 1
    normals = np.vectorize(NormalDist().inv_cdf)(uniform)
    normals -= normals.mean(axis=0)
    table = np.linalg.solve(np.linalg.cholesky(np.cov(normals.T)), normals.T).T.astype(np.float32)  # uncorrelated
    table.flags.writeable = False
    return table
