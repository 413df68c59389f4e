"""One sample of a data set: the lidar's range image, the truth around it, and the traffic participants nearby.

Needs numpy only, so that data sets are read where the simulator is not installed.

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

__all__ = ["LABELS", "OBJECT", "RANGE_STEP", "Beams", "SimulatedSample", "Weather"]

# columns of a detection in a data set, in this order; the first three are x, y, z in the sensor's frame
DETECTION = ("x", "y", "z", "doppler", "compensated", "rcs", "snr", "origin", "object")


class Origin(IntEnum):
    """What a detection is of."""

    OBJECT = 0  # anything that stands or moves where it is reported
    GROUND = 1
    GHOST = 2  # a real thing in a wrong place, by way of a mirror
    CLUTTER = 3  # noise


class RadarSweep(NamedTuple):
    """The detections of one sweep, in the sensor's frame.

    Attributes
    ----------
    xyz : (N, 3) float32
        [m]; z is 0 for a radar without elevation.
    doppler : (N,) float32
        Radial velocity against the sensor, positive away from it, folded into the unambiguous interval [m/s].
    compensated : (N,) float32
        The same over ground: of what stands still it is 0 but for noise, and for ghosts.
    rcs : (N,) float32
        Radar cross section [dBsm].
    snr : (N,) float32
        Signal-to-noise ratio [dB].
    origin : (N,) uint8
        `Origin`.
    object : (N,) int32
        Number of the moving thing in the list given to `Scene.place`; -1 for none.
    """

    xyz: Floats32
    doppler: Floats32
    compensated: Floats32
    rcs: Floats32
    snr: Floats32
    origin: Bytes
    object: Ints32

    def scan(self, stamp: float | None = None, sensor: str = "", doppler_interval: float | None = None) -> Scan:
        """Return what a real radar gives: points with Doppler, against the sensor, and cross sections."""
        points = np.zeros((len(self.xyz), 4), np.float32)
        points[:, :3] = self.xyz
        return Scan(
            points, stamp=stamp, doppler=self.doppler, rcs=self.rcs, sensor=sensor, doppler_interval=doppler_interval
        )

    @property
    def table(self) -> Floats32:
        """The columns `DETECTION`, (N, 9)."""
        return np.column_stack([self.xyz, *self[1:]]).astype(np.float32)

    @classmethod
    def of_table(cls, table: Floats32) -> "RadarSweep":
        """Make from what `table` returned."""
        doppler, compensated, rcs, snr, origin, number = table[:, 3:].T
        return cls(table[:, :3], doppler, compensated, rcs, snr, origin.astype(np.uint8), number.astype(np.int32))


class PlacedSweep(NamedTuple):
    """A sweep of a data set.

    Attributes
    ----------
    radar : int
        Number of the radar in the plan.
    stamp : float
        [s]
    T_world_sensor : (4, 4) float64
    velocity : (3,) float64
        Of the sensor in the world's axes [m/s].
    detections : RadarSweep
        Its `object` are the tracks of the sample's objects; -1 for none.
    """

    radar: int
    stamp: float
    T_world_sensor: Floats
    velocity: Floats
    detections: RadarSweep


RANGE_STEP = 0.004  # [m] in which ranges are kept, as Velodyne's packets do
LABELS = ("car", "van", "truck", "trailer", "bus", "motorcycle", "bicycle", "pedestrian")
_BOX = ("x", "y", "z", "length", "width", "height", "yaw", "vx", "vy")
# One traffic participant. label: number in LABELS; x, y, z: middle of the upright box in the sensor's frame [m];
# length, width, height [m]; yaw: of the forward axis about the sensor's z axis [rad]; vx, vy: velocity over ground
# along the sensor's x and y axes [m/s]; track: the same for one participant in all samples of a scenario;
# returns: points of this sample on it.
OBJECT = np.dtype(
    [("label", np.uint8), *((name, np.float32) for name in _BOX), ("track", np.int32), ("returns", np.int32)]
)


class Weather(NamedTuple):
    """What is in the air and on the road.

    Attributes
    ----------
    rain : float
        Rate [mm/h].
    fog : float
        Meteorological visibility [m], inf for clear air.
    wet : float
        How wet the ground is, from 0, dry, to 1: asphalt as `ogm.simulation.materials.Material.WET_ASPHALT`.
    dust : float
        Extinction of the densest cloud of dust [1/m].
    """

    rain: float = 0.0
    fog: float = float("inf")
    wet: float = 0.0
    dust: float = 0.0


def shown_share(kind: str, columns: int, step: float) -> float:
    """Return the share of a turn's time in which a sensor measures: 0 for a camera."""
    return 0.0 if kind == "depth" else min(abs(step) * columns / (2 * np.pi), 1.0)


