"""How large the buffers of an Arrow IPC file become when they are unpacked: pyarrow allocates what each one claims.

Formats: ``Message.fbs``, ``File.fbs`` of Apache Arrow, in the encoding of FlatBuffers. A compressed buffer begins with
its size when unpacked, or with -1 where it is stored as it is.
"""

import struct
from typing import NamedTuple

_MAGIC = b"ARROW1"
_CONTINUED = b"\xff\xff\xff\xff"
_BLOCK = 24  # [byte] of a Block: offset, length of the metadata, length of the body
_MOST = 2**22  # buffers of one file; a sweep has some ten per batch


class _Table(NamedTuple):
    """A table of FlatBuffers: where it begins."""

    data: memoryview
    start: int

    def field(self, number: int) -> int | None:
        """Return where the value of a field stands; None where it has its default."""
        table = self.start - _number(self.data, self.start, "<i")
        at = 4 + 2 * number
        offset = _number(self.data, table + at, "<H") if at < _number(self.data, table, "<H") else 0
        return self.start + offset if offset else None

    def table(self, number: int) -> "_Table | None":
        """Return the table that a field refers to."""
        at = self.field(number)
        return None if at is None else _Table(self.data, at + _number(self.data, at, "<I"))

    def structs(self, number: int, size: int) -> list[int]:
        """Return where the structs of a vector stand."""
        at = self.field(number)
        if at is None:
            return []
        at += _number(self.data, at, "<I")
        count = _number(self.data, at, "<I")
        if count > min((len(self.data) - at) // size, _MOST):
            raise ValueError(f"it has a vector of {count} parts, which do not fit in it")
        return [at + 4 + size * k for k in range(count)]


def unpacked_sizes(data: bytes) -> list[list[int]]:
    """Return the sizes that the buffers of each batch of an IPC file claim to have when unpacked [byte].

    Parameters
    ----------
    data : bytes
        The whole file; dictionaries come first.

    Raises
    ------
    ValueError, struct.error
        If it is no such file, or damaged.
    """
    view = memoryview(data)
    if not data.startswith(_MAGIC) or not data.endswith(_MAGIC):
        raise ValueError("it does not begin and end as an Arrow file does")
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
    if (
        kind is not None and _number(message.data, kind, "<B") == 2 and batch is not None
    ):  # a DictionaryBatch holds a RecordBatch
        batch = batch.table(1)
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
    """Return a whole number."""
    return int(struct.unpack(form, _part(data, start, struct.calcsize(form)))[0])
