"""How good a grid is: metrics of an evidential grid against the true states of its cells.

Every metric leaves out the cells that the truth ignores. A metric without a cell is NaN, never 0, and `reasons` gives
the reason. `METRICS` describes each.

>>> from ogm.metrics import accumulate, score
>>> scores = score(accumulate(grid.mass, truth.state))               # one frame           # doctest: +SKIP
>>> counts = accumulate(grid.mass, truth.state, distances(spec))     # curves and ranges   # doctest: +SKIP
>>> risk_coverage(counts), by_range(counts), reasons(counts)                          # doctest: +SKIP
"""

from ogm.metrics.counts import RANGES, ConfusionSums, accumulate
from ogm.metrics.curves import free_space, intervals, precision_recall, reliability, risk_coverage
from ogm.metrics.evilog import evilog_kl, evilog_published, evilog_unmixed
from ogm.metrics.ranges import by_range, distances
from ogm.metrics.scores import METRICS, Metric, reasons, score

__all__ = [
    "ConfusionSums", "METRICS", "Metric", "RANGES", "accumulate", "by_range", "distances", "evilog_kl",
    "evilog_published", "evilog_unmixed", "free_space", "intervals", "precision_recall", "reasons", "reliability",
    "risk_coverage", "score",
]  # fmt: skip
