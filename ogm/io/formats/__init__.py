"""Formats of point clouds. A new format is a parser in a module here, with an entry in `PARSERS`.

A parser takes the unpacked bytes of a file and its path (for messages) and returns a `Table` of named columns.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ogm.io.formats.feather import parse_feather
from ogm.io.formats.las import parse_las
from ogm.io.formats.pcd import parse_pcd, parse_ply
from ogm.io.formats.table import Table
from ogm.io.reading import parse_array
from ogm.storage.files import OgmError

__all__ = ["PARSERS", "Table", "parse"]

_NAMES = ("x", "y", "z", "intensity", "ring")
_FROM_TEXT = 'text becomes .npy by numpy.save("scan.npy", numpy.loadtxt(NAME))'


def parse_kitti(data: bytes, path: Path) -> Table:
    """Read KITTI ``.bin``: x, y, z, reflectance 0 to 1 as float32."""
    columns = _float_rows(data, path, 4)
    if not len(data) % 20 and columns["intensity"].max(initial=0) > 1 and _are_rings(np.frombuffer(data, "<f4")[4::5]):
        raise OgmError(
            f"{path} has intensities up to {columns['intensity'].max():g} as rows of 4 float32, and integers as every "
            "fifth value: its rows have 5 values (nuScenes), name it .pcd.bin"
        )
    return Table("KITTI", columns, intensity_max=1.0, headerless=True)


def parse_nuscenes(data: bytes, path: Path) -> Table:
    """Read nuScenes ``.pcd.bin``: x, y, z, intensity 0 to 255, ring as float32."""
    columns = _float_rows(data, path, 5)
    if not _are_rings(columns["ring"]):
        raise OgmError(
            f"{path} has fifth values from {columns['ring'].min():g} to {columns['ring'].max():g}, wanted rings, "
            "integers from 0 to 65535: its rows have another number of values, such as 4 (KITTI), name it .bin"
        )
    return Table("nuScenes", columns, intensity_max=255.0, headerless=True)


def _are_rings(values: np.ndarray) -> bool:
    """Return whether nearly all values are possible laser numbers."""
    with np.errstate(invalid="ignore"):
        whole = (values >= 0) & (values < 2**16) & (values == np.floor(values))
    return bool(np.count_nonzero(whole) >= 0.95 * values.size)


def _float_rows(data: bytes, path: Path, width: int) -> dict[str, np.ndarray]:
    wanted = f"rows of {width} float32: {', '.join(_NAMES[:width])}"
    if all(byte in b"\t\n\r" or 32 <= byte < 127 for byte in data[:4096]):
        raise OgmError(f"{path} is text, wanted {wanted}: {_FROM_TEXT}")
    if len(data) % (4 * width):
        raise OgmError(
            f"{path} has {len(data)} bytes, no multiple of {4 * width}, wanted {wanted}: it is cut short, or its rows "
            "have another number of values (4 in KITTI's .bin, 5 in nuScenes' .pcd.bin)"
        )
    return dict(zip(_NAMES, np.frombuffer(data, "<f4").reshape(-1, width).T, strict=False))


def parse_npy(data: bytes, path: Path) -> Table:
    """Read ``.npy``: (N, 3), (N, 4) or (N, 5) points, or an organised cloud (rows, columns, 3 or more).

    The values of a point are x, y, z, intensity, ring. Only the first four are read from an organised cloud, as
    further values have no common meaning. Pickled objects are refused.
    """

    def fits(shape: tuple[int, ...]) -> bool:
        return (len(shape) == 2 and 3 <= shape[1] <= 5) or (len(shape) == 3 and shape[2] >= 3)

    wanted = "numbers of shape (N, 3), (N, 4), (N, 5) or (rows, columns, 3 or more)"
    array = parse_array(data, path, fits, wanted)
    organised = array.ndim == 3
    flat = array.reshape(-1, array.shape[-1])[:, : 4 if organised else 5]
    columns = dict(zip(_NAMES, flat.T, strict=False))
    return Table("numpy array", columns, (array.shape[0], array.shape[1]) if organised else None)


PARSERS: dict[str, Callable[[bytes, Path], Table]] = {
    ".pcd.bin": parse_nuscenes,  # before .bin: the first matching ending is used
    ".bin": parse_kitti,
    ".pcd": parse_pcd,
    ".ply": parse_ply,
    ".feather": parse_feather,
    ".las": parse_las,
    ".laz": parse_las,
    ".npy": parse_npy,
}
_MAPS = (".npz", ".png", ".jpg", ".jpeg", ".pgm", ".yaml", ".yml", ".tif", ".tiff", ".nc", ".zarr")
_SIGNATURES = (
    (b"# .PCD", "a PCD cloud", (".pcd",)),
    (b"ply\n", "a PLY cloud", (".ply",)),
    (b"ply\r\n", "a PLY cloud", (".ply",)),
    (b"LASF", "a LAS cloud", (".las", ".laz")),
    (b"ARROW1", "an Arrow table", (".feather",)),
    (b"\x93NUMPY", "a numpy array", (".npy",)),
    (b"PK\x03\x04", "a zip archive", ()),
    (b"\x1f\x8b", "packed by gzip, which its name must show: .gz", ()),
    (b"\xfd7zXZ", "packed by xz, which its name must show: .xz", ()),
    (b"\x89PNG", "a PNG picture", ()),
    (b"\xff\xd8\xff", "a JPEG picture", ()),
    (b"%PDF", "a PDF document", ()),
    (b"\x89HDF", "an HDF5 file", ()),
    (b"version https://git-lfs", "a placeholder of Git LFS (fetch the file with git lfs pull)", ()),
)


def parse(data: bytes, path: Path) -> Table:
    """Read a point cloud by the ending of its name.

    Parameters
    ----------
    data : bytes
        The whole file, unpacked.
    path : Path
        File name, without ``.xz`` or ``.gz``.

    Raises
    ------
    OgmError
        If the ending is unknown, the first bytes belong to another format, or the file is damaged.
    """
    if (suffix := next((ending for ending in PARSERS if path.name.lower().endswith(ending)), None)) is None:
        is_map = path.suffix.lower() in _MAPS
        way_out = (
            "`ogm view` shows maps and pictures of maps" if is_map else f"name the file after its format; {_FROM_TEXT}"
        )
        wanted = f"wanted {', '.join(PARSERS)}, also with .xz or .gz"
        raise OgmError(f"{path} ends in {path.suffix or 'no suffix'}, {wanted}; {way_out}")
    for signature, found, suffixes in _SIGNATURES:
        if data.startswith(signature) and suffix not in suffixes:
            way_out = f"name it {' or '.join(suffixes)}" if suffixes else "give the point cloud itself"
            raise OgmError(f"{path} is {found}, wanted {suffix} as in its name: {way_out}")
    return PARSERS[suffix](data, path)
