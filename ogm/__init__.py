"""Evidential occupancy grid maps from lidar and radar.

The names below and the packages of `ogm` are loaded at first use: ``import ogm`` imports neither numba nor torch nor
open3d, and ``ogm.evidence.dempster`` works without a further import.
"""

from typing import TYPE_CHECKING

from ogm.extras import lazy_names

if TYPE_CHECKING:
    from ogm import (  # noqa: F401
        calibration,
        datasets,
        deep,
        evaluation,
        evidence,
        fusion,
        geometric,
        io,
        live,
        metrics,
        models,
        planning,
        plot,
        simulation,
        storage,
        truth,
        workflows,
        world,
    )
    from ogm.datasets import open_dataset
    from ogm.dynamic_grid import DynamicGrid
    from ogm.evaluation import evaluate
    from ogm.fusion import fuse, map_scans
    from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid
    from ogm.io import read_points, read_scan
    from ogm.models import load_model
    from ogm.scan import Boxes, Frame, InverseSensorModel, Mount, Scan
    from ogm.state import CellState, Motion, Truth
    from ogm.storage.files import OgmError
    from ogm.unknown_cause import UnknownCause

__version__ = "0.1.0"
__all__ = [
    "Boxes", "CellState", "DynamicGrid", "EvidentialGrid", "Frame", "GridSpec", "InverseSensorModel", "LayeredGrid",
    "Motion", "Mount", "OgmError", "Scan", "Truth", "UnknownCause", "evaluate", "fuse", "load_model", "map_scans",
    "open_dataset", "read_points", "read_scan",
]  # fmt: skip

_MODULES = {
    **dict.fromkeys(("EvidentialGrid", "GridSpec", "LayeredGrid"), "ogm.grid"),
    **dict.fromkeys(("Boxes", "Frame", "InverseSensorModel", "Mount", "Scan"), "ogm.scan"),
    **dict.fromkeys(("CellState", "Motion", "Truth"), "ogm.state"),
    **{"DynamicGrid": "ogm.dynamic_grid", "OgmError": "ogm.storage.files", "evaluate": "ogm.evaluation"},
    **{"fuse": "ogm.fusion", "map_scans": "ogm.fusion", "load_model": "ogm.models", "open_dataset": "ogm.datasets"},
    **{"read_points": "ogm.io", "read_scan": "ogm.io", "UnknownCause": "ogm.unknown_cause"},
    **{
        name: f"ogm.{name}"
        for name in (
            *("calibration", "datasets", "deep", "evaluation", "evidence", "fusion", "geometric", "io", "live"),
            *("metrics", "models", "planning", "plot", "simulation", "storage", "truth", "workflows", "world"),
        )
    },
}
__getattr__ = lazy_names("ogm", _MODULES)


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
