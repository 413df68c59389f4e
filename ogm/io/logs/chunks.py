"""Chunks of a log file, which hold many messages and may be packed."""

import bz2
import zlib
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from ogm.files import OgmError
from ogm.io.logs.files import RandomAccess
from ogm.io.reading import optional

__all__ = ["LIMIT", "Chunk", "Chunks"]

LIMIT = 2**30  # [byte] of one message or one chunk: what is larger is taken for damage
_BEGINNING = 2**18  # [byte] that are unpacked at least: blocks of zstd have half of it
_PACKED = Path("a packed log")
_KEPT = 4  # unpacked chunks in memory: some 1 MB each, or one scan


class Chunk(NamedTuple):
    """Where a chunk lies.

    Attributes
    ----------
    start : int
        Of its stored bytes in the file.
    stored : int
        Their number.
    size : int
        Their number when unpacked.
    packing : str
        "" for none, "zstd", "lz4", "bz2".
    checksum : int
        CRC-32 of what is unpacked; 0 if there is none.
    """

    start: int
    stored: int
    size: int
    packing: str
    checksum: int = 0


class Chunks:
    """The chunks of a file, of which the last ones that were read are kept unpacked.

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
        """How chunks are packed, in words; "" where none is."""
        return ", ".join(sorted({chunk.packing for chunk in self._all} - {""}))

    def append(self, chunk: Chunk) -> None:
        """Add a chunk that is whole in the file."""
        self._all.append(chunk)

    def append_cut(self, chunk: Chunk) -> None:
        """Add a chunk of which the file has the beginning only, as far as that can be unpacked."""
        stored = min(self._file.size - chunk.start, LIMIT)
        data = _unpack(self._file.read(chunk.start, stored), chunk)
        self._all.append(chunk._replace(stored=stored, size=len(data), checksum=0))

    def is_kept(self, number: int) -> bool:
        """Tell whether a chunk is unpacked already."""
        return number in self._unpacked

    def data(self, number: int, end: int | None = None) -> bytes:
        """Return what a chunk holds, unpacked.

        Parameters
        ----------
        number : int
        end : int, optional
            So many bytes are enough. Of a beginning, the checksum is not known to fit.

        Raises
        ------
        OgmError
            If it is damaged, or packed in an unknown way.
        """
        chunk, kept = self._all[number], self._unpacked.get(number, b"")
        wanted = chunk.size if end is None else min(end, chunk.size)
        if len(kept) < wanted or number not in self._unpacked:
            # A scan is often the last in its chunk, after messages of a few bytes.
            limit = max(wanted, 2 * len(kept), _BEGINNING)
            data = self._beginning(chunk, limit) if chunk.packing and limit < chunk.size / 2 else b""
            self._unpacked[number] = data if len(data) >= wanted else self._whole(chunk)
            if len(self._unpacked) > _KEPT:
                self._unpacked.popitem(last=False)
        self._unpacked.move_to_end(number)
        return self._unpacked[number]

    def _beginning(self, chunk: Chunk, limit: int) -> bytes:
        stored = self._file.read(chunk.start, min(chunk.stored, limit + _BEGINNING))
        return _unpack(stored, chunk._replace(size=limit))

    def _whole(self, chunk: Chunk) -> bytes:
        where = f"the chunk at byte {chunk.start}"
        if max(chunk.size, chunk.stored) > LIMIT:
            raise OgmError(f"{where} is damaged: it has more than {LIMIT} bytes")
        data = _unpack(self._file.read(chunk.start, chunk.stored), chunk)
        if len(data) != chunk.size:
            raise OgmError(f"{where} is damaged: {len(data)} of its {chunk.size} bytes can be unpacked")
        if chunk.checksum and zlib.crc32(data) != chunk.checksum:
            raise OgmError(f"{where} is damaged: its checksum does not fit")
        return data


def _unpack(stored: bytes, chunk: Chunk) -> bytes:
    """Unpack the bytes of a chunk, or their beginning where the rest is cut off."""
    limit = min(chunk.size, LIMIT)
    if chunk.packing not in _UNPACK:
        raise OgmError(f"the chunk at byte {chunk.start} is packed by {chunk.packing!r}, known are zstd, lz4 and bz2")
    try:
        return _UNPACK[chunk.packing](stored, limit)
    except ImportError:
        raise
    except Exception as error:  # each library has its own
        raise OgmError(f"the chunk at byte {chunk.start} is damaged: {error}") from error


def _zstd(stored: bytes, limit: int) -> bytes:
    zstandard = optional("zstandard", _PACKED, "ros")
    with zstandard.ZstdDecompressor().stream_reader(stored) as reader:
        return bytes(reader.read(limit))


def _lz4(stored: bytes, limit: int) -> bytes:
    frame = optional("lz4.frame", _PACKED, "ros")
    return bytes(frame.LZ4FrameDecompressor().decompress(stored, limit))


_UNPACK: dict[str, Callable[[bytes, int], bytes]] = {
    "": lambda stored, limit: stored[:limit],
    "zstd": _zstd,
    "lz4": _lz4,
    "bz2": lambda stored, limit: bz2.BZ2Decompressor().decompress(stored, limit),
}
