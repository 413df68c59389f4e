"""MCAP files, complete or cut: their records are read from the beginning, without an index at the end.

The `mcap` package reads a file without its end only from start to end, and stops at the first damaged chunk. Here every
complete chunk is found, messages are read by place, and opening a file without packing reads no points.
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

MCAP_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX = range(2, 8)
_RECORD = struct.Struct("<BQ")  # opcode, length
_SENT = struct.Struct("<HIQQ")  # of a message: channel, sequence, log time, publish time
_HEAD = _RECORD.size + _SENT.size
_TIMES = struct.Struct("<QQQI")  # of a chunk: first and last log time, unpacked size, checksum
_CHUNK_HEAD = _RECORD.size + _TIMES.size + 16  # least size, with the name of the packing
_UNCHUNKED = -1
_SMALL = 4096  # [byte] shorter messages of an unpacked chunk are read without its checksum


class McapFile(ChunkedFile):
    """An MCAP file; see `LogFile`.

    Parameters
    ----------
    path : Path
        File that begins with `MCAP_MAGIC`.
    """

    kind, channel_word = "MCAP", "channel"

    def __init__(self, path: Path) -> None:
        self._schemas: dict[int, list[str]] = {}
        super().__init__(path)

    def read(self, place: Place, size: int | None = None) -> bytes | memoryview:
        """Return the message at a place, or its first bytes."""
        number, offset = place
        if number == _UNCHUNKED:
            return self._read_stored(offset, self._file.size, size)
        chunk = self._chunks[number]
        if not chunk.packing and not self._chunks.is_kept(number):
            start, end = chunk.start + offset, chunk.start + chunk.stored
            head = self._file.read(start, _RECORD.size)
            if size is not None or len(head) < _RECORD.size or _RECORD.unpack(head)[1] < _SMALL:
                return self._read_stored(start, end, size)
        start = offset + _HEAD
        head = self._chunks.data(number, start)[offset : offset + _RECORD.size]
        length = self._length(head, chunk.size - offset)
        end = start + (length if size is None else min(size, length))
        return memoryview(self._chunks.data(number, end))[start:end]

    def _read_stored(self, offset: int, end: int, size: int | None) -> bytes:
        """Return a message that is not packed."""
        length = self._length(self._file.read(offset, _RECORD.size), end - offset)
        return self._file.read(offset + _HEAD, length if size is None else min(size, length))

    @staticmethod
    def _length(head: bytes, space: int) -> int:
        """Return the length of a message by the head of its record, within the given space [byte]."""
        opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (0, 0)
        if opcode != _MESSAGE or not _SENT.size <= length <= min(current_limits().file, space - _RECORD.size):
            raise OgmError("there is no complete message at its place: the file is damaged")
        return int(length - _SENT.size)

    def _walk(self, stream: BinaryIO) -> None:
        pending: list[bytes] = []  # index records of the last chunk
        position, opcode = len(MCAP_MAGIC), 0
        while opcode != _FOOTER:
            stream.seek(position)
            head = stream.read(_RECORD.size)
            opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (0, 0)
            end = position + _RECORD.size + length
            if end > self._file.size or not opcode:
                self._note_chunk([])  # some of its index records may be missing
                self._end_cut(stream, position, opcode)
                return
            if opcode == _MESSAGE_INDEX:
                pending.append(stream.read(length))
            else:
                self._note_chunk(pending)
                pending = []
            if opcode == _CHUNK:
                self._chunks.append(_chunk(stream))
            elif opcode == _MESSAGE:
                number, _, time, _ = _SENT.unpack(stream.read(_SENT.size))
                self._note(number, np.array([[time, _UNCHUNKED, position]]))
            elif opcode in (_SCHEMA, _CHANNEL):
                self._define(opcode, stream.read(length))
            position = end

    def _end_cut(self, stream: BinaryIO, position: int, opcode: int) -> None:
        """Add the complete messages at the end of a cut file."""
        size = self._file.size
        damaged = not opcode and position < size - _RECORD.size
        problem = f"{'damaged' if damaged else 'cut'} at byte {position} of {size}"
        self.warnings.append(f"{self.path} is {problem}: only earlier messages are read; record or copy all of it")
        if opcode == _CHUNK and size - position > _CHUNK_HEAD:
            self._rescue(_chunk(stream))

    def _indexed(self, number: int, record: bytes) -> tuple[int, NDArray[np.int64]]:
        (channel, _), pairs = struct.unpack_from("<HI", record), np.frombuffer(record, "<i8", offset=6)
        rows = np.full((len(pairs) // 2, 3), number, np.int64)
        rows[:, 0], rows[:, 2] = pairs[0::2], pairs[1::2]
        return channel, rows

    def _walk_chunk(self, number: int, data: bytes, messages: bool) -> None:
        position = 0
        while position + _RECORD.size <= len(data):
            opcode, length = _RECORD.unpack_from(data, position)
            body, end = position + _RECORD.size, position + _RECORD.size + length
            if end > len(data):
                return
            if opcode == _MESSAGE and messages and length >= _SENT.size:
                channel, _, time, _ = _SENT.unpack_from(data, body)
                self._note(channel, np.array([[time, number, position]]))
            elif opcode in (_SCHEMA, _CHANNEL):
                self._define(opcode, data[body:end])
            position = end

    def _define(self, opcode: int, record: bytes) -> None:
        """Add a schema or a channel."""
        number = struct.unpack_from("<H", record)[0]
        if opcode == _SCHEMA:
            self._schemas.setdefault(number, _strings(record, 2, 3))
        elif number not in self.channels:
            name, form, text = self._schemas.get(struct.unpack_from("<H", record, 2)[0], ["", "", ""])
            topic, encoding = _strings(record, 4, 2)
            name = ros2_name(name) if encoding in ("cdr", "ros1") else name
            self.channels[number] = Channel(topic, name, encoding, text, form)


def _chunk(stream: BinaryIO) -> Chunk:
    """Read the head of a chunk."""
    _, _, size, checksum = _TIMES.unpack(stream.read(_TIMES.size))
    packing = stream.read(min(struct.unpack("<I", stream.read(4))[0], 32)).decode("ascii", "replace")
    stored = struct.unpack("<Q", stream.read(8))[0]
    return Chunk(stream.tell(), stored, size, packing, checksum)


def _strings(record: bytes, position: int, count: int) -> list[str]:
    """Return the texts from a position on, each preceded by its length."""
    found = []
    for _ in range(count):
        length = struct.unpack_from("<I", record, position)[0]
        found.append(record[position + 4 : position + 4 + length].decode("utf-8", "replace"))
        position += 4 + length
    return found
