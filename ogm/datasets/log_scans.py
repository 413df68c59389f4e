"""Scans of a log: their places in the files, sensors, stamps and poses."""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.clocks import STRAY, ClockFinding
from ogm.datasets.frames import FrameRef, SensorPlace
from ogm.datasets.log_frames import lidar_frames, unnamed_frame
from ogm.datasets.log_transforms import LogTransforms
from ogm.datasets.sensor_setup import SensorSetup, setup_of
from ogm.io.depth import Intrinsics
from ogm.io.logs import LogReader
from ogm.io.logs.reader import MessageHead, MessageRef
from ogm.io.messages.images import DEPTH_ENCODINGS, intrinsics_from_camera_info
from ogm.storage.files import OgmError

CLOUD = "sensor_msgs/msg/PointCloud2"
_LIDAR_TYPES = (
    CLOUD, "velodyne_msgs/msg/VelodyneScan", "livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg",
)  # fmt: skip
RADAR_TYPES = (
    "radar_msgs/msg/RadarScan", "continental_msgs/msg/ContinentalArs548DetectionList",
    "continental_msgs/msg/ContinentalSrr520DetectionList",
)  # fmt: skip
PLANAR_TYPES = ("sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan")
CONE_TYPES = ("sensor_msgs/msg/Range",)
_IMAGE, _PACKED, CAMERA = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
IMAGE_TYPES = _IMAGE, _PACKED  # only depth images are scans, see `scan_topics`
# Kinds of topics in the order of preference
_BY_DEFAULT = (_LIDAR_TYPES, PLANAR_TYPES, (_IMAGE,), (_PACKED,), RADAR_TYPES, CONE_TYPES)
SCAN_TYPES = tuple(name for types in _BY_DEFAULT for name in types)
PACKET_TYPES = (  # raw packets of sensors, which are not decoded
    "ouster_ros/msg/PacketMsg", "ouster_sensor_msgs/msg/PacketMsg", "hesai_ros_driver/msg/UdpFrame",
    "rslidar_msg/msg/RslidarPacket", "nebula_msgs/msg/NebulaPackets", "pandar_msgs/msg/PandarScan",
)  # fmt: skip
_RADAR = re.compile(r"radar|continental|(?<![a-z])(ars|srr|umrr)", re.IGNORECASE)  # in names and types of topics
_HALF_LENGTH, _HALF_WIDTH = 2.5, 1.1  # [m] of the ego vehicle around its lidars, the default of `Mount`
NO_FOOTPRINT = (0.0, 0.0, 0.0, 0.0)  # planar lasers and depth cameras seldom see their small robots
PLANE_HEIGHT = 0.3  # [m] above ground: default for planar lasers and range sensors; only a name of their plane
_ON_GROUND = 0.03  # [m] a sensor at most this high in base_link may be the origin of base_link itself


class ScanRef(NamedTuple):
    """Reference to a scan of a log and its header; points are not read."""

    ref: MessageRef
    topic: str
    frame: str  # frame of the sensor
    cloud: str  # frame of the points, usually the same
    time: int  # header time [ns]
    stamp: float  # [s]; NaN if the header has none
    part: int  # part of the drive, see `clock_parts`


