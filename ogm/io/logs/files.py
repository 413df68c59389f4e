"""What the files of all kinds of logs have in common: channels, an index of their messages, and reading by it."""

import os
import weakref
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Place = tuple[int, int]
"""Where a message lies: two numbers that its file understands."""


class Channel(NamedTuple):
    """A topic of a file.

    Attributes
    ----------
    topic : str
    type : str
        As in ROS 2: sensor_msgs/msg/PointCloud2.
    encoding : str
        "cdr" (ROS 2), "ros1", or another one, whose messages are not decoded.
    definition : str
        Of the type; "" where the file has none.
    format : str
        Of the definition: "ros1msg", "ros2msg", "ros2idl".
    """

    topic: str
    type: str
    encoding: str
    definition: str = ""
    format: str = ""


class LogFile(Protocol):
    """One file of a log: opening it makes an index of its messages, of 24 bytes each, and decodes none.

    Attributes
    ----------
    format : str
        In words.
    channels : dict of int to Channel
    index : dict of int to (K, 3) int64
        By channel: the log times [ns] and places of its messages, in the order of the file.
    warnings : list of str
        What is damaged or missing.
    """

    format: str
    channels: dict[int, Channel]
    index: dict[int, NDArray[np.int64]]
    warnings: list[str]

    def read(self, place: Place, size: int | None = None) -> bytes | memoryview:
        """Return the message at a place, or its first `size` bytes; raise `OgmError` where it is damaged."""
        ...


class RandomAccess:
    """A file that threads and forked processes may read at the same time; it is closed with its last reference."""

    def __init__(self, path: Path) -> None:
        file = os.open(path, os.O_RDONLY | getattr(os, "O_CLOEXEC", 0))
        self._file, self.size = file, os.fstat(file).st_size
        weakref.finalize(self, os.close, file)

    def read(self, start: int, size: int) -> bytes:
        """Return `size` bytes from `start` on, or as many as there are: none before its begin or after its end."""
        if not 0 <= start <= self.size or size < 0:
            return b""
        return os.pread(self._file, size, start)


def ros2_name(name: str) -> str:
    """Return a type's name as ROS 2 writes it: sensor_msgs/PointCloud2 is sensor_msgs/msg/PointCloud2."""
    package, slash, rest = name.partition("/")
    return f"{package}/msg/{rest}" if slash and "/" not in rest else name
