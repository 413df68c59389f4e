"""Sensor poses of a log in a fixed frame, from its transforms or odometry."""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.clocks import ClockFinding, DriveClock, clock_offset, coarse_stamps
from ogm.datasets.log_frames import FIXED, sensor_frame, unnamed_frame
from ogm.io.depth import T_OPTICAL_BODY
from ogm.io.logs import LogReader
from ogm.io.logs.reader import MessageHead, MessageRef
from ogm.io.messages import StampedTransform, transform_from_odometry, transforms_from_tf
from ogm.io.notices import one_notice_per_kind
from ogm.io.transforms import ExtrapolationError, TransformBuffer, TransformError, frame_name
from ogm.pose import inverse
from ogm.storage.files import OgmError

_TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_ODOMETRY = "nav_msgs/msg/Odometry"
_MIN_MOVING_POSES = 3  # number of different poses from which a static transform counts as moving
_ROUNDING = 1e-6  # [m] and elements of a rotation matrix: smaller changes are rounding
_MIN_UP = math.cos(math.radians(60))  # a z axis at most 60 degrees from up points up
_VEHICLE, _FOOTPRINT = "base_link", "base_footprint"  # never fixed frames, though ROS 1 sends their mounts repeatedly


class LogTransforms:
    """Transforms and odometry of a log.

    All transforms are read at the start, because they may be recorded after the scans that need them. Odometry is read
    only if transforms do not lead from a fixed frame to a sensor.

    Parameters
    ----------
    log : LogReader
    scans : iterable of str
        Topics of scans. Their headers are read in the same pass, so a packed log is unpacked once.

    Attributes
    ----------
    buffer : TransformBuffer
        Transforms with stamps on the time line of `clock`.
    source : str
        Source of the poses, in words.
    heads : list of (MessageRef, MessageHead)
        Headers of the scans.
    clock : DriveClock
        Parts of the drive and their time line.
    lost : list of str
        Error texts of unreadable messages.
    notes : list of str
        Unusual properties of transforms that were repaired.
    """

    def __init__(self, log: LogReader, scans: Iterable[str] = ()) -> None:
        self.buffer, self.source = TransformBuffer(), "transforms"
        self._recorded: dict[tuple[str, str], list[tuple[float, float]]] = {}  # stamps and log times [s]
        self._log = log
        self._odometry = sorted(self._of_type(_ODOMETRY), key=lambda name: -log.topics[name].count)
        self.heads: list[tuple[MessageRef, MessageHead]] = []
        self.lost: list[str] = []
        self.notes: list[str] = []
        self.cameras: dict[str, str] = {}  # frame of each camera body -> note on the frame of its images, or ""
        known = {name: name.rstrip("/").endswith("tf_static") for name in self._of_type(*_TRANSFORMS)}
        found: list[tuple[str, int, StampedTransform]] = []
        with one_notice_per_kind(Counter()):
            for ref in log.iter_refs([*scans, *known]):
                try:
                    topic = log.topic_of(ref)
                    if topic in known:
                        several = transforms_from_tf(log.message(ref).decode())
                        found += [(topic, ref.log_time, transform) for transform in several]
                    else:
                        self.heads.append((ref, log.head(ref)))
                except OgmError as error:
                    self.lost.append(str(error))
        self.clock = DriveClock(
            [log.topic_of(ref) for ref, _ in self.heads],
            np.array([ref.log_time * 1e-9 for ref, _ in self.heads]),
            np.array([head.stamp if head.time else np.nan for _, head in self.heads]),
        )
        self._add(found, [name for name, static in known.items() if static])
        self._hold_mounts()

    def fixed_frame(self, sensor: str, wanted: str | None = None, preferred: str | None = None) -> str | None:
        """Return the fixed frame of the poses of a sensor, or None if there is none.

        Parameters
        ----------
        sensor : str
            Frame of the sensor.
        wanted : str, optional
            Fixed frame. By default the first of map, odom, world and the root of the transforms that leads to the
            sensor over a changing transform.
        preferred : str, optional
            Fixed frame of another sensor, which this sensor must share.

        Raises
        ------
        OgmError
            If the wanted frame does not exist, or no transforms join it with the sensor.
        """
        if wanted is not None:
            return self._wanted(sensor, frame_name(wanted))
        if preferred is not None:
            return self._joined([preferred], sensor)
        while True:
            candidates = [frame for name in FIXED for frame in self._named(name)]
            vehicle = self._named(_VEHICLE) + self._named(_FOOTPRINT)
            for frame in [*candidates, self._root(sensor)]:
                if frame not in vehicle and self._is_moving(frame, sensor):
                    return frame
            if not self._read_odometry():
                return None

    def camera_body(self, frame: str) -> str:
        """Add the body frame of a depth camera (x forward, y left, z up) and return its name.

        Images are in optical axes (x right, y down, z forward), see REP 103. A frame without "optical" in its name and
        with its z axis up in base_link is taken for the body.

        Parameters
        ----------
        frame : str
            Frame in the headers of the camera's images.
        """
        if (body := f"{frame}_body") in self.cameras:
            return body
        optical, note = "optical" in frame.lower(), ""
        T = T_OPTICAL_BODY
        vehicle = self.vehicle_frame(frame)
        if vehicle is not None:
            first = self.buffer.covers(vehicle, frame)[0]
            up = float(self.buffer.lookup(vehicle, frame, first if math.isfinite(first) else 0.0)[2, 2])
            if up > _MIN_UP and not optical:
                T, note = np.eye(4), "whose z axis points up: it is taken for the camera body, x forward"
            elif up > _MIN_UP:
                note = "whose z axis points up: the camera would look up; the rotation to optical axes (x right, "
                note += "y down, z forward) may be missing in the transforms"
        elif not optical:
            note = "taken for optical axes (x right, y down, z forward), as no transform states them"
        if frame in self.buffer.frames:
            self.buffer.add(StampedTransform(frame, body, 0.0, T), static=True)
        self.cameras[body] = note
        return body

    def sensor_frame(self, frame: str) -> str:
        """Return the frame of the sensor for clouds in a frame, see `ogm.datasets.log_frames`."""
        return sensor_frame(self.buffer, frame, self._named(_VEHICLE) + self._named(_FOOTPRINT))

    def mount(self, sensor: str, T_vehicle_sensor: NDArray[np.float64]) -> None:  # noqa: N803
        """Add the pose of a sensor in base_link, which overrides other transforms."""
        vehicle = self._named(_VEHICLE)
        name = vehicle[0] if vehicle else _VEHICLE
        if sensor in self._parents() and (name, sensor) not in self.buffer.pairs:  # each frame has one parent
            self.buffer.add(StampedTransform(sensor, name, 0.0, inverse(T_vehicle_sensor)), static=True)
        else:
            self.buffer.add(StampedTransform(name, sensor, 0.0, T_vehicle_sensor), static=True)

    def vehicle_frame(self, sensor: str) -> str | None:
        """Return base_link, also in a namespace, if transforms join it with a sensor; else None."""
        return self._joined(self._named(_VEHICLE), sensor)

    def floor_frame(self, sensor: str) -> str | None:
        """Return base_footprint, which is on the ground, if transforms join it with a sensor; else None."""
        return self._joined(self._named(_FOOTPRINT), sensor)

    def lookup(
        self, target: str, source: str, stamps: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], dict[int, str]]:
        """Return the transform between two frames at given stamps.

        Parameters
        ----------
        target, source : str
            Names of frames.
        stamps : (K,) float
            Stamps on the time line [s].

        Returns
        -------
        T_target_source : (K, 4, 4) float64
            NaN if unknown.
        reasons : dict of int to str
            Reason of each unknown transform, by the index of the stamp.
        """
        T, reasons = np.full((len(stamps), 4, 4), np.nan), {}
        first, last = self.buffer.covers(target, source)
        inside = (stamps >= first) & (stamps <= last)
        try:
            T[inside] = self.buffer.lookup(target, source, stamps[inside])
        except ExtrapolationError:  # a gap in the transforms
            inside[:] = False
        for k in np.flatnonzero(~inside):
            try:
                T[k] = self.buffer.lookup(target, source, stamps[k])
            except ExtrapolationError as error:
                reasons[int(k)] = str(error)
        return T, reasons

    def recorded(self, target: str, source: str, stamps: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the log times at which the transforms between two frames were available.

        Parameters
        ----------
        target, source : str
            Names of frames.
        stamps : (K,) float
            Stamps on the time line [s].

        Returns
        -------
        (K,) float64
            Log times [s]; NaN if no transform is as late as the stamp.
        """
        latest = np.full(len(stamps), -np.inf)
        for pair in pairwise(self.buffer.chain(target, source)):
            rows = self._recorded.get(pair) or self._recorded.get(pair[::-1])
            if rows is None:  # a mount given by the user
                continue
            known, times = np.array(sorted(rows)).T
            first = np.append(np.minimum.accumulate(times[::-1])[::-1], np.nan)
            latest = np.maximum(latest, first[np.searchsorted(known, stamps)])
        return latest

    def clock_findings(
        self, target: str, source: str, topic: str, log_times: NDArray[np.float64], stamps: NDArray[np.float64]
    ) -> list[ClockFinding]:
        """Return the clock faults of the transforms between two frames, relative to the clock of scans.

        Parameters
        ----------
        target, source : str
            Names of frames.
        topic : str
            Topic of the scans.
        log_times, stamps : (K,) float64
            Log times and stamps of the scans [s].
        """
        found = []
        for parent, child in pairwise(self.buffer.chain(target, source)):
            rows = self._recorded.get((parent, child)) or self._recorded.get((child, parent)) or []
            times, known = np.array([(time, stamp) for stamp, time in rows if math.isfinite(stamp)]).reshape(-1, 2).T
            where = f"{child} in {parent}"
            coarse = coarse_stamps(where, "transforms", times, known)
            found += coarse or clock_offset(topic, log_times, stamps, f"transforms of {where}", times, known)
        return found

    def note_parents(self, target: str, source: str) -> None:
        """Add a note for each frame with several parents between two frames."""
        for frame in self.buffer.chain(target, source):
            if len(parents := [parent for parent, child in self.buffer.pairs if child == frame]) > 1:
                chain = " <- ".join(self.buffer.chain(target, source))
                self.notes.append(f"{frame} has the parents {', '.join(parents)}: the shortest chain is used, {chain}")

    def missing(self, sensor: str, topic: str) -> str:
        """Return a description of the transforms that are missing for poses of a sensor."""
        if not (frames := ", ".join(self.buffer.frames)):
            read = " that can be read" * bool(self.lost)
            return f"the log has no transforms (/tf, /tf_static){read} and no odometry"
        if sensor not in self.buffer.frames:
            unnamed = sensor == unnamed_frame(topic)
            subject = f"the scans of {topic} name no" if unnamed else f"no transform leads to {sensor}, the"
            way = f"; `setups` with its mount joins it with {_VEHICLE}" * bool(self._named(_VEHICLE))
            of_topic = "" if unnamed else f" of {topic}"
            return f"{subject} frame{of_topic}; there are {frames}{way}"
        root = self._root(sensor)
        fixed = [frame for name in FIXED for frame in self._named(name)]
        if root == sensor or not self._joined([root], sensor):
            return f"no transform leads from another frame to {sensor}, the frame of {topic}; there are {frames}"
        if root in fixed:
            return f"all transforms from {root} to {sensor} are static: for a static sensor, give `frame` {root}"
        lacking = f"from {' or '.join(fixed) if fixed else 'a fixed frame (map, odom, world)'} to {root}"
        return f"transforms lead from {root} to {sensor}, the frame of {topic}; one {lacking} is missing"

    def missing_vehicle(self, sensors: Iterable[str]) -> str:
        """Return a description of the sensors without transforms to base_link."""
        lone = [sensor for sensor in sensors if self.vehicle_frame(sensor) is None]
        return f"no transform leads from {_VEHICLE} to {', '.join(lone)}"

    def _wanted(self, sensor: str, frame: str) -> str:
        while True:
            try:
                self.buffer.covers(frame, sensor)
                return frame
            except TransformError as error:
                if not self._read_odometry():
                    raise OgmError(f"`frame` {frame} cannot be used: {error}") from error

    def _is_moving(self, frame: str, sensor: str) -> bool:
        """Return whether transforms join two frames and at least one of them is not static."""
        return self._joined([frame], sensor) is not None and math.isfinite(self.buffer.covers(frame, sensor)[0])

    def _joined(self, frames: Iterable[str], sensor: str) -> str | None:
        """Return the first frame that transforms join with a sensor, or None."""
        for frame in frames:
            try:
                self.buffer.covers(frame, sensor)
            except TransformError:
                continue
            return frame
        return None

    def _named(self, name: str) -> list[str]:
        """Return the frames of a name, also in namespaces (robot1/base_link)."""
        return [frame for frame in self.buffer.frames if frame == name or frame.endswith(f"/{name}")]

    def _parents(self) -> dict[str, str]:
        return {child: parent for parent, child in self.buffer.pairs}

    def _root(self, sensor: str) -> str:
        """Return the topmost frame above a sensor."""
        parents, frame, passed = self._parents(), sensor, {sensor}
        while frame in parents and parents[frame] not in passed:
            frame = parents[frame]
            passed.add(frame)
        return frame

    def _read_odometry(self) -> bool:
        """Add the poses of the next odometry topic; return False if there is none left."""
        if not self._odometry:
            return False
        name = self._odometry.pop(0)
        self.source = f"odometry ({name})"
        poses: list[tuple[str, int, StampedTransform]] = []
        for ref in self._log.iter_refs([name]):
            try:
                found = transform_from_odometry(self._log.message(ref).decode())
            except OgmError as error:
                self.lost.append(str(error))
                continue
            poses.append((name, ref.log_time, found if found.child else found._replace(child=_VEHICLE)))
        self._add(poses)
        return True

    def _of_type(self, *types: str) -> list[str]:
        """Return the topics of the given types."""
        return [name for name, facts in self._log.topics.items() if facts.type in types]

    def _add(self, transforms: Sequence[tuple[str, int, StampedTransform]], static: Iterable[str] = ()) -> None:
        """Add transforms, given with topics and log times [ns]; damaged transforms are left out."""
        topics = np.array([name for name, _, _ in transforms])
        times, stamps = np.array([(1e-9 * time, transform.stamp) for _, time, transform in transforms]).reshape(-1, 2).T
        for name in {*topics} - {*static}:
            stamps[topics == name] = self.clock.on_line(times[topics == name], stamps[topics == name])
        moving = self._moving([transform for name, _, transform in transforms if name in static])
        for (name, _, transform), time, stamp in zip(transforms, times.tolist(), stamps.tolist(), strict=True):
            pair = transform.parent, transform.child
            holds = name in static and pair not in moving
            try:
                self.buffer.add(transform._replace(stamp=stamp), holds)
            except OgmError as error:
                self.lost.append(str(error))
                continue
            self._recorded.setdefault(pair, []).append((math.inf if holds else stamp, time))

    def _moving(self, transforms: Iterable[StampedTransform]) -> set[tuple[str, str]]:
        """Return the pairs of frames with three or more different static transforms, which count as moving."""
        poses: dict[tuple[str, str], list[StampedTransform]] = {}
        for transform in transforms:
            known = poses.setdefault((transform.parent, transform.child), [])
            same = (np.allclose(transform.T_parent_child, other.T_parent_child, atol=1e-3) for other in known)
            if len(known) < _MIN_MOVING_POSES and not any(same):
                known.append(transform)
        moving = set()
        for (parent, child), known in poses.items():
            text = f"there are different static transforms from {child} to {parent}"
            if len(known) == _MIN_MOVING_POSES == len({transform.stamp for transform in known}):
                moving.add((parent, child))
                self.notes.append(f"{text}: each is used at its stamp")
            elif len(known) > 1:
                self.notes.append(f"{text}: the last is used")
        return moving

    def _hold_mounts(self) -> None:
        """Make unchanged transforms below changing ones static, as drivers send some mounts only once."""
        parents, vehicle = self._parents(), self._named(_VEHICLE) + self._named(_FOOTPRINT)
        changing = {pair for pair in self.buffer.pairs if self.buffer.changes(*pair, by=_ROUNDING)}
        for (parent, child), static in self.buffer.pairs.items():
            if static or (parent, child) in changing:
                continue
            frame, passed = parent, {child}
            while frame in parents and frame not in passed and (parents[frame], frame) not in changing:
                passed.add(frame)
                frame = parents[frame]
            if parent not in vehicle and (frame not in parents or frame in passed):
                continue
            first = self.buffer.covers(parent, child)[0]
            stamps = np.sort([stamp for stamp, _ in self._recorded[parent, child]])
            self.buffer.add(StampedTransform(parent, child, 0.0, self.buffer.lookup(parent, child, first)), static=True)
            if len(stamps) == 1 or np.diff(stamps).max() > self.buffer.max_gap:
                times = f"{len(stamps)} times" if len(stamps) > 1 else "once"
                self.notes.append(f"the transform from {child} to {parent} comes {times}, unchanged: used at all times")
