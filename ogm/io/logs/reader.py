"""Reader of logs: messages by topic in the order of their log times, or by their places."""

import os
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from ogm.io.logs.bag_file import BAG_MAGIC, BagFile
from ogm.io.logs.db3_file import DB3_MAGIC, Db3File
from ogm.io.logs.definitions import LOG_ENDINGS, Channel, LogFile, decode, log_files
from ogm.io.logs.mcap_file import MCAP_MAGIC, McapFile
from ogm.io.transforms import frame_name
from ogm.storage.files import FilePath, OgmError, error_context

_ROWS = 10_000  # rows of the index converted to objects at once
_HEAD = 512  # [byte] that contain the header of a message, for frame names of usual length


@dataclass(frozen=True)
class TopicFacts:
    """Facts about a topic of a log.

    Attributes
    ----------
    type : str
        Name as in ROS 2: sensor_msgs/msg/PointCloud2.
    count : int
        Number of messages.
    rate : float
        Mean messages per second, by log time [Hz]; NaN for fewer than two.
    first, last : float
        Log times [s].
    """

    type: str
    count: int
    rate: float
    first: float
    last: float


class MessageRef(NamedTuple):
    """Position of a message: file, channel, log time [ns] and place in the file."""

    file: int
    channel: int
    log_time: int
    place: tuple[int, int]


class MessageHead(NamedTuple):
    """The header of a message."""

    time: int  # stamp [ns]
    stamp: float  # stamp [s]
    frame: str


@dataclass(frozen=True, slots=True)
class LogMessage:
    """A raw message of a log.

    Attributes
    ----------
    topic, type : str
    log_time : float
        Time of recording [s]: later than the measurement, which has the header's stamp.
    raw : bytes or memoryview
        Serialised message: CDR (ROS 2) or ROS 1.
    channel : Channel
        Channel with encoding and definition.
    """

    topic: str
    type: str
    log_time: float
    raw: bytes | memoryview
    channel: Channel

    def decode(self) -> Any:
        """Return the message as an object with its field names and numpy arrays.

        Raises
        ------
        OgmError
            If it is no ROS message, its type is unknown, or it is damaged.
        """
        with error_context(f"a message of {self.topic} cannot be read", OgmError):
            return decode(self.channel, self.raw)


