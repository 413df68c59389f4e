"""Boxes that are moved, widened, looked up: what a recording needs to take its moving objects out."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.grid import GridSpec
from ogm.pose import check_pose
from ogm.truth.boxes import cells_in_box, check_boxes, over

__all__ = ["boxes_over_points", "cells_in_boxes", "move_boxes", "moving_tracks", "widen_boxes"]

MOVING = 1.0  # [m/s] from the first box of a track to the last, from which an object moves
AWAY = 3.0  # [m] or this far from the first box at any time: who drives a little and then waits moves too


def move_boxes(boxes: ArrayLike, T: ArrayLike) -> NDArray[np.float64]:
    """Take upright boxes through a transform that hardly tilts; they stay upright.

    Parameters
    ----------
    boxes : (B, 7) float
        x, y of the middle [m], yaw [rad], length, width, bottom, top [m].
    T : (4, 4) float
        ``T_to_from``.

    Returns
    -------
    (B, 7) float64
        Their middles go through the transform, their yaw turns by its heading.
    """
    result = check_boxes(boxes, "boxes").copy()
    if not len(result):
        return np.empty((0, 7))
    T = check_pose(T)
    half = (result[:, 6] - result[:, 5]) / 2
    middles = np.column_stack([result[:, :2], result[:, 5] + half, np.ones(len(result))]) @ T.T
    result[:, :2] = middles[:, :2]
    result[:, 2] += np.arctan2(T[1, 0], T[0, 0])
    result[:, 5], result[:, 6] = middles[:, 2] - half, middles[:, 2] + half
    return result


def widen_boxes(boxes: ArrayLike, margin: float) -> NDArray[np.float64]:
    """Make boxes (B, 7) longer and wider by `margin` [m] on every side, and as much lower and higher."""
    result = check_boxes(boxes, "boxes")
    if not len(result):
        return np.empty((0, 7))
    return result + [0, 0, 0, 2 * margin, 2 * margin, -margin, margin]


def cells_in_boxes(boxes: ArrayLike, spec: GridSpec) -> NDArray[np.bool_]:
    """Return which cells any of the boxes covers, (nx, ny); each as `cells_in_box`."""
    result = np.zeros(spec.shape, bool)
    for box in check_boxes(boxes, "boxes"):
        result[cells_in_box(box, spec)] = True
    return result


def boxes_over_points(points: NDArray[np.floating], boxes: ArrayLike) -> NDArray[np.bool_]:
    """Return which points lie over, in or under any of the boxes, (N,): at any height."""
    result = np.zeros(len(points), bool)
    for box in check_boxes(boxes, "boxes"):
        result |= over(box, points[:, 0], points[:, 1])
    return result


def moving_tracks(
    stamps: ArrayLike, places: ArrayLike, tracks: ArrayLike, *, speed: float = MOVING, away: float = AWAY
) -> set[str]:
    """Tell which objects of a recording move.

    Parameters
    ----------
    stamps : (M,) float
        Times at which boxes were seen [s].
    places : (M, 2) float
        Where their middles were then, in the map's frame [m].
    tracks : (M,) str
        Whose boxes they were. Objects without a name ('') cannot be followed, and are left out.
    speed : float
        From first to last box, over the time between [m/s].
    away : float
        Distance from the first box at any time [m].

    Returns
    -------
    set of str
        Tracks above either. An object that was seen once does not move, as far as anybody can tell.
    """
    stamps, places = np.asarray(stamps, np.float64), np.reshape(np.asarray(places, np.float64), (-1, 2))
    names = np.asarray(tracks, dtype=np.str_)
    if not len(stamps) == len(places) == len(names):
        raise ValueError(
            f"stamps, places and tracks must be as many, got {len(stamps)}, {len(places)} and {len(names)}"
        )
    result = set()
    for name in np.unique(names[names != ""]):
        mine = np.flatnonzero(names == name)
        mine = mine[np.argsort(stamps[mine], kind="stable")]
        way = np.hypot(*(places[mine] - places[mine[0]]).T)
        time = stamps[mine[-1]] - stamps[mine[0]]
        if way.max() > away or (time > 0 and way[-1] > speed * time):
            result.add(str(name))
    return result
