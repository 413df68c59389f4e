"""Truth of boxes alone: what was seen well enough is occupied as a whole."""

import numpy as np
from numpy.typing import ArrayLike

from ogm.grid import GridSpec
from ogm.truth.boxes import check_boxes
from ogm.truth.moving import cells_in_boxes
from ogm.truth.rules import MIN_RETURNS
from ogm.truth.state import IGNORE, OCCUPIED, Truth

__all__ = ["truth_from_boxes"]


def truth_from_boxes(
    boxes: ArrayLike, returns: ArrayLike, spec: GridSpec, *, min_returns: int = MIN_RETURNS
) -> Truth:
    """Make a truth grid of the boxes around objects (van Kempen et al. 2021, Sec. IV-B).

    Parameters
    ----------
    boxes : (B, 5) or (B, 7) float
        x, y of the middle [m], yaw [rad], length, width [m] (and bottom, top) in the grid's frame.
    returns : (B,) integer
        Points that each has in the scan: `count_returns`, without the ground under it.
    spec : GridSpec
    min_returns : int
        Boxes with at least so many make their cells occupied.

    Returns
    -------
    Truth
        Never free, nowhere unknown: boxes with fewer returns, and what lies outside of all boxes, are to be
        ignored. Nobody labelled that.
    """
    boxes, counts = check_boxes(boxes, "boxes"), np.asarray(returns)
    if counts.shape != (len(boxes),):
        raise ValueError(f"returns must have shape ({len(boxes)},), one per box, got {counts.shape}")
    state = np.full(spec.shape, IGNORE, np.uint8)
    state[cells_in_boxes(boxes[counts >= min_returns], spec)] = OCCUPIED
    return Truth(spec, state)
