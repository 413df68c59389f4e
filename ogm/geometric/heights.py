"""Layers of heights from a scan (ground, slope, steps, roughness, obstacles, overhangs), and traversability.

>>> import numpy as np
>>> from ogm import GridSpec, Mount, Scan
>>> from ogm.geometric import RayISM, height_layers, traversability
>>> x, y = np.mgrid[3:12:0.05, -4:4:0.05].reshape(2, -1)
>>> scan = Scan(np.column_stack([x, y, 0.1 * x - 1.8]).astype(np.float32))   # a road with 10 % slope
>>> trace = RayISM(GridSpec.centered(24.0, 16.0, 0.5), Mount(sensor_height=1.8)).trace(scan)
>>> layers, at = height_layers(trace), trace.grid.spec.index(8.0, 1.0)
>>> layers["ground_height"][at].round(1), np.degrees(layers["slope"][at]).round()
(np.float32(-1.0), np.float32(6.0))
>>> traversability(layers, trace.grid)[at].round(1)
np.float32(0.7)
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.inputs import check_within
from ogm.geometric.kernels.arguments import Cells, HeightSpace
from ogm.geometric.kernels.height_sums import sum_returns
from ogm.geometric.kernels.heights import PARTS, WIDTH, height_cells
from ogm.geometric.ray import RayTrace
from ogm.grid import EvidentialGrid, LayeredGrid
from ogm.state import CellState, predict_state

HEIGHT_LAYERS = (
    "ground_height", "ground_variance", "slope", "step", "roughness", "highest_obstacle", "clearance",
)  # fmt: skip
"""Names of the layers of `height_layers`."""
MIN_FLOATS = 2**22  # 16 MiB: glibc keeps an allocation of this size for the next scan, and fresh pages cost time


@dataclass(frozen=True)
class VehicleLimits:
    """Limits of the ground that a vehicle can drive on.

    Parameters
    ----------
    max_slope : float
        Greatest inclination of the ground, above 0 and at most pi / 2 [rad].
    max_step : float
        Greatest height of a step [m].
    height : float
        Height of the vehicle [m].

    Raises
    ------
    ValueError
        If a number is out of its range.
    """

    max_slope: float = math.radians(20)
    max_step: float = 0.15
    height: float = 2.0

    def __post_init__(self) -> None:
        check_within("max_slope", self.max_slope, 0, math.pi / 2 + 1e-9)
        check_within("max_step", self.max_step, 0, 1e3)
        check_within("height", self.height, 0, 1e3)


def height_layers(trace: RayTrace) -> LayeredGrid:
    """Return the layers of heights of a scan.

    Returns up to `RayISM.obstacle_height` above the ground map of `RayISM` are ground, except in cells with obstacles
    and the cells around them. The ground map is interpolated there, then corrected by the mean of the ground returns
    in blocks of 0.64 m and in each cell. Cells without ground returns take the height of the block. The ground is
    unknown on bulges of more than 0.25 m within 11 m, which may be roofs of cars that hide the ground.

    Parameters
    ----------
    trace : RayTrace
        Result of `RayISM.trace`.

    Returns
    -------
    LayeredGrid
        Layers (nx, ny), NaN where the ground is unknown. It is unknown more than half a metre from ground returns
        in cells without mass of free, more than 3 m from ground returns, and where most returns are below the surface.

        - ``ground_height``: ground at the cell centre, in the vehicle frame [m];
        - ``ground_variance``: variance of the ground height [m2]; it grows in gaps, and includes range noise but not
          pose noise;
        - ``slope``: inclination of the ground over 1 m [rad];
        - ``step``: greatest rise between cells at most 0.35 m away, less the rise of the slope [m]; obstacles that
          stand on the ground are steps; NaN without a return within this distance;
        - ``roughness``: standard deviation of the ground returns about the ground, over 0.64 m [m];
        - ``highest_obstacle``: highest return between `RayISM.obstacle_height` and `RayISM.clearance` above the
          ground [m]; 0 on known ground without such a return;
        - ``clearance``: lowest return above `RayISM.obstacle_height`, relative to the ground [m]; NaN without such a
          return.

    Raises
    ------
    ValueError
        If the grid is wider than 16,384 cells.
    """
    spec = trace.grid.spec
    nx, ny = spec.shape
    if ny >= WIDTH - 16:
        raise ValueError(f"layers of heights are for grids of at most {WIDTH - 16} cells along y, got {ny}")
    cells = Cells(*spec.origin, spec.resolution)
    wide, part = np.split(np.empty(max(2 * nx * ny + PARTS, MIN_FLOATS), np.float32), [2 * nx * ny])
    work = HeightSpace(np.empty((len(HEIGHT_LAYERS), nx, ny), np.float32), wide.reshape(2, nx, ny), part)
    sum_returns(trace.points, trace.work.above, cells, trace.numbers, work.layers)
    height_cells(np.ascontiguousarray(trace.grid.mass), trace.ground, trace.mount.ground_point, cells, work)
    return LayeredGrid(spec, dict(zip(HEIGHT_LAYERS, work.layers, strict=True)))


def traversability(
    layers: LayeredGrid,
    grid: EvidentialGrid,
    vehicle: VehicleLimits = VehicleLimits(),  # noqa: B008  it is immutable
) -> NDArray[np.float32]:
    """Return the traversability of each cell, 1 for level ground to 0 for ground beyond a limit.

    Parameters
    ----------
    layers : LayeredGrid
        With ``slope``, ``step`` and ``clearance``, see `height_layers`.
    grid : EvidentialGrid
        Masses on the same cells.
    vehicle : VehicleLimits

    Returns
    -------
    (nx, ny) float32
        The lesser of ``1 - slope / max_slope`` and ``1 - step / max_step``, at least 0. It is 0 in cells predicted
        occupied and in free cells with a clearance below the vehicle's height, and NaN in cells predicted unknown or
        with unknown slope. An unknown step does not count.

    Raises
    ------
    ValueError
        If the cells differ.
    """
    if layers.spec != grid.spec:
        raise ValueError(f"layers and masses must have the same cells, got {layers.spec} and {grid.spec}")
    state = predict_state(grid.mass)
    by_slope = 1 - layers["slope"] / np.float32(vehicle.max_slope)
    share: NDArray[np.float32] = np.clip(np.fmin(by_slope, 1 - layers["step"] / np.float32(vehicle.max_step)), 0, 1)
    share[np.isnan(by_slope) | (state == CellState.UNKNOWN)] = np.nan
    share[(state == CellState.OCCUPIED) | ((layers["clearance"] < vehicle.height) & (state == CellState.FREE))] = 0
    return share
