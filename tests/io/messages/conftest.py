"""Messages as other libraries make them: what rosbags and mcap-ros2-support read of ours, and write for us."""

import io
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

GRID_MAP = "string[] layers\nstring[] basic_layers\nstd_msgs/Float32MultiArray[] data\n"
GRID_MAP += "uint16 outer_start_index\nuint16 inner_start_index"
SIZES = "float64 resolution\nfloat64 length_x\nfloat64 length_y\ngeometry_msgs/Pose pose"
LIVOX = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line"
DRIVERS = {
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nVelodynePacket[] packets",
    "livox_ros_driver2/msg/CustomPoint": LIVOX,
    "livox_ros_driver2/msg/CustomMsg": "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\n"
    "uint8[3] rsvd\nCustomPoint[] points",
    "radar_msgs/msg/RadarReturn": "float32 range\nfloat32 azimuth\nfloat32 elevation\nfloat32 doppler_velocity\n"
    "float32 amplitude",
    "radar_msgs/msg/RadarScan": "std_msgs/Header header\nradar_msgs/RadarReturn[] returns",
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
}
OF_RELEASE = {
    1: {
        "grid_map_msgs/msg/GridMapInfo": f"std_msgs/Header header\n{SIZES}",
        "grid_map_msgs/msg/GridMap": f"GridMapInfo info\n{GRID_MAP}",
    },
    2: {
        "grid_map_msgs/msg/GridMapInfo": SIZES,
        "grid_map_msgs/msg/GridMap": f"std_msgs/Header header\nGridMapInfo info\n{GRID_MAP}",
        "nav2_msgs/msg/CostmapMetaData": "builtin_interfaces/Time map_load_time\nbuiltin_interfaces/Time update_time\n"
        "string layer\nfloat32 resolution\nuint32 size_x\nuint32 size_y\ngeometry_msgs/Pose origin",
        "nav2_msgs/msg/Costmap": "std_msgs/Header header\nnav2_msgs/CostmapMetaData metadata\nuint8[] data",
    },
}


@pytest.fixture(scope="session")
def stores() -> dict[int, Any]:
    """Give the message types of ROS 1 and ROS 2 of rosbags, with those of drivers."""
    typesys = pytest.importorskip("rosbags.typesys")
    result = {}
    for ros, name in ((1, "ROS1_NOETIC"), (2, "ROS2_HUMBLE")):
        result[ros] = typesys.get_typestore(typesys.Stores[name])
        for kind, text in (DRIVERS | OF_RELEASE[ros]).items():
            if kind not in result[ros].fielddefs:
                result[ros].register(typesys.get_types_from_msg(text, kind))
    return result


@pytest.fixture(scope="session")
def sent(stores) -> Callable[[Any, str, int], Any]:
    """Give what arrives of a message: its bytes, written and read by rosbags as ROS 1 or ROS 2."""

    def send(message: Any, kind: str, ros: int = 2) -> Any:
        store = stores[ros]
        if ros == 1:
            return store.deserialize_ros1(store.serialize_ros1(message, kind), kind)
        return store.deserialize_cdr(store.serialize_cdr(message, kind), kind)

    return send


@pytest.fixture(scope="session")
def by_mcap(stores) -> Callable[[Any, str], Any]:
    """Give what mcap-ros2-support reads of a message that rosbags serialised."""
    pytest.importorskip("mcap_ros2")
    from mcap.reader import make_reader
    from mcap.writer import Writer
    from mcap_ros2.decoder import DecoderFactory

    def send(message: Any, kind: str) -> Any:
        store, file = stores[2], io.BytesIO()
        writer = Writer(file)
        writer.start(profile="ros2")
        definition, _ = store.generate_msgdef(kind, ros_version=2)
        schema = writer.register_schema(kind, "ros2msg", definition.encode())
        channel = writer.register_channel("/topic", "cdr", schema)
        writer.add_message(channel, 0, bytes(store.serialize_cdr(message, kind)), 0)
        writer.finish()
        file.seek(0)
        ((*_, decoded),) = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        return decoded

    return send


@pytest.fixture(scope="session")
def ros1_class(stores) -> Callable[[str], type]:
    """Give message classes of ROS 1 as Debian's own generator (genpy) makes them from a definition."""
    debian = Path("/usr/lib/python3/dist-packages")
    if not (debian / "genpy").is_dir():
        pytest.skip("no genpy of Debian (python3-genpy)")
    for name in ("genmsg", "genpy"):  # these two alone, for there is another numpy beside them
        if name not in sys.modules:
            import importlib.util

            spec = importlib.util.spec_from_file_location(
                name, debian / name / "__init__.py", submodule_search_locations=[str(debian / name)]
            )
            module = sys.modules[name] = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
    dynamic = pytest.importorskip("genpy.dynamic")

    def make(kind: str) -> type:
        definition, _ = stores[1].generate_msgdef(kind, ros_version=1)
        classes = dynamic.generate_dynamic(kind.replace("/msg/", "/"), definition)
        for full, one in classes.items():
            package, name = full.split("/")
            module = sys.modules.setdefault(f"{package}.msg", ModuleType(f"{package}.msg"))
            setattr(module, name, one)
        return classes[kind.replace("/msg/", "/")]

    return make
