"""KITTI, nuScenes, LAS and numpy files: bytes in, columns out."""

import io
import math
from pathlib import Path

import numpy as np

from ogm.io.source import BYTE_LIMIT, Table, optional

__all__ = ["parse_kitti", "parse_las", "parse_npy", "parse_nuscenes"]

_LAS_FORMAT = 104  # where the format of the points stands; its highest bit tells LAZ
_LAS_RECORD = 54  # [byte] of a variable length record at least
_NAMES = ("x", "y", "z", "intensity", "ring")


def parse_kitti(data: bytes, path: Path) -> Table:
    """Read KITTI ``.bin``: x, y, z, reflectance 0 to 1 as float32."""
    return Table("KITTI", _float_rows(data, path, 4), intensity_max=1.0)


def parse_nuscenes(data: bytes, path: Path) -> Table:
    """Read nuScenes ``.pcd.bin``: x, y, z, intensity 0 to 255, ring as float32."""
    return Table("nuScenes", _float_rows(data, path, 5), intensity_max=255.0)


def _float_rows(data: bytes, path: Path, width: int) -> dict[str, np.ndarray]:
    wanted = f"rows of {width} float32: {', '.join(_NAMES[:width])}"
    if all(byte in b"\t\n\r" or 32 <= byte < 127 for byte in data[:4096]):
        raise ValueError(f"{path} is text, wanted {wanted}: name it after the format it has")
    if len(data) % (4 * width):
        raise ValueError(
            f"{path} has {len(data)} bytes, which is no multiple of {4 * width}, wanted {wanted}: it is cut "
            "short, or has another number of values (4 in KITTI's .bin, 5 in nuScenes' .pcd.bin)"
        )
    rows = np.frombuffer(data, "<f4").reshape(-1, width)
    return {name: rows[:, i] for i, name in enumerate(_NAMES[:width])}


def parse_npy(data: bytes, path: Path) -> Table:
    """Read ``.npy``: (N, 3), (N, 4) or (N, 5) points, or an organised cloud (rows, columns, 3 or more).

    The values of a point are x, y, z, intensity, ring. Of an organised cloud the first four are read; what
    follows differs too much from file to file. Pickled objects are refused.
    """
    wanted = "numbers of shape (N, 3), (N, 4), (N, 5) or (rows, columns, 3 or more)"
    stream = io.BytesIO(data)
    try:
        # numpy.load would make room for what the header claims before it looks at the file.
        version = np.lib.format.read_magic(stream)
        if version == (1, 0):
            shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
        elif version in ((2, 0), (3, 0)):  # 3.0 differs in the names of fields only, which are refused
            shape, fortran, dtype = np.lib.format.read_array_header_2_0(stream)
        else:
            raise ValueError(f"its version is {version[0]}.{version[1]}, known are 1.0, 2.0 and 3.0")
    except Exception as error:  # the header is Python text, which can be wrong in many ways
        raise ValueError(f"{path} has no readable numpy header ({error}), wanted {wanted}") from error
    listed = len(shape) == 2 and 3 <= shape[1] <= 5
    organised = len(shape) == 3 and shape[2] >= 3
    if dtype.kind not in "fiu" or not (listed or organised) or min(shape) < 0:
        raise ValueError(f"{path} holds an array of {dtype} and shape {shape}, wanted {wanted}")
    count = math.prod(shape)
    offset = stream.tell()
    if offset + count * dtype.itemsize > len(data):
        raise ValueError(
            f"{path} has {len(data) - offset} bytes after its header, wanted {count * dtype.itemsize} for "
            f"shape {shape}: it is cut short"
        )
    array = np.frombuffer(data, dtype, count, offset).reshape(shape, order="F" if fortran else "C")
    flat = array.reshape(-1, shape[-1])
    columns = {name: flat[:, i] for i, name in enumerate(_NAMES[: min(shape[-1], 4 if organised else 5)])}
    return Table("numpy array", columns, (shape[0], shape[1]) if organised else None)


def parse_las(data: bytes, path: Path) -> Table:
    """Read LAS or LAZ: coordinates, intensity (16 bit) and, where there is one, gps_time.

    A LAZ file made to do harm can still take much memory, for lazrs believes the sizes of its layers.
    """
    laspy = optional("laspy", path)
    _check_las(data, path)
    if data[_LAS_FORMAT] & 0x80:
        optional("lazrs", path)
    try:
        # Of its decoders, the one of a single thread believes less of what a damaged file claims.
        decoder = laspy.LazBackend.Lazrs
        with laspy.open(io.BytesIO(data), laz_backend=decoder, read_evlrs=False) as reader:
            header = reader.header
            room = BYTE_LIMIT if header.are_points_compressed else len(data) - header.offset_to_point_data
            if header.point_count * header.point_format.size > room:
                raise ValueError(f"its header promises {header.point_count} points, which do not fit in it")
            record = reader.read_points(-1)
        names = ["x", "y", "z", "intensity", *({"gps_time"} & set(header.point_format.dimension_names))]
        with np.errstate(over="ignore", invalid="ignore"):  # such points are dropped later
            columns = {name: np.asarray(record[name]) for name in names}
    except Exception as error:  # laspy and its decoders let through whatever a damaged file leads them to
        raise ValueError(
            f"{path} is no readable LAS cloud ({error}): it is damaged or wrongly named"
        ) from error
    return Table("LAS", columns)


def _check_las(data: bytes, path: Path) -> None:
    """Hold the counts that laspy and lazrs take on trust against the size of the file."""

    def number(at: int, size: int) -> int:
        return int.from_bytes(data[at : at + size], "little")

    start, records = number(96, 4), number(100, 4)  # where the points begin, how many records lie before them
    sound = (
        data.startswith(b"LASF") and len(data) > _LAS_FORMAT and records * _LAS_RECORD <= start <= len(data)
    )
    if sound and data[_LAS_FORMAT] & 0x80:  # LAZ: the points begin with the place of the table of chunks
        table = number(start, 8)
        if table == 2**64 - 1:  # a stream: its place was known only at the end
            table = number(len(data) - 8, 8)
        sound = start < table <= len(data) - 8 and number(table + 4, 4) <= table - start
    if not sound:
        raise ValueError(f"{path} is no whole LAS cloud: it is cut short, damaged or wrongly named")
