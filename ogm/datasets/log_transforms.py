"""Where the sensors of a log were: its transforms, or its odometry, from a fixed frame to the frames of the scans."""

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
_SEVERAL = 3  # different poses of a static transform, from which on it moves
_SAME = 1e-6  # [m], and of the numbers of a rotation: rounding
_UPRIGHT = math.cos(math.radians(60))  # of the angle between a frame's z axis and up, below which z is up
_VEHICLE, _FLOOR = "base_link", "base_footprint"  # never fixed, though ROS 1 sends their mounts as if they moved


class LogTransforms:
    """The transforms of a log, all of which are read first: one may be recorded after the scan that needs it.

    Odometry is read where transforms alone do not lead from a fixed frame to a sensor.

    Parameters
    ----------
    log : LogReader
    scans : iterable of str
        Topics whose headers are read on the way, for a packed log is then unpacked once.

    Attributes
    ----------
    buffer : TransformBuffer
    source : str
        Where poses come from, in words.
    heads : list of (MessageRef, MessageHead)
        Of the scans.
    clock : DriveClock
        Parts of the drive. Stamps of the buffer are those of its time line.
    lost : list of str
        Why messages could not be read.
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
        self.cameras: dict[str, str] = {}  # frames of the bodies of cameras, and what is unusual about those of images
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
        """Return the frame that poses of a sensor are given in; None if there is none.

        Parameters
        ----------
        sensor : str
            Its frame.
        wanted : str, optional
            By default map, odom, world, or the root of the transforms: the first that leads to the sensor over a
            transform that is not static.
        preferred : str, optional
            That of another sensor: then this one, or none.

        Raises
        ------
        OgmError
            If the wanted frame is not there, or no transforms join it with the sensor.
        """
        if wanted is not None:
            return self._wanted(sensor, frame_name(wanted))
        if preferred is not None:
            return self._joined([preferred], sensor)
        while True:
            candidates = [frame for name in FIXED for frame in self._named(name)]
            vehicle = self._named(_VEHICLE) + self._named(_FLOOR)
            for frame in [*candidates, self._root(sensor)]:
                if frame not in vehicle and self._is_moving(frame, sensor):
                    return frame
            if not self._read_odometry():
                return None

    def camera_body(self, frame: str) -> str:
        """Add the body of a depth camera (x forward, y left, z up) to the frame of its images; return its frame.

        Images are in optical axes (x right, y down, z forward) by REP 103, unless the frame is not called optical, and
        its z axis points up in base_link: then it is taken for the body.

        Parameters
        ----------
        frame : str
            Frame of the headers of its images.
        """
        if (body := f"{frame}_body") in self.cameras:
            return body
        optical, note = "optical" in frame.lower(), ""
        T = T_OPTICAL_BODY
        vehicle = self.vehicle_frame(frame)
        if vehicle is not None:
            first = self.buffer.covers(vehicle, frame)[0]
            up = float(self.buffer.lookup(vehicle, frame, first if math.isfinite(first) else 0.0)[2, 2])
            if up > _UPRIGHT and not optical:
                T, note = np.eye(4), "whose z axis points up: they are taken for those of a body, x forward"
            elif up > _UPRIGHT:
                note = "by whose transforms the camera looks up: was the rotation to optical axes (x right, y down, z "
                note += "forward) left out?"
        elif not optical:
            note = "taken for optical axes (x right, y down, z forward), as no transform tells"
        if frame in self.buffer.frames:
            self.buffer.add(StampedTransform(frame, body, 0.0, T), static=True)
        self.cameras[body] = note
        return body

    def sensor_frame(self, frame: str) -> str:
        """Return the frame of the sensor that measured clouds in a frame, see `ogm.datasets.log_frames`."""
        return sensor_frame(self.buffer, frame, self._named(_VEHICLE) + self._named(_FLOOR))

    def mount(self, sensor: str, T_vehicle_sensor: NDArray[np.float64]) -> None:  # noqa: N803
        """Add the pose of a sensor in base_link, which counts instead of that of other transforms."""
        vehicle = self._named(_VEHICLE)
        name = vehicle[0] if vehicle else _VEHICLE
        if sensor in self._parents() and (name, sensor) not in self.buffer.pairs:  # a frame has one parent
            self.buffer.add(StampedTransform(sensor, name, 0.0, inverse(T_vehicle_sensor)), static=True)
        else:
            self.buffer.add(StampedTransform(name, sensor, 0.0, T_vehicle_sensor), static=True)

    def vehicle_frame(self, sensor: str) -> str | None:
        """Return the frame base_link, or that of a namespace, where transforms join it with a sensor."""
        return self._joined(self._named(_VEHICLE), sensor)

    def floor_frame(self, sensor: str) -> str | None:
        """Return the frame base_footprint, on the ground, where transforms join it with a sensor."""
        return self._joined(self._named(_FLOOR), sensor)

    def lookup(
        self, target: str, source: str, stamps: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], dict[int, str]]:
        """Return where a frame was in another at some times.

        Parameters
        ----------
        target, source : str
            Names of frames.
        stamps : (K,) float
            [s].

        Returns
        -------
        T_target_source : (K, 4, 4) float64
            NaN where it is not known.
        reasons : dict of int to str
            Why not, by the number of the stamp.
        """
        T, reasons = np.full((len(stamps), 4, 4), np.nan), {}
        first, last = self.buffer.covers(target, source)
        inside = (stamps >= first) & (stamps <= last)
        try:
            T[inside] = self.buffer.lookup(target, source, stamps[inside])
        except ExtrapolationError:  # there is a gap
            inside[:] = False
        for k in np.flatnonzero(~inside):
            try:
                T[k] = self.buffer.lookup(target, source, stamps[k])
            except ExtrapolationError as error:
                reasons[int(k)] = str(error)
        return T, reasons

    def recorded(self, target: str, source: str, stamps: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return when the transforms between two frames at some times had been recorded.

        Parameters
        ----------
        target, source : str
            Names of frames.
        stamps : (K,) float
            [s]

        Returns
        -------
        (K,) float64
            Log times [s]; NaN where no transform is as late as the stamp.
        """
        latest = np.full(len(stamps), -np.inf)
        for pair in pairwise(self.buffer.chain(target, source)):
            rows = self._recorded.get(pair) or self._recorded.get(pair[::-1])
            if rows is None:  # a mount that is given
                continue
            known, times = np.array(sorted(rows)).T
            first = np.append(np.minimum.accumulate(times[::-1])[::-1], np.nan)
            latest = np.maximum(latest, first[np.searchsorted(known, stamps)])
        return latest

    def clock_findings(
        self, target: str, source: str, topic: str, log_times: NDArray[np.float64], stamps: NDArray[np.float64]
    ) -> list[ClockFinding]:
        """Return the faults of the clock of the transforms between two frames, against that of scans.

        Parameters
        ----------
        target, source : str
            Names of frames.
        topic : str
            Of the scans.
        log_times, stamps : (K,) float64
            Of the scans [s].
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
        """Note frames with several parents on the way from one frame to another."""
        for frame in self.buffer.chain(target, source):
            if len(parents := [parent for parent, child in self.buffer.pairs if child == frame]) > 1:
                way = " <- ".join(self.buffer.chain(target, source))
                self.notes.append(f"{frame} has the parents {', '.join(parents)}: the shortest way counts, {way}")

    def missing(self, sensor: str, topic: str) -> str:
        """Return which transforms lack for poses of a sensor, in words."""
        if not (frames := ", ".join(self.buffer.frames)):
            read = " that can be read" * bool(self.lost)
            return f"the log has no transforms (/tf, /tf_static){read} and no odometry"
        if sensor not in self.buffer.frames:
            unnamed = sensor == unnamed_frame(topic)
            what = f"the scans of {topic} name no" if unnamed else f"no transform leads to {sensor}, the"
            way = f"; `setups` with its mount joins it with {_VEHICLE}" * bool(self._named(_VEHICLE))
            of_topic = "" if unnamed else f" of {topic}"
            return f"{what} frame{of_topic}; there are {frames}{way}"
        root = self._root(sensor)
        fixed = [frame for name in FIXED for frame in self._named(name)]
        if root == sensor or not self._joined([root], sensor):
            return f"no transform leads from another frame to {sensor}, the frame of {topic}; there are {frames}"
        if root in fixed:
            return f"all transforms from {root} to {sensor} are static: if the sensor stands still, give `frame` {root}"
        lacking = f"from {' or '.join(fixed) if fixed else 'a fixed frame (map, odom, world)'} to {root}"
        return f"transforms lead from {root} to {sensor}, the frame of {topic}; one {lacking} is missing"

    def missing_vehicle(self, sensors: Iterable[str]) -> str:
        """Return from which sensors no transform leads to base_link, in words."""
        lone = [sensor for sensor in sensors if self.vehicle_frame(sensor) is None]
        return f"no transform leads from {_VEHICLE} to {', '.join(lone)}"

    def chain(self, target: str, sensor: str) -> str:
        """Return the frames from one to another, in words."""
        frames, parents = [sensor], self._parents()
        while frames[-1] != target and frames[-1] in parents and parents[frames[-1]] not in frames:
            frames.append(parents[frames[-1]])
        return " <- ".join(reversed(frames)) if frames[-1] == target else f"{target} ... {sensor}"

    def _wanted(self, sensor: str, frame: str) -> str:
        while True:
            try:
                self.buffer.covers(frame, sensor)
                return frame
            except TransformError as error:
                if not self._read_odometry():
                    raise OgmError(f"`frame` {frame} has no use: {error}") from error

    def _is_moving(self, frame: str, sensor: str) -> bool:
        """Tell whether transforms join two frames, one of which is not static."""
        return self._joined([frame], sensor) is not None and math.isfinite(self.buffer.covers(frame, sensor)[0])

    def _joined(self, frames: Iterable[str], sensor: str) -> str | None:
        """Return the first of some frames that transforms join with a sensor."""
        for frame in frames:
            try:
                self.buffer.covers(frame, sensor)
            except TransformError:
                continue
            return frame
        return None

    def _named(self, name: str) -> list[str]:
        """Return the frames of a name, also those of a namespace: robot1/base_link."""
        return [frame for frame in self.buffer.frames if frame == name or frame.endswith(f"/{name}")]

    def _parents(self) -> dict[str, str]:
        return {child: parent for parent, child in self.buffer.pairs}

    def _root(self, sensor: str) -> str:
        """Return the frame above all others."""
        parents, frame, passed = self._parents(), sensor, {sensor}
        while frame in parents and parents[frame] not in passed:
            frame = parents[frame]
            passed.add(frame)
        return frame

    def _read_odometry(self) -> bool:
        """Add the poses of the next topic of odometry; return whether there is one."""
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
        """Return the topics of some types."""
        return [name for name, facts in self._log.topics.items() if facts.type in types]

    def _add(self, transforms: Sequence[tuple[str, int, StampedTransform]], static: Iterable[str] = ()) -> None:
        """Add transforms by their topics and log times [ns], except those that are damaged."""
        topics = np.array([name for name, _, _ in transforms])
        times, stamps = np.array([(1e-9 * time, one.stamp) for _, time, one in transforms]).reshape(-1, 2).T
        for name in {*topics} - {*static}:
            stamps[topics == name] = self.clock.on_line(times[topics == name], stamps[topics == name])
        moving = self._moving([one for name, _, one in transforms if name in static])
        for (name, _, one), time, stamp in zip(transforms, times.tolist(), stamps.tolist(), strict=True):
            pair, holds = (one.parent, one.child), name in static and (one.parent, one.child) not in moving
            try:
                self.buffer.add(one._replace(stamp=stamp), holds)
            except OgmError as error:
                self.lost.append(str(error))
                continue
            self._recorded.setdefault(pair, []).append((math.inf if holds else stamp, time))

    def _moving(self, transforms: Iterable[StampedTransform]) -> set[tuple[str, str]]:
        """Return the pairs of frames with three or more different static transforms: these count as those of /tf."""
        poses: dict[tuple[str, str], list[StampedTransform]] = {}
        for one in transforms:
            known = poses.setdefault((one.parent, one.child), [])
            same = (np.allclose(one.T_parent_child, other.T_parent_child, atol=1e-3) for other in known)
            if len(known) < _SEVERAL and not any(same):
                known.append(one)
        moving = set()
        for (parent, child), known in poses.items():
            what = f"different static transforms from {child} to {parent}"
            if len(known) == _SEVERAL == len({one.stamp for one in known}):
                moving.add((parent, child))
                self.notes.append(f"there are {what}: each counts at its stamp")
            elif len(known) > 1:
                self.notes.append(f"there are {what}: the last counts")
        return moving

    def _hold_mounts(self) -> None:
        """Let transforms that never change count at all times, where one above them changes: drivers send some once."""
        parents, vehicle = self._parents(), self._named(_VEHICLE) + self._named(_FLOOR)
        changing = {pair for pair in self.buffer.pairs if self.buffer.changes(*pair, by=_SAME)}
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
                self.notes.append(f"the transform from {child} to {parent} comes {times}, unchanged: it counts always")
