"""Point clouds, poses and labels in: any supported file to metres, x forward, y left, z up."""

from ogm.io.argoverse2 import Argoverse2Log, Argoverse2Map, read_argoverse2
from ogm.io.axes import AXES, Axes
from ogm.io.calibration import read_calibration
from ogm.io.kitti import read_kitti_calibration, read_kitti_objects, read_kitti_stamps, read_kitti_tracks
from ogm.io.nuscenes import NuScenes, NuScenesFrame, read_mmdet3d, read_nuscenes
from ogm.io.objects import LabelledPoints
from ogm.io.points import read_points, read_scan, read_scan_file
from ogm.io.poses import Poses, read_poses, write_poses
from ogm.io.range_images import NUSCENES_ELEVEN, read_range_image
from ogm.io.scan import FileFacts, describe, estimate_sensor_height
from ogm.io.semantic_kitti import (
    SEMANTIC_KITTI,
    SEMANTIC_KITTI_MOVING,
    SEMANTIC_KITTI_TO_TRAINING,
    SEMANTIC_KITTI_TRAINING,
    read_semantic_kitti,
)
from ogm.io.source import BYTE_LIMIT
from ogm.io.sustech import read_sustech

__all__ = [
    "AXES",
    "BYTE_LIMIT",
    "FileFacts",
    "NUSCENES_ELEVEN",
    "SEMANTIC_KITTI",
    "SEMANTIC_KITTI_MOVING",
    "SEMANTIC_KITTI_TO_TRAINING",
    "SEMANTIC_KITTI_TRAINING",
    "Argoverse2Log",
    "Argoverse2Map",
    "Axes",
    "LabelledPoints",
    "NuScenes",
    "NuScenesFrame",
    "Poses",
    "describe",
    "estimate_sensor_height",
    "read_argoverse2",
    "read_calibration",
    "read_kitti_calibration",
    "read_kitti_objects",
    "read_kitti_stamps",
    "read_kitti_tracks",
    "read_mmdet3d",
    "read_nuscenes",
    "read_points",
    "read_poses",
    "read_range_image",
    "read_scan",
    "read_scan_file",
    "read_semantic_kitti",
    "read_sustech",
    "write_poses",
]
