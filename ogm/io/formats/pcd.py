"""PCD and PLY clouds with text headers: points as text or binary, and for PCD also packed or organised.

A library does not serve here: PCL itself wrote padding fields of COUNT 0 for years, which `pypcd4` refuses, and a
header must not determine the memory taken. The most common format also needs no further packages, except for
binary_compressed. For PLY, `plyfile` 1.1 is slower by more than a factor of 2 (135 times for a million points from a
packed file, 4 times for text) and allocates the size stated by a damaged header.
"""

import re
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ogm.io.formats.table import Field, Table, binary_columns, check_size, check_text, refuse_doubles, text_columns
from ogm.io.reading import optional
from ogm.storage.files import OgmError
from ogm.storage.limits import current_limits, too_large

_HEADER_LIMIT = 2**16  # [byte] within which a header must end
_LZF_EXPANSION = 88  # largest factor: 3 bytes of LZF unpack to 264
_KINDS = {f"{kind}{size}" for kind in "IU" for size in (1, 2, 4, 8)} | {"F4", "F8"}


class _Header(NamedTuple):
    fields: list[Field]
    width: int
    height: int
    points: int
    encoding: str


def parse_pcd(data: bytes, path: Path) -> Table:
    """Read PCD.

    Fields named ``_`` are padding. Bytes after the last point are ignored, because PCL fills its last memory page with
    zeros. VIEWPOINT is not applied: points stay in the frame in which they are stored.

    Parameters
    ----------
    data : bytes
        The whole file, unpacked.
    path : Path
        File name, for messages.
    """
    header, body = _split(data, path)
    if header.encoding == "ascii":
        columns = text_columns([f for f in header.fields if f.count > 0], header.points, body, path)
    elif header.encoding == "binary":
        columns = binary_columns(_repaired(header.fields, path), header.points, body, path)
    else:
        columns = _unpacked(header, body, path)
    columns.pop("_", None)
    shape = (header.height, header.width) if header.height > 1 else None
    return Table(f"PCD, {header.encoding}", columns, shape)


def _split(data: bytes, path: Path) -> tuple[_Header, memoryview]:
    """Split the header from the body."""
    entries: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in entries:
        end = data.find(b"\n", start, _HEADER_LIMIT)
        if end < 0:
            raise OgmError(f"{path} has no DATA line, wanted a PCD header: it is cut short or no PCD file")
        words = data[start:end].decode("ascii", "replace").split()
        start = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    return _checked(entries, path), memoryview(data)[start:]


