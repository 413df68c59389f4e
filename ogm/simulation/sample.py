"""One sample of a dataset: lidar range image, true cell states around the sensor, and nearby traffic participants.

Needs numpy only, so that datasets can be read without the simulator installed.

>>> from ogm.simulation.sample import Weather
>>> Weather(fog=50.0)                                                       # visibility [m]
Weather(rain=0.0, fog=50.0, wet=0.0, dust=0.0)
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.scan import Scan
from ogm.simulation.mesh import Array, Bytes, Floats, Floats32, Ints32, Mask
from ogm.state import Truth

__all__ = ["LABELS", "OBJECT_DTYPE", "RANGE_STEP", "Beams", "SimulatedSample", "Weather"]

# Columns of a stored detection, in this order; x, y and z are in the sensor's frame.
DETECTION = ("x", "y", "z", "doppler", "compensated", "rcs", "snr", "origin", "object")


class Origin(IntEnum):
    """Cause of a radar detection."""

    OBJECT = 0  # a static or moving object at the reported position
    GROUND = 1
    GHOST = 2  # an object at a wrong position, seen through a mirror
    CLUTTER = 3  # noise


class RadarSweep(NamedTuple):
    """Detections of one radar sweep, in the sensor's frame.

    Attributes
    ----------
    xyz : (N, 3) float32
        Positions [m]; z is 0 for a radar without elevation.
    doppler : (N,) float32
        Radial velocity relative to the sensor, positive away from it, folded into the unambiguous interval [m/s].
    compensated : (N,) float32
        Radial velocity over ground [m/s]: 0 up to noise for static objects, except for ghosts.
    rcs : (N,) float32
        Radar cross section [dBsm].
    snr : (N,) float32
        Signal-to-noise ratio [dB].
    origin : (N,) uint8
        `Origin` of each detection.
    object : (N,) int32
        Index of the moving object in the list given to `Scene.place`; -1 for other causes.
    """

    xyz: Floats32
    doppler: Floats32
    compensated: Floats32
    rcs: Floats32
    snr: Floats32
    origin: Bytes
    object: Ints32

    def scan(self, stamp: float | None = None, sensor: str = "", doppler_interval: float | None = None) -> Scan:
        """Return the sweep as a `Scan` with Doppler velocities relative to the sensor and radar cross sections."""
        points = np.pad(self.xyz, ((0, 0), (0, 1)))
        return Scan(
            points, stamp=stamp, doppler=self.doppler, rcs=self.rcs, sensor=sensor, doppler_interval=doppler_interval
        )

    @property
    def table(self) -> Floats32:
        """Columns `DETECTION`, (N, 9)."""
        return np.column_stack([self.xyz, *self[1:]]).astype(np.float32)

    @classmethod
    def of_table(cls, table: Floats32) -> "RadarSweep":
        """Make a sweep from its `table`."""
        doppler, compensated, rcs, snr, origin, number = table[:, 3:].T
        return cls(table[:, :3], doppler, compensated, rcs, snr, origin.astype(np.uint8), number.astype(np.int32))


class PlacedSweep(NamedTuple):
    """A radar sweep of a dataset with its stamp, pose and velocity.

    Attributes
    ----------
    radar : int
        Index of the radar in the plan.
    stamp : float
        Time of the sweep [s].
    T_world_sensor : (4, 4) float64
    velocity : (3,) float64
        Velocity of the sensor, along the axes of the world frame [m/s].
    detections : RadarSweep
        Detections of the sweep. Their `object` is the track of a traffic participant, -1 for other causes.
    """

    radar: int
    stamp: float
    T_world_sensor: Floats
    velocity: Floats
    detections: RadarSweep


RANGE_STEP = 0.004  # [m] resolution of stored ranges, as in Velodyne's packets
LABELS = ("car", "van", "truck", "trailer", "bus", "motorcycle", "bicycle", "pedestrian")
_BOX = ("x", "y", "z", "length", "width", "height", "yaw", "vx", "vy")
# One traffic participant. label: index in LABELS; x, y, z: centre of the upright box in the sensor's frame [m];
# length, width, height [m]; yaw: direction of the forward axis about the sensor's z axis [rad]; vx, vy: velocity over
# ground along the sensor's x and y axes [m/s]; track: number of the participant, constant within a scenario;
# returns: number of this sample's points on it.
OBJECT_DTYPE = np.dtype(
    [("label", np.uint8), *((name, np.float32) for name in _BOX), ("track", np.int32), ("returns", np.int32)]
)


class Weather(NamedTuple):
    """Rain, fog, dust and wetness of the ground.

    Attributes
    ----------
    rain : float
        Rain rate [mm/h].
    fog : float
        Meteorological visibility [m], inf for clear air.
    wet : float
        Wetness of the ground, 0 (dry) to 1 (asphalt as `ogm.simulation.materials.Material.WET_ASPHALT`).
    dust : float
        Extinction coefficient of the densest dust cloud [1/m].
    """

    rain: float = 0.0
    fog: float = float("inf")
    wet: float = 0.0
    dust: float = 0.0


def shown_share(kind: str, columns: int, step: float) -> float:
    """Return the share of a turn in which a sensor measures; 0 for a depth camera."""
    return 0.0 if kind == "depth" else min(abs(step) * columns / (2 * np.pi), 1.0)


@dataclass(frozen=True)
class Beams:
    """Beam directions of a lidar, which turn a range image into points.

    Parameters
    ----------
    name : str
    elevation : tuple of float
        Elevation of each layer above the sensor's xy plane [rad], ascending.
    azimuth : tuple of float
        Azimuth of each layer's beam in column 0, from x towards y [rad].
    step : float
        Angle between columns [rad]; negative for a lidar that turns clockwise, seen from above.
    columns : int
        Beams per layer and turn.
    rate : float
        Rotation rate [Hz].
    origin : tuple of (x, y, z)
        Start of each layer's beams in the sensor's frame [m].
    kind : {"", "planar", "depth"}
        See `ogm.scan.Scan.kind`. The layers of a depth camera are the image rows, `elevation` is measured in the middle
        column, and `step` is the pixel spacing on an image plane at distance 1.
    range_min, range_max : float
        Smallest and largest range of a planar laser or depth camera [m]; 0 for lidars.
    """

    name: str
    elevation: tuple[float, ...]
    azimuth: tuple[float, ...]
    step: float
    columns: int
    rate: float
    origin: tuple[tuple[float, float, float], ...]
    kind: str = ""
    range_min: float = 0.0
    range_max: float = 0.0

    def __post_init__(self) -> None:
        layers = len(self.elevation)
        if not layers == len(self.azimuth) == len(self.origin) or layers == 0:
            counts = f"{layers}, {len(self.azimuth)} and {len(self.origin)}"
            raise ValueError(f"{self.name} must have one elevation, azimuth and origin per layer, got {counts}")
        angles = (*self.elevation, *self.azimuth, self.step, self.rate, *sum(self.origin, ()))
        if not np.isfinite(angles).all():
            raise ValueError(f"angles, origins and rate of {self.name} must be finite, got NaN or inf")
        if self.kind not in ("", "planar", "depth") or bool(self.kind) != (0 <= self.range_min < self.range_max < 1e4):
            limits = f"{self.range_min:g} ... {self.range_max:g} m"
            raise ValueError(
                f'kind of {self.name} must be "" without range limits, or "planar" or "depth" with limits, got '
                f"{self.kind!r}, {limits}"
            )
        if self.kind == "depth" and not (
            np.abs((*self.elevation, *self.azimuth)).max() < np.pi / 2 and len({*self.azimuth}) == 1 and self.step < 0
        ):
            raise ValueError(
                f"depth camera {self.name} must have angles below 90 degrees, one azimuth and a negative step "
                "(columns from left to right)"
            )
        if self.columns < 1 or not self.rate > 0:
            raise ValueError(f"columns and rate of {self.name} must be positive, got {self.columns} and {self.rate}")

    @property
    def shape(self) -> tuple[int, int]:
        """Number of layers and columns of a range image."""
        return len(self.elevation), self.columns

    @cached_property
    def directions(self) -> Floats32:
        """Unit directions in the sensor's frame, (layers, columns, 3)."""
        elevation = np.array(self.elevation)[:, None]
        if self.kind == "depth":
            across = np.tan(self.azimuth)[:, None] + self.step * np.arange(self.columns)
            ways = np.stack(np.broadcast_arrays(1.0, across, np.tan(elevation)), axis=-1)
            return np.asarray(ways / np.linalg.norm(ways, axis=-1, keepdims=True), np.float32)
        azimuth = np.array(self.azimuth)[:, None] + self.step * np.arange(self.columns)
        return np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth],
            axis=-1,
        ).astype(np.float32)

    @cached_property
    def origins(self) -> Floats32:
        """Start of each layer's beams [m], (layers, 3)."""
        return np.array(self.origin, np.float32)

    @cached_property
    def times(self) -> Floats32:
        """Time of each column [s], (columns,) float32; 0 in the middle of the turn."""
        times = ((np.arange(self.columns) + 0.5) / self.columns - 0.5) / self.rate
        if self.kind:
            times = times * shown_share(self.kind, self.columns, self.step)
        return times.astype(np.float32)

    def to_dict(self) -> dict[str, Any]:
        """Return the parameters as a dict for `from_dict`; a lidar has no kind and no range limits in it."""
        numbers = asdict(self)
        return numbers if self.kind else {name: numbers[name] for name in list(numbers)[:-3]}

    @classmethod
    def from_dict(cls, numbers: Mapping[str, Any]) -> "Beams":
        """Make beams from the dict of `to_dict`, also after a round trip through JSON."""
        angles = {name: tuple(map(float, numbers[name])) for name in ("elevation", "azimuth")}
        origin = tuple((float(x), float(y), float(z)) for x, y, z in numbers["origin"])
        return cls(**{**numbers, **angles, "origin": origin})


