"""Which cells hold ground or obstacles, from classified points."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ogm.grid import GridSpec

__all__ = ["GROUND_SEEN", "HEIGHT_LIMITS", "OBSTACLE_SEEN", "HeightLimits", "Kind", "observe_points"]

GROUND_SEEN, OBSTACLE_SEEN = 1, 2  # bits of an observation


class Kind(IntEnum):
    """What was hit, as far as driving is concerned."""

    GROUND = 0  # may be driven over: frees its cell at any height below the clearance
    OBSTACLE = 1  # counts between the obstacle height and the clearance
    PLANT = 2  # soft: counts as ground below the plant height, as obstacle from there to the clearance
    STEP = 3  # upright face between two levels of ground, as of a kerb: counts by the rise of the ground
    OTHER = 4  # no evidence: no hit, ego vehicle, unlabelled, spray


@dataclass(frozen=True)
class HeightLimits:
    """Between which heights above ground a hit blocks a car.

    Parameters
    ----------
    obstacle : float
        Lower hits, such as those on a dropped kerb, can be driven over [m].
    plant : float
        The same for grass and other soft plants [m].
    clearance : float
        Higher hits block no car [m]: the top of the height band of van Kempen et al. 2021.

    Raises
    ------
    ValueError
        If they are not finite, or out of order.
    """

    obstacle: float = 0.05
    plant: float = 0.25
    clearance: float = 2.0

    def __post_init__(self) -> None:
        if not 0 <= self.obstacle <= self.plant < self.clearance < np.inf:
            raise ValueError(
                f"heights must obey 0 <= obstacle <= plant < clearance, got {self.obstacle}, {self.plant}, "
                f"{self.clearance} m"
            )


HEIGHT_LIMITS = HeightLimits()


def observe_points(
    seen: NDArray[np.uint8],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    kind: NDArray[np.integer],
    height: NDArray[np.float64],
    spec: GridSpec,
    limits: HeightLimits = HEIGHT_LIMITS,
) -> None:
    """Add classified points to an observation.

    Parameters
    ----------
    seen : (nx, ny) uint8
        Changed in place, bits `GROUND_SEEN` and `OBSTACLE_SEEN`; begin with zeros.
    x, y, kind, height, spec, limits
        As in `truth_grid`; nothing is checked.
    """
    below = height < limits.clearance
    plant = kind == Kind.PLANT
    free = below & ((kind == Kind.GROUND) | (plant & (height < limits.plant)))
    hard = (kind == Kind.OBSTACLE) | (kind == Kind.STEP)
    obstacle = below & ((hard & (height >= limits.obstacle)) | (plant & (height >= limits.plant)))
    inside = spec.contains(x, y)
    for chosen, bit in ((free & inside, GROUND_SEEN), (obstacle & inside, OBSTACLE_SEEN)):
        seen[spec.index(x[chosen], y[chosen])] |= np.uint8(bit)
