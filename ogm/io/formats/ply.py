"""PLY clouds: ascii, binary_little_endian and binary_big_endian.

Read here rather than by `plyfile` 1.1, which is slower by more than a factor of 2 (135 times for a million points
from a packed file, 4 times for text) and allocates what a damaged header promises.
"""

import re
from pathlib import Path

import numpy as np

from ogm.io.formats.table import Field, Table, binary_columns, check_size, check_text, refuse_doubles, text_columns
from ogm.storage.files import OgmError

_HEADER_LIMIT = 2**16  # [byte] within which the header must end
_END = re.compile(rb"\nend_header\r?\n")  # a line of its own: a comment may hold the word
_ORDER = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip


def parse_ply(data: bytes, path: Path) -> Table:
    """Read the element ``vertex`` of a PLY file, whose properties must be single numbers.

    Elements before it are stepped over, elements after it (faces) are left alone.

    Parameters
    ----------
    data, path
        See `ogm.io.formats.parse`.
    """
    encoding, elements, body = _split(data, path)
    for name, count, fields in elements:
        if name == "vertex":
            read = text_columns if encoding == "ascii" else binary_columns
            return Table(f"PLY, {encoding}", read(_single(fields, name, path), count, body, path))
        if encoding == "ascii":
            body = _after_lines(body, count, path)
        else:
            length = count * sum(field.length for field in _single(fields, name, path))
            check_size(length, count, body, path)
            body = body[length:]
    raise OgmError(f"{path} has no element vertex in its PLY header, wanted points: it is no point cloud")


def _split(data: bytes, path: Path) -> tuple[str, list[tuple[str, int, list[Field | None]]], memoryview]:
    """Take the header off; a property that is a list is None among its element's fields."""
    end = _END.search(data, 0, _HEADER_LIMIT)
    if not data.startswith(b"ply") or end is None:
        raise OgmError(f"{path} has no whole PLY header: it is cut short or no PLY file")
    encoding = ""
    elements: list[tuple[str, int, list[Field | None]]] = []
    for line in data[: end.start()].decode("ascii", "replace").split("\n")[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", ("ascii" | "binary_little_endian" | "binary_big_endian") as encoding, _]:
                pass
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 19:
                elements.append((name, int(count), []))
            case ["property", "list", _, _, _] if elements:
                elements[-1][2].append(None)
            case ["property", kind, name] if elements and encoding and kind in _TYPES:
                elements[-1][2].append(Field(name, np.dtype(_ORDER[encoding] + _TYPES[kind])))
            case _:
                raise OgmError(f"{path} has the line {line[:80]!r} in its PLY header: it is damaged")
    return encoding, elements, memoryview(data)[end.end() :]


def _single(fields: list[Field | None], element: str, path: Path) -> list[Field]:
    single = [field for field in fields if field is not None]
    if len(single) < len(fields):
        raise OgmError(
            f"{path} has lists in its PLY element {element}, wanted single numbers: write the points without them"
        )
    refuse_doubles((field.name for field in single), path)
    return single


def _after_lines(body: memoryview, count: int, path: Path) -> memoryview:
    check_text(body, path)
    text, start = bytes(body), 0
    for _ in range(count):
        if not (start := text.find(b"\n", start) + 1):
            raise OgmError(f"{path} ends before its vertices: it is cut short or damaged")
    return body[start:]
