"""Targets: the bytes of messages, decoded as those of a log, and made scans, transforms and grids."""

import json
import struct
from collections.abc import Callable
from functools import partial
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from PIL import Image
from seed_grids import dynamic, evidential
from seed_logs import CLOUD, START, TF, packets
from targets import Target, check_grid, check_poses, check_scan, cloud

from ogm.io.depth import Intrinsics
from ogm.io.grids.logged import decode_foxglove_grid
from ogm.io.logs.definitions import Channel, decode, message_types
from ogm.io.messages import (
    StampedTransform,
    foxglove_grid,
    grid_from_foxglove_grid,
    grid_from_grid_map,
    grid_from_occupancy_grid,
    grid_map,
    intrinsics_from_camera_info,
    layers_from_grid_map,
    occupancy_grid,
    point_cloud2,
    scan_from_continental,
    scan_from_depth_image,
    scan_from_laser_scan,
    scan_from_livox,
    scan_from_point_cloud2,
    scan_from_radar_scan,
    scan_from_range,
    scan_from_velodyne_scan,
    tf_message,
    transform_from_odometry,
    transforms_from_tf,
)
from ogm.io.messages.plain import ros_stamp
from ogm.pose import pose
from ogm.scan import Scan

HEADER = SimpleNamespace(seq=0, stamp=ros_stamp(START), frame_id="lidar")
RADAR = (  # type and definition: rosbags has none of it
    "radar_msgs/msg/RadarScan",
    "std_msgs/Header header\nradar_msgs/RadarReturn[] returns\n" + "=" * 80 + "\nMSG: radar_msgs/RadarReturn\n"
    "float32 range\nfloat32 azimuth\nfloat32 elevation\nfloat32 doppler_velocity\nfloat32 amplitude\n" + "=" * 80 + "\n"
    "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n" + "=" * 80 + "\n"
    "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
)  # fmt: skip


def _cloud() -> Any:
    scan = Scan(cloud(), stamp=START, ring=np.arange(24) % 4, time=np.linspace(0, 0.1, 24))
    return point_cloud2(scan, frame_id="lidar")


def _organised() -> Any:
    message = _cloud()
    message.height, message.width, message.row_step = 4, 6, 6 * message.point_step
    return message


def _packets() -> Any:
    parts = [SimpleNamespace(stamp=ros_stamp(START), data=np.frombuffer(one, np.uint8)) for one in packets(3)]
    return SimpleNamespace(header=HEADER, packets=parts)


def _livox() -> Any:
    point = message_types(2).types["livox_ros_driver2/msg/CustomPoint"]
    points = [point(k * 5000, *map(float, row[:3]), k, 0, k % 6) for k, row in enumerate(cloud())]
    rest = {"point_num": 24, "lidar_id": 1, "rsvd": np.zeros(3, np.uint8), "points": points}
    return SimpleNamespace(header=HEADER, timebase=int(START) * 10**9, **rest)


def _laser(several: bool = False) -> Any:
    limits = {"angle_min": -1.0, "angle_max": 0.9, "angle_increment": 0.1, "time_increment": 0.001, "scan_time": 0.1}
    ranges = np.array([0.0, np.nan, np.inf, -np.inf, 8.0, *np.linspace(0.2, 7.0, 15)], np.float32)
    bright = np.arange(20, dtype=np.float32)
    if several:
        echo = message_types(2).types["sensor_msgs/msg/LaserEcho"]
        ranges, bright = ([echo(one[[k, -1]]) for k in range(20)] for one in (ranges, bright))
    rest = {"range_min": 0.1, "range_max": 8.0, "ranges": ranges, "intensities": bright}
    return SimpleNamespace(header=HEADER, **limits, **rest)


def _range() -> Any:
    rest = {"radiation_type": 0, "field_of_view": 0.5, "min_range": 0.2, "max_range": 4.0, "range": 1.5}
    return SimpleNamespace(header=HEADER, variance=0.0, **rest)


def _depth_image() -> Any:
    pixels = np.arange(1000, 1048, dtype=np.uint16).view(np.uint8)
    sizes = {"height": 6, "width": 8, "step": 16, "encoding": "16UC1", "is_bigendian": 0}
    return SimpleNamespace(header=HEADER, data=pixels, **sizes)


def _packed_image(encoding: str) -> Any:
    Image.fromarray(np.arange(1000, 1048, dtype=np.uint16).reshape(6, 8)).save(png := BytesIO(), "PNG")
    data = np.frombuffer(struct.pack("<iff", 0, 5000.0, -100.0) + png.getvalue(), np.uint8)
    return SimpleNamespace(header=HEADER, format=f"{encoding}; compressedDepth png", data=data)


