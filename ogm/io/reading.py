"""Bytes, text, JSON and arrays of files, with errors that name the file and the problem."""

import gzip
import importlib
import io
import json
import lzma
import math
import os
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ogm.extras import import_problem
from ogm.pose import check_pose, quaternion_to_matrix
from ogm.storage.files import FilePath, OgmError
from ogm.storage.limits import current_limits, too_large

_UNIT = 1e-2  # departure of a quaternion from length 1 by rounding
_CHUNK = 2**20  # [byte] unpacked in one step
_XZ_MEMORY = 2**27  # [byte] limit for the .xz decoder; files of "xz -9" need half of it
_JSON_SIZES = {b",": 64, b":": 64, b"[": 96, b"{": 256}  # [byte] largest size in Python per character of JSON
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
    (3, 0): np.lib.format.read_array_header_2_0,  # differs only in field names, which are refused
}


def read_bytes(path: FilePath, limit: str = "file") -> tuple[bytes, Path]:
    """Read a file, unpacking ``.xz`` and ``.gz``.

    Parameters
    ----------
    path : path
    limit : str
        Field of `ogm.storage.limits.MemoryLimits` that bounds the unpacked content. No more is unpacked, so that a
        small packed file cannot fill the memory.

    Returns
    -------
    data : bytes
        Unpacked content, at least 1 byte.
    inner : Path
        Path without ``.xz`` or ``.gz``; its suffix gives the format.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If it is no regular file, empty, damaged, or larger than the limit.
    OSError
        If the system refuses to read it.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}: check the name and the folder")
    if not path.is_file():
        raise OgmError(f"{path} is a folder or a device, wanted a file: give the scans one by one")
    packing, max_size = path.suffix.lower(), getattr(current_limits(), limit)
    unpack = {".xz": _unpacked_xz, ".gz": _unpacked_gz}.get(packing)
    parts, size = [], 0
    try:
        with open(path, "rb") as file:
            whole = os.fstat(file.fileno()).st_size
            if unpack is None and whole > max_size:
                raise too_large(path, whole, limit)
            step = _CHUNK if unpack else max(whole + 1, _CHUNK)
            for part in unpack(file) if unpack else iter(lambda: file.read(step), b""):
                parts.append(part)
                size += len(part)
                if size > max_size:
                    raise too_large(path, None, limit)
    except (lzma.LZMAError, gzip.BadGzipFile, zlib.error, EOFError) as error:
        raise OgmError(f"{path} is no complete {packing} file ({error}): cut short or wrongly named") from error
    if not size:
        raise OgmError(f"{path} holds 0 bytes, wanted data: the file is incomplete")
    return parts[0] if len(parts) == 1 else b"".join(parts), path.with_suffix("") if unpack else path


def _unpacked_gz(file: IO[bytes]) -> Iterator[bytes]:
    """Unpack a gzip file, piece by piece."""
    with gzip.GzipFile(fileobj=file, mode="rb") as stream:
        while part := stream.read(_CHUNK):
            yield part


def _unpacked_xz(file: IO[bytes]) -> Iterator[bytes]:
    """Unpack an xz file, piece by piece, with bounded decoder memory, which `lzma.open` lacks."""
    rest = file.read(_CHUNK)
    while True:
        decoder = lzma.LZMADecompressor(lzma.FORMAT_AUTO, _XZ_MEMORY)
        while not decoder.eof:
            if decoder.needs_input and not rest and not (rest := file.read(_CHUNK)):
                raise EOFError("the end of its stream is missing")
            if part := decoder.decompress(rest, _CHUNK):
                yield part
            rest = b""
        rest = (decoder.unused_data or file.read(_CHUNK)).lstrip(b"\0")  # zeros may separate streams
        while not rest:
            if not (more := file.read(_CHUNK)):
                return
            rest = more.lstrip(b"\0")


def optional(module: str, path: Path, extra: str = "io", verb: str = "read") -> Any:
    """Import a package of an extra; if it is missing, the error has the install line."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        text = f"{path} cannot be {verb}: {import_problem(module, extra, error)}"
        raise ImportError(text, name=module) from error


def reason(error: BaseException, path: Path) -> str:
    """Return the text of a library's error without the path, which the new error already names."""
    return str(error).replace(str(path), "it").replace(f"{path.name}: ", "") or type(error).__name__


def read_text(path: Path, wanted: str) -> str:
    """Read a UTF-8 text file; an empty file is an empty text.

    Parameters
    ----------
    path : Path
    wanted : str
        Description of the expected content, for the error.
    """
    if path.is_file() and not path.stat().st_size:
        return ""
    try:
        text = read_bytes(path, "lines")[0].decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise OgmError(f"{path} is no text, wanted {wanted}: check its name")
    return text


def read_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the words of every line that is not blank."""
    for n, line in text_lines(read_text(path, "lines of words and numbers")):
        if words := line.split():
            yield n, words


def text_lines(text: str) -> Iterator[tuple[int, str]]:
    """Yield the lines of a text with their numbers, one at a time, as short strings take 50 bytes each."""
    start, n = 0, 0
    while start < len(text):
        end = text.find("\n", start)
        end = len(text) if end < 0 else end
        for line in text[start : end + 1].splitlines():  # also splits at other line ends
            n += 1
            yield n, line
        start = end + 1


def read_json(path: Path, kind: type, wanted: str, limit: str = "json") -> Any:
    """Read a JSON file with an outermost `dict` or `list`.

    Parameters
    ----------
    path : Path
    kind : type
        `dict` or `list`.
    wanted : str
        Description of the expected content, for the error.
    limit : str
        Field of `ogm.storage.limits.MemoryLimits` that bounds the Python objects.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}, wanted {wanted}: check the name and the folder")
    data = read_bytes(path, limit)[0] if path.stat().st_size else b""
    try:
        value = decode_json(data, path, limit)
    except OgmError:
        raise
    except (ValueError, RecursionError) as error:
        raise OgmError(f"{path} is no JSON ({error}), wanted {wanted}: it is cut short or wrongly named") from error
    if not isinstance(value, kind):
        found = type(value).__name__
        raise OgmError(f"{path} holds a JSON {found}, wanted a {kind.__name__}: {wanted}; check the file and dataset")
    return value


