"""Counts of a dynamic grid against the true motion of its cells.

Only cells occupied in the scan are compared, as unobserved cells have no velocity to estimate. Counts are additive, see
`ogm.metrics.counts`.
"""

from collections.abc import Mapping, Sequence
from operator import add
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.metrics.counts import LEVELS, RANGES
from ogm.state import Motion

MOVING, STILL = 1.0, 0.3  # [m/s] true speed above which a cell is moving, below which static; between: ignored
FASTEST = 2.0  # [m/s] estimated speed above which the score depends only on belief
THRESHOLD = 0.6  # [m/s] score above which a cell is predicted moving
SLOW = 5.0  # [m/s] up to which a moving cell is slow
KINDS = ("vehicle", "cyclist", "pedestrian", "other")
GROUPS = ("moving", *KINDS, "slow", "fast", "static")  # of cells, by truth; a moving cell is in three groups
FIRST_EDGE, RATIO, BINS = 0.01, 1.01, 930  # of histograms of errors: [0, 0.01) and then 1 % each, up to 103
SECTORS = 720  # of histograms of heading errors: 0.25 degrees each
INSIDE = (0.50, 0.95)  # probabilities of the ellipses of a cell's velocity

_WORDS = {  # parts of labels, in the order of the search
    "pedestrian": ("pedestrian", "person", "human", "walker", "stroller", "wheelchair"),
    "cyclist": ("cycl", "rider", "motorbike"),
    "vehicle": ("vehicle", "car", "van", "truck", "bus", "tram", "train", "trailer"),
}


class MotionSums(NamedTuple):
    """Sums over cells occupied in the scan with known true motion. Add two with `plus`.

    The axis `groups` follows `GROUPS`. *Motion* is the velocity of the grid in cells predicted moving, and 0 in other
    cells.

    Attributes
    ----------
    score_hist : (2, 4097)
        Histograms of the score of static and of moving cells, see `moving_score`, over [0, 2] m/s.
    cells : (groups, 2)
        Number of cells, and of cells predicted moving.
    range_cells : (ranges, 2, 2)
        Number of static and moving cells by the bins of `RANGES`, and of these predicted moving; zeros without
        distances.
    velocity_hist, motion_hist : (groups, 930)
        Histograms of the length of the error of the velocity, in cells with a velocity, and of the motion, in all
        cells.
    velocity_sums : (groups, 2)
        Number of cells with a velocity, and the sum of their squared errors [m²/s²].
    motion_sums : (groups,)
        Sums of the error of the motion [m/s].
    relative_hist, relative_sums : (groups, 930), (groups,)
        Histograms and sums of the error of the motion over the true speed; zeros for the group ``static``.
    heading_hist : (groups, 720)
        Histograms of the error of the heading of the velocity, over [0, 180] degrees.
    ellipses : (groups, 3)
        Number of cells with a velocity and a covariance, and of cells with the true velocity in the 50 % and in the
        95 % ellipse.
    body : (3,)
        Number of all cells under moving objects with at least one cell occupied in the scan; of cells with more mass on
        occupied than on free; and of cells with a mass of free above 1/2.
    """

    score_hist: NDArray[np.float64]
    cells: NDArray[np.float64]
    range_cells: NDArray[np.float64]
    velocity_hist: NDArray[np.float64]
    motion_hist: NDArray[np.float64]
    velocity_sums: NDArray[np.float64]
    motion_sums: NDArray[np.float64]
    relative_hist: NDArray[np.float64]
    relative_sums: NDArray[np.float64]
    heading_hist: NDArray[np.float64]
    ellipses: NDArray[np.float64]
    body: NDArray[np.float64]

    @classmethod
    def zeros(cls) -> Self:
        """Return sums of zero."""
        n = len(GROUPS)
        shapes: list[tuple[int, ...]] = [(2, LEVELS), (n, 2), (len(RANGES) - 1, 2, 2), (n, BINS), (n, BINS), (n, 2)]
        shapes += [(n,), (n, BINS), (n,), (n, SECTORS), (n, 3), (3,)]
        return cls(*map(np.zeros, shapes))

    def plus(self, other: Self) -> "MotionSums":
        """Return the added sums of both."""
        return MotionSums(*map(add, self, other))


