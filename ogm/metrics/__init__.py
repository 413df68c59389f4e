"""How good a grid is: metrics of an evidential grid against the true states of its cells, of a dynamic one also motion.

Every metric leaves out the cells that the truth ignores. A metric without a cell is NaN, never 0, and `reasons` gives
the reason. `METRICS` describes each.

>>> from ogm.metrics import accumulate, score
>>> scores = score(accumulate(grid.mass, truth.state))               # one frame           # doctest: +SKIP
>>> counts = accumulate(grid.mass, truth.state, distances(spec))     # curves and ranges   # doctest: +SKIP
>>> risk_coverage(counts), by_range(counts), reasons(counts)                          # doctest: +SKIP
>>> score_motion(accumulate_motion(dynamic_grid, truth.motion, scan_occupied))        # doctest: +SKIP
"""

from ogm.metrics.beams import BeamNoise, BeamScores, PlanarBeams, score_beams
from ogm.metrics.counts import ConfusionSums, accumulate
from ogm.metrics.curves import free_space, intervals, precision_recall, reliability, risk_coverage
from ogm.metrics.detection_time import detection_times
from ogm.metrics.motion import MotionSums, accumulate_motion
from ogm.metrics.motion_scores import MOTION_METRICS, motion_curve, score_motion
from ogm.metrics.prediction import PREDICTION_METRICS, PredictionSums, accumulate_prediction, score_prediction
from ogm.metrics.scores import METRICS, Metric, by_range, distances, reasons, score

__all__ = [
    "BeamNoise", "BeamScores", "PlanarBeams", "ConfusionSums", "METRICS", "MOTION_METRICS", "Metric", "MotionSums",
    "PREDICTION_METRICS", "PredictionSums", "accumulate", "accumulate_motion", "accumulate_prediction", "by_range",
    "detection_times", "distances", "free_space", "intervals", "motion_curve", "precision_recall", "reasons",
    "reliability", "risk_coverage", "score", "score_beams", "score_motion", "score_prediction",
]  # fmt: skip
