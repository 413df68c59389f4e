"""Sensor frames of a log: clouds may be given in another frame than the sensor's."""

import re
from collections.abc import Sequence

from ogm.io.transforms import TransformBuffer
from ogm.storage.files import OgmError

FIXED = ("map", "odom", "world")  # usual names of fixed frames
_OTHERS = ("earth", "global", "local", "local_map", "camera_init", "lidar_init", "aft_mapped", "odom_combined")
_LIDAR = re.compile(
    r"lidar|laser|velo|ouster|(^|[/_])os\d?(_|$)|livox|mid_?360|avia|hapi|hesai|pandar|rs_?lidar|robosense|radar|sick"
    r"|aeva|luminar|innoviz|(^|[/_])scan",
    re.IGNORECASE,
)


def unnamed_frame(topic: str) -> str:
    """Return the placeholder for the frame of a topic without frame names in its headers."""
    return f"(frame of {topic})"


def lidar_frames(buffer: TransformBuffer) -> list[str]:
    """Return the frames of a transform buffer with lidar names; of nested ones only the lowest."""
    return _lidars(_children(buffer), buffer.frames)


def sensor_frame(buffer: TransformBuffer, frame: str, vehicle: Sequence[str]) -> str:
    """Return the frame of the sensor that measured a cloud.

    This is the frame of the cloud, unless the cloud was transformed after the measurement: its frame is then the
    vehicle's or lies above it. Frames above are fixed frames (map, odom, world), and frames from which changing
    transforms lead to the vehicle.

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
        If the frame lies above the vehicle, and transforms do not lead from it to exactly one lidar.
    """
    children = _children(buffer)
    below = _below(children, frame)
    if frame in vehicle:  # a cloud of several lidars has no single sensor position
        lidars = _lidars(children, below)
        return lidars[0] if len(lidars) == 1 else frame
    if not (_named(frame, (*FIXED, *_OTHERS)) or _carries(buffer, children, frame, vehicle)):
        return frame
    where = f"are in {frame}, a frame above the vehicle's, and do not give the position of their sensor"
    lidars = _lidars(children, below)
    if not lidars and not any(name in vehicle for name in below):
        lidars = [name for name in below if name not in children]
    if len(lidars) != 1:
        found = f"lead from it to {', '.join(lidars or below)}, wanted one lidar" if below else "from it are missing"
        way = "give `sensor_position` (x, y, z in base_link), or choose a `topic` with clouds in the sensor's frame"
        raise OgmError(f"{where}, and transforms {found}: {way}")
    return lidars[0]


def _children(buffer: TransformBuffer) -> dict[str, list[str]]:
    """Return the frames directly below each frame."""
    children: dict[str, list[str]] = {}
    for parent, child in buffer.pairs:
        children.setdefault(parent, []).append(child)
    return children


def _below(children: dict[str, list[str]], frame: str) -> list[str]:
    """Return all frames below a frame."""
    found: list[str] = []
    waiting = [frame]
    while waiting:
        for child in children.get(waiting.pop(), []):
            if child not in found and child != frame:
                found.append(child)
                waiting.append(child)
    return found


def _lidars(children: dict[str, list[str]], frames: Sequence[str]) -> list[str]:
    """Return the frames with lidar names; of nested ones only the lowest."""
    named = [frame for frame in frames if _LIDAR.search(frame)]
    return [frame for frame in named if not any(child in named for child in _below(children, frame))]


def _named(frame: str, names: Sequence[str]) -> bool:
    """Return whether a frame has one of the names, also in a namespace (robot1/map)."""
    return frame.rsplit("/", 1)[-1] in names


def _carries(buffer: TransformBuffer, children: dict[str, list[str]], frame: str, vehicle: Sequence[str]) -> bool:
    """Return whether changing transforms lead from a frame down to the vehicle, or to any frame without vehicle."""
    goals = [name for name in _below(children, frame) if name in vehicle]
    if not goals and not any(name in vehicle for name in buffer.frames) and not _LIDAR.search(frame):
        goals = _below(children, frame)
    return any(buffer.changes(frame, goal) for goal in goals)
