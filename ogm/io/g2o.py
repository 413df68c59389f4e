"""Poses of g2o files, which hold the vertices of optimised pose graphs."""

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ogm.io.reading import from_quaternions, read_lines
from ogm.storage.files import OgmError

_VERTICES = {"VERTEX_SE3:QUAT": 7, "VERTEX_SE2": 3}  # tag: numbers after the identifier
_MAX_ID = 2**53  # largest identifier that float64 represents


def read_g2o(path: Path) -> tuple[NDArray[np.int64], NDArray[np.float64], str]:
    """Return the vertex identifiers (K,), increasing, the poses (K, 4, 4), and the name of the format.

    ``VERTEX_SE3:QUAT id x y z qx qy qz qw`` and ``VERTEX_SE2 id x y theta`` are read; edges, parameters and other
    vertices are skipped. Errors: see `ogm.io.read_poses`.
    """
    rows: dict[int, tuple[int, str, list[float]]] = {}
    for n, (tag, *words) in read_lines(path):
        if tag not in _VERTICES:
            continue
        where = f"line {n} of {path}"
        try:
            number, values = int(words[0]), [float(word) for word in words[1:]]
        except (ValueError, IndexError):
            raise OgmError(f"{where} must be {tag}, an integer and {_VERTICES[tag]} numbers") from None
        if len(values) != _VERTICES[tag] or not all(map(math.isfinite, values)) or not 0 <= number < _MAX_ID:
            raise OgmError(f"{where} must be {tag}, an integer from 0 and {_VERTICES[tag]} finite numbers")
        if number in rows:
            raise OgmError(f"{where} repeats the vertex {number} of line {rows[number][0]}: remove one of them")
        rows[number] = n, tag, values
    if not rows:
        raise OgmError(f"{path} has no vertex ({', '.join(_VERTICES)}), wanted poses: the file is empty or incomplete")
    numbers = sorted(rows)
    table = np.array([_in_space(*rows[number][1:]) for number in numbers])
    lines = [rows[number][0] for number in numbers]
    poses = from_quaternions(table[:, :3], table[:, 3:], lambda k: f"line {lines[k]} of {path}")
    return np.array(numbers, np.int64), poses, "g2o"


def _in_space(tag: str, values: list[float]) -> list[float]:
    """Return position and quaternion of a vertex."""
    if tag == "VERTEX_SE3:QUAT":
        return values
    x, y, theta = values
    return [x, y, 0.0, 0.0, 0.0, math.sin(theta / 2), math.cos(theta / 2)]
