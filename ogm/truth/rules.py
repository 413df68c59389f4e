"""From hits and boxes to states: the rules of the truth."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.grid import GridSpec
from ogm.truth.boxes import cells_in_box, check_boxes
from ogm.truth.state import FREE, IGNORE, OCCUPIED, UNKNOWN, Truth
from ogm.truth.tally import CLEARANCE, OBSTACLE_HEIGHT, PLANT_HEIGHT, Kind, tally_points

__all__ = ["MIN_RETURNS", "check_heights", "finalize_truth", "truth_grid"]

MIN_RETURNS = 50  # points in the input scan that make a traffic participant known as a whole (Sec. IV-B)


def truth_grid(
    x: ArrayLike,
    y: ArrayLike,
    kind: ArrayLike,
    height: ArrayLike,
    spec: GridSpec,
    *,
    obstacle_height: float = OBSTACLE_HEIGHT,
    plant_height: float = PLANT_HEIGHT,
    clearance: float = CLEARANCE,
    boxes: ArrayLike | None = None,
    returns: ArrayLike | None = None,
    min_returns: int = MIN_RETURNS,
    own: ArrayLike | None = None,
) -> Truth:
    """Turn classified hits and the boxes of traffic participants into a truth grid.

    Parameters
    ----------
    x, y : (N,) float
        Where the hits are, in the grid's frame [m]. Those outside `spec` count for nothing.
    kind : (N,) integer
        `Kind` of each.
    height : (N,) float
        Height of each above the ground around it [m].
    spec : GridSpec
    obstacle_height, plant_height, clearance : float
        Between which heights above ground a hit is in a car's way [m]; see `Kind`.
    boxes : (B, 5) or (B, 7) float, optional
        Traffic participants: x, y of the middle [m], yaw [rad], length, width [m] in the grid's frame. What
        `count_returns` wants beyond that (bottom, top) is not looked at.
    returns : (B,) integer, optional
        Points that each box has in the input scan; needed with `boxes`.
    min_returns : int
        Boxes with at least so many are filled as occupied.
    own : (5,) or (7,) float, optional
        Box of the own vehicle: its cells become `IGNORE`, whatever was hit.

    Returns
    -------
    Truth

    Raises
    ------
    TypeError
        If `kind` or `returns` is not integer.
    ValueError
        If shapes disagree, a number is not finite, a kind is none, or the heights are out of order.
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
    check_heights(obstacle_height, plant_height, clearance)
    seen = np.zeros(spec.shape, np.uint8)
    tally_points(seen, x, y, kind, height, spec, obstacle_height, plant_height, clearance)
    return finalize_truth(seen, spec, boxes=boxes, returns=returns, min_returns=min_returns, own=own)


def finalize_truth(
    seen: NDArray[np.uint8],
    spec: GridSpec,
    *,
    boxes: ArrayLike | None = None,
    returns: ArrayLike | None = None,
    min_returns: int = MIN_RETURNS,
    own: ArrayLike | None = None,
    beyond: NDArray[np.bool_] | None = None,
) -> Truth:
    """Turn a tally of hits into states, fill the boxes of traffic participants, blank the own vehicle.

    Parameters
    ----------
    seen : (nx, ny) uint8
        What `tally_rays` or `tally_points` has added up.
    spec, boxes, returns, min_returns, own
        As in `truth_grid`.
    beyond : (nx, ny) bool, optional
        Cells outside the known world: `IGNORE` instead of `UNKNOWN` if nothing was hit in them.
    """
    state = np.array([UNKNOWN, FREE, OCCUPIED, OCCUPIED], np.uint8)[seen]
    if beyond is not None:
        state[beyond & (state == UNKNOWN)] = IGNORE
    if boxes is not None:
        boxes = check_boxes(boxes, "boxes")
        if returns is None:
            raise ValueError(
                "boxes need returns, the points that each has in the input scan: count_returns()"
            )
        returns = np.asarray(returns)
        if returns.dtype.kind not in "iu":
            raise TypeError(f"returns must be integers, got dtype {returns.dtype}")
        if returns.shape != (len(boxes),):
            raise ValueError(f"returns must have shape ({len(boxes)},), one per box, got {returns.shape}")
        for box in boxes[returns >= min_returns]:
            state[cells_in_box(box, spec)] = OCCUPIED
    if own is not None:
        if np.size(own) == 0:
            raise ValueError(
                "own must be one box (x, y, yaw, length, width), got an empty array; None for no box"
            )
        state[cells_in_box(check_boxes(np.asarray(own)[None], "own")[0], spec)] = IGNORE
    return Truth(spec, state)


def check_heights(obstacle_height: float, plant_height: float, clearance: float) -> None:
    """Refuse heights that are not finite or out of order."""
    if not 0 <= obstacle_height <= plant_height < clearance < np.inf:
        raise ValueError(
            f"heights must obey 0 <= obstacle_height <= plant_height < clearance, got {obstacle_height}, "
            f"{plant_height}, {clearance} m"
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
