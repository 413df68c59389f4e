"""Arrays in ``.npz`` files: written whole or not at all, and read only after all sizes have been checked."""

import math
import os
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import ArrayLike, NDArray

from ogm.files import OgmError, atomic_write
from ogm.limits import current_limits, too_large

__all__ = ["open_archive", "stated_format", "write_archive"]

_UNREADABLE = (  # what zipfile, zlib and numpy raise on damaged archives, and grids on what they held
    zipfile.BadZipFile,
    zlib.error,
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


def write_archive(path: str | os.PathLike[str], stated: str, **arrays: ArrayLike) -> None:
    """Write arrays, lossless and in one step, to an ``.npz`` file.

    Parameters
    ----------
    path : path
        Ends in ``.npz``. Whatever stood there stays whole until the new file is.
    stated : str
        Name and version of the format, kept as the array ``format``.
    **arrays
        By their names in the file.

    Raises
    ------
    ValueError
        If the path has another ending.
    OSError
        If the file cannot be written.
    """
    if not str(path).lower().endswith(".npz"):
        raise ValueError(f"a grid is saved as .npz, got {path}; pictures are made by ogm.plot.save_picture")
    with atomic_write(path) as file:
        named: dict[str, Any] = {"format": np.array(stated)} | {name: np.asarray(one) for name, one in arrays.items()}
        np.savez_compressed(file, **named)


@contextmanager
def open_archive(path: str | os.PathLike[str], wanted: str) -> Iterator[dict[str, NDArray]]:
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
        (`ogm.limits.MemoryLimits`), or the block fails on what it holds.
    """
    with _errors_of(path), zipfile.ZipFile(path) as archive:
        size = sum(item.file_size for item in archive.infolist())
        if size > current_limits().grid + _TEXTS:
            raise too_large("it", size, "grid")
        if (found := _format(archive)) != wanted:
            names = sorted(item.filename.removesuffix(".npy") for item in archive.infolist())
            raise OgmError(f"it is not an {wanted} file: found {found or f'arrays {names}'}"[:400])
        items = {item.filename.removesuffix(".npy"): item for item in archive.infolist()}
        yield {name: _read(archive, item) for name, item in items.items()}


def stated_format(path: str | os.PathLike[str]) -> str:
    """Return the format that an ``.npz`` file states, "" if none; errors as those of `open_archive`."""
    with _errors_of(path), zipfile.ZipFile(path) as archive:
        return _format(archive)


def _format(archive: zipfile.ZipFile) -> str:
    """Return the text of the array ``format``."""
    items = [item for item in archive.infolist() if item.filename == "format.npy" and item.file_size <= _TEXTS]
    return str(_read(archive, items[-1])) if items else ""


def _read(archive: zipfile.ZipFile, item: zipfile.ZipInfo) -> NDArray:
    """Return an array; its header must announce what the archive announces, before there is memory for it."""
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
        return npy.read_array(whole, allow_pickle=False)


@contextmanager
def _errors_of(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn the errors of a damaged file into one that names it."""
    try:
        yield
    except _UNREADABLE as error:
        if isinstance(error, FileNotFoundError | PermissionError | IsADirectoryError):
            raise
        text = str(error).replace(str(path), "it") or type(error).__name__
        what = text if isinstance(error, ValueError) else f"not a whole grid file (.npz): {text}"
        raise OgmError(f"{path}: {what}") from error
