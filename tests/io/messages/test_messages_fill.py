"""`fill_message`: messages of rospy, made by Debian's genpy, and of rclpy, whose shape is followed here."""

import array
import io
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from ogm.grid import EvidentialGrid, GridSpec
from ogm.io.messages import (
    StampedTransform,
    fill_message,
    grid_from_grid_map,
    grid_from_occupancy_grid,
    grid_map,
    occupancy_grid,
    point_cloud2,
    scan_from_point_cloud2,
    tf_message,
    transforms_from_tf,
)
from ogm.io.messages.grids import occupancy_values
from ogm.pose import pose
from ogm.scan import Scan

GRID = EvidentialGrid(GridSpec(0.5, (3, 2), (1.0, 2.0)), np.arange(12, dtype=np.float32).reshape(3, 2, 2) / 32)
SCAN = Scan(np.array([[1, 2, 3, 0.5], [4, 5, 6, 0]], np.float32), stamp=5.5, ring=[3, 4])


def test_rospy(ros1_class, stores):
    """genpy serialises what was filled in; rosbags reads those bytes as it reads its own."""
    for kind, plain in (
        ("sensor_msgs/msg/PointCloud2", point_cloud2(SCAN, frame_id="lidar")),
        ("nav_msgs/msg/OccupancyGrid", occupancy_grid(GRID, frame_id="map", stamp=3.25)),
        ("grid_map_msgs/msg/GridMap", grid_map(GRID, frame_id="map", stamp=3.25)),
        ("tf2_msgs/msg/TFMessage", tf_message([StampedTransform("a", "b", 9.5, pose(1, 2, 3, yaw=1))])),
    ):
        filled = fill_message(ros1_class(kind)(), plain)
        buffer = io.BytesIO()
        filled.serialize(buffer)
        assert buffer.getvalue() == bytes(stores[1].serialize_ros1(plain, kind))


class _Ros2:
    """As rosidl's Python classes: properties check their values, sequences of numbers are ``array.array``."""

    FIELDS: dict = {}

    def __init__(self):
        for name, kind in self.FIELDS.items():
            object.__setattr__(self, name, self._initial(kind))

    @staticmethod
    def _initial(kind):
        if kind.startswith("sequence<"):
            inner = kind[9:-1]
            codes = {"uint8": "B", "int8": "b", "float": "f"}
            return array.array(codes[inner]) if inner in codes else []
        plain = {"string": "", "boolean": False, "float": 0.0, "double": 0.0}
        if "/" in kind:
            return _classes()[kind]()
        return plain.get(kind, 0)

    @classmethod
    def get_fields_and_field_types(cls):
        return dict(cls.FIELDS)

    def __setattr__(self, name, value):
        kind, now = self.FIELDS[name], getattr(self, name)  # an unknown name is an error, as with __slots__
        assert type(value) is type(now), f"{name} of {kind} got {type(value)}"
        if isinstance(now, array.array):
            assert value.typecode == now.typecode
        if kind.startswith("sequence<") and "/" in kind:
            assert all(type(one) is _classes()[kind[9:-1]] for one in value)
        object.__setattr__(self, name, value)


