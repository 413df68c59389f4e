"""Parts of the frames of a recording: references, raw scans, HD maps and places of sensors."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.io.labels import LabelledPoints
from ogm.scan import Scan
from ogm.truth import Kind

Footprint = tuple[float, float, float, float]
"""x_min, x_max, y_min, y_max around the sensor [m], as `Mount.ego_footprint`."""

EGO: Footprint = (-2.5, 2.5, -1.1, 1.1)
KITTI_EGO: Footprint = (-2.6, 2.6, -1.7, 1.7)  # with mirrors and other parts that stick out at the sides

# Kinds of points by the class names of all datasets. A class that is not listed is an obstacle.
_KINDS = {"vegetation": Kind.PLANT} | dict.fromkeys(("unlabeled", "outlier", "none"), Kind.OTHER)
_KINDS |= dict.fromkeys(("road", "parking", "sidewalk", "other-ground", "terrain", "lane-marking"), Kind.GROUND)


class FrameRef(NamedTuple):
    """Name, sequence, time and pose of a frame, known before its scan is read."""

    name: str
    sequence: str = ""  # "" for a single frame
    stamp: float | None = None  # [s]
    T_map_sensor: NDArray[np.float64] | None = None  # (4, 4)


class RawFrame(NamedTuple):
    """Scan in the sensor's frame, including returns from the ego vehicle, with a label for each point."""

    scan: Scan
    kinds: NDArray[np.uint8] | None = None  # (N,) `Kind` of each point, from its class
    moving: NDArray[np.bool_] | None = None  # (N,) points of moving objects, from their class
    all_points: NDArray[np.float32] | None = None  # (M, 4) points of all lidars of the vehicle, in this sensor's frame

    def without(self, box: Footprint) -> "RawFrame":
        """Return the frame without the returns inside a footprint."""
        every = None if self.all_points is None else self.all_points[_outside(box, self.all_points)]
        return self.kept(_outside(box, self.scan.points), self.scan.no_returns)._replace(all_points=every)

    def kept(self, rows: NDArray[np.bool_], no_returns: NDArray[np.float32] | None) -> "RawFrame":
        """Return the frame with the selected points and the given beams without echo."""
        kinds = None if self.kinds is None else self.kinds[rows]
        moving = None if self.moving is None else self.moving[rows]
        return RawFrame(replace(self.scan.select(rows), no_returns=no_returns), kinds, moving, self.all_points)


class HdMap(NamedTuple):
    """HD map around one scan, in the sensor's frame."""

    outlines: list[NDArray[np.float64]]  # drivable areas, each (N, 2)
    ground: Callable[[NDArray[np.float64]], NDArray[np.float64]]  # (N, 3) -> (N,) z of the ground or NaN


class SensorPlace(NamedTuple):
    """Place of a sensor on the vehicle, for datasets with several sensors or stated heights."""

    name: str = ""  # frames with the same name share an estimated height
    origin: tuple[float, float] = (0.0, 0.0)  # x, y in the vehicle frame [m]
    above_first: float = 0.0  # [m] above the sensor that the user's height refers to
    height: float | None = None  # above ground [m], if it is stated
    ego_footprint: Footprint | None = None  # in the vehicle frame
    yaw: float = 0.0  # of the sensor in the vehicle frame [rad]


def kinds_of(labelled: LabelledPoints) -> NDArray[np.uint8]:
    """Return the `Kind` of each point from the name of its class, (N,)."""
    table = np.full(max(labelled.names) + 1, Kind.OTHER, np.uint8)
    for number, name in labelled.names.items():
        table[number] = _KINDS.get(name, Kind.OBSTACLE)
    return table[labelled.classes]


def _outside(box: Footprint, points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return a mask of the points outside a footprint, (N,)."""
    x, y = points[:, 0], points[:, 1]
    return (x < box[0]) | (x > box[1]) | (y < box[2]) | (y > box[3])
