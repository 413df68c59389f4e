"""Messages of ROS, Livox, Velodyne and Foxglove: to scans and transforms, and from grids.

A message is any object with the message's field names, of rosbags, rclpy, rospy or a decoded MCAP. Functions return
messages as trees of `types.SimpleNamespace` with numpy arrays: rosbags serialises them by the name of their type.
"""

from ogm.io.messages.clouds import point_cloud2, scan_from_point_cloud2
from ogm.io.messages.plain import ros_stamp, stamp_seconds
from ogm.io.messages.poses import (
    rotation_from_imu,
    tf_message,
    transform_from_odometry,
    transform_from_pose,
    transforms_from_tf,
)
from ogm.io.transforms import StampedTransform

__all__ = [
    "StampedTransform",
    "point_cloud2",
    "ros_stamp",
    "rotation_from_imu",
    "scan_from_point_cloud2",
    "stamp_seconds",
    "tf_message",
    "transform_from_odometry",
    "transform_from_pose",
    "transforms_from_tf",
]
