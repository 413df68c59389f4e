"""Sensor properties that scans do not state, such as mount, ego footprint and ranges, and their YAML file."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from ogm.datasets.frames import Footprint, RawFrame
from ogm.io.ground_plane import LEVEL, LEVEL_MARGIN, levelling_gain
from ogm.pose import levelling, pose, tilt_of
from ogm.scan import Frame
from ogm.storage.files import OgmError, atomic_write

_SATURATION_MARGIN = 0.02  # [m] points within this margin of the greatest range count as saturated
_MAX_BYTES = 2**16  # [byte] largest file of sensors
_KEYS = ("topic", "height", "mount", "footprint", "range", "no_echo_at_greatest_range", "leave_out", "depth_scale")
_MOUNT = ("x", "y", "z", "roll", "pitch", "yaw")
_FILE_HEADER = (
    "# Sensors of a vehicle, for --sensors of ogm map, fuse, serve, evaluate and world build. Metres and degrees;\n"
    "# every line except topic is optional. mount: pose in base_link; footprint: x_min, x_max, y_min, y_max of the\n"
    "# vehicle around the sensor; range: smallest and greatest; leave_out: sectors of view, angles to the left;\n"
    "# depth_scale: pixel value at 1 m.\n"
)


@dataclass(frozen=True)
class SensorSetup:
    """Sensor properties that scans do not state.

    Parameters
    ----------
    topic : str
        Topic of the sensor in logs; "" for all sensors without their own setup.
    sensor_height : float, optional
        Height above the ground [m].
    mount : (x, y, z, roll, pitch, yaw), optional
        Pose in the vehicle's frame, base_link [m, rad].
    ego_footprint : (x_min, x_max, y_min, y_max), optional
        See `ogm.Mount`.
    min_range, max_range : float
        Smallest and greatest range [m]; other points are dropped. Beams without echo are free only up to `max_range`.
    max_range_no_echo : bool
        Whether points at `max_range` and beyond are beams without echo, which some drivers report so.
    leave_out : sequence of (float, float)
        Sectors of view to drop, each from and to an angle to the left of the sensor's x axis [rad].
    depth_scale : float, optional
        Pixel value at 1 m of a depth camera, see `ogm.io.depth_scan`.

    Raises
    ------
    ValueError
        If a number is not finite, or a range or sector is invalid.
    """

    topic: str = ""
    sensor_height: float | None = None
    mount: tuple[float, float, float, float, float, float] | None = None
    ego_footprint: Footprint | None = None
    min_range: float = 0.0
    max_range: float = math.inf
    max_range_no_echo: bool = False
    leave_out: tuple[tuple[float, float], ...] = ()
    depth_scale: float | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.min_range < self.max_range:
            raise ValueError(
                f"min_range must be at least 0 and below max_range [m], got {self.min_range} and {self.max_range} "
                "(--min-range, --max-range)"
            )
        if self.max_range_no_echo and math.isinf(self.max_range):
            raise ValueError("`max_range_no_echo` needs the greatest range: give `max_range`")
        for name, count in (("mount", 6), ("ego_footprint", 4)):
            numbers = getattr(self, name)
            if numbers is not None and (len(numbers) != count or not np.isfinite(numbers).all()):
                raise ValueError(f"{name} must be {count} finite numbers, got {numbers}")
        if self.depth_scale is not None and not 0 < self.depth_scale < math.inf:
            raise ValueError(f"depth_scale, the pixel value at 1 m, must be above 0, got {self.depth_scale}")
        for sector in self.leave_out:
            if len(sector) != 2 or not np.isfinite(sector).all() or abs(sector[1] - sector[0]) > 2 * math.pi:
                raise ValueError(f"leave_out must be sectors (from, to) of at most a turn [rad], got {sector}")

    @property
    def T_vehicle_sensor(self) -> NDArray[np.float64] | None:  # noqa: N802
        """Mount as a transform, (4, 4); None if it is not given."""
        if self.mount is None:
            return None
        x, y, z, roll, pitch, yaw = self.mount
        return pose(x, y, z, roll=roll, pitch=pitch, yaw=yaw)

    def limit(self, raw: RawFrame, place: Sequence[float] = (0.0, 0.0, 0.0)) -> RawFrame:
        """Return a frame without the points that are out of range or in a dropped sector.

        Parameters
        ----------
        raw : RawFrame
        place : (x, y, z)
            Position of the sensor in the frame of the points [m].
        """
        if not (self.min_range or self.leave_out or math.isfinite(self.max_range)):
            return raw
        scan = raw.scan
        rays = scan.points[:, :3] - np.asarray(place, np.float32)
        distance = np.sqrt(np.einsum("ij,ij->i", rays, rays))
        in_view = self._in_view(rays)
        far = distance >= self.max_range - _SATURATION_MARGIN if self.max_range_no_echo else distance > self.max_range
        no_returns = scan.no_returns
        if no_returns is not None:
            no_returns = no_returns[self._in_view(no_returns)]
        if self.max_range_no_echo:
            silent = far & in_view & np.isfinite(distance)
            added = rays[silent] / distance[silent, None]
            no_returns = added if no_returns is None else np.concatenate([no_returns, added])
        if math.isfinite(self.max_range):
            raw = raw._replace(scan=replace(scan, max_range=min(scan.max_range or math.inf, self.max_range)))
        return raw.kept(in_view & ~far & (distance >= self.min_range), no_returns)

    def _in_view(self, rays: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return a mask of the directions outside all dropped sectors, (N,)."""
        kept = np.ones(len(rays), np.bool_)
        if self.leave_out:
            azimuth = np.arctan2(rays[:, 1], rays[:, 0])
            for start, end in self.leave_out:
                kept &= (azimuth - start) % (2 * math.pi) > (end - start) % (2 * math.pi)
        return kept


