"""The bytes of a ``foxglove.Grid``: protobuf's wire format, as far as this message needs it.

https://protobuf.dev/programming-guides/encoding; the numbers of the fields are those of foxglove's schemas.
"""

import struct
from types import SimpleNamespace
from typing import Any

from ogm.storage.files import error_context

_SIZES = {1: 8, 5: 4}  # [byte] of the wire types of fixed length
_XY, _XYZ, _XYZW = ("x", "y"), ("x", "y", "z"), ("x", "y", "z", "w")


def decode_foxglove_grid(data: bytes) -> SimpleNamespace:
    """Return a ``foxglove.Grid`` with the names of its fields.

    Raises
    ------
    OgmError
        If the bytes are none.
    """
    with error_context("it is no whole foxglove.Grid", ValueError, IndexError, TypeError, AttributeError, struct.error):
        top = _fields(data)
        pose, time = _fields(_last(top, 3, b"")), _fields(_last(top, 1, b""))
        fields = []
        for one in top.get(8, []):
            field = _fields(one)
            fields.append(
                SimpleNamespace(name=_last(field, 1, b"").decode(), offset=_whole(field, 2), type=_last(field, 3, 0))
            )
        return SimpleNamespace(
            timestamp=SimpleNamespace(sec=_last(time, 1, 0), nanosec=_last(time, 2, 0)),
            frame_id=_last(top, 2, b"").decode(),
            pose=SimpleNamespace(position=_vector(pose, 1, _XYZ), orientation=_vector(pose, 2, _XYZW)),
            column_count=_whole(top, 4),
            cell_size=_vector(top, 5, _XY),
            row_stride=_whole(top, 6),
            cell_stride=_whole(top, 7),
            fields=fields,
            data=_last(top, 9, b""),
        )


def _fields(data: bytes) -> dict[int, list[Any]]:
    """Return the values of a message by the numbers of their fields."""
    found: dict[int, list[Any]] = {}
    position = 0
    while position < len(data):
        key, position = _varint(data, position)
        number, wire = key >> 3, key & 7
        if wire == 0:
            value: Any
            value, position = _varint(data, position)
        else:
            if wire == 2:
                length, position = _varint(data, position)
            elif wire in _SIZES:
                length = _SIZES[wire]
            else:
                raise ValueError(f"wire type {wire}")
            value = data[position : position + length]
            position += length
            if position > len(data):
                raise ValueError("it is cut short")
        found.setdefault(number, []).append(value)
    return found


def _varint(data: bytes, position: int) -> tuple[int, int]:
    value = shift = 0
    while shift < 70:
        byte = data[position]
        value |= (byte & 0x7F) << shift
        position, shift = position + 1, shift + 7
        if byte < 0x80:
            return value, position
    raise ValueError("a number of more than 10 bytes")


def _last(fields: dict[int, list[Any]], number: int, default: Any) -> Any:
    """Return the value of a field; one that is missing has its default, as proto3 has it."""
    return fields.get(number, [default])[-1]


def _whole(fields: dict[int, list[Any]], number: int) -> int:
    return int(struct.unpack("<I", _last(fields, number, bytes(4)))[0])


def _vector(fields: dict[int, list[Any]], number: int, names: tuple[str, ...]) -> SimpleNamespace:
    """Return a message of doubles."""
    inner = _fields(_last(fields, number, b""))
    numbers = (struct.unpack("<d", _last(inner, k, bytes(8)))[0] for k in range(1, len(names) + 1))
    return SimpleNamespace(**dict(zip(names, numbers, strict=True)))