def decode_json(data: bytes, path: Path, limit: str = "json") -> Any:
    """Return the value of JSON bytes if their estimated size is within a limit; errors of `json.loads` pass through."""
    size = len(data) + sum(data.count(sign) * bytes_each for sign, bytes_each in _JSON_SIZES.items())
    if size > getattr(current_limits(), limit):
        raise too_large(path, size, limit)
    return json.loads(data)


def is_file_name(name: str) -> bool:
    """Return whether a file name or path, stated by another file, is valid on this system."""
    try:
        encoded = os.fsencode(name)
    except UnicodeEncodeError:
        return False
    return 0 < len(encoded) <= 255 and b"\0" not in encoded


def need(value: Any, key: str, where: object, kind: type = object) -> Any:
    """Return an entry of a JSON object; raise if it is missing or not of a kind, `dict` or `list`."""
    if not isinstance(value, dict) or key not in value:
        got = ", ".join(map(str, value))[:120] if isinstance(value, dict) else type(value).__name__
        raise OgmError(f"{where} has no {key!r}, only {got or 'nothing'}: check that it belongs to this dataset")
    if not isinstance(value[key], kind):
        found = type(value[key]).__name__
        raise OgmError(f"{key!r} of {where} is a {found}, wanted a {kind.__name__}: check that it is of this dataset")
    return value[key]


def need_numbers(value: Any, key: str, count: int | tuple[int, ...], where: object) -> NDArray[np.float64]:
    """Return finite numbers of a shape from an entry of a JSON object; raise for other entries."""
    return numbers(need(value, key, where), count, f"{key} of {where}")


def numbers(value: Any, count: int | tuple[int, ...], where: str) -> NDArray[np.float64]:
    """Return finite numbers of a shape; raise for other values."""
    shape = (count,) if isinstance(count, int) else count
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise OgmError(f"{where} must be numbers of shape {shape}, got {str(value)[:80]}") from error
    if array.shape != shape or not np.isfinite(array).all():
        raise OgmError(f"{where} must be finite numbers of shape {shape}, got {str(value)[:80]}")
    return array


def rigid(T: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """Return a transform (4, 4) of a file; raise if it is not rigid."""
    try:
        return check_pose(T, where)
    except ValueError as error:
        raise OgmError(str(error)) from error


def from_quaternions(
    positions: NDArray[np.float64], quaternions: NDArray[np.float64], where: Callable[[int], str]
) -> NDArray[np.float64]:
    """Return the transforms (K, 4, 4) of positions and quaternions.

    Parameters
    ----------
    positions : (K, 3) float64
        [m]
    quaternions : (K, 4) float64
        x, y, z, w; of length 1 except for rounding.
    where : function
        Name of row k in the file, for the error.
    """
    length = np.linalg.norm(quaternions, axis=1)
    bad = ~(np.isfinite(positions).all(axis=1) & (np.abs(length - 1) <= _UNIT))
    if bad.any():
        k = int(np.argmax(bad))
        got = f"{length[k]:.4g}: {positions[k].tolist()}, {quaternions[k].tolist()}"
        raise OgmError(f"{where(k)} must have a finite position and a quaternion of length 1, got {got}")
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    if len(poses):
        poses[:, :3, :3] = quaternion_to_matrix(quaternions)
    poses[:, :3, 3] = positions
    return poses


def parse_array(data: bytes, path: Path, fits: Callable[[tuple[int, ...]], bool], wanted: str) -> NDArray[Any]:
    """View the numbers of an ``.npy`` file, after checking its header against the size of the file.

    Parameters
    ----------
    data : bytes
        The whole file. (`numpy.load` allocates the size stated by the header before reading.)
    path : Path
        File name, for errors.
    fits : function
        Predicate for the shape.
    wanted : str
        Description of the expected array, for the error.
    """
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        if version not in _HEADERS:
            raise ValueError(f"its version is {version}, known are 1.0, 2.0 and 3.0")
        shape, fortran, dtype = _HEADERS[version](stream)
    except Exception as error:  # the header is Python text, which can be wrong in many ways
        raise OgmError(f"{path} has no readable numpy header ({error}), wanted {wanted}") from error
    sizes = all(type(size) is int and 0 <= size <= len(data) for size in shape)  # numpy accepts True as a size
    if not sizes or dtype.kind not in "fiu" or not fits(shape):
        raise OgmError(f"{path} holds an array of {dtype} and shape {shape}, wanted {wanted}")
    count, offset = math.prod(shape), stream.tell()
    if offset + count * dtype.itemsize > len(data):
        size = count * dtype.itemsize
        raise OgmError(f"{path} has {len(data) - offset} bytes of data, wanted {size} for {shape}: it is cut short")
    return np.frombuffer(data, dtype, count, offset).reshape(shape, order="F" if fortran else "C")