def moving_score(grid: DynamicGrid) -> NDArray[np.float64]:
    """Return the score of motion of each cell: belief in dynamic times min(speed, 2 m/s).

    Returns
    -------
    (nx, ny) float64
        Score, 0 to 2 m/s; the belief is dynamic / (static + dynamic), and 0 without mass of occupied.
    """
    occupied = grid.static.astype(np.float64) + grid.dynamic
    belief = grid.dynamic / np.where(occupied > 0, occupied, 1.0)
    return belief * np.minimum(np.nan_to_num(grid.speed.astype(np.float64)), FASTEST)


def predicted_moving(grid: DynamicGrid, threshold: float = THRESHOLD) -> NDArray[np.bool_]:
    """Return the cells predicted moving, (nx, ny), with a `moving_score` above a threshold [m/s]."""
    return moving_score(grid) > threshold


def object_kinds(labels: Sequence[str]) -> NDArray[np.int8]:
    """Return the kind of each object, (B,), an index in `KINDS`, by words in its label."""
    found = np.full(len(labels), KINDS.index("other"), np.int8)
    for k, label in enumerate(labels):
        for kind, words in _WORDS.items():
            if any(word in label.lower() for word in words):
                found[k] = KINDS.index(kind)
                break
    return found


def accumulate_motion(
    grid: DynamicGrid,
    motion: Motion,
    occupied: NDArray[np.bool_],
    labels: Sequence[str] = (),
    distance: NDArray[np.floating] | None = None,
    predicted: NDArray[np.bool_] | None = None,
) -> MotionSums:
    """Return the sums of a grid for the scores of motion.

    Parameters
    ----------
    grid : DynamicGrid
    motion : Motion
        True motion on the same cells and axes. Cells with NaN or 0.3 to 1 m/s are left out.
    occupied : (nx, ny) bool
        Cells occupied in the scan, with a mass above 1/2 in the measurement grid.
    labels : sequence of str, optional
        Labels of the objects in `motion.box`; by default all objects are of the kind ``other``.
    distance : (nx, ny) float array, optional
        Distances of the cells [m], see `ogm.metrics.distances`; needed for sums by range.
    predicted : (nx, ny) bool, optional
        Cells predicted moving; by default from `predicted_moving`.

    Raises
    ------
    ValueError
        If the shapes do not fit, or a box has no label.
    """
    chosen = predicted_moving(grid) if predicted is None else predicted
    _check(grid, motion, labels, {"occupied": occupied, "distance": distance, "predicted": chosen})
    sums = MotionSums.zeros()
    true_speed = np.hypot(*np.moveaxis(motion.velocity.astype(np.float64), -1, 0))  # (nx, ny), NaN where unknown
    moving, static = true_speed > MOVING, true_speed < STILL
    _count_body(grid, motion.box, moving, occupied, sums)

    at = occupied & (moving | static)
    moves, true, speed = moving[at], motion.velocity[at].astype(np.float64), true_speed[at]
    scores = moving_score(grid)[at]
    predicted = chosen[at]
    levels = np.rint(scores / FASTEST * (LEVELS - 1)).astype(np.intp)
    for row, kept in enumerate((~moves, moves)):
        sums.score_hist[row] = np.bincount(levels[kept], minlength=LEVELS)
    if distance is not None:
        place = np.searchsorted(RANGES, distance[at], side="right") - 1
        np.add.at(sums.range_cells, (place, moves.astype(np.intp), 0), 1)
        np.add.at(sums.range_cells, (place, moves.astype(np.intp), 1), predicted)

    found = grid.velocity[at].astype(np.float64)
    known = np.isfinite(found).all(axis=-1)
    error = np.hypot(*(found - true).T)
    motion_error = np.hypot(*(np.where((predicted & known)[:, None], found, 0.0) - true).T)
    relative = motion_error / np.where(moves, speed, 1.0)
    heading = np.abs(_angle_between(found, true))
    squared = _squared_distances(found - true, grid.covariance[at].astype(np.float64))

    kinds = object_kinds(labels) if len(labels) else np.zeros(0, np.int8)
    kind = np.append(kinds, np.int8(KINDS.index("other")))[motion.box[at]]  # -1: the last
    members = [moves, *(moves & (kind == k) for k in range(len(KINDS)))]
    members += [moves & (speed <= SLOW), moves & (speed > SLOW), ~moves]
    for row, kept in enumerate(members):
        valued, spread = kept & known, kept & np.isfinite(squared)
        sums.cells[row] = np.count_nonzero(kept), np.count_nonzero(kept & predicted)
        sums.velocity_hist[row] = _histogram(error[valued])
        sums.velocity_sums[row] = np.count_nonzero(valued), (error[valued] ** 2).sum()
        sums.motion_hist[row], sums.motion_sums[row] = _histogram(motion_error[kept]), motion_error[kept].sum()
        limits = (-2 * np.log1p(-p) for p in INSIDE)  # quantiles of chi² with two degrees of freedom
        inside = (np.count_nonzero(squared[spread] <= limit) for limit in limits)
        sums.ellipses[row] = np.count_nonzero(spread), *inside
        if GROUPS[row] != "static":
            sums.relative_hist[row], sums.relative_sums[row] = _histogram(relative[kept]), relative[kept].sum()
            sector = np.minimum(heading[valued] / np.pi * SECTORS, SECTORS - 1).astype(np.intp)
            sums.heading_hist[row] = np.bincount(sector, minlength=SECTORS)
    return sums


