"""Sensor model of depth cameras: `RayISM` with parameters for a narrow view.

>>> from ogm import GridSpec, Mount
>>> from ogm.models.depth import depth_model
>>> depth_model(GridSpec.centered(8.0, 8.0, 0.05), Mount(sensor_height=0.6)).p_hidden
1.0
"""

import math
from typing import Any

from ogm.geometric import RayISM
from ogm.grid import GridSpec
from ogm.scan import Mount

PARAMETERS: dict[str, Any] = {
    "range_noise": 0.01,
    "noise_growth": 0.0025,  # 0.08 pixel of disparity at a baseline of 50 mm and a focal length of 640 pixels
    "p_hidden": 1.0,
    "hidden_height": 0.2,
    "azimuth_step": 2 * math.pi / 720,  # half a degree: see `ogm.io.depth.APART`
    "ground_cell": 0.5,
}


def depth_model(spec: GridSpec, mount: Mount | None = None) -> RayISM:
    """Return the model of depth cameras.

    A cell is free only to the extent that rays pass it at all heights up to `RayISM.clearance`. Obstacles can be hidden
    in gaps between rays (a black object without depth), or above the view (a table top before a low camera).

    Parameters
    ----------
    spec : GridSpec
        Cells of the grids.
    mount : Mount, optional
        See `RayISM`.
    """
    return RayISM(spec, mount, **PARAMETERS)
