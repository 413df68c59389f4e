"""Geometric inverse sensor models of lidar and radar: one scan to one evidential grid.

The kernels are compiled by numba at their first call in a new environment and cached on disk after that.

>>> import numpy as np
>>> from ogm import GridSpec, Mount
>>> from ogm.geometric import RayISM
>>> x, y = np.mgrid[3:12:0.1, -4:4:0.1].reshape(2, -1)     # flat ground, 1.8 m below
>>> spec = GridSpec.centered(length=24.0, width=16.0, resolution=0.5)
>>> ism = RayISM(spec, Mount(sensor_height=1.8))
>>> grid = ism(np.column_stack([x, y, np.full(x.size, -1.8), np.zeros(x.size)]))
>>> bool(grid.at(8.0, 1.0).free > 0.9), float(grid.at(-8.0, 1.0).unknown)
(True, 1.0)
"""

from ogm.geometric.doppler import moving_detections, sensor_velocity
from ogm.geometric.ground import flat_ground, ground_height, local_ground, patchwork_ground, points_down, shows_ground
from ogm.geometric.height_band import HeightBandISM
from ogm.geometric.heights import VehicleLimits, height_layers, traversability
from ogm.geometric.planar import PlanarISM, plane_text
from ogm.geometric.radar import RadarISM
from ogm.geometric.ray import RayISM

__all__ = [
    "HeightBandISM", "PlanarISM", "RadarISM", "RayISM", "VehicleLimits", "flat_ground", "ground_height",
    "height_layers", "local_ground", "moving_detections", "patchwork_ground", "plane_text", "points_down",
    "sensor_velocity", "shows_ground", "traversability",
]  # fmt: skip
