"""Point clouds and poses in: any supported file to metres, x forward, y left, z up."""

from ogm.io.axes import AXES, Axes
from ogm.io.calibration import read_calibration
from ogm.io.points import read_points, read_scan
from ogm.io.poses import Poses, read_poses, write_poses
from ogm.io.scan import Scan, describe, estimate_sensor_height
from ogm.io.source import BYTE_LIMIT

__all__ = [
    "AXES",
    "BYTE_LIMIT",
    "Axes",
    "Poses",
    "Scan",
    "describe",
    "estimate_sensor_height",
    "read_calibration",
    "read_points",
    "read_poses",
    "read_scan",
    "write_poses",
]
