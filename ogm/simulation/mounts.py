"""Lidars and radars of a dataset and their mounting positions.

>>> from ogm.simulation.mounts import single_sensor, radars_at
>>> single_sensor("vlp-16")[0].lidar, [radar.name for radar in radars_at(["ars548"])]
('vlp-16', ['ars548-front'])
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from ogm.simulation.radars import RADARS
from ogm.simulation.robot_sensors import sensor_spec

__all__ = ["FULL_TURN", "MOUNTS", "RADAR_POSITIONS", "LidarMount", "RadarMount", "single_sensor", "radars_at"]

FULL_TURN = 2 * math.pi


@dataclass(frozen=True)
class LidarMount:
    """A lidar, planar laser or depth camera with its mounting position and its share of the samples.

    Parameters
    ----------
    lidar : str
        Name in `ogm.simulation.sensors.LIDARS` or `ogm.simulation.robot_sensors.ROBOT_SENSORS`.
    share : float
        Share of the samples with this sensor, relative to the shares of the other mounts.
    height : (float, float), optional
        Lowest and highest mounting height above the ground [m], drawn uniformly for each sample or sequence. By
        default the usual height of the sensor.
    forward : (float, float)
        Rearmost and foremost position along the vehicle's x axis, from the middle of its footprint [m].
    tilt : float
        Largest roll and pitch of the mounting [rad], 0 to 0.2, drawn uniformly.
    view : float
        Width of the fired sector, centred straight ahead [rad], above 0 and up to 2 pi. Only recipes use it.
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
            raise ValueError(f"share of {self.lidar} must be positive and finite, got {self.share}")
        for name, pair, low, high in (("height", self.height, 0.1, 5.0), ("forward", self.forward, -3.0, 3.0)):
            if pair is not None and (len(pair) != 2 or not low <= pair[0] <= pair[1] <= high):
                raise ValueError(
                    f"{name} of {self.lidar} must be an ascending pair within {low} ... {high} m, got {pair}"
                )
        if not 0 <= self.tilt <= 0.2:
            raise ValueError(f"tilt of {self.lidar} must be in 0 ... 0.2 rad, got {self.tilt}")
        if not 0 < self.view <= FULL_TURN:
            raise ValueError(f"view of {self.lidar} must be in 0 ... 2 pi rad, got {self.view}")


# Four of five samples use the paper's sensor and mount. The others let a network be trained for several cars.
MOUNTS = (
    LidarMount("vlp-32c", 0.80),
    LidarMount("vlp-32c", 0.05, (1.7, 2.4), (-0.4, 0.4), 0.03),
    LidarMount("hdl-32e", 0.05, (1.7, 2.2), (-0.4, 0.4), 0.03),
    LidarMount("hdl-64e", 0.04, (1.7, 2.1), (-0.4, 0.4), 0.03),
    LidarMount("os1-64", 0.04, (1.7, 2.2), (-0.4, 0.4), 0.03),
    LidarMount("vls-128", 0.02, (1.7, 2.2), (-0.4, 0.4), 0.03),
)


def single_sensor(lidar: str) -> tuple[LidarMount, ...]:
    """Return the mounts of a dataset with one level sensor: a lidar mid-roof as in the paper, others at the front.

    Parameters
    ----------
    lidar : str
        Name as in `LidarMount`, optionally followed by ``@`` and a height above the ground [m]: ``utm-30lx@0.5``.

    Raises
    ------
    ValueError
        If the sensor is unknown, or the height is not a number within the bounds of `LidarMount`.
    """
    name, at, height = lidar.partition("@")
    forward = sensor_spec(name).forward
    try:
        heights = (float(height),) * 2 if at else None
    except ValueError:
        raise ValueError(f"@ after {name} must be followed by a height above the ground [m], got {height!r}") from None
    return (LidarMount(name, height=heights, forward=(forward, forward)),)


@dataclass(frozen=True)
class RadarMount:
    """A radar and its mounting position.

    Parameters
    ----------
    name : str
        Name of the sensor, unique on the vehicle; 1 to 64 printable characters.
    radar : str
        Name in `ogm.simulation.radars.RADARS`.
    x, y : float
        Position from the middle of the vehicle's footprint [m], within 20 m and 5 m.
    z : float
        Height above the ground [m], 0.1 to 5.
    yaw : float
        Direction of the middle of its field of view [rad], -pi to pi.
    """

    name: str
    radar: str
    x: float
    y: float
    z: float
    yaw: float = 0.0

    def __post_init__(self) -> None:
        if not self.name or not self.name.isprintable() or len(self.name) > 64:
            raise ValueError(f"the name of a radar must be 1 to 64 printable characters, got {self.name!r}")
        if self.radar not in RADARS:
            raise ValueError(f"unknown radar {self.radar!r}; known radars: {', '.join(RADARS)}")
        bounds = {"x": (-20.0, 20.0), "y": (-5.0, 5.0), "z": (0.1, 5.0), "yaw": (-math.pi, math.pi)}
        for key, (low, high) in bounds.items():
            value = float(getattr(self, key))
            if not low <= value <= high:  # NaN fails too
                raise ValueError(f"{key} of {self.name} must be in {low:.4g} ... {high:.4g}, got {value}")
            object.__setattr__(self, key, value)


_HALF, _SIDE = 2.45, 1.0  # [m] from the middle of the ego vehicle to its bumpers and to its corners
RADAR_POSITIONS = {  # x, y, z [m], yaw [degrees]
    "front": (_HALF, 0.0, 0.5, 0.0),
    "rear": (-_HALF, 0.0, 0.5, 180.0),
    "front-left": (_HALF - 0.2, _SIDE, 0.6, 60.0),
    "front-right": (_HALF - 0.2, -_SIDE, 0.6, -60.0),
    "rear-left": (-_HALF + 0.2, _SIDE, 0.6, 120.0),
    "rear-right": (-_HALF + 0.2, -_SIDE, 0.6, -120.0),
}
_CORNERS = tuple(place for place in RADAR_POSITIONS if "-" in place)


def radars_at(names: Iterable[str]) -> tuple[RadarMount, ...]:
    """Return radar mounts by names such as ``ars548`` or ``ars408@rear``.

    Parameters
    ----------
    names : iterable of str
        Names in `RADARS`, each optionally followed by ``@`` and a name in `RADAR_POSITIONS`. Without a position,
        ``corner`` gives one radar at each of the four corners, and any other name one radar at the front.

    Raises
    ------
    ValueError
        If a radar or a place is unknown.
    """
    result = []
    for word in names:
        radar, _, place = word.partition("@")
        if radar not in RADARS or place not in ("", *RADAR_POSITIONS):
            raise ValueError(
                f"a radar must be one of {', '.join(RADARS)}, optionally followed by @ and one of "
                f"{', '.join(RADAR_POSITIONS)}; got {word!r}"
            )
        places = (place,) if place else _CORNERS if radar == "corner" else ("front",)
        for position in places:
            x, y, z, degrees = RADAR_POSITIONS[position]
            result.append(RadarMount(f"{radar}-{position}", radar, x, y, z, math.radians(degrees)))
    return tuple(result)
