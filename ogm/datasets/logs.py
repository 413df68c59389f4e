"""Logs: scans in ROS bags and MCAPs with poses from transforms, and captures of Velodynes (.pcap)."""

import logging
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.frames import FrameRef, RawFrame, SensorPlace
from ogm.datasets.log_scans import CLOUD, CONE_TYPES, IMAGE_TYPES, PLANAR_TYPES, RADAR_TYPES, LogScans, scan_topics
from ogm.datasets.log_transforms import LogTransforms
from ogm.datasets.recording import OpenOptions, Recording
from ogm.datasets.scans import ending_of
from ogm.datasets.sensor_setup import SensorSetup, setup_of
from ogm.io.columns import IntensityRange
from ogm.io.logs import LogMessage, LogReader, log_ending, open_log
from ogm.io.logs.definitions import log_files
from ogm.io.messages.clouds import cloud_table, scan_from_continental, scan_from_point_cloud2, scan_from_radar_scan
from ogm.io.messages.images import scan_from_depth_image
from ogm.io.messages.lasers import laser_intensity_range, scan_from_laser_scan, scan_from_range
from ogm.io.messages.livox import scan_from_livox
from ogm.io.messages.velodyne import scan_from_velodyne_scan, scans_from_pcap
from ogm.io.scan_table import rotation_to_flu, stated_range
from ogm.pose import pose, rotate, transform_points
from ogm.scan import Scan
from ogm.storage.files import OgmError

_log = logging.getLogger(__name__)


def is_log(paths: Sequence[Path]) -> bool:
    """Return whether paths are named as logs: files, or one folder of logs without scans and sub-folders."""
    if len(paths) == 1 and paths[0].is_dir():
        other = any(entry.is_dir() or ending_of(entry) for entry in paths[0].iterdir())
        return not other and bool(log_files(paths[0]))
    return bool(paths) and all(map(log_ending, paths))