def setup_of(setups: Iterable[SensorSetup], topic: str) -> SensorSetup:
    """Return the setup of a topic, else the setup for all sensors, else an empty setup."""
    by_topic = {setup.topic: setup for setup in setups}
    if topic in by_topic:
        return by_topic[topic]
    alone = next(iter(by_topic.values())) if len(by_topic) == 1 and not topic else SensorSetup()
    return by_topic.get("", alone)


def within_limits(frames: Iterable[Frame], setup: SensorSetup) -> Iterator[Frame]:
    """Yield frames with the mount and the limits of a setup, levelled by tilted poses.

    Parameters
    ----------
    frames : iterable of Frame
        Frames with points in the sensor's frame, for example from `ogm.live.receive_frames`.
    setup : SensorSetup
        Mount and limits of the sensor.
    """
    T_vehicle_sensor, levelled = setup.T_vehicle_sensor, None
    for frame in frames:
        scan, mount, T = setup.limit(RawFrame(frame.scan)).scan, frame.mount, frame.T_map_sensor
        R = np.eye(3) if T_vehicle_sensor is None else T_vehicle_sensor[:3, :3]
        if T is not None and tilt_of(T) > LEVEL:
            if levelled is None:  # the first scan with a tilted pose decides
                levelled = levelling_gain(scan.points, levelling(T)) >= -LEVEL_MARGIN
            R = levelling(T) if levelled else R
        if not np.array_equal(R, np.eye(3)):
            level = pose(z=mount.sensor_height)
            level[:3, :3] = R
            mount = replace(mount, T_vehicle_sensor=level)
        yield replace(frame, scan=scan, mount=mount)


