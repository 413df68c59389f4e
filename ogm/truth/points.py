"""Truth from classified points, with boxes."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.extras import import_extra
from ogm.grid import GridSpec
from ogm.scan import Boxes
from ogm.state import PARTICIPANT, CellState, Truth
from ogm.truth.boxes import cells_in_hit_boxes
from ogm.truth.observe import Kind, observe_points

TRUTH_SPEC = GridSpec.centered(length=99.84, width=99.84, resolution=0.16)  # contains the paper's grid at any yaw
_MAX_SQUARES = 1e8  # of 1 m for the estimate of the ground: 10 km x 10 km
_REACH = 10.0  # [m] from ground, beyond which a height is unknown


def finalize_truth(
    seen: NDArray[np.uint8],
    spec: GridSpec,
    *,
    boxes: Boxes | None = None,
    returns: ArrayLike | None = None,
    unobserved: NDArray[np.bool_] | None = None,
    beyond: NDArray[np.bool_] | None = None,
    highest: NDArray[np.float32] | None = None,
) -> Truth:
    """Return the truth of an observation, with the boxes of traffic participants filled.

    Parameters
    ----------
    seen : (nx, ny) uint8
        Observation from `observe_points` or `ogm.truth.rays.observe_rays`.
    spec : GridSpec
    boxes : Boxes, optional
        Traffic participants in the grid's frame: all cells of boxes with at least `MIN_RETURNS` are occupied.
    returns : (B,) integer, needed with `boxes`
        Points of each box in the input scan, from `count_returns`.
    unobserved : (nx, ny) bool, optional
        Cells to ignore regardless of hits, such as cells under the ego vehicle (`cells_in_footprint`).
    beyond : (nx, ny) bool, optional
        Cells outside the known world: ignored instead of unknown if they have no hit.
    highest : (nx, ny) float32, optional
        Height of the highest obstacle hit in each cell [m], for `Truth.height_cm`.
    """
    of_bits = (CellState.UNKNOWN, CellState.FREE, CellState.OCCUPIED, CellState.OCCUPIED)
    state = np.array(of_bits, np.uint8)[seen]
    if beyond is not None:
        state[beyond & (state == CellState.UNKNOWN)] = CellState.IGNORE
    height = None if highest is None else np.rint(100 * highest).astype(np.uint8)  # below the clearance
    if boxes is not None:
        filled = cells_in_hit_boxes(boxes, returns, spec)
        state[filled] = CellState.OCCUPIED
        if height is not None:
            height[filled] = PARTICIPANT
    if unobserved is not None:
        state[unobserved] = CellState.IGNORE
    if height is not None:
        height[state != CellState.OCCUPIED] = 0
    return Truth(spec, state, height)


def height_above_ground(xyz: ArrayLike, is_ground: ArrayLike) -> NDArray[np.float64]:
    """Return the height of points above the labelled ground points of their recording.

    The ground's height is the median of ground points in squares of 1 m, interpolated between the squares' centres;
    squares without ground take the height of the nearest square with ground.

    Parameters
    ----------
    xyz : (N, 3 or more) float
        x, y, z [m].
    is_ground : (N,) bool

    Returns
    -------
    (N,) float64
        Height [m]; NaN for points further than 10 m from any ground.

    Raises
    ------
    ValueError
        If shapes disagree, a number is not finite, or the points span more than 1e8 squares of 1 m.
    """
    distance_transform_edt = import_extra("scipy.ndimage", "evaluate").distance_transform_edt

    xyz, is_ground = np.asarray(xyz, np.float64), np.asarray(is_ground)
    if xyz.ndim != 2 or xyz.shape[1] < 3:
        raise ValueError(f"xyz must have shape (N, 3 or more), got {xyz.shape}")
    if is_ground.dtype != bool or is_ground.shape != (len(xyz),):
        raise ValueError(f"is_ground must be {len(xyz)} booleans, got {is_ground.dtype} of shape {is_ground.shape}")
    if not np.isfinite(xyz[:, :3]).all():
        raise ValueError("xyz must be finite, got NaN or inf; drop those points first")
    if not is_ground.any():
        return np.full(len(xyz), np.nan)
    square = xyz[:, :2] - (xyz[:, :2].min(axis=0) - 0.5)  # position in squares of 1 m
    if np.prod(square.max(axis=0) + 2) > _MAX_SQUARES:
        far = xyz[np.argmax(np.abs(xyz[:, :2]).max(axis=1)), :2]
        raise ValueError(
            f"points must lie in at most {_MAX_SQUARES:g} squares of 1 m, got a point at {far.tolist()} m: drop it, "
            "or correct the scan"
        )
    shape = tuple(np.floor(square.max(axis=0)).astype(int) + 2)
    cell = np.ravel_multi_index(tuple(np.floor(square[is_ground]).astype(int).T), shape)
    order = np.lexsort((xyz[is_ground, 2], cell))
    cells, first, count = np.unique(cell[order], return_index=True, return_counts=True)
    heights = np.full(shape, np.nan)
    heights.flat[cells] = xyz[is_ground, 2][order][first + count // 2]
    away, nearest = distance_transform_edt(np.isnan(heights), return_indices=True)
    heights = heights[tuple(nearest)]
    far = away[tuple(np.floor(square).astype(int).T)] > _REACH
    low = np.clip(np.floor(square - 0.5).astype(int), 0, np.array(shape) - 2)
    u, v = np.clip(square - 0.5 - low, 0, 1).T
    i, j = low.T
    ground = (heights[i, j] * (1 - u) + heights[i + 1, j] * u) * (1 - v)
    ground += (heights[i, j + 1] * (1 - u) + heights[i + 1, j + 1] * u) * v
    return np.where(far, np.nan, xyz[:, 2] - ground)


def truth_from_points(
    points: ArrayLike, kind: ArrayLike, spec: GridSpec, *, unobserved: NDArray[np.bool_] | None = None
) -> Truth:
    """Return the truth of a labelled scan.

    Only cells with points become known; cells are free only if ground was hit in them. Points without ground nearby are
    ignored, as their height is unknown (`height_above_ground`).

    Parameters
    ----------
    points : (N, 3 or more) float
        x, y, z [m] in the grid's frame. Rows that are not finite are ignored.
    kind : (N,) integer
        `Kind` of each point, by its label.
    spec : GridSpec
    unobserved : (nx, ny) bool, optional
        See `finalize_truth`.
    """
    array, kinds = np.asarray(points), np.asarray(kind)
    if array.ndim != 2 or array.shape[1] < 3:
        raise ValueError(f"points must have shape (N, 3 or more), got {array.shape}")
    if kinds.shape != (len(array),) or not np.isin(kinds, list(Kind)).all():
        raise ValueError(f"kind must have shape ({len(array)},), one Kind per point, got {kinds.shape}")
    finite = np.isfinite(array[:, :3]).all(axis=1)
    xyz, kinds = array[finite, :3].astype(np.float64), kinds[finite]
    is_ground = kinds == Kind.GROUND
    high = np.where(is_ground, 0.0, height_above_ground(xyz, is_ground))
    known = np.isfinite(high)
    seen = np.zeros(spec.shape, np.uint8)
    observe_points(seen, xyz[known, 0], xyz[known, 1], kinds[known], high[known], spec)
    return finalize_truth(seen, spec, unobserved=unobserved)
