"""Readers of point clouds, poses and labels, in metres, x forward, y left, z up; grid files, read and written.

A new format of point clouds belongs in `ogm.io.formats`. Labels of a dataset are read by the module of its name:
`ogm.io.kitti`, `ogm.io.nuscenes`, ...

>>> import numpy as np
>>> from ogm import EvidentialGrid, GridSpec
>>> from ogm.io import read_grid, write_grid
>>> grid = EvidentialGrid(GridSpec(0.1, (2, 1), (0.0, 0.0)), np.array([[[1, 0]], [[0, 1]]], np.float32))
>>> write_grid("map.yaml", grid)                                            # for nav2's map_server
>>> read_grid("map.yaml").mass[:, 0]
array([[1., 0.],
       [0., 1.]], dtype=float32)
"""

from ogm.io.depth import T_OPTICAL_BODY, Intrinsics, depth_scan, read_intrinsics
from ogm.io.grids.files import read_any_grid, read_grid, read_placed_grid, write_grid
from ogm.io.grids.logged import GridLog
from ogm.io.grids.placed import PlacedGrid
from ogm.io.grids.scientific import from_xarray, to_xarray
from ogm.io.ground_plane import estimate_sensor_height
from ogm.io.kitti import read_calibration
from ogm.io.messages.costs import occupancy_from_costs
from ogm.io.messages.grids import grid_from_layer
from ogm.io.poses import Poses, read_poses, write_poses
from ogm.io.scan import describe, read_points, read_scan, read_scan_file
from ogm.io.scan_table import AXES, Axes, FileFacts
from ogm.io.transforms import StampedTransform, TransformBuffer

__all__ = [
    "AXES", "T_OPTICAL_BODY", "Axes", "FileFacts", "GridLog", "Intrinsics", "PlacedGrid", "Poses", "StampedTransform",
    "TransformBuffer", "depth_scan", "describe", "estimate_sensor_height", "from_xarray", "grid_from_layer",
    "occupancy_from_costs", "read_any_grid", "read_calibration", "read_grid", "read_intrinsics", "read_placed_grid",
    "read_points", "read_poses", "read_scan", "read_scan_file", "to_xarray", "write_grid", "write_poses",
]  # fmt: skip
