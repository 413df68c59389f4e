"""Geometric inverse sensor models: one lidar scan to one evidential grid, by ray casting.

The kernels are compiled by numba at their first call in a new environment and cached on disk after that.
"""

from ogm.doppler import moving_detections, sensor_velocity
from ogm.geometric.ground import flat_ground, ground_height, local_ground, patchwork_ground
from ogm.geometric.height_band import HeightBandISM
from ogm.geometric.radar import RadarISM
from ogm.geometric.ray import RayISM

__all__ = [
    "HeightBandISM", "RadarISM", "RayISM", "flat_ground", "ground_height", "local_ground", "moving_detections",
    "patchwork_ground", "sensor_velocity",
]  # fmt: skip
