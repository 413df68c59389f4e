"""Evidential occupancy grid maps from lidar.

The names below load their module when they are first used, so that ``import ogm`` costs next to nothing and
brings in neither torch nor open3d nor matplotlib.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ogm.grid import EvidentialGrid, GridSpec, InverseSensorModel
    from ogm.io import Scan, read_points, read_scan

__version__ = "0.1.0"
__all__ = ["EvidentialGrid", "GridSpec", "InverseSensorModel", "Scan", "read_points", "read_scan"]

_HOME = {
    "EvidentialGrid": "ogm.grid",
    "GridSpec": "ogm.grid",
    "InverseSensorModel": "ogm.grid",
    "Scan": "ogm.io",
    "read_points": "ogm.io",
    "read_scan": "ogm.io",
}


def __getattr__(name: str) -> object:
    """Load a front-door name from its module on first use."""
    if name not in _HOME:
        raise AttributeError(f"module 'ogm' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
