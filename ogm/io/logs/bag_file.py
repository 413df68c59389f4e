"""ROS 1 bags of version 2.0, complete or cut: their records are read from the beginning.

Other readers need the index at the end of a bag, which an interrupted recording lacks.
"""

import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ogm.io.logs.chunks import Chunk, ChunkedFile
from ogm.io.logs.definitions import Channel, Place, ros2_name
from ogm.storage.files import OgmError
from ogm.storage.limits import current_limits

BAG_MAGIC = b"#ROSBAG V"
_VERSION = BAG_MAGIC + b"2.0\n"
_MESSAGE, _FILE_HEADER, _INDEX, _CHUNK, _, _CONNECTION = (bytes([op]) for op in range(2, 8))
_BEGINNING = 4096  # [byte] read at once: a header, and the message if it is short
_HEADER_LIMIT = 2**16  # [byte] of a record's header; type definitions are part of the data
_UINT = struct.Struct("<I")

Header = dict[str, bytes]


class BagFile(ChunkedFile):
    """A ROS 1 bag; see `LogFile`.

    Parameters
    ----------
    path : Path

    Raises
    ------
    OgmError
        If it has another version, or is encrypted.
    """

    kind, channel_word = "ROS 1 bag", "connection"
    _encrypted = False

    def __init__(self, path: Path) -> None:
        with open(path, "rb") as stream:
            start = stream.read(len(_VERSION))
        if start != _VERSION:
            raise OgmError(f"{path} begins with {start!r}, wanted {_VERSION!r}, as ROS 1 bags do since 2010")
        super().__init__(path)
        if self._encrypted:
            raise OgmError(f"{path} is encrypted: decrypt it first, with `rosbag decrypt`")

    def read(self, place: Place, size: int | None = None) -> bytes | memoryview:
        """Return the message at a place, or its first bytes."""
        number, offset = place
        chunk = self._chunks[number]
        if chunk.packing:
            data = memoryview(self._chunks.data(number, offset + _BEGINNING))[offset:]
            space = chunk.size - offset
        else:
            data = memoryview(self._file.read(chunk.start + offset, _BEGINNING))
            space = chunk.stored - offset
        header, start, length = _record(data)
        if header["op"] != _MESSAGE or length > min(space - start, current_limits().file):
            raise OgmError("there is no complete message at its place: the file is damaged")
        wanted = length if size is None else min(size, length)
        if start + wanted > len(data) and not chunk.packing:
            return self._file.read(chunk.start + offset + start, wanted)
        if start + wanted > len(data):
            data = memoryview(self._chunks.data(number, offset + start + wanted))[offset:]
        return data[start : start + wanted]

    def _walk(self, stream: BinaryIO) -> None:
        pending: list[tuple[int, bytes]] = []  # channels and index records of the last chunk
        position, index, size = len(_VERSION), 0, self._file.size
        cut: Chunk | None = None
        while position < size:
            stream.seek(position)
            try:
                header, body, length = _record(_head(stream))
            except OgmError:
                break
            op, end = header["op"], position + body + length
            if op == _CHUNK:
                cut = _chunk(header, position + body, length)
            if end > size:
                break
            stream.seek(position + body)
            if op == _INDEX:
                pending.append((_number(header, "conn"), stream.read(length)))
            else:
                self._note_chunk(pending)
                pending = []
            if op == _CHUNK and cut is not None:
                self._chunks.append(cut)
            elif op == _CONNECTION:
                self._define(header, stream.read(length))
            elif op == _FILE_HEADER:
                index = _number(header, "index_pos", 8)
                self._encrypted = bool(header.get("encryptor"))
            position, cut = end, None
        whole = position == size
        self._note_chunk(pending if whole else [])  # some index records of the last chunk may be missing
        if not whole or not 0 < index <= size:
            problem = f"cut or damaged at byte {position} of {size}"
            self.warnings.append(f"{self.path} is {problem}: only earlier messages are read; record or copy all of it")
        if cut is not None:
            self._rescue(cut)

    def _indexed(self, number: int, record: tuple[int, bytes]) -> tuple[int, NDArray[np.int64]]:
        channel, data = record
        sec, nanosec, offset = np.frombuffer(data, "<u4").reshape(-1, 3).T.astype(np.int64)
        return channel, np.column_stack([sec * 10**9 + nanosec, np.full_like(sec, number), offset])

    def _walk_chunk(self, number: int, data: bytes, messages: bool) -> None:
        view, position = memoryview(data), 0
        while position < len(view):
            try:
                header, body, length = _record(view[position:])
            except OgmError:
                return
            end = position + body + length
            if end > len(view):
                return
            if header["op"] == _MESSAGE and messages:
                sec, nanosec = struct.unpack("<II", header["time"])
                self._note(_number(header, "conn"), np.array([[sec * 10**9 + nanosec, number, position]]))
            elif header["op"] == _CONNECTION:
                self._define(header, view[position + body : end])
            position = end

    def _define(self, header: Header, data: bytes | memoryview) -> None:
        """Add a connection."""
        number = _number(header, "conn")
        if number not in self.channels:
            facts = _fields(memoryview(data))
            parts = header.get("topic", b""), facts.get("type", b""), facts.get("message_definition", b"")
            topic, name, text = (part.decode("utf-8", "replace") for part in parts)
            self.channels[number] = Channel(topic, ros2_name(name), "ros1", text, "ros1msg")


def _head(stream: BinaryIO) -> memoryview:
    """Read a record up to its data."""
    size = stream.read(_UINT.size)
    rest = _UINT.unpack(size)[0] if len(size) == _UINT.size else 0
    return memoryview(size + stream.read(min(rest, _HEADER_LIMIT) + _UINT.size))


def _record(data: memoryview) -> tuple[Header, int, int]:
    """Return the header of a record, the position and the length of its data; raise if it is cut or damaged."""
    size = _UINT.unpack_from(data)[0] if len(data) >= _UINT.size else 0
    start = 2 * _UINT.size + size
    header = _fields(data[_UINT.size : _UINT.size + size]) if 0 < size <= _HEADER_LIMIT and start <= len(data) else {}
    if len(header.get("op", b"")) != 1:
        raise OgmError("there is no complete record")
    return header, start, _UINT.unpack_from(data, start - _UINT.size)[0]


def _fields(data: memoryview) -> Header:
    """Return the fields of a header; for a damaged one, the readable fields."""
    found, position = {}, 0
    while position + _UINT.size <= len(data):
        end = position + _UINT.size + _UINT.unpack_from(data, position)[0]
        name, _, value = bytes(data[position + _UINT.size : end]).partition(b"=")
        found[name.decode("ascii", "replace")] = value
        position = end
    return found


def _number(header: Header, name: str, size: int = 4) -> int:
    """Return an integer of a header; raise if it is missing."""
    value = header.get(name, b"")
    if len(value) != size:
        raise OgmError(f"a record has no {name} of {size} bytes: the bag is damaged")
    return int.from_bytes(value, "little")


def _chunk(header: Header, start: int, stored: int) -> Chunk:
    packing = header.get("compression", b"").decode("ascii", "replace")
    size = _number(header, "size") if packing != "none" else stored
    return Chunk(start, stored, size, "" if packing == "none" else packing)
