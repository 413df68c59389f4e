"""Rows of numbers in a text file of poses, each with the line that it stands in."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ogm.io.source import read_bytes

__all__ = ["NAMES", "OURS", "WANTED", "check_stamps", "numbers_of", "read_rows", "whole_numbers"]

OURS = "ogm.poses/1"
NAMES = ("stamp", "x", "y", "z", "qx", "qy", "qz", "qw")
WANTED = (
    "8 (TUM: stamp x y z qx qy qz qw), 12 (KITTI: the upper three rows of T_map_sensor), 13 (KITTI-360: frame "
    "number and those 12), 16 or 17 (all four rows)"
)
_LATEST = 1e11  # [s], year 5138: larger stamps count something smaller than seconds


def read_rows(path: Path) -> tuple[list[tuple[int, list[str]]], list[str], bool]:
    """Return the rows with their line numbers, the header's names ([] if none), and whether it is ours."""
    if path.is_file() and not path.stat().st_size:
        raise ValueError(f"{path} is empty, wanted poses: was it written to its end?")
    data, inner = read_bytes(path)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise ValueError(f"{path} is no text, wanted poses in lines of numbers: {WANTED}")
    csv = inner.suffix.lower() == ".csv"
    lines: list[tuple[int, list[str]]] = []
    ours = False
    for number, raw in enumerate(text.splitlines(), start=1):
        content, _, comment = raw.partition("#")
        if not lines and comment.strip().startswith("ogm.poses/"):
            version = comment.split()[0].rstrip(":")
            if version != OURS:
                raise ValueError(f"{path} is {version}, wanted {OURS}: it comes from a newer release of ogm")
            ours = True
        fields = content.split(",") if csv else content.split()
        if content.strip():
            lines.append((number, [field.strip() for field in fields]))
    header: list[str] = []
    if csv and lines:
        header = lines.pop(0)[1]
        if len(set(header)) != len(header) or set(header) - {"number"} != set(NAMES):
            raise ValueError(
                f"the header of {path} must be {','.join(NAMES)} and perhaps number, got {','.join(header)[:200]}"
            )
    if not lines:
        raise ValueError(f"{path} holds no pose, only comments or a header: was it written to its end?")
    return lines, header, ours


def numbers_of(path: Path, lines: list[tuple[int, list[str]]], columns: int) -> NDArray[np.float64]:
    """Return the table (K, columns) of finite numbers, or name the line that is none."""
    table = np.empty((len(lines), columns))
    for row, (line, fields) in enumerate(lines):
        if len(fields) != columns:
            raise ValueError(
                f"line {line} of {path} has {len(fields)} columns, those before it have {columns}"
            )
        try:
            table[row] = [float(field) for field in fields]
        except ValueError as error:
            raise ValueError(
                f"line {line} of {path} is no row of numbers: {' '.join(fields)[:80]!r}"
            ) from error
    bad = ~np.isfinite(table).all(axis=1)
    if bad.any():
        raise ValueError(f"line {lines[int(np.argmax(bad))][0]} of {path} holds NaN or inf: drop that pose")
    return table


def whole_numbers(path: Path, where: NDArray[np.int64], column: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return frame numbers, or name the line where they are none or do not increase."""
    bad = (column != np.floor(column)) | (np.abs(column) > 2**53)
    if bad.any():
        k = int(np.argmax(bad))
        raise ValueError(f"line {where[k]} of {path} must begin with a frame number, got {column[k]:g}")
    stuck = np.diff(column) <= 0
    if stuck.any():
        k = int(np.argmax(stuck))
        raise ValueError(
            f"frame numbers must increase, but line {where[k]} of {path} has {column[k]:.0f} and line "
            f"{where[k + 1]} has {column[k + 1]:.0f}: sort them, or drop what is double"
        )
    return column.astype(np.int64)


def check_stamps(path: Path, where: NDArray[np.int64], stamps: NDArray[np.float64]) -> None:
    """Raise where stamps count no seconds or do not increase, and name the line."""
    if np.abs(stamps).max() > _LATEST:
        k = int(np.argmax(np.abs(stamps)))
        raise ValueError(
            f"stamps must be seconds, got {stamps[k]:g} in line {where[k]} of {path}: divide nanoseconds by 1e9"
        )
    stuck = np.diff(stamps) <= 0
    if stuck.any():
        k = int(np.argmax(stuck))
        raise ValueError(
            f"stamps must increase, but line {where[k]} of {path} has {float(stamps[k])!r} s and line {where[k + 1]} "
            f"has {float(stamps[k + 1])!r} s: sort them, or drop what is double"
        )
