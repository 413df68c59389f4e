"""From hits to cells: which cells hold ground, which obstacles."""

from enum import IntEnum
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ogm.grid import GridSpec

__all__ = [
    "CLEARANCE",
    "GROUND_SEEN",
    "OBSTACLE_HEIGHT",
    "OBSTACLE_SEEN",
    "PLANT_HEIGHT",
    "Kind",
    "tally_points",
    "tally_rays",
]

CLEARANCE = 2.0  # [m] above ground; what is higher blocks no car: the top of the band that the paper looks at
OBSTACLE_HEIGHT = 0.05  # [m] above ground; what is lower, a dropped kerb for one, a car drives over
PLANT_HEIGHT = 0.25  # [m] the same for grass and other soft plants

GROUND_SEEN, OBSTACLE_SEEN = 1, 2  # bits of a tally


class Kind(IntEnum):
    """What was hit, as far as driving is concerned."""

    GROUND = 0  # may be driven over: frees its cell at any height below `clearance`
    OBSTACLE = 1  # counts between `obstacle_height` and `clearance`
    PLANT = 2  # soft: counts as ground below `plant_height`, as obstacle from there to `clearance`
    STEP = 3  # upright face between two levels of ground, as of a kerb: counts by the rise of the ground
    OTHER = 4  # says nothing: no hit, own vehicle, unlabelled, spray


def tally_rays(
    seen: NDArray[np.uint8],
    distance: NDArray[np.float32],
    directions: NDArray[np.float32],
    code: NDArray[np.uint8],
    kinds: NDArray[np.uint8],
    ground: NDArray[np.float32],
    rise: NDArray[np.float32],
    spec: GridSpec,
    obstacle_height: float = OBSTACLE_HEIGHT,
    plant_height: float = PLANT_HEIGHT,
    clearance: float = CLEARANCE,
) -> None:
    """Add what rays from the sensor hit to a tally, in one pass without intermediate arrays.

    Nothing is checked: this is called with millions of rays. `tally_points` does the same for points.

    Parameters
    ----------
    seen : (nx, ny) uint8, C-contiguous
        Changed in place; begin with zeros.
    distance : (N,) float32
        Range of each hit [m]; not finite for none.
    directions : (N, 3) float32
        Unit vectors in the grid's frame, from the grid's (0, 0).
    code : (N,) uint8
        What was hit, a row of `kinds`: a material, a class.
    kinds : (256,) uint8
        `Kind` of each code.
    ground : (nx, ny) float32
        z of the ground in each cell [m], the lowest around where it has a step; NaN where there is none.
    rise : (nx, ny) float32
        How far the ground rises or drops abruptly in each cell [m]: what `Kind.STEP` is judged by.
    spec : GridSpec
    obstacle_height, plant_height, clearance : float
        As in `truth_grid` [m].
    """
    _tally_rays(
        *(seen, distance, directions, code, kinds, ground, rise, spec.resolution, *spec.origin),
        *(obstacle_height, plant_height, clearance),
    )


def tally_points(
    seen: NDArray[np.uint8],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    kind: NDArray[np.integer],
    height: NDArray[np.float64],
    spec: GridSpec,
    obstacle_height: float = OBSTACLE_HEIGHT,
    plant_height: float = PLANT_HEIGHT,
    clearance: float = CLEARANCE,
) -> None:
    """Add classified points to a tally: the plain twin of `tally_rays`. Parameters as in `truth_grid`."""
    below = height < clearance
    plant = kind == Kind.PLANT
    free = below & ((kind == Kind.GROUND) | (plant & (height < plant_height)))
    hard = (kind == Kind.OBSTACLE) | (kind == Kind.STEP)
    obstacle = below & ((hard & (height >= obstacle_height)) | (plant & (height >= plant_height)))
    inside = spec.contains(x, y)
    for chosen, bit in ((free & inside, GROUND_SEEN), (obstacle & inside, OBSTACLE_SEEN)):
        cell = spec.index(x[chosen], y[chosen])
        seen[cell] |= np.uint8(bit)


@njit(cache=True, nogil=True)
def _tally_rays(
    seen: Any,
    distance: Any,
    directions: Any,
    code: Any,
    kinds: Any,
    ground: Any,
    rise: Any,
    resolution: float,
    x0: float,
    y0: float,
    obstacle_height: float,
    plant_height: float,
    clearance: float,
) -> None:
    nx, ny = seen.shape
    for n in range(len(distance)):
        kind = kinds[code[n]]
        if kind == 4:  # Kind.OTHER
            continue
        t = np.float64(distance[n])
        if not t < 1e6:  # no hit; NaN
            continue
        u = (t * directions[n, 0] - x0) / resolution
        v = (t * directions[n, 1] - y0) / resolution
        if not (u >= 0 and v >= 0 and u < nx and v < ny):
            continue
        ix, iy = int(u), int(v)
        height = t * directions[n, 2] - ground[ix, iy]
        if not height < clearance:
            continue
        if kind == 3:  # Kind.STEP
            height = rise[ix, iy]
        if kind == 0 or (kind == 2 and height < plant_height):
            seen[ix, iy] |= 1
        elif height >= (plant_height if kind == 2 else obstacle_height):
            seen[ix, iy] |= 2
