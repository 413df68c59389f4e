"""Truth of points whose class is known: hits and boxes in, states of cells out."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.grid import GridSpec
from ogm.scan import Boxes
from ogm.state import CellState, Truth
from ogm.truth.boxes import MIN_RETURNS, cells_in_boxes, count_returns
from ogm.truth.observe import HEIGHT_LIMITS, HeightLimits, Kind, observe_points

__all__ = ["TRUTH_SPEC", "finalize_truth", "height_above_ground", "truth_from_points", "truth_grid"]

TRUTH_SPEC = GridSpec.centered(length=99.84, width=99.84, resolution=0.16)  # holds the paper's grid at any yaw
_MOST_SQUARES = 1e8  # on which ground is estimated: 10 km x 10 km of 1 m


def truth_grid(
    x: ArrayLike,
    y: ArrayLike,
    kind: ArrayLike,
    height: ArrayLike,
    spec: GridSpec,
    *,
    limits: HeightLimits = HEIGHT_LIMITS,
    boxes: Boxes | None = None,
    returns: ArrayLike | None = None,
    min_returns: int = MIN_RETURNS,
    unobserved: NDArray[np.bool_] | None = None,
) -> Truth:
    """Return the truth of classified hits and of the boxes of traffic participants.

    Parameters
    ----------
    x, y : (N,) float
        Where the hits are, in the grid's frame [m]. Those outside `spec` count for nothing.
    kind : (N,) integer
        `Kind` of each.
    height : (N,) float
        Height of each above the ground around it [m].
    spec : GridSpec
    limits : HeightLimits
        Between which heights above ground a hit blocks a car.
    boxes : Boxes, optional
        Traffic participants, in the grid's frame.
    returns : (B,) integer, optional
        Points that each box has in the input scan, from `count_returns`; needed with `boxes`.
    min_returns : int
        All cells of boxes with at least so many are occupied.
    unobserved : (nx, ny) bool, optional
        Cells to be ignored whatever was hit in them: those under the ego vehicle (`cells_in_footprint`).

    Returns
    -------
    Truth

    Raises
    ------
    TypeError
        If `kind` or `returns` is not integer.
    ValueError
        If shapes disagree, a number is not finite, or a kind is not in `Kind`.
    """
    x, y, height = (_floats(value, name) for value, name in ((x, "x"), (y, "y"), (height, "height")))
    kind = np.asarray(kind)
    if kind.dtype.kind not in "iu":
        raise TypeError(f"kind must be an integer array of Kind, got dtype {kind.dtype}")
    if not x.shape == y.shape == kind.shape == height.shape:
        raise ValueError(
            f"x, y, kind and height must have one number per hit, got shapes {x.shape}, {y.shape}, "
            f"{kind.shape}, {height.shape}"
        )
    if kind.size and not (kind.min() >= 0 and kind.max() < len(Kind)):
        raise ValueError(f"kind must lie in 0..{len(Kind) - 1}, see Kind; got {kind.min()} to {kind.max()}")
    seen = np.zeros(spec.shape, np.uint8)
    observe_points(seen, x, y, kind, height, spec, limits)
    return finalize_truth(seen, spec, boxes=boxes, returns=returns, min_returns=min_returns, unobserved=unobserved)


def finalize_truth(
    seen: NDArray[np.uint8],
    spec: GridSpec,
    *,
    boxes: Boxes | None = None,
    returns: ArrayLike | None = None,
    min_returns: int = MIN_RETURNS,
    unobserved: NDArray[np.bool_] | None = None,
    beyond: NDArray[np.bool_] | None = None,
) -> Truth:
    """Return the truth of an observation, with the boxes of traffic participants filled.

    Parameters
    ----------
    seen : (nx, ny) uint8
        What `observe_points` or `ogm.truth.rays.observe_rays` has added up.
    spec, boxes, returns, min_returns, unobserved
        As in `truth_grid`.
    beyond : (nx, ny) bool, optional
        Cells outside the known world: to be ignored, instead of unknown, where nothing was hit.
    """
    of_bits = (CellState.UNKNOWN, CellState.FREE, CellState.OCCUPIED, CellState.OCCUPIED)
    state = np.array(of_bits, np.uint8)[seen]
    if beyond is not None:
        state[beyond & (state == CellState.UNKNOWN)] = CellState.IGNORE
    if boxes is not None:
        if returns is None:
            raise ValueError("boxes need returns, the points that each has in the input scan: count_returns()")
        returns = np.asarray(returns)
        if returns.dtype.kind not in "iu":
            raise TypeError(f"returns must be integers, got dtype {returns.dtype}")
        if returns.shape != (len(boxes),):
            raise ValueError(f"returns must have shape ({len(boxes)},), one per box, got {returns.shape}")
        state[cells_in_boxes(boxes.select(returns >= min_returns), spec)] = CellState.OCCUPIED
    if unobserved is not None:
        state[unobserved] = CellState.IGNORE
    return Truth(spec, state)


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
        Points further than this from any ground [m] get NaN: their height is not known.

    Returns
    -------
    (N,) float64
        [m]; NaN where there is no ground near.

    Raises
    ------
    ValueError
        If shapes disagree, a number is not finite or impossible, or the points lie further apart than any scan's.
    """
    from scipy.ndimage import distance_transform_edt

    xyz, is_ground = np.asarray(xyz, np.float64), np.asarray(is_ground)
    if xyz.ndim != 2 or xyz.shape[1] < 3:
        raise ValueError(f"xyz must have shape (N, 3 or more), got {xyz.shape}")
    if is_ground.dtype != bool or is_ground.shape != (len(xyz),):
        raise ValueError(f"is_ground must be {len(xyz)} booleans, got {is_ground.dtype} of shape {is_ground.shape}")
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
    limits: HeightLimits = HEIGHT_LIMITS,
    boxes: Boxes | None = None,
    returns: ArrayLike | None = None,
    min_returns: int = MIN_RETURNS,
    unobserved: NDArray[np.bool_] | None = None,
) -> Truth:
    """Return the truth of a labelled scan.

    Only cells that hold points become known: free where ground was hit, never in between.

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
    returns : (B,) integer, optional
        Points in each box; by default those here that are not labelled as ground, by `count_returns`. Give
        them where the points are of several scans.
    limits, boxes, min_returns, unobserved
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
        limits=limits,
        boxes=boxes,
        returns=returns,
        min_returns=min_returns,
        unobserved=unobserved,
    )


def _floats(value: ArrayLike, name: str) -> NDArray[np.float64]:
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{name} must be a float array, got dtype {array.dtype}")
    if array.ndim != 1:
        raise ValueError(f"{name} must have shape (N,), got {array.shape}")
    array = array.astype(np.float64, copy=False)
    bad = array.size - np.count_nonzero(np.isfinite(array))
    if bad:
        raise ValueError(f"{name} must be finite, but {bad} of {array.size} are not; drop those hits first")
    return array