DEFINITIONS = {
    "builtin_interfaces/Time": {"sec": "int32", "nanosec": "uint32"},
    "std_msgs/Header": {"stamp": "builtin_interfaces/Time", "frame_id": "string"},
    "sensor_msgs/PointField": {"name": "string", "offset": "uint32", "datatype": "uint8", "count": "uint32"},
    "sensor_msgs/PointCloud2": {
        "header": "std_msgs/Header", "height": "uint32", "width": "uint32",
        "fields": "sequence<sensor_msgs/PointField>", "is_bigendian": "boolean", "point_step": "uint32",
        "row_step": "uint32", "data": "sequence<uint8>",
        "is_dense": "boolean",
    },
    "geometry_msgs/Point": {"x": "double", "y": "double", "z": "double"},
    "geometry_msgs/Vector3": {"x": "double", "y": "double", "z": "double"},
    "geometry_msgs/Quaternion": {"x": "double", "y": "double", "z": "double", "w": "double"},
    "geometry_msgs/Pose": {"position": "geometry_msgs/Point", "orientation": "geometry_msgs/Quaternion"},
    "geometry_msgs/Transform": {"translation": "geometry_msgs/Vector3", "rotation": "geometry_msgs/Quaternion"},
    "geometry_msgs/TransformStamped": {
        "header": "std_msgs/Header", "child_frame_id": "string", "transform": "geometry_msgs/Transform",
    },
    "tf2_msgs/TFMessage": {"transforms": "sequence<geometry_msgs/TransformStamped>"},
    "nav_msgs/MapMetaData": {
        "map_load_time": "builtin_interfaces/Time", "resolution": "float", "width": "uint32", "height": "uint32",
        "origin": "geometry_msgs/Pose",
    },
    "nav_msgs/OccupancyGrid": {"header": "std_msgs/Header", "info": "nav_msgs/MapMetaData", "data": "sequence<int8>"},
    "std_msgs/MultiArrayDimension": {"label": "string", "size": "uint32", "stride": "uint32"},
    "std_msgs/MultiArrayLayout": {"dim": "sequence<std_msgs/MultiArrayDimension>", "data_offset": "uint32"},
    "std_msgs/Float32MultiArray": {"layout": "std_msgs/MultiArrayLayout", "data": "sequence<float>"},
    "grid_map_msgs/GridMapInfo": {
        "resolution": "double", "length_x": "double", "length_y": "double", "pose": "geometry_msgs/Pose",
    },
    "grid_map_msgs/GridMap": {
        "header": "std_msgs/Header", "info": "grid_map_msgs/GridMapInfo", "layers": "sequence<string>",
        "basic_layers": "sequence<string>", "data": "sequence<std_msgs/Float32MultiArray>",
        "outer_start_index": "uint16", "inner_start_index": "uint16",
    },
}  # fmt: skip
_CACHE: dict[str, type] = {}


def _classes():
    if not _CACHE:
        _CACHE.update({full: type(full.split("/")[1], (_Ros2,), {"FIELDS": f}) for full, f in DEFINITIONS.items()})
    return _CACHE


@pytest.fixture
def ros2(monkeypatch):
    for full, kind in _classes().items():
        package, name = full.split("/")
        module = sys.modules.get(f"{package}.msg")
        if module is None or not hasattr(module, "OF_THIS_TEST"):
            module = ModuleType(f"{package}.msg")
            module.OF_THIS_TEST = True
            monkeypatch.setitem(sys.modules, f"{package}.msg", module)
        setattr(module, name, kind)
    return lambda full: _classes()[full]()


def test_rclpy(ros2):
    cloud = fill_message(ros2("sensor_msgs/PointCloud2"), point_cloud2(SCAN, frame_id="lidar"))
    back = scan_from_point_cloud2(cloud)
    np.testing.assert_array_equal(back.points, SCAN.points)
    np.testing.assert_array_equal(back.ring, SCAN.ring)
    assert (back.stamp, cloud.header.frame_id) == (5.5, "lidar")
    grid = fill_message(ros2("nav_msgs/OccupancyGrid"), occupancy_grid(GRID, frame_id="map", stamp=3.25))
    np.testing.assert_array_equal(occupancy_values(grid_from_occupancy_grid(grid)[0]), occupancy_values(GRID))
    layers = fill_message(ros2("grid_map_msgs/GridMap"), grid_map(GRID, frame_id="map"))
    assert grid_from_grid_map(layers)[0] == GRID
    moved = fill_message(ros2("tf2_msgs/TFMessage"), tf_message([StampedTransform("a", "b", 9.5, pose(1, yaw=1))]))
    assert transforms_from_tf(moved)[0][:3] == ("a", "b", 9.5)


def test_fields_that_a_message_lacks_are_left_out(ros2):
    header = fill_message(
        ros2("std_msgs/Header"), SimpleNamespace(seq=4, stamp=SimpleNamespace(sec=1, nanosec=2), frame_id="a")
    )
    assert (header.frame_id, header.stamp.sec, header.stamp.nanosec) == ("a", 1, 2)
