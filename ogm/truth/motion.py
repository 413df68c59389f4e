"""Motion of cells under boxes, and of tracked boxes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.grid import GridSpec
from ogm.scan import Boxes
from ogm.state import Motion
from ogm.truth.boxes import cells_around

AROUND = 0.15  # [m] around a box, for returns from its sides
REACH = 0.35  # [s] of a track used before and after a frame: seven frames at 10 Hz
NEEDED = 0.25  # [s] of a track needed before and after a frame; with less, the slope is of another time
_TOLERANCE = 1e-4  # [s] of stamps


class BoxMotion(NamedTuple):
    """Motion of B boxes; NaN where unknown.

    Attributes
    ----------
    velocity : (B, 2) float64
        Velocity of the centers over ground along x and y [m/s].
    yaw_rate : (B,) float64
        Yaw rate, counter-clockwise [rad/s].
    """

    velocity: NDArray[np.float64]
    yaw_rate: NDArray[np.float64]


def motion_of_boxes(
    boxes: Boxes,
    yaw_rate: ArrayLike,
    spec: GridSpec,
    *,
    margin: float = AROUND,
    unknown: NDArray[np.bool_] | None = None,
) -> Motion:
    """Return the motion of every cell, from the rigid body in it; 0 in cells without a body.

    A cell at r from the center of its box has the velocity ``v + ω × r = (vx - ω ry, vy + ω rx)``. A box has the cells
    with centers in it or within `margin` of it, and the cell of its own center. In overlapping boxes, a cell belongs to
    the box in which it lies deepest.

    Parameters
    ----------
    boxes : Boxes
        All objects that may move, with velocities, in the grid's frame; heights are not used.
    yaw_rate : (B,) float
        Yaw rate of each box [rad/s]. If it or the velocity is NaN, the motion of the box's cells is unknown.
    spec : GridSpec
    margin : float
        Margin on every side of a box [m].
    unknown : (nx, ny) bool, optional
        Cells in which objects may have no box, such as cells outside the labelled view: without a box, their motion is
        unknown.

    Returns
    -------
    Motion

    Raises
    ------
    ValueError
        If the number of yaw rates differs from the number of boxes.
    """
    turn = np.asarray(yaw_rate, np.float64)
    if turn.shape != (len(boxes),):
        raise ValueError(f"yaw_rate must have shape ({len(boxes)},), one per box, got {turn.shape}")
    speeds = np.full((len(boxes), 2), np.nan) if boxes.velocity is None else boxes.velocity
    velocity, box = np.zeros((*spec.shape, 2), np.float32), np.full(spec.shape, np.int16(-1))
    if unknown is not None:
        velocity[unknown] = np.nan
    distance = np.full(spec.shape, np.inf)  # from the edge of the cell's box [m], negative inside
    x, y = spec.cell_centers
    wide = boxes.widened(margin)
    for k, (cx, cy) in enumerate(boxes.center[:, :2]):
        rows, columns = cells_around(wide, k, spec)
        c, s, rx, ry = np.cos(boxes.yaw[k]), np.sin(boxes.yaw[k]), x[rows] - cx, y[:, columns] - cy
        length, width = boxes.size[k, :2]
        outside = np.maximum(np.abs(c * rx + s * ry) - length / 2, np.abs(c * ry - s * rx) - width / 2)
        inside = outside <= margin
        if spec.contains(cx, cy):
            i, j = spec.index(cx, cy)
            inside[i - rows.start, j - columns.start] = True
        inside &= outside < distance[rows, columns]
        distance[rows, columns][inside] = outside[inside]
        box[rows, columns][inside] = k
        field = np.stack(np.broadcast_arrays(speeds[k, 0] - turn[k] * ry, speeds[k, 1] + turn[k] * rx), axis=-1)
        velocity[rows, columns][inside] = field[inside]
    return Motion(velocity, box)


def track_motion(
    n: int, stamps: Sequence[float], boxes: Sequence[Boxes], *, reach: float = REACH, needed: float = NEEDED
) -> BoxMotion:
    """Return the motion of the boxes of a frame: least-squares slopes of their tracks over the frames around it.

    Parameters
    ----------
    n : int
        Index of the frame.
    stamps : sequence of K float
        Times of the frames [s], in any order.
    boxes : sequence of K Boxes
        Boxes of each frame, in the map's frame (`Boxes.moved`).
    reach : float
        Greatest time between frame `n` and used frames [s].
    needed : float
        Length of a track needed before and after frame `n` [s]. 0 allows one-sided slopes at the ends of tracks, which
        lag or lead.

    Returns
    -------
    BoxMotion
        Motion of the boxes of frame `n`, in the map's axes. NaN for boxes without a track or with a short track. A jump
        of the yaw by half a turn between frames does not count as rotation.

    Raises
    ------
    ValueError
        If the number of stamps differs from the number of frames.
    """
    if len(stamps) != len(boxes):
        raise ValueError(f"there must be one stamp per frame, got {len(stamps)} stamps and {len(boxes)} frames")
    away = np.asarray(stamps, np.float64) - stamps[n]
    rows: dict[str, list[tuple[float, float, float, float]]] = {name: [] for name in boxes[n].track if name}
    for k in map(int, np.argsort(away, kind="stable")):
        if abs(away[k]) > reach + _TOLERANCE:
            continue
        for name, (x, y), yaw in zip(boxes[k].track, boxes[k].center[:, :2], boxes[k].yaw, strict=True):
            if name in rows:
                rows[name].append((away[k], x, y, yaw))
    slopes = {name: _slopes(np.array(track), needed) for name, track in rows.items()}
    nothing = np.full(3, np.nan)
    found = np.array([slopes.get(name, nothing) for name in boxes[n].track]).reshape(-1, 3)
    return BoxMotion(found[:, :2], found[:, 2])


def _slopes(track: NDArray[np.float64], needed: float) -> NDArray[np.float64]:
    """Return the change of x, y and yaw per second, (3,), of rows t, x, y, yaw around t = 0."""
    t = track[:, 0] - track[:, 0].mean()
    short = track[0, 0] > _TOLERANCE - needed or track[-1, 0] < needed - _TOLERANCE
    if short or not t.any():
        return np.full(3, np.nan)
    values = np.column_stack([track[:, 1:3], np.unwrap(track[:, 3], period=np.pi)])
    return np.asarray(t @ (values - values.mean(axis=0)) / (t @ t))