class LogReader:
    """Reader of a log, created by `open_log`. A context manager.

    Opening it indexes all messages, 24 bytes each, without reading messages unless the file is cut. Threads may share
    a reader.

    Attributes
    ----------
    topics : dict of str to TopicFacts
    format : str
        Name of the file format.
    warnings : list of str
        Damaged or missing parts; reading may add some.
    """

    def __init__(self, paths: Sequence[Path], files: Sequence[LogFile]) -> None:
        self.paths, self._files = tuple(paths), list(files)
        self.format = ", ".join(dict.fromkeys(file.format for file in self._files))
        self.warnings = [warning for file in self._files for warning in file.warnings]
        self.topics = self._topics()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files; further reading is an error."""
        self._files = []

    def refs(self, topics: Iterable[str] | None = None, start: float | None = None) -> list[MessageRef]:
        """Return the positions of messages in the order of their log times; see `messages`."""
        return list(self.iter_refs(topics, start))

    def iter_refs(self, topics: Iterable[str] | None = None, start: float | None = None) -> Iterator[MessageRef]:
        """Yield the positions of messages in the order of their log times; see `messages`."""
        parts = [np.empty((0, 5), np.int64)]
        wanted = None if topics is None else self._known(topics)
        for n, file in enumerate(self._files):
            for number, rows in file.index.items():
                if wanted is None or file.channels[number].topic in wanted:
                    ids = np.full((len(rows), 2), (n, number), np.int64)
                    parts.append(np.column_stack([ids, rows]))
        table = np.concatenate(parts)
        table = table[np.argsort(table[:, 2], kind="stable")]
        if start is not None:
            table = table[table[:, 2] >= round(start * 1e9)]
        for first in range(0, len(table), _ROWS):
            for n, number, time, a, b in table[first : first + _ROWS].tolist():
                yield MessageRef(n, number, time, (a, b))

    def messages(self, topics: Iterable[str] | None = None, start: float | None = None) -> Iterator[LogMessage]:
        """Yield messages in the order of their log times, one in memory at a time.

        Damaged messages are left out and counted in `warnings`.

        Parameters
        ----------
        topics : iterable of str, optional
            All topics by default.
        start : float, optional
            Log time of the first messages [s].

        Raises
        ------
        OgmError
            If there is no such topic; the error lists the existing topics.
        """
        lost: dict[str, int] = {}
        for ref in self.iter_refs(topics, start):
            try:
                message = self.message(ref)
            except OgmError as error:
                lost[str(error)] = lost.get(str(error), 0) + 1
                continue
            yield message
        self.warnings += [f"{count} messages cannot be read: {error}" for error, count in lost.items()]

    def message(self, ref: MessageRef) -> LogMessage:
        """Read one message.

        Raises
        ------
        OgmError
            If it is damaged.
        """
        channel, raw = self._read(ref)
        return LogMessage(channel.topic, channel.type, _seconds(ref.log_time), raw, channel)

    def head(self, ref: MessageRef) -> MessageHead:
        """Read the header of a message that begins with a std_msgs/Header, without the rest.

        Raises
        ------
        OgmError
            If it is damaged.
        """
        channel, raw = self._read(ref, _HEAD)
        try:
            return _head(channel, raw)
        except (struct.error, IndexError) as error:
            where = f"{self.paths[ref.file]}: a message of {channel.topic} ({channel.type})"
            raise OgmError(f"{where} begins without a readable header: {error}") from error

    def topic_of(self, ref: MessageRef) -> str:
        """Return the topic of a message."""
        return self._files[ref.file].channels[ref.channel].topic

    def _read(self, ref: MessageRef, size: int | None = None) -> tuple[Channel, bytes | memoryview]:
        if not self._files:
            raise ValueError("the log is closed: read it inside of the with block")
        file = self._files[ref.file]
        channel = file.channels[ref.channel]
        try:
            return channel, file.read(ref.place, size)
        except (OgmError, struct.error) as error:  # struct.error for a file cut since it was indexed
            raise OgmError(f"{self.paths[ref.file]}: a message of {channel.topic} is lost, {error}") from error

    def _known(self, topics: Iterable[str]) -> set[str]:
        wanted = {topics} if isinstance(topics, str) else set(topics)
        for topic in sorted(wanted - self.topics.keys()):
            there = ", ".join(f"{name} ({facts.type})" for name, facts in self.topics.items())
            raise OgmError(f"{self.paths[0]} has no topic {topic}; there are {there or 'none'}")
        return wanted

    def _topics(self) -> dict[str, TopicFacts]:
        found: dict[str, tuple[str, list[Any]]] = {}
        for file in self._files:
            for number, channel in file.channels.items():
                times = file.index.get(number, np.empty((0, 3), np.int64))[:, 0]
                name, parts = found.setdefault(channel.topic, (channel.type, []))
                parts.append(times)
                if name != channel.type:
                    self.warnings.append(f"topic {channel.topic} has two types, {name} and {channel.type}")
        topics = {}
        for topic in sorted(found):
            name, parts = found[topic]
            times = np.concatenate(parts)
            first, last = (_seconds(int(t)) for t in (times.min(), times.max())) if len(times) else (np.nan, np.nan)
            rate = (len(times) - 1) / (last - first) if last > first else np.nan
            topics[topic] = TopicFacts(name, len(times), rate, first, last)
        return topics


def _seconds(nanoseconds: int) -> float:
    """Return a time with the rounding of `ogm.io.messages.plain.stamp_seconds`: 0.3 s stay 0.3 s."""
    return nanoseconds // 10**9 + nanoseconds % 10**9 * 1e-9


def _head(channel: Channel, raw: bytes | memoryview) -> MessageHead:
    """Read stamp and frame from the first bytes of a message."""
    if channel.encoding == "ros1":
        sec, nanosec, length = struct.unpack_from("<III", raw, 4)  # after a sequence number
        start, end = 16, 16 + length
    elif channel.encoding == "cdr":
        order = "<" if raw[1] & 1 else ">"
        sec, nanosec, length = struct.unpack_from(f"{order}iII", raw, 4)
        start, end = 16, 16 + length - 1  # without the 0 at its end
    else:
        raise OgmError(f"{channel.topic} has {channel.encoding or 'no'} encoding, wanted ROS messages")
    if length > _HEAD - 16:
        raise struct.error(f"its frame has a name of {length} bytes")
    return MessageHead(
        sec * 10**9 + nanosec, sec + nanosec * 1e-9, frame_name(bytes(raw[start:end]).decode("utf-8", "replace"))
    )


_KINDS: dict[bytes, Callable[[Path], LogFile]] = {MCAP_MAGIC: McapFile, DB3_MAGIC: Db3File, BAG_MAGIC: BagFile}


def open_log(path: FilePath | Sequence[FilePath]) -> LogReader:
    """Open a log: a ROS 1 bag (``.bag``), a ROS 2 bag (``.db3``), an MCAP (``.mcap``), or a folder with parts of a log.

    The first bytes of a file determine its format. Parts of a split recording are one log. Neither ``metadata.yaml``
    nor an index at the end of a file is needed: from a cut file, all complete messages before the cut are read, and
    `LogReader.warnings` states the position of the cut.

    Parameters
    ----------
    path : path or sequence of paths

    Returns
    -------
    LogReader
        A context manager.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If it is no log, empty, or too damaged to read anything.
    """
    given = [path] if isinstance(path, str | os.PathLike) else list(path)
    paths = [part for each in given for part in (log_files(Path(each)) if Path(each).is_dir() else [Path(each)])]
    if not paths:
        raise OgmError(f"{given[0] if given else 'nothing'} holds no log ({', '.join(LOG_ENDINGS)})")
    return LogReader(paths, [_opened(path) for path in paths])


def _opened(path: Path) -> LogFile:
    if not path.exists():
        raise FileNotFoundError(f"there is no {path}: check the name and the folder")
    with open(path, "rb") as file:
        start = file.read(16)
    if not start:
        raise OgmError(f"{path} holds 0 bytes, wanted a log: the file is incomplete")
    for magic, kind in _KINDS.items():
        if start.startswith(magic):
            return kind(path)
    packed = start.startswith(b"\x28\xb5\x2f\xfd")
    way_out = f"unpack it first: zstd -d {path.name}" if packed else "check its name"
    raise OgmError(f"{path} is no log: it begins with {start!r}, wanted an MCAP, a ROS 1 bag or a ROS 2 bag; {way_out}")
