"""Input of the library: `Scan`, `Mount`, `Boxes`, their container `Frame`, and the interface of sensor models.

>>> import numpy as np
>>> from ogm import Mount, Scan
>>> points = np.array([[5.0, 0.0, -1.8, 0.3], [8.0, 1.0, 0.2, 0.7]], np.float32)    # x, y, z [m], intensity
>>> scan, mount = Scan(points, stamp=12.5), Mount(sensor_height=1.8)
>>> len(scan), scan.stamp, mount.sensor_height
(2, 12.5, 1.8)
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Protocol, Self, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.evidence.arrays import refuse_masked
from ogm.grid import EvidentialGrid, GridSpec, ShownInNotebooks
from ogm.pose import check_pose, check_stamp
from ogm.state import Truth

__all__ = [
    "Boxes", "Frame", "InverseSensorModel", "LazyFrame", "Mount", "Scan", "SensorModels", "as_scan", "mount_of",
    "of_sensor", "run_model",
]  # fmt: skip

Value = TypeVar("Value")

KINDS = ("", "planar", "depth", "cone")
"""Values of `Scan.kind`."""


@dataclass(frozen=True, eq=False)
class Scan(ShownInNotebooks):
    """One measurement of a lidar, a radar or another range sensor.

    Parameters
    ----------
    points : (N, 4) float32
        x, y, z [m], intensity [0, 1] (0 for sensors without intensity). An (N, 3) array gets intensities of 0,
        float64 becomes float32.
    stamp : float, optional
        Time of the sweep [s], on the clock of the recording.
    time : (N,) float64, optional
        Time of each point [s], relative to `stamp`.
    ring : (N,) uint16, optional
        Number of the laser of each point.
    no_returns : (M, 3) float32, optional
        Unit directions of beams without echo, in the frame of `points`: towards the sky, but also towards black or
        wet surfaces. None if unknown.
    doppler : (N,) float32, optional
        Radial velocity, positive away from the sensor [m/s]; NaN where unknown.
    rcs : (N,) float32, optional
        Radar cross section [dBsm], NaN where unknown; None for scans of lidars.
    sensor : str
        Name of the sensor.
    doppler_interval : float, optional
        Width of the interval of unambiguous Doppler [m/s]: radial velocities may be wrong by multiples of it.
    mount : Mount, optional
        Mount of the sensor, set by a `Frame`. A sensor model with its own mount ignores it.
    kind : {"", "planar", "depth", "cone"}
        Kind of the sensor: "planar" is a laser with all beams in its x-y plane, "depth" a depth camera, "cone" a
        sensor with one wide beam per point (ultrasound, infrared), "" a lidar or radar.
    max_range : float, optional
        Greatest range of the sensor, above 0 [m]: a beam without echo is free at most up to it. None if unknown.
    beam_width : float, optional
        Full angle of a beam, above 0 and at most 2 pi [rad]. None if unknown.

    Raises
    ------
    TypeError
        If `points` is no float array, a column is a masked array, or `mount` no Mount.
    ValueError
        If `points` is not (N, 4) or (N, 3), a column has not one number per point, a time is not finite, a ring is no
        whole number from 0 to 65535, `stamp` is no time in seconds, `doppler_interval`, `max_range` or `beam_width`
        is not above 0, or `kind` is unknown.
    """

    points: NDArray[np.float32]
    stamp: float | None = None
    time: NDArray[np.float64] | None = None
    ring: NDArray[np.uint16] | None = None
    no_returns: NDArray[np.float32] | None = None
    doppler: NDArray[np.float32] | None = None
    rcs: NDArray[np.float32] | None = None
    sensor: str = ""
    doppler_interval: float | None = None
    mount: "Mount | None" = None
    kind: str = ""
    max_range: float | None = None
    beam_width: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", _checked_points(self.points))
        if self.mount is not None:
            check_mount(self.mount)
        if self.kind not in KINDS:
            raise ValueError(f"kind must be one of {', '.join(map(repr, KINDS))}, got {self.kind!r}")
        if self.max_range is not None and not 0 < self.max_range < math.inf:
            raise ValueError(f"max_range must be a range above 0 [m], got {self.max_range}; give None if unknown")
        if self.beam_width is not None and not 0 < self.beam_width <= 2 * math.pi:
            width = f"above 0, at most 2 pi [rad], got {self.beam_width}"
            raise ValueError(f"beam_width must be an angle {width}; give None if unknown")
        if self.doppler_interval is not None and not 0 < self.doppler_interval < math.inf:
            raise ValueError(f"doppler_interval must be a width above 0 [m/s], got {self.doppler_interval}")
        if self.stamp is not None:
            object.__setattr__(self, "stamp", check_stamp(self.stamp))
        columns = {"time": np.float64, "ring": np.uint16, "doppler": np.float32, "rcs": np.float32}
        for name, dtype in columns.items():
            if getattr(self, name) is None:
                continue
            refuse_masked(getattr(self, name), name)
            column = _column(getattr(self, name), name, dtype)
            if column.shape != (len(self.points),):
                raise ValueError(f"{name} must be ({len(self.points)},) like points, got shape {column.shape}")
            object.__setattr__(self, name, column)
        if self.no_returns is not None:
            directions = np.asarray(self.no_returns)
            if directions.ndim != 2 or directions.shape[1] != 3:
                raise ValueError(f"no_returns must be directions of shape (M, 3), got {directions.shape}")
            object.__setattr__(self, "no_returns", directions.astype(np.float32, copy=False))

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        extras = [name for name in ("time", "ring", "no_returns", "doppler", "rcs") if getattr(self, name) is not None]
        stamp = "" if self.stamp is None else f", stamp {self.stamp:.6g} s"
        kind = f"{self.kind}, " * bool(self.kind)
        reach = "" if self.max_range is None else f", max_range {self.max_range:.6g} m"
        width = "" if self.beam_width is None else f", beam_width {self.beam_width:.4g} rad"
        return f"Scan({kind}{len(self)} points{stamp}{''.join(f', {name}' for name in extras)}{reach}{width})"

    def select(self, keep: NDArray[Any] | slice) -> "Scan":
        """Return the scan with some of its points; beams without echo stay.

        Parameters
        ----------
        keep : (N,) bool, (K,) int or slice
        """
        columns: Any = {
            name: None if getattr(self, name) is None else getattr(self, name)[keep]
            for name in ("time", "ring", "doppler", "rcs")
        }
        return replace(self, points=self.points[keep], **columns)


class LazyScan(Scan):
    """A scan with a mount that is found at the first access and kept; made by `of`. Pickled, it becomes a `Scan`."""

    @classmethod
    def of(cls, scan: Scan, mount: Callable[[], "Mount"]) -> "LazyScan":
        """Return a scan with a mount that is found at the first access.

        Parameters
        ----------
        scan : Scan
        mount : function
            Takes no arguments and returns the mount.
        """
        lazy = cls(**{column.name: getattr(scan, column.name) for column in fields(Scan) if column.name != "mount"})
        del lazy.__dict__["mount"]
        lazy.__dict__.update(_scan=scan, _find=mount)
        return lazy

    @cached_property
    def mount(self) -> "Mount | None":
        """Mount of the sensor."""
        mount: Mount = self.__dict__["_find"]()
        return mount

    def select(self, keep: NDArray[Any] | slice) -> Scan:
        """See `Scan.select`; the mount is still found at the first access."""
        if "_scan" not in self.__dict__:  # a copy by `replace`, whose mount is known
            return super().select(keep)
        return LazyScan.of(self.__dict__["_scan"].select(keep), lambda: self.mount)  # type: ignore[arg-type,return-value]

    def __reduce__(self) -> tuple[Any, ...]:
        return Scan, tuple(getattr(self, column.name) for column in fields(Scan))


def as_scan(scan: "Scan | ArrayLike") -> Scan:
    """Return a scan as it is, or the scan of an (N, 4) or (N, 3) float array of points.

    Raises
    ------
    TypeError, ValueError
        If it is neither; the message states the fix.
    """
    return scan if isinstance(scan, Scan) else Scan(scan)  # type: ignore[arg-type]


def _column(given: Any, name: str, dtype: type[Any]) -> NDArray[Any]:
    """Return a column converted to its type, or raise a ValueError for numbers beyond the range of the type."""
    raw = np.asarray(given)
    if raw.dtype.kind not in "fiu":
        raise ValueError(f"{name} must be numbers, got {raw.dtype}")
    if name == "time" and not np.isfinite(raw).all():
        raise ValueError(f"time must be finite [s], time[{int(np.argmin(np.isfinite(raw)))}] is not; leave out time")
    short = raw.dtype in (np.uint8, np.uint16)
    if name == "ring" and not short and not ((raw >= 0) & (raw < 2**16) & (raw == np.floor(raw))).all():
        raise ValueError(f"ring must be whole numbers from 0 to 65535, got {raw.min()} to {raw.max()}; leave out ring")
    return raw.astype(dtype, copy=False)


def _checked_points(points: Any) -> NDArray[np.float32]:
    """Return points as (N, 4) float32, or raise an error that states the fix."""
    refuse_masked(points, "points")
    if not isinstance(points, np.ndarray):
        if hasattr(points, "detach"):
            raise TypeError("points is a torch tensor; give points.detach().cpu().numpy()")
        if isinstance(points, Scan):
            raise TypeError("points is a Scan already; give scan.points")
        raise TypeError(
            f"points must be a float array of shape (N, 4) [x, y, z, intensity], got {type(points).__name__}; "
            "give np.asarray(points, np.float32)"
        )
    if points.dtype.kind != "f":
        raise TypeError(
            f"points must be a float array of shape (N, 4) [x, y, z, intensity], got dtype {points.dtype}; "
            "give points.astype(np.float32), in metres"
        )
    if points.ndim != 2 or points.shape[1] not in (3, 4):
        columns = "columns x, y, z, intensity"
        if points.ndim == 2 and points.shape[0] in (3, 4):
            raise ValueError(f"points must have shape (N, 4), {columns}, got {points.shape}; give points.T")
        if points.ndim == 2 and points.shape[1] > 4:
            raise ValueError(f"points must have shape (N, 4), {columns}, got {points.shape}; give points[:, :4]")
        raise ValueError(f"points must have shape (N, 4), {columns}, got {points.shape}")
    if points.shape[1] == 3:
        points = np.concatenate([points, np.zeros((len(points), 1), points.dtype)], axis=1)
    checked: NDArray[np.float32] = np.asarray(points).astype(np.float32, copy=False)  # a matrix becomes an array
    return checked


@dataclass(frozen=True, eq=False)
class Mount:
    """Pose of a sensor on its vehicle, and the footprint of the ego vehicle.

    Parameters
    ----------
    sensor_height : float
        Height of the sensor above the ground under it [m].
    T_vehicle_sensor : (4, 4) array, optional
        Pose of the sensor in the vehicle frame, which is the frame of measurement grids. The default is the identity:
        the grid is centred on the sensor. The pose levels a pitched or rolled sensor.
    ego_footprint : (x_min, x_max, y_min, y_max), optional
        Rectangle of the ego vehicle in the vehicle frame [m]: returns in it are dropped, its cells stay unknown. By
        default 5.0 m x 2.2 m around the sensor; ``(0, 0, 0, 0)`` for none.
    points_in : {"sensor", "vehicle"}
        Frame of the points. Rays start at the sensor in either case.

    Raises
    ------
    ValueError
        If the height is not in (0, 100) m, the pose is not rigid, or the footprint is no rectangle.
    """

    sensor_height: float
    T_vehicle_sensor: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    ego_footprint: tuple[float, float, float, float] = None  # type: ignore[assignment]
    points_in: str = "sensor"

    def __post_init__(self) -> None:
        if not 0 < self.sensor_height < 100:
            raise ValueError(f"sensor_height must be above ground and below 100 m, got {self.sensor_height}")
        if self.points_in not in ("sensor", "vehicle"):
            raise ValueError(f'points_in must be "sensor" or "vehicle", got {self.points_in!r}')
        T = check_pose(self.T_vehicle_sensor, "T_vehicle_sensor") + 0.0  # a copy, in which -0 is 0
        T.flags.writeable = False
        x, y = float(T[0, 3]), float(T[1, 3])
        box = (
            (x - 2.5, x + 2.5, y - 1.1, y + 1.1)
            if self.ego_footprint is None
            else tuple(float(edge) for edge in self.ego_footprint)
        )
        if len(box) != 4 or not np.isfinite(box).all() or box[0] > box[1] or box[2] > box[3]:
            raise ValueError(
                f"ego_footprint must be finite x_min <= x_max, y_min <= y_max [m], got {self.ego_footprint}"
            )
        self.__dict__.update(sensor_height=float(self.sensor_height), T_vehicle_sensor=T, ego_footprint=box)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Mount):
            return NotImplemented
        return self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    @property
    def _key(self) -> tuple[Any, ...]:
        T = self.T_vehicle_sensor.tobytes()
        return self.sensor_height, T, self.ego_footprint, self.points_in

    @property
    def origin(self) -> NDArray[np.float64]:
        """Position of the sensor in the vehicle frame, (3,) [m]."""
        return self.T_vehicle_sensor[:3, 3]

    @property
    def ground_point(self) -> tuple[float, float, float]:
        """Point on the ground under the sensor, x, y, z in the vehicle frame [m]."""
        x, y, z = (float(value) for value in self.origin)
        return x, y, z - self.sensor_height

    @property
    def T_vehicle_points(self) -> NDArray[np.float64]:
        """Transform (4, 4) from the frame of the points, see `points_in`, to the vehicle frame."""
        return self.T_vehicle_sensor if self.points_in == "sensor" else np.eye(4)

    @property
    def T_sensor_level(self) -> NDArray[np.float64]:
        """Transform (4, 4) to the sensor frame, from the frame at the sensor parallel to the vehicle frame."""
        T = np.eye(4)
        T[:3, :3] = self.T_vehicle_sensor[:3, :3].T
        return T


@dataclass(frozen=True, eq=False)
class Boxes:
    """Upright boxes around objects, as columns.

    Parameters
    ----------
    center : (B, 3) float64
        Centres x, y, z [m].
    size : (B, 3) float64
        Length, width, height [m], above 0.
    yaw : (B,) float64
        Direction of the length, about z [rad].
    velocity : (B, 2) float64, optional
        Velocity over ground along x and y [m/s]; NaN where unknown.
    label : sequence of B str, optional
        Class of each object, as named by its dataset.
    track : sequence of B str, optional
        Name of each object, the same in all frames of a sequence; "" where unknown.

    Raises
    ------
    ValueError
        If the counts differ, a number is not finite, or a size is not above 0.
    """

    center: NDArray[np.float64]
    size: NDArray[np.float64]
    yaw: NDArray[np.float64]
    velocity: NDArray[np.float64] | None = None
    label: Sequence[str] = ()
    track: Sequence[str] = ()

    def __post_init__(self) -> None:
        center, size = (np.asarray(a, np.float64).reshape(-1, 3) for a in (self.center, self.size))
        yaw = np.asarray(self.yaw, np.float64).reshape(-1)
        count = len(center)
        label, track = tuple(self.label) or ("",) * count, tuple(self.track) or ("",) * count
        velocity = None if self.velocity is None else np.asarray(self.velocity, np.float64).reshape(-1, 2)
        counts = {"size": len(size), "yaw": len(yaw), "label": len(label), "track": len(track)}
        counts["velocity"] = count if velocity is None else len(velocity)
        for name, number in counts.items():
            if number != count:
                raise ValueError(f"there must be one {name} per box, got {count} boxes and {number} of {name}")
        values = np.column_stack([center, size, yaw])
        good = np.isfinite(values).all(axis=1) & (size > 0).all(axis=1)
        if not good.all():
            k = int(np.argmin(good))
            raise ValueError(
                f"box {k} ({label[k]}) must be finite, with length, width and height above 0 m, got center "
                f"{center[k].tolist()}, size {size[k].tolist()}, yaw {yaw[k]}; drop it, or correct the label"
            )
        self.__dict__.update(center=center, size=size, yaw=yaw, velocity=velocity, label=label, track=track)

    @classmethod
    def empty(cls) -> Self:
        """Return an empty set of boxes."""
        return cls(np.empty((0, 3)), np.empty((0, 3)), np.empty(0))

    def __len__(self) -> int:
        return len(self.center)

    def __repr__(self) -> str:
        labels = ", ".join(sorted({label for label in self.label if label}))
        return f"Boxes({len(self)}: {labels})" if labels else f"Boxes({len(self)})"

    @property
    def bottom(self) -> NDArray[np.float64]:
        """Lowest z of each box, (B,) [m]."""
        return self.center[:, 2] - self.size[:, 2] / 2

    @property
    def top(self) -> NDArray[np.float64]:
        """Highest z of each box, (B,) [m]."""
        return self.center[:, 2] + self.size[:, 2] / 2

    def select(self, keep: ArrayLike) -> "Boxes":
        """Return some of the boxes.

        Parameters
        ----------
        keep : (B,) bool or (K,) int
        """
        at = np.arange(len(self))[np.asarray(keep)] if len(self) else np.empty(0, int)
        velocity = None if self.velocity is None else self.velocity[at]
        label, track = ([names[k] for k in at] for names in (self.label, self.track))
        return Boxes(self.center[at], self.size[at], self.yaw[at], velocity, label, track)

    def moved(self, T: ArrayLike) -> "Boxes":
        """Return the boxes in another frame; they stay upright.

        Parameters
        ----------
        T : (4, 4) array
            ``T_to_from``, with little tilt. It is applied to centers; its heading is added to yaws.
        """
        T = check_pose(T)
        center = self.center @ T[:3, :3].T + T[:3, 3]
        velocity = None if self.velocity is None else self.velocity @ T[:2, :2].T
        return replace(self, center=center, yaw=self.yaw + np.arctan2(T[1, 0], T[0, 0]), velocity=velocity)

    def widened(self, margin: float) -> "Boxes":
        """Return the boxes with `margin` [m] added on all six sides."""
        return replace(self, size=self.size + 2 * margin)


@dataclass(frozen=True, eq=False)
class Frame:
    """One scan with the pose and mount of its sensor, and optional labels.

    Parameters
    ----------
    scan : Scan
        Its `Scan.mount` is replaced by `mount`.
    mount : Mount
    boxes : Boxes, optional
        Labelled objects in the sensor frame, with velocities if the dataset states them or tracks the objects.
    truth : Truth, optional
        True states of the cells around the sensor.
    T_map_sensor : (4, 4) float64, optional
        Pose of the sensor; frames of a sequence share a map frame. None if unknown.
    stamp : float, optional
        Time of the scan [s]. None if unknown.
    name : str
        Name of the frame, unique in its dataset.
    sequence : str
        Frames with the same sequence are ordered in time; "" for a single frame.
    """

    scan: Scan
    mount: Mount
    boxes: Boxes | None = None
    truth: Truth | None = None
    T_map_sensor: NDArray[np.float64] | None = None
    stamp: float | None = None
    name: str = ""
    sequence: str = ""

    def __post_init__(self) -> None:
        if self.scan.mount != self.mount:
            object.__setattr__(self, "scan", replace(self.scan, mount=self.mount))

    def __repr__(self) -> str:
        sequence = f" of {self.sequence}" if self.sequence else ""
        return f"Frame({self.name!r}{sequence})"


class LazyFrame(Frame):
    """A frame with scan, mount, boxes and truth read at the first access and kept.

    A dataset thus reads only the used parts, and an error in an unused part is not raised.

    Parameters
    ----------
    scan, mount, boxes, truth : function
        Takes no arguments and returns the attribute of its name.
    T_map_sensor, stamp, name, sequence
        See `Frame`.
    """

    def __init__(
        self,
        scan: Callable[[], Scan],
        mount: Callable[[], Mount],
        boxes: Callable[[], Boxes | None] = lambda: None,
        truth: Callable[[], Truth | None] = lambda: None,
        *,
        T_map_sensor: NDArray[np.float64] | None = None,  # noqa: N803
        stamp: float | None = None,
        name: str = "",
        sequence: str = "",
    ) -> None:
        self.__dict__.update(_scan=scan, _mount=mount, _boxes=boxes, _truth=truth)
        self.__dict__.update(T_map_sensor=T_map_sensor, stamp=stamp, name=name, sequence=sequence)

    @cached_property
    def scan(self) -> Scan:
        """The scan, with the mount of the frame."""
        return LazyScan.of(self.__dict__["_scan"](), lambda: self.mount)

    @cached_property
    def mount(self) -> Mount:
        """The mount of the sensor."""
        mount: Mount = self.__dict__["_mount"]()
        return mount

    @cached_property
    def boxes(self) -> Boxes | None:
        """Labelled objects."""
        boxes: Boxes | None = self.__dict__["_boxes"]()
        return boxes

    @cached_property
    def truth(self) -> Truth | None:
        """True states of the cells."""
        truth: Truth | None = self.__dict__["_truth"]()
        return truth


@runtime_checkable
class InverseSensorModel(Protocol):
    """Interface of sensor models: a callable from one scan to a measurement grid, with a `spec`.

    Geometric and learned models of all sensors share it, so that mappers, metrics and the command line treat them
    alike.
    """

    @property
    def spec(self) -> GridSpec:
        """Cells of the model's grids."""
        ...

    def __call__(self, scan: Scan) -> EvidentialGrid:
        """Return the evidential grid of a scan."""
        ...


