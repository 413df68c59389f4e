"""Points that lie in a file one after the other, as records of bytes or as lines of text."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

__all__ = ["Field", "binary_columns", "check_size", "text_columns"]


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

    The parameters are those of `binary_columns`.
    """
    per_line = sum(field.count for field in fields)
    check_size(2 * per_line * points - 1, points, body, path)  # a digit and a blank for each number
    if not points:
        return {field.name: np.empty(0, field.type) for field in fields}
    row = np.dtype([(str(i), field.type, (field.count,)) for i, field in enumerate(fields)])
    lines = [line for line in str(body, "ascii", "replace").splitlines() if line.strip()][:points]
    if len(lines) < points:
        raise ValueError(
            f"{path} has {len(lines)} lines of points, its header says {points}: it is cut short or damaged"
        )
    try:
        table = np.loadtxt(lines, row, comments=None, ndmin=1)
    except (ValueError, OverflowError) as error:
        raise ValueError(
            f"{path} has a line that is not {per_line} numbers as its header says: {error}"
        ) from error
    return {field.name: table[str(i)][:, 0] for i, field in enumerate(fields)}


def check_size(needed: int, points: int, body: memoryview, path: Path) -> None:
    """Trust a header's numbers only as far as the file reaches."""
    if needed > len(body):
        raise ValueError(
            f"{path} has {len(body)} bytes after its header, wanted at least {needed} for the {points} "
            "points that the header promises: it is cut short or its header is damaged"
        )