def read_setups(path: str | Path) -> tuple[SensorSetup, ...]:
    """Read the sensors of a vehicle from a YAML file.

    Parameters
    ----------
    path : path
        File of `write_setups` or ``ogm check --write``: a list ``sensors`` of mappings with any of topic, height [m],
        mount (x, y, z [m], roll, pitch, yaw [deg]), footprint [m], range [m], no_echo_at_greatest_range, leave_out
        (sectors [deg]) and depth_scale (pixel value at 1 m).

    Raises
    ------
    OgmError
        If the file is not valid.
    """
    with open(path, "rb") as file:
        text = file.read(_MAX_BYTES + 1)
    if len(text) > _MAX_BYTES:
        raise OgmError(f"{path} has more than {_MAX_BYTES} bytes, wanted a YAML file of `ogm check LOG --write FILE`")
    try:
        content = yaml.load(text, yaml.BaseLoader)  # text scalars; no merge keys, which can exhaust the memory
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        problem = getattr(error, "problem", None) or error
        raise OgmError(f"{path} is no YAML file: {problem}; `ogm check --write FILE` writes one") from error
    try:
        setups = tuple(_parsed(entry) for entry in content["sensors"])
    except (ValueError, TypeError, LookupError, AttributeError, OverflowError) as error:
        raise OgmError(
            f"{path} must have a list `sensors`, each with some of {', '.join(_KEYS)} (`ogm check LOG --write FILE` "
            f"writes such a file): {error}"
        ) from error
    topics = [setup.topic for setup in setups]
    if len(set(topics)) < len(topics) or not setups:
        raise OgmError(f"{path} must have one entry for each topic, got {', '.join(map(repr, topics)) or 'none'}")
    return setups


def write_setups(path: str | Path, setups: Iterable[SensorSetup]) -> None:
    """Write sensors to a YAML file for `read_setups`."""
    content = {"sensors": [_record(setup) for setup in setups]}
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=100)
    with atomic_write(path, "w") as file:
        file.write(_FILE_HEADER + text)


def merged(setups: Sequence[SensorSetup], **given: Any) -> tuple[SensorSetup, ...]:
    """Return setups with given properties replaced in all of them; None leaves a property as it is."""
    chosen = {name: value for name, value in given.items() if value is not None}
    return tuple(replace(setup, **chosen) for setup in setups) if chosen or setups else ()


def _parsed(entry: Mapping[str, Any]) -> SensorSetup:
    if unknown := [key for key in entry if key not in _KEYS]:
        raise ValueError(f"unknown key {unknown[0]!r}, wanted {', '.join(_KEYS)}")
    low, high = entry.get("range") or (0.0, math.inf)
    place: Mapping[str, Any] | None = entry.get("mount")
    mount = None
    if place is not None:
        if unknown := [key for key in place if key not in _MOUNT]:
            raise ValueError(f"unknown key {unknown[0]!r} of mount, wanted {', '.join(_MOUNT)}")
        numbers = [float(place.get(key, 0.0)) for key in _MOUNT]
        mount = (*numbers[:3], *map(math.radians, numbers[3:]))
    height, box, scale = entry.get("height"), entry.get("footprint"), entry.get("depth_scale")
    no_echo = entry.get("no_echo_at_greatest_range", "false")
    if no_echo not in ("true", "false") or not isinstance(entry.get("topic", ""), str):
        raise TypeError("topic must be a name and no_echo_at_greatest_range true or false")
    return SensorSetup(
        entry.get("topic", ""),
        None if height is None else float(height),
        mount,  # type: ignore[arg-type]
        None if box is None else tuple(map(float, box)),  # type: ignore[arg-type]
        float(low),
        float(high),
        no_echo == "true",
        tuple((math.radians(float(start)), math.radians(float(end))) for start, end in entry.get("leave_out") or ()),
        None if scale is None else float(scale),
    )


def _record(setup: SensorSetup) -> dict[str, Any]:
    mount = setup.mount and [*setup.mount[:3], *map(math.degrees, setup.mount[3:])]
    is_limited = setup.min_range or math.isfinite(setup.max_range)
    sectors = [[round(math.degrees(angle), 2) for angle in sector] for sector in setup.leave_out]
    found = {
        "topic": setup.topic or None,
        "height": None if setup.sensor_height is None else round(setup.sensor_height, 3),
        "mount": mount and {key: round(number, 3) for key, number in zip(_MOUNT, mount, strict=True)},
        "footprint": setup.ego_footprint and [round(edge, 2) for edge in setup.ego_footprint],
        "range": [round(setup.min_range, 3), round(setup.max_range, 3)] if is_limited else None,
        "no_echo_at_greatest_range": setup.max_range_no_echo or None,
        "leave_out": sectors or None,
        "depth_scale": setup.depth_scale,
    }
    return {key: value for key, value in found.items() if value is not None}
