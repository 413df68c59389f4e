"""Motion of the labelled objects of a recording, and of the cells under them."""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.frames import EGO
from ogm.datasets.recording import Recording
from ogm.grid import GridSpec
from ogm.pose import inverse
from ogm.scan import Boxes
from ogm.state import Motion
from ogm.truth import motion_of_boxes
from ogm.truth.boxes import cells_in_footprint
from ogm.truth.motion import NEEDED, REACH, BoxMotion, track_motion

__all__ = ["MotionReader"]

_NEXT = 0.15  # [s] the frames before and after at 10 Hz
_KEPT = 16  # frames in memory: a few kB each


class MotionReader:
    """Finds the motion of objects in the frames of a recording. Pickled, it goes without the motion that it found.

    Velocities are stated by the dataset, and yaw rates follow from the frames before and after; or else both are
    slopes of the objects' tracks over 0.5 to 0.7 s (`ogm.truth.track_motion`): the first and the last 0.3 s of a track
    have none.

    Parameters
    ----------
    recording : Recording
    """

    recording: Recording

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self._placed = lru_cache(_KEPT)(self._on_map)
        self._found = lru_cache(_KEPT)(self._find)
        self._members = lru_cache(None)(self._of_sequence)

    def __reduce__(self) -> tuple[Any, ...]:
        return MotionReader, (self.recording,)

    def boxes(self, n: int) -> Boxes | None:
        """Return the boxes around a scan, in the sensor's frame, with velocities where there are any."""
        boxes = self.recording.boxes(n)
        if boxes is None or boxes.velocity is not None:
            return boxes
        found = self._found(n)
        return boxes if found is None else replace(boxes, velocity=found.velocity)

    def cells(self, n: int, spec: GridSpec) -> Motion | None:
        """Return the motion of the cells around a scan; None where that of objects cannot be known.

        Nothing is known of cells under the ego vehicle, and outside the view in which objects are labelled.
        """
        boxes, found = self.boxes(n), self._found(n)
        if boxes is None or found is None:
            return None
        unknown = cells_in_footprint(self.recording.ego_footprint or EGO, spec)
        if self.recording.view_angle is not None:
            x, y = spec.cell_centers
            unknown |= np.abs(y) > np.tan(self.recording.view_angle) * x
        return motion_of_boxes(boxes, found.yaw_rate, spec, unknown=unknown)

    def _find(self, n: int) -> BoxMotion | None:
        """Return the motion of a scan's boxes in the sensor's frame, None where no tracks can be followed."""
        frame, boxes = self.recording.frames[n], self.recording.boxes(n)
        if boxes is None or frame.stamp is None or frame.T_map_sensor is None or not frame.sequence:
            return None
        stated = boxes.velocity is not None
        reach, needed = (_NEXT, 0.0) if stated else (REACH, NEEDED)
        members, stamps = self._members(frame.sequence)
        near = np.abs(stamps - frame.stamp) < 1.1 * reach
        around = members[near].tolist()
        placed = [self._placed(k) for k in around]
        found = track_motion(around.index(n), stamps[near].tolist(), placed, reach=reach, needed=needed)
        if boxes.velocity is not None:
            return BoxMotion(boxes.velocity, found.yaw_rate)
        return BoxMotion(found.velocity @ inverse(frame.T_map_sensor)[:2, :2].T, found.yaw_rate)

    def _of_sequence(self, sequence: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the frames of a sequence that have a pose and a stamp: their numbers and their stamps."""
        refs = [(k, self.recording.frames[k]) for k in self.recording.groups[sequence]]
        known = [(k, ref.stamp) for k, ref in refs if ref.T_map_sensor is not None and ref.stamp is not None]
        return np.array([k for k, _ in known], np.int64), np.array([stamp for _, stamp in known], np.float64)

    def _on_map(self, n: int) -> Boxes:
        """Return the boxes of a scan in the map's frame."""
        return self.recording.read_boxes(n).moved(np.asarray(self.recording.frames[n].T_map_sensor))