class LogScans:
    """Scans of chosen topics of a log, sorted by header stamp. No points are read.

    Parameters
    ----------
    log : LogReader
    topic : str or iterable of str
        Topics with scans. By default the only topic of the first kind in the log: lidar, planar laser, depth camera,
        radar, range sensor.
    placed : bool
        Whether the user gives the position of the sensor, in base_link if clouds are in a frame above it.
    setups : iterable of SensorSetup
        Sensors with mounts that replace the transforms from base_link.

    Attributes
    ----------
    pose_findings : list of ClockFinding
        Faults of the clocks of transforms, found by `poses`.

    Raises
    ------
    OgmError
        If a topic does not exist, or the default topic is ambiguous.
    """

    def __init__(
        self, log: LogReader, topic: str | Iterable[str] = (), placed: bool = False, setups: Iterable[SensorSetup] = ()
    ) -> None:
        self.log, self.path = log, log.paths[0]
        self.topics = _chosen(log, [topic] if isinstance(topic, str) else list(topic))
        self.types = {log.topics[name].type for name in self.topics}
        self.transforms = LogTransforms(log, self.topics)
        self.assumes_height = False  # set by `places`
        self.unplaced: dict[str, str] = {}  # frames of clouds with an unknown sensor position -> reason
        self.cameras = {name: camera_of(log, name) for name in self.topics if log.topics[name].type in IMAGE_TYPES}
        self.transforms.heads = self._with_bodies(self.transforms.heads)
        named = [(log.topic_of(ref), head.frame) for ref, head in self.transforms.heads]
        keys = dict.fromkeys(named)
        frames = {key: self._spelled(key[1]) if key[1] else self._unnamed(key[0], named) for key in keys}
        sensors = {name: self._sensor(name, placed) for name in frames.values()}
        clock = self.transforms.clock
        rows = zip(self.transforms.heads, named, clock.stamps.tolist(), clock.parts.tolist(), strict=True)
        scans = [
            ScanRef(ref, key[0], sensors[frames[key]], frames[key], head.time, stamp, part)
            for (ref, head), key, stamp, part in rows
            if part != STRAY
        ]
        mounts = {name: setup_of(setups, name).T_vehicle_sensor for name in self.topics}
        for frame, name in {scan.frame: scan.topic for scan in scans}.items():
            if (T := mounts[name]) is not None:
                self.transforms.mount(frame, T)
        self.refs = sorted(scans, key=lambda scan: (scan.part, scan.time))
        self.pose_findings: list[ClockFinding] = []
        self.warnings, lost = [*log.warnings], self.transforms.lost
        if lost:
            self.warnings.append(f"{len(lost)} messages are left out: {lost[0]}")
        if not scans:
            raise OgmError(f"{self.path} has no readable message of {', '.join(self.topics)}: choose another `topic`")

    @property
    def name(self) -> str:
        """Name of the drive: the file's, or the folder's for a log of several files."""
        return self.path.stem if len(self.log.paths) == 1 else self.path.resolve().parent.name

    @cached_property
    def stamps(self) -> NDArray[np.float64]:
        """Stamps of the scans on the time line of the transforms, (K,) [s]; NaN if missing."""
        stamps, parts = np.array([scan.stamp for scan in self.refs]), np.array([scan.part for scan in self.refs])
        return self.transforms.clock.shifted(stamps, parts)

    @cached_property
    def by_frame(self) -> dict[str, NDArray[np.intp]]:
        """Numbers of the scans with a stamp, by sensor frame."""
        frames = np.array([scan.frame for scan in self.refs])
        known = np.isfinite(self.stamps)
        return {scan.frame: np.flatnonzero((frames == scan.frame) & known) for scan in self.refs}

    def poses(self, wanted: str | None = None) -> tuple[NDArray[np.float64], dict[str, Any]]:
        """Return the sensor poses and facts about their source.

        Parameters
        ----------
        wanted : str, optional
            See `LogTransforms.fixed_frame`.

        Returns
        -------
        poses : (K, 4, 4) float64
            ``T_map_sensor`` of each scan; NaN if unknown.
        facts : dict
            "poses" (number, source and reasons of missing poses, in words) and "frame" (fixed frame, or "").

        Raises
        ------
        OgmError
            If clouds are in a frame that does not give the position of their sensor.
        """
        for ref in self.refs:
            if ref.cloud in self.unplaced:
                raise OgmError(f"{self.path}: the points of {ref.topic} {self.unplaced[ref.cloud]}")
        poses = np.full((len(self.refs), 4, 4), np.nan)
        topics = {scan.frame: scan.topic for scan in reversed(self.refs)}
        fixed, reasons, chains = None, [], []
        if np.isnan(self.stamps).any():
            reasons.append(f"{np.isnan(self.stamps).sum()} headers have no stamp (0)")
        for sensor, numbers in self.by_frame.items():
            if (found := self.transforms.fixed_frame(sensor, wanted, fixed)) is None:
                reasons.append(self.transforms.missing(sensor, topics[sensor]))
                continue
            fixed = found
            logged = np.array([self.refs[n].ref.log_time * 1e-9 for n in numbers])
            faults = self.transforms.clock_findings(found, sensor, topics[sensor], logged, self.stamps[numbers])
            self.pose_findings += faults
            self.transforms.note_parents(found, sensor)
            if coarse := [fault for fault in faults if fault.kind == "coarse stamps"]:
                reasons += map(str, coarse)
                continue
            poses[numbers], why = self.transforms.lookup(found, sensor, self.stamps[numbers])
            chains.append(" <- ".join(self.transforms.buffer.chain(found, sensor)))
            if why:
                reasons.append(f"{len(why)} of {topics[sensor]}: {next(iter(why.values()))}")
        moved = {ref.topic: f"points of {ref.topic} from {ref.cloud}" for ref in self.refs if ref.cloud != ref.frame}
        chains += moved.values()
        known = int(np.isfinite(poses[:, 0, 0]).sum())
        how = f"{known} of {len(poses)} scans, by {self.transforms.source} ({', '.join(chains)})" if known else "none"
        return poses, {"poses": "; ".join([how, *reasons]), "frame": fixed or ""}

    def transform_delays(self, fixed: str) -> NDArray[np.float64]:
        """Return the recording delay of the transforms of each scan, (K,) [s]; NaN if unknown.

        Parameters
        ----------
        fixed : str
            Fixed frame of the poses; "" if there are no poses.
        """
        delays = np.full(len(self.refs), np.nan)
        logged = np.array([scan.ref.log_time * 1e-9 for scan in self.refs])
        for sensor, numbers in self.by_frame.items():
            if fixed and self.transforms.fixed_frame(sensor, None, fixed):
                delays[numbers] = self.transforms.recorded(fixed, sensor, self.stamps[numbers]) - logged[numbers]
        return delays

    @cached_property
    def T_sensor_cloud(self) -> NDArray[np.float64] | None:  # noqa: N802
        """Transforms from cloud frame to sensor frame, (K, 4, 4); None if the frames are the same."""
        T = np.tile(np.eye(4), (len(self.refs), 1, 1))
        pairs = {(ref.frame, ref.cloud) for ref in self.refs if ref.cloud != ref.frame}
        for sensor, frame in sorted(pairs):
            numbers = np.array([n for n, ref in enumerate(self.refs) if (ref.frame, ref.cloud) == (sensor, frame)])
            known = np.isfinite(self.stamps[numbers])
            T[numbers] = np.nan
            T[numbers[known]] = self.transforms.lookup(sensor, frame, self.stamps[numbers[known]])[0]
        return T if pairs else None

    def frame_notes(self, placed: bool) -> list[tuple[str, str]]:
        """Return notes on unusual frames, heights and transforms, each with the way out or ""."""
        notes = [(text, "") for text in self.transforms.notes]
        if self.assumes_height:
            text = f"the height of {', '.join(self.topics)} above ground is not known: {self.places()[0].height:g} m is"  # type: ignore[index]
            notes.append((f"{text} assumed as the height of the plane of free cells (--sensor-height)", ""))
        for topic, ref in {ref.topic: ref for ref in self.refs}.items():
            if topic in self.cameras:
                if self.cameras[topic].distortion:
                    text = f"the images of {topic}, not named as rectified (rect), are rectified by camera_info's lens"
                    notes.append((text, ""))
                if note := self.transforms.cameras.get(ref.cloud):
                    way = "state the pose of the camera body (x forward, y left, z up) as mount in --sensors"
                    notes.append((f"the images of {topic} are in {ref.cloud.removesuffix('_body')}, {note}", way))
                continue
            if ref.cloud != ref.frame and not placed:
                text = f"the points of {topic} are in {ref.cloud}: rays start at {ref.frame}, by transforms"
                notes.append((text, ""))
            elif not placed and self.transforms.vehicle_frame(ref.frame) == ref.frame:
                text = f"the points of {topic} are in {ref.cloud}, the vehicle's frame: rays start at its origin"
                notes.append((text, "give --sensor-position X Y Z, the sensor's position there; 0 0 0 is the origin"))
        return notes

    def known_place(self) -> str:
        """Return the sensor's frame and position in base_link, in words; "" if unknown, or the same frame."""
        frame = self.refs[0].frame
        vehicle, T = self.transforms.vehicle_frame(frame), self.T_vehicle_sensor
        if vehicle in (None, frame) or T is None or np.allclose(T[0], np.eye(4)):
            return ""
        x, y, z = T[0, :3, 3]
        return f"{frame}, at {x:g} {y:g} {z:g} m in {vehicle}"

    def _with_bodies(self, heads: list[tuple[MessageRef, MessageHead]]) -> list[tuple[MessageRef, MessageHead]]:
        """Return headers with the frames of depth images replaced by the frames of their camera bodies."""
        images = [self.log.topic_of(ref) in self.cameras for ref, _ in heads]
        frames = {head.frame for (_, head), is_image in zip(heads, images, strict=True) if is_image}
        bodies = {frame: self.transforms.camera_body(self._spelled(frame)) for frame in frames}
        rows = zip(heads, images, strict=True)
        return [(ref, head._replace(frame=bodies[head.frame]) if is_image else head) for (ref, head), is_image in rows]

    def _spelled(self, frame: str) -> str:
        """Return a frame in the spelling of the transforms, if only the case differs."""
        known = self.transforms.buffer.frames
        alike = [name for name in known if name.casefold() == frame.casefold()]
        if frame in known or len(alike) != 1:
            return frame
        self.transforms.notes.append(f"the frame {frame} of scans is taken for {alike[0]}, as transforms spell it")
        return alike[0]

    def _unnamed(self, topic: str, named: Iterable[tuple[str, str]]) -> str:
        """Return the frame of scans without a frame name in their headers.

        It is the frame of the topic's other scans, else the only lidar frame of the transforms, else a placeholder.

        Parameters
        ----------
        topic : str
        named : iterable of (str, str)
            Topics and frames of all scans.
        """
        others = {frame for name, frame in named if name == topic and frame}
        possible = [facts.type for facts in self.log.topics.values() if facts.type in (*_LIDAR_TYPES, *PLANAR_TYPES)]
        is_only = self.log.topics[topic].type in possible and len(possible) == 1
        found = sorted(others) or (lidar_frames(self.transforms.buffer) if is_only else [])
        if len(found) != 1:
            return unnamed_frame(topic)
        why = "the frame of the others" if others else "the only frame of a lidar in transforms"
        self.transforms.notes.append(f"scans of {topic} without frame are taken to be in {found[0]}, {why}")
        return self._spelled(found[0])

    def _sensor(self, frame: str, placed: bool) -> str:
        """Return the sensor frame of clouds, or the vehicle frame if the user gives a position in it."""
        try:
            sensor = self.transforms.sensor_frame(frame)
        except OgmError as error:
            if not placed:
                self.unplaced[frame] = str(error)
            return (self.transforms.vehicle_frame(frame) or frame) if placed else frame
        return sensor if sensor == frame or not placed else (self.transforms.vehicle_frame(frame) or frame)

    @cached_property
    def T_vehicle_sensor(self) -> NDArray[np.float64] | None:  # noqa: N802
        """Sensor pose in base_link at each scan, (K, 4, 4); None if it is unknown for any sensor."""
        return self._in_frames(self.transforms.vehicle_frame)

    def _in_frames(self, find: Callable[[str], str | None]) -> NDArray[np.float64] | None:
        """Return the sensor pose in another frame at each scan, (K, 4, 4); None if unknown for any sensor."""
        result = np.full((len(self.refs), 4, 4), np.nan)
        frames = np.array([scan.frame for scan in self.refs])
        for sensor, numbers in self.by_frame.items():
            if (frame := find(sensor)) is None:
                return None
            result[numbers] = self.transforms.lookup(frame, sensor, self.stamps[numbers])[0]
            unknown = np.isnan(result[:, 0, 0]) & (frames == sensor)
            known = np.flatnonzero(~unknown & (frames == sensor))
            if not len(known):
                return None
            result[unknown] = result[known[0]]
        return result

    def places(self) -> list[SensorPlace] | None:
        """Return the place of the sensor of each scan, or None if the log does not state it.

        Raises
        ------
        OgmError
            If there are several sensors without transforms to base_link.
        """
        floor = self._in_frames(self.transforms.floor_frame)
        heights = [None] * len(self.refs) if floor is None or (floor[:, 2, 3] <= 0).any() else floor[:, 2, 3].tolist()
        if heights[0] is None and self.types <= {*PLANAR_TYPES, *CONE_TYPES}:
            heights, self.assumes_height = self._plane_heights(), True
        if len(self.topics) == 1:
            box = NO_FOOTPRINT if self._sees_no_vehicle(self.topics[0]) else None
            known = heights[0] is not None or box is not None
            return [SensorPlace(height=height, ego_footprint=box) for height in heights] if known else None
        if (T := self.T_vehicle_sensor) is None:
            raise OgmError(
                f"{self.path}: {self.transforms.missing_vehicle(list(self.by_frame))}, which scans of several sensors "
                "need: choose one `topic`"
            )
        places, first = T[:, :3, 3], {scan.topic: n for n, scan in reversed(list(enumerate(self.refs)))}
        x, y = np.array([places[n, :2] for n in first.values()]).T
        x, y = (x.min() + x.max()) / 2, (y.min() + y.max()) / 2
        box = (x - _HALF_LENGTH, x + _HALF_LENGTH, y - _HALF_WIDTH, y + _HALF_WIDTH)
        above = places[:, 2] - places[first[self.topics[0]], 2]
        rows = zip(self.refs, places, above, heights, strict=True)
        boxes = {topic: NO_FOOTPRINT if self._sees_no_vehicle(topic) else box for topic in self.topics}
        return [SensorPlace(scan.topic, (at[0], at[1]), up, high, boxes[scan.topic]) for scan, at, up, high in rows]

    def _sees_no_vehicle(self, topic: str) -> bool:
        return topic in self.cameras or self.log.topics[topic].type in (*PLANAR_TYPES, *CONE_TYPES)

    def _plane_heights(self) -> list[float]:
        """Return assumed heights of planar lasers and range sensors: the height in base_link, or 0.3 m."""
        T = self.T_vehicle_sensor
        above = [PLANE_HEIGHT] * len(self.refs) if T is None else T[:, 2, 3].tolist()
        return [height if height > _ON_GROUND else PLANE_HEIGHT for height in above]

    def frame_refs(self, poses: NDArray[np.float64]) -> tuple[FrameRef, ...]:
        """Return the frames, named by the stamp [ns], after the topic if there are several topics."""
        refs, used = [], Counter[str]()
        for n, scan in enumerate(self.refs):
            name = str(scan.time) if scan.time else f"{n:06d}"
            if len(self.topics) > 1:
                name = f"{scan.topic.strip('/').replace('/', '_')}_{name}"
            used[name] += 1
            if used[name] > 1:
                name = f"{name}-{used[name]}"
            T = poses[n] if np.isfinite(poses[n]).all() else None
            drive = f"{self.name} part {scan.part + 1}" if self.transforms.clock.is_cut else self.name
            refs.append(FrameRef(name, drive, None if np.isnan(scan.stamp) else scan.stamp, T))
        return tuple(refs)


