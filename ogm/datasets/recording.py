"""Base class of all datasets and logs: which frames a path holds, and how their parts are read.

A dataset is added by a subclass in a module of its own, as in `ogm.datasets.sustech`, and an entry of `RECORDINGS` in
`ogm.datasets.opening`.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm import io
from ogm.datasets.clocks import ClockFinding
from ogm.datasets.frames import EGO, Footprint, FrameRef, HdMap, RawFrame, SensorPlace
from ogm.datasets.sensor_setup import SensorSetup, setup_of
from ogm.grid import GridSpec
from ogm.io import Axes
from ogm.io.columns import IntensityRange
from ogm.io.ground_plane import (
    LEVEL,
    LEVEL_MARGIN,
    MAX_INCLINE,
    SIDES,
    ground_plane,
    ground_side,
    levelling_gain,
    plausible_sensor_height,
)  # fmt: skip
from ogm.io.notices import one_notice_per_kind
from ogm.io.scan import read_table
from ogm.io.scan_table import stated_range
from ogm.pose import levelling, pose, rotate, tilt_of
from ogm.scan import Boxes, Mount, Scan
from ogm.state import Truth
from ogm.storage.files import OgmError

_HEIGHTS = 5  # scans of a sequence whose median is the height of its sensor
_INDOORS = 0.25  # [m]
_KEPT = 64  # scans in memory, some 2 MB each: the truth of a frame takes many of its neighbours
_KEPT_UNLABELLED = 16
_UNREADABLE = (ValueError, TypeError, OSError)


class OpenOptions(NamedTuple):
    """Options of `ogm.datasets.open_dataset`."""

    axes: Axes = "flu"
    units: Mapping[str, Any] = {}
    sensor_height: float | None = None
    sensor_position: tuple[float, float, float] | None = None
    split: str | None = None
    default_split: str | None = None
    others: str = "all"
    spec: GridSpec | None = None
    frame: str | None = None
    truth: tuple[str, ...] = ()
    topic: tuple[str, ...] = ()
    sensors: tuple[str, ...] = ()
    setups: tuple[SensorSetup, ...] = ()


class Recording(ABC):
    """Frames of a dataset or a log: their references, and methods that read a part of frame n.

    Opening a recording reads no points. Pickled or copied, it goes without the values of its cached properties, which
    are read again when they are needed; an open file or a large table is therefore a cached property.

    Attributes
    ----------
    path : Path or ObjectPath
    frames : tuple of FrameRef
        With unique names.
    name : str
    files : list of Path
        Files and folders that the recording is read from.
    facts : dict
        Further facts, as JSON can hold them; the format and the number of frames if empty.
    format : str
        The format, in words.
    wanted_labels : str
        Labels that this format may have, for the error if there are none.
    labelled : tuple of str
        Labels of the frames: "boxes" (`read_boxes`), "classes" (`RawFrame.kinds`), "map" (`hd_map`).
    ego_footprint : Footprint or None
        Returns inside of it are dropped. None keeps all: sensor models drop them by their mount.
    view : str
        View or range in which labels were made, as the description of the truth states it.
    view_angle : float or None
        Objects are labelled up to this angle to either side of straight ahead [rad], below π/2. None for all around.
    axes : Axes
        Axes of the files.
    stamped : bool
        Whether the stamps of the frames are stated, not counted from their names at 10 Hz.
    aggregated : bool
        Whether truth may be made of neighbouring scans; a radar shows no ground.
    motion_distorted : bool
        Whether points may be shifted by the ego motion during a scan, so that de-skewing makes sense.
    known_axes, known_height, known_mount, known_truth : bool
        Whether the dataset states its axes and units, the sensor's height, its whole mount, the truth itself. The user
        cannot choose axes, mounts and truths that are known.
    warnings : sequence of str
        Damage that was found when the recording was opened.
    clock_findings : sequence of ClockFinding
        Faults of the clock that were found when the recording was opened.
    frame_notes : sequence of (str, str)
        What is unusual about the frames of the points, and the way out, "" where nothing need be done.
    transform_delays : (len(frames),) float64 array or None
        Time from the recording of a scan to that of the transforms that its pose needs [s]: above 0 where these came
        later; NaN where unknown.
    shards : (len(frames),) int array or None
        Shard of each frame in an object store, where reading a shard costs little more than reading a frame.
    assumed_height : bool
        Whether `known_height` is assumed, as the scans show no ground and nothing states it.
    main_sequence : str
        Sequence that commands use by default; "" for the first.
    own_options : tuple of str
        Options of `OpenOptions` that other formats refuse: some of "split", "sensors", "topic", "frame".
    """

    format: str
    wanted_labels: str = ""
    labelled: tuple[str, ...] = ()
    ego_footprint: Footprint | None = EGO
    view: str = ""
    view_angle: float | None = None
    axes: Axes = "flu"
    stamped: bool = False
    aggregated: bool = True
    motion_distorted: bool = True
    description: str = ""  # of a known truth
    known_axes: ClassVar[bool] = True
    known_mount: ClassVar[bool] = False
    known_height: bool = False
    assumed_height: bool = False
    known_truth: bool = False
    main_sequence: str = ""
    own_options: ClassVar[tuple[str, ...]] = ()
    warnings: Sequence[str] = ()
    clock_findings: Sequence[ClockFinding] = ()
    frame_notes: Sequence[tuple[str, str]] = ()
    transform_delays: NDArray[np.float64] | None = None
    shards: NDArray[np.int64] | None = None
    sensor_height: float | None = None  # [m] given by the user
    sensor_position: tuple[float, float, float] | None = None  # [m] given by the user
    setups: tuple[SensorSetup, ...] = ()  # given by the user

    def __init__(self, path: Any, frames: Sequence[FrameRef], name: str = "") -> None:
        times = Counter(ref.name for ref in frames)  # some datasets count the frames of each sequence from 0
        self.path, self.files = path, [path]
        self.frames: tuple[FrameRef, ...] = tuple(
            ref if times[ref.name] == 1 else ref._replace(name=f"{ref.sequence} {ref.name}".strip()) for ref in frames
        )
        self.name = name or path.name or path.resolve().name or str(path)
        self.facts: Mapping[str, Any] = {}
        self.notices = Counter[str]()  # of scans, by kind

    def __getstate__(self) -> dict[str, Any]:
        cached = {name for name in vars(self) if isinstance(getattr(type(self), name, None), cached_property)}
        return {name: _absolute(value) for name, value in vars(self).items() if name not in cached}

    # --- Which frames there are ----------------------------------------------------------------------

    @classmethod
    def open(cls, paths: Sequence[Any], options: OpenOptions) -> "Recording | None":
        """Return the recording at some paths, or None if they are of another format."""
        return cls.find(paths[0]) if len(paths) == 1 else None

    @classmethod
    def find(cls, path: Path) -> "Recording | None":
        """Return the recording at one path that exists, or None if it is of another format."""
        return None

    @cached_property
    def groups(self) -> dict[str, list[int]]:
        """Numbers of the frames of each sequence; a single frame is a group. Sensors of a group keep their heights."""
        groups: dict[str, list[int]] = {}
        for n, ref in enumerate(self.frames):
            groups.setdefault(ref.sequence or ref.name, []).append(n)
        return groups

    # --- What a format implements --------------------------------------------------------------------

    @abstractmethod
    def read(self, n: int) -> RawFrame:
        """Read a scan, in the sensor's frame."""

    def read_boxes(self, n: int) -> Boxes:
        """Read the boxes around a scan, in the sensor's frame; for recordings that are labelled with boxes."""
        raise NotImplementedError

    def hd_map(self, n: int) -> HdMap:
        """Return the map around a scan; for recordings that are labelled with a map."""
        raise NotImplementedError

    def place(self, n: int) -> SensorPlace:
        """Return the place of the sensor on the vehicle."""
        return SensorPlace()

    def estimate_height(self, n: int) -> float | None:
        """Return the height of the sensor above ground [m] by one scan, or None if it shows no ground."""
        return io.estimate_sensor_height(self.levelled_points(n), self.square(n))

    def square(self, n: int) -> float:
        """Return the side of the squares in which a scan shows its ground [m], see `ogm.io.ground_plane`."""
        return _INDOORS if self.raw(n).scan.kind == "depth" else 1.0

    def intensity_range(self, n: int) -> IntensityRange | None:
        """Return the intensities that mean 0 and 1 by the values of one scan; None if the format states them."""
        return None

    def truth(self, n: int) -> Truth:
        """Return the truth of a frame; for recordings with a known truth."""
        raise NotImplementedError

    def has_truth(self, n: int) -> bool:
        """Return whether a frame may have a truth, without reading it."""
        return True

    def setup(self, n: int) -> SensorSetup:
        """Return what the user states of the sensor of a frame."""
        return setup_of(self.setups, "")

    # --- What all formats share ----------------------------------------------------------------------

    def scan(self, n: int) -> Scan:
        """Return a scan, without the returns from inside the ego footprint."""
        return self.raw(n).scan

    @cached_property
    def raw(self) -> Callable[[int], RawFrame]:
        """Function that reads a frame without the returns from inside the ego footprint; it keeps the last frames."""
        return lru_cache(_KEPT if self.labelled else _KEPT_UNLABELLED)(self._read_without_ego)

    def boxes(self, n: int) -> Boxes | None:
        """Return the boxes around a scan, in the sensor's frame; None if there are no labelled boxes."""
        return self.read_boxes(n) if "boxes" in self.labelled else None

    def mount(self, n: int) -> Mount:
        """Return the mount of the sensor, above the ground below it."""
        height, position, place = self.height(n), self.sensor_position, self.place(n)
        if position is not None:
            return Mount(height, pose(*position), points_in="vehicle")
        T = pose(*place.origin, height, yaw=place.yaw)
        T[:3, :3] = T[:3, :3] @ self.levelling(n)
        return Mount(height, T, place.ego_footprint)  # type: ignore[arg-type]

    def levelling(self, n: int) -> NDArray[np.float64]:
        """Return the rotation by which the pose of a frame levels its points, (3, 3).

        Identity where the dataset states the axes of the points, and where the ground in the scans is more level
        without the tilt of the poses: that of the road.
        """
        ref = self.frames[n]
        if ref.T_map_sensor is None or self.known_axes or not self._levelled(ref.sequence or ref.name):
            T = None if self.known_axes else self.setup(n).T_vehicle_sensor
            return np.eye(3) if T is None else T[:3, :3]
        return levelling(ref.T_map_sensor)

    def levelled_points(self, n: int) -> NDArray[np.float32]:
        """Return the points of a scan, (N, 4), turned by `levelling`."""
        points, R = self.raw(n).scan.points, self.levelling(n)
        if np.array_equal(R, np.eye(3)):
            return points
        return np.column_stack([rotate(R, points[:, :3].T).T, points[:, 3:]]).astype(np.float32)

    @cached_property
    def _levelled(self) -> Callable[[str], bool]:
        return lru_cache(None)(self._is_levelled)

    def _is_levelled(self, group: str) -> bool:
        """Return whether the poses of a group tell the tilt of its scans: by the ground in some of them."""
        poses = {k: T for k in self.groups[group] if (T := self.frames[k].T_map_sensor) is not None}
        tilted = [k for k, T in poses.items() if tilt_of(T) > LEVEL]
        gains = []
        for k in _sample(tilted):
            try:
                points = self.raw(k).scan.points
            except _UNREADABLE:
                continue
            gains.append(levelling_gain(points, levelling(poses[k])))
        return bool(tilted) and (not gains or float(np.median(gains)) >= -LEVEL_MARGIN)

    def used_mount(self, n: int) -> Mount:
        """Return the mount of the sensor with the ego footprint that the user states."""
        mount, footprint = self.mount(n), self.setup(n).ego_footprint
        return mount if footprint is None else replace(mount, ego_footprint=footprint)

    def height(self, n: int) -> float:
        """Return the height of the sensor above ground [m]: given, stated, or the median of some scans' estimates."""
        ref, place = self.frames[n], self.place(n)
        if self.sensor_height is not None:
            return self.sensor_height + place.above_first
        if (stated := self.setup(n).sensor_height) is not None:
            return stated
        return self._height(ref.sequence or ref.name, place.name) if place.height is None else place.height

    @cached_property
    def _height(self) -> Callable[[str, str], float]:
        return lru_cache(None)(self._median_height)

    def _median_height(self, group: str, sensor: str) -> float:
        members = [k for k in self.groups[group] if self.place(k).name == sensor]
        estimates, side, reasons, above = list[float](), 1.0, list[str](), (self.sensor_position or (0, 0, 0))[2]
        unreadable = ""
        for k in _sample(members):
            try:
                height = self.estimate_height(k)
                if height is None or height + above <= 0:
                    reasons.append(why_no_height(self.levelled_points(k)))
                else:
                    estimates.append(height + above)
                    side = self.square(k)
            except _UNREADABLE as error:
                unreadable = unreadable or str(error)
        if not estimates and unreadable and not reasons:
            raise OgmError(f"no scan of {group} can be read: {unreadable}")
        if not estimates:
            why = next(filter(None, reasons), "")
            raise OgmError(
                f"no scan of {group} in {self.path} shows the ground around the sensor{why}, so its height "
                "is not known: give `sensor_height` [m]"
            )
        return plausible_sensor_height(float(np.median(estimates)), f"{group} in {self.path}", side)

    def intensities(self, n: int, own: IntensityRange) -> IntensityRange:
        """Return the intensities that mean 0 and 1 in all scans of a drive and sensor.

        Parameters
        ----------
        n : int
        own : (float, float)
            Range by the values of scan n alone.

        Returns
        -------
        (float, float)
            0 and 1 if most of up to five scans stay between, else their widest range.
        """
        ref = self.frames[n]
        return (self._intensities(ref.sequence, self.place(n).name) if ref.sequence else None) or own

    @cached_property
    def _intensities(self) -> Callable[[str, str], IntensityRange | None]:
        return lru_cache(None)(self._widest_range)

    def _widest_range(self, group: str, sensor: str) -> IntensityRange | None:
        members = [k for k in self.groups[group] if self.place(k).name == sensor]
        ranges = []
        for k in np.unique(np.round(np.linspace(0, len(members) - 1, _HEIGHTS)).astype(int)):
            try:
                ranges.append(self.intensity_range(members[k]))
            except _UNREADABLE:
                continue  # the mapping reports it
        known = [one for one in ranges if one is not None]
        if 2 * known.count((0.0, 1.0)) > len(known) or not known:
            return (0.0, 1.0) if known else None
        return min(low for low, _ in known), max(high for _, high in known)

    def _read_without_ego(self, n: int) -> RawFrame:
        with one_notice_per_kind(self.notices):
            raw = self.read(n)
        setup = self.setup(n)
        raw = setup.limit(raw, self.sensor_position or (0.0, 0.0, 0.0))
        return raw if self.ego_footprint is None else raw.without(setup.ego_footprint or self.ego_footprint)


