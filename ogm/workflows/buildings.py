"""Maps of buildings: defaults for the scans of planar lasers, and the window that holds a building."""

import math
from typing import NamedTuple

import numpy as np

from ogm.datasets import Dataset
from ogm.fusion import bounding_window
from ogm.grid import GridSpec

MARGIN = 1.0  # [m] around the echoes
_TRIED = 5  # scans that are read until one can be
_UNREADABLE = (ValueError, TypeError, OSError)


class MapDefaults(NamedTuple):
    """Defaults of a map that depend on the sensor.

    Attributes
    ----------
    resolution : float
        Side of a cell [m].
    window : {"rolling", "fixed"}
    half_life : float or None
        Time in which belief halves [s]; None for that of the rule.
    """

    resolution: float
    window: str
    half_life: float | None


ROAD = MapDefaults(0.16, "rolling", None)
BUILDING = MapDefaults(0.05, "fixed", math.inf)


def map_defaults(dataset: Dataset) -> MapDefaults:
    """Return the defaults of a map: `BUILDING` for planar lasers, `ROAD` for other sensors."""
    return BUILDING if is_planar(dataset) else ROAD


def is_planar(dataset: Dataset) -> bool:
    """Return whether the scans are of a planar laser, by the first that can be read."""
    for frame in dataset[:_TRIED]:
        try:
            return frame.scan.kind == "planar"
        except _UNREADABLE:
            continue  # the mapping reports it
    return False


def has_doubtful_clock(dataset: Dataset) -> bool:
    """Return whether stamps are counted, or the clock has faults: poses far apart in such a time are no jump."""
    return not dataset.recording.stamped or bool(dataset.recording.clock_findings)


def echo_window(dataset: Dataset, spec: GridSpec) -> GridSpec:
    """Return the cells, in map coordinates, that hold all echoes of planar scans and 1 m around them.

    All scans are read once. Echoes beyond the reach of a measurement grid are left out.

    Parameters
    ----------
    dataset : Dataset
        With poses.
    spec : GridSpec
        Cells of a measurement grid.

    Raises
    ------
    ValueError
        If no scan has a pose, or more than 2**24 cells would be needed.
    """
    reach = math.hypot(spec.length, spec.width) / 2
    corners = []
    for frame in dataset:
        T = frame.T_map_sensor
        if T is None:
            continue
        corners.append(np.stack([T[:2, 3], T[:2, 3]]))
        try:
            points = frame.scan.points[:, :3]
        except _UNREADABLE:
            continue  # the mapping reports it
        points = points[np.hypot(points[:, 0], points[:, 1]) < reach]  # NaN is left out
        if len(points):
            ends = points.astype(np.float64) @ T[:2, :3].T + T[:2, 3]
            corners.append(np.stack([ends.min(axis=0), ends.max(axis=0)]))
    if not corners:
        raise ValueError("none of the scans has a pose, so a fixed window has no area")
    both = np.stack(corners)
    return bounding_window(spec.resolution, both[:, 0].min(axis=0) - MARGIN, both[:, 1].max(axis=0) + MARGIN)