def _chosen(log: LogReader, wanted: list[str]) -> tuple[str, ...]:
    """Return the topics to read scans of."""
    path, types = log.paths[0], ", ".join(SCAN_TYPES)
    named = {name: f"{name} ({facts.type})" for name, facts in log.topics.items()}
    scans = scan_topics(log)
    listed = ", ".join(named[name] for name in scans) or "none"
    for name in wanted:
        if name not in log.topics:
            other = ", ".join(log.topics) or "none"
            raise OgmError(f"{path} has no topic {name}; topics with scans are {listed}, all topics are {other}")
        if name not in scans:
            found = f"{log.topics[name].count} messages of {log.topics[name].type}"
            if encoding := image_encoding(log, name):
                found += f" with the encoding {encoding}"
            wanted_types = f"wanted scans ({types}); topics with scans are {listed}{_decoded(log, [name])}"
            raise OgmError(f"topic {name} of {path} has {found}, {wanted_types}")
    if not scans:
        way = _decoded(log, log.topics)
        read = "" if way else f" ({types})"
        damage = f"; {log.warnings[0]}" if log.warnings else ""
        raise OgmError(f"{path} has no scans{read}; its topics are {', '.join(named.values()) or 'none'}{way}{damage}")
    kinds = ([name for name in scans if log.topics[name].type in types] for types in _BY_DEFAULT)
    usual = next(kind for kind in kinds if kind)
    if not wanted and len(usual) > 1:
        raise OgmError(f"{path} has several topics with scans, {listed}: choose one by `topic`")
    return tuple(dict.fromkeys(wanted or usual))


