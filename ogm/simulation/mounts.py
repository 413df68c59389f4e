"""Which lidars and radars a data set has, how they are mounted, and how often.

>>> from ogm.simulation.mounts import only, radars_at
>>> only("vlp-16")[0].lidar, [radar.name for radar in radars_at(["ars548"])]
('vlp-16', ['ars548-front'])
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from ogm.simulation.radars import RADARS
from ogm.simulation.robot_sensors import sensor_spec

__all__ = ["FULL_TURN", "MOUNTS", "PLACES", "LidarMount", "RadarMount", "only", "radars_at"]

FULL_TURN = 2 * math.pi


@dataclass(frozen=True)
class LidarMount:
    """A lidar, planar laser or depth camera, how it is mounted, and how often.

    Parameters
    ----------
    lidar : str
        Name in `ogm.simulation.sensors.LIDARS` or `ogm.simulation.robot_sensors.ROBOT_SENSORS`.
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
        for name, pair, low, high in (("height", self.height, 0.1, 5.0), ("forward", self.forward, -3.0, 3.0)):
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
    """Return the mounts of a data set that has one sensor, level: a lidar mid-roof as the paper's, others at the front.

    Parameters
    ----------
    lidar : str
        A name of `LidarMount`, and perhaps ``@`` and a height above the ground [m], as ``utm-30lx@0.5``.

    Raises
    ------
    ValueError
        If there is no such sensor, or the height is none.
    """
    name, at, height = lidar.partition("@")
    forward = sensor_spec(name).forward
    try:
        heights = (float(height),) * 2 if at else None
    except ValueError:
        raise ValueError(f"after @ of {name} stands a height above the ground [m], got {height!r}") from None
    return (LidarMount(name, height=heights, forward=(forward, forward)),)


@dataclass(frozen=True)
class RadarMount:
    """A radar and where it is mounted.

    Parameters
    ----------
    name : str
        Of the sensor; no other radar of the vehicle has the same.
    radar : str
        Name in `ogm.simulation.radars.RADARS`.
    x, y, z : float
        From the middle of the vehicle's footprint, on the ground [m].
    yaw : float
        Of the middle of its field of view [rad].
    """

    name: str
    radar: str
    x: float
    y: float
    z: float
    yaw: float = 0.0

    def __post_init__(self) -> None:
        if not self.name or not self.name.isprintable() or len(self.name) > 64:
            raise ValueError(f"the name of a radar must be 1 to 64 characters, got {self.name!r}")
        if self.radar not in RADARS:
            raise ValueError(f"there is no radar {self.radar!r}; there are {', '.join(RADARS)}")
        bounds = {"x": (-20.0, 20.0), "y": (-5.0, 5.0), "z": (0.1, 5.0), "yaw": (-math.pi, math.pi)}
        for key, (low, high) in bounds.items():
            value = float(getattr(self, key))
            if not low <= value <= high:  # NaN fails too
                raise ValueError(f"{key} of {self.name} must lie in {low:.4g} ... {high:.4g}, got {value}")
            object.__setattr__(self, key, value)


_HALF, _SIDE = 2.45, 1.0  # [m] the bumpers, and the corners, of the ego vehicle
PLACES = {  # x, y, z [m], yaw [degrees]
    "front": (_HALF, 0.0, 0.5, 0.0),
    "rear": (-_HALF, 0.0, 0.5, 180.0),
    "front-left": (_HALF - 0.2, _SIDE, 0.6, 60.0),
    "front-right": (_HALF - 0.2, -_SIDE, 0.6, -60.0),
    "rear-left": (-_HALF + 0.2, _SIDE, 0.6, 120.0),
    "rear-right": (-_HALF + 0.2, -_SIDE, 0.6, -120.0),
}
_CORNERS = tuple(place for place in PLACES if "-" in place)


def radars_at(names: Iterable[str]) -> tuple[RadarMount, ...]:
    """Return radars by words such as ``ars548`` or ``ars408@rear``.

    Parameters
    ----------
    names : iterable of str
        A name in `RADARS`, and perhaps ``@`` and a name in `PLACES`. Without a place, ``corner`` is one radar at each
        of the four corners, and another radar is in front.

    Raises
    ------
    ValueError
        If there is no such radar or place, or two are at one place with one name.
    """
    result = []
    for word in names:
        radar, _, place = word.partition("@")
        if radar not in RADARS or place not in ("", *PLACES):
            raise ValueError(
                f"a radar is one of {', '.join(RADARS)}, or such a name, @ and a place, which is one of "
                f"{', '.join(PLACES)}; got {word!r}"
            )
        places = (place,) if place else _CORNERS if radar == "corner" else ("front",)
        for one in places:
            x, y, z, degrees = PLACES[one]
            result.append(RadarMount(f"{radar}-{one}", radar, x, y, z, math.radians(degrees)))
    return tuple(result)
