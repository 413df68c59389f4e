"""Truth of labelled recordings."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt

from ogm.grid import GridSpec
from ogm.truth.boxes import count_returns
from ogm.truth.rules import MIN_RETURNS, truth_grid
from ogm.truth.state import Truth
from ogm.truth.tally import CLEARANCE, OBSTACLE_HEIGHT, PLANT_HEIGHT, Kind

__all__ = ["height_above_ground", "truth_from_points"]

_MOST_SQUARES = 1e8  # on which ground is looked for: 10 km x 10 km of 1 m


def height_above_ground(
    xyz: ArrayLike, is_ground: ArrayLike, resolution: float = 1.0, reach: float = 10.0
) -> NDArray[np.float64]:
    """Return the height of points above the points of their recording that are labelled as ground.

    The ground's height is the median of its points in squares of `resolution`, interpolated between their
    middles; squares without ground take it from the nearest that has some.

    Parameters
    ----------
    xyz : (N, 3 or more) float
        x, y, z [m].
    is_ground : (N,) bool
    resolution : float
        Side of the squares [m].
    reach : float
        Points further than this from any ground [m] get NaN: nobody knows how high they are.

    Returns
    -------
    (N,) float64
        [m]; NaN where there is no ground near.

    Raises
    ------
    ValueError
        If shapes disagree, a number is not finite or impossible, or the points lie further apart than any scan's.
    """
    xyz, is_ground = np.asarray(xyz, np.float64), np.asarray(is_ground)
    if xyz.ndim != 2 or xyz.shape[1] < 3:
        raise ValueError(f"xyz must have shape (N, 3 or more), got {xyz.shape}")
    if is_ground.dtype != bool or is_ground.shape != (len(xyz),):
        raise ValueError(
            f"is_ground must be {len(xyz)} booleans, got {is_ground.dtype} of shape {is_ground.shape}"
        )
    if not np.isfinite(xyz[:, :3]).all():
        raise ValueError("xyz holds NaN or inf; drop those points first")
    if not (0 < resolution < np.inf and reach >= 0):
        raise ValueError(f"resolution must be above 0 m and reach 0 m or more, got {resolution}, {reach}")
    if not is_ground.any():
        return np.full(len(xyz), np.nan)
    corner = xyz[:, :2].min(axis=0) - 0.5 * resolution
    where = (xyz[:, :2] - corner) / resolution
    if np.prod(where.max(axis=0) + 2) > _MOST_SQUARES:
        far = xyz[np.argmax(np.abs(xyz[:, :2]).max(axis=1)), :2]
        raise ValueError(
            f"points must lie in {_MOST_SQUARES:g} squares of {resolution:g} m at most, but one lies at "
            f"{far.tolist()} m: drop it, or mend the scan"
        )
    shape = tuple(np.floor(where.max(axis=0)).astype(int) + 2)
    cell = np.ravel_multi_index(tuple(np.floor(where[is_ground]).astype(int).T), shape)
    order = np.lexsort((xyz[is_ground, 2], cell))
    cells, first, count = np.unique(cell[order], return_index=True, return_counts=True)
    heights = np.full(shape, np.nan)
    heights.flat[cells] = xyz[is_ground, 2][order][first + count // 2]
    away, nearest = distance_transform_edt(np.isnan(heights), return_indices=True)
    heights = heights[tuple(nearest)]
    far = away[tuple(np.floor(where).astype(int).T)] * resolution > reach
    low = np.clip(np.floor(where - 0.5).astype(int), 0, np.array(shape) - 2)
    u, v = np.clip(where - 0.5 - low, 0, 1).T
    i, j = low.T
    ground = (heights[i, j] * (1 - u) + heights[i + 1, j] * u) * (1 - v)
    ground += (heights[i, j + 1] * (1 - u) + heights[i + 1, j + 1] * u) * v
    return np.where(far, np.nan, xyz[:, 2] - ground)


def truth_from_points(
    points: ArrayLike,
    kind: ArrayLike,
    spec: GridSpec,
    *,
    height: Callable[..., NDArray[np.float64]] = height_above_ground,
    boxes: ArrayLike | None = None,
    returns: ArrayLike | None = None,
    min_returns: int = MIN_RETURNS,
    own: ArrayLike | None = None,
    obstacle_height: float = OBSTACLE_HEIGHT,
    plant_height: float = PLANT_HEIGHT,
    clearance: float = CLEARANCE,
) -> Truth:
    """Make a truth grid of a labelled recording.

    Only cells that hold points become known: free where ground was seen, never in between.

    Parameters
    ----------
    points : (N, 3 or more) float
        x, y, z [m] in the grid's frame. Rows that are not finite count for nothing.
    kind : (N,) integer
        `Kind` of each point, by its label.
    spec : GridSpec
    height : function
        ``height(xyz, is_ground) -> (N,)``: height above ground [m], NaN where it is not known (such points
        count for nothing, unless they are ground themselves).
    boxes : (B, 5) or (B, 7) float, optional
        As in `truth_grid`.
    returns : (B,) integer, optional
        Points in each box; by default those here that are not labelled as ground, by `count_returns`. Give
        them where the points are of several scans.
    min_returns, own, obstacle_height, plant_height, clearance
        As in `truth_grid`.
    """
    array, kinds = np.asarray(points), np.asarray(kind)
    if array.ndim != 2 or array.shape[1] < 3:
        raise ValueError(f"points must have shape (N, 3 or more), got {array.shape}")
    if kinds.shape != (len(array),):
        raise ValueError(f"kind must have shape ({len(array)},), one per point, got {kinds.shape}")
    finite = np.isfinite(array[:, :3]).all(axis=1)
    xyz, kinds = array[finite, :3].astype(np.float64), kinds[finite]
    is_ground = kinds == Kind.GROUND
    if boxes is not None and returns is None:
        returns = count_returns(xyz[~is_ground], boxes)
    high = np.where(is_ground, 0.0, height(xyz, is_ground))
    known = np.isfinite(high)
    return truth_grid(
        xyz[known, 0],
        xyz[known, 1],
        kinds[known],
        high[known],
        spec,
        obstacle_height=obstacle_height,
        plant_height=plant_height,
        clearance=clearance,
        boxes=boxes,
        returns=returns,
        min_returns=min_returns,
        own=own,
    )
