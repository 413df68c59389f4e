"""Text, JSON and arrays in, with errors that say what is wrong in which file."""

import io
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.io.source import read_bytes

__all__ = ["need", "numbers", "read_array", "read_json", "read_lines"]


def read_lines(path: Path) -> list[tuple[int, list[str]]]:
    """Read the words of every line that has some, with the number of the line; an empty file has none."""
    if path.is_file() and not path.stat().st_size:
        return []
    try:
        text = read_bytes(path)[0].decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} is no text, wanted lines of words and numbers: is its name right?"
        ) from error
    if "\0" in text:
        raise ValueError(f"{path} is no text, wanted lines of words and numbers: is its name right?")
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
    data = read_bytes(path)[0] if packed else path.read_bytes()  # a plain file is never larger than it looks
    try:
        value = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ValueError(
            f"{path} is no JSON ({error}), wanted {wanted}: it is cut short or wrongly named"
        ) from error
    if not isinstance(value, kind):
        raise ValueError(
            f"{path} holds a JSON {type(value).__name__}, wanted a {kind.__name__}: {wanted}; is it another data "
            "set's, or another file of this one?"
        )
    return value


def need(value: Any, key: str, where: str, kind: type = object) -> Any:
    """Return an entry of a JSON object, or say that it is missing, or not of a kind, `dict` or `list`."""
    if not isinstance(value, dict) or key not in value:
        got = ", ".join(map(str, value))[:120] if isinstance(value, dict) else type(value).__name__
        raise ValueError(f"{where} has no {key!r}, only {got or 'nothing'}: is it of this data set?")
    if not isinstance(value[key], kind):
        raise ValueError(
            f"{key!r} of {where} is a {type(value[key]).__name__}, wanted a {kind.__name__}: is it of this data set?"
        )
    return value[key]


def numbers(value: Any, count: int | tuple[int, ...], where: str) -> NDArray[np.float64]:
    """Return finite numbers of a shape, or say what is there instead."""
    shape = (count,) if isinstance(count, int) else count
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{where} must be numbers of shape {shape}, got {str(value)[:80]}") from error
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{where} must be finite numbers of shape {shape}, got {str(value)[:80]}")
    return array


def read_array(
    data: bytes, path: Path, fits: Callable[[tuple[int, ...], np.dtype[Any]], bool], wanted: str
) -> NDArray[np.float64]:
    """Read an ``.npy`` file of numbers, but make no room for what its header claims and the file does not hold.

    Parameters
    ----------
    data : bytes
        The whole file.
    path : Path
        Its name, for messages.
    fits : function of shape and dtype
        Whether such an array is wanted. Only numbers are read, whatever it says.
    wanted : str
        What it should be, in words, for the error.
    """
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        header = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = header(stream)
    except Exception as error:  # the header is Python text, which can be wrong in many ways
        raise ValueError(f"{path} has no readable numpy header ({error}), wanted {wanted}") from error
    if min(shape, default=0) < 0 or dtype.kind not in "fiu" or not fits(shape, dtype):
        raise ValueError(f"{path} holds an array of {dtype} and shape {shape}, wanted {wanted}")
    if stream.tell() + math.prod(shape) * dtype.itemsize > len(data):
        raise ValueError(
            f"{path} has {len(data)} bytes, too few for an array of shape {shape}: it is cut short"
        )
    return np.load(io.BytesIO(data), allow_pickle=False).astype(np.float64)
