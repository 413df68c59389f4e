"""Named columns of numbers: what every format of point clouds is read into, and helpers that formats share."""

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
INTENSITY = ("intensity", "reflectivity", "reflectance", "remission", "i")  # the first that is there counts
RING = ("ring", "laser_number", "channel", "laser_id", "line")
TIME = ("time", "timestamp", "time_stamp", "t", "offset_ns", "offset_time", "time_offset", "gps_time", "gpstime")
DOPPLER = ("doppler", "doppler_velocity", "radial_velocity", "range_rate", "velocity")
RCS = ("rcs", "radar_cross_section")
KNOWN = frozenset(POSITION + INTENSITY + RING + TIME + DOPPLER + RCS)


class Table(NamedTuple):
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
        Raw intensity that means 1 in this format; None where the format does not define it.
    fields : tuple of str
        The names of all that the file holds, where `columns` has not all of it; else empty.
    headerless : bool
        Whether nothing in the file states how many values a row has.
    """

    format: str
    columns: dict[str, np.ndarray]
    shape: tuple[int, int] | None = None
    intensity_max: float | None = None
    fields: tuple[str, ...] = ()
    headerless: bool = False


@dataclass(frozen=True)
class Field:
    """One number, or `count` of them, that every point has."""

    name: str
    type: np.dtype
    count: int = 1

    @property
    def length(self) -> int:
        """Bytes in a binary record."""
        return self.type.itemsize * self.count


def plain(name: str) -> str:
    """Return a field's name as spelled in `KNOWN`: in small letters, without the ``scalar_`` of CloudCompare."""
    return name.lower().removeprefix("scalar_")


def refuse_doubles(names: Iterable[str], path: Path | str) -> None:
    """Raise where two fields are one coordinate, but for capitals and ``scalar_``; of other fields the first counts.

    Parameters
    ----------
    names : iterable of str
        The file's own names, without those of padding.
    path : Path
        The file's name, for messages.
    """
    names = list(names)
    count = Counter(plain(name) for name in names)
    if doubled := [name for name in names if plain(name) in POSITION and count[plain(name)] > 1]:
        raise OgmError(
            f"{path} has the fields {', '.join(doubled)[:200]}, wanted one of each name (capitals and scalar_ "
            "make no difference): write the file with one of them, or rename the other"
        )
    if doubled := [name for name in names if plain(name) in KNOWN and count[plain(name)] > 1]:
        text = "%s has the fields %s, of which the first counts: capitals and scalar_ make no difference"
        notice(log, "doubled fields", text, path, ", ".join(doubled)[:200])


def binary_columns(
    fields: list[Field], points: int, body: memoryview, path: Path, *, planar: bool = False
) -> dict[str, np.ndarray]:
    """View every field in the bytes of the file, without a copy; of several values, the first.

    Parameters
    ----------
    fields : list of Field
        What a record holds, in order and without gaps.
    points : int
        How many records there are.
    body : memoryview
        The bytes; what follows the last record is left alone.
    path : Path
        The file's name, for messages.
    planar : bool
        Whether the fields lie one after the other, each for all points, rather than in records.
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

    The parameters are those of `binary_columns`. Lines are taken one by one, so that they need not all be in
    memory; still a number of two letters becomes one of up to eight bytes, so there is a limit of its own for text.
    """
    check_text(body, path)
    per_line = sum(field.count for field in fields)
    check_size(2 * per_line * points - 1, points, body, path)  # a digit and a blank for each number
    if not points:
        return {field.name: np.empty(0, field.type) for field in fields}
    try:
        try:
            table = _rows([field.type for field in fields], fields, points, body)
        except ValueError:  # nan or 12.0 where the header promises whole numbers
            loose = [field.type if field.type.kind == "f" else np.dtype(np.float64) for field in fields]
            table = _rows(loose, fields, points, body)
    except (ValueError, OverflowError) as error:
        raise OgmError(f"{path} has a line that is not {per_line} numbers as its header promises: {error}") from error
    if len(table) < points:
        raise OgmError(
            f"{path} has {len(table)} lines of points, its header promises {points}: it is cut short or damaged"
        )
    columns: dict[str, np.ndarray] = {}
    for i, field in enumerate(fields):
        columns.setdefault(field.name, table[str(i)][:, 0])
    return columns


def _rows(types: list[np.dtype], fields: list[Field], points: int, body: memoryview) -> np.ndarray:
    """Read lines of numbers as records of some types."""
    row = np.dtype([(str(i), kind, (field.count,)) for i, (kind, field) in enumerate(zip(types, fields, strict=True))])
    filled = (line for line in io.TextIOWrapper(io.BytesIO(body), "ascii", "replace") if line.strip())
    lines = itertools.islice(filled, points)
    first = list(itertools.islice(lines, 1))  # loadtxt warns of no line at all
    if not first:
        return np.empty(0, row)
    return np.loadtxt(itertools.chain(first, lines), row, comments=None, ndmin=1)


def check_size(needed: int, points: int, body: memoryview, path: Path) -> None:
    """Trust a header's numbers only as far as the file reaches."""
    if needed > len(body):
        raise OgmError(
            f"{path} has {len(body)} bytes after its header, wanted at least {needed} for the {points} "
            "points that the header promises: it is cut short or its header is damaged"
        )


def check_text(body: memoryview, path: Path) -> None:
    """Refuse more text than the limit allows."""
    if len(body) > current_limits().text:
        raise too_large(path, len(body), "text")
