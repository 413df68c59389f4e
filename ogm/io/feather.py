"""Feather tables (Arrow IPC files), the format of Argoverse 2."""

import struct
from pathlib import Path
from typing import Any

from ogm.io.names import KNOWN, plain, refuse_doubles
from ogm.io.source import BYTE_LIMIT, Table, optional

__all__ = ["parse_feather"]

_MAGIC = 8  # [byte] of a file before its first message


def parse_feather(data: bytes, path: Path) -> Table:
    """Read a Feather table; an Argoverse 2 sweep has x, y, z, intensity, laser_number, offset_ns.

    Only columns of numbers that have a meaning here are unpacked, and only if all their rows stay within
    `BYTE_LIMIT`. A file made to do harm can still take much memory, for pyarrow believes the sizes of its
    buffers.

    Parameters
    ----------
    data : bytes
        The whole file, unpacked from ``.xz`` or ``.gz``.
    path : Path
        Its name, for messages.
    """
    pyarrow, ipc = optional("pyarrow", path), optional("pyarrow.ipc", path)
    if data.startswith(b"FEA1"):
        raise ValueError(f"{path} is Feather of version 1, wanted version 2: write it anew with pyarrow")
    try:
        schema = ipc.open_file(pyarrow.BufferReader(data)).schema
        numbers = [i for i, field in enumerate(schema) if _is_number(field.type, pyarrow)]
        fields = tuple(schema.names[i] for i in numbers)
        wanted = [i for i in numbers if plain(schema.names[i]) in KNOWN]
        width = sum(schema.types[i].bit_width // 8 for i in wanted)
        options = ipc.IpcReadOptions(included_fields=wanted)
        reader = ipc.open_file(pyarrow.BufferReader(data), options=options)
        rows = reader.num_record_batches * max(_rows_of_batches(data, pyarrow), default=0)
    except (pyarrow.ArrowException, struct.error, ValueError, OSError) as error:
        raise ValueError(_damaged(path, error)) from error
    refuse_doubles(fields, path)
    if rows * width > BYTE_LIMIT:
        raise ValueError(
            f"{path} unpacks to {rows} rows of {width} bytes, wanted one scan of at most {BYTE_LIMIT} bytes "
            "(ogm.io.BYTE_LIMIT): split it"
        )
    if not wanted:  # to pyarrow, no fields would mean all
        return Table("Feather", {}, fields=fields)
    try:
        table = reader.read_all()
        columns = {name: table[name].to_numpy() for name in table.column_names}
    except (pyarrow.ArrowException, ValueError, OSError) as error:
        raise ValueError(_damaged(path, error)) from error
    return Table("Feather", columns, fields=fields)


def _is_number(kind: Any, pyarrow: Any) -> bool:
    return pyarrow.types.is_integer(kind) or pyarrow.types.is_floating(kind)


def _rows_of_batches(data: bytes, pyarrow: Any) -> list[int]:
    """Read how many rows each batch has, without unpacking one."""
    messages = pyarrow.ipc.MessageReader.open_stream(pyarrow.py_buffer(data).slice(_MAGIC))
    return [_length(message.metadata.to_pybytes()) for message in messages if message.type == "record batch"]


def _length(message: bytes) -> int:
    """Take the length out of a RecordBatch message; pyarrow tells it only of what it has unpacked.

    The message is a flatbuffer (arrow/format/Message.fbs): its third field is the batch, whose first field is
    the length.
    """

    def number(kind: str, at: int) -> int:
        return int(struct.unpack_from(kind, message, at)[0])

    def field(table: int, index: int) -> int | None:
        fields = table - number("<i", table)
        entry = 4 + 2 * index
        offset = number("<H", fields + entry) if entry < number("<H", fields) else 0
        return table + offset if offset else None

    header = field(number("<I", 0), 2)
    length = None if header is None else field(header + number("<I", header), 0)
    return 0 if length is None else number("<q", length)


def _damaged(path: Path, error: Exception) -> str:
    return f"{path} is no readable Feather table ({error}): it is damaged or wrongly named"
