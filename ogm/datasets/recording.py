"""Base class of all datasets and logs: frame references and reader methods for the parts of a frame.

To add a dataset, write a subclass in a new module, see `ogm.datasets.sustech` for an example, and list it in
`RECORDINGS` of `ogm.datasets.opening`.
"""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
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
from ogm.io.scan_table import axes_text, rotation_to_flu, stated_range
from ogm.pose import levelling, pose, rotate, tilt_of
from ogm.scan import Boxes, Mount, Scan
from ogm.state import Truth
from ogm.storage.files import OgmError

_MAX_SAMPLES = 5  # scans of a sequence from which heights and intensity ranges are estimated
_INDOOR_SQUARE = 0.25  # [m] side of ground squares for depth cameras
_MAX_KEPT = 64  # scans in memory, about 2 MB each; the truth of a frame takes many of its neighbours
_MAX_KEPT_UNLABELLED = 16
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
    kerbs: str = "ignore"
    spec: GridSpec | None = None
    frame: str | None = None
    truth: tuple[str, ...] = ()
    topic: tuple[str, ...] = ()
    sensors: tuple[str, ...] = ()
    setups: tuple[SensorSetup, ...] = ()


class Recording(ABC):
    """Frames of a dataset or a log: their references, and methods that read a part of frame n.

    Opening a recording reads no points. Pickling and copying drop the values of cached properties, which are read
    again when needed. Open files and large tables are therefore cached properties.

    Attributes
    ----------
    path : Path or ObjectPath
        File, folder or object store of the recording.
    frames : tuple of FrameRef
        References to the frames, with unique names.
    name : str
        Name of the recording.
    files : list of Path
        Files and folders that the recording is read from.
    facts : dict
        Further facts that JSON can hold; if empty, the format and the number of frames.
    format : str
        Name of the format.
    wanted_labels : str
        Labels that this format may have, named in the error if there are none.
    labelled : tuple of str
        Labels of the frames: "boxes" (`read_boxes`), "classes" (`RawFrame.kinds`), "map" (`hd_map`).
    ego_footprint : Footprint or None
        Region around the sensor in which returns are dropped. None keeps them; sensor models drop them by the mount.
    view : str
        View or range with labels, for the description of the truth.
    view_angle : float or None
        Half angle of the view ahead with labelled objects [rad], below π/2. None for all around.
    axes : Axes
        Axes of the files.
    stamped : bool
        Whether the stamps of the frames are stated, not counted from their names at 10 Hz.
    aggregated : bool
        Whether truth may be made of neighbouring scans; not for radars, which show no ground.
    motion_distorted : bool
        Whether points may be shifted by the ego motion during a scan and should be de-skewed.
    known_axes, known_height, known_mount, known_truth : bool
        Whether the dataset states its axes and units, the sensor's height, the whole mount, the truth. The user cannot
        override known axes, mounts and truths.
    warnings : sequence of str
        Damage found when the recording was opened.
    clock_findings : sequence of ClockFinding
        Clock faults found when the recording was opened.
    frame_notes : sequence of (str, str)
        Unusual properties of the frames of the points, each with the way out, or "" if no action is needed.
    transform_delays : (len(frames),) float64 array or None
        Delay from the recording of a scan to the recording of the transforms for its pose [s]; NaN if unknown.
    shards : (len(frames),) int array or None
        Shard of each frame in an object store. Reading a shard costs little more than reading one frame.
    assumed_height : bool
        Whether the known height is an assumption, because the scans show no ground and no height is stated.
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
    description: str = ""  # description of a known truth
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

    # --- References to frames ------------------------------------------------------------------------

    @classmethod
    def open(cls, paths: Sequence[Any], options: OpenOptions) -> "Recording | None":
        """Return the recording at the paths, or None if they have another format."""
        return cls.find(paths[0]) if len(paths) == 1 else None

    @classmethod
    def find(cls, path: Path) -> "Recording | None":
        """Return the recording at one existing path, or None if it has another format."""
        return None

    @cached_property
    def groups(self) -> dict[str, list[int]]:
        """Numbers of the frames of each sequence or single frame; sensor heights are constant in a group."""
        groups: dict[str, list[int]] = {}
        for n, ref in enumerate(self.frames):
            groups.setdefault(ref.sequence or ref.name, []).append(n)
        return groups

    # --- Methods of a format -------------------------------------------------------------------------

    @abstractmethod
    def read(self, n: int) -> RawFrame:
        """Read scan n, in the sensor's frame."""

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
        """Estimate the height of the sensor above ground from one scan [m]; None if it shows no ground."""
        return io.estimate_sensor_height(self.levelled_points(n), self.square(n))

    def square(self, n: int) -> float:
        """Return the side of the squares for estimating the ground [m], see `ogm.io.ground_plane`."""
        return _INDOOR_SQUARE if self.raw(n).scan.kind == "depth" else 1.0

    def intensity_range(self, n: int) -> IntensityRange | None:
        """Return the intensities that mean 0 and 1, found from one scan; None if the format states them."""
        return None

    def truth(self, n: int) -> Truth:
        """Return the truth of a frame; for recordings with a known truth."""
        raise NotImplementedError

    def has_truth(self, n: int) -> bool:
        """Return whether a frame may have a truth, without reading it."""
        return True

    def setup(self, n: int) -> SensorSetup:
        """Return the user's setup of the sensor of a frame."""
        return setup_of(self.setups, "")

    # --- Methods of all formats ----------------------------------------------------------------------

    def scan(self, n: int) -> Scan:
        """Return scan n without the returns inside the ego footprint."""
        return self.raw(n).scan

    @cached_property
    def raw(self) -> Callable[[int], RawFrame]:
        """Cached function that reads a frame without the returns inside the ego footprint."""
        return lru_cache(_MAX_KEPT if self.labelled else _MAX_KEPT_UNLABELLED)(self._read_without_ego)

    def boxes(self, n: int) -> Boxes | None:
        """Return the boxes around a scan, in the sensor's frame; None if there are no labelled boxes."""
        return self.read_boxes(n) if "boxes" in self.labelled else None

    def mount(self, n: int) -> Mount:
        """Return the mount of the sensor, with z = 0 on the ground below it."""
        height, position, place = self.height(n), self.sensor_position, self.place(n)
        if position is not None:
            return Mount(height, pose(*position), points_in="vehicle")
        T = pose(*place.origin, height, yaw=place.yaw)
        T[:3, :3] = T[:3, :3] @ self.levelling(n)
        return Mount(height, T, place.ego_footprint)  # type: ignore[arg-type]

    def levelling(self, n: int) -> NDArray[np.float64]:
        """Return the rotation that levels the points of a frame, (3, 3), from its pose or the stated mount.

        The tilt of the poses is not used if the dataset states the axes of the points, or if the ground in the scans
        is more level without it, as on an inclined road.
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
        """Return whether the poses of a group level the ground in its scans, by up to five scans."""
        poses = {k: T for k in self.groups[group] if (T := self.frames[k].T_map_sensor) is not None}
        tilted = [k for k, T in poses.items() if tilt_of(T) > LEVEL]
        gains = []
        for k in _sample(tilted):
            with suppress(*_UNREADABLE):  # reported by the mapping
                gains.append(levelling_gain(self.raw(k).scan.points, levelling(poses[k])))
        return bool(tilted) and (not gains or float(np.median(gains)) >= -LEVEL_MARGIN)

    def used_mount(self, n: int) -> Mount:
        """Return the mount of the sensor, with the user's ego footprint if there is one."""
        mount, footprint = self.mount(n), self.setup(n).ego_footprint
        return mount if footprint is None else replace(mount, ego_footprint=footprint)

    def height(self, n: int) -> float:
        """Return the sensor height above ground [m]: the user's, the dataset's, or a median of estimates."""
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
                    reasons.append(why_no_height(self.levelled_points(k), self.axes))
                else:
                    estimates.append(height + above)
                    side = self.square(k)
            except _UNREADABLE as error:
                unreadable = unreadable or str(error)
        if not estimates and unreadable and not reasons:
            raise OgmError(f"no scan of {group} can be read: {unreadable}; repair or leave out the files")
        if not estimates:
            why = next(filter(None, reasons), "")
            raise OgmError(
                f"no scan of {group} in {self.path} shows the ground around the sensor{why}, so its height is not "
                "known: give `sensor_height` [m]"
            )
        return plausible_sensor_height(float(np.median(estimates)), f"{group} in {self.path}", side)

    def intensities(self, n: int, own: IntensityRange) -> IntensityRange:
        """Return the intensities that mean 0 and 1 in all scans of a sensor in a drive.

        Parameters
        ----------
        n : int
            Number of a scan.
        own : (float, float)
            Intensity range of scan n alone.

        Returns
        -------
        (float, float)
            0 and 1 if most of up to five sampled scans are within, else the widest range of the sampled scans.
        """
        ref = self.frames[n]
        return (self._intensities(ref.sequence, self.place(n).name) if ref.sequence else None) or own

    @cached_property
    def _intensities(self) -> Callable[[str, str], IntensityRange | None]:
        return lru_cache(None)(self._widest_range)

    def _widest_range(self, group: str, sensor: str) -> IntensityRange | None:
        known: list[IntensityRange] = []
        for k in _sample([k for k in self.groups[group] if self.place(k).name == sensor]):
            with suppress(*_UNREADABLE):  # reported by the mapping
                if (limits := self.intensity_range(k)) is not None:
                    known.append(limits)
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
    """Recording of scan files that `ogm.io.read_scan` reads, in the axes of the recording.

    Attributes
    ----------
    scans : list of Path
        Scan file of each frame.
    units : mapping of str to number
        User-defined ``intensity_max``, ``time_unit`` and ``origin`` of `ogm.io.read_scan`.
    """

    def __init__(self, path: Path, scans: Sequence[tuple[FrameRef, Path]], name: str = "") -> None:
        super().__init__(path, [ref for ref, _ in scans], name)
        self.scans: list[Path] = [scan for _, scan in scans]
        self.units: Mapping[str, Any] = {}

    def read(self, n: int) -> RawFrame:
        """Read a scan from its file; with `origin`, points in map coordinates are transformed by the pose."""
        T = self.frames[n].T_map_sensor if "origin" in self.units else None
        if T is None:
            return RawFrame(io.read_scan(self.scans[n], self.axes, **self.scales(n)))
        scan = io.read_scan(self.scans[n], self.axes, **{**self.scales(n), "origin": T[:3, 3]})
        points = scan.points.copy()
        points[:, :3] = rotate(T[:3, :3].T, points[:, :3].T).T
        return RawFrame(replace(scan, points=points, no_returns=None))

    def scales(self, n: int) -> Mapping[str, Any]:
        """Return the units of a scan: the user's, else the intensity range of the drive."""
        return {"intensity_max": partial(self.intensities, n), **self.units}

    def intensity_range(self, n: int) -> IntensityRange | None:
        """Return the intensities that mean 0 and 1, found from one file."""
        return stated_range(read_table(self.scans[n]))


