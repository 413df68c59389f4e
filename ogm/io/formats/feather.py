"""Feather tables (Arrow IPC files), the format of Argoverse 2, by `pyarrow`."""

import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

from ogm.io.formats.table import KNOWN, Table, plain, refuse_doubles
from ogm.io.reading import optional
from ogm.storage.files import OgmError
from ogm.storage.limits import current_limits, too_large


def parse_feather(data: bytes, path: Path) -> Table:
    """Read a Feather table; an Argoverse 2 sweep has x, y, z, intensity, laser_number, offset_ns.

    Only numeric columns with a known meaning are unpacked, and only if their rows and the stated sizes of their buffers
    stay within the limit for a file.

    Parameters
    ----------
    data : bytes
        The whole file, unpacked from ``.xz`` or ``.gz``.
    path : Path
        File name, for messages.
    """
    if data.startswith(b"FEA1"):
        raise OgmError(f"{path} is Feather of version 1, wanted version 2: rewrite it with pyarrow")
    columns, schema = read_columns(data, path, partial(_known_columns, data, path))
    return Table("Feather", columns, fields=tuple(schema.names[i] for i in _numeric_columns(schema)))


def _numeric_columns(schema: Any) -> list[int]:
    from pyarrow import types

    return [i for i, kind in enumerate(schema.types) if types.is_integer(kind) or types.is_floating(kind)]


def _known_columns(data: bytes, path: Path, schema: Any) -> list[int]:
    """Return the numbers of the columns to unpack, after checking their size without unpacking."""
    pyarrow, dataset = optional("pyarrow", path), optional("pyarrow.dataset", path)
    numeric = _numeric_columns(schema)
    refuse_doubles((schema.names[i] for i in numeric), path)
    wanted = [i for i in numeric if plain(schema.names[i]) in KNOWN]
    width = sum(schema.types[i].bit_width // 8 for i in wanted)
    fragment = dataset.IpcFileFormat().make_fragment(pyarrow.py_buffer(data))
    if wanted and (size := fragment.count_rows(use_threads=False) * width) > current_limits().file:
        raise too_large(path, size, "file")
    return wanted


def read_columns(data: bytes, path: Path, choose: Callable[[Any], list[int]]) -> tuple[dict[str, NDArray[Any]], Any]:
    """Return columns of a Feather table, by a function from its schema to their numbers, and the schema.

    Raises
    ------
    OgmError
        If the table is damaged, or too large.
    ImportError
        If pyarrow is missing.
    """
    pyarrow, ipc = optional("pyarrow", path), optional("pyarrow.ipc", path)
    try:
        buffer = pyarrow.py_buffer(data)
        schema = ipc.open_file(buffer).schema
        if not (wanted := choose(schema)):  # pyarrow reads all fields if none are given
            return {}, schema
        check_sizes(data, path, schema.types, wanted)
        table = ipc.open_file(buffer, options=ipc.IpcReadOptions(included_fields=wanted)).read_all()
        table.validate(full=True)  # lengths beyond the buffers would read foreign memory
        return {name: table[name].to_numpy(zero_copy_only=False) for name in table.column_names}, schema
    except OgmError:
        raise
    except (pyarrow.ArrowException, ValueError, OSError, MemoryError, struct.error) as error:
        text = f"{path} is no readable Feather table: it is damaged or wrongly named ({error})"
        raise OgmError(text[:400]) from error


def check_sizes(data: bytes, path: Path, types: list[Any], wanted: list[int]) -> None:
    """Refuse a table with stated buffer sizes above the limit for a file, before pyarrow allocates them.

    Parameters
    ----------
    data : bytes
        The whole file.
    path : Path
    types : list of pyarrow.DataType
        Types of all columns.
    wanted : list of int
        Numbers of the columns to unpack.

    Raises
    ------
    OgmError
        If the sizes exceed the limit.
    ValueError, struct.error
        If the file is damaged.
    """
    buffers = [_buffers(column_type) for column_type in types]
    total = 0
    for sizes in unpacked_sizes(data):
        if None in buffers or len(sizes) != sum(n for n in buffers if n is not None):  # dictionaries, nested columns
            total += sum(sizes)
            continue
        first = 0
        for column, count in enumerate(buffers):
            total += sum(sizes[first : first + (count or 0)]) if column in wanted else 0
            first += count or 0
    if total > current_limits().file:
        raise too_large(path, total, "file")


def _buffers(kind: Any) -> int | None:
    """Return the number of buffers of a column by its type; None if unknown here."""
    from pyarrow import types

    if types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind):
        return 2
    if types.is_string(kind) or types.is_large_string(kind) or types.is_binary(kind):
        return 3
    return None


