"""`LogWriter`: messages to an MCAP, a ROS 2 bag or a ROS 1 bag, written in one step."""

import errno
import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

from ogm.io.logs.definitions import LOG_ENDINGS, message_types
from ogm.io.messages.plain import ros_stamp
from ogm.io.reading import optional
from ogm.storage.files import FilePath, OgmError, atomic_write, errors_with_path, replaced_path
from ogm.storage.whole_path import whole_path

_FOREVER = {"sec": 9223372036, "nsec": 854775807}
_TRANSIENT_LOCAL = (  # QoS of a ROS 2 topic that is kept for late subscribers
    "- history: 1\n  depth: 100\n  reliability: 1\n  durability: 1\n  deadline: {0}\n  lifespan: {0}\n"
    "  liveliness: 1\n  liveliness_lease_duration: {0}\n  avoid_ros_namespace_conventions: false"
).format("{{sec: {sec}, nsec: {nsec}}}".format(**_FOREVER))

Write = Callable[[str, str, Any, int], None]


class LogWriter:
    """Writer of a log: ``.mcap`` (ROS 2), ``.db3`` (ROS 2, one file without metadata.yaml) or ``.bag`` (ROS 1).

    A context manager: the file appears under its name at the end of the ``with`` block. An error inside the block
    leaves an existing file unchanged.

    Parameters
    ----------
    path : path
        Path in an existing folder.
    compression : {"", "zstd"}
        Compression of the chunks of an MCAP. ROS 1 bags are not packed, as other readers refuse packed bags of this
        writer.

    Raises
    ------
    ValueError
        If the ending is not supported, or does not support the compression.
    FileNotFoundError
        If there is no such folder.

    Examples
    --------
    >>> with LogWriter("map.mcap") as log:                                                # doctest: +SKIP
    ...     log.write("/map", "nav_msgs/msg/OccupancyGrid", occupancy_grid(grid, frame_id="map"), stamp)
    """

    def __init__(self, path: FilePath, compression: str = "") -> None:
        self.path, self._compression = Path(path), compression
        ending = self.path.suffix.lower()
        if ending not in LOG_ENDINGS:
            raise ValueError(f"cannot write a log to {path}: name it {', '.join(LOG_ENDINGS)}")
        if compression not in ("", "zstd") or (compression and ending != ".mcap"):
            raise ValueError(f"compression must be '', or 'zstd' for .mcap, got {compression!r} for {path}")
        if replaced_path(path)[0].is_dir():
            raise IsADirectoryError(f"cannot write {path}: it is a folder; give a file name")
        self._ending, self._stack = ending, ExitStack()
        self._write: Write | None = None

    def __enter__(self) -> Self:
        begin = self._begin_mcap if self._ending == ".mcap" else self._begin_rosbag
        with self._explained(), ExitStack() as stack:
            self._write = begin(stack)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: Any) -> bool | None:
        self._write = None
        with self._explained():
            return self._stack.__exit__(*error)

    def write(self, topic: str, type: str, message: Any, stamp: float) -> None:
        """Write a message.

        Parameters
        ----------
        topic : str
        type : str
            Type name as in ROS 2, such as nav_msgs/msg/OccupancyGrid, also for ROS 1 bags; or a Foxglove schema, such
            as foxglove.Grid, for MCAP.
        message : object
            Message with the field names of the type, and numpy arrays for arrays of numbers: from `ogm.io.messages`,
            `LogMessage.decode` or rosbags. Additional fields of ROS 1 (``seq``) are added. For a Foxglove schema, a
            message of foxglove-sdk.
        stamp : float
            Log time [s].

        Raises
        ------
        OgmError
            If the type is unknown, or the message does not fit it.
        """
        if self._write is None:
            raise ValueError(f"{self.path} is not open for writing: write inside of the with block")
        at = ros_stamp(stamp)
        with self._explained():
            self._write(topic, type, message, at.sec * 10**9 + at.nanosec)

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Add the path of the log to errors of a full or broken disk."""
        try:
            with errors_with_path(self.path):
                yield
        except sqlite3.OperationalError as error:  # ROS 2 bags
            if not self.path.parent.is_dir():
                raise FileNotFoundError(f"{self.path} is lost: its folder was removed during writing") from error
            raise OSError(errno.EIO, f"{error}: check for a full disk", str(self.path)) from error

    def _serialized(self, topic: str, name: str, message: Any, ros: int) -> memoryview:
        """Return the serialised message."""
        store = message_types(ros)
        try:
            if name not in store.fielddefs:
                raise OgmError("its type is unknown")
            if ros == 1:
                return memoryview(store.serialize_ros1(_for_ros1(message, name, store), name))
            return memoryview(store.serialize_cdr(message, name))
        except Exception as error:  # generated code raises various errors for fields that do not fit
            raise OgmError(f"{self.path}: a message for {topic} ({name}) cannot be written: {error}") from error

    def _begin_mcap(self, stack: ExitStack) -> Write:
        optional("mcap", self.path, "ros", "written")
        from mcap.writer import CompressionType, Writer

        packing = CompressionType.ZSTD if self._compression else CompressionType.NONE
        writer: Any = Writer(stack.enter_context(atomic_write(self.path)), compression=packing)
        writer.start(profile="ros2", library="ogm")
        stack.push(lambda kind, *_: writer.finish() if kind is None else None)
        schemas: dict[str, int] = {}
        channels: dict[tuple[str, str], int] = {}

        def write(topic: str, name: str, message: Any, time: int) -> None:
            ros = not hasattr(message, "get_schema")
            data = self._serialized(topic, name, message, 2) if ros else message.encode()
            if name not in schemas:
                if ros:  # includes the definitions of its parts
                    form, text = "ros2msg", message_types(2).generate_msgdef(name, ros_version=2)[0].encode()
                else:
                    form, text = "protobuf", message.get_schema().data
                schemas[name] = writer.register_schema(name, form, text)
            if (topic, name) not in channels:
                facts = {"offered_qos_profiles": _TRANSIENT_LOCAL if _is_latched(topic, name) else ""} if ros else {}
                encoding = "cdr" if ros else "protobuf"
                channels[topic, name] = writer.register_channel(topic, encoding, schemas[name], facts)
            writer.add_message(channels[topic, name], time, bytes(data), time)

        return write

    def _begin_rosbag(self, stack: ExitStack) -> Write:
        """Begin a bag of ROS 1 (``.bag``) or ROS 2 (``.db3``)."""
        optional("rosbags", self.path, "ros", "written")
        from rosbags import rosbag1, rosbag2
        from rosbags.rosbag2.metadata import parse_qos

        ros: int = 1 if self._ending == ".bag" else 2
        writer: Any
        path = stack.enter_context(whole_path(self.path))
        if ros == 1:
            writer = rosbag1.Writer(path)
            stack.callback(_close, writer)
        else:
            folder = path.with_suffix("")
            stack.push(partial(_move, folder / f"{folder.name}.db3", path))
            writer = rosbag2.Writer(folder, version=8, storage_plugin=rosbag2.StoragePlugin.SQLITE3)
        stack.enter_context(writer)
        connections: dict[tuple[str, str], Any] = {}

        def write(topic: str, name: str, message: Any, time: int) -> None:
            data = self._serialized(topic, name, message, ros)
            if (topic, name) not in connections:
                latched = _is_latched(topic, name)
                profiles = {"offered_qos_profiles": parse_qos(_TRANSIENT_LOCAL) if latched else []}
                facts: Any = {"latching": int(latched)} if ros == 1 else profiles
                connections[topic, name] = writer.add_connection(topic, name, typestore=message_types(ros), **facts)
            writer.write(connections[topic, name], time, data)

        return write


def _move(written: Path, path: Path, kind: Any, *_: object) -> None:
    """Move a file if nothing failed."""
    if kind is None:
        os.replace(written, path)


def _close(writer: Any) -> None:
    """Close the file of a ROS 1 bag, which rosbags leaves open on a full disk."""
    if writer.bio is not None:
        with suppress(OSError):
            writer.bio.close()


def _is_latched(topic: str, name: str) -> bool:
    """Return whether late subscribers get earlier messages, as expected for static transforms and maps."""
    return topic == "/tf_static" or name in ("nav_msgs/msg/OccupancyGrid", "nav2_msgs/msg/Costmap")


def _for_ros1(message: Any, name: str, store: Any, header: Any = None) -> Any:
    """Return a message with the additional fields of ROS 1: ``seq`` of headers, and the header in a GridMap's info."""
    from rosbags.interfaces import Nodetype

    header = getattr(message, "header", header)
    fields: dict[str, Any] = {}
    for field, (kind, inner) in store.fielddefs[name][1]:
        if name == "std_msgs/msg/Header" and field == "seq":
            fields[field] = getattr(message, field, 0)
            continue
        value = getattr(message, field, header) if field == "header" else getattr(message, field)
        if value is None:
            raise OgmError(f"it has no {field}")
        if kind == Nodetype.NAME:
            value = _for_ros1(value, inner, store, header)
        elif kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) and inner[0][0] == Nodetype.NAME:
            value = [_for_ros1(element, inner[0][1], store, header) for element in value]
        fields[field] = value
    return SimpleNamespace(**fields)
