"""Predictions of dynamic maps in an evaluation: made after every scan, compared in the frame of their time."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.evaluation.methods import FusedMethod
from ogm.fusion.pipeline import grid_pose
from ogm.grid import GridSpec
from ogm.metrics import PREDICTION_METRICS, PredictionSums, accumulate_prediction
from ogm.scan import Frame
from ogm.state import CellState, Truth

HORIZON = 0.5  # [s] from a scan to the time that is predicted
TOLERANCE = 0.02  # [s] by which the stamp of the later frame may differ from that time
PREDICTED = {  # the metrics that need no truth of the earlier time
    name: metric._replace(title=f"{metric.title}, {HORIZON:g} s ahead")
    for name, metric in PREDICTION_METRICS.items()
    if not name.endswith("_moving")
}


class _Prediction(NamedTuple):
    stamp: float  # [s] of the predicted time
    grid: DynamicGrid  # in map coordinates


class Predictions:
    """The predictions of each dynamic map, by the place of its method, that wait for the frame of their time."""

    def __init__(self) -> None:
        self._sequence = ""
        self._waiting: dict[int, list[_Prediction]] = {}

    def predict(self, place: int, method: FusedMethod, frame: Frame) -> None:
        """Predict the time `HORIZON` after a frame that the method has just fused."""
        if frame.sequence != self._sequence:
            self._sequence, self._waiting = frame.sequence, {}
        assert frame.stamp is not None
        kept = [made for made in self._waiting.get(place, []) if made.stamp > frame.stamp + TOLERANCE]
        self._waiting[place] = [*kept, _Prediction(frame.stamp + HORIZON, method.predicted(HORIZON))]

    def compare(self, place: int, frame: Frame, truth: Truth, occupied: NDArray[np.bool_]) -> PredictionSums:
        """Compare the predictions of the time of a frame with its truth; before `predict` of the same frame.

        Parameters
        ----------
        place : int
        frame : Frame
        truth : Truth
            With motion, on the evaluated cells.
        occupied : (nx, ny) bool
            Cells that the scan shows as occupied.

        Returns
        -------
        PredictionSums
            Zeros if no prediction is of this time.
        """
        assert frame.stamp is not None
        sums, T = PredictionSums.zeros(), grid_pose(frame)
        shown = Truth(truth.spec, occupied.astype(np.uint8) + np.uint8(CellState.FREE))
        for made in self._waiting.get(place, []) if frame.sequence == self._sequence else ():
            if abs(made.stamp - frame.stamp) <= TOLERANCE:
                there, spec = _on_map(truth, made.grid.spec, T), made.grid.spec
                seen = _on_map(shown, spec, T).state == CellState.OCCUPIED
                sums = sums.plus(accumulate_prediction(made.grid, there, seen))
        return sums


def _on_map(truth: Truth, spec: GridSpec, T_map_grid: NDArray[np.float64]) -> Truth:  # noqa: N803
    """Return the truth around a vehicle on cells of the map."""
    yaw = float(np.arctan2(T_map_grid[1, 0], T_map_grid[0, 0]))
    return truth.crop(spec, yaw, float(T_map_grid[0, 3]), float(T_map_grid[1, 3]))