class ScanFiles(Recording):
    """Recording of files that `ogm.io.read_scan` reads, in the axes of the recording.

    Attributes
    ----------
    scans : list of Path
    units : mapping of str to number
        Given ``intensity_max``, ``time_unit`` and ``origin`` of `ogm.io.read_scan`.
    """

    def __init__(self, path: Path, scans: Sequence[tuple[FrameRef, Path]], name: str = "") -> None:
        super().__init__(path, [ref for ref, _ in scans], name)
        self.scans: list[Path] = [scan for _, scan in scans]
        self.units: Mapping[str, Any] = {}

    def read(self, n: int) -> RawFrame:
        """Read a scan from its file; with an origin, points in map coordinates come to the sensor by its pose."""
        T = self.frames[n].T_map_sensor if "origin" in self.units else None
        if T is None:
            return RawFrame(io.read_scan(self.scans[n], self.axes, **self.scales(n)))
        scan = io.read_scan(self.scans[n], self.axes, **{**self.scales(n), "origin": T[:3, 3]})
        points = scan.points.copy()
        points[:, :3] = rotate(T[:3, :3].T, points[:, :3].T).T
        return RawFrame(replace(scan, points=points, no_returns=None))

    def scales(self, n: int) -> Mapping[str, Any]:
        """Return the units of a scan: those that are given, else the drive's range of intensities."""
        return {"intensity_max": partial(self.intensities, n), **self.units}

    def intensity_range(self, n: int) -> IntensityRange | None:
        """Return the intensities that mean 0 and 1 by the values of one file."""
        return stated_range(read_table(self.scans[n]))


