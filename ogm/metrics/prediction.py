"""Counts of a predicted dynamic grid against the truth of the predicted time.

Cells of moving objects are compared with a tolerance of one cell: recall is over their cells occupied in the later
scan, precision over the cells predicted moving.
"""

from operator import add
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.extras import import_extra
from ogm.metrics.areas import above, parts
from ogm.metrics.motion import FASTEST, MOVING, STILL
from ogm.metrics.scores import Metric
from ogm.state import CellState, Truth

LEVELS = 1025  # of histograms: 0, 1/1024, ..., 1
BINS = 15  # of P(occupied), for calibration
PRECISION = 0.7  # of the stated recall
MASS = 0.25  # `moving_mass` above which a cell is predicted moving

PREDICTION_METRICS = {
    "recall": Metric(
        "recall", "higher", "share of cells of moving objects, occupied in the later scan, with a moving mass above "
        f"{MASS} within one cell"
    ),
    "precision": Metric(
        "precision", "higher", f"share of cells with a moving mass above {MASS} within one cell of moving objects"
    ),
    "recall_at_70": Metric(
        "recall at 70 %", "higher", f"largest recall over thresholds with a precision of {PRECISION} or more"
    ),
    "best_f1": Metric("best F1", "higher", "largest harmonic mean of precision and recall over thresholds"),
    "brier": Metric("Brier", "lower", "mean squared error of P(occupied), cells known at the later time"),
    "ece": Metric("ECE", "lower", f"calibration error of P(occupied), cells known at the later time, {BINS} bins"),
    "brier_moving": Metric(
        "Brier, moving", "lower", "mean squared error of P(occupied), cells under a moving object later or now"
    ),
    "ece_moving": Metric("ECE, moving", "lower", "calibration error of P(occupied), cells under a moving object later "
        "or now"),
}  # fmt: skip


class PredictionSums(NamedTuple):
    """Sums over cells of a predicted grid. Add two with `plus`.

    Attributes
    ----------
    predicted_hist : (2, 1025)
        Histograms of `moving_mass`, for cells farther than one cell from moving objects and for the other cells.
    found_hist : (1025,)
        Histogram of cells of moving objects occupied in the later scan, by the largest moving mass within one cell.
    reliability : (2, 15, 3)
        In bins of P(occupied), for all known cells and for known cells under a moving object at the later time or now:
        number of cells, sum of P, number of occupied cells.
    squared_error : (2,)
        Sums of (P - occupied)**2 over these cells.
    """

    predicted_hist: NDArray[np.float64]
    found_hist: NDArray[np.float64]
    reliability: NDArray[np.float64]
    squared_error: NDArray[np.float64]

    @classmethod
    def zeros(cls) -> Self:
        """Return sums of zero."""
        return cls(*map(np.zeros, ((2, LEVELS), (LEVELS,), (2, BINS, 3), (2,))))

    def plus(self, other: Self) -> "PredictionSums":
        """Return the added sums of both."""
        return PredictionSums(*map(add, self, other))


def moving_mass(grid: DynamicGrid) -> NDArray[np.float64]:
    """Return the mass of dynamic times min(speed / (2 m/s), 1), (nx, ny) in [0, 1]."""
    speed = np.nan_to_num(grid.speed.astype(np.float64))
    return grid.dynamic.astype(np.float64) * np.minimum(speed / FASTEST, 1.0)


def accumulate_prediction(
    predicted: DynamicGrid, truth: Truth, occupied: NDArray[np.bool_], moving_now: NDArray[np.bool_] | None = None
) -> PredictionSums:
    """Return the sums of a predicted grid for its scores.

    Parameters
    ----------
    predicted : DynamicGrid
    truth : Truth
        Truth at the later time, with motion, on the same cells and axes. Ignored cells are left out.
    occupied : (nx, ny) bool
        Cells occupied in the scan at the later time.
    moving_now : (nx, ny) bool, optional
        Cells under a moving object at the time of the prediction.

    Raises
    ------
    ValueError
        If the truth has no motion, or the shapes do not fit.
    """
    ndimage = import_extra("scipy.ndimage", "evaluate")  # here, as it would double the import time

    if truth.motion is None:
        raise ValueError("the truth must have motion, got none: open a dataset with velocities of objects")
    shape = predicted.spec.shape
    for name, array in (("truth", truth.state), ("occupied", occupied), ("moving_now", moving_now)):
        if array is not None and array.shape != shape:
            raise ValueError(f"{name} must have the grid's cells {shape}, got {array.shape}; crop it to them")
    sums = PredictionSums.zeros()
    speed = np.hypot(truth.motion.velocity[..., 0], truth.motion.velocity[..., 1])
    moving, known = speed > MOVING, (speed > MOVING) | (speed < STILL)
    mass, square = moving_mass(predicted), np.ones((3, 3))
    near = ndimage.binary_dilation(moving, square)
    for row, cells in enumerate((known & ~near, known & near)):
        sums.predicted_hist[row] = _histogram(mass[cells])
    sums.found_hist[:] = _histogram(ndimage.maximum_filter(mass, footprint=square, mode="constant")[moving & occupied])

    probability = (predicted.occupied.astype(np.float64) + 1.0 - predicted.free) / 2
    touched = moving if moving_now is None else moving | moving_now
    for row, cells in enumerate((truth.known, truth.known & touched)):
        p, observed = probability[cells], truth.state[cells] == CellState.OCCUPIED
        level = np.clip((p * BINS).astype(np.intp), 0, BINS - 1)
        columns = (None, p, observed.astype(np.float64))
        sums.reliability[row] = np.stack([np.bincount(level, column, BINS) for column in columns], axis=-1)
        sums.squared_error[row] = ((p - observed) ** 2).sum()
    return sums


def score_prediction(sums: PredictionSums) -> dict[str, float]:
    """Return the scores of `PREDICTION_METRICS`; NaN for scores without cells."""
    recall, precision = prediction_curve(sums)
    at = LEVELS - 1 - int(np.floor(MASS * (LEVELS - 1))) - 1  # the lowest level above the threshold
    f1 = 2 * precision * recall / np.maximum(precision + recall, 1e-12)
    valid, there = precision >= PRECISION, bool(sums.found_hist.any())
    cells, predicted, observed = np.moveaxis(sums.reliability, -1, 0)  # (2, 15) each
    total = cells.sum(axis=-1)
    brier, ece = parts(sums.squared_error, total), parts(np.abs(predicted - observed).sum(axis=-1), total)
    values = {
        "recall": recall[at] if there else np.nan,
        "precision": precision[at],
        "recall_at_70": (recall[valid].max() if valid.any() else 0.0) if there else np.nan,
        "best_f1": np.nanmax(f1) if there and not np.isnan(f1).all() else np.nan,
        "brier": brier[0],
        "ece": ece[0],
        "brier_moving": brier[1],
        "ece_moving": ece[1],
    }
    return {name: float(values[name]) for name in PREDICTION_METRICS}


def prediction_curve(sums: PredictionSums) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return recall and precision, (1025,) each, for thresholds 1, 1023/1024, ..., 0 of the moving mass.

    Precision is NaN if no cell reaches the threshold, recall without moving cells.
    """
    wrong, right = sums.predicted_hist
    found = above(sums.found_hist)
    return parts(found, found[-1]), parts(above(right), above(right) + above(wrong))


def _histogram(mass: NDArray[np.float64]) -> NDArray[np.float64]:
    level = np.floor(mass * (LEVELS - 1) + 1e-6).astype(np.intp)
    return np.bincount(np.clip(level, 0, LEVELS - 1), minlength=LEVELS).astype(np.float64)
