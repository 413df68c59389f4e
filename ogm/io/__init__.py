"""Point clouds in: any supported file to points in metres, x forward, y left, z up."""

from ogm.io.axes import AXES, Axes
from ogm.io.points import read_points, read_scan
from ogm.io.scan import Scan, describe, estimate_sensor_height
from ogm.io.source import BYTE_LIMIT

__all__ = [
    "AXES",
    "BYTE_LIMIT",
    "Axes",
    "Scan",
    "describe",
    "estimate_sensor_height",
    "read_points",
    "read_scan",
]