@dataclass(frozen=True, eq=False)
class SimulatedSample:
    """One turn of a lidar with the true states of the cells around it.

    Parameters
    ----------
    beams : Beams
        The lidar.
    steps : (layers, columns) uint16
        Range image in steps of `RANGE_STEP`; 0 for no return.
    intensities : (layers, columns) uint8
        Intensities 0 to 255, calibrated as Velodyne's.
    truth : Truth
        True cell states in the sensor's x and y, with heights if the dataset has them.
    objects : (K,) array of `OBJECT_DTYPE`
        Traffic participants nearby.
    T_world_sensor, T_vehicle_sensor : (4, 4) float64
        Pose of the sensor in the world, and in the vehicle.
    velocity : (3,) float64
        Velocity of the ego vehicle, along the axes of the world frame [m/s].
    yaw_rate : float
        Yaw rate of the ego vehicle [rad/s].
    stamp : float
        Time since the start of the scenario, in the middle of the turn [s].
    split : str
        Split of the dataset: "training", "validation", "test" or "sequences".
    index : int
        Index in the split.
    scenario : int
        Index of the drive within the split. Samples of a drive share streets and traffic.
    weather : Weather
    measured : (layers, columns) bool, optional
        Beams that were fired and reported; None for all. Other beams are neither points nor beams without echo.
    sweeps : tuple of PlacedSweep
        Radar sweeps, in the order of the plan's radars, each radar's in order of time.
    """

    beams: Beams
    steps: NDArray[np.uint16]
    intensities: Bytes
    truth: Truth
    objects: Array
    T_world_sensor: Floats
    T_vehicle_sensor: Floats
    velocity: Floats
    yaw_rate: float
    stamp: float
    split: str
    index: int
    scenario: int
    weather: Weather = Weather()
    measured: Mask | None = None
    sweeps: tuple[PlacedSweep, ...] = ()

    @property
    def lidar(self) -> str:
        """Name of the lidar."""
        return self.beams.name

    @cached_property
    def points(self) -> Floats32:
        """Returns (N, 4) float32: x, y, z in the sensor's frame [m], intensity [0, 1]; layer by layer."""
        beam = np.flatnonzero(self.steps)
        distance = (self.steps.ravel()[beam] * RANGE_STEP).astype(np.float32)
        result = np.empty((len(beam), 4), np.float32)
        xyz = self.beams.directions.reshape(-1, 3).take(beam, axis=0)
        xyz *= distance[:, None]
        xyz += np.repeat(self.beams.origins, np.count_nonzero(self.steps, axis=1), axis=0)
        result[:, :3] = xyz
        result[:, 3] = self.intensities.ravel()[beam] * np.float32(1 / 255)
        return result

    @property
    def no_returns(self) -> Floats32:
        """Unit directions of measured beams without return, (M, 3) float32; empty for depth cameras."""
        if self.beams.kind == "depth":
            return np.zeros((0, 3), np.float32)
        silent = self.steps == 0
        return np.asarray(self.beams.directions[silent if self.measured is None else silent & self.measured])

    @property
    def ring(self) -> NDArray[np.uint16]:
        """Layer of each point, (N,) uint16; 0 is the lowest."""
        return np.nonzero(self.steps)[0].astype(np.uint16)

    @property
    def column(self) -> NDArray[np.uint16]:
        """Column of each point, (N,) uint16."""
        return np.nonzero(self.steps)[1].astype(np.uint16)

    @property
    def time(self) -> Floats32:
        """Time of each point relative to `stamp` [s], (N,) float32."""
        return self.beams.times[np.nonzero(self.steps)[1]]
