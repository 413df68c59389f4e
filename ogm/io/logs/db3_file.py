"""ROS 2 bags in SQLite (.db3), complete or cut, with or without type definitions."""

import os
import sqlite3
import threading
import weakref
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from ogm.io.logs.chunks import unpack_zstd
from ogm.io.logs.definitions import Channel, Place
from ogm.io.reading import optional
from ogm.storage.files import OgmError, error_context
from ogm.storage.limits import current_limits, too_large

DB3_MAGIC = b"SQLite format 3\0"
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_INDEX = (  # blobs are opened by rowid, which equals `id` only for a primary key
    "SELECT topic_id, timestamp, rowid, typeof(topic_id) = 'integer' AND typeof(timestamp) = 'integer' FROM messages"
)
_ROWS = 10_000  # rows of the index per array


class Db3File:
    """A ROS 2 bag in SQLite; see `LogFile`.

    Parameters
    ----------
    path : Path

    Raises
    ------
    OgmError
        If it is no such file, or too damaged to read anything.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.warnings: list[str] = []
        self._process, self._lock = -1, threading.Lock()
        try:
            self.channels = self._read_channels()
        except sqlite3.Error as error:
            raise OgmError(
                f"{path} is no readable ROS 2 bag ({error}), wanted an SQLite file with the tables topics and "
                "messages: it is damaged or incomplete"
            ) from error
        self._read_index()
        self._check_size()
        self.format = "ROS 2 bag (SQLite)"

    def read(self, place: Place, size: int | None = None) -> bytes:
        """Return the message at a place, or its first bytes."""
        with (
            error_context("it cannot be read", sqlite3.Error),
            self._lock,
            self._connection().blobopen("messages", "data", place[0], readonly=True) as blob,
        ):
            if len(blob) > current_limits().file:
                raise too_large("it", len(blob), "file")
            packed = blob.read(len(_ZSTD_MAGIC)) == _ZSTD_MAGIC
            blob.seek(0)
            data = blob.read() if size is None or packed else blob.read(size)
        if packed:
            data = _unpacked(data)
        return data if size is None else data[:size]

    def _connection(self) -> sqlite3.Connection:
        """Return the connection of this process: a forked process must not use its parent's."""
        if self._process != os.getpid():
            # A write-ahead log holds messages missing in the file; without it, nothing needs a lock.
            unwritten = self.path.with_name(f"{self.path.name}-wal")
            mode = "mode=ro" if unwritten.is_file() and unwritten.stat().st_size else "immutable=1"
            self._open = sqlite3.connect(f"file:{quote(str(self.path))}?{mode}", uri=True, check_same_thread=False)
            self._open.execute("PRAGMA writable_schema=ON")  # reads the rest of a cut file; nothing is written
            weakref.finalize(self, self._open.close)
            self._process = os.getpid()
        return self._open

    def _read_channels(self) -> dict[int, Channel]:
        connection = self._connection()
        rows = connection.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        definitions = {}
        if connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'").fetchone():
            columns = "topic_type, encoded_message_definition, encoding"
            found = connection.execute(f"SELECT {columns} FROM message_definitions")
            definitions = {name: (str(text or ""), str(form or "")) for name, text, form in found}
        return {
            number: Channel(str(topic), str(name), encoding or "cdr", *definitions.get(name, ("", "")))
            for number, topic, name, encoding in rows
        }

    def _read_index(self) -> None:
        """Collect topics, times and row numbers of all messages, without their data."""
        rows: list[NDArray[np.int64]] = []
        part: list[list[int]] = []
        count = 0
        try:
            cursor = self._connection().execute(_INDEX)
            for *row, whole in cursor:
                count += 1
                if whole and row[0] in self.channels:
                    part.append(row)
                if len(part) == _ROWS:
                    rows.append(np.array(part, np.int64))
                    part = []
        except sqlite3.Error as error:
            self._warn(str(error))
        table = np.concatenate([*rows, np.array(part, np.int64).reshape(-1, 3)])
        self.index: dict[int, Any] = {}
        for number in self.channels:
            mine = table[table[:, 0] == number]
            count -= len(mine)
            if len(mine):
                self.index[number] = np.column_stack([mine[:, 1:], np.zeros(len(mine), np.int64)])
        if count:
            text = "messages are left out: their topic is not in the table topics, or their time is no integer"
            self.warnings.append(f"{self.path}: {count} {text}")

    def _check_size(self) -> None:
        """Warn if the file has fewer pages than it states: SQLite reads missing parts of a page as zeros."""
        with open(self.path, "rb") as file:
            head = file.read(100)
        page, pages = int.from_bytes(head[16:18], "big"), int.from_bytes(head[28:32], "big")
        wanted, size = (65536 if page == 1 else page) * pages, self.path.stat().st_size
        if size < wanted and head[24:28] == head[92:96] and not self.warnings:
            self._warn(f"{size} of {wanted} bytes")

    def _warn(self, reason: str) -> None:
        text = f"cut or damaged ({reason}): only the remaining messages are read; record or copy all of it"
        self.warnings.append(f"{self.path} is {text}")


def _unpacked(data: bytes) -> bytes:
    """Unpack a message that is packed individually (compression_mode: message)."""
    zstandard = optional("zstandard", Path("a packed message"), "ros")
    with error_context("it is damaged", zstandard.ZstdError):
        content = unpack_zstd(data, current_limits().file + 1)
    if len(content) > current_limits().file:
        raise too_large("it", None, "file")
    return content
