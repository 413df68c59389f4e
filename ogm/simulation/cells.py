"""Ground height in cells, steps and slopes of the ground, and rays aimed at points of cells."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import minimum_filter

from ogm.grid import GridSpec
from ogm.jit import kernel
from ogm.pose import check_pose
from ogm.simulation.mesh import Floats, Floats32, Mask
from ogm.simulation.scene import Scene
from ogm.truth import HEIGHT_LIMITS, TRUTH_SPEC

ABOVE = 60.0  # [m] start of the vertical rays above the sensor
BELOW = 120.0  # [m] length of the vertical rays: enough for any slope of the ground


class Below(NamedTuple):
    """Ground heights in every cell, along the z axis of the grid.

    Attributes
    ----------
    z : (nx, ny) float32
        Ground height in the middle of each cell [m]; NaN without ground.
    ground : (nx, ny) float32
        As `z`, but the lower level in cells with a step.
    rise : (nx, ny) float32
        Height of the step in each cell, slopes removed [m]; 0 without a step.
    spec : GridSpec
        Cells in the sensor's frame.
    T_world_sensor : (4, 4) float64
    """

    z: Floats32
    ground: Floats32
    rise: Floats32
    spec: GridSpec
    T_world_sensor: Floats


def measure_ground(
    surface: Scene, T_world_sensor: ArrayLike, spec: GridSpec = TRUTH_SPEC, step: float = HEIGHT_LIMITS.obstacle
) -> Below:
    """Measure the ground height in the middle of every cell, and the height of steps.

    Parameters
    ----------
    surface : Scene
        Ground only: surfaces that vehicles or pedestrians may stand on.
    T_world_sensor : (4, 4) float
    spec : GridSpec
        Cells in the sensor's frame.
    step : float
        Smallest rise of a step [m].
    """
    T = check_pose(T_world_sensor, "T_world_sensor")
    x, y = spec.cell_centers
    start = T[:3, 3] + ABOVE * T[:3, 2]
    count = spec.shape[0] * spec.shape[1]
    along = x[..., None] * T[:3, 0] + y[..., None] * T[:3, 1]
    origins = (start + along).astype(np.float32).reshape(count, 3)
    down = np.broadcast_to((-T[:3, 2]).astype(np.float32), (count, 3))
    distance = surface.cast(origins, np.ascontiguousarray(down)).distance.reshape(spec.shape)
    z = np.where(distance < BELOW, np.float32(ABOVE) - distance, np.float32(np.nan))
    _mend(z)
    rise = np.maximum(_steps_along(z.T).T, _steps_along(z))
    # The lower level of a step is the lowest height in the 3 x 3 neighbourhood.
    lowest = minimum_filter(np.where(np.isnan(z), np.inf, z), 3, mode="nearest")
    ground = np.where((rise >= step) & (lowest < z), lowest, z)
    return Below(z, ground, rise.astype(np.float32), spec, T)


def _mend(z: Floats32) -> None:
    """Fill single-cell holes, left by rays that passed between two triangles, with the median of their neighbours."""
    ix, iy = (index[:, None] for index in np.nonzero(np.isnan(z)))
    across, along = np.repeat((-1, 0, 1), 3), np.tile((-1, 0, 1), 3)
    nx, ny = z.shape
    around = z[np.clip(ix + across, 0, nx - 1), np.clip(iy + along, 0, ny - 1)]
    closed = np.isfinite(around).sum(axis=1) >= 4
    z[ix[closed, 0], iy[closed, 0]] = np.nanmedian(around[closed], axis=1) if closed.any() else np.nan


def _steps_along(z: Floats32) -> Floats:
    """Return the height of steps along a row [m]: the rise from cell i - 1 to i + 1, less that on the flatter side."""
    change = np.abs(z[:, 2:] - z[:, :-2]).astype(np.float64)  # around cells 1 to n - 2
    before, after = np.full_like(change, np.inf), np.full_like(change, np.inf)
    before[:, 2:], after[:, :-2] = change[:, :-2], change[:, 2:]
    found = change - np.where(after < before, after, before)
    rise = np.zeros(z.shape)
    rise[:, 1:-1] = np.where(found > 0, found, 0.0)  # also for NaN
    return rise


def steep_cells(below: Below, steepest: float) -> tuple[Mask, Floats32]:
    """Return the cells with a slope above `steepest`, and the rise of their ground over three cells [m].

    Slopes are relative to the horizontal plane, also for a tilted sensor. A cell has the smaller slope of those
    measured over three and over five cells, so that a kerb does not count as steep.
    """
    z, resolution, (a, b, c) = below.z, below.spec.resolution, below.T_world_sensor[2, :3].astype(np.float32)
    slopes = []
    for reach in (1, 2):
        change = np.zeros((2, *z.shape), np.float32)
        change[0, reach:-reach] = z[2 * reach :] - z[: -2 * reach]
        change[1, :, reach:-reach] = z[:, 2 * reach :] - z[:, : -2 * reach]
        dx, dy = change / np.float32(2 * reach * resolution)
        up = (c - a * dx - b * dy) ** 2  # squared vertical component of the normal (-dx, -dy, 1)
        slopes.append(np.sqrt(np.maximum((1 + dx * dx + dy * dy) / np.maximum(up, np.float32(1e-6)) - 1, 0)))
    slope = np.nan_to_num(np.minimum(*slopes))
    return slope > steepest, (3 * resolution * slope).astype(np.float32)


class Aim(NamedTuple):
    """Target point of a ray, relative to a cell.

    Attributes
    ----------
    height : float
        Height above the cell's ground [m].
    dx, dy : float
        Offset from the middle of the cell [cells].
    """

    height: float
    dx: float = 0.0
    dy: float = 0.0


def _spread(*heights: float) -> tuple[Aim, ...]:
    """Return target points at the given heights [m], cycling through the quarters of the cell."""
    quarters = ((0.25, 0.25), (-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25))
    return tuple(Aim(height, *quarters[n % 4]) for n, height in enumerate(heights))


# Target points by groups of cells, in this order: about 1.5 million rays on `TRUTH_SPEC`. The benchmark
# benchmarks/truth_modes.py measures the cells they observe and miss.
# every: all cells.
# alternate: every other cell, as the fields of one colour on a chessboard, with alternating colours. Rays to far cells
# pass near cells at nearly the same heights, so that little is missed.
# step: cells with a step in the ground and without a hit on an obstacle; heights count from the middle of the step.
# beside: neighbours of cells with obstacles, without an obstacle of their own so far.
# edge: unobserved neighbours of observed cells.
AIMS: dict[str, tuple[Aim, ...]] = {
    "every": (Aim(0.0),),
    "alternate": _spread(0.12, 0.45, 0.9, 1.4, 1.8),
    "step": _spread(0.02, 0.02, 0.02, 0.02),
    "beside": _spread(0.1, 0.3, 0.6, 1.0, 1.4, 1.9, 0.15, 0.45, 0.75, 1.15, 1.55, 1.75),
    "edge": tuple(Aim(0.0, dx, dy) for dx in (-0.35, 0.0, 0.35) for dy in (-0.35, 0.0, 0.35)),
}


def aimed_directions(z: Floats32, spec: GridSpec, aim: Aim, elevations: tuple[float, float], chosen: Mask) -> Floats32:
    """Return the unit vectors from the sensor to one point of every chosen cell within its field of view.

    Parameters
    ----------
    z : (nx, ny) float32
        Ground height of the cells [m]; cells with NaN are left out.
    spec : GridSpec
    aim : Aim
    elevations : (float, float)
        Lowest and highest elevation of the field of view [rad]; points outside are left out.
    chosen : (nx, ny) bool

    Returns
    -------
    (N, 3) float32
        Directions in the sensor's frame.
    """
    out = np.empty((np.count_nonzero(chosen), 3), np.float32)
    low, high = np.sin(elevations)
    return out[: _aim(out, z, chosen, (spec.resolution, *spec.origin), aim, low, high)]


@kernel
def _aim(
    out: Floats32, z: Floats32, chosen: Mask, grid: tuple[float, float, float], aim: Aim, low: float, high: float
) -> int:
    resolution, x0, y0 = grid
    nx, ny = z.shape
    count = 0
    for ix in range(nx):
        x = x0 + (ix + 0.5 + aim.dx) * resolution
        for iy in range(ny):
            if not chosen[ix, iy]:
                continue
            y = y0 + (iy + 0.5 + aim.dy) * resolution
            up = z[ix, iy] + aim.height
            length = np.sqrt(x * x + y * y + up * up)
            sine = up / length
            if not (sine >= low and sine <= high):  # also for NaN
                continue
            out[count, 0], out[count, 1], out[count, 2] = x / length, y / length, sine
            count += 1
    return count
