"""Rooms of boxes: depths and ranges by analytic ray casting, and depth images as messages."""

from io import BytesIO
from types import SimpleNamespace
from typing import Any

import numpy as np
from PIL import Image

from ogm.io import Intrinsics
from ogm.io.messages.plain import header
from ogm.pose import pose

CAMERA = Intrinsics(160, 120, 131.0, 131.0, 79.5, 59.5)  # 62 x 49 degrees
ROOM = (-3.0, -3.0, 0.0, 5.0, 3.0, 2.6)  # x, y, z from and to [m]: the rays start inside of it
TABLE = (
    (2.0, -0.6, 0.70, 3.0, 0.6, 0.75),
    *((x, y, 0.0, x + 0.06, y + 0.06, 0.7) for x in (2.0, 2.94) for y in (-0.6, 0.54)),
)
MAN = (1.8, 0.8, 0.0, 2.1, 1.1, 1.8)


def ranges(origin: np.ndarray, ways: np.ndarray, boxes: tuple = (), room: tuple = ROOM) -> np.ndarray:
    """Return how far rays go until they meet a box or a wall, in lengths of their directions, (N,)."""
    found = np.full(len(ways), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for box in (room, *boxes):
            ends = (np.array(box).reshape(2, 1, 3) - origin) / ways
            enter, leave = np.nanmax(ends.min(0), axis=1), np.nanmin(ends.max(0), axis=1)
            hit = leave if box is room else np.where((enter <= leave) & (enter > 0), enter, np.inf)
            found = np.minimum(found, hit)
    return found


def depths(T_room_camera: np.ndarray, boxes: tuple = (), camera: Intrinsics = CAMERA, room: tuple = ROOM) -> np.ndarray:
    """Return the image of a depth camera in a room, (height, width) [m]; the camera looks along x of its pose."""
    v, u = np.mgrid[: camera.height, : camera.width].reshape(2, -1)
    ways = np.column_stack([np.ones(u.size), (camera.cx - u) / camera.fx, (camera.cy - v) / camera.fy])
    along = ranges(T_room_camera[:3, 3], ways @ T_room_camera[:3, :3].T, boxes, room)
    return along.reshape(camera.height, camera.width)


def looking(height: float, pitch: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """Return the pose of a camera above the middle of a room's floor, by angles in degrees; pitch is down."""
    return pose(z=height, yaw=np.radians(yaw)) @ pose(pitch=np.radians(pitch))


def image_message(depth: np.ndarray, encoding: str, frame: str, stamp: float) -> Any:
    pixels = (depth * 1000).round().astype(np.uint16) if encoding != "32FC1" else depth.astype(np.float32)
    if "compressedDepth" in encoding:
        Image.fromarray(pixels).save(png := BytesIO(), "PNG")
        data = np.frombuffer(bytes(12) + png.getvalue(), np.uint8)
        return SimpleNamespace(header=header(stamp, frame), format=encoding, data=data)
    data = pixels.view(np.uint8).reshape(-1)
    sizes = {"height": len(depth), "width": depth.shape[1], "step": pixels.strides[0]}
    return SimpleNamespace(header=header(stamp, frame), encoding=encoding, is_bigendian=0, data=data, **sizes)


def info_message(frame: str, stamp: float, ros1: bool) -> Any:
    k = np.array([CAMERA.fx, 0, CAMERA.cx, 0, CAMERA.fy, CAMERA.cy, 0, 0, 1])
    matrices = {"d": np.zeros(5), "k": k, "r": np.eye(3).ravel(), "p": np.insert(k, [3, 6, 9], 0)}
    roi = SimpleNamespace(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    named = {name.upper() if ros1 else name: value for name, value in matrices.items()}
    rest = {
        "height": CAMERA.height,
        "width": CAMERA.width,
        "distortion_model": "plumb_bob",
        "binning_x": 0,
        "binning_y": 0,
    }
    return SimpleNamespace(header=header(stamp, frame), roi=roi, **named, **rest)
