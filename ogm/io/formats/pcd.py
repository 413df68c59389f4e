"""PCD clouds: ascii, binary and binary_compressed, as a list or organised.

Read here rather than by a library: PCL itself wrote padding fields of COUNT 0 for years, which `pypcd4`
refuses, and a header must not decide how much memory is taken. It also keeps the most common format free of
further packages; only binary_compressed needs one.
"""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ogm.io.formats.table import Field, Table, binary_columns, check_size, refuse_doubles, text_columns
from ogm.io.reading import optional
from ogm.storage.files import OgmError
from ogm.storage.limits import current_limits, too_large

_HEADER_LIMIT = 2**16  # [byte] within which the DATA line must end
_LZF_EXPANSION = 88  # at most: 3 bytes of LZF unpack to 264
_KINDS = {f"{kind}{size}" for kind in "IU" for size in (1, 2, 4, 8)} | {"F4", "F8"}


class _Header(NamedTuple):
    fields: list[Field]
    width: int
    height: int
    points: int
    encoding: str


def parse_pcd(data: bytes, path: Path) -> Table:
    """Read PCD.

    Fields named ``_`` are padding. Bytes after the last point are left alone, for PCL fills its last page of
    memory with zeros. VIEWPOINT is not applied: points stay in the frame in which they are stored.

    Parameters
    ----------
    data : bytes
        The whole file, unpacked.
    path : Path
        Its name, for messages.
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
    """Take the header off."""
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
    """Hold the header's lines against each other."""
    if missing := [key for key in ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT") if not entries.get(key)]:
        raise OgmError(f"{path} has no {', '.join(missing)} in its header: it is damaged or no PCD file")
    names = entries["FIELDS"]
    refuse_doubles((name for name in names if name != "_"), path)
    kinds = [kind.upper() + size for kind, size in zip(entries["TYPE"], entries["SIZE"], strict=False)]
    if not len(names) == len(entries["TYPE"]) == len(entries["SIZE"]) or not _KINDS.issuperset(kinds):
        raise OgmError(
            f"{path} has TYPE and SIZE {' '.join(kinds)[:80]} for {len(names)} FIELDS in its PCD header, "
            f"wanted one of {', '.join(sorted(_KINDS))} for each: it is damaged"
        )
    counts = _integers(entries, "COUNT", len(names), path) if "COUNT" in entries else [1] * len(names)
    if any(count < 1 for name, count in zip(names, counts, strict=True) if name != "_"):
        raise OgmError(f"{path} has COUNT {counts} in its PCD header, wanted 1 or more: it is damaged")
    (width,), (height,) = (_integers(entries, key, 1, path) for key in ("WIDTH", "HEIGHT"))
    (points,) = _integers(entries, "POINTS", 1, path) if "POINTS" in entries else [width * height]
    if min(width, height) < 0 or points != width * height:
        raise OgmError(
            f"{path} has POINTS {points} in its PCD header, wanted WIDTH {width} times HEIGHT {height}: it is damaged"
        )
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
        raise OgmError(
            f"{path} has {key} {' '.join(words)[:80]!r} in its PCD header, wanted {wanted} whole number(s): "
            "it is damaged"
        )
    return [int(word) for word in words]


def _repaired(fields: list[Field], path: Path) -> list[Field]:
    """Undo a mistake of old PCL versions in the COUNT of padding.

    Their `generateHeader` took the size of the field after a gap for that of the field before it, so the
    fields behind the gap seem to lie elsewhere, while the sum over a record is right. A padding COUNT of 0 or
    less gives such a header away: where there is no gap, a right one has no padding.
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
    """Undo LZF; the fields then lie one after the other, each for all points."""
    if not header.points:
        return binary_columns(header.fields, 0, body, path)
    check_size(8, header.points, body, path)
    packed, size = struct.unpack("<II", body[:8])
    needed = sum(field.length for field in header.fields) * header.points
    check_size(8 + packed, header.points, body, path)
    if needed > current_limits().file:
        raise too_large(path, needed, "file")
    if size != needed or size > _LZF_EXPANSION * packed or min(field.count for field in header.fields) < 1:
        raise OgmError(
            f"{path} has {packed} bytes that shall unpack to {size}, wanted {needed} for {header.points} "
            "points: it is damaged"
        )
    try:
        content = optional("lzf", path).decompress(bytes(body[8 : 8 + packed]), size) or b""
    except ValueError as error:
        raise OgmError(f"{path} has points that do not unpack ({error}): it is damaged") from error
    if len(content) != size:
        raise OgmError(f"{path} has points that do not unpack to {size} bytes: it is damaged")
    return binary_columns(header.fields, header.points, memoryview(content), path, planar=True)