def scan_topics(log: LogReader) -> list[str]:
    """Return the topics of a log with scans; image topics count only with depth images."""
    there = [name for name, facts in log.topics.items() if facts.type in SCAN_TYPES and facts.count]
    return [name for name in there if image_encoding(log, name).partition(";")[0] in ("", *DEPTH_ENCODINGS)]


def image_encoding(log: LogReader, topic: str) -> str:
    """Return the encoding or format of the first readable image of a topic; "" for other topics."""
    if log.topics[topic].type not in IMAGE_TYPES:
        return ""
    name = "encoding" if log.topics[topic].type == _IMAGE else "format"
    texts = (getattr(message, name, "") for message in _messages(log, topic))
    return next((str(text) for text in texts if text), "unknown")


def camera_of(log: LogReader, topic: str) -> Intrinsics:
    """Return the camera of a topic with depth images, from the nearest or only topic with CameraInfo.

    Raises
    ------
    OgmError
        If there is no such topic, or it has no message of a calibrated camera.
    """
    path, image = log.paths[0], topic.removesuffix("/compressedDepth").removesuffix("/compressed")
    folder = image.rpartition("/")[0]
    infos = [name for name, facts in log.topics.items() if facts.type == CAMERA and facts.count]
    beside = [name for name in infos if name in (f"{folder}/camera_info", f"{image}/camera_info")]
    found, reason = dict[str, Intrinsics](), ""
    for name in beside or infos:
        for message in _messages(log, name):
            try:
                found[name] = intrinsics_from_camera_info(message, rectified="rect" in image.rpartition("/")[2])
                break
            except OgmError as error:
                reason = f" ({error})"
    if len(found) != 1:
        listed = ", ".join(found or infos) or "none"
        raise OgmError(
            f"{path}: the camera of {topic} is not known{reason}; wanted {CAMERA} on {folder}/camera_info, or on one "
            f"other topic, got {listed}: record it with the images"
        )
    return next(iter(found.values()))


def _messages(log: LogReader, topic: str) -> Iterator[Any]:
    """Yield the messages of a topic that can be decoded."""
    for ref in log.iter_refs([topic]):
        with suppress(OgmError):
            yield log.message(ref).decode()


def _decoded(log: LogReader, names: Iterable[str]) -> str:
    """Return the messages to record instead of radar, packet or colour image topics; "" for other topics."""
    types = {name: kind for name in names if (kind := log.topics[name].type) not in SCAN_TYPES}
    if radars := [name for name, kind in types.items() if _RADAR.search(f"{name} {kind}")]:
        wanted = f"{', '.join(RADAR_TYPES)}, or {CLOUD} with the field doppler (docs/radar.md)"
        return f". {', '.join(radars)}: radars are mapped by {wanted}; record what their driver decodes"
    if packets := [name for name, kind in types.items() if kind in PACKET_TYPES]:
        return f". {', '.join(packets)}: packets are not decoded; record the {CLOUD} of their driver"
    if coloured := [name for name in names if image_encoding(log, name)]:
        return f". {', '.join(coloured)}: only depth images are scans ({', '.join(DEPTH_ENCODINGS)})"
    return ""
