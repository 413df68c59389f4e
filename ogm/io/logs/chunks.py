"""Chunks of a log file, which hold many messages and may be packed, and the base class of chunked log files."""

import bz2
import struct
import zlib
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.io.logs.definitions import Channel, RandomAccess
from ogm.io.reading import optional
from ogm.storage.files import OgmError
from ogm.storage.limits import current_limits, too_large

_BEGINNING = 2**18  # [byte] least size to unpack: blocks of zstd have half of it
_PACKED = Path("a packed log")
_KEPT = 4  # unpacked chunks in memory: about 1 MB each, or one scan; fewer if they exceed the limit for a file
_PIECE = 2**22  # [byte] unpacked in one step: no library allocates the size stated by a damaged chunk


class Chunk(NamedTuple):
    """Position and packing of a chunk.

    Attributes
    ----------
    start : int
        Position of its stored bytes in the file.
    stored : int
        Number of stored bytes.
    size : int
        Number of unpacked bytes.
    packing : str
        "" if not packed, or "zstd", "lz4", "bz2".
    checksum : int
        CRC-32 of the unpacked bytes; 0 without checksum.
    """

    start: int
    stored: int
    size: int
    packing: str
    checksum: int = 0


class Chunks:
    """Chunks of a file, unpacked on request; the last used stay in memory.

    Parameters
    ----------
    file : RandomAccess
    """

    def __init__(self, file: RandomAccess) -> None:
        self._file = file
        self._all: list[Chunk] = []
        self._unpacked: OrderedDict[int, bytes] = OrderedDict()

    def __len__(self) -> int:
        return len(self._all)

    def __getitem__(self, number: int) -> Chunk:
        return self._all[number]

    @property
    def packings(self) -> str:
        """Names of the packings used, separated by commas; "" if no chunk is packed."""
        return ", ".join(sorted({chunk.packing for chunk in self._all} - {""}))

    def append(self, chunk: Chunk) -> None:
        """Add a chunk that is complete in the file."""
        self._all.append(chunk)

    def append_cut(self, chunk: Chunk) -> None:
        """Add the beginning of a chunk that is cut, as far as it can be unpacked."""
        stored = min(self._file.size - chunk.start, current_limits().file)
        data = _unpack(self._file.read(chunk.start, stored), chunk)
        self._all.append(chunk._replace(stored=stored, size=len(data), checksum=0))

    def is_kept(self, number: int) -> bool:
        """Return whether a chunk is already unpacked."""
        return number in self._unpacked

    def data(self, number: int, end: int | None = None) -> bytes:
        """Return the unpacked content of a chunk.

        Parameters
        ----------
        number : int
        end : int, optional
            Number of bytes needed from the beginning. The checksum of a beginning is not verified.

        Raises
        ------
        OgmError
            If the chunk is damaged, or has an unknown packing.
        """
        chunk, kept = self._all[number], self._unpacked.get(number, b"")
        wanted = chunk.size if end is None else min(end, chunk.size)
        if len(kept) < wanted or number not in self._unpacked:
            # A scan is often the last message of its chunk, after messages of a few bytes.
            limit = max(wanted, 2 * len(kept), _BEGINNING)
            data = self._beginning(chunk, limit) if chunk.packing and limit < chunk.size / 2 else b""
            self._unpacked[number] = data if len(data) >= wanted else self._whole(chunk)
            self._forget()
        self._unpacked.move_to_end(number)
        return self._unpacked[number]

    def _forget(self) -> None:
        """Drop the least recently used chunks, but keep the last chunk read."""
        total = sum(map(len, self._unpacked.values()))
        while len(self._unpacked) > _KEPT or (total > current_limits().file and len(self._unpacked) > 1):
            total -= len(self._unpacked.popitem(last=False)[1])

    def _beginning(self, chunk: Chunk, limit: int) -> bytes:
        stored = self._file.read(chunk.start, min(chunk.stored, limit + _BEGINNING))
        return _unpack(stored, chunk._replace(size=limit))

    def _whole(self, chunk: Chunk) -> bytes:
        where = f"the chunk at byte {chunk.start}"
        if max(chunk.size, chunk.stored) > current_limits().file:
            raise too_large(where, max(chunk.size, chunk.stored), "file")
        data = _unpack(self._file.read(chunk.start, chunk.stored), chunk)
        if len(data) != chunk.size:
            raise OgmError(f"{where} is damaged: only {len(data)} of its {chunk.size} bytes can be unpacked")
        if chunk.checksum and zlib.crc32(data) != chunk.checksum:
            raise OgmError(f"{where} is damaged: its checksum does not match")
        return data


def _unpack(stored: bytes, chunk: Chunk) -> bytes:
    """Unpack the bytes of a chunk, or their beginning if the rest is cut off."""
    limit = min(chunk.size, current_limits().file)
    if chunk.packing not in _UNPACK:
        raise OgmError(f"the chunk at byte {chunk.start} is packed by {chunk.packing!r}, known are zstd, lz4 and bz2")
    try:
        return _UNPACK[chunk.packing](stored, limit)
    except ImportError:
        raise
    except Exception as error:  # each library has its own error classes
        raise OgmError(f"the chunk at byte {chunk.start} is damaged: {error}") from error


