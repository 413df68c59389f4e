"""Evaluation of sensor models and maps against the truth, frame by frame, with a report.

>>> from ogm.datasets import open_dataset
>>> from ogm.evaluation import evaluate, write_report
>>> methods = {"mine": my_model, "ray": "ray", "lite": "lite"}           # any callable with .spec  # doctest: +SKIP
>>> result = evaluate(methods, open_dataset("data/"), out="report")                                 # doctest: +SKIP
>>> write_report("report", result)                                                                  # doctest: +SKIP
"""

from ogm.evaluation.agreement import AGREEMENT_METRICS, AgreementEvaluation, evaluate_agreement, write_agreement_report
from ogm.evaluation.beams import BEAM_METRICS, BeamEvaluation, FusedMap, evaluate_beams, named_maps, write_beam_report
from ogm.evaluation.methods import FusedMethod, MethodRunner, PrecomputedGrids, SingleScanMethod
from ogm.evaluation.report import evaluation_record, write_report
from ogm.evaluation.result import Evaluation, FrameInfo
from ogm.evaluation.runner import evaluate
from ogm.evaluation.statistics import Comparison, Interval, compare_paired, mean_interval, ratio_interval

__all__ = [
    "AGREEMENT_METRICS", "BEAM_METRICS", "AgreementEvaluation", "BeamEvaluation", "Comparison", "Evaluation",
    "FrameInfo", "FusedMap", "FusedMethod", "Interval", "MethodRunner", "PrecomputedGrids", "SingleScanMethod",
    "compare_paired", "evaluate", "evaluate_agreement", "evaluate_beams", "evaluation_record", "mean_interval",
    "named_maps", "ratio_interval", "write_agreement_report", "write_beam_report", "write_report",
]  # fmt: skip