class LogRecording(Recording):
    """Scans of a log, sorted by header stamp.

    Points are turned to the axes of the vehicle (base_link) if transforms state them. With several sensors, each
    sensor has its place in the vehicle's frame.
    """

    wanted_labels = "poses of the scans (transforms or odometry in the log)"
    ego_footprint = None
    known_axes = False
    own_options = ("topic", "frame")

    def __init__(self, path: Path, scans: LogScans, options: OpenOptions) -> None:
        poses, facts = scans.poses(options.frame)
        position, several = options.sensor_position, len(scans.topics) > 1
        if position is not None and (known := scans.known_place()):
            text = f"points in the vehicle's frame, but those of {path} are in {known}"
            raise ValueError(f"`sensor_position` is for {text}: leave it out")
        self._turns = _turns(scans, rotation_to_flu(options.axes), position is not None)
        self._places = None if position is not None else scans.places()
        self._in_vehicle = position is None and scans.T_vehicle_sensor is not None
        turns = self._turns
        if any(setup.mount is not None for setup in options.setups):
            turns = _turns_of_poses(poses, turns)
        poses[:, :3, :3] = poses[:, :3, :3] @ np.swapaxes(turns, 1, 2)
        if position is not None:
            poses = poses @ pose(*position)
        super().__init__(path, scans.frame_refs(poses), scans.name)
        self._moves, self._cameras = scans.T_sensor_cloud, scans.cameras
        self.warnings, self.frame_notes = tuple(scans.warnings), scans.frame_notes(position is not None)
        self.log, self.files, self._scans = scans.log, list(scans.log.paths), scans.refs
        self.axes, self._units, self.format = options.axes, options.units, f"log, {scans.log.format}"
        self.facts = {"format": scans.log.format, "frames": len(scans.refs), "topics": list(scans.topics), **facts}
        self.stamped = not np.isnan(scans.stamps).any()
        self.known_height = self._places is not None and self._places[0].height is not None
        self.assumed_height = scans.assumes_height
        self.known_truth, self.motion_distorted = several, not several
        self.clock_findings = [*scans.transforms.clock.findings, *scans.pose_findings]
        for warning in (*scans.transforms.notes, *scans.pose_findings):
            _log.warning("%s: %s", path, warning)
        self.transform_delays = scans.transform_delays(facts["frame"])
        if scans.transforms.clock.is_cut:
            self.main_sequence = max(self.groups, key=lambda name: len(self.groups[name]))

    @classmethod
    def open(cls, paths: Sequence[Path], options: OpenOptions) -> "LogRecording | None":
        """Return the scans of a log, given as a file, its parts, or their folder; None if the paths are no log.

        Raises
        ------
        OgmError
            If a topic or frame does not exist, no topic is chosen of several with scans, or the file is no log.
        ValueError
            If an option states axes, units or a position that the log itself states.
        """
        if not is_log(paths):
            return None
        scans = LogScans(open_log(paths), options.topic, options.sensor_position is not None, options.setups)
        for finding in scans.transforms.clock.findings:
            if finding.kind == "coarse stamps":
                raise OgmError(f"{scans.path}: {finding}")
        for warning in (*scans.warnings, *scans.transforms.clock.findings):
            _log.warning("%s", warning)
        if "origin" in options.units:
            raise ValueError(f"`origin` is for files of scans in map coordinates, {scans.path} is a log: leave it out")
        if scans.types != {CLOUD} and options.units:
            raise ValueError(f"{scans.path} has scans of known units: leave out `intensity_max` and `time_unit`")
        if len(scans.topics) > 1 and options.sensor_position is not None:
            raise ValueError(f"`sensor_position` is for one sensor, got {len(scans.topics)} topics: choose one `topic`")
        return cls(paths[0], scans, options)

    @cached_property
    def log(self) -> LogReader:
        """Open log."""
        return open_log(self.files)

    def read(self, n: int) -> RawFrame:
        """Read a scan and turn its points to the vehicle's axes."""
        ref = self._scans[n]
        message = self.log.message(ref.ref)
        try:
            if message.type in IMAGE_TYPES:
                scale = self.setup(n).depth_scale
                scan = scan_from_depth_image(message.decode(), self._cameras[message.topic], scale=scale)
            else:
                scan = _scan(message, self._scales(n))
        except OgmError as error:
            raise OgmError(f"{self.files[ref.ref.file]}: {error}") from error
        if self._moves is not None:
            scan = _moved(scan, self._moves[n], ref.cloud)
        return RawFrame(turn_scan(replace(scan, sensor=ref.frame), self._turns[n]))

    def _scales(self, n: int) -> Mapping[str, Any]:
        """Return the units of a point cloud: the user's, else the intensity range of the drive."""
        return {"intensity_max": partial(self.intensities, n), **self._units}

    def intensity_range(self, n: int) -> IntensityRange | None:
        """Return the intensities that mean 0 and 1, from one cloud or laser scan; None for other messages."""
        message = self.log.message(self._scans[n].ref)
        if message.type in PLANAR_TYPES:
            return laser_intensity_range(message.decode())
        return stated_range(cloud_table(message.decode())[0]) if message.type == CLOUD else None

    def place(self, n: int) -> SensorPlace:
        """Return the place of the sensor of a scan."""
        return SensorPlace() if self._places is None else self._places[n]

    def setup(self, n: int) -> SensorSetup:
        """Return the user's setup of the sensor of a scan, by its topic."""
        setup = setup_of(self.setups, self._scans[n].topic)
        return replace(setup, mount=None) if self._in_vehicle else setup  # points are already turned by the mount

    def height(self, n: int) -> float:
        """Return the sensor height [m], by transforms from a lidar if the sensor shows no ground."""
        lidars = (k for k, ref in enumerate(self._scans) if self._shows_ground(ref.topic))
        reference = n if self._shows_ground(self._scans[n].topic) else next(lidars, n)
        return super().height(reference) + self.place(n).above_first - self.place(reference).above_first

    def _shows_ground(self, topic: str) -> bool:
        return self.log.topics[topic].type not in (*RADAR_TYPES, *PLANAR_TYPES, *CONE_TYPES)

    def truth(self, n: int) -> NoReturn:
        """Raise OgmError, as scans of several sensors have no truth."""
        raise OgmError(f"{self.path} has scans of several sensors, of which no truth is made: choose one `topic`")