def _count_body(
    grid: DynamicGrid, box: NDArray[np.int16], moving: NDArray[np.bool_], occupied: NDArray[np.bool_], sums: MotionSums
) -> None:
    """Count all cells under moving objects that have a cell occupied in the scan."""
    under = moving & (box >= 0)
    cells = under & np.isin(box, np.unique(box[under & occupied]))
    free, full = grid.free[cells], grid.occupied[cells]
    sums.body[:] = len(free), np.count_nonzero(full > free), np.count_nonzero(free > 0.5)


def _squared_distances(error: NDArray[np.float64], covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return squared Mahalanobis distances, (n,): 0 without error, 1e300 for a singular covariance."""
    (x, y), (xx, xy, yy) = error.T, (covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1])
    determinant = xx * yy - xy * xy
    valid = (determinant > 0) & (xx > 0)
    value = (yy * x * x - 2 * xy * x * y + xx * y * y) / np.where(valid, determinant, 1.0)
    value = np.where(valid, np.maximum(value, 0.0), np.where((x == 0) & (y == 0), 0.0, 1e300))
    return np.where(np.isfinite(x + y + determinant), value, np.nan)


def _angle_between(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the angle from `b` to `a`, (n,) in [-π, π]."""
    cross, dot = b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0], (a * b).sum(axis=-1)
    return np.asarray(np.arctan2(cross, dot))


def _histogram(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Count errors in the bins [0, 0.01), [0.01, 0.0101), ...; the last bin is open."""
    level = np.log(np.maximum(errors, FIRST_EDGE) / FIRST_EDGE) / np.log(RATIO)
    level = np.where(errors < FIRST_EDGE, 0, np.minimum(np.floor(level) + 1, BINS - 1))
    return np.bincount(level.astype(np.intp), minlength=BINS).astype(np.float64)


def _check(grid: DynamicGrid, motion: Motion, labels: Sequence[str], arrays: Mapping[str, NDArray[Any] | None]) -> None:
    shape = grid.spec.shape
    for name, array in {"motion.velocity": motion.velocity[..., 0], "motion.box": motion.box, **arrays}.items():
        if array is not None and array.shape != shape:
            raise ValueError(f"{name} must have the grid's cells {shape}, got {array.shape}; crop the truth to them")
    if len(labels) and motion.box.size and motion.box.max() >= len(labels):
        raise ValueError(f"labels must have an entry for box {motion.box.max()} of motion.box, got {len(labels)}")
