"""A data set's scans and mounts, read on demand; the last scans are kept."""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.layout import Footprint, Layout, RawFrame, SensorPlace
from ogm.io import estimate_sensor_height
from ogm.io.sensor_height import plausible_sensor_height
from ogm.pose import pose
from ogm.scan import Boxes, Mount, Scan
from ogm.storage.files import OgmError

__all__ = ["FrameReader"]

_HEIGHTS = 5  # scans of a sequence whose median is its sensor's height
_KEPT = 64  # scans in memory: some 2 MB each
_UNREADABLE = (ValueError, TypeError, OSError)


class FrameReader:
    """What reads the frames of a layout.

    Parameters
    ----------
    layout : Layout
    path : Path
        For messages.
    sensor_height : float, optional
    sensor_position : (x, y, z), optional
    """

    layout: Layout
    path: Path
    sensor_position: tuple[float, float, float] | None

    def __init__(
        self,
        layout: Layout,
        path: Path,
        sensor_height: float | None = None,
        sensor_position: tuple[float, float, float] | None = None,
    ) -> None:
        self.layout, self.path = layout, path
        self._given_height, self.sensor_position = sensor_height, sensor_position
        if layout.mount is not None and sensor_height is not None:
            raise ValueError(f"{path} states its sensor's height; leave out sensor_height (--sensor-height)")
        if sensor_position is not None and (layout.mount is not None or layout.known_axes):
            raise ValueError(
                f"the points of {path} ({layout.format}) are in the sensor's frame; leave out sensor_position"
            )
        self.groups: dict[str, list[int]] = {}  # frames whose sensor has one height
        for n, frame in enumerate(layout.frames):
            self.groups.setdefault(frame.sequence or frame.name, []).append(n)
        self.raw: Callable[[int], RawFrame] = lru_cache(_KEPT)(self._read)
        self._height = lru_cache(None)(self._find_height)

    def scan(self, n: int) -> Scan:
        """Return a scan, without the returns from the ego vehicle where the layout knows its footprint."""
        return self.raw(n).scan

    def boxes(self, n: int) -> Boxes | None:
        """Return the boxes around a scan, in the sensor's frame."""
        return None if self.layout.boxes is None else self.layout.boxes(n)

    def mount(self, n: int) -> Mount:
        """Return how the sensor of a scan is mounted, above the ground below it."""
        if self.layout.mount is not None:
            return self.layout.mount(n)
        height, position, place = self.height(n), self.sensor_position, self._place(n)
        if position is not None:
            return Mount(height, pose(*position), points_in="vehicle")
        x, y = place.origin
        return Mount(height, pose(x, y, height, yaw=place.yaw), place.ego_footprint)  # type: ignore[arg-type]

    def height(self, n: int) -> float:
        """Return the height of the sensor above ground [m]."""
        frame, place = self.layout.frames[n], self._place(n)
        if self._given_height is not None:
            return self._given_height + place.above_first
        return self._height(frame.sequence or frame.name, place.name) if place.height is None else place.height

    def _place(self, n: int) -> SensorPlace:
        return SensorPlace() if self.layout.place is None else self.layout.place(n)

    def _find_height(self, group: str, sensor: str) -> float:
        """Return the median over some scans: the vehicle stays the same."""
        layout = self.layout
        members = [k for k in self.groups[group] if self._place(k).name == sensor]
        heights, failed = [], ""
        for k in np.unique(np.round(np.linspace(0, len(members) - 1, _HEIGHTS)).astype(int)):
            n, known = members[k], layout.sensor_height
            try:
                height = known(n) if known else estimate_sensor_height(layout.read(n).scan.points)
            except _UNREADABLE as error:
                failed = f" ({error})"
                continue
            if height is not None:
                heights.append(height)
        if not heights:
            raise OgmError(
                f"no scan of {group} in {self.path} shows the ground around the sensor, or none can be read{failed}, "
                "so its height is not known: give sensor_height [m] (--sensor-height)"
            )
        height = float(np.median(heights)) + (self.sensor_position or (0, 0, 0))[2]
        return plausible_sensor_height(height, f"{group} in {self.path}")

    def _read(self, n: int) -> RawFrame:
        """Read a scan without the ego vehicle."""
        raw, box = self.layout.read(n), self.layout.ego_footprint
        if box is None:
            return raw
        kept, every = outside(box, raw.scan.points), raw.all_points
        kinds = None if raw.kinds is None else raw.kinds[kept]
        moving = None if raw.moving is None else raw.moving[kept]
        return RawFrame(raw.scan.select(kept), kinds, moving, None if every is None else every[outside(box, every)])


def outside(box: Footprint, points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which points lie outside of a footprint, (N,)."""
    x, y = points[:, 0], points[:, 1]
    return (x < box[0]) | (x > box[1]) | (y < box[2]) | (y > box[3])
