"""A drive to try maps on, without any data: a lidar moves through a round yard, and a car crosses its way.

    from yard import CAR_SPEED, MOUNT, frames, write_log

`frames` yields the frames of a dataset; in its place could be ``ogm.open_dataset("drive/")``.
`write_log` writes them as ROS messages.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ogm import Boxes, Frame, Mount, Scan
from ogm.pose import inverse, pose

MOUNT = Mount(sensor_height=1.8)
YARD, EGO_SPEED, CAR_SPEED, RATE = 15.0, 1.0, 5.0, 10.0  # radius [m], [m/s] along x, [m/s] along y, [Hz]
CAR = np.array([1.8, 4.2, 1.5])  # [m] along x, y and z
AZIMUTH, ELEVATION = np.linspace(-np.pi, np.pi, 1024, endpoint=False), np.deg2rad(np.arange(-24.0, 4.0, 1.0))
DIRECTIONS = np.column_stack([np.cos(AZIMUTH), np.sin(AZIMUTH)])


def to_car(center: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance to the car in every direction [m]; inf where it is not hit."""
    with np.errstate(divide="ignore"):
        sides = (center + np.array([-0.5, 0.5])[:, None, None] * CAR[:2]) / DIRECTIONS
    near, far = sides.min(axis=0).max(axis=1), sides.max(axis=0).min(axis=1)
    return np.where((near < far) & (near > 0), near, np.inf)


def frames(count: int = 30) -> Iterator[Frame]:
    """Yield the frames of the drive, 10 a second."""
    for k in range(count):
        stamp = k / RATE
        x = EGO_SPEED * stamp
        center = np.array([8.0 - x, CAR_SPEED * stamp - 7.5])  # of the car, from the sensor
        along = DIRECTIONS[:, 0] * x
        wall, car = -along + np.sqrt(along**2 - x**2 + YARD**2), to_car(center)
        rings = []
        for elevation in ELEVATION:
            over_car = MOUNT.sensor_height + np.where(car < np.inf, car, 0.0) * np.tan(elevation) > CAR[2]
            ground = MOUNT.sensor_height / np.tan(-elevation) if elevation < 0 else np.inf
            distance = np.minimum(np.minimum(wall, ground), np.where(over_car, np.inf, car))
            z = distance * np.tan(elevation)
            rings.append(np.column_stack([DIRECTIONS * distance[:, None], z, np.full(z.size, 0.5)]))
        boxes = Boxes([[*center, CAR[2] / 2 - MOUNT.sensor_height]], [CAR], [0.0], [[0.0, CAR_SPEED]], ["car"], ["1"])
        scan = Scan(np.concatenate(rings).astype(np.float32), stamp)
        T_map_sensor = pose(x=x, z=MOUNT.sensor_height)
        yield Frame(scan, MOUNT, boxes, None, T_map_sensor=T_map_sensor, stamp=stamp, name=f"{k:03}", sequence="yard")


def write_log(path: str, count: int = 30) -> None:
    """Write the drive as a log, .mcap, .db3 or .bag: points, the mount of the lidar, poses of the vehicle."""
    from ogm.io.logs import LogWriter  # only now: frames need no packages of logs
    from ogm.io.messages import StampedTransform, point_cloud2, tf_message

    TF, CLOUD = "tf2_msgs/msg/TFMessage", "sensor_msgs/msg/PointCloud2"
    T_base_lidar = pose(z=MOUNT.sensor_height)
    with LogWriter(path) as log:
        mount = StampedTransform("base_link", "lidar", 100.0, T_base_lidar)
        log.write("/tf_static", TF, tf_message([mount]), 100.0)
        for frame in frames(count):
            stamp = 100.0 + frame.stamp
            moved = StampedTransform("map", "base_link", stamp, frame.T_map_sensor @ inverse(T_base_lidar))
            log.write("/tf", TF, tf_message([moved]), stamp)
            log.write("/points", CLOUD, point_cloud2(frame.scan, frame_id="lidar", stamp=stamp), stamp)
