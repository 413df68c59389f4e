"""Heights of one scan: ground, slope, steps, roughness, obstacles and what hangs, and where a vehicle may drive.

>>> import numpy as np
>>> from ogm import GridSpec, Mount, Scan
>>> from ogm.geometric import RayISM, height_layers
>>> x, y = np.mgrid[3:12:0.05, -4:4:0.05].reshape(2, -1)
>>> scan = Scan(np.column_stack([x, y, 0.1 * x - 1.8]).astype(np.float32))   # a road that climbs by 10 %
>>> trace = RayISM(GridSpec.centered(24.0, 16.0, 0.5), Mount(sensor_height=1.8)).trace(scan)
>>> layers = height_layers(trace)
>>> at = trace.grid.spec.index(8.0, 1.0)
>>> float(layers["ground_height"][at].round(2)), float(np.degrees(layers["slope"][at]).round())
(-0.98, 6.0)
"""

import numpy as np

from ogm.geometric.kernels.arguments import Cells, HeightSpace
from ogm.geometric.kernels.heights import PARTS, height_cells, sum_returns
from ogm.geometric.ray import RayTrace
from ogm.grid import LayeredGrid

HEIGHT_LAYERS = (
    "ground_height", "ground_variance", "slope", "step", "roughness", "highest_obstacle", "clearance",
)  # fmt: skip
"""Names of the layers of `height_layers`."""


def height_layers(trace: RayTrace) -> LayeredGrid:
    """x."""
    spec = trace.grid.spec
    nx, ny = spec.shape
    cells = Cells(*spec.origin, spec.resolution)
    wide, part = np.split(np.empty(2 * nx * ny + PARTS, np.float32), [2 * nx * ny])
    work = HeightSpace(np.empty((len(HEIGHT_LAYERS), nx, ny), np.float32), wide.reshape(2, nx, ny), part)
    sum_returns(trace.points, trace.work.above, cells, trace.numbers, work.layers)
    height_cells(np.ascontiguousarray(trace.grid.mass), trace.ground, trace.mount.ground_point, cells, work)
    return LayeredGrid(spec, dict(zip(HEIGHT_LAYERS, work.layers, strict=True)))
