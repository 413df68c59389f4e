"""Motion of the cells under boxes, and of boxes that are followed from frame to frame."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.grid import GridSpec
from ogm.scan import Boxes
from ogm.state import Motion
from ogm.truth.boxes import cells_around

AROUND = 0.15  # [m] around a box: returns from its sides lie there too
REACH = 0.35  # [s] before and after a frame that a track is followed: seven frames at 10 Hz
NEEDED = 0.25  # [s] of the track before and after the frame, without which its slope is that of another time
_SAME = 1e-4  # [s] by which stamps may miss these


class BoxMotion(NamedTuple):
    """Motion of B boxes; NaN where it is not known.

    Attributes
    ----------
    velocity : (B, 2) float64
        Of the centers, over ground, along x and y [m/s].
    yaw_rate : (B,) float64
        Counter-clockwise [rad/s].
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
    """Return the motion of every cell: that of the rigid body in it, 0 where there is none.

    A cell at r from the center of its box has the velocity ``v + ω × r = (vx - ω ry, vy + ω rx)``. A box has the cells
    whose centers lie in it or within `margin` of it, and the cell that holds its own center. Where boxes overlap, a
    cell belongs to the one in which it lies deepest.

    Parameters
    ----------
    boxes : Boxes
        All objects that may move, with their velocities, in the grid's frame; heights are not used.
    yaw_rate : (B,) float
        Of each [rad/s]. Where it or the velocity is NaN, nothing is known of the motion of the box's cells.
    spec : GridSpec
    margin : float
        On every side of a box [m].
    unknown : (nx, ny) bool, optional
        Cells where objects would have no box, such as those outside the view in which objects were labelled: without
        a box there, nothing is known of their motion.

    Returns
    -------
    Motion

    Raises
    ------
    ValueError
        If there is not one yaw rate per box.
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
    """Return how the boxes of a frame move, by the slopes of their tracks: least squares over the frames around it.

    Parameters
    ----------
    n : int
        Number of the frame among those that are given.
    stamps : sequence of K float
        Times of the frames [s], in any order.
    boxes : sequence of K Boxes
        The boxes of each, in the map's frame (`Boxes.moved`).
    reach : float
        Frames up to so long before and after frame `n` are used [s].
    needed : float
        A track must be known so long before and after frame `n` [s]. 0 allows slopes of one side, which lag or lead:
        those of the first and the last frame of a track.

    Returns
    -------
    BoxMotion
        Of the boxes of frame `n`, in the map's axes. NaN for those without a track, and where the track is too short.
        A box that is turned by half a turn from one frame to the next is the same box: its yaw rate does not count
        that.

    Raises
    ------
    ValueError
        If there is not one stamp per frame.
    """
    if len(stamps) != len(boxes):
        raise ValueError(f"there must be one stamp per frame, got {len(stamps)} stamps and {len(boxes)} frames")
    away = np.asarray(stamps, np.float64) - stamps[n]
    rows: dict[str, list[tuple[float, float, float, float]]] = {name: [] for name in boxes[n].track if name}
    for k in map(int, np.argsort(away, kind="stable")):
        if abs(away[k]) > reach + _SAME:
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
    short = track[0, 0] > _SAME - needed or track[-1, 0] < needed - _SAME
    if short or not t.any():
        return np.full(3, np.nan)
    values = np.column_stack([track[:, 1:3], np.unwrap(track[:, 3], period=np.pi)])
    return np.asarray(t @ (values - values.mean(axis=0)) / (t @ t))
