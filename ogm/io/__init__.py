"""Point clouds, poses and labels in: any supported file to metres, x forward, y left, z up. Grids both ways.

A new format of point clouds goes to `ogm.io.formats`; the labels of a data set are read by the module of its name.

>>> import numpy as np
>>> from ogm import EvidentialGrid, GridSpec
>>> from ogm.io import read_grid, write_grid
>>> grid = EvidentialGrid(GridSpec(0.1, (2, 1), (0.0, 0.0)), np.array([[[1, 0]], [[0, 1]]], np.float32))
>>> write_grid("map.yaml", grid)                                            # for nav2's map_server
>>> read_grid("map.yaml").mass[:, 0]
array([[1., 0.],
       [0., 1.]], dtype=float32)
"""

from ogm.io.argoverse2 import read_argoverse2
from ogm.io.axes import AXES, Axes
from ogm.io.grids import (
    GridLog,
    PlacedGrid,
    from_xarray,
    read_any_grid,
    read_grid,
    read_placed_grid,
    to_xarray,
    write_grid,
)
from ogm.io.kitti import read_calibration, read_kitti_objects, read_kitti_stamps, read_kitti_tracks
from ogm.io.labels import LabelledPoints
from ogm.io.nuscenes import NuScenes, read_mmdet3d, read_nuscenes
from ogm.io.poses import Poses, read_poses, write_poses
from ogm.io.radar import read_nuscenes_radar
from ogm.io.radarscenes import RadarScenes, RadarScenesSweep, read_radarscenes
from ogm.io.range_images import NUSCENES_ELEVEN, read_range_image
from ogm.io.scan import FileFacts, describe, read_points, read_scan, read_scan_file
from ogm.io.semantic_kitti import SEMANTIC_KITTI, SEMANTIC_KITTI_MOVING, SEMANTIC_KITTI_TRAINING, read_semantic_kitti
from ogm.io.sensor_height import estimate_sensor_height, plausible_sensor_height
from ogm.io.sustech import read_sustech
from ogm.io.transforms import StampedTransform, TransformBuffer

__all__ = [
    "AXES",
    "NUSCENES_ELEVEN",
    "SEMANTIC_KITTI",
    "SEMANTIC_KITTI_MOVING",
    "SEMANTIC_KITTI_TRAINING",
    "Axes",
    "FileFacts",
    "GridLog",
    "LabelledPoints",
    "NuScenes",
    "PlacedGrid",
    "Poses",
    "RadarScenes",
    "RadarScenesSweep",
    "StampedTransform",
    "TransformBuffer",
    "describe",
    "estimate_sensor_height",
    "from_xarray",
    "plausible_sensor_height",
    "read_argoverse2",
    "read_calibration",
    "read_any_grid",
    "read_grid",
    "read_kitti_objects",
    "read_kitti_stamps",
    "read_kitti_tracks",
    "read_mmdet3d",
    "read_nuscenes",
    "read_nuscenes_radar",
    "read_placed_grid",
    "read_points",
    "read_poses",
    "read_radarscenes",
    "read_range_image",
    "read_scan",
    "read_scan_file",
    "read_semantic_kitti",
    "read_sustech",
    "to_xarray",
    "write_grid",
    "write_poses",
]
