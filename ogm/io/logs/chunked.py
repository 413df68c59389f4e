"""Base of the log files whose messages lie in chunks: they are found by a walk over all records from the beginning."""

import struct
from pathlib import Path
from typing import Any, BinaryIO, ClassVar

import numpy as np
from numpy.typing import NDArray

from ogm.io.logs.chunks import Chunk, Chunks
from ogm.io.logs.files import Channel, RandomAccess
from ogm.storage.files import OgmError


class ChunkedFile:
    """A log file with chunks, whole or cut; see `LogFile`. Subclasses know the records of a format.

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

    kind: ClassVar[str]  # of the file, in words
    channel_word: ClassVar[str]  # for a channel, in warnings

    def __init__(self, path: Path) -> None:
        self.path, self._file = path, RandomAccess(path)
        self.channels: dict[int, Channel] = {}
        self.warnings: list[str] = []
        self._chunks = Chunks(self._file)
        self._parts: dict[int, list[NDArray[np.int64]]] = {}
        self._noted = 0  # chunks whose messages are in the index
        with open(path, "rb") as stream:
            try:
                self._walk(stream)
                self._find_channels()
            except (struct.error, ValueError, LookupError) as error:
                self.warnings.append(f"{path} is damaged ({error}): only the messages before are read")
        found = {number: np.concatenate(rows) for number, rows in self._parts.items()}
        self.index = {number: rows for number, rows in found.items() if number in self.channels}
        self.format = f"{self.kind} ({self._chunks.packings})" if self._chunks.packings else self.kind

    def _walk(self, stream: BinaryIO) -> None:
        """Go from record to record, over the contents of chunks."""
        raise NotImplementedError

    def _walk_chunk(self, number: int, data: bytes, messages: bool) -> None:
        """Take the channels of an unpacked chunk, and its messages if wanted."""
        raise NotImplementedError

    def _indexed(self, number: int, record: Any) -> tuple[int, NDArray[np.int64]]:
        """Return the channel of an index record, and the rows of its messages in a chunk: time [ns], chunk, place."""
        raise NotImplementedError

    def _rescue(self, chunk: Chunk) -> None:
        """Take what is whole from a cut chunk."""
        try:
            self._chunks.append_cut(chunk)
        except OgmError:
            return
        self._note_chunk([])

    def _note_chunk(self, records: list[Any]) -> None:
        """Note the messages of the last chunk: by its index records, or, without any, by its contents."""
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
        """Unpack a chunk and walk over its records."""
        try:
            data = self._chunks.data(number)
        except OgmError as error:
            self.warnings.append(f"{self.path}: {error}; its messages are lost")
            return
        self._walk_chunk(number, data, messages)

    def _find_channels(self) -> None:
        """Look into chunks for channels that went with the end of the file, or that it does not repeat."""
        first = sorted({int(rows[0][0, 1]) for number, rows in self._parts.items() if number not in self.channels})
        for number in (*first, *range(len(self._chunks))):
            if self._parts.keys() <= self.channels.keys():
                return
            if number >= 0:  # else a message that lies in no chunk
                self._look_into(number, messages=False)
        for number in self._parts.keys() - self.channels.keys():
            count = sum(map(len, self._parts[number]))
            self.warnings.append(
                f"{self.path}: {count} messages are of {self.channel_word} {number}, which is nowhere defined"
            )