def _camera() -> Any:
    k = np.array([50, 0, 3.5, 0, 50, 2.5, 0, 0, 1.0])
    matrices = {"d": np.array([0.1, -0.2, 0.001, -0.001, 0.05]), "k": k, "r": np.eye(3).ravel(), "p": np.zeros(12)}
    roi = SimpleNamespace(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    sizes = {"height": 6, "width": 8, "distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0}
    return SimpleNamespace(header=HEADER, roi=roi, **matrices, **sizes)


def _placed() -> Any:
    turn = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    return SimpleNamespace(position=SimpleNamespace(x=1.0, y=2.0, z=0.5), orientation=turn)


def _odometry() -> Any:
    zero, covariance = SimpleNamespace(x=0.0, y=0.0, z=0.0), np.zeros(36)
    twist = SimpleNamespace(twist=SimpleNamespace(linear=zero, angular=zero), covariance=covariance)
    placed = SimpleNamespace(pose=_placed(), covariance=covariance)
    return SimpleNamespace(header=HEADER, child_frame_id="base_link", pose=placed, twist=twist)


def _radar() -> Any:
    names = ("range", "azimuth", "elevation", "doppler_velocity", "amplitude")
    returns = [SimpleNamespace(**dict(zip(names, (5.0 + k, 0.1 * k, 0.0, -1.0, 20.0), strict=True))) for k in range(8)]
    return SimpleNamespace(header=HEADER, returns=returns)


def _continental() -> dict[str, bytes]:
    """Return a detection list of an ARS548, as ``ros2 topic echo`` prints it and JSON holds it."""
    names = ("azimuth_angle", "elevation_angle", "range", "range_rate", "rcs")
    flags = ("invalid_distance", "invalid_azimuth", "invalid_elevation", "invalid_range_rate")
    rows = [dict(zip(names, (0.1 * k, 0.01 * k, 5.0 + k, -1.0, 10), strict=True)) for k in range(8)]
    header = {"stamp": {"sec": int(START), "nanosec": 5}, "frame_id": "radar"}
    list_ = {"header": header, "detections": [row | dict.fromkeys(flags, k == 3) for k, row in enumerate(rows)]}
    return {"list.json": json.dumps(list_).encode()}


def _continental_list(folder: Path) -> Target:
    """Decode what is JSON; what is none is no message."""
    from ogm.io.reading import read_json

    read = lambda files: check_scan(scan_from_continental(read_json(files / "list.json", dict, "a message")))  # noqa: E731
    return Target(_continental(), read)


def _continental_message(folder: Path) -> Target:
    definition, _, rest = RADAR[1].partition("radar_msgs/RadarReturn[] returns\n")
    definition += "continental_msgs/ContinentalArs548Detection[] detections\n" + "=" * 80 + "\n"
    definition += "MSG: continental_msgs/ContinentalArs548Detection\n"
    definition += "bool invalid_distance\nbool invalid_azimuth\nfloat32 azimuth_angle\nfloat32 elevation_angle\n"
    definition += (
        "float32 range\nfloat32 range_rate\nint8 rcs\n" + "=" * 80 + "\n" + rest[rest.index("MSG: std_msgs") :]
    )
    kind, read = "continental_msgs/msg/ContinentalArs548DetectionList", scan_from_continental
    names = ("invalid_distance", "invalid_azimuth", "azimuth_angle", "elevation_angle", "range", "range_rate", "rcs")
    rows = [(k == 3, False, 0.1 * k, 0.01 * k, 5.0 + k, -1.0, 10) for k in range(8)]
    listed = [SimpleNamespace(**dict(zip(names, row, strict=True))) for row in rows]
    make = lambda: SimpleNamespace(header=HEADER, detections=listed)  # noqa: E731
    return _message(kind, make, lambda message: check_scan(read(message)), 2, folder, definition)


def _tf(transforms: Any) -> None:
    for one in transforms:
        check_poses(one.T_parent_child)


def _placed_grid(found: Any) -> None:
    check_grid(found[0])
    check_poses(found[1])


def _message(
    kind: str, make: Callable[[], Any], read: Callable[[Any], object], ros: int, folder: Path, definition: str = ""
) -> Target:
    definition = RADAR[1] if kind == RADAR[0] else definition
    channel = Channel("/a", kind, "ros1" if ros == 1 else "cdr", definition, "ros2msg")
    store = message_types(ros)
    if definition:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(definition, kind))
    data = bytes((store.serialize_ros1 if ros == 1 else store.serialize_cdr)(make(), kind))
    return Target({"message": data}, lambda raw: read(decode(channel, raw)), in_memory=True)


def _livox_bytes(ros: int, folder: Path) -> Target:
    kind = "livox_ros_driver2/msg/CustomMsg"
    store = message_types(ros)
    data = bytes((store.serialize_ros1 if ros == 1 else store.serialize_cdr)(_livox(), kind))
    return Target({"message": data}, lambda raw: check_scan(scan_from_livox(raw)), in_memory=True)


def _foxglove(make: Callable[[], Any], folder: Path) -> Target:
    data = bytes(foxglove_grid(make(), frame_id="map", stamp=START, T_frame_grid=pose(1.0, 2.0, yaw=0.5)).encode())
    read = lambda raw: _placed_grid(grid_from_foxglove_grid(decode_foxglove_grid(raw)))  # noqa: E731
    return Target({"grid.pb": data}, read, in_memory=True)


def _transforms() -> Any:
    return tf_message([StampedTransform("map", "base_link", START, pose(x=k, yaw=0.1 * k)) for k in range(3)])


_CAMERA = Intrinsics(8, 6, 50.0, 50.0, 3.5, 2.5)
_GRIDS: dict[str, Any] = {"frame_id": "map", "stamp": START, "T_frame_grid": pose(1.0, 2.0, yaw=0.5)}
_MESSAGES: dict[str, tuple[str, Callable[[], Any], Callable[[Any], object]]] = {
    "cloud": (CLOUD, _cloud, lambda message: check_scan(scan_from_point_cloud2(message))),
    "cloud-organised": (CLOUD, _organised, lambda message: check_scan(scan_from_point_cloud2(message))),
    "velodyne": (
        "velodyne_msgs/msg/VelodyneScan", _packets, lambda message: check_scan(scan_from_velodyne_scan(message)),
    ),
    "livox": ("livox_ros_driver2/msg/CustomMsg", _livox, lambda message: check_scan(scan_from_livox(message))),
    "laser": ("sensor_msgs/msg/LaserScan", _laser, lambda message: check_scan(scan_from_laser_scan(message))),
    "lasers": (
        "sensor_msgs/msg/MultiEchoLaserScan", partial(_laser, True),
        lambda message: check_scan(scan_from_laser_scan(message)),
    ),
    "range": ("sensor_msgs/msg/Range", _range, lambda message: check_scan(scan_from_range(message))),
    "depth": (
        "sensor_msgs/msg/Image", _depth_image, lambda message: check_scan(scan_from_depth_image(message, _CAMERA)),
    ),
    **{
        f"depth-{encoding.lower()}": (
            "sensor_msgs/msg/CompressedImage",
            partial(_packed_image, encoding),
            lambda message: check_scan(scan_from_depth_image(message, _CAMERA)),
        )
        for encoding in ("16UC1", "32FC1")
    },
    "camera": (
        "sensor_msgs/msg/CameraInfo",
        _camera,
        lambda message: check_scan(scan_from_depth_image(_depth_image(), intrinsics_from_camera_info(message))),
    ),
    "tf": (TF, _transforms, lambda message: _tf(transforms_from_tf(message))),
    "odometry": ("nav_msgs/msg/Odometry", _odometry, lambda message: _tf([transform_from_odometry(message)])),
    "occupancy": (
        "nav_msgs/msg/OccupancyGrid",
        lambda: occupancy_grid(evidential(), **_GRIDS),
        lambda message: _placed_grid(grid_from_occupancy_grid(message)),
    ),
    "grid-map": (
        "grid_map_msgs/msg/GridMap",
        lambda: grid_map(evidential(), **_GRIDS),
        lambda message: (_placed_grid(grid_from_grid_map(message)), layers_from_grid_map(message)),
    ),
}  # fmt: skip
TARGETS: dict[str, Callable[[Path], Target]] = {
    **{f"message-{name}": partial(_message, *given, 2) for name, given in _MESSAGES.items()},
    **{f"message-{name}-ros1": partial(_message, *_MESSAGES[name], 1) for name in ("cloud", "tf", "grid-map")},
    "message-radar": partial(
        _message, RADAR[0], _radar, lambda message: check_scan(scan_from_radar_scan(message)), 2
    ),
    "message-continental": _continental_message,
    "message-continental-json": _continental_list,
    "message-livox-cdr": partial(_livox_bytes, 2),
    "message-livox-ros1": partial(_livox_bytes, 1),
    "message-foxglove": partial(_foxglove, evidential),
    "message-foxglove-dynamic": partial(_foxglove, dynamic),
}  # fmt: skip
