"""Formats of point clouds: a new one is a module here, with a function in `PARSERS`.

A parser takes the unpacked bytes of a file and its path (for messages) and returns a `Table` of named columns.
"""

from collections.abc import Callable
from pathlib import Path

from ogm.io.formats.feather import parse_feather
from ogm.io.formats.las import parse_las
from ogm.io.formats.pcd import parse_pcd
from ogm.io.formats.ply import parse_ply
from ogm.io.formats.raw import parse_kitti, parse_npy, parse_nuscenes
from ogm.io.formats.table import Table
from ogm.storage.files import OgmError

__all__ = ["PARSERS", "Table", "parse"]

PARSERS: dict[str, Callable[[bytes, Path], Table]] = {
    ".pcd.bin": parse_nuscenes,  # before .bin: the first ending that fits is taken
    ".bin": parse_kitti,
    ".pcd": parse_pcd,
    ".ply": parse_ply,
    ".feather": parse_feather,
    ".las": parse_las,
    ".laz": parse_las,
    ".npy": parse_npy,
}
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
        Its name, without ``.xz`` or ``.gz``.

    Raises
    ------
    OgmError
        If the ending is not known, the first bytes are another format's, or the file is damaged.
    """
    suffix = next((one for one in PARSERS if path.name.lower().endswith(one)), None)
    if suffix is None:
        raise OgmError(
            f"{path} ends in {path.suffix or 'no suffix'}, wanted {', '.join(PARSERS)}, or one of these "
            "and .xz or .gz: name the file after its format"
        )
    for signature, what, suffixes in _SIGNATURES:
        if data.startswith(signature) and suffix not in suffixes:
            way_out = f"name it {' or '.join(suffixes)}" if suffixes else "give the point cloud itself"
            raise OgmError(f"{path} is {what}, wanted a file as its name promises, {suffix}: {way_out}")
    return PARSERS[suffix](data, path)
