"""What every data set is turned into before frames are made of it: references to its scans and functions that read."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.io import Axes
from ogm.io.labels import LabelledPoints
from ogm.scan import Boxes, Mount, Scan
from ogm.state import Truth
from ogm.truth import Kind

__all__ = ["EGO", "KITTI_EGO", "Footprint", "FrameRef", "HdMap", "Layout", "RawFrame", "SensorPlace", "kinds_of"]

Footprint = tuple[float, float, float, float]
"""x_min, x_max, y_min, y_max around the sensor [m], as `Mount.ego_footprint`."""

EGO: Footprint = (-2.5, 2.5, -1.1, 1.1)
KITTI_EGO: Footprint = (-2.6, 2.6, -1.7, 1.7)  # with the mirrors and what else stands out at the sides

# Classes by what they mean to a car, under the names of all data sets. What is not here is an obstacle.
_KINDS = {"vegetation": Kind.PLANT} | dict.fromkeys(("unlabeled", "outlier", "none"), Kind.OTHER)
_KINDS |= dict.fromkeys(("road", "parking", "sidewalk", "other-ground", "terrain", "lane-marking"), Kind.GROUND)


class FrameRef(NamedTuple):
    """What is known of a frame before its scan is read."""

    name: str
    sequence: str = ""  # "" where the frame stands alone
    stamp: float | None = None  # [s]
    T_map_sensor: NDArray[np.float64] | None = None  # (4, 4)


class RawFrame(NamedTuple):
    """One scan in its sensor's frame, with the returns from the ego vehicle, and what is labelled point by point."""

    scan: Scan
    kinds: NDArray[np.uint8] | None = None  # (N,) `Kind` of each point, from its class
    moving: NDArray[np.bool_] | None = None  # (N,) points whose class tells that they move
    all_points: NDArray[np.float32] | None = None  # (M, 4) of all lidars of the vehicle, in this one's frame


class HdMap(NamedTuple):
    """A map around one scan, in its sensor's frame."""

    outlines: list[NDArray[np.float64]]  # (N, 2) each: drivable areas
    ground: Callable[[NDArray[np.float64]], NDArray[np.float64]]  # (N, 3) -> (N,) z of the ground or NaN


class SensorPlace(NamedTuple):
    """How the sensor of a frame is mounted, where a data set has several, or states their height."""

    name: str = ""  # frames of one name share an estimated height
    origin: tuple[float, float] = (0.0, 0.0)  # x, y in the vehicle frame [m]
    above_first: float = 0.0  # [m] over the sensor whose height a user gives
    height: float | None = None  # above ground [m], where it is stated
    ego_footprint: Footprint | None = None  # in the vehicle frame
    yaw: float = 0.0  # of the sensor in the vehicle frame [rad]


@dataclass(frozen=True)
class Layout:
    """What was found at a path. Its functions take the number of a frame, and read when they are called.

    Parameters
    ----------
    format : str
        In words.
    frames : tuple of FrameRef
    read : function -> RawFrame
    labels : str
        Which labels this layout may have: for the error where there are none.
    boxes, hd_map : function -> Boxes, HdMap, optional
        None where there are no boxes, no map.
    classes : bool
        Whether `read` gives kinds.
    ego_footprint : Footprint, optional
        Returns inside of it are dropped. None keeps all: sensor models drop them by their mount.
    view : str
        From where, or how far, labels were made, where truth has to state it.
    view_angle : float, optional
        Objects are labelled up to so far to either side of straight ahead [rad], below π/2. None for all around.
    sensor_height : function -> float, optional
        Height of the sensor above ground [m], where the data set has more of it than the scan's points.
    place : function -> SensorPlace, optional
        Where there are several sensors, or their height is stated.
    mount : function -> Mount, optional
        Where the data set states how the sensor is mounted, and where it was.
    truth : function -> Truth, optional
        Where the data set holds the truth itself; made of labels and scans otherwise.
    has_truth : function -> bool, optional
        Whether a frame has a truth, without reading it; None where all have one.
    description : str
        What that truth is made of.
    stamped : bool
        Whether the stamps of the frames are stated, not counted from their names at 10 Hz.
    axes : Axes
        Which way the axes of the files point.
    known_axes : bool
        Whether axes and units are those of a public data set, so that a user cannot choose them.
    aggregated : bool
        Whether truth may be made of neighbouring scans; a radar shows no ground.
    motion_distorted : bool
        Whether points may be shifted by the ego motion during a scan, so that de-skewing makes sense.
    name : str
        Of the data set; that of its folder where empty.
    facts : dict
        What else there is to know, as JSON can hold it.
    files : tuple of Path
        Files and folders that it is read from; its path where empty.
    shards : (len(frames),) int array, optional
        Which frames lie together, where reading all that do costs little more than reading one: in object stores.
    itself : bool
        Whether it can be pickled, so that other processes need not open the path again.
    """

    format: str
    frames: tuple[FrameRef, ...]
    read: Callable[[int], RawFrame]
    labels: str = ""
    boxes: Callable[[int], Boxes] | None = None
    hd_map: Callable[[int], HdMap] | None = None
    classes: bool = False
    ego_footprint: Footprint | None = EGO
    view: str = ""
    view_angle: float | None = None
    sensor_height: Callable[[int], float] | None = None
    place: Callable[[int], SensorPlace] | None = None
    mount: Callable[[int], Mount] | None = None
    truth: Callable[[int], Truth] | None = None
    has_truth: Callable[[int], bool] | None = None
    description: str = ""
    stamped: bool = False
    axes: Axes = "flu"
    known_axes: bool = True
    aggregated: bool = True
    motion_distorted: bool = True
    name: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict)
    files: tuple[Path, ...] = ()
    shards: NDArray[np.int64] | None = None
    itself: bool = False


def kinds_of(labelled: LabelledPoints) -> NDArray[np.uint8]:
    """Return what each point is to a car, (N,), by the name of its class."""
    table = np.full(max(labelled.names) + 1, Kind.OTHER, np.uint8)
    for number, name in labelled.names.items():
        table[number] = _KINDS.get(name, Kind.OBSTACLE)
    return table[labelled.classes]
