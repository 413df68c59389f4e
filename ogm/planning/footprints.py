"""Belief in a collision along a path, and free lines of sight."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.grid import EvidentialGrid, GridSpec
from ogm.planning.distances import evidential_of
from ogm.planning.kernels import footprint_extremes

Grid = EvidentialGrid | DynamicGrid
MAX_PLAUSIBILITY = 0.5  # of occupied in a cell that counts as free: free is at least as great as occupied + unknown


class Collision(NamedTuple):
    """Belief in obstacles under a footprint, for each pose of a path.

    Cells of a map are not independent: one beam affects many of them. So the masses under a footprint are not
    multiplied; each number is the extreme over all cells that the footprint touches.

    Attributes
    ----------
    belief : (K,) float32
        Greatest mass of occupied in a cell, [0, 1].
    plausibility : (K,) float32
        Greatest plausibility of occupied, 1 - free, in a cell, [0, 1].
    unknown : (K,) float32
        Greatest mass of unknown in a cell, [0, 1]; 1 where the footprint reaches beyond the grid.
    first_doubtful : int or None
        Index of the first pose with a plausibility above the limit; None if all are below it.
    """

    belief: NDArray[np.float32]
    plausibility: NDArray[np.float32]
    unknown: NDArray[np.float32]
    first_doubtful: int | None


def collision(
    grid: Grid | Callable[[float], Grid],
    footprint: ArrayLike,
    poses: ArrayLike,
    seconds: ArrayLike | None = None,
    *,
    max_plausibility: float = MAX_PLAUSIBILITY,
) -> Collision:
    """Return the belief in obstacles under a vehicle's footprint along a path.

    All cells that the footprint touches count. Nothing is checked between poses: space them by less than the vehicle's
    length.

    Parameters
    ----------
    grid : EvidentialGrid, DynamicGrid, or function of seconds
        With `seconds`, a function that returns the grid at a time [s], such as `ogm.fusion.DynamicMapper.predicted`.
    footprint : (x_min, x_max, y_min, y_max), or (V, 2) array
        Extent of the vehicle as in `ogm.Mount.ego_footprint`, or corners of any polygon, in the vehicle's frame [m].
    poses : (K, 3) or (K, 4, 4) array
        Poses of the vehicle in the grid's frame: x, y [m] and yaw [rad], or transforms, of which the x, y part is used.
    seconds : (K,) array, optional
        Time of each pose after the time of the map [s]. The grid is predicted once for each different time.
    max_plausibility : float
        Plausibility of occupied above which a pose is doubtful, [0, 1].

    Returns
    -------
    Collision

    Raises
    ------
    TypeError
        If `grid` holds no masses.
    ValueError
        If shapes do not fit, a number is not finite or out of its range, or only one of `seconds` and a function as
        `grid` is given.
    """
    _check_limit(max_plausibility)
    xy, x_axis = _places(poses)
    corners = _corners(footprint)
    convex = _is_convex(corners)
    y_axis = np.stack([-x_axis[:, 1], x_axis[:, 0]], axis=-1)
    polygons = xy[:, None] + corners[:, :1] * x_axis[:, None] + corners[:, 1:] * y_axis[:, None]
    if callable(grid) != (seconds is not None):
        missing = "`seconds`, the time of each pose" if callable(grid) else "a function as `grid`, mapper.predicted"
        raise ValueError(f"a grid at the time of each pose needs a function of seconds and `seconds`: give {missing}")
    found = np.empty((len(polygons), 3), np.float32)
    if callable(grid):
        times = _finite("seconds", seconds)
        if times.shape != (len(polygons),):
            raise ValueError(f"seconds must be one number for each of {len(polygons)} poses, got shape {times.shape}")
        for time in np.unique(times):
            found[times == time] = _extremes(grid(float(time)), polygons[times == time], convex)
    else:
        found = _extremes(grid, polygons, convex)
    belief, free, known = found.T
    doubtful = np.flatnonzero(1 - free > max_plausibility)
    return Collision(belief, 1 - free, 1 - known, int(doubtful[0]) if len(doubtful) else None)


def ray_is_free(
    grid: Grid, a: ArrayLike, b: ArrayLike, *, max_plausibility: float = MAX_PLAUSIBILITY
) -> NDArray[np.bool_]:
    """Return whether all cells on the straight lines between points are free.

    Parameters
    ----------
    grid : EvidentialGrid or DynamicGrid
    a, b : (..., 2) array
        Ends of the lines, x and y [m] in the grid's frame; their leading axes are broadcast.
    max_plausibility : float
        Plausibility of occupied, 1 - free, up to which a cell is free, [0, 1].

    Returns
    -------
    (...) bool
        True for free lines; False for a line that leaves the grid.

    Raises
    ------
    TypeError
        If `grid` holds no masses.
    ValueError
        If shapes do not fit, or a number is not finite or out of its range.
    """
    _check_limit(max_plausibility)
    ends = np.stack(np.broadcast_arrays(_finite("a", a), _finite("b", b)), axis=-2)
    if ends.shape[-1] != 2:
        raise ValueError(f"a and b must have x and y on their last axis, got shape {ends.shape[:-2] + ends.shape[-1:]}")
    free = _extremes(grid, ends.reshape(-1, 2, 2), convex=True)[:, 1]
    return np.asarray(1 - free <= max_plausibility).reshape(ends.shape[:-2])


def _extremes(grid: Grid, polygons: NDArray[np.float64], convex: bool) -> NDArray[np.float32]:
    """Return the greatest occupied, the least free and the least known mass under polygons (K, V, 2) [m], (K, 3)."""
    spec: GridSpec = grid.spec
    mass = np.ascontiguousarray(evidential_of(grid).mass).view()
    mass.flags.writeable = False  # one type for the kernel: some grids have read-only masses
    found = np.empty((len(polygons), 3), np.float32)
    corners = np.ascontiguousarray((polygons - spec.origin) / spec.resolution)
    footprint_extremes(mass, corners, convex, found)
    return found


def _is_convex(corners: NDArray[np.float64]) -> bool:
    """Return whether a polygon (V, 2) is convex: it turns to one side only, and once around."""
    x, y = (np.roll(corners, -1, axis=0) - corners).T
    p, q = np.roll(x, -1), np.roll(y, -1)
    turns = np.arctan2(x * q - y * p, x * p + y * q)
    return bool((turns >= 0).all() or (turns <= 0).all()) and abs(abs(turns.sum()) - 2 * np.pi) < 1e-6


def _corners(footprint: ArrayLike) -> NDArray[np.float64]:
    """Return the corners (V, 2) of a footprint."""
    found = _finite("footprint", footprint)
    if found.shape == (4,):
        x0, x1, y0, y1 = found.tolist()
        if not (x0 < x1 and y0 < y1):
            raise ValueError(f"footprint must be (x_min, x_max, y_min, y_max) [m], got {found.tolist()}")
        return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
    if found.ndim != 2 or found.shape[1] != 2 or len(found) < 3:
        raise ValueError(
            f"footprint must be (x_min, x_max, y_min, y_max), or three corners (x, y) or more, got shape {found.shape}"
        )
    return found


def _places(poses: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return positions and x axes of poses in the plane, (K, 2) each."""
    found = _finite("poses", poses)
    if found.ndim == 3 and found.shape[1:] == (4, 4):
        return found[:, :2, 3], found[:, :2, 0]
    if found.ndim != 2 or found.shape[1] != 3:
        raise ValueError(f"poses must be (K, 3), x, y and yaw, or (K, 4, 4), got shape {found.shape}")
    return found[:, :2], np.stack([np.cos(found[:, 2]), np.sin(found[:, 2])], axis=-1)


def _finite(name: str, numbers: ArrayLike | None) -> NDArray[np.float64]:
    found = np.asarray(numbers, np.float64)
    if not np.isfinite(found).all():
        raise ValueError(f"{name} must be finite, got {found[~np.isfinite(found)][0]}")
    return found


def _check_limit(max_plausibility: float) -> None:
    if not 0 <= max_plausibility <= 1:
        raise ValueError(f"max_plausibility must be in [0, 1], got {max_plausibility}")
