"""Bytes, text, JSON and arrays of files, with errors that name the file and what is wrong in it."""

import gzip
import importlib
import io
import json
import lzma
import math
import os
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.files import OgmError
from ogm.pose import check_pose

BYTE_LIMIT = 2**30  # [byte] of one unpacked file: 67 M points of 16 bytes
_UNIT = 1e-2  # departure of a quaternion from length 1 that rounding can make
_CHUNK = 2**20  # [byte] unpacked in one step
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
    (3, 0): np.lib.format.read_array_header_2_0,  # differs in the names of fields only, which are refused
}


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
        Its path without ``.xz`` or ``.gz``: its suffix gives the format.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If it is no plain file, empty, damaged, or larger than `BYTE_LIMIT`.
    OSError
        If the system does not let it be read.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}: check the name and the folder")
    if not path.is_file():
        raise OgmError(f"{path} is a folder or a device, wanted a file: give the scans one by one")
    packing = path.suffix.lower()
    openers: dict[str, Callable[[Path], Any]] = {".xz": lzma.LZMAFile, ".gz": gzip.GzipFile}
    content = bytearray()
    try:
        with openers.get(packing, lambda path: open(path, "rb"))(path) as stream:
            while len(content) <= BYTE_LIMIT and (chunk := stream.read(_CHUNK)):
                content += chunk
    except (lzma.LZMAError, gzip.BadGzipFile, zlib.error, EOFError, MemoryError) as error:
        raise OgmError(f"{path} is no whole {packing} file ({error}): it is cut short or wrongly named") from error
    if len(content) > BYTE_LIMIT:
        raise OgmError(
            f"{path} holds more than {BYTE_LIMIT} bytes, wanted one scan below that (ogm.io.BYTE_LIMIT): split it"
        )
    if not content:
        raise OgmError(f"{path} holds 0 bytes: was it written to its end?")
    return bytes(content), path.with_suffix("") if packing in openers else path


def optional(module: str, path: Path, extra: str = "io", verb: str = "read") -> Any:
    """Import a package of an extra; the error of a missing one has the line that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f'{path} cannot be {verb} without the package {module}: pip install "ogm-toolkit[{extra}]"', name=module
        ) from error


def read_text(path: Path, wanted: str) -> str:
    """Read a text file, UTF-8; an empty file is an empty text.

    Parameters
    ----------
    path : Path
    wanted : str
        What it should be, in words, for the error.
    """
    if path.is_file() and not path.stat().st_size:
        return ""
    try:
        text = read_bytes(path)[0].decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise OgmError(f"{path} is no text, wanted {wanted}: is its name right?")
    return text


def read_lines(path: Path) -> list[tuple[int, list[str]]]:
    """Read the words of every line that has some, with the number of the line."""
    text = read_text(path, "lines of words and numbers")
    return [(n, line.split()) for n, line in enumerate(text.splitlines(), start=1) if line.strip()]


def read_json(path: Path, kind: type, wanted: str) -> Any:
    """Read a JSON file whose outermost value is of a kind, `dict` or `list`.

    Parameters
    ----------
    path : Path
    kind : type
    wanted : str
        What it should be, in words, for the error.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}, wanted {wanted}: check the name and the folder")
    packed = path.suffix.lower() in (".xz", ".gz")
    data = read_bytes(path)[0] if packed else path.read_bytes()  # tables of a data set may be beyond BYTE_LIMIT
    try:
        value = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise OgmError(f"{path} is no JSON ({error}), wanted {wanted}: it is cut short or wrongly named") from error
    if not isinstance(value, kind):
        raise OgmError(
            f"{path} holds a JSON {type(value).__name__}, wanted a {kind.__name__}: {wanted}; is it another data "
            "set's, or another file of this one?"
        )
    return value


