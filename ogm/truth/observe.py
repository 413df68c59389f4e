"""Observation of ground and obstacles in cells, from classified points."""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.grid import GridSpec

GROUND_SEEN, OBSTACLE_SEEN = 1, 2  # bits of an observation


class Kind(IntEnum):
    """Kind of a hit surface, with respect to driving."""

    GROUND = 0  # drivable: frees its cell at any height below the clearance
    OBSTACLE = 1  # counts between the obstacle height and the clearance
    PLANT = 2  # soft: counts as ground below the plant height, as obstacle from there to the clearance
    STEP = 3  # upright face between two levels of ground, such as a kerb: counts by the rise of the ground
    OTHER = 4  # no evidence: no hit, ego vehicle, unlabelled, spray


class HeightLimits(NamedTuple):
    """Heights above ground between which a hit is an obstacle for a car."""

    obstacle: float = 0.05  # [m] lower hits, such as a dropped kerb, are drivable
    plant: float = 0.25  # [m] lower grass and other soft plants are drivable
    clearance: float = 2.0  # [m] higher hits are no obstacles: top of the height band of van Kempen et al. 2021


HEIGHT_LIMITS = HeightLimits()


def observe_points(
    seen: NDArray[np.uint8],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    kind: NDArray[np.integer],
    height: NDArray[np.float64],
    spec: GridSpec,
) -> None:
    """Add classified points to an observation.

    Parameters
    ----------
    seen : (nx, ny) uint8
        Changed in place, bits `GROUND_SEEN` and `OBSTACLE_SEEN`; begin with zeros.
    x, y : (N,) float64
        Positions of the hits in the grid's frame [m]. Hits outside `spec` are ignored.
    kind : (N,) integer
        `Kind` of each hit.
    height : (N,) float64
        Height of each hit above the ground around it [m].
    spec : GridSpec
    """
    limits = HEIGHT_LIMITS
    below = height < limits.clearance
    plant = kind == Kind.PLANT
    free = below & ((kind == Kind.GROUND) | (plant & (height < limits.plant)))
    hard = (kind == Kind.OBSTACLE) | (kind == Kind.STEP)
    obstacle = below & ((hard & (height >= limits.obstacle)) | (plant & (height >= limits.plant)))
    inside = spec.contains(x, y)
    for chosen, bit in ((free & inside, GROUND_SEEN), (obstacle & inside, OBSTACLE_SEEN)):
        seen[spec.index(x[chosen], y[chosen])] |= np.uint8(bit)
