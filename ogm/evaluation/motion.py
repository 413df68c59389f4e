"""Evaluation of motion: results of frames, pooled results, and predictions compared with the truth of their time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.evaluation.methods import FusedMethod
from ogm.evaluation.statistics import Interval, mean_interval
from ogm.fusion.pipeline import grid_pose
from ogm.grid import GridSpec
from ogm.metrics import (
    MOTION_METRICS,
    PREDICTION_METRICS,
    MotionSums,
    PredictionSums,
    accumulate_motion,
    accumulate_prediction,
    detection_times,
    distances,
    motion_curve,
    score_motion,
    score_prediction,
)
from ogm.metrics.detection_time import Detection, ObjectCells, object_cells
from ogm.metrics.motion import predicted_moving
from ogm.metrics.motion_scores import motion_by_range
from ogm.scan import Boxes, Frame
from ogm.state import CellState, Motion, Truth

HORIZON = 0.5  # [s] from a scan to the predicted time
TOLERANCE = 0.02  # [s] between the predicted time and the stamp of its frame
PREDICTED = {  # metrics that need no truth of the earlier time
    name: metric._replace(title=f"{metric.title}, {HORIZON:g} s ahead")
    for name, metric in PREDICTION_METRICS.items()
    if not name.endswith("_moving")
}


class _Prediction(NamedTuple):
    stamp: float  # [s] of the predicted time
    grid: DynamicGrid  # in map coordinates


class Predictions:
    """Pending predictions of each dynamic map, by the index of its method."""

    def __init__(self) -> None:
        self._sequence = ""
        self._waiting: dict[int, list[_Prediction]] = {}

    def predict(self, place: int, method: FusedMethod, frame: Frame) -> None:
        """Store the prediction for `HORIZON` after the last fused frame of a method."""
        if frame.sequence != self._sequence:
            self._sequence, self._waiting = frame.sequence, {}
        assert frame.stamp is not None
        kept = [pending for pending in self._waiting.get(place, []) if pending.stamp > frame.stamp + TOLERANCE]
        self._waiting[place] = [*kept, _Prediction(frame.stamp + HORIZON, method.predicted(HORIZON))]

    def compare(self, place: int, frame: Frame, truth: Truth, occupied: NDArray[np.bool_]) -> PredictionSums:
        """Compare predictions for the time of a frame with its truth; call it before `predict` of the same frame.

        Parameters
        ----------
        place : int
            Index of the method.
        frame : Frame
        truth : Truth
            Truth with motion, on the evaluated cells.
        occupied : (nx, ny) bool
            Cells occupied in the scan.

        Returns
        -------
        PredictionSums
            Zeros without a prediction for this time.
        """
        assert frame.stamp is not None
        sums, T = PredictionSums.zeros(), grid_pose(frame)
        shown = Truth(truth.spec, occupied.astype(np.uint8) + np.uint8(CellState.FREE))
        for pending in self._waiting.get(place, []) if frame.sequence == self._sequence else ():
            if abs(pending.stamp - frame.stamp) <= TOLERANCE:
                spec = pending.grid.spec
                seen = _on_map(shown, spec, T).state == CellState.OCCUPIED
                sums = sums.plus(accumulate_prediction(pending.grid, _on_map(truth, spec, T), seen))
        return sums


def _on_map(truth: Truth, spec: GridSpec, T_map_grid: NDArray[np.float64]) -> Truth:  # noqa: N803
    """Return the truth around a vehicle on cells of the map."""
    yaw = float(np.arctan2(T_map_grid[1, 0], T_map_grid[0, 0]))
    return truth.crop(spec, yaw, float(T_map_grid[0, 3]), float(T_map_grid[1, 3]))


MOTION_HEADLINE = (
    "motion_ap", "motion_iou", "motion_precision", "motion_recall", "static_moving", "velocity_rmse", "velocity_median",
    "heading_median", "inside_95", "moving_occupied", "moving_free",
)  # fmt: skip
MAX_POINTS = 200  # of a curve


class FrameMotion(NamedTuple):
    """Results of a dynamic grid in one frame: sums over cells, observed objects, and sums of its prediction."""

    sums: MotionSums
    objects: ObjectCells
    predicted: PredictionSums


@dataclass(frozen=True, eq=False)
class MotionResult:
    """Motion results of all evaluated frames, for methods with dynamic grids.

    Parameters
    ----------
    methods : tuple of str
    values : dict of str to (methods, frames) float64
        Values of each metric in `ogm.metrics.MOTION_METRICS`; NaN in frames without a value.
    pooled : tuple of MotionSums
        Sums over all frames, of each method.
    predicted : tuple of PredictionSums
        Sums over all predicted frames, of each method.
    detections : tuple of list of Detection
        Detections of the objects of all sequences, of each method.
    drives : list of str
        Drive of each frame.
    """

    methods: tuple[str, ...]
    values: dict[str, NDArray[np.float64]]
    pooled: tuple[MotionSums, ...]
    predicted: tuple[PredictionSums, ...]
    detections: tuple[list[Detection], ...]
    drives: list[str]

    def interval(self, method: str, metric: str) -> Interval:
        """Return a metric's mean over frames with its 95 % interval over drives."""
        return mean_interval(self.values[metric][self.methods.index(method)], self.drives)


