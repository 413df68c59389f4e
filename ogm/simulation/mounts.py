"""Which lidars a data set has, how they are mounted, and how often."""

import math
from dataclasses import dataclass

__all__ = ["FULL_TURN", "MOUNTS", "LidarMount", "only"]

FULL_TURN = 2 * math.pi


@dataclass(frozen=True)
class LidarMount:
    """A lidar, how it is mounted, and how often.

    Parameters
    ----------
    lidar : str
        Name in `ogm.simulation.sensors.LIDARS`.
    share : float
        Share of the samples taken with it, relative to that of the other mounts.
    height : (float, float), optional
        Lowest and highest mounting height above the ground [m]; drawn anew for each sample (each sequence). By
        default the lidar's usual height.
    forward : (float, float)
        The same along the vehicle's x axis, from the middle of its footprint [m].
    tilt : float
        Largest roll and pitch of the mounting [rad], drawn likewise.
    view : float
        Width of the sector around straight ahead in which it fires [rad]: less than a turn for a lidar that does not
        turn. Recipes alone regard it.
    """

    lidar: str
    share: float = 1.0
    height: tuple[float, float] | None = None
    forward: tuple[float, float] = (0.0, 0.0)
    tilt: float = 0.0
    view: float = FULL_TURN

    def __post_init__(self) -> None:
        if self.height is not None:
            object.__setattr__(self, "height", tuple(map(float, self.height)))
        object.__setattr__(self, "forward", tuple(map(float, self.forward)))
        if not (self.share > 0 and math.isfinite(self.share)):
            raise ValueError(f"the share of {self.lidar} must be positive, got {self.share}")
        for name, pair, low, high in (("height", self.height, 0.3, 5.0), ("forward", self.forward, -3.0, 3.0)):
            if pair is not None and (len(pair) != 2 or not low <= pair[0] <= pair[1] <= high):
                raise ValueError(
                    f"{name} of {self.lidar} must be two numbers, rising, in {low} ... {high} m, got {pair}"
                )
        if not 0 <= self.tilt <= 0.2:
            raise ValueError(f"tilt of {self.lidar} must be in 0 ... 0.2 rad, got {self.tilt}")
        if not 0 < self.view <= FULL_TURN:
            raise ValueError(f"view of {self.lidar} must be in 0 ... 2 pi rad, got {self.view}")


# Four samples in five as in the paper; the others so that a network can be trained for more than one car.
MOUNTS = (
    LidarMount("vlp-32c", 0.80),
    LidarMount("vlp-32c", 0.05, (1.7, 2.4), (-0.4, 0.4), 0.03),
    LidarMount("hdl-32e", 0.05, (1.7, 2.2), (-0.4, 0.4), 0.03),
    LidarMount("hdl-64e", 0.04, (1.7, 2.1), (-0.4, 0.4), 0.03),
    LidarMount("os1-64", 0.04, (1.7, 2.2), (-0.4, 0.4), 0.03),
    LidarMount("vls-128", 0.02, (1.7, 2.2), (-0.4, 0.4), 0.03),
)


def only(lidar: str) -> tuple[LidarMount, ...]:
    """Return the mounts of a data set that has one lidar, mounted as the paper's: mid-roof and level."""
    return (LidarMount(lidar),)
