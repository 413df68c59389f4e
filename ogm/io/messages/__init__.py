"""Messages of ROS, Livox, Velodyne and Foxglove: conversion to scans, transforms and grids, and back.

A message is any object with the message's field names, from rosbags, rclpy, rospy or a decoded MCAP. Functions return
messages as trees of `types.SimpleNamespace` with numpy arrays: rosbags serialises them by type name, and `fill_message`
copies them into messages of rclpy and rospy.

>>> import numpy as np
>>> from ogm import Scan
>>> from ogm.io.messages import point_cloud2, scan_from_point_cloud2
>>> message = point_cloud2(Scan(np.ones((5, 4), np.float32)), frame_id="lidar", stamp=12.5)
>>> message.width, message.header.frame_id, scan_from_point_cloud2(message).stamp
(5, 'lidar', 12.5)
"""

from ogm.io.messages.clouds import point_cloud2, scan_from_continental, scan_from_point_cloud2, scan_from_radar_scan
from ogm.io.messages.costs import layers_from_nav2_costmap, nav2_costmap
from ogm.io.messages.grids import grid_from_occupancy_grid, occupancy_grid
from ogm.io.messages.images import intrinsics_from_camera_info, scan_from_depth_image
from ogm.io.messages.lasers import scan_from_laser_scan, scan_from_range
from ogm.io.messages.layers import (
    foxglove_grid,
    grid_from_foxglove_grid,
    grid_from_grid_map,
    grid_map,
    layers_from_foxglove_grid,
    layers_from_grid_map,
)
from ogm.io.messages.livox import scan_from_livox
from ogm.io.messages.plain import fill_message, tf_message, transform_from_odometry, transforms_from_tf
from ogm.io.messages.velodyne import scan_from_velodyne_scan, scans_from_pcap
from ogm.io.transforms import StampedTransform

__all__ = [
    "StampedTransform", "fill_message", "foxglove_grid", "grid_from_foxglove_grid", "grid_from_grid_map",
    "grid_from_occupancy_grid", "grid_map", "intrinsics_from_camera_info", "layers_from_foxglove_grid",
    "layers_from_grid_map", "layers_from_nav2_costmap", "nav2_costmap", "occupancy_grid", "point_cloud2",
    "scan_from_continental", "scan_from_depth_image", "scan_from_laser_scan", "scan_from_livox",
    "scan_from_point_cloud2", "scan_from_radar_scan", "scan_from_range", "scan_from_velodyne_scan", "scans_from_pcap",
    "tf_message", "transform_from_odometry", "transforms_from_tf",
]  # fmt: skip
