"""A ROS 2 node around the converters: PointCloud2 and tf in, OccupancyGrid out.

    python3 examples/ros2_node.py --ros-args -r points:=/lidar/points -p sensor_height:=1.8 -p map_frame:=odom

`map_cloud` is all that it does with a message; it needs no ROS.
"""

from types import SimpleNamespace
from typing import Any

from ogm import Frame, GridSpec, Mount
from ogm.fusion import EvidentialMapper, rolling_window, update_map
from ogm.geometric import RayISM
from ogm.io.messages import fill_message, occupancy_grid, scan_from_point_cloud2, transforms_from_tf
from ogm.io.transforms import ExtrapolationError, TransformBuffer
from ogm.live import warm_up


def map_cloud(
    cloud: Any, transforms: TransformBuffer, ism: RayISM, mapper: EvidentialMapper, map_frame: str
) -> SimpleNamespace:
    """Fuse a PointCloud2 into the map, and return the map as an OccupancyGrid."""
    scan = scan_from_point_cloud2(cloud)
    T_map_sensor = transforms.lookup(map_frame, cloud.header.frame_id.lstrip("/"), scan.stamp)
    frame = Frame(scan, ism.mount, None, None, T_map_sensor=T_map_sensor, stamp=scan.stamp)
    update_map(mapper, ism(scan), frame)
    return occupancy_grid(mapper.grid, frame_id=map_frame, stamp=scan.stamp)


def main() -> None:
    import rclpy
    from nav_msgs.msg import OccupancyGrid
    from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
    from sensor_msgs.msg import PointCloud2
    from tf2_msgs.msg import TFMessage

    rclpy.init()
    node = rclpy.create_node("ogm")
    map_frame = node.declare_parameter("map_frame", "odom").value
    spec, mount = GridSpec.centered(), Mount(node.declare_parameter("sensor_height", 1.8).value)
    ism, mapper, transforms = RayISM(spec, mount), EvidentialMapper(rolling_window(spec)), TransformBuffer(keep=10.0)
    warm_up(ism, mapper)
    latched, static = (QoSProfile(depth=n, durability=DurabilityPolicy.TRANSIENT_LOCAL) for n in (1, 100))
    publisher = node.create_publisher(OccupancyGrid, "map", latched)
    waiting: list[Any] = []  # the newest cloud, until tf has its time

    def map_waiting() -> None:
        try:
            if waiting:
                plain = map_cloud(waiting[0], transforms, ism, mapper, map_frame)
                publisher.publish(fill_message(OccupancyGrid(), plain))
                waiting.clear()
        except ValueError as error:
            if not isinstance(error, ExtrapolationError) or error.seconds <= 0:  # else tf comes a little later
                node.get_logger().warning(f"a cloud is skipped: {error}", throttle_duration_sec=5.0)
                waiting.clear()

    def take_tf(message: TFMessage, static: bool = False) -> None:
        for transform in transforms_from_tf(message):
            transforms.add(transform, static)
        map_waiting()

    def take_cloud(cloud: PointCloud2) -> None:
        waiting[:] = [cloud]
        map_waiting()

    node.create_subscription(TFMessage, "/tf", take_tf, 100)
    node.create_subscription(TFMessage, "/tf_static", lambda message: take_tf(message, True), static)
    node.create_subscription(PointCloud2, "points", take_cloud, qos_profile_sensor_data)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
