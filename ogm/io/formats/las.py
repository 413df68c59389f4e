"""LAS and LAZ clouds, by `laspy` and `lazrs`."""

import io
from pathlib import Path

import numpy as np

from ogm.files import OgmError
from ogm.io.formats.table import Table
from ogm.io.reading import BYTE_LIMIT, optional

__all__ = ["parse_las"]

_FORMAT = 104  # position of the format of the points; its highest bit is set in LAZ
_RECORD = 54  # [byte] of a variable length record at least


def parse_las(data: bytes, path: Path) -> Table:
    """Read LAS or LAZ: coordinates, intensity (16 bit) and, where there is one, gps_time.

    A LAZ file made to do harm can still take much memory, for lazrs believes the sizes of its layers.
    """
    laspy = optional("laspy", path)
    _check(data, path)
    if data[_FORMAT] & 0x80:
        optional("lazrs", path)
    try:
        # Of its decoders, the one of a single thread trusts less of the counts of a damaged file.
        decoder = laspy.LazBackend.Lazrs
        with laspy.open(io.BytesIO(data), laz_backend=decoder, read_evlrs=False) as reader:
            header = reader.header
            space = BYTE_LIMIT if header.are_points_compressed else len(data) - header.offset_to_point_data
            if header.point_count * header.point_format.size > space:
                raise ValueError(f"its header promises {header.point_count} points, which do not fit in it")
            record = reader.read_points(-1)
        names = ["x", "y", "z", "intensity", *({"gps_time"} & set(header.point_format.dimension_names))]
        with np.errstate(over="ignore", invalid="ignore"):  # such points are dropped later
            columns = {name: np.asarray(record[name]) for name in names}
    except Exception as error:  # laspy and its decoders let through whatever a damaged file leads them to
        raise OgmError(f"{path} is no readable LAS cloud ({error}): it is damaged or wrongly named") from error
    return Table("LAS", columns)


def _check(data: bytes, path: Path) -> None:
    """Hold the counts that laspy and lazrs take on trust against the size of the file."""

    def number(at: int, size: int) -> int:
        return int.from_bytes(data[at : at + size], "little")

    start, records = number(96, 4), number(100, 4)  # where the points begin, how many records lie before them
    sound = data.startswith(b"LASF") and len(data) > _FORMAT and records * _RECORD <= start <= len(data)
    if sound and data[_FORMAT] & 0x80:  # LAZ: the points begin with the position of the table of chunks
        table = number(start, 8)
        if table == 2**64 - 1:  # a stream: its position was known only at the end
            table = number(len(data) - 8, 8)
        sound = start < table <= len(data) - 8 and number(table + 4, 4) <= table - start
    if not sound:
        raise OgmError(f"{path} is no whole LAS cloud: it is cut short, damaged or wrongly named")
