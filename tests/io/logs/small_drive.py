"""A small drive as messages."""

from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import numpy as np

from ogm.io.messages import StampedTransform, point_cloud2, tf_message
from ogm.pose import pose
from ogm.scan import Scan

CLOUD, TF = "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"
START = 1_700_000_000.0  # [s] all times are multiples of 2**-4 s from here, which seconds and nanoseconds hold exactly
SCANS = 12
KINDS = [("a.mcap", ""), ("a.mcap", "zstd"), ("a.db3", ""), ("a.bag", "")]  # names and packings of logs


def scan(k: int, points: int = 4000) -> Scan:
    """Return scan k: numbers that pack badly, with rings and times."""
    rng = np.random.default_rng(k)
    cloud = rng.uniform(0, 1, (points, 4)).astype(np.float32)
    return Scan(cloud, stamp=START + k / 8, ring=np.arange(points) % 16, time=np.linspace(0, 0.1, points))


def drive(points: int = 4000) -> list[tuple[str, str, Any, float]]:
    """Return topics, types, messages and log times of a drive, in the order of writing."""
    static = tf_message([StampedTransform("base_link", "lidar", START, pose(z=1.75))])
    rows: list[tuple[str, str, Any, float]] = [("/tf_static", TF, static, START)]
    for k in range(SCANS):
        stamp = START + k / 8
        rows.append(("/points", CLOUD, point_cloud2(scan(k, points), frame_id="lidar"), stamp + 1 / 16))
        moving = tf_message([StampedTransform("map", "base_link", stamp, pose(x=k, yaw=0.1 * k))])
        rows.append(("/tf", TF, moving, stamp + 1 / 8))
    return rows


def plain(message: Any) -> Any:
    """Return a message as lists, dicts and numbers, without the numbers of ROS 1 headers."""
    if isinstance(message, np.ndarray):
        return message.tolist()
    if isinstance(message, list | tuple):
        return [plain(one) for one in message]
    if isinstance(message, SimpleNamespace) or hasattr(message, "__dataclass_fields__"):
        names = vars(message) if isinstance(message, SimpleNamespace) else [one.name for one in fields(message)]
        wanted = [name for name in names if name not in ("seq", "__msgtype__") and not name.isupper()]  # no constants
        return {name: plain(getattr(message, name)) for name in wanted}
    return message
