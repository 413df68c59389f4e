"""Particles of equal weight, and the kernels that predict them and sort them into cells.

Positions are in map coordinates, relative to the corner of the window [m], so that float32 suffices at any distance
from the origin. Cells are numbered ``ix * ny + iy`` in the order of the window. The kernels check nothing.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.dynamic.hashed_noise import hashed, index
from ogm.jit import inline, kernel


class Particles(NamedTuple):
    """Particles of equal weight, sorted by cell.

    Attributes
    ----------
    x, y : (n,) float32
        Position relative to the corner of the window [m].
    vx, vy : (n,) float32
        Velocity over ground along the axes of the map [m/s].
    start : (cells + 1,) int32
        Cell c = ix * ny + iy has the particles ``start[c]:start[c + 1]``.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    vx: NDArray[np.float32]
    vy: NDArray[np.float32]
    start: NDArray[np.int32]


class Step(NamedTuple):
    """Motion of particles from one scan to the next: constant velocity and noise.

    Attributes
    ----------
    seconds : float32
    shift : (float32, float32)
        Shift of the corner of the window [m].
    noise : (float32, float32)
        Standard deviations of position [m] and velocity [m/s] along each axis.
    resolution : float32
        Side of a cell [m].
    shape : (int, int)
        Cells along x and y.
    key : uint64
        Key of the random numbers of the scan.
    """

    seconds: np.float32
    shift: tuple[np.float32, np.float32]
    noise: tuple[np.float32, np.float32]
    resolution: np.float32
    shape: tuple[int, int]
    key: np.uint64


def no_particles(capacity: int, cells: int) -> Particles:
    """Return empty arrays for particles."""
    x, y, vx, vy = np.empty((4, capacity), np.float32)
    return Particles(x, y, vx, vy, np.zeros(cells + 1, np.int32))


@inline
def _moved(p: Any, k: int, h: Any, step: Any, normals: Any) -> Any:
    """Return the position of particle k after the step, identical in all kernels."""
    x = p.x[k] + p.vx[k] * step.seconds + step.noise[0] * normals[index(h, 0)] - step.shift[0]
    y = p.y[k] + p.vy[k] * step.seconds + step.noise[0] * normals[index(h, 1)] - step.shift[1]
    return x, y


@kernel
def count_in_cells(
    p: Particles, span: tuple[int, int], step: Step, normals: np.ndarray, cell: np.ndarray, count: np.ndarray
) -> None:
    """Predict the particles [span[0], span[1]), write their cells (-1 outside the window), and count them.

    Parameters
    ----------
    p : Particles
    span : (int, int)
    step : Step
    normals : (4096,) float32
    cell : (n,) int32
        Output: cell of each particle.
    count : (cells,) int32
        Output: number of particles in each cell.
    """
    nx, ny = step.shape
    per_metre = np.float32(1) / step.resolution
    zero, high_x, high_y = np.float32(0), np.float32(nx), np.float32(ny)
    count[:] = 0
    for k in range(span[0], span[1]):
        h = hashed(np.uint64(k), step.key)
        x, y = _moved(p, k, h, step, normals)
        u, v = x * per_metre, y * per_metre
        c = np.int32(-1)
        if u >= zero and v >= zero and u < high_x and v < high_y:
            c = np.int32(u) * np.int32(ny) + np.int32(v)
            count[c] += 1
        cell[k] = c


@kernel
def cell_starts(count: np.ndarray, start: np.ndarray) -> None:
    """Turn counts per part and cell, (parts, cells) int32, into first indices, and fill `start` (cells + 1,)."""
    parts, cells = count.shape
    total = np.int32(0)
    for c in range(cells):
        start[c] = total
        for part in range(parts):
            n = count[part, c]
            count[part, c] = total
            total += n
    start[cells] = total


@kernel
def sort_into_cells(
    p: Particles,
    span: tuple[int, int],
    step: Step,
    normals: np.ndarray,
    cell: np.ndarray,
    place: np.ndarray,
    out: Particles,
) -> None:
    """Predict the particles [span[0], span[1]) again, and write them sorted by cell (counting sort).

    Parameters
    ----------
    p, span, step, normals, cell
        See `count_in_cells`.
    place : (cells,) int32
        Index of the part's next particle in each cell, changed in place.
    out : Particles
        Output, except `start`.
    """
    for k in range(span[0], span[1]):
        c = cell[k]
        if c < 0:
            continue
        h = hashed(np.uint64(k), step.key)
        at = place[c]
        place[c] = at + 1
        out.x[at], out.y[at] = _moved(p, k, h, step, normals)
        out.vx[at] = p.vx[k] + step.noise[1] * normals[index(h, 2)]
        out.vy[at] = p.vy[k] + step.noise[1] * normals[index(h, 3)]
