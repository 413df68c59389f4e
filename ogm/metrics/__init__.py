"""How good a grid is: metrics of an evidential grid against the true states of its cells, paired over frames.

Every metric leaves out the cells that the truth ignores. A metric without a cell to look at is NaN, never 0.

>>> from ogm.metrics import score, tally
>>> scores = score(tally(grid.mass, truth.state))               # one frame           # doctest: +SKIP
>>> result = evaluate({"ray": ray, "deep": deep}, samples)      # many, paired        # doctest: +SKIP
"""

from ogm.evidence import dirichlet_kl
from ogm.metrics.counts import METRICS, Metric, Tally, called, score, tally
from ogm.metrics.divergence import (
    MIN_UNKNOWN,
    Density,
    density,
    kl_from_truth,
    kl_to_truth,
    legacy_kl,
)
from ogm.metrics.evaluation import Evaluation, ModelFor, evaluate, model_for, same_cells
from ogm.metrics.paired import Interval, Paired, bootstrap_mean, bootstrap_ratio, paired
from ogm.metrics.ranking import auroc, auroc_of_histograms

__all__ = [
    "METRICS",
    "MIN_UNKNOWN",
    "Density",
    "Evaluation",
    "Interval",
    "Metric",
    "ModelFor",
    "Paired",
    "Tally",
    "auroc",
    "auroc_of_histograms",
    "bootstrap_mean",
    "bootstrap_ratio",
    "called",
    "density",
    "dirichlet_kl",
    "evaluate",
    "kl_from_truth",
    "kl_to_truth",
    "legacy_kl",
    "model_for",
    "paired",
    "same_cells",
    "score",
    "tally",
]