def need(value: Any, key: str, where: object, kind: type = object) -> Any:
    """Return an entry of a JSON object; raise if it is missing, or not of a kind, `dict` or `list`."""
    if not isinstance(value, dict) or key not in value:
        got = ", ".join(map(str, value))[:120] if isinstance(value, dict) else type(value).__name__
        raise OgmError(f"{where} has no {key!r}, only {got or 'nothing'}: is it of this data set?")
    if not isinstance(value[key], kind):
        raise OgmError(
            f"{key!r} of {where} is a {type(value[key]).__name__}, wanted a {kind.__name__}: is it of this data set?"
        )
    return value[key]


def need_numbers(value: Any, key: str, count: int | tuple[int, ...], where: object) -> NDArray[np.float64]:
    """Return an entry of a JSON object, which must be finite numbers of a shape."""
    return numbers(need(value, key, where), count, f"{key} of {where}")


def numbers(value: Any, count: int | tuple[int, ...], where: str) -> NDArray[np.float64]:
    """Return finite numbers of a shape; raise if `value` is something else."""
    shape = (count,) if isinstance(count, int) else count
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise OgmError(f"{where} must be numbers of shape {shape}, got {str(value)[:80]}") from error
    if array.shape != shape or not np.isfinite(array).all():
        raise OgmError(f"{where} must be finite numbers of shape {shape}, got {str(value)[:80]}")
    return array


def rigid(T: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """Return a transform of a file, (4, 4); raise if it is not rigid."""
    try:
        return check_pose(T, where)
    except ValueError as error:
        raise OgmError(str(error)) from error


def from_quaternions(
    positions: NDArray[np.float64], quaternions: NDArray[np.float64], where: Callable[[int], str]
) -> NDArray[np.float64]:
    """Return transforms (K, 4, 4) of a file.

    Parameters
    ----------
    positions : (K, 3) float64
        [m]
    quaternions : (K, 4) float64
        x, y, z, w; of length 1, but for rounding.
    where : function
        The place of row k in the file, for the error.
    """
    from scipy.spatial.transform import Rotation

    length = np.linalg.norm(quaternions, axis=1)
    bad = ~(np.isfinite(positions).all(axis=1) & (np.abs(length - 1) <= _UNIT))
    if bad.any():
        k = int(np.argmax(bad))
        raise OgmError(
            f"{where(k)} must have a finite position and a quaternion of length 1, got {length[k]:.4g}: "
            f"{positions[k].tolist()}, {quaternions[k].tolist()}"
        )
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    if len(poses):
        poses[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    poses[:, :3, 3] = positions
    return poses


def parse_array(data: bytes, path: Path, fits: Callable[[tuple[int, ...]], bool], wanted: str) -> NDArray[Any]:
    """View the numbers of an ``.npy`` file, whose header is trusted only as far as the file reaches.

    Parameters
    ----------
    data : bytes
        The whole file. (`numpy.load` allocates what the header promises before it reads on.)
    path : Path
        Its name, for messages.
    fits : function
        Whether an array of a shape is wanted.
    wanted : str
        What it should be, in words, for the error.
    """
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        if version not in _HEADERS:
            raise ValueError(f"its version is {version}, known are 1.0, 2.0 and 3.0")
        shape, fortran, dtype = _HEADERS[version](stream)
    except Exception as error:  # the header is Python text, which can be wrong in many ways
        raise OgmError(f"{path} has no readable numpy header ({error}), wanted {wanted}") from error
    if min(shape, default=0) < 0 or dtype.kind not in "fiu" or not fits(shape):
        raise OgmError(f"{path} holds an array of {dtype} and shape {shape}, wanted {wanted}")
    count, offset = math.prod(shape), stream.tell()
    if offset + count * dtype.itemsize > len(data):
        raise OgmError(
            f"{path} has {len(data) - offset} bytes after its header, wanted {count * dtype.itemsize} for "
            f"shape {shape}: it is cut short"
        )
    return np.frombuffer(data, dtype, count, offset).reshape(shape, order="F" if fortran else "C")
