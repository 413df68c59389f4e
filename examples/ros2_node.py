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
    from rclpy.node import Node
    from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
    from sensor_msgs.msg import PointCloud2
    from tf2_msgs.msg import TFMessage

    class GridNode(Node):
        """Maps the newest cloud as soon as tf has its time."""

        def __init__(self) -> None:
            super().__init__("ogm")
            self.map_frame = self.declare_parameter("map_frame", "odom").value
            spec, mount = GridSpec.centered(), Mount(self.declare_parameter("sensor_height", 1.8).value)
            self.ism, self.mapper = RayISM(spec, mount), EvidentialMapper(rolling_window(spec))
            warm_up(self.ism, self.mapper)
            self.transforms, self.waiting = TransformBuffer(keep=10.0), None
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            static = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self.publisher = self.create_publisher(OccupancyGrid, "map", latched)
            self.create_subscription(TFMessage, "/tf", self.add_transforms, 100)
            self.create_subscription(TFMessage, "/tf_static", lambda tf: self.add_transforms(tf, True), static)
            self.create_subscription(PointCloud2, "points", self.take_cloud, qos_profile_sensor_data)

        def add_transforms(self, message: TFMessage, static: bool = False) -> None:
            for transform in transforms_from_tf(message):
                self.transforms.add(transform, static)
            self.map_waiting()

        def take_cloud(self, cloud: PointCloud2) -> None:
            self.waiting = cloud  # an older one that still waits is dropped
            self.map_waiting()

        def map_waiting(self) -> None:
            cloud, self.waiting = self.waiting, None
            try:
                if cloud is not None:
                    plain = map_cloud(cloud, self.transforms, self.ism, self.mapper, self.map_frame)
                    self.publisher.publish(fill_message(OccupancyGrid(), plain))
            except ExtrapolationError as error:
                self.waiting = cloud if error.seconds > 0 else None  # tf comes a little later
            except ValueError as error:
                self.get_logger().warning(f"a cloud is skipped: {error}", throttle_duration_sec=5.0)

    rclpy.init()
    rclpy.spin(GridNode())