SensorModels = InverseSensorModel | Mapping[str, InverseSensorModel]


def check_mount(mount: object) -> None:
    """Raise a TypeError unless `mount` is a `Mount`."""
    if not isinstance(mount, Mount):
        raise TypeError(f"mount must be an ogm.Mount, got {mount!r}; give Mount(sensor_height=...) [m]")


def mount_of(scan: Scan, mount: Mount | None = None) -> Mount:
    """Return the mount of a model, or the mount of the scan if the model has none.

    Parameters
    ----------
    scan : Scan
    mount : Mount, optional
        Mount of the model.

    Raises
    ------
    ValueError
        If both are missing.
    """
    found = scan.mount if mount is None else mount
    if found is None:
        raise ValueError("the mount of the sensor is unknown: give mount=Mount(...) to the model or the Scan")
    return found


def run_model(ism: SensorModels, frame: Frame) -> EvidentialGrid:
    """Map the scan of a frame.

    Parameters
    ----------
    ism : callable with `spec`, or mapping of str to these
        A mapping has a model for each `Scan.sensor`; the key "" is the default.
    frame : Frame

    Raises
    ------
    ValueError
        If a mapping has no model for the frame's sensor.
    TypeError
        If the model does not return an EvidentialGrid.
    """
    model = of_sensor(ism, frame.scan.sensor, "model") if isinstance(ism, Mapping) else ism
    grid = model(frame.scan)
    if not isinstance(grid, EvidentialGrid):
        name = type(model).__name__
        raise TypeError(f"{name} returned {type(grid).__name__}, wanted an EvidentialGrid: EvidentialGrid(spec, mass)")
    return grid


def of_sensor(values: Mapping[str, Value], sensor: str, kind: str) -> Value:
    """Return the value of a sensor, or of the default "", else raise a ValueError that names the sensor and `kind`."""
    if sensor not in values and "" in values:
        return values[""]
    if sensor not in values:
        given = ", ".join(map(repr, values)) or "none"
        raise ValueError(f"there is no {kind} for the sensor {sensor!r} (Scan.sensor), only for {given}")
    return values[sensor]