def why_no_height(points: NDArray[np.float32]) -> str:
    """Return the reason why points do not tell the sensor's height, in brackets; "" where they show no ground at all.

    Parameters
    ----------
    points : (N, 4) float32
    """
    from ogm.geometric.inputs import explain_coordinates, extent_text  # compiles kernels, which most callers need not

    finite = points[np.isfinite(points[:, :3]).all(axis=1), :3]
    if len(finite) and (cause := explain_coordinates(finite)):
        return f" (its points lie at {extent_text(finite)}: {cause})"
    plane = ground_plane(points)
    if plane is not None and plane.incline > MAX_INCLINE:
        return (
            f" (the ground is inclined by {np.degrees(plane.incline):.0f} degrees: the sensor is tilted, and neither "
            "transforms from base_link nor poses tell it; `ogm check --write vehicle.yaml` estimates it for --sensors)"
        )
    axes = ground_side(points) if plane is None or plane.height <= 0 else None
    return f" (the ground lies {SIDES[axes]} the sensor: give axes, --axes={axes})" if axes else ""


def _sample(numbers: Sequence[int]) -> list[int]:
    """Return up to five numbers, evenly spaced."""
    if not numbers:
        return []
    return [numbers[k] for k in np.unique(np.round(np.linspace(0, len(numbers) - 1, _HEIGHTS)).astype(int))]


def _absolute(value: Any) -> Any:
    """Return a path or a list of paths as absolute ones: another process may run in another folder."""
    if isinstance(value, list):
        return [_absolute(item) for item in value]
    return value.absolute() if isinstance(value, Path) else value
