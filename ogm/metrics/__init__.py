"""How good a grid is: metrics of an evidential grid against the true states of its cells.

Every metric leaves out the cells that the truth ignores. A metric without a cell to look at is NaN, never 0, and
`reasons` says why. `METRICS` says what each is.

>>> from ogm.metrics import accumulate, score
>>> scores = score(accumulate(grid.mass, truth.state))               # one frame           # doctest: +SKIP
>>> counts = accumulate(grid.mass, truth.state, distances(spec))     # curves and ranges   # doctest: +SKIP
>>> risk_coverage(counts), by_range(counts), reasons(counts)                          # doctest: +SKIP
"""

from ogm.evidence import dirichlet_kl
from ogm.metrics.counts import RANGES, ConfusionSums, accumulate
from ogm.metrics.curves import (
    FreeSpace,
    Intervals,
    PrecisionRecall,
    Reliability,
    RiskCoverage,
    free_space,
    intervals,
    precision_recall,
    reliability,
    risk_coverage,
)
from ogm.metrics.divergence import MIN_UNKNOWN, Density, density, kl_from_truth, kl_to_truth
from ogm.metrics.legacy import Published, legacy_accuracy, legacy_kl, legacy_published, legacy_unmixed
from ogm.metrics.ranges import by_range, distances
from ogm.metrics.ranking import auroc, auroc_of_histograms, average_precision
from ogm.metrics.scores import METRICS, Metric, reasons, score

__all__ = [
    "METRICS",
    "MIN_UNKNOWN",
    "RANGES",
    "Density",
    "FreeSpace",
    "Intervals",
    "Metric",
    "PrecisionRecall",
    "Published",
    "Reliability",
    "RiskCoverage",
    "ConfusionSums",
    "auroc",
    "auroc_of_histograms",
    "average_precision",
    "by_range",
    "density",
    "dirichlet_kl",
    "distances",
    "free_space",
    "intervals",
    "kl_from_truth",
    "kl_to_truth",
    "legacy_accuracy",
    "legacy_kl",
    "legacy_published",
    "legacy_unmixed",
    "precision_recall",
    "reasons",
    "reliability",
    "risk_coverage",
    "score",
    "accumulate",
]
