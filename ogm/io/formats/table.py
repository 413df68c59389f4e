"""Named columns of numbers, the common result of all parsers of point clouds, and shared helpers."""

import io
import itertools
import logging
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ogm.io.notices import notice
from ogm.storage.files import OgmError
from ogm.storage.limits import current_limits, too_large

log: logging.Logger = logging.getLogger(__name__)

POSITION = ("x", "y", "z")
INTENSITY = ("intensity", "reflectivity", "reflectance", "remission", "i")  # in order of preference
RING = ("ring", "laser_number", "channel", "laser_id", "line")
TIME = ("time", "timestamp", "time_stamp", "t", "offset_ns", "offset_time", "time_offset", "gps_time", "gpstime")
DOPPLER = ("doppler", "doppler_velocity", "radial_velocity", "range_rate", "velocity")
RCS = ("rcs", "radar_cross_section")
KNOWN = frozenset(POSITION + INTENSITY + RING + TIME + DOPPLER + RCS)


class Table(NamedTuple):
    """Columns of a file, before axes and scales are applied.

    Parameters
    ----------
    format : str
        Name of the format.
    columns : dict of str to (N,) array
        Numbers per point, under the file's own names and in its own types.
    shape : (rows, columns) or None
        Raster of an organised cloud, stored row by row in `columns`; None for a list of points.
    intensity_max : float or None
        Raw intensity that becomes 1 in this format; None if undefined.
    fields : tuple of str
        Names of all fields of the file, if `columns` holds only a part of them; else empty.
    headerless : bool
        Whether the file does not state its number of values per row.
    """

    format: str
    columns: dict[str, np.ndarray]
    shape: tuple[int, int] | None = None
    intensity_max: float | None = None
    fields: tuple[str, ...] = ()
    headerless: bool = False


@dataclass(frozen=True)
class Field:
    """A field with `count` numbers per point."""

    name: str
    type: np.dtype
    count: int = 1

    @property
    def length(self) -> int:
        """Size in a binary record [byte]."""
        return self.type.itemsize * self.count


def plain(name: str) -> str:
    """Return a field's name as in `KNOWN`: in lower case, without the ``scalar_`` of CloudCompare."""
    return name.lower().removeprefix("scalar_")


def refuse_doubles(names: Iterable[str], path: Path | str) -> None:
    """Raise if two fields are the same coordinate, except for case and ``scalar_``; log other duplicates.

    Parameters
    ----------
    names : iterable of str
        The file's own names, without padding.
    path : Path
        File name, for messages.
    """
    names = list(names)
    count = Counter(plain(name) for name in names)
    if doubled := [name for name in names if plain(name) in POSITION and count[plain(name)] > 1]:
        got = f"{', '.join(doubled)[:200]}, which differ only in case or scalar_"
        raise OgmError(f"{path} has the fields {got}, wanted one of each: remove or rename the others")
    if doubled := [name for name in names if plain(name) in KNOWN and count[plain(name)] > 1]:
        text = "%s has the fields %s, which differ only in case or scalar_: the first is used"
        notice(log, "doubled fields", text, path, ", ".join(doubled)[:200])


def binary_columns(
    fields: list[Field], points: int, body: memoryview, path: Path, *, planar: bool = False
) -> dict[str, np.ndarray]:
    """View every field in the bytes of the file, without a copy; of several values, the first.

    Parameters
    ----------
    fields : list of Field
        Fields of a record, in order and without gaps.
    points : int
        Number of records.
    body : memoryview
        Data bytes; bytes after the last record are ignored.
    path : Path
        File name, for messages.
    planar : bool
        Whether each field is stored for all points in turn, instead of in records.
    """
    record = sum(field.length for field in fields)
    check_size(record * points, points, body, path)
    if not points:
        return {field.name: np.empty(0, field.type) for field in fields}
    columns: dict[str, np.ndarray] = {}
    offset = 0
    for field in fields:
        if field.count > 0:
            stride = field.length if planar else record
            columns.setdefault(field.name, np.ndarray((points,), field.type, body, offset, (stride,)))
        offset += field.length * (points if planar else 1)
    return columns


def text_columns(fields: list[Field], points: int, body: memoryview, path: Path) -> dict[str, np.ndarray]:
    """Read every field from lines of numbers, one line per point; of several values, the first.

    Parameters: see `binary_columns`. Lines are read one by one to limit memory. A number of two characters becomes
    up to eight bytes, so text has its own limit.
    """
    check_text(body, path)
    per_line = sum(field.count for field in fields)
    check_size(2 * per_line * points - 1, points, body, path)  # a digit and a blank per number
    if not points:
        return {field.name: np.empty(0, field.type) for field in fields}
    try:
        try:
            table = _rows([field.type for field in fields], fields, points, body)
        except ValueError:  # nan or 12.0 in a column of integers
            loose = [field.type if field.type.kind == "f" else np.dtype(np.float64) for field in fields]
            table = _rows(loose, fields, points, body)
    except (ValueError, OverflowError) as error:
        raise OgmError(f"{path} has a line that is not {per_line} numbers, as stated by its header: {error}") from error
    if len(table) < points:
        raise OgmError(f"{path} has {len(table)} lines of points, its header states {points}: it is cut short")
    columns: dict[str, np.ndarray] = {}
    for i, field in enumerate(fields):
        columns.setdefault(field.name, table[str(i)][:, 0])
    return columns


def _rows(types: list[np.dtype], fields: list[Field], points: int, body: memoryview) -> np.ndarray:
    """Read lines of numbers as records of the given types."""
    row = np.dtype([(str(i), kind, (field.count,)) for i, (kind, field) in enumerate(zip(types, fields, strict=True))])
    filled = (line for line in io.TextIOWrapper(io.BytesIO(body), "ascii", "replace") if line.strip())
    lines = itertools.islice(filled, points)
    first = list(itertools.islice(lines, 1))  # loadtxt warns about empty input
    if not first:
        return np.empty(0, row)
    return np.loadtxt(itertools.chain(first, lines), row, comments=None, ndmin=1)


def check_size(needed: int, points: int, body: memoryview, path: Path) -> None:
    """Raise if the body is smaller than the header implies."""
    if needed > len(body):
        wanted = f"wanted at least {needed} for the stated {points} points"
        raise OgmError(f"{path} has {len(body)} bytes after its header, {wanted}: it is cut short or damaged")


def check_text(body: memoryview, path: Path) -> None:
    """Raise if text exceeds its limit."""
    if len(body) > current_limits().text:
        raise too_large(path, len(body), "text")
