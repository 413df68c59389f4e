"""Arrays in ``.npz`` files: written whole or not at all, and read only after sizes and checksums have been checked."""

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

UNREADABLE = (  # raised by zipfile, zlib and numpy on damaged archives, and by grids on their content
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    tokenize.TokenError,
    ArithmeticError,
    EOFError,
    LookupError,
    AttributeError,
    MemoryError,
    OSError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
)
_TEXTS = 2**20  # [bytes] for headers and texts
_CHECKSUMS = "checksums"  # array of the names of the others and the SHA-256 of what the archive holds of each


def write_archive(path: str | os.PathLike[str], stated: str, **arrays: ArrayLike) -> None:
    """Write arrays, lossless and in one step, to an ``.npz`` file.

    Parameters
    ----------
    path : path
        Ends in ``.npz``. Whatever stood there stays whole until the new file is.
    stated : str
        Name and version of the format, kept as the array ``format``.
    **arrays
        By their names in the file. One more is added, ``checksums``: rows of a name and the SHA-256 of its ``.npy``.

    Raises
    ------
    ValueError
        If the path has another ending.
    OSError
        If the file cannot be written.
    """
    if not str(path).lower().endswith(".npz"):
        raise ValueError(f"a grid is saved as .npz, got {path}; pictures are made by ogm.plot.save_picture")
    with atomic_write(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        named: dict[str, ArrayLike] = {"format": stated, **arrays}
        sums = [(name, _write(archive, name, one)) for name, one in named.items()]
        _write(archive, _CHECKSUMS, sums)


def attributes_checksum(attributes: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the attributes of a Zarr group but ``sha256``, as JSON with sorted keys."""
    rest = {name: value for name, value in attributes.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


@contextmanager
def open_archive(path: str | os.PathLike[str], wanted: str) -> Iterator[dict[str, NDArray[Any]]]:
    """Read the arrays that `write_archive` wrote. Nothing is unpickled.

    What is made of the arrays belongs into the ``with`` block: its errors are those of the file.

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
        If the file is damaged, of another format, announces arrays beyond the limit for a grid
        (`ogm.storage.limits.MemoryLimits`), or the block fails on what it holds.
    """
    with _errors_of(path), zipfile.ZipFile(path) as archive:
        size = sum(item.file_size for item in archive.infolist())
        if size > current_limits().grid + _TEXTS:
            raise too_large("it", size, "grid")
        if (found := _format(archive)) != wanted:
            names = sorted(item.filename.removesuffix(".npy") for item in archive.infolist())
            what = f"{found or f'arrays {names}'}"[:300] + update_hint(found, wanted)
            raise OgmError(f"it is not an {wanted} file: found {what}")
        items = {item.filename.removesuffix(".npy"): item for item in archive.infolist()}
        arrays = {name: _read(archive, item) for name, item in items.items()}
        _check(arrays)
        yield {name: array for name, (array, _) in arrays.items()}


def stated_format(path: str | os.PathLike[str]) -> str:
    """Return the format that an ``.npz`` file states, "" if none; errors as those of `open_archive`."""
    with _errors_of(path), zipfile.ZipFile(path) as archive:
        return _format(archive)


def _format(archive: zipfile.ZipFile) -> str:
    """Return the text of the array ``format``."""
    items = [item for item in archive.infolist() if item.filename == "format.npy" and item.file_size <= _TEXTS]
    return str(_read(archive, items[-1])[0]) if items else ""


class _Hashed:
    """A file of an archive; what is written or read is hashed on the way."""

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
    """Compare the checksums, which older files lack, with those of what was read."""
    if _CHECKSUMS not in arrays:
        return
    for name, wanted in arrays[_CHECKSUMS][0].tolist():
        if name not in arrays:
            raise OgmError(f"its array {name} is missing")
        if arrays[name][1] != wanted:
            raise OgmError(f"its array {name} is damaged: another SHA-256 than when it was saved")


def _read(archive: zipfile.ZipFile, item: zipfile.ZipInfo) -> tuple[NDArray[Any], str]:
    """Return an array and its checksum; its header must announce what the archive does, before there is memory."""
    name = item.filename.removesuffix(".npy")
    with archive.open(item) as file:
        header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
        shape, _, kind = header[npy.read_magic(file)](file)
        if kind.hasobject:
            raise OgmError(f"its array {name} holds Python objects (pickle), which are not read")
        if kind.kind not in "fU" or min(shape, default=0) < 0:
            raise OgmError(f"its array {name} has {kind} of shape {shape}, wanted floats or text")
        if file.tell() + math.prod(shape) * kind.itemsize != item.file_size:
            raise OgmError(f"its array {name} has {item.file_size} bytes, too few or too many for {kind} of {shape}")
    with archive.open(item) as whole:
        hashed: Any = _Hashed(whole)
        try:
            return npy.read_array(hashed, allow_pickle=False), hashed.checksum
        except (zlib.error, EOFError) as error:  # which name no array
            raise zipfile.BadZipFile(f"its array {name} is damaged: {error}") from error


@contextmanager
def _errors_of(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn the errors of a damaged file into one that names it."""
    try:
        yield
    except UNREADABLE as error:
        if isinstance(error, FileNotFoundError | PermissionError | IsADirectoryError):
            raise
        text = str(error).replace(str(path), "it") or type(error).__name__
        what = text if isinstance(error, ValueError) else f"not a whole grid file (.npz): {text}"
        raise OgmError(f"{path}: {what}") from error
