"""Rays aimed from the sensor at cells: at which points of them, and in which directions that is."""

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ogm.grid import GridSpec

__all__ = ["AIMS", "Aim", "Aims", "aimed_directions"]


class Aim(NamedTuple):
    """Points of a cell that rays are aimed at.

    Attributes
    ----------
    height : float
        Above the cell's ground [m].
    dx, dy : float
        From the cell's middle [cells].
    """

    height: float
    dx: float = 0.0
    dy: float = 0.0


class Aims(NamedTuple):
    """Which points of which cells rays are aimed at, in this order.

    Attributes
    ----------
    every : tuple of Aim
        In all cells.
    alternate : tuple of Aim
        In every other cell, as the fields of one colour on a chessboard; the colours take turns. Rays to far
        cells pass near ones at nearly the same heights, so that little is missed.
    step : tuple of Aim
        In cells with a step in the ground that nothing was hit in; heights count from its middle.
    beside : tuple of Aim
        In cells that touch one in which an obstacle was hit, but hold none themselves so far.
    edge : tuple of Aim
        In cells not seen so far that touch one which was.
    """

    every: tuple[Aim, ...]
    alternate: tuple[Aim, ...]
    step: tuple[Aim, ...]
    beside: tuple[Aim, ...]
    edge: tuple[Aim, ...]


def _spread(*heights: float) -> tuple[Aim, ...]:
    """Aim at heights [m], each at another quarter of the cell."""
    quarters = ((0.25, 0.25), (-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25))
    return tuple(Aim(height, *quarters[n % 4]) for n, height in enumerate(heights))


# About 1.5 million rays on `TRUTH_SPEC`. benchmarks/truth_modes.py says what they find and what they miss.
AIMS = Aims(
    every=(Aim(0.0),),
    alternate=_spread(0.12, 0.45, 0.9, 1.4, 1.8),
    step=_spread(0.02, 0.02, 0.02, 0.02),
    beside=_spread(0.1, 0.3, 0.6, 1.0, 1.4, 1.9, 0.15, 0.45, 0.75, 1.15, 1.55, 1.75),
    edge=tuple(Aim(0.0, dx, dy) for dx in (-0.35, 0.0, 0.35) for dy in (-0.35, 0.0, 0.35)),
)


def aimed_directions(
    z: NDArray[np.float32],
    spec: GridSpec,
    aim: Aim,
    elevations: tuple[float, float],
    chosen: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Return the unit vectors from the sensor to one point of every chosen cell that it can look at.

    Parameters
    ----------
    z : (nx, ny) float32
        Of the cells' ground [m]; cells with NaN are left out.
    spec : GridSpec
    aim : Aim
    elevations : (float, float)
        Lowest and highest that the sensor sees [rad]; cells beyond are left out.
    chosen : (nx, ny) bool

    Returns
    -------
    (N, 3) float32
        In the sensor's frame.
    """
    out = np.empty((np.count_nonzero(chosen), 3), np.float32)
    low, high = np.sin(elevations)
    count = _aim(out, z, chosen, spec.resolution, *spec.origin, *aim, low, high)
    return out[:count]


@njit(cache=True, nogil=True)
def _aim(
    out: Any,
    z: Any,
    chosen: Any,
    resolution: float,
    x0: float,
    y0: float,
    height: float,
    dx: float,
    dy: float,
    low: float,
    high: float,
) -> int:
    nx, ny = z.shape
    n = 0
    for ix in range(nx):
        x = x0 + (ix + 0.5 + dx) * resolution
        for iy in range(ny):
            if not chosen[ix, iy]:
                continue
            y = y0 + (iy + 0.5 + dy) * resolution
            up = z[ix, iy] + height
            length = np.sqrt(x * x + y * y + up * up)
            sine = up / length
            if not (sine >= low and sine <= high):  # nor for NaN
                continue
            out[n, 0], out[n, 1], out[n, 2] = x / length, y / length, sine
            n += 1
    return n
