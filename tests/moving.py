"""A dynamic grid made in code: a street with a wall, parked and moving blocks, and what is unknown behind them."""

import numpy as np

from ogm import DynamicGrid, GridSpec

__all__ = ["SPEC", "street"]

SPEC = GridSpec.centered(32.0, 24.0, 0.5)


def street(spec: GridSpec = SPEC) -> DynamicGrid:
    """Return free ground with a wall on the left, a parked block, and three moving ones.

    Ahead, one moves forward at 8 m/s beside one that comes the other way at 6 m/s, side by side; behind, one turns: its
    front moves to the left, its back forward.
    """
    x, y = (np.broadcast_to(one, spec.shape) for one in spec.cell_centers)
    mass = np.zeros((*spec.shape, 3), np.float32)
    velocity = np.full((*spec.shape, 2), np.nan, np.float32)
    covariance = np.full((*spec.shape, 2, 2), np.nan, np.float32)
    known = np.abs(y) < 8
    mass[known, 0] = 0.8
    mass[(y > 7) & (y < 8)] = 0, 0.9, 0
    mass[(abs(x + 8) < 2) & (abs(y + 6) < 1)] = 0.05, 0.8, 0.05

    def moving(cells: np.ndarray, *parts: np.ndarray | float) -> None:
        mass[cells] = 0, 0.1, 0.8
        for k, part in enumerate(parts):
            velocity[..., k][cells] = np.broadcast_to(part, spec.shape)[cells]
        covariance[cells] = np.eye(2) * 0.25 + 0.05

    moving((abs(x - 9) < 2) & (y > 0) & (y < 2), 8.0, 0.0)
    moving((abs(x - 9) < 2) & (y > 2) & (y < 4), -6.0, 0.0)
    turning = (abs(x + 9) < 2) & (abs(y) < 1)
    moving(turning, 3.0 - 0.6 * y, 0.6 * (x + 11))
    faint = (velocity[..., 0] != velocity[..., 0]) & (mass[..., 2] > 0)
    velocity[faint], covariance[faint] = 0, np.eye(2)
    return DynamicGrid(spec, mass, velocity, covariance)
