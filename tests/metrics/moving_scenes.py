"""Small dynamic grids with their true motion."""

import numpy as np
from numpy.typing import NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.grid import GridSpec
from ogm.state import Motion

SPEC = GridSpec.centered(length=30, width=20, resolution=1.0)
LABELS = ("Car", "Cyclist", "Pedestrian", "animal")


def scene(seed: int) -> tuple[DynamicGrid, Motion, NDArray[np.bool_]]:
    """Return a grid with errors of all kinds, its truth, and the cells that a scan shows as occupied."""
    rng = np.random.default_rng(seed)
    shape = SPEC.shape
    box = rng.integers(-1, len(LABELS), shape).astype(np.int16)
    heading, speed = rng.uniform(-np.pi, np.pi, len(LABELS)), rng.choice([0.1, 0.6, 1.4, 4.0, 9.0], len(LABELS))
    velocities = np.vstack([speed * np.cos(heading), speed * np.sin(heading)]).T
    velocity = np.where((box >= 0)[..., None], velocities[box], 0.0) + rng.normal(0, 0.05, (*shape, 2))
    velocity[rng.random(shape) < 0.1] = np.nan
    mass = rng.dirichlet([0.5, 0.5, 0.5, 0.5], shape)[..., :3]
    mass[rng.random(shape) < 0.2, 2] = 0
    mass[rng.random(shape) < 0.1] = 0
    found = velocities[box] + rng.normal(0, 1, (*shape, 2))
    root = rng.normal(0, 1, (*shape, 2, 2))
    covariance = root @ np.swapaxes(root, -1, -2) + 0.1 * np.eye(2)
    still = mass[..., 2] == 0
    found[still], covariance[still] = np.nan, np.nan
    grid = DynamicGrid(SPEC, *(one.astype(np.float32) for one in (mass, found, covariance)))
    return grid, Motion(velocity.astype(np.float32), box), rng.random(shape) < 0.6


def perfect(motion: Motion, occupied: NDArray[np.bool_], spec: GridSpec = SPEC) -> DynamicGrid:
    """Return the grid that is certain of the truth."""
    velocity = motion.velocity.astype(np.float32)
    moving = np.hypot(velocity[..., 0], velocity[..., 1]) > 1
    full = occupied | moving
    mass = np.stack([~full, full & ~moving, moving], axis=-1).astype(np.float32)
    known = moving[..., None]
    covariance = np.broadcast_to(np.eye(2, dtype=np.float32), (*spec.shape, 2, 2))
    return DynamicGrid(spec, mass, np.where(known, velocity, np.nan), np.where(known[..., None], covariance, np.nan))


def motionless(occupied: NDArray[np.bool_], spec: GridSpec = SPEC) -> DynamicGrid:
    """Return a grid in which nothing moves."""
    mass = np.stack([~occupied, occupied, np.zeros_like(occupied)], axis=-1).astype(np.float32)
    nothing = np.full((*spec.shape, 2), np.nan, np.float32)
    return DynamicGrid(spec, mass, nothing, np.full((*spec.shape, 2, 2), np.nan, np.float32))