@dataclass(frozen=True)
class Beams:
    """Where the beams of a lidar point: enough to turn a range image into points.

    Parameters
    ----------
    name : str
    elevation : tuple of float
        Of each layer above the sensor's xy plane [rad], ascending.
    azimuth : tuple of float
        Of each layer's beam in column 0, from x towards y [rad].
    step : float
        From one column to the next [rad]; negative where the lidar turns clockwise, seen from above.
    columns : int
        Beams per layer and turn.
    rate : float
        Turns per second [Hz].
    origin : tuple of (x, y, z)
        Where each layer's beams start in the sensor's frame [m].
    kind : {"", "planar", "depth"}
        See `ogm.scan.Scan.kind`. The layers of a depth camera are the rows of its image, `elevation` counts in the
        middle column, and `step` counts from pixel to pixel of an image at distance 1.
    range_min, range_max : float
        Least and greatest range of a planar laser or depth camera [m]; not kept of lidars.
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
            raise ValueError(f"angles, places and rate of {self.name} must be finite")
        if self.kind not in ("", "planar", "depth") or bool(self.kind) != (0 <= self.range_min < self.range_max < 1e4):
            limits = f"{self.range_min:g} ... {self.range_max:g} m"
            raise ValueError(f"{self.name} must be a lidar, planar or depth with limits, got {self.kind!r}, {limits}")
        if self.kind == "depth" and not (
            np.abs((*self.elevation, *self.azimuth)).max() < np.pi / 2 and len({*self.azimuth}) == 1 and self.step < 0
        ):
            raise ValueError(f"{self.name} must have angles within a right angle and columns from left to right")
        if self.columns < 1 or not self.rate > 0:
            raise ValueError(f"columns and rate of {self.name} must be positive, got {self.columns} and {self.rate}")

    @property
    def shape(self) -> tuple[int, int]:
        """Layers and columns of a range image."""
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
        """Where each layer's beams start [m], (layers, 3)."""
        return np.array(self.origin, np.float32)

    @cached_property
    def times(self) -> Floats32:
        """When each column is measured [s], (columns,) float32; 0 is the middle of the turn."""
        times = ((np.arange(self.columns) + 0.5) / self.columns - 0.5) / self.rate
        if self.kind:
            times = times * shown_share(self.kind, self.columns, self.step)
        return times.astype(np.float32)

    def to_dict(self) -> dict[str, Any]:
        """Return what `from_dict` takes; lidars have no kind and no limits."""
        numbers = asdict(self)
        return numbers if self.kind else {name: numbers[name] for name in list(numbers)[:-3]}

    @classmethod
    def from_dict(cls, numbers: Mapping[str, Any]) -> "Beams":
        """Make from what `to_dict` returned, or from what JSON made of it."""
        angles = {name: tuple(map(float, numbers[name])) for name in ("elevation", "azimuth")}
        origin = tuple((float(x), float(y), float(z)) for x, y, z in numbers["origin"])
        return cls(**{**numbers, **angles, "origin": origin})


@dataclass(frozen=True, eq=False)
class SimulatedSample:
    """One turn of a lidar, and the truth about the cells around it.

    Parameters
    ----------
    beams : Beams
        The lidar.
    steps : (layers, columns) uint16
        The range image in steps of `RANGE_STEP`; 0 where there was no return.
    intensities : (layers, columns) uint8
        Calibrated as Velodyne's, 0 ... 255.
    truth : Truth
        Around the sensor, in its x and y; with heights, where the data set has them.
    objects : (K,) array of `OBJECT`
        Traffic participants nearby.
    T_world_sensor, T_vehicle_sensor : (4, 4) float64
        Where the sensor stood, and how it is mounted.
    velocity : (3,) float64
        Of the ego vehicle, in the world's axes [m/s].
    yaw_rate : float
        Of the ego vehicle [rad/s].
    stamp : float
        Time in the scenario, in the middle of the turn [s].
    split : str
        The part of the data set: "training", "validation", "test" or "sequences".
    index : int
        Number in that part.
    scenario : int
        Number of the drive within the part: the same streets and traffic for all its samples.
    weather : Weather
    measured : (layers, columns) bool, optional
        Beams that were fired and reported; None for all. The others are neither points nor beams without echo.
    sweeps : tuple of PlacedSweep
        Of radars, in the order of the plan's radars, each in the order of time.
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
        """The lidar's name."""
        return self.beams.name

    @cached_property
    def points(self) -> Floats32:
        """The returns, (N, 4) float32: x, y, z in the sensor's frame [m], intensity [0, 1]; layer by layer."""
        layer, column = np.nonzero(self.steps)
        distance = (self.steps[layer, column] * RANGE_STEP).astype(np.float32)
        result = np.empty((len(layer), 4), np.float32)
        result[:, :3] = self.beams.origins[layer] + distance[:, None] * self.beams.directions[layer, column]
        result[:, 3] = self.intensities[layer, column] * np.float32(1 / 255)
        return result

    @property
    def no_returns(self) -> Floats32:
        """Unit directions of the beams that were measured and gave no return, (M, 3) float32; none of depth cameras."""
        if self.beams.kind == "depth":
            return np.zeros((0, 3), np.float32)
        silent = self.steps == 0
        return np.asarray(self.beams.directions[silent if self.measured is None else silent & self.measured])

    @property
    def ring(self) -> NDArray[np.uint16]:
        """The layer of each point, (N,) uint16; 0 is the lowest."""
        return np.nonzero(self.steps)[0].astype(np.uint16)

    @property
    def column(self) -> NDArray[np.uint16]:
        """The azimuth index of each point, (N,) uint16."""
        return np.nonzero(self.steps)[1].astype(np.uint16)

    @property
    def time(self) -> Floats32:
        """When each point was measured [s], counted from `stamp`, (N,) float32."""
        return self.beams.times[np.nonzero(self.steps)[1]]
