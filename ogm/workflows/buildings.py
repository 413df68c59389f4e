"""Maps of buildings: defaults for the scans of planar lasers."""

import math
from contextlib import suppress
from typing import NamedTuple

from ogm.datasets import Dataset
from ogm.evidence.map_rules import DYNAMIC, NUSS, REVISE, SMOOTH
from ogm.scan import Frame


class MapDefaults(NamedTuple):
    """Sensor-dependent defaults of a map.

    Attributes
    ----------
    resolution : float
        Side of a cell [m].
    window : {"rolling", "fixed"}
    half_life : float or None
        Time in which belief halves [s]; None for the default of the rule.
    rule : str
        Combination rule.
    """

    resolution: float
    window: str
    half_life: float | None
    rule: str


ROAD = MapDefaults(0.16, "rolling", None, REVISE)
BUILDING = MapDefaults(0.05, "fixed", math.inf, SMOOTH)


def map_defaults(dataset: Dataset, rule: str | None = None) -> MapDefaults:
    """Return the defaults of a map: `BUILDING` for planar lasers, `ROAD` for other sensors; `rule` replaces theirs.

    A dynamic map has the resolution of its sensor and the other defaults of `ROAD`.
    """
    usual = BUILDING if is_planar(dataset) else ROAD
    if rule in (DYNAMIC, NUSS):
        usual = ROAD._replace(resolution=usual.resolution)
    return usual if rule is None else usual._replace(rule=rule)


def is_planar(dataset: Dataset) -> bool:
    """Return whether the first readable scan is of a planar laser."""
    frame = first_readable(dataset)
    return frame is not None and frame.scan.kind == "planar"


def first_readable(dataset: Dataset) -> Frame | None:
    """Return the first frame with a readable scan, else None."""
    for frame in dataset:
        with suppress(ValueError, TypeError, OSError):  # reported during mapping
            if frame.scan is not None:
                return frame
    return None


def has_doubtful_clock(dataset: Dataset) -> bool:
    """Return whether stamps are counted from a rate or the clock has faults, so that speeds are unreliable."""
    return not dataset.recording.stamped or bool(dataset.recording.clock_findings)
