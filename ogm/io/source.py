"""From a file on disk to its bytes, and the columns that every format turns them into."""

import gzip
import importlib
import io
import lzma
import os
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["BYTE_LIMIT", "Table", "optional", "read_bytes", "refuse_foreign"]

BYTE_LIMIT = 2**30  # [byte] of one unpacked cloud: 67 M points of 16 bytes

_CHUNK = 2**20  # [byte] unpacked in one step
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


@dataclass(frozen=True)
class Table:
    """What a file holds, before axes and scales are settled.

    Parameters
    ----------
    format : str
        What the file is, in words.
    columns : dict of str to (N,) array
        The numbers per point, under the file's own names and in its own types.
    shape : (rows, columns) or None
        The raster of an organised cloud, whose rows follow each other in `columns`; None for a list.
    intensity_max : float or None
        Raw intensity that the format calls 1; None where the format does not say.
    fields : tuple of str
        The names of all that the file holds, where `columns` has not all of it; else empty.
    """

    format: str
    columns: dict[str, np.ndarray]
    shape: tuple[int, int] | None = None
    intensity_max: float | None = None
    fields: tuple[str, ...] = ()


def read_bytes(path: str | os.PathLike[str]) -> tuple[bytes, Path]:
    """Read a file, unpacking ``.xz`` and ``.gz`` on the way.

    Parameters
    ----------
    path : path
        The file.

    Returns
    -------
    data : bytes
        Its unpacked content: at least 1 byte, at most `BYTE_LIMIT`, so that a small packed file cannot fill
        the memory.
    inner : Path
        Its path without ``.xz`` or ``.gz``: the name that tells the format.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is no plain file, empty, damaged, or larger than `BYTE_LIMIT`.
    OSError
        If the system does not let it be read.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}: check the name and the folder")
    if not path.is_file():
        raise ValueError(f"{path} is a folder or a device, wanted a file: give the scans one by one")
    packing = path.suffix.lower()
    content = bytearray()
    try:
        with open(path, "rb") as file:
            stream = _unpacking(file, packing)
            while len(content) <= BYTE_LIMIT and (chunk := stream.read(_CHUNK)):
                content += chunk
    except (lzma.LZMAError, gzip.BadGzipFile, zlib.error, EOFError, MemoryError) as error:
        raise ValueError(
            f"{path} is no whole {packing} file ({error}): it is damaged, cut short or wrongly named"
        ) from error
    if len(content) > BYTE_LIMIT:
        raise ValueError(
            f"{path} holds more than {BYTE_LIMIT} bytes, wanted one scan below that (ogm.io.BYTE_LIMIT): "
            "split it"
        )
    if not content:
        raise ValueError(f"{path} holds 0 bytes, wanted a point cloud: was it written to its end?")
    return bytes(content), path.with_suffix("") if packing in (".xz", ".gz") else path


def _unpacking(file: io.BufferedReader, packing: str) -> io.BufferedIOBase:
    if packing == ".xz":
        return lzma.LZMAFile(file)
    if packing == ".gz":
        return gzip.GzipFile(fileobj=file)
    return file


def refuse_foreign(data: bytes, path: Path, suffix: str) -> None:
    """Raise where the first bytes show a file to be something else than its name says."""
    for signature, what, suffixes in _SIGNATURES:
        if data.startswith(signature) and suffix not in suffixes:
            way_out = f"name it {' or '.join(suffixes)}" if suffixes else "give the point cloud itself"
            raise ValueError(f"{path} is {what}, wanted what its name says, {suffix}: {way_out}")


def optional(module: str, path: Path) -> Any:
    """Import a package of the ``io`` extra, or say how to get it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f'{path} cannot be read without the package {module}: pip install "ogm-toolkit[io]"', name=module
        ) from error