class MotionCollector:
    """Collection of motion results over successive frames.

    Parameters
    ----------
    methods : sequence of str
        All methods of the evaluation.
    """

    def __init__(self, methods: Sequence[str]) -> None:
        self._names = tuple(methods)
        self._rows: list[dict[int, dict[str, float]]] = []
        self._pooled: dict[int, MotionSums] = {}
        self._predicted: dict[int, PredictionSums] = {}
        self._objects: dict[int, dict[str, list[tuple[float, ObjectCells]]]] = {}

    def add(self, motion: Mapping[int, FrameMotion], sequence: str, stamp: float | None) -> None:
        """Add the results of a frame, by the index of the method."""
        self._rows.append({k: score_motion(result.sums) for k, result in motion.items()})
        for k, result in motion.items():
            self._pooled[k] = self._pooled.get(k, MotionSums.zeros()).plus(result.sums)
            self._predicted[k] = self._predicted.get(k, PredictionSums.zeros()).plus(result.predicted)
            if stamp is not None:
                self._objects.setdefault(k, {}).setdefault(sequence, []).append((stamp, result.objects))

    def result(self, drives: list[str]) -> MotionResult | None:
        """Return the results of all frames; None without dynamic grids or true motion."""
        if not self._pooled:
            return None
        nothing = dict.fromkeys(MOTION_METRICS, np.nan)
        places = sorted(self._pooled)
        values = {m: np.array([[row.get(k, nothing)[m] for row in self._rows] for k in places]) for m in MOTION_METRICS}
        times = tuple(
            [found for frames in self._objects.get(k, {}).values() for found in detection_times(frames)] for k in places
        )
        pooled, predicted = tuple(self._pooled[k] for k in places), tuple(self._predicted[k] for k in places)
        return MotionResult(tuple(self._names[k] for k in places), values, pooled, predicted, times, drives)


def compare_motion(
    grid: DynamicGrid, occupied: NDArray[np.bool_], motion: Motion, boxes: Boxes | None, predicted: PredictionSums
) -> FrameMotion:
    """Compare a dynamic grid with the true motion of a frame.

    Parameters
    ----------
    grid : DynamicGrid
        Grid in the axes of the truth.
    occupied : (nx, ny) bool
        Cells occupied in the scan.
    motion : Motion
        True motion on the same cells.
    boxes : Boxes, optional
        Boxes that `motion.box` refers to.
    predicted : PredictionSums
        See `ogm.evaluation.motion.Predictions.compare`.
    """
    boxes = Boxes.empty() if boxes is None else boxes
    moving = predicted_moving(grid)
    sums = accumulate_motion(grid, motion, occupied, boxes.label, distances(grid.spec), moving)
    return FrameMotion(sums, object_cells(motion, occupied, moving, boxes.track), predicted)


def motion_record(result: MotionResult | None) -> dict[str, Any] | None:
    """Return the motion results of an evaluation for its record."""
    if result is None:
        return None
    methods = {}
    rows = zip(result.methods, result.pooled, result.predicted, result.detections, strict=True)
    for name, sums, predicted, found in rows:
        scores = score_prediction(predicted)
        seconds = [detection.seconds for detection in found]
        recall, precision, threshold = motion_curve(sums)
        thin = np.linspace(0, len(recall) - 1, min(len(recall), MAX_POINTS)).astype(int)
        methods[name] = {
            "macro": {metric: result.interval(name, metric) for metric in MOTION_METRICS},
            "micro": score_motion(sums) | {f"predicted_{name}": scores[name] for name in PREDICTED},
            "cells": {"moving": sums.cells[0, 0], "static": sums.cells[-1, 0]},
            "time to detect": {
                "objects": len(seconds),
                "median": float(np.median(seconds)) if seconds else None,
                "never": int(np.isinf(seconds).sum()),
            },
            "by range": motion_by_range(sums),
            "curve": {"recall": recall[thin], "precision": precision[thin], "threshold": threshold[thin]},
            "per frame": {metric: rows[result.methods.index(name)] for metric, rows in result.values.items()},
        }
    predictions = {f"predicted_{name}": metric for name, metric in PREDICTED.items()}
    return {"metrics": MOTION_METRICS | predictions, "methods": methods}


def group_motion(record: Mapping[str, Any] | None) -> list[list[str]]:
    """Return the names of metrics outside the headline, grouped by their cells."""
    found: dict[str, list[str]] = {}
    for name in record["metrics"] if record else ():
        if name not in MOTION_HEADLINE:
            found.setdefault(name.partition("_")[0], []).append(name)
    return list(found.values())