def why_no_height(points: NDArray[np.float32], used: Axes) -> str:
    """Return the reason for an unknown sensor height, in brackets; "" if no ground is visible.

    Parameters
    ----------
    points : (N, 4) float32
        Points of a scan [m].
    used : Axes
        Axes by which the scan was read.
    """
    from ogm.geometric.inputs import explain_coordinates, extent_text  # late, as it compiles kernels

    finite = points[np.isfinite(points[:, :3]).all(axis=1), :3]
    if len(finite) and (cause := explain_coordinates(finite)):
        return f" (its points lie at {extent_text(finite)}: {cause})"
    plane = ground_plane(points)
    if plane is not None and plane.incline > MAX_INCLINE:
        return (
            f" (the ground is inclined by {np.degrees(plane.incline):.0f} degrees: the sensor is tilted, and neither "
            "transforms from base_link nor poses state it; `ogm check --write vehicle.yaml` estimates the tilt for "
            "--sensors)"
        )
    axes = ground_side(points) if plane is None or plane.height <= 0 else None
    if axes is None:
        return ""
    wanted = axes_text(rotation_to_flu(axes.split(",")) @ rotation_to_flu(used))
    return f" (the ground lies {SIDES[axes]} the sensor: give axes, --axes={wanted})"


def _sample(numbers: Sequence[int]) -> list[int]:
    """Return up to five numbers, evenly spaced."""
    if not numbers:
        return []
    return [numbers[k] for k in np.unique(np.round(np.linspace(0, len(numbers) - 1, _MAX_SAMPLES)).astype(int))]


def _absolute(value: Any) -> Any:
    """Return a path or list with absolute paths, as another process may have another working folder."""
    if isinstance(value, list):
        return [_absolute(item) for item in value]
    return value.absolute() if isinstance(value, Path) else value
