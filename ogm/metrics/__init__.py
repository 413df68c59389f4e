"""Metrics of evidential grids against true states of cells, and of dynamic grids against true motion.

All metrics leave out ignored cells of the truth. A metric without cells is NaN, never 0; `reasons` gives the reason.
`METRICS` describes all metrics.

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
