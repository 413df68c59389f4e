"""Scores of motion computed from `MotionSums`, with descriptions."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.metrics.areas import above, average_precision, parts
from ogm.metrics.motion import FIRST_EDGE, GROUPS, RATIO, SECTORS, MotionSums
from ogm.metrics.scores import Metric

_ALL, _STATIC = GROUPS.index("moving"), GROUPS.index("static")
_TABLE = """\
motion_ap | AP moving | higher | average precision of the score, belief in dynamic times min(speed, 2 m/s), for cells \
faster than 1 m/s among cells occupied in the scan
motion_iou | IoU moving | higher | IoU of cells predicted moving (score above 0.6 m/s) and moving cells
motion_precision | precision moving | higher | share of moving cells among cells predicted moving
motion_recall | recall moving | higher | share of moving cells predicted moving
static_moving | static predicted moving | lower | share of static cells predicted moving
velocity_rmse | velocity RMSE | lower | root mean square of the length of the velocity's error in moving cells with a \
velocity [m/s]
velocity_median | velocity median | lower | median length of the velocity's error in these cells [m/s]
velocity_known | has a velocity | higher | share of moving cells with a velocity
heading_median | heading median | lower | median error of the velocity's direction in these cells [degrees]
normalised_mean | normalised error | lower | mean error of the motion over the true speed in moving cells; 1 for cells \
not predicted moving
normalised_median | normalised error, median | lower | median error of the motion over the true speed
inside_50 | in the 50 % ellipse |  | share of moving cells' true velocities within the 50 % ellipse of the cell's \
covariance; 0.50 is consistent
inside_95 | in the 95 % ellipse |  | share within the 95 % ellipse; 0.95 is consistent
moving_occupied | moving occupied | higher | share of cells under visible moving objects with more mass on \
occupied than on free
moving_free | moving free | lower | share of these cells with a mass of free above 1/2
"""  # name | title | better | description
_BY_GROUP = """\
recall | recall, {0} | higher | recall of moving cells, {1}
velocity_rmse | velocity RMSE, {0} | lower | velocity RMSE in moving cells, {1} [m/s]
velocity_median | velocity median, {0} | lower | median error of the velocity in moving cells, {1} [m/s]
motion_mean | motion error, {0} | lower | mean error of the motion, 0 where not predicted moving, {1} [m/s]
motion_median | motion median, {0} | lower | median error of the motion, {1} [m/s]
normalised_mean | normalised error, {0} | lower | mean error of the motion over the true speed, {1}
normalised_median | normalised median, {0} | lower | median error of the motion over the true speed, {1}
inside_95 | in the 95 % ellipse, {0} |  | share of true velocities within the 95 % ellipse, {1}
"""
_DESCRIPTIONS = {
    "vehicle": "of vehicles",
    "cyclist": "of cyclists and motorcycles",
    "pedestrian": "of pedestrians",
    "slow": "up to 5 m/s",
    "fast": "above 5 m/s",
}


def _rows(table: str) -> list[list[str]]:
    return [row.split(" | ") for row in table.splitlines()]


def _described() -> dict[str, Metric]:
    found = {name: Metric(*rest) for name, *rest in _rows(_TABLE)}
    for group, description in _DESCRIPTIONS.items():
        rows = _rows(_BY_GROUP.format(group, description))
        found |= {f"{group}_{name}": Metric(*rest) for name, *rest in rows}
    static = "of the motion predicted for static cells [m/s]"
    found["static_motion_mean"] = Metric("motion error, static", "lower", f"mean length {static}")
    found["static_motion_median"] = Metric("motion median, static", "lower", f"median length {static}")
    return found


# By name: title, which way is better, description
MOTION_METRICS = _described()


class MotionCurve(NamedTuple):
    """Precision over recall of moving cells, from the highest threshold down.

    Attributes
    ----------
    recall, precision : (points,) float64
        Empty without moving or static cells.
    threshold : (points,) float64
        Threshold of the score [m/s].
    """

    recall: NDArray[np.float64]
    precision: NDArray[np.float64]
    threshold: NDArray[np.float64]


def score_motion(sums: MotionSums) -> dict[str, float]:
    """Return the scores of `MOTION_METRICS`, in their order; NaN for scores without cells.

    Notes
    -----
    Medians are exact to 1 %, the width of a histogram's bins. Errors below 0.01 count as 0 in medians.
    """
    (moving, right), (static, wrong) = sums.cells[_ALL], sums.cells[_STATIC]
    whole = _of_group(sums, _ALL)
    values = {
        "motion_ap": average_precision(sums.score_hist[1], sums.score_hist[0]),
        "motion_iou": parts(right, moving + wrong) if moving else np.nan,
        "motion_precision": parts(right, right + wrong),
        "motion_recall": parts(right, moving),
        "static_moving": parts(wrong, static),
        "velocity_known": parts(sums.velocity_sums[_ALL, 0], moving),
        "heading_median": _median_heading(sums.heading_hist[_ALL]),
        "inside_50": parts(sums.ellipses[_ALL, 1], sums.ellipses[_ALL, 0]),
        "moving_occupied": parts(sums.body[1], sums.body[0]),
        "moving_free": parts(sums.body[2], sums.body[0]),
        **whole,
        **{f"{group}_{name}": v for group in _DESCRIPTIONS for name, v in _of_group(sums, GROUPS.index(group)).items()},
        **{f"static_{name}": v for name, v in _of_group(sums, _STATIC).items()},
    }
    return {name: float(values[name]) for name in MOTION_METRICS}


def motion_curve(sums: MotionSums) -> MotionCurve:
    """Return precision and recall of moving cells over all thresholds reached by scores of cells."""
    static, moving = sums.score_hist
    if not static.any() or not moving.any():
        return MotionCurve(np.zeros(0), np.zeros(0), np.zeros(0))
    right, predicted = above(moving), above(static + moving)
    kept = (static + moving)[::-1] > 0
    threshold = np.linspace(2.0, 0.0, len(static))
    return MotionCurve((right / right[-1])[kept], (right / np.maximum(predicted, 1))[kept], threshold[kept])


def motion_by_range(sums: MotionSums) -> dict[str, NDArray[np.float64]]:
    """Return numbers of static and moving cells and their shares predicted moving, by the bins of `RANGES`."""
    cells, predicted = sums.range_cells[..., 0], sums.range_cells[..., 1]
    shares = parts(predicted, cells)
    return {
        "static_cells": cells[:, 0],
        "moving_cells": cells[:, 1],
        "static_moving": shares[:, 0],
        "motion_recall": shares[:, 1],
    }


def _of_group(sums: MotionSums, row: int) -> dict[str, Any]:
    """Return the scores of one group of cells."""
    cells, predicted = sums.cells[row]
    valued, squares = sums.velocity_sums[row]
    return {
        "recall": parts(predicted, cells),
        "velocity_rmse": np.sqrt(parts(squares, valued)),
        "velocity_median": median_error(sums.velocity_hist[row]),
        "motion_mean": parts(sums.motion_sums[row], cells),
        "motion_median": median_error(sums.motion_hist[row]),
        "normalised_mean": parts(sums.relative_sums[row], cells),
        "normalised_median": median_error(sums.relative_hist[row]),
        "inside_95": parts(sums.ellipses[row, 2], sums.ellipses[row, 0]),
    }


def median_error(histogram: NDArray[np.float64]) -> float:
    """Return the median of a histogram of errors; 0 below 0.01, NaN without cells."""
    middle = _middle(histogram)
    return float("nan") if np.isnan(middle) else float(FIRST_EDGE * RATIO ** (middle - 1)) if middle >= 1 else 0.0


def _median_heading(histogram: NDArray[np.float64]) -> float:
    """Return the median heading error [degrees]; 0 in the first bin."""
    middle = _middle(histogram)
    return float(middle * 180 / SECTORS) if np.isnan(middle) or middle >= 1 else 0.0


def _middle(histogram: NDArray[np.float64]) -> float:
    """Return the fractional bin at which half of the cells is reached."""
    ends = np.cumsum(histogram)
    if not len(ends) or ends[-1] == 0:
        return float("nan")
    k = int(np.searchsorted(ends, ends[-1] / 2))
    return k + float((ends[-1] / 2 - (ends[k] - histogram[k])) / histogram[k])