def describe_log(path: Path, frame: str | None = None) -> dict[str, str]:
    """Return the content of a log and the reasons of missing poses, as names and values to print.

    Parameters
    ----------
    path : Path
    frame : str, optional
        See `LogTransforms.fixed_frame`.
    """
    log = open_log(path)
    stamps = [t for facts in log.topics.values() for t in (facts.first, facts.last) if facts.count]
    found = {"format": log.format, "files": ", ".join(file.name for file in log.paths)}
    if stamps:
        found["recorded"] = f"{max(stamps) - min(stamps):.1f} s, {_date(min(stamps))} to {_date(max(stamps))}"
    for name, facts in log.topics.items():
        rate = "" if np.isnan(facts.rate) else f", {facts.rate:.1f} Hz"
        found[name] = f"{facts.type}, {facts.count} message{'s' * (facts.count != 1)}{rate}"
    topics = {name: LogScans(log, name) for name in scan_topics(log)}
    transforms = next((scans.transforms for scans in topics.values()), None) or LogTransforms(log)
    pairs = transforms.buffer.pairs.items()
    found["transforms"] = ", ".join(f"{a} <- {b}{' (static)' * static}" for (a, b), static in pairs) or "none"
    for name, scans in topics.items():
        try:
            poses = scans.poses(frame)[1]["poses"]
        except OgmError as error:
            poses = str(error)
        if faults := [*scans.transforms.clock.findings, *scans.pose_findings]:
            found[f"clock of {name}"] = "; ".join(map(str, faults))
        found[f"poses of {name}"] = f"{poses} (see `ogm fuse --odometry`)" if poses.startswith("none") else poses
    if damage := [warning for scans in topics.values() for warning in scans.warnings] or log.warnings:
        found["damage"] = "; ".join(dict.fromkeys(damage))
    return found


def _date(stamp: float) -> str:
    """Return a time as a date, or in seconds if it is no time since 1970."""
    try:
        return f"{datetime.fromtimestamp(stamp, UTC):%Y-%m-%d %H:%M:%S} UTC" if stamp > 1e8 else f"{stamp:.3f} s"
    except (ValueError, OverflowError, OSError):
        return f"{stamp:.3f} s"


def _scan(message: LogMessage, units: Mapping[str, Any]) -> Scan:
    """Return the scan of a message of any of `SCAN_TYPES` except images."""
    if message.type == CLOUD:
        return scan_from_point_cloud2(message.decode(), **units)
    if message.type in PLANAR_TYPES:
        return scan_from_laser_scan(message.decode(), intensity_max=units["intensity_max"])
    if message.type in CONE_TYPES:
        return scan_from_range(message.decode())
    if message.type.endswith("/CustomMsg"):
        return scan_from_livox(message.raw)
    if message.type.startswith("continental_msgs/"):
        return scan_from_continental(message.decode())
    if message.type.startswith("radar_msgs/"):
        return scan_from_radar_scan(message.decode())
    return scan_from_velodyne_scan(message.decode())


def _turns(scans: LogScans, turn: NDArray[np.float64], in_vehicle: bool) -> NDArray[np.float64]:
    """Return the rotation of the points of each scan to x forward, y left, z up, (K, 3, 3)."""
    T = None if in_vehicle else scans.T_vehicle_sensor
    if T is None:
        return np.tile(turn, (len(scans.refs), 1, 1))
    if not np.array_equal(turn, np.eye(3)):
        raise ValueError(f"the transforms of {scans.path} state the axes of its points: leave out `axes`")
    return T[:, :3, :3]


