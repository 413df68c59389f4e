"""Message types: those that `rosbags` has of ROS 1 and ROS 2, and those of drivers that logs often lack."""

import struct
from functools import lru_cache
from pathlib import Path
from typing import Any

from ogm.io.logs.files import Channel
from ogm.io.reading import optional
from ogm.storage.files import OgmError

_LIVOX = {
    "CustomPoint": "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line",
    "CustomMsg": "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "CustomPoint[] points",
}
_BOTH = {
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nVelodynePacket[] packets",
    "radar_msgs/msg/RadarReturn": "float32 range\nfloat32 azimuth\nfloat32 elevation\nfloat32 doppler_velocity\n"
    "float32 amplitude",
    "radar_msgs/msg/RadarScan": "std_msgs/Header header\nRadarReturn[] returns",
    **{f"{package}/msg/{name}": text for package in ("livox_ros_driver", "livox_ros_driver2")
       for name, text in _LIVOX.items()},
}  # fmt: skip
_SIZES = "float64 resolution\nfloat64 length_x\nfloat64 length_y\ngeometry_msgs/Pose pose"
_LAYERS = (
    "string[] layers\nstring[] basic_layers\nstd_msgs/Float32MultiArray[] data\nuint16 outer_start_index\n"
    "uint16 inner_start_index"
)
_TRANSFORMS = "geometry_msgs/TransformStamped[] transforms"
_OURS = {
    1: _BOTH
    | {
        "tf2_msgs/msg/TFMessage": _TRANSFORMS,
        "tf/msg/tfMessage": _TRANSFORMS,
        "grid_map_msgs/msg/GridMapInfo": f"std_msgs/Header header\n{_SIZES}",
        "grid_map_msgs/msg/GridMap": f"GridMapInfo info\n{_LAYERS}",
    },
    2: _BOTH
    | {
        "grid_map_msgs/msg/GridMapInfo": _SIZES,
        "grid_map_msgs/msg/GridMap": f"std_msgs/Header header\nGridMapInfo info\n{_LAYERS}",
    },
}
_IDL_MARK = "=" * 80 + "\nIDL: "


@lru_cache
def message_types(ros: int) -> Any:
    """Return the message types that need no definition in a log, as a typestore of `rosbags`.

    Parameters
    ----------
    ros : {1, 2}
        Those of Noetic, or of the latest ROS 2, with those of velodyne_msgs, livox_ros_driver, livox_ros_driver2,
        radar_msgs, grid_map_msgs, and of ROS 1 tf2_msgs and tf.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.LATEST)
    for name, text in _OURS[ros].items():
        if name not in store.fielddefs:
            store.register(get_types_from_msg(text, name))
    return store


def decode(channel: Channel, raw: bytes | memoryview) -> Any:
    """Decode a message by the definition in its log, or by `message_types` if there is none.

    Raises
    ------
    OgmError
        If it is no ROS message, its type is not known, or its bytes do not fit the type.
    """
    optional("rosbags", Path(channel.topic), "ros")
    from rosbags.serde import SerdeError
    from rosbags.typesys import TypesysError

    ros = {"ros1": 1, "cdr": 2}.get(channel.encoding)
    if ros is None:
        raise OgmError(f"messages of {channel.type} are {channel.encoding or 'of no encoding'}, wanted those of ROS")
    try:
        store = (
            _types_of(channel.type, channel.definition, channel.format) if channel.definition else message_types(ros)
        )
        if channel.type not in store.fielddefs:
            raise OgmError(f"the type {channel.type} is not known, and the log does not define it")
        return (store.deserialize_ros1 if ros == 1 else store.deserialize_cdr)(memoryview(raw), channel.type)
    except (SerdeError, TypesysError, KeyError, ValueError, AssertionError, IndexError, struct.error) as error:
        raise error if isinstance(error, OgmError) else OgmError(f"it is no whole {channel.type}: {error}") from error


@lru_cache(maxsize=256)
def _types_of(name: str, definition: str, form: str) -> Any:
    """Return a typestore of the types that one definition holds."""
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    if "idl" not in form:
        store.register(get_types_from_msg(definition, name))
        return store
    parts = [one.partition("\n")[2] for one in definition.split(_IDL_MARK)[1:]] or [definition]
    types: dict[str, Any] = {}
    for part in parts:
        types |= get_types_from_idl(part.removesuffix("=" * 80 + "\n"))
    store.register(types)
    return store
