"""Common parts of all kinds of logs: channels, an index of messages, and message types."""

import os
import re
import struct
import weakref
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ogm.io.reading import optional
from ogm.storage.files import OgmError

Place = tuple[int, int]
"""Place of a message: two numbers with a meaning for its file."""

LOG_ENDINGS = (".mcap", ".db3", ".bag")
_UNFINISHED = ".active"  # suffix added by recorders until a log is finished


class Channel(NamedTuple):
    """A topic of a file.

    Attributes
    ----------
    topic : str
    type : str
        Name as in ROS 2: sensor_msgs/msg/PointCloud2.
    encoding : str
        "cdr" (ROS 2), "ros1", or another encoding, which is not decoded.
    definition : str
        Definition of the type; "" if missing in the file.
    format : str
        Format of the definition: "ros1msg", "ros2msg", "ros2idl".
    """

    topic: str
    type: str
    encoding: str
    definition: str = ""
    format: str = ""


class LogFile(Protocol):
    """One file of a log. Opening it indexes its messages, 24 bytes each, and decodes none.

    Attributes
    ----------
    format : str
        Name of the file format.
    channels : dict of int to Channel
    index : dict of int to (K, 3) int64
        Log times [ns] and places of the messages by channel, in the order of the file.
    warnings : list of str
        Damaged or missing parts.
    """

    format: str
    channels: dict[int, Channel]
    index: dict[int, NDArray[np.int64]]
    warnings: list[str]

    def read(self, place: Place, size: int | None = None) -> bytes | memoryview:
        """Return the message at a place, or its first `size` bytes; raise `OgmError` if it is damaged."""
        ...


class RandomAccess:
    """File for concurrent reading by threads and forked processes; closed with its last reference."""

    def __init__(self, path: Path) -> None:
        file = os.open(path, os.O_RDONLY | getattr(os, "O_CLOEXEC", 0))
        self._file, self.size = file, os.fstat(file).st_size
        weakref.finalize(self, os.close, file)

    def read(self, start: int, size: int) -> bytes:
        """Return up to `size` bytes from `start` on; none before the beginning or after the end."""
        if not 0 <= start <= self.size or size < 0:
            return b""
        return os.pread(self._file, size, start)


def log_ending(path: Path) -> str:
    """Return the ending of a log's name in lower case, also for ``drive.bag.active``; "" for other files."""
    ending = Path(path.name.lower().removesuffix(_UNFINISHED)).suffix
    return ending if ending in LOG_ENDINGS else ""


def log_files(folder: Path) -> list[Path]:
    """Return the parts of a log in a folder, with part 2 before part 10.

    Raises
    ------
    OgmError
        If the folder has logs of several kinds.
    """
    files = [file for file in folder.iterdir() if log_ending(file) and file.is_file()]
    if len({log_ending(file) for file in files}) > 1:
        names = ", ".join(sorted(file.name for file in files))
        raise OgmError(f"{folder} holds logs of several kinds ({names}): give one of them")
    return sorted(files, key=lambda file: [int(p) if p.isdecimal() else p for p in re.split(r"(\d+)", file.name)])


def ros2_name(name: str) -> str:
    """Return a type's name as in ROS 2: sensor_msgs/PointCloud2 is sensor_msgs/msg/PointCloud2.

    Names of DDS are supported, too: sensor_msgs::msg::dds_::PointCloud2_.
    """
    if "::dds_::" in name:
        name = name.replace("::dds_::", "::").replace("::", "/").removesuffix("_")
    package, slash, rest = name.partition("/")
    return f"{package}/msg/{rest}" if slash and "/" not in rest else name


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
    "map_msgs/msg/OccupancyGridUpdate": "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\n"
    "int8[] data",
    "nav2_msgs/msg/CostmapMetaData": "builtin_interfaces/Time map_load_time\nbuiltin_interfaces/Time update_time\n"
    "string layer\nfloat32 resolution\nuint32 size_x\nuint32 size_y\ngeometry_msgs/Pose origin",
    "nav2_msgs/msg/Costmap": "std_msgs/Header header\nCostmapMetaData metadata\nuint8[] data",
    **{f"{package}/msg/{name}": text for package in ("livox_ros_driver", "livox_ros_driver2")
       for name, text in _LIVOX.items()},
}  # fmt: skip
_SIZES = "float64 resolution\nfloat64 length_x\nfloat64 length_y\ngeometry_msgs/Pose pose"
_LAYERS = (
    "string[] layers\nstring[] basic_layers\nstd_msgs/Float32MultiArray[] data\nuint16 outer_start_index\n"
    "uint16 inner_start_index"
)
_OURS = {
    1: {
        **_BOTH,
        **dict.fromkeys(("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"), "geometry_msgs/TransformStamped[] transforms"),
        "grid_map_msgs/msg/GridMapInfo": f"std_msgs/Header header\n{_SIZES}",
        "grid_map_msgs/msg/GridMap": f"GridMapInfo info\n{_LAYERS}",
    },
    2: {
        **_BOTH,
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
        Types of Noetic, or of the latest ROS 2, and of velodyne_msgs, livox_ros_driver, livox_ros_driver2, radar_msgs,
        map_msgs, nav2_msgs, grid_map_msgs, and for ROS 1 tf2_msgs and tf.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.LATEST)
    for name, text in _OURS[ros].items():
        if name not in store.fielddefs:
            store.register(get_types_from_msg(text, name))
    return store


def decode(channel: Channel, raw: bytes | memoryview) -> Any:
    """Decode a message by the definition in its log, or by `message_types` if that is missing or wrong.

    Raises
    ------
    OgmError
        If it is no ROS message, its type is unknown, or its bytes do not fit the type.
    """
    optional("rosbags", Path(channel.topic), "ros")
    if (ros := {"ros1": 1, "cdr": 2}.get(channel.encoding)) is None:
        raise OgmError(f"messages of {channel.type} have {channel.encoding or 'no'} encoding, wanted ROS messages")
    if channel.definition:
        try:
            return _decoded(_types_of(channel.type, channel.definition, channel.format), channel.type, ros, raw)
        except OgmError:
            if channel.type not in message_types(ros).fielddefs:
                raise
    return _decoded(message_types(ros), channel.type, ros, raw)


def _decoded(store: Any, name: str, ros: int, raw: bytes | memoryview) -> Any:
    """Decode a message by the types of a store."""
    from rosbags.serde import SerdeError
    from rosbags.typesys import TypesysError

    try:
        if isinstance(store, str):
            raise OgmError(store)
        if name not in store.fielddefs:
            raise OgmError(f"the type {name} is unknown, and the log does not define it")
        return (store.deserialize_ros1 if ros == 1 else store.deserialize_cdr)(memoryview(raw), name)
    except (SerdeError, TypesysError, KeyError, ValueError, AssertionError, IndexError, struct.error) as error:
        raise error if isinstance(error, OgmError) else OgmError(f"it is no complete {name}: {error}") from error


@lru_cache(maxsize=256)
def _types_of(name: str, definition: str, form: str) -> Any:
    """Return a typestore of the types in a definition, or the text of an error."""
    from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    try:
        if "idl" not in form:
            store.register(get_types_from_msg(definition, name))
            return store
        parts = [part.partition("\n")[2] for part in definition.split(_IDL_MARK)[1:]] or [definition]
        types: dict[str, Any] = {}
        for part in parts:
            types |= get_types_from_idl(part.removesuffix("=" * 80 + "\n"))
        store.register(types)
    except (TypesysError, KeyError, ValueError, AssertionError, IndexError) as error:
        return f"it is no complete {name}: {error}"
    return store