def _checked(entries: dict[str, list[str]], path: Path) -> _Header:
    """Check the header's lines for consistency; like PCL, accept COLUMNS for FIELDS, and a missing HEIGHT as 1."""
    entries = {"HEIGHT": ["1"], **({"FIELDS": entries["COLUMNS"]} if "COLUMNS" in entries else {}), **entries}
    if missing := [key for key in ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT") if not entries.get(key)]:
        raise OgmError(f"{path} has no {', '.join(missing)} in its header: it is damaged or no PCD file")
    names = entries["FIELDS"]
    refuse_doubles((name for name in names if name != "_"), path)
    kinds = [kind.upper() + size for kind, size in zip(entries["TYPE"], entries["SIZE"], strict=False)]
    if not len(names) == len(entries["TYPE"]) == len(entries["SIZE"]) or not _KINDS.issuperset(kinds):
        got, wanted = f"{' '.join(kinds)[:80]} for {len(names)} FIELDS", f"one of {', '.join(sorted(_KINDS))} for each"
        raise OgmError(f"{path} has TYPE and SIZE {got} in its PCD header, wanted {wanted}: it is damaged")
    counts = _integers(entries, "COUNT", len(names), path) if "COUNT" in entries else [1] * len(names)
    if any(count < 1 for name, count in zip(names, counts, strict=True) if name != "_"):
        raise OgmError(f"{path} has COUNT {counts} in its PCD header, wanted 1 or more: it is damaged")
    (width,), (height,) = (_integers(entries, key, 1, path) for key in ("WIDTH", "HEIGHT"))
    (points,) = _integers(entries, "POINTS", 1, path) if "POINTS" in entries else [width * height]
    if min(width, height) < 0 or points != width * height:
        raise OgmError(f"{path} has POINTS {points} in its PCD header, wanted {width} x {height}: it is damaged")
    encoding = " ".join(entries["DATA"]).lower()
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise OgmError(f"{path} has DATA {encoding[:40]!r}, wanted ascii, binary or binary_compressed")
    types = [np.dtype(f"<{kind.lower()}") for kind in kinds]
    fields = [Field(*parts) for parts in zip(names, types, counts, strict=True)]
    return _Header(fields, width, height, points, encoding)


def _integers(entries: dict[str, list[str]], key: str, wanted: int, path: Path) -> list[int]:
    words = entries[key]
    digits = (word.removeprefix("-") for word in words)
    if len(words) != wanted or not all(d.isascii() and d.isdigit() and len(d) < 19 for d in digits):
        got = " ".join(words)[:80]
        raise OgmError(f"{path} has {key} {got!r} in its PCD header, wanted {wanted} integer(s): it is damaged")
    return [int(word) for word in words]


def _repaired(fields: list[Field], path: Path) -> list[Field]:
    """Correct a bug of old PCL versions in the COUNT of padding.

    Their `generateHeader` confused the size of the field after a gap with the size before it, so the fields behind the
    gap seem to lie elsewhere, while the sum over a record is right. A padding COUNT of 0 or less reveals such a header:
    without a gap, a correct header has no padding.
    """
    if all(field.count > 0 for field in fields):
        return fields
    last = max((i for i, field in enumerate(fields) if field.name != "_"), default=-1)
    repaired = fields[: last + 1]
    for i in range(1, last):
        if fields[i].name == "_":
            gap = fields[i].length + fields[i + 1].length - fields[i - 1].length
            repaired[i] = Field("_", np.dtype("u1"), gap)
    end, record = (sum(field.length for field in some) for some in (repaired, fields))
    repaired.append(Field("_", np.dtype("u1"), record - end))
    if min(field.count for field in repaired) < 0:
        raise OgmError(f"{path} has COUNT {[f.count for f in fields]} in its PCD header: it is damaged")
    return repaired


def _unpacked(header: _Header, body: memoryview, path: Path) -> dict[str, np.ndarray]:
    """Unpack LZF data, which stores each field for all points in turn."""
    if not header.points:
        return binary_columns(header.fields, 0, body, path)
    check_size(8, header.points, body, path)
    packed, size = struct.unpack("<II", body[:8])
    needed = sum(field.length for field in header.fields) * header.points
    check_size(8 + packed, header.points, body, path)
    if needed > current_limits().file:
        raise too_large(path, needed, "file")
    if size != needed or size > _LZF_EXPANSION * packed or min(field.count for field in header.fields) < 1:
        wanted = f"wanted {needed} for {header.points} points"
        raise OgmError(f"{path} has {packed} bytes for {size} unpacked, {wanted}: it is damaged")
    try:
        content = optional("lzf", path).decompress(bytes(body[8 : 8 + packed]), size) or b""
    except ValueError as error:
        raise OgmError(f"{path} has points that do not unpack ({error}): it is damaged") from error
    if len(content) != size:
        raise OgmError(f"{path} has points that do not unpack to {size} bytes: it is damaged")
    return binary_columns(header.fields, header.points, memoryview(content), path, planar=True)


_END = re.compile(rb"\nend_header\r?\n")  # on its own line: a comment may contain the word
_ORDER = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip


def parse_ply(data: bytes, path: Path) -> Table:
    """Read the element ``vertex`` of a PLY file; its properties must be single numbers.

    Elements before it are skipped, elements after it (faces) are ignored.

    Parameters
    ----------
    data, path
        See `ogm.io.formats.parse`.
    """
    encoding, elements, body = _split_ply(data, path)
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


def _split_ply(data: bytes, path: Path) -> tuple[str, list[tuple[str, int, list[Field | None]]], memoryview]:
    """Split the header from the body; list properties are None among the fields of their element."""
    end = _END.search(data, 0, _HEADER_LIMIT)
    if not data.startswith(b"ply") or end is None:
        raise OgmError(f"{path} has no complete PLY header: it is cut short or no PLY file")
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
        raise OgmError(f"{path} has lists in its PLY element {element}, wanted single numbers: write it without them")
    refuse_doubles((field.name for field in single), path)
    return single


def _after_lines(body: memoryview, count: int, path: Path) -> memoryview:
    check_text(body, path)
    text, start = bytes(body), 0
    for _ in range(count):
        if not (start := text.find(b"\n", start) + 1):
            raise OgmError(f"{path} ends before its vertices: it is cut short or damaged")
    return body[start:]
