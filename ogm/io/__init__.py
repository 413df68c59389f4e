"""Point clouds and poses in: any supported file to metres, x forward, y left, z up.

What is about poses is loaded on first use: it brings scipy, which reading points does without.
"""

import importlib
from typing import TYPE_CHECKING

from ogm.io.axes import AXES, Axes
from ogm.io.points import read_points, read_scan
from ogm.io.scan import Scan, describe, estimate_sensor_height
from ogm.io.source import BYTE_LIMIT

if TYPE_CHECKING:
    from ogm.io.calibration import read_calibration
    from ogm.io.poses import Poses, read_poses, write_poses

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

_HOME = {
    "Poses": "ogm.io.poses",
    "read_calibration": "ogm.io.calibration",
    "read_poses": "ogm.io.poses",
    "write_poses": "ogm.io.poses",
}


def __getattr__(name: str) -> object:
    """Load a name that is about poses on first use."""
    if name not in _HOME:
        raise AttributeError(f"module 'ogm.io' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value
