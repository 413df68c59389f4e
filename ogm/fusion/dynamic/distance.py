"""Distance of cells to the nearest occupied cell, up to a cap."""

import numpy as np
from numpy.typing import NDArray

from ogm.jit import vector

LEVELS = 100  # steps in which a distance between 0 and the cap is kept
MAX_CAP = 11  # [cells] so that sums of two squares fit 8 bits


@vector
def capped_distance(mask: NDArray[np.uint8], cap: float, out: NDArray[np.uint8]) -> None:
    """Fill `out` (nx, ny) uint8 with the distance to the nearest occupied cell, in steps of cap / `LEVELS`.

    The exact Euclidean transform, by Meijster's two passes: squares of distances along rows, then the least of them
    plus the square of the distance between rows. What is further than the cap needs no value, so both passes look at
    few neighbours, in 8 bits.

    Parameters
    ----------
    mask : (nx, ny) uint8
        0 or 1.
    cap : float
        [cells], at most `MAX_CAP`.
    """
    nx, ny = mask.shape
    reach = int(np.ceil(cap))
    limit = np.uint8(reach * reach)
    table = np.empty(256, np.uint8)
    for square in range(256):
        table[square] = np.uint8(np.floor(min(np.sqrt(square), cap) / cap * LEVELS + 0.5))
    along = np.empty((nx, ny), np.uint8)
    line = np.full(ny + 2 * reach, limit, np.uint8)
    for i in range(nx):
        for j in range(ny):
            line[reach + j] = limit * (np.uint8(1) - mask[i, j])
        row = along[i]
        for j in range(ny):
            row[j] = line[reach + j]
        for s in range(1, reach):
            _lower(row, line[reach - s :], np.uint8(s * s))
            _lower(row, line[reach + s :], np.uint8(s * s))
    least = np.empty(ny, np.uint8)
    for i in range(nx):
        for j in range(ny):
            least[j] = along[i, j]
        for s in range(1, reach):
            if i >= s:
                _lower(least, along[i - s], np.uint8(s * s))
            if i + s < nx:
                _lower(least, along[i + s], np.uint8(s * s))
        for j in range(ny):
            out[i, j] = table[least[j]]


@vector
def _lower(least: NDArray[np.uint8], values: NDArray[np.uint8], square: np.uint8) -> None:
    for j in range(least.size):
        value = np.uint8(values[j] + square)
        least[j] = value if value < least[j] else least[j]
