"""Where the sensors of a log were: its transforms, or its odometry, from a fixed frame to the frames of the scans."""

import logging
import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.files import OgmError
from ogm.io.logs import LogReader
from ogm.io.messages import StampedTransform, transform_from_odometry, transforms_from_tf
from ogm.io.transforms import ExtrapolationError, TransformBuffer, TransformError

__all__ = ["LogTransforms"]

_log = logging.getLogger(__name__)

_TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_ODOMETRY = "nav_msgs/msg/Odometry"
_FIXED = ("map", "odom", "world")  # the first that a chain of transforms joins with the sensor, one of which changes
_VEHICLE = "base_link"


class LogTransforms:
    """The transforms of a log, all of which are read first: one may be recorded after the scan that needs it.

    Odometry is read where transforms alone do not lead from a fixed frame to a sensor.

    Parameters
    ----------
    log : LogReader

    Attributes
    ----------
    buffer : TransformBuffer
    source : str
        Where poses come from, in words.
    """

    def __init__(self, log: LogReader) -> None:
        self.buffer, self.source = TransformBuffer(), "transforms"
        self._log = log
        self._odometry = [name for name, facts in log.topics.items() if facts.type == _ODOMETRY and facts.count]
        self._odometry.sort(key=lambda name: -log.topics[name].count)
        for name in [name for name, facts in log.topics.items() if facts.type in _TRANSFORMS]:
            self._read(name, transforms_from_tf, static=name.rstrip("/").endswith("tf_static"))

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
            return self._wanted(sensor, wanted.lstrip("/"))
        if preferred is not None:
            return self._joined([preferred], sensor)
        while True:
            candidates = [frame for name in _FIXED for frame in self._named(name)]
            for frame in [*candidates, self._root(sensor)]:
                if self._is_moving(frame, sensor):
                    return frame
            if not self._read_odometry():
                return None

    def vehicle_frame(self, sensor: str) -> str | None:
        """Return the frame base_link, or that of a namespace, where transforms join it with a sensor."""
        return self._joined(self._named(_VEHICLE), sensor)

    def floor_frame(self, sensor: str) -> str | None:
        """Return the frame base_footprint, on the ground, where transforms join it with a sensor."""
        return self._joined(self._named("base_footprint"), sensor)

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

    def missing(self, sensor: str, topic: str) -> str:
        """Return which transforms lack for poses of a sensor, in words."""
        frames = ", ".join(self.buffer.frames)
        if not frames:
            return "the log has no transforms (/tf, /tf_static) and no odometry"
        if sensor not in self.buffer.frames:
            return f"no transform leads to {sensor or 'a frame without name'}, the frame of {topic}; there are {frames}"
        root = self._root(sensor)
        fixed = [frame for name in _FIXED for frame in self._named(name)]
        if root == sensor or not self._joined([root], sensor):
            return f"no transform leads from another frame to {sensor}, the frame of {topic}; there are {frames}"
        lacking = f"from {' or '.join(fixed) if fixed else 'a fixed frame (map, odom, world)'} to {root}"
        return f"the transforms from {root} to {sensor}, the frame of {topic}, are static; one {lacking} is missing"

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
                    raise OgmError(f"frame (--frame) {frame} has no use: {error}") from error

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
        self._read(name, _odometry_transforms)
        return True

    def _read(self, topic: str, convert: Callable[[Any], list[StampedTransform]], static: bool = False) -> None:
        """Add the transforms of a topic."""
        lost: list[str] = []
        for message in self._log.messages([topic]):
            try:
                for transform in convert(message.decode()):
                    self.buffer.add(transform, static)
            except OgmError as error:
                lost.append(str(error))
        if lost:
            _log.warning("%s: %d messages of %s are left out: %s", self._log.paths[0], len(lost), topic, lost[0])


def _odometry_transforms(message: Any) -> list[StampedTransform]:
    found = transform_from_odometry(message)
    return [found if found.child else found._replace(child=_VEHICLE)]