_MAGIC = b"ARROW1"
_CONTINUED = b"\xff\xff\xff\xff"
_BLOCK = 24  # [byte] of a Block: offset, length of the metadata, length of the body
_MAX_BUFFERS = 2**22  # of one file; a sweep has about ten per batch


class _Table(NamedTuple):
    """Start of a FlatBuffers table."""

    data: memoryview
    start: int

    def field(self, number: int) -> int | None:
        """Return the position of a field's value; None for the default value."""
        table = self.start - _number(self.data, self.start, "<i")
        at = 4 + 2 * number
        offset = _number(self.data, table + at, "<H") if at < _number(self.data, table, "<H") else 0
        return self.start + offset if offset else None

    def table(self, number: int) -> "_Table | None":
        """Return the table referred to by a field."""
        at = self.field(number)
        return None if at is None else _Table(self.data, at + _number(self.data, at, "<I"))

    def structs(self, number: int, size: int) -> list[int]:
        """Return the positions of the structs of a vector."""
        if (at := self.field(number)) is None:
            return []
        at += _number(self.data, at, "<I")
        count = _number(self.data, at, "<I")
        if count > min((len(self.data) - at) // size, _MAX_BUFFERS):
            raise ValueError(f"it has a vector of {count} parts, which do not fit into it")
        return [at + 4 + size * k for k in range(count)]


def unpacked_sizes(data: bytes) -> list[list[int]]:
    """Return the stated unpacked sizes of the buffers of each batch of an IPC file [byte].

    Parameters
    ----------
    data : bytes
        The whole file. Dictionaries come first in the result.

    Raises
    ------
    ValueError, struct.error
        If it is no IPC file, or damaged.
    """
    view = memoryview(data)
    if not data.startswith(_MAGIC) or not data.endswith(_MAGIC):
        raise ValueError("it does not begin and end as an Arrow file")
    end = len(data) - len(_MAGIC) - 4
    length = _number(view, end, "<i")
    if not 0 < length <= end:
        raise ValueError(f"its footer has {length} bytes")
    footer = _root(view[end - length : end])
    return [_batch(view, _number(footer.data, at, "<q")) for k in (2, 3) for at in footer.structs(k, _BLOCK)]


def _batch(view: memoryview, start: int) -> list[int]:
    """Return the sizes of the buffers of a batch."""
    continued = bytes(_part(view, start, 4)) == _CONTINUED
    at = start + 4 if continued else start
    length = _number(view, at, "<i")
    message = _root(_part(view, at + 4, length))
    body = at + 4 + length
    kind = message.field(1)
    batch = message.table(2)
    if kind is not None and _number(message.data, kind, "<B") == 2 and batch is not None:
        batch = batch.table(1)  # a DictionaryBatch holds a RecordBatch
    if batch is None:
        return []
    packed = batch.field(3) is not None
    sizes = []
    for place in batch.structs(2, 16):
        offset, size = _number(batch.data, place, "<q"), _number(batch.data, place + 8, "<q")
        if packed and size >= 8:
            claimed = _number(view, body + offset, "<q")
            size = size if claimed == -1 else claimed
        if size < 0:
            raise ValueError(f"it has a buffer of {size} bytes")
        sizes.append(size)
    return sizes


def _root(data: memoryview) -> _Table:
    return _Table(data, _number(data, 0, "<I"))


def _part(data: memoryview, start: int, size: int) -> memoryview:
    if not 0 <= start <= start + size <= len(data):
        raise ValueError("it is cut short")
    return data[start : start + size]


def _number(data: memoryview, start: int, form: str) -> int:
    """Return an integer at a position, unpacked by a format of `struct`."""
    return int(struct.unpack(form, _part(data, start, struct.calcsize(form)))[0])
