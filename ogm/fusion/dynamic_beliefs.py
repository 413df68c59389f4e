"""What is read from a dynamic map: masses, mean velocity and covariance of every cell, in the map's axes or others.

Beliefs are (nx, ny, 8) float32: free, static, dynamic, velocity (x, y) and its covariance (xx, xy, yy).
"""

import numpy as np
from numpy.typing import NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.fusion.dynamic_cells import DynamicCells
from ogm.fusion.resampling import GroupVelocities, Moments
from ogm.grid import GridSpec

__all__ = ["beliefs", "grid_of", "turned"]


def beliefs(cells: DynamicCells, moments: Moments, groups: GroupVelocities) -> NDArray[np.float32]:
    """Return the beliefs of all cells; velocities are those of the mixture of surviving particles and births."""
    mass = np.stack([cells.free, cells.static, cells.surviving + cells.born], axis=-1)
    velocity = np.concatenate(moments, axis=-1)
    velocity[cells.surviving <= 0] = 0  # of cells without particles
    rows = groups.rows
    mean, (xx, yx, yy) = rows[:, 5:7], rows[:, 7:10].T
    births = np.column_stack([mean, xx * xx, xx * yx, yx * yx + yy * yy])[groups.label]
    share = (cells.born / np.maximum(mass[..., 2], np.float32(1e-30)))[..., np.newaxis]
    off = births[..., :2] - velocity[..., :2]
    velocity += share * (births - velocity)
    velocity[..., 2:] += share * (1 - share) * off[..., [0, 0, 1]] * off[..., [0, 1, 1]]
    return np.concatenate([mass, velocity], axis=-1)


def turned(belief: NDArray[np.float32], T_map_vehicle: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return beliefs (nx, ny, 8) whose velocities are along the vehicle's axes."""
    forward = T_map_vehicle[:2, 0] / np.hypot(*T_map_vehicle[:2, 0])
    cosine, sine = forward.astype(np.float32)
    turn = np.array([[cosine, sine], [-sine, cosine]])
    velocity = belief[..., 3:5] @ turn.T
    covariance = turn @ belief[..., [5, 6, 6, 7]].reshape(*belief.shape[:2], 2, 2) @ turn.T
    flat = covariance.reshape(*belief.shape[:2], 4)[..., [0, 1, 3]]
    return np.concatenate([belief[..., :3], velocity, flat], axis=-1)


def grid_of(spec: GridSpec, belief: NDArray[np.float32]) -> DynamicGrid:
    """Return beliefs (nx, ny, 8) as a grid, without velocities where nothing is dynamic."""
    mass, velocity = belief[..., :3], belief[..., 3:]
    velocity[mass[..., 2] <= 0] = np.nan
    covariance = velocity[..., [2, 3, 3, 4]].reshape(*spec.shape, 2, 2)
    return DynamicGrid.trusted(spec, mass, velocity[..., :2], covariance)
