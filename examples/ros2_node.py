"""A ROS 2 node around the converters: clouds, laser scans, depth images and tf in, OccupancyGrid out.

    python3 examples/ros2_node.py --ros-args -r points:=/lidar/points -p map_frame:=odom -p base_frame:=base_footprint

The base frame lies on the ground. `read_frame` is all that it does with a message; it needs no ROS.
"""

from functools import partial
from typing import Any

import numpy as np

from ogm import Frame, GridSpec, Mount, load_model
from ogm.fusion import make_mapper, rolling_window, update_map
from ogm.io import T_OPTICAL_BODY, messages
from ogm.io.transforms import ExtrapolationError, TransformBuffer
from ogm.live import warm_up


def read_frame(kept: dict[str, Any], topic: str, tf: TransformBuffer, frames: list[str]) -> Frame:
    """Return the scan of a topic with its place in the frames of the map and of the vehicle."""
    message, T = kept[topic], T_OPTICAL_BODY if topic == "depth" else np.eye(4)
    if topic == "depth":
        scan = messages.scan_from_depth_image(message, messages.intrinsics_from_camera_info(kept.get("camera_info")))
    else:
        scan = (messages.scan_from_laser_scan if topic == "scan" else messages.scan_from_point_cloud2)(message)
    sensor = message.header.frame_id.lstrip("/")
    T_map_sensor, T_base_sensor = (tf.lookup(frame, sensor, scan.stamp) @ T for frame in frames)
    return Frame(scan, Mount(T_base_sensor[2, 3], T_base_sensor), T_map_sensor=T_map_sensor, stamp=scan.stamp)


def main() -> None:
    import rclpy
    from nav_msgs.msg import OccupancyGrid
    from rclpy import qos
    from sensor_msgs import msg
    from tf2_msgs.msg import TFMessage

    rclpy.init()
    node, kept = rclpy.create_node("ogm"), dict[str, Any]()  # the newest message of each topic, until tf has its time
    frames = [node.declare_parameter(*one).value for one in (("map_frame", "odom"), ("base_frame", "base_link"))]
    spec, tf = GridSpec.centered(), TransformBuffer(keep=10.0)
    ism, mapper = load_model("ray+planar+depth", spec), make_mapper("revise", rolling_window(spec))
    warm_up(ism, mapper)
    latched, static = (qos.QoSProfile(depth=n, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL) for n in (1, 100))
    publisher = node.create_publisher(OccupancyGrid, "map", latched)

    def take(topic: str, message: Any) -> None:
        for transform in messages.transforms_from_tf(message) if "tf" in topic else ():
            tf.add(transform, topic == "/tf_static")
        kept[topic] = message
        for key in [one for one in ("points", "scan", "depth") if one in kept]:
            try:
                frame = read_frame(kept, key, tf, frames)
                update_map(mapper, ism(frame.scan), frame)
                plain = messages.occupancy_grid(mapper.grid, frame_id=frames[0], stamp=frame.stamp)
                publisher.publish(messages.fill_message(OccupancyGrid(), plain))
            except ValueError as error:
                if isinstance(error, ExtrapolationError) and error.seconds > 0:
                    continue  # tf comes a little later
                node.get_logger().warning(f"a scan is skipped: {error}", throttle_duration_sec=5.0)
            del kept[key]

    for topic, n in (("/tf", 100), ("/tf_static", static)):
        node.create_subscription(TFMessage, topic, partial(take, topic), n)
    kinds = {"points": msg.PointCloud2, "scan": msg.LaserScan, "depth": msg.Image, "camera_info": msg.CameraInfo}
    for topic, kind in kinds.items():
        node.create_subscription(kind, topic, partial(take, topic), qos.qos_profile_sensor_data)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
