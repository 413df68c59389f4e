"""The model of depth cameras: `RayISM` for rays that end where the view does.

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

    A cell is free as far as rays pass it at all heights up to `RayISM.clearance`: what stands in a gap between rays, as
    something black without depth, or hangs above the view, as the top of a table before a low camera, is not seen.

    Parameters
    ----------
    spec : GridSpec
        The grid to fill.
    mount : Mount, optional
        See `RayISM`.
    """
    return RayISM(spec, mount, **PARAMETERS)