def _turns_of_poses(poses: NDArray[np.float64], turns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotations to apply to poses when a stated mount turns the points, (K, 3, 3).

    Poses without the tilt of the mount are poses of a level sensor, so only the heading is applied to them.
    """
    turned = poses[:, :3, :3] @ np.swapaxes(turns, 1, 2)
    known = np.isfinite(poses[:, 0, 0])
    if not known.any() or np.median(turned[known, 2, 2]) >= np.median(poses[known, 2, 2]):
        return turns
    return np.array([pose(yaw=np.arctan2(R[1, 0], R[0, 0]))[:3, :3] for R in turns])


def _moved(scan: Scan, T: NDArray[np.float64], frame: str) -> Scan:
    """Return a scan in its sensor's frame; a moved scan loses its beams without echo."""
    if np.array_equal(T, np.eye(4)):
        return scan
    if not np.isfinite(T).all():
        raise OgmError(
            f"its points are in {frame}, and no transform leads from there to the sensor at its stamp: give "
            "`sensor_position`, or choose a `topic` with clouds in the sensor's frame"
        )
    return replace(scan, points=transform_points(T, scan.points), no_returns=None)


def turn_scan(scan: Scan, R: NDArray[np.float64]) -> Scan:
    """Return a scan in other axes.

    Parameters
    ----------
    scan : Scan
    R : (3, 3) float64
        Rotation from the axes of the scan to the other axes.
    """
    if np.array_equal(R, np.eye(3)):
        return scan
    points = scan.points.copy()
    points[:, :3] = rotate(R, points[:, :3].T).T
    no_returns = None if scan.no_returns is None else rotate(R, scan.no_returns.T).T.astype(np.float32)
    return replace(scan, points=points, no_returns=no_returns)


CAPTURE_ENDINGS = (".pcap", ".pcapng")


class CaptureRecording(Recording):
    """Scans of a Velodyne capture."""

    format = "network capture"
    wanted_labels = "poses of the scans, which a capture does not hold: estimate them with `ogm fuse --odometry`"
    ego_footprint = None
    stamped = True
    known_axes = False

    @classmethod
    def open(cls, paths: Sequence[Path], options: OpenOptions) -> "CaptureRecording | None":
        """Return the scans of a capture, or None if no path is named as a capture.

        Raises
        ------
        OgmError
            If there are several files, or the file is no capture of a single Velodyne.
        ValueError
            If the options state units, which packets define.
        """
        if not any(path.suffix.lower() in CAPTURE_ENDINGS for path in paths):
            return None
        path = paths[0]
        if len(paths) > 1:
            raise OgmError(f"{path} is a network capture, got {len(paths)} paths: give one alone")
        if options.units:
            raise ValueError(f"{path} has scans of known units: leave out `intensity_max` and `time_unit`")
        stamps = [scan.stamp for scan in scans_from_pcap(path, no_returns=False)]
        refs = [FrameRef(f"{n:06d}", path.stem, stamp) for n, stamp in enumerate(stamps)]
        recording = cls(path, refs, path.stem)
        recording.axes = options.axes
        return recording

    def decode(self) -> Iterator[Scan]:
        """Decode the scans from the beginning of the capture."""
        return scans_from_pcap(self.path)

    @cached_property
    def _sequence(self) -> "ScanSequence":
        return ScanSequence(self.path, self.decode)

    def read(self, n: int) -> RawFrame:
        """Read a scan; fast only in the order of the scans."""
        return RawFrame(turn_scan(self._sequence.read(n), rotation_to_flu(self.axes)))


class ScanSequence:
    """Scans of a capture, decoded from the beginning: fast in sequential order, slow in random order.

    Parameters
    ----------
    path : Path
    decode : function
        Returns an iterator over all scans.
    """

    def __init__(self, path: Path, decode: Callable[[], Iterator[Scan]]) -> None:
        self._path, self._decode, self._lock = path, decode, threading.Lock()
        self._rewind()

    def read(self, n: int) -> Scan:
        """Return scan n; earlier scans are decoded and dropped."""
        with self._lock:
            if n < self._next:
                self._rewind()
            for scan in self._scans:
                self._next += 1
                if self._next > n:
                    return scan
        raise OgmError(f"{self._path} has only {self._next} scans, wanted scan {n}: it was changed, open it again")

    def _rewind(self) -> None:
        self._scans: Iterator[Scan] = self._decode()
        self._next = 0
