"""Frames of sensors in a log: clouds may be given in another frame than that of their sensor."""

import re
from collections.abc import Sequence

from ogm.io.transforms import TransformBuffer
from ogm.storage.files import OgmError

FIXED = ("map", "odom", "world")  # frames that stand still, by their usual names
_OTHERS = ("earth", "global", "local", "local_map", "camera_init", "lidar_init", "aft_mapped", "odom_combined")
_LIDAR = re.compile(
    r"lidar|laser|velo|ouster|(^|[/_])os\d?(_|$)|livox|mid_?360|avia|hapi|hesai|pandar|rs_?lidar|robosense|radar|sick"
    r"|aeva|luminar|innoviz|(^|[/_])scan",
    re.IGNORECASE,
)


def unnamed_frame(topic: str) -> str:
    """Return the name that stands for the frame of the scans of a topic whose headers name none."""
    return f"(frame of {topic})"


def lidar_frames(buffer: TransformBuffer) -> list[str]:
    """Return the frames of a transform buffer with the name of a lidar, of several in a chain the last."""
    return _lidars(_children(buffer), buffer.frames)


def sensor_frame(buffer: TransformBuffer, frame: str, vehicle: Sequence[str]) -> str:
    """Return the frame of the sensor that measured a cloud.

    It is the frame of the cloud, unless that is the vehicle's or lies above it: a fixed frame (map, odom, world), or
    one from which transforms that change lead to the vehicle. Such a cloud was moved after it was measured.

    Parameters
    ----------
    buffer : TransformBuffer
    frame : str
        Frame of the cloud.
    vehicle : sequence of str
        Frames of the vehicle, such as base_link.

    Raises
    ------
    OgmError
        If the frame lies above the vehicle, and transforms do not lead from there to one lidar.
    """
    children = _children(buffer)
    below = _below(children, frame)
    if frame in vehicle:  # a cloud of several lidars has no place of its own
        lidars = _lidars(children, below)
        return lidars[0] if len(lidars) == 1 else frame
    if not (_named(frame, (*FIXED, *_OTHERS)) or _carries(buffer, children, frame, vehicle)):
        return frame
    where = f"are in {frame}, a frame above the vehicle's, so that they do not tell where their sensor was"
    lidars = _lidars(children, below)
    if not lidars and not any(one in vehicle for one in below):
        lidars = [one for one in below if one not in children]
    if len(lidars) != 1:
        found = (
            f"lead from there to {', '.join(lidars or below)}, not to one lidar" if below else "from there are missing"
        )
        way = "give `sensor_position` (x, y, z in base_link), or by `topic` the cloud in its sensor's frame"
        raise OgmError(f"{where}, and transforms {found}: {way}")
    return lidars[0]


def _children(buffer: TransformBuffer) -> dict[str, list[str]]:
    """Return the frames directly below each frame."""
    children: dict[str, list[str]] = {}
    for parent, child in buffer.pairs:
        children.setdefault(parent, []).append(child)
    return children


def _below(children: dict[str, list[str]], frame: str) -> list[str]:
    """Return all frames below one."""
    found: list[str] = []
    waiting = [frame]
    while waiting:
        for child in children.get(waiting.pop(), []):
            if child not in found and child != frame:
                found.append(child)
                waiting.append(child)
    return found


def _lidars(children: dict[str, list[str]], frames: Sequence[str]) -> list[str]:
    """Return the frames with the name of a lidar, of several in a chain the last."""
    named = [frame for frame in frames if _LIDAR.search(frame)]
    return [frame for frame in named if not any(one in named for one in _below(children, frame))]


def _named(frame: str, names: Sequence[str]) -> bool:
    """Return whether a frame has one of some names, also in a namespace: robot1/map."""
    return frame.rsplit("/", 1)[-1] in names


def _carries(buffer: TransformBuffer, children: dict[str, list[str]], frame: str, vehicle: Sequence[str]) -> bool:
    """Return whether transforms that change lead from a frame down to the vehicle, or to any frame without one."""
    goals = [one for one in _below(children, frame) if one in vehicle]
    if not goals and not any(one in vehicle for one in buffer.frames) and not _LIDAR.search(frame):
        goals = _below(children, frame)
    return any(buffer.changes(frame, goal) for goal in goals)
