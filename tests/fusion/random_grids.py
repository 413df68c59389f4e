"""Grids and layers for tests of the maps."""

import numpy as np

from ogm.fusion import EvidentialMapper
from ogm.grid import EvidentialGrid, GridSpec


def noise(spec: GridSpec, seed: int = 0) -> EvidentialGrid:
    """Return a grid of arbitrary masses, a third of its cells vacuous."""
    rng = np.random.default_rng(seed)
    mass = rng.dirichlet([0.7, 0.7, 0.7], size=spec.shape)[..., :2]
    mass[rng.random(spec.shape) < 1 / 3] = 0
    return EvidentialGrid(spec, mass.astype(np.float32))


def uniform(spec: GridSpec, free: float = 0.4, occupied: float = 0.1) -> EvidentialGrid:
    """Return a grid whose cells are alike."""
    return EvidentialGrid(spec, np.full((*spec.shape, 2), (free, occupied), np.float32))


def layers(mapper: EvidentialMapper) -> np.ndarray:
    """Return the conflict layers free -> occupied and occupied -> free, (nx, ny, 2)."""
    conflict = mapper.conflict
    return np.stack([conflict["free_to_occupied"], conflict["occupied_to_free"]], axis=-1)
