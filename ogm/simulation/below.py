"""The ground below the sensor, cell by cell: its height, and where it has steps."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from ogm.grid import GridSpec
from ogm.pose import check_pose
from ogm.simulation.scene import Scene
from ogm.truth import TRUTH_SPEC, HeightLimits

__all__ = ["Below", "look_down"]

ABOVE = 60.0  # [m] over the sensor: where the look down begins
BELOW = 120.0  # [m] how far it goes: ground of any slope lies between


class Below(NamedTuple):
    """The ground under every cell, along the z axis of the grid.

    Attributes
    ----------
    z : (nx, ny) float32
        Of the ground in the middle of each cell [m]; NaN where there is none.
    ground : (nx, ny) float32
        The same, but the lower level where there is a step.
    rise : (nx, ny) float32
        Height of the step that passes through each cell, slopes taken away [m]; 0 where there is none.
    """

    z: NDArray[np.float32]
    ground: NDArray[np.float32]
    rise: NDArray[np.float32]


def look_down(
    ground: Scene, T_world_sensor: ArrayLike, spec: GridSpec = TRUTH_SPEC, step: float = HeightLimits.obstacle
) -> Below:
    """Find the ground in the middle of every cell, and the steps in it.

    Parameters
    ----------
    ground : Scene
        Nothing but ground: what vehicles and pedestrians may stand on.
    T_world_sensor : (4, 4) float
    spec : GridSpec
        Cells in the sensor's frame.
    step : float
        From which rise on [m] a step counts.
    """
    T = check_pose(T_world_sensor, "T_world_sensor")
    x, y = spec.cell_centers
    start = T[:3, 3] + ABOVE * T[:3, 2]
    count = spec.shape[0] * spec.shape[1]
    along = x[..., None] * T[:3, 0] + y[..., None] * T[:3, 1]
    origins = (start + along).astype(np.float32).reshape(count, 3)
    down = np.broadcast_to((-T[:3, 2]).astype(np.float32), (count, 3))
    distance = ground.cast(origins, np.ascontiguousarray(down)).distance.reshape(spec.shape)
    z = np.where(distance < BELOW, np.float32(ABOVE) - distance, np.float32(np.nan))
    _mend(z)
    below = Below(z, np.empty_like(z), np.empty_like(z))
    _steps(*below, step)
    return below


def _mend(z: NDArray[np.float32]) -> None:
    """Close holes of single cells, where a ray slipped between two triangles, with what is around them."""
    ix, iy = (index[:, None] for index in np.nonzero(np.isnan(z)))
    across, along = np.repeat((-1, 0, 1), 3), np.tile((-1, 0, 1), 3)
    nx, ny = z.shape
    around = z[np.clip(ix + across, 0, nx - 1), np.clip(iy + along, 0, ny - 1)]
    closed = np.isfinite(around).sum(axis=1) >= 4
    z[ix[closed, 0], iy[closed, 0]] = np.nanmedian(around[closed], axis=1) if closed.any() else np.nan


@njit(cache=True, nogil=True)
def _step_at(line: Any, i: int) -> float:
    """Return how much more the ground rises from cell i - 1 to i + 1 than further out, on the flatter side."""
    if i < 1 or i + 1 >= len(line):
        return 0.0
    slope = np.inf
    if i >= 3:
        slope = abs(line[i - 1] - line[i - 3])
    if i + 3 < len(line):
        slope = min(slope, abs(line[i + 3] - line[i + 1]))
    found = abs(line[i + 1] - line[i - 1]) - slope
    return found if found > 0 else 0.0  # nor for NaN


@njit(cache=True, nogil=True)
def _steps(z: Any, ground: Any, rise: Any, step: float) -> None:
    """Fill `rise` and `ground` of `Below`."""
    nx, ny = z.shape
    for ix in range(nx):
        for iy in range(ny):
            most = max(_step_at(z[:, iy], ix), _step_at(z[ix, :], iy))
            rise[ix, iy] = most
            lowest = z[ix, iy]
            if most >= step:
                for jx in range(max(ix - 1, 0), min(ix + 2, nx)):
                    for jy in range(max(iy - 1, 0), min(iy + 2, ny)):
                        if z[jx, jy] < lowest:
                            lowest = z[jx, jy]
            ground[ix, iy] = lowest
