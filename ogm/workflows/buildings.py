"""Maps of buildings: defaults for the scans of planar lasers."""

import math
from typing import NamedTuple

from ogm.datasets import Dataset
from ogm.evidence.map_rules import DYNAMIC, NUSS, REVISE

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
        Time in which belief halves [s]; None for the rule's own.
    """

    resolution: float
    window: str
    half_life: float | None


ROAD = MapDefaults(0.16, "rolling", None)
BUILDING = MapDefaults(0.05, "fixed", math.inf)


def map_defaults(dataset: Dataset, rule: str = REVISE) -> MapDefaults:
    """Return the defaults of a map: `BUILDING` for planar lasers, `ROAD` for other sensors.

    A dynamic map has the cells of its sensor, and the other defaults of `ROAD`.
    """
    usual = BUILDING if is_planar(dataset) else ROAD
    return ROAD._replace(resolution=usual.resolution) if rule in (DYNAMIC, NUSS) else usual


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
