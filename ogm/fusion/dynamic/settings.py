"""Parameters of the dynamic map's model, per second, and their effect between two scans."""

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ogm.fusion.dynamic.cells import Rates


@dataclass(frozen=True)
class DynamicSettings:
    """Parameters of the model of `DynamicMapper`.

    Parameters
    ----------
    free_half_life, static_half_life, dynamic_half_life : float
        Half-lives of free and static mass, and of the number of surviving particles [s]; infinity forgets nothing.
    birth_rate : float
        Rate at which something new appears in a cell [1/s].
    static_share : float
        Share of newly appeared mass that is static, [0, 1].
    to_dynamic_rate : float
        Rate at which static things begin to move [1/s].
    birth_speed : float
        Standard deviation of each velocity component of newly appeared mass [m/s].
    position_noise, velocity_noise : float
        Noise of the particles along each axis: their variances grow by its square per second [m/√s], [m/s/√s].
    association : float
        Probability that the particles of a group caused the measurement of its velocity, [0, 1].
    renewal_likelihood : float
        Mean likelihood of a measured velocity under a cell's particles at which half of them are replaced by births
        with the measured velocity, relative to its maximum, above 0. The default is the likelihood at three standard
        deviations.
    motion_odds : float
        Greatest factor by which a measured velocity raises the odds of dynamic to static in the cells of its group, at
        least 1; with 1 only the particles decide.
    hiding_width : float
        Free in cells within this distance of a dynamic cell that the scan measures as occupied is bounded by the free
        mass of the scan [m]; 0 sets no limit. The default is the greatest width of a road vehicle: Council Directive
        96/53/EC allows 2.6 m.
    conflict_half_life : float
        Half-life of the conflict layers [s]; 0 keeps only the conflict of the last scan.
    min_unknown : float
        Lower bound of unknown, [0, 1), so that new scans can change the map.

    Raises
    ------
    ValueError
        If a number is out of its range.
    """

    free_half_life: float = 2.0
    static_half_life: float = 2.0
    dynamic_half_life: float = 7.0
    birth_rate: float = 0.8
    static_share: float = 0.98
    to_dynamic_rate: float = 0.01
    birth_speed: float = 6.0
    position_noise: float = 0.1
    velocity_noise: float = 0.7
    association: float = 0.95
    renewal_likelihood: float = 0.01
    motion_odds: float = 100.0
    hiding_width: float = 2.6
    conflict_half_life: float = 2.0
    min_unknown: float = 0.02

    def __post_init__(self) -> None:
        for name in (field.name for field in fields(self)):
            value: Any = getattr(self, name)
            if name == "conflict_half_life":
                good, wanted = value >= 0, "0 s or more"
            elif name == "renewal_likelihood":
                good, wanted = 0 < value < math.inf, "greater than 0 and finite"
            elif name.endswith("half_life"):
                good, wanted = value > 0, "greater than 0 s; infinity forgets nothing"
            elif name == "min_unknown":
                good, wanted = 0 <= value < 1, "in [0, 1)"
            elif name in ("static_share", "association"):
                good, wanted = 0 <= value <= 1, "in [0, 1]"
            elif name == "motion_odds":
                good, wanted = 1 <= value < math.inf, "1 or more and finite"
            else:
                good, wanted = 0 <= value < math.inf, "0 or more and finite"
            if not good:
                raise ValueError(f"{name} must be {wanted}, got {value}")

    def rates(self, seconds: float, reliability: float, particle: float) -> Rates:
        """Return the changes of beliefs within some time, for a scan of a reliability and particles of a mass."""
        birth, to_dynamic = (-math.expm1(-rate * seconds) for rate in (self.birth_rate, self.to_dynamic_rate))
        numbers = {
            "keep_free": _kept(seconds, self.free_half_life),
            "keep_static": _kept(seconds, self.static_half_life),
            "keep_conflict": _kept(seconds, self.conflict_half_life),
            "birth": birth,
            "static_share": self.static_share,
            "to_dynamic": to_dynamic,
            "max_known": 1 - self.min_unknown,
            "reliability": reliability,
            "particle": _kept(seconds, self.dynamic_half_life) * particle,
        }
        return Rates(**{name: np.float32(value) for name, value in numbers.items()})

    def noise(self, seconds: float) -> tuple[np.float32, np.float32]:
        """Return the standard deviations of position [m] and velocity [m/s] that particles gain within some time."""
        root = math.sqrt(seconds)
        return np.float32(self.position_noise * root), np.float32(self.velocity_noise * root)


def _kept(seconds: float, half_life: float) -> float:
    """Return the share that remains after some time [s]."""
    if seconds == 0:
        return 1.0
    return 0.5 ** (seconds / half_life) if half_life else 0.0
