"""What is counted of a predicted dynamic grid against the truth of the time that it was predicted for.

The cells of moving objects are compared with a tolerance of one cell: recall is of those that the later scan shows as
occupied, precision of the cells that are predicted to hold something moving, within a cell of such an object or not.
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
PRECISION = 0.7  # at which the recall is stated
MASS = 0.25  # of `moving_mass`, above which a cell is predicted to hold something that moves

PREDICTION_METRICS = {
    "recall": Metric(
        "recall", "higher", "share of the cells of moving objects that the later scan shows as occupied with a moving "
        f"mass above {MASS} within one cell"
    ),
    "precision": Metric(
        "precision", "higher", f"share of the cells with a moving mass above {MASS} within one cell of moving objects"
    ),
    "recall_at_70": Metric(
        "recall at 70 %", "higher", f"the largest recall of any threshold with a precision of {PRECISION} or more"
    ),
    "best_f1": Metric("best F1", "higher", "the largest harmonic mean of precision and recall of any threshold"),
    "brier": Metric("Brier", "lower", "mean squared error of P(occupied), cells known at the later time"),
    "ece": Metric("ECE", "lower", f"calibration error of P(occupied) on the same cells, {BINS} bins"),
    "brier_moving": Metric(
        "Brier, moving", "lower", "as brier, on cells that a moving object covers at the later time or now"
    ),
    "ece_moving": Metric("ECE, moving", "lower", "as ece, on the same cells"),
}  # fmt: skip


class PredictionSums(NamedTuple):
    """Sums over cells of a predicted grid. Add two with `plus`.

    Attributes
    ----------
    predicted_hist : (2, 1025)
        Histograms of `moving_mass`, of cells farther than one cell from moving objects and of the others.
    found_hist : (1025,)
        Cells of moving objects that the later scan shows as occupied, by the largest moving mass within one cell.
    reliability : (2, 15, 3)
        In bins of P(occupied), of all known cells and of those that a moving object covers at the later time or now:
        cells, sum of P, cells that are occupied.
    squared_error : (2,)
        Sums of (P - occupied)**2 over the same cells.
    """

    predicted_hist: NDArray[np.float64]
    found_hist: NDArray[np.float64]
    reliability: NDArray[np.float64]
    squared_error: NDArray[np.float64]

    @classmethod
    def zeros(cls) -> Self:
        """Return the sums of no cell."""
        return cls(*map(np.zeros, ((2, LEVELS), (LEVELS,), (2, BINS, 3), (2,))))

    def plus(self, other: Self) -> "PredictionSums":
        """Return the sums of both."""
        return PredictionSums(*map(add, self, other))


def moving_mass(grid: DynamicGrid) -> NDArray[np.float64]:
    """Return the mass of dynamic, (nx, ny) in [0, 1], times the share of 2 m/s that its speed reaches."""
    speed = np.nan_to_num(grid.speed.astype(np.float64))
    return grid.dynamic.astype(np.float64) * np.minimum(speed / FASTEST, 1.0)


def accumulate_prediction(
    predicted: DynamicGrid, truth: Truth, occupied: NDArray[np.bool_], moving_now: NDArray[np.bool_] | None = None
) -> PredictionSums:
    """Return the sums of one predicted grid that its scores need.

    Parameters
    ----------
    predicted : DynamicGrid
    truth : Truth
        Of the later time, with motion, on the same cells and axes. What it ignores is left out.
    occupied : (nx, ny) bool
        Cells that the scan of the later time shows as occupied.
    moving_now : (nx, ny) bool, optional
        Cells that a moving object covers when the prediction is made.

    Raises
    ------
    ValueError
        If the truth has no motion, or the shapes do not fit.
    """
    ndimage = import_extra("scipy.ndimage", "evaluate")  # here, as it would double the time of the import

    if truth.motion is None:
        raise ValueError("the truth has no motion to compare with: open a data set whose objects have velocities")
    shape = predicted.spec.shape
    for name, array in (("truth", truth.state), ("occupied", occupied), ("moving_now", moving_now)):
        if array is not None and array.shape != shape:
            raise ValueError(f"{name} must be of the grid's cells {shape}, got {array.shape}; crop it to them")
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
        p, happened = probability[cells], truth.state[cells] == CellState.OCCUPIED
        place = np.clip((p * BINS).astype(np.intp), 0, BINS - 1)
        columns = (None, p, happened.astype(np.float64))
        sums.reliability[row] = np.stack([np.bincount(place, one, BINS) for one in columns], axis=-1)
        sums.squared_error[row] = ((p - happened) ** 2).sum()
    return sums


def score_prediction(sums: PredictionSums) -> dict[str, float]:
    """Return the scores of `PREDICTION_METRICS`; NaN where there is no cell for one."""
    recall, precision = prediction_curve(sums)
    at = LEVELS - 1 - int(np.floor(MASS * (LEVELS - 1))) - 1  # the lowest level above the threshold
    f1 = 2 * precision * recall / np.maximum(precision + recall, 1e-12)
    valid, there = precision >= PRECISION, bool(sums.found_hist.any())
    cells, claimed, happened = np.moveaxis(sums.reliability, -1, 0)  # (2, 15) each
    total = cells.sum(axis=-1)
    brier, ece = parts(sums.squared_error, total), parts(np.abs(claimed - happened).sum(axis=-1), total)
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
    """Return recall and precision, (1025,) each, of the thresholds 1, 1023/1024, ..., 0 of the moving mass.

    Precision is NaN where nothing reaches the threshold, recall where there is no moving cell.
    """
    wrong, right = sums.predicted_hist
    found = above(sums.found_hist)
    return parts(found, found[-1]), parts(above(right), above(right) + above(wrong))


def _histogram(mass: NDArray[np.float64]) -> NDArray[np.float64]:
    level = np.floor(mass * (LEVELS - 1) + 1e-6).astype(np.intp)
    return np.bincount(np.clip(level, 0, LEVELS - 1), minlength=LEVELS).astype(np.float64)
