"""A street with a wall of pillars, recorded as logs whose frames, mounts or ranges are unusual."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ogm.io.logs import LogWriter
from ogm.io.messages import StampedTransform, point_cloud2, tf_message
from ogm.pose import inverse, pose, transform_points
from ogm.scan import Scan

CLOUD, TF = "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"
START, STEP = 100.0, 0.125  # [s]
BOX = 8.0  # [m] where the front of a box across the way stands
MAST = np.array(
    [(x, y, z) for x in np.arange(-0.45, -0.3, 0.03) for y in np.arange(-0.2, 0.21, 0.03) for z in (0, 0.2)]
)


def world(side: float = 0.2) -> np.ndarray:
    """Return the ground, a box across the way and pillars beside it; z is 0 on the ground."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-15, 20, side), np.arange(-8, 8, side)))
    box = [(BOX, b, z) for b in np.arange(-3, 3, 0.1) for z in (0.4, 0.8, 1.2)]
    pillars = [(a, b, z) for a in np.arange(-4, 8, 1.5) for b in (-0.95, 0.95) for z in np.arange(0.3, 1.2, 0.1)]
    return np.concatenate([np.column_stack([x, y, 0 * x]), box, pillars])


def tilted(roll: float = 0, pitch: float = 0, yaw: float = 0, height: float = 1.2) -> np.ndarray:
    """Return the pose of a sensor above its vehicle, by angles in degrees."""
    return pose(z=height, yaw=np.radians(yaw)) @ pose(roll=np.radians(roll), pitch=np.radians(pitch))


def way(count: int, step: float = 0.5) -> list[np.ndarray]:
    """Return T_map_vehicle along a slight curve."""
    return [pose(step * k, 0.1 * k, yaw=0.02 * k) for k in range(count)]


def write_log(
    path: Path,
    vehicles: Iterable[np.ndarray],
    mount: np.ndarray,
    *,
    frame: str = "os_lidar",
    chain: tuple[tuple[str, str], ...] = (("map", "os_lidar"),),
    extra: np.ndarray | None = None,
    pose_mount: np.ndarray | None = None,
    static: bool = True,
) -> Path:
    """Write what a sensor measures on its way.

    Parameters
    ----------
    path
    vehicles
        T_map_base_link of the scans.
    mount
        T_base_link_sensor.
    frame
        Frame of the clouds: map, base_link or any other name for the sensor's.
    chain
        Transforms that are written: of map, base_link and the sensor's frame.
    extra
        Further points in the sensor's frame, the same in each scan.
    pose_mount
        The mount as the transforms state it; by default the true one.
    static
        Whether base_link's transforms to the sensor are written as static.
    """
    stated = mount if pose_mount is None else pose_mount
    with LogWriter(path) as log:
        for k, T in enumerate(vehicles):
            stamp = START + STEP * k
            places = {"map": np.eye(4), "odom": np.eye(4), "base_link": T}
            points = transform_points(inverse(T @ mount), world())
            points = points if extra is None else np.concatenate([points, extra])
            if frame in places:
                points = transform_points(inverse(places[frame]) @ T @ mount, points)
            scan = Scan(points.astype(np.float32))
            log.write("/points", CLOUD, point_cloud2(scan, frame_id=frame, stamp=stamp), stamp)
            for parent, child in chain:
                T_parent_child = inverse(places.get(parent, T @ stated)) @ places.get(child, T @ stated)
                topic = "/tf_static" if static and parent == "base_link" else "/tf"
                message: Any = tf_message([StampedTransform(parent, child, stamp, T_parent_child)])
                log.write(topic, TF, message, stamp)
    return path
