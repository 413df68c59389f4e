"""Points that lie in a file one after the other, as records of bytes or as lines of text."""

import io
import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

__all__ = ["TEXT_LIMIT", "Field", "binary_columns", "check_size", "check_text", "text_columns"]

TEXT_LIMIT = 2**28  # [byte] of the points of one cloud of text: some 10 M points


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


def binary_columns(fields: list[Field], points: int, body: memoryview, path: Path) -> dict[str, np.ndarray]:
    """View every field where it lies, without a copy; of several values, the first.

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
    """
    record = sum(field.length for field in fields)
    check_size(record * points, points, body, path)
    if not points:
        return {field.name: np.empty(0, field.type) for field in fields}
    columns = {}
    offset = 0
    for field in fields:
        if field.count > 0:
            columns[field.name] = np.ndarray((points,), field.type, body, offset, (record,))
        offset += field.length
    return columns


def text_columns(fields: list[Field], points: int, body: memoryview, path: Path) -> dict[str, np.ndarray]:
    """Read every field from lines of numbers, one line per point; of several values, the first.

    The parameters are those of `binary_columns`. Lines are taken one by one, so that they need not all be in
    memory; still a number of two letters becomes one of up to eight bytes, so there is `TEXT_LIMIT`.
    """
    check_text(body, path)
    per_line = sum(field.count for field in fields)
    check_size(2 * per_line * points - 1, points, body, path)  # a digit and a blank for each number
    if not points:
        return {field.name: np.empty(0, field.type) for field in fields}
    row = np.dtype([(str(i), field.type, (field.count,)) for i, field in enumerate(fields)])
    filled = (line for line in io.TextIOWrapper(io.BytesIO(body), "ascii", "replace") if line.strip())
    lines = itertools.islice(filled, points)
    first = list(itertools.islice(lines, 1))  # loadtxt warns of no line at all
    try:
        table = (
            np.loadtxt(itertools.chain(first, lines), row, comments=None, ndmin=1)
            if first
            else np.empty(0, row)
        )
    except (ValueError, OverflowError) as error:
        raise ValueError(
            f"{path} has a line that is not {per_line} numbers as its header says: {error}"
        ) from error
    if len(table) < points:
        raise ValueError(
            f"{path} has {len(table)} lines of points, its header says {points}: it is cut short or damaged"
        )
    return {field.name: table[str(i)][:, 0] for i, field in enumerate(fields)}


def check_size(needed: int, points: int, body: memoryview, path: Path) -> None:
    """Trust a header's numbers only as far as the file reaches."""
    if needed > len(body):
        raise ValueError(
            f"{path} has {len(body)} bytes after its header, wanted at least {needed} for the {points} "
            "points that the header promises: it is cut short or its header is damaged"
        )


def check_text(body: memoryview, path: Path) -> None:
    """Refuse more text than `TEXT_LIMIT`."""
    if len(body) > TEXT_LIMIT:
        raise ValueError(
            f"{path} holds {len(body)} bytes of text, wanted at most {TEXT_LIMIT}: write it as binary, or split it"
        )
