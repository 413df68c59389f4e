"""LAS and LAZ clouds, by `laspy` and `lazrs`, after checking their counts against the size of the file."""

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.io.formats.table import Table
from ogm.io.reading import optional
from ogm.storage.files import OgmError
from ogm.storage.limits import current_limits, too_large

_FORMAT = 104  # position of the point format; its highest bit is set in LAZ
_AT_ONCE = 2**20  # points
_RECORD = 54  # [byte] least size of a variable length record


def parse_las(data: bytes, path: Path) -> Table:
    """Read LAS or LAZ: coordinates, intensity (16 bit) and, if present, gps_time."""
    laspy = optional("laspy", path)
    _check(data, path)
    if data[_FORMAT] & 0x80:
        optional("lazrs", path)
    try:
        # The single-threaded decoder is safer against wrong counts in damaged files.
        decoder = laspy.LazBackend.Lazrs
        with laspy.open(io.BytesIO(data), laz_backend=decoder, read_evlrs=False) as reader:
            header = reader.header
            space = current_limits().file if header.are_points_compressed else len(data) - header.offset_to_point_data
            size = header.point_count * header.point_format.size
            if size > current_limits().file:
                raise too_large(path, size, "file")
            if size > space:
                raise ValueError(f"its header states {header.point_count} points, which do not fit into it")
            columns = _columns(reader)
    except OgmError:
        raise
    except BaseException as error:  # laspy and its decoders let arbitrary errors of damaged files through
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":  # of lazrs, in Rust
            raise
        raise OgmError(f"{path} is no readable LAS cloud ({error}): it is damaged or wrongly named") from error
    return Table("LAS", columns)


def _columns(reader: Any) -> dict[str, NDArray[Any]]:
    """Read the points in parts, as the records take as much memory as the columns."""
    count, done = reader.header.point_count, 0
    has_time = "gps_time" in reader.header.point_format.dimension_names
    columns = {name: np.empty(count, np.float64) for name in ("x", "y", "z", *(("gps_time",) if has_time else ()))}
    columns["intensity"] = np.empty(count, np.uint16)
    while done < count:
        part = reader.read_points(min(_AT_ONCE, count - done))
        if not len(part):
            raise ValueError(f"it has {done} points, its header states {count}")
        with np.errstate(over="ignore", invalid="ignore"):  # such points are dropped later
            for name, column in columns.items():
                column[done : done + len(part)] = part[name]
        done += len(part)
    return columns


def _check(data: bytes, path: Path) -> None:
    """Check the counts that laspy and lazrs trust against the size of the file."""

    def number(at: int, size: int) -> int:
        return int.from_bytes(data[at : at + size], "little")

    start, records = number(96, 4), number(100, 4)  # position of the points, and number of records before them
    sound = data.startswith(b"LASF") and len(data) > _FORMAT and records * _RECORD <= start <= len(data)
    if sound and data[_FORMAT] & 0x80:  # LAZ: the points begin with the position of the chunk table
        table = number(start, 8)
        if table == 2**64 - 1:  # a stream: its position was known only at the end
            table = number(len(data) - 8, 8)
        sound = start < table <= len(data) - 8 and number(table + 4, 4) <= table - start
        sound = sound and layers_fit(data, start + 8, table)
    if not sound:
        raise OgmError(f"{path} is no complete LAS cloud: it is cut short, damaged or wrongly named")


_HEADER = struct.Struct("<2x16sHH32x")  # of a variable length record: user, number, length
_ITEMS, _ITEM = 32, struct.Struct("<HHH")  # position of the item count in the laszip record; type, size, version
_LAYERED = 3  # compressor
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # of POINT14, RGB14, RGBNIR14, WAVEPACKET14
_BYTES = 14  # BYTE14, with one layer per byte


def layers_fit(data: bytes, first: int, table: int) -> bool:
    """Return whether all layers end before the chunk table; True for points without layers.

    Parameters
    ----------
    data : bytes
        The whole file.
    first, table : int
        Positions of the first chunk and of the chunk table.
    """
    try:
        record = _laszip(data)
        if struct.unpack_from("<H", record)[0] != _LAYERED:
            return True
        count = struct.unpack_from("<H", record, _ITEMS)[0]
        items = [_ITEM.unpack_from(record, _ITEMS + 2 + _ITEM.size * k) for k in range(count)]
        point = sum(size for _, size, _ in items)
        layers = sum(size if kind == _BYTES else _LAYERS[kind] for kind, size, _ in items)
        sizes = struct.Struct(f"<{layers}I")
        while first < table:
            first += point + 4 + sizes.size + sum(sizes.unpack_from(data, first + point + 4))
    except (struct.error, KeyError):
        return False
    return first == table


def _laszip(data: bytes) -> bytes:
    """Return the laszip record, which describes the packing of the points; raise KeyError without one."""
    at, count = struct.unpack_from("<H", data, 94)[0], struct.unpack_from("<I", data, 100)[0]
    for _ in range(count):
        user, number, size = _HEADER.unpack_from(data, at)
        at += _HEADER.size
        if number == 22204 and user.startswith(b"laszip encoded"):
            return data[at : at + size]
        at += size
    raise KeyError("laszip encoded")