def unpack_zstd(stored: bytes, limit: int) -> bytes:
    """Return the content of bytes packed by zstd, up to a limit [byte]."""
    zstandard = optional("zstandard", _PACKED, "ros")
    with zstandard.ZstdDecompressor().stream_reader(stored) as reader:
        return _in_pieces(reader.read, limit)


def _lz4(stored: bytes, limit: int) -> bytes:
    frame = optional("lz4.frame", _PACKED, "ros")
    return _of_decoder(frame.LZ4FrameDecompressor(), stored, limit)


def _of_decoder(decoder: Any, stored: bytes, limit: int) -> bytes:
    """Unpack by a decoder with the interface of `bz2.BZ2Decompressor`."""
    rest = [stored]

    def read(size: int) -> bytes:
        return b"" if decoder.eof else decoder.decompress(rest.pop() if rest else b"", size)

    return _in_pieces(read, limit)


def _in_pieces(read: Callable[[int], bytes], limit: int) -> bytes:
    """Return the output of a reading function, up to a limit, read in pieces."""
    pieces, size = [], 0
    while size < limit and (piece := read(min(_PIECE, limit - size))):
        pieces.append(piece)
        size += len(piece)
    return pieces[0] if len(pieces) == 1 else b"".join(pieces)


_UNPACK: dict[str, Callable[[bytes, int], bytes]] = {
    "": lambda stored, limit: stored[:limit],
    "zstd": unpack_zstd,
    "lz4": _lz4,
    "bz2": lambda stored, limit: _of_decoder(bz2.BZ2Decompressor(), stored, limit),
}


class ChunkedFile:
    """A log file with chunks, complete or cut; see `LogFile`. Subclasses read the records of a format.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    path : Path
    index : dict of int to (K, 3) int64
    format : str
    channels : dict of int to Channel
    warnings : list of str
    """

    kind: ClassVar[str]  # name of the file format
    channel_word: ClassVar[str]  # word for a channel, in warnings

    def __init__(self, path: Path) -> None:
        self.path, self._file = path, RandomAccess(path)
        self.channels: dict[int, Channel] = {}
        self.warnings: list[str] = []
        self._chunks = Chunks(self._file)
        self._parts: dict[int, list[NDArray[np.int64]]] = {}
        self._noted = 0  # number of chunks with indexed messages
        with open(path, "rb") as stream:
            try:
                self._walk(stream)
                self._find_channels()
            except (struct.error, ValueError, LookupError) as error:
                self.warnings.append(f"{path} is damaged ({error}): only earlier messages are read")
        found = {number: np.concatenate(rows) for number, rows in self._parts.items()}
        self.index = {number: rows for number, rows in found.items() if number in self.channels}
        self.format = f"{self.kind} ({self._chunks.packings})" if self._chunks.packings else self.kind

    def _walk(self, stream: BinaryIO) -> None:
        """Read the records of the file in order, skipping the contents of chunks."""
        raise NotImplementedError

    def _walk_chunk(self, number: int, data: bytes, messages: bool) -> None:
        """Add the channels of an unpacked chunk, and its messages if wanted."""
        raise NotImplementedError

    def _indexed(self, number: int, record: Any) -> tuple[int, NDArray[np.int64]]:
        """Return the channel of an index record, and its messages in a chunk as rows: time [ns], chunk, place."""
        raise NotImplementedError

    def _rescue(self, chunk: Chunk) -> None:
        """Add the complete messages of a cut chunk."""
        try:
            self._chunks.append_cut(chunk)
        except OgmError:
            return
        self._note_chunk([])

    def _note_chunk(self, records: list[Any]) -> None:
        """Add the messages of the last chunk: by its index records, or without any by its contents."""
        number = len(self._chunks) - 1
        if number < self._noted:
            return
        self._noted = number + 1
        if not records:
            self._look_into(number, messages=True)
        for record in records:
            self._note(*self._indexed(number, record))

    def _note(self, channel: int, rows: NDArray[np.int64]) -> None:
        if len(rows):
            self._parts.setdefault(channel, []).append(rows)

    def _look_into(self, number: int, *, messages: bool) -> None:
        """Unpack a chunk and read its records."""
        try:
            data = self._chunks.data(number)
        except OgmError as error:
            self.warnings.append(f"{self.path}: {error}; its messages are lost")
            return
        self._walk_chunk(number, data, messages)

    def _find_channels(self) -> None:
        """Search chunks for channels that are not repeated outside of them, or were lost with the end of the file."""
        first = sorted({int(rows[0][0, 1]) for number, rows in self._parts.items() if number not in self.channels})
        for number in (*first, *range(len(self._chunks))):
            if self._parts.keys() <= self.channels.keys():
                return
            if number >= 0:  # below 0 for messages outside of chunks
                self._look_into(number, messages=False)
        for number in self._parts.keys() - self.channels.keys():
            count = sum(map(len, self._parts[number]))
            word = f"{self.channel_word} {number}"
            self.warnings.append(f"{self.path}: {count} messages belong to {word}, which is not defined")
