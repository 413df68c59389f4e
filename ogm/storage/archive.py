"""Arrays in ``.npz`` files, written atomically; sizes and checksums are checked before reading."""

import hashlib
import json
import math
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import ArrayLike, NDArray

from ogm.storage.files import OgmError, atomic_write, update_hint
from ogm.storage.limits import current_limits, too_large

UNREADABLE = (  # errors of zipfile, zlib and numpy for damaged archives, and of grids for invalid content
    *(zipfile.BadZipFile, zlib.error, struct.error, tokenize.TokenError, ArithmeticError, EOFError, LookupError),
    *(AttributeError, MemoryError, OSError, RuntimeError, SyntaxError, TypeError, ValueError),
)
_MAX_TEXT = 2**20  # [bytes] for headers and texts
_CHECKSUMS = "checksums"  # array with rows of (array name, SHA-256 of its .npy)


def write_archive(path: str | os.PathLike[str], stated: str, **arrays: ArrayLike) -> None:
    """Write arrays to an ``.npz`` file, lossless and in one step.

    Parameters
    ----------
    path : path
        File name that ends in ``.npz``. An existing file is replaced only by a complete new file.
    stated : str
        Name and version of the format, stored as the array ``format``.
    **arrays
        Arrays by their names in the file. The array ``checksums`` is added: rows of (name, SHA-256 of its ``.npy``).

    Raises
    ------
    ValueError
        If the path has another ending.
    OSError
        If the file cannot be written.
    """
    if not str(path).lower().endswith(".npz"):
        raise ValueError(f"a grid is saved as .npz, got {path}; for pictures use ogm.plot.save_picture")
    with atomic_write(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        named: dict[str, ArrayLike] = {"format": stated, **arrays}
        sums = [(name, _write(archive, name, array)) for name, array in named.items()]
        _write(archive, _CHECKSUMS, sums)


def attributes_checksum(attributes: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the attributes of a Zarr group, without ``sha256``, as JSON with sorted keys."""
    rest = {name: value for name, value in attributes.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


@contextmanager
def open_archive(path: str | os.PathLike[str], wanted: str) -> Iterator[dict[str, NDArray[Any]]]:
    """Read the arrays of a file of `write_archive`. Nothing is unpickled.

    Build objects from the arrays inside the ``with`` block, so that its errors name the file.

    Parameters
    ----------
    path : path
    wanted : str
        Format that the file must state.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If the file is damaged, has another format, announces arrays beyond the limit for a grid
        (`ogm.storage.limits.MemoryLimits`), or the block rejects its content.
    """
    with _errors_of(path), zipfile.ZipFile(path) as archive:
        size = sum(item.file_size for item in archive.infolist())
        if size > current_limits().grid + _MAX_TEXT:
            raise too_large("it", size, "grid")
        if (found := _format(archive)) != wanted:
            names = sorted(item.filename.removesuffix(".npy") for item in archive.infolist())
            description = f"{found or f'arrays {names}'}"[:300] + update_hint(found, wanted)
            raise OgmError(f"it is not an {wanted} file: found {description}")
        items = {item.filename.removesuffix(".npy"): item for item in archive.infolist()}
        arrays = {name: _read(archive, item) for name, item in items.items()}
        _check(arrays)
        yield {name: array for name, (array, _) in arrays.items()}


def stated_format(path: str | os.PathLike[str]) -> str:
    """Return the format stated by an ``.npz`` file, or "". Errors: see `open_archive`."""
    with _errors_of(path), zipfile.ZipFile(path) as archive:
        return _format(archive)


def _format(archive: zipfile.ZipFile) -> str:
    """Return the text of the array ``format``."""
    items = [item for item in archive.infolist() if item.filename == "format.npy" and item.file_size <= _MAX_TEXT]
    return str(_read(archive, items[-1])[0]) if items else ""


class _Hashed:
    """File of an archive that hashes all bytes written or read."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self._sum = file, hashlib.sha256()

    def write(self, data: bytes) -> int:
        self._sum.update(data)
        return self._file.write(data)

    def read(self, size: int = -1) -> bytes:
        data = self._file.read(size)
        self._sum.update(data)
        return data

    @property
    def checksum(self) -> str:
        return self._sum.hexdigest()


def _write(archive: zipfile.ZipFile, name: str, array: ArrayLike) -> str:
    """Add an array and return its checksum."""
    with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
        hashed: Any = _Hashed(file)
        npy.write_array(hashed, np.asarray(array), allow_pickle=False)
        return str(hashed.checksum)


def _check(arrays: dict[str, tuple[NDArray[Any], str]]) -> None:
    """Compare the checksums with the arrays read; older files have none."""
    if _CHECKSUMS not in arrays:
        return
    for name, wanted in arrays[_CHECKSUMS][0].tolist():
        if name not in arrays:
            raise OgmError(f"its array {name} is missing")
        if arrays[name][1] != wanted:
            raise OgmError(f"its array {name} is damaged: its SHA-256 differs from the saved one")


def _read(archive: zipfile.ZipFile, item: zipfile.ZipInfo) -> tuple[NDArray[Any], str]:
    """Return an array and its checksum; the header must agree with the archive before memory is allocated."""
    name = item.filename.removesuffix(".npy")
    with archive.open(item) as file:
        header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
        shape, _, kind = header[npy.read_magic(file)](file)
        if kind.hasobject:
            raise OgmError(f"its array {name} holds Python objects (pickle), which are not read")
        if kind.kind not in "fU" or min(shape, default=0) < 0:
            raise OgmError(f"its array {name} has {kind} of shape {shape}, wanted floats or text")
        if file.tell() + math.prod(shape) * kind.itemsize != item.file_size:
            raise OgmError(f"its array {name} has {item.file_size} bytes, which do not fit {kind} of shape {shape}")
    with archive.open(item) as whole:
        hashed: Any = _Hashed(whole)
        try:
            return npy.read_array(hashed, allow_pickle=False), hashed.checksum
        except (zlib.error, EOFError) as error:  # these name no array
            raise zipfile.BadZipFile(f"its array {name} is damaged: {error}") from error


@contextmanager
def _errors_of(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn the errors of a damaged file into an `OgmError` that names the file."""
    try:
        yield
    except UNREADABLE as error:
        if isinstance(error, FileNotFoundError | PermissionError | IsADirectoryError):
            raise
        text = str(error).replace(str(path), "it") or type(error).__name__
        problem = text if isinstance(error, ValueError) else f"not a complete grid file (.npz): {text}"
        raise OgmError(f"{path}: {problem}") from error
