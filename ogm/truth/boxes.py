"""Boxes of traffic participants: the cells they cover, the points they hold."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.grid import GridSpec

__all__ = ["boxes_seen_from", "cells_in_box", "check_boxes", "count_returns", "over"]


def check_boxes(value: ArrayLike, name: str) -> NDArray[np.float64]:
    """Refuse what are no boxes; return them as an array (B, 5) or (B, 7)."""
    boxes = np.asarray(value, np.float64)
    if boxes.size == 0:
        return boxes.reshape(0, 5)
    if boxes.ndim != 2 or boxes.shape[1] not in (5, 7):
        raise ValueError(
            f"{name} must hold x, y, yaw, length, width (and bottom, top) per box, shape (B, 5) or (B, 7), "
            f"got {boxes.shape}"
        )
    if not np.isfinite(boxes).all() or not (boxes[:, 3:5] > 0).all():
        raise ValueError(f"{name} must be finite, with length and width above 0 m")
    return boxes


def over(box: ArrayLike, x: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Tell which places lie on the footprint of a box, (5 or more,); in float64, whatever the places are in."""
    x0, y0, yaw, length, width = np.asarray(box, np.float64)[:5]
    c, s, px, py = np.cos(yaw), np.sin(yaw), x - x0, y - y0
    return (np.abs(c * px + s * py) <= length / 2) & (np.abs(c * py - s * px) <= width / 2)


def cells_in_box(box: ArrayLike, spec: GridSpec) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the cells that a box covers: those whose middle lies in it, and the one that holds its middle.

    Counting middles keeps the area right on average; what sticks out into further cells is hit there anyhow.

    Parameters
    ----------
    box : (5 or more,) float
        x, y of the middle [m], yaw [rad], length, width [m].
    spec : GridSpec

    Returns
    -------
    ix, iy : (C,) int64
        Cells inside the grid only.
    """
    x, y, _, length, width = (float(value) for value in np.asarray(box)[:5])
    reach = 0.5 * np.hypot(length, width) + spec.resolution
    (ix0, ix1), (iy0, iy1) = spec.index(*np.array([[x - reach, x + reach], [y - reach, y + reach]]))
    nx, ny = spec.shape
    ix = np.arange(max(ix0, 0), min(ix1 + 1, nx))[:, None]
    iy = np.arange(max(iy0, 0), min(iy1 + 1, ny))[None, :]
    inside = over(
        box, spec.origin[0] + (ix + 0.5) * spec.resolution, spec.origin[1] + (iy + 0.5) * spec.resolution
    )
    mx, my = spec.index(x, y)
    inside |= (ix == mx) & (iy == my)
    at = np.nonzero(inside)
    return at[0] + max(int(ix0), 0), at[1] + max(int(iy0), 0)


def count_returns(points: ArrayLike, boxes: ArrayLike) -> NDArray[np.int64]:
    """Count the points of a scan in each box.

    Ground under a vehicle is in its box too: leave those points out if you can tell them, or raise `bottom`.

    Parameters
    ----------
    points : (N, 3 or more) float
        x, y, z [m] in the boxes' frame.
    boxes : (B, 5) or (B, 7) float
        x, y of the middle [m], yaw [rad], length, width [m]; and bottom, top, the lowest and highest z [m],
        without which points at all heights count.

    Returns
    -------
    (B,) int64
    """
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"points must have shape (N, 3 or more), got {points.shape}")
    result = np.zeros(len(check_boxes(boxes, "boxes")), np.int64)
    for n, box in enumerate(check_boxes(boxes, "boxes")):
        near = points[np.abs(points[:, 0] - box[0]) <= 0.5 * np.hypot(box[3], box[4])]
        inside = over(box, near[:, 0], near[:, 1])
        if len(box) == 7:
            inside &= (near[:, 2] >= box[5]) & (near[:, 2] <= box[6])
        result[n] = np.count_nonzero(inside)
    return result


def boxes_seen_from(T: ArrayLike, poses: ArrayLike, sizes: ArrayLike) -> NDArray[np.float64]:
    """Bring upright boxes from their own frames to the rows that `truth_grid` and `count_returns` take.

    Parameters
    ----------
    T : (4, 4) float
        ``T_grid_world``, from the frame of the poses to that of the grid.
    poses : (B, 4, 4) float
        ``T_world_object``; origin in the middle of the footprint, x forward, z up.
    sizes : (B, 3) float
        Length, width, height [m].

    Returns
    -------
    (B, 7) float64
        x, y of the middle, yaw, length, width, bottom, top. Where the frames tilt against each other, the middle
        is that of the body at half its height, and bottom and top hold the whole box.
    """
    poses, sizes = (
        np.asarray(poses, np.float64).reshape(-1, 4, 4),
        np.asarray(sizes, np.float64).reshape(-1, 3),
    )
    if len(poses) != len(sizes):
        raise ValueError(f"poses and sizes must be as many, got {len(poses)} and {len(sizes)}")
    seen = np.asarray(T, np.float64) @ poses
    middle = seen[:, :3, 3] + 0.5 * sizes[:, 2, None] * seen[:, :3, 2]
    reach = 0.5 * np.abs(seen[:, 2, :3] * sizes).sum(axis=1)
    yaw = np.arctan2(seen[:, 1, 0], seen[:, 0, 0])
    bottom, top = middle[:, 2] - reach, middle[:, 2] + reach
    return np.column_stack([middle[:, :2], yaw, sizes[:, :2], bottom, top])
