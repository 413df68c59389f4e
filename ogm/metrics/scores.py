"""Scores computed from counts, also by distance, with descriptions and reasons for missing scores."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.grid import GridSpec
from ogm.metrics import areas
from ogm.metrics.areas import auroc, average_precision, false_positive_rate, free_recall, overlaps, parts
from ogm.metrics.counts import HEIGHTS, ConfusionSums
from ogm.state import CellState

FALSE_FREE = {"free_recall_1": 0.01, "free_recall_01": 0.001}  # bounds of false free

_UNKNOWN, _FREE, _OCCUPIED = CellState.UNKNOWN, CellState.FREE, CellState.OCCUPIED


class Metric(NamedTuple):
    """Description of a score.

    Attributes
    ----------
    title : str
        Title for tables and pictures.
    better : {"lower", "higher", ""}
        Direction of better values; "" if there is none.
    description : str
        Definition in a line.
    """

    title: str
    better: str
    description: str


_TABLE = """\
nll | NLL | lower | mean -ln P(true state) on known cells, with P of at least 1e-5 [nats]; 0.69 for a vacuous grid
brier | Brier | lower | mean squared error of P(occupied) on known cells
iou_free | IoU free | higher | IoU of free cells; the prediction is the state of greatest mass, including unknown
iou_occupied | IoU occupied | higher | IoU of occupied cells, likewise
iou_unknown | IoU unknown | higher | IoU of unknown cells, likewise
false_free | false free | lower | share of occupied cells with a mass of free above 1/2
missed_occupied | missed occupied | lower | share of occupied cells without a mass of occupied above 1/2
false_occupied | false occupied | lower | share of free cells with a mass of occupied above 1/2
missed_obstacles | missed obstacles | lower | share of groups of touching occupied cells without P(occupied) > \
1/2 within one cell
from10_iou_free | IoU free, from 0.10 m | higher | IoU free, without occupied cells with obstacles lower than 0.10 m, \
such as low kerbs
from10_iou_occupied | IoU occupied, from 0.10 m | higher | likewise
from10_false_free | false free, from 0.10 m | lower | likewise
from10_missed_occupied | missed occupied, from 0.10 m | lower | likewise
from50_iou_free | IoU free, from 0.50 m | higher | likewise; also without kerbs, low walls and plants
from50_iou_occupied | IoU occupied, from 0.50 m | higher | likewise
from50_false_free | false free, from 0.50 m | lower | likewise
from50_missed_occupied | missed occupied, from 0.50 m | lower | likewise
free_recall_1 | free recall at 1 % | higher | share of free cells above the least threshold of Bel(free) that at most \
1 % of occupied cells exceed
free_recall_01 | free recall at 0.1 % | higher | free recall with at most 0.1 % of occupied cells
ap_occupied_near | AP occupied, 1 cell | higher | average precision of P(occupied) on known cells, with a tolerance \
of one cell
ap_occupied | AP occupied | higher | average precision of P(occupied) on known cells
ece | ECE | lower | expected calibration error of P(occupied) on known cells, 15 bins
ece_relative | ECE, relative | lower | ECE of occupied / (free + occupied), 1/2 if both are 0
ece_called | ECE, predicted known | lower | ECE on known cells predicted free or occupied
ace | ACE | lower | calibration error of P(occupied) on known cells, 15 bins of equal weight
interval_violation | outside [Bel, Pl] | lower | distance of the share of occupied cells outside [Bel, Pl], mean \
over 15 bins of Bel(occupied)
auroc_unknown | AUROC unknown | higher | AUROC of the mass of unknown for truly unknown cells
aupr_unknown | AUPR unknown | higher | average precision of the mass of unknown for truly unknown cells
aupr_known | AUPR known | higher | average precision of a low mass of unknown for known cells
fpr95_unknown | FPR at 95 % | lower | share of known cells at or above the threshold of unknown that finds 95 % of \
truly unknown cells
aurc | AURC | lower | mean risk over coverage: share of wrong P(occupied) among known cells in order of unknown
ause | AUSE | lower | AURC minus its least value, of cells sorted by error
brier_relative | Brier, relative | lower | squared error of occupied / (free + occupied)
brier_expected | Brier, expected | lower | mean squared error of p drawn from the grid's Beta density, known cells
map_score | MapScore | higher | mean 1 + log2 P(true state) on known cells [bit]; 1 is best, 0 for a vacuous grid
conflict | conflict | lower | mean mass on the wrong state, known cells
conflict_free | conflict free | lower | mean mass of free on occupied cells
conflict_occupied | conflict occupied | lower | mean mass of occupied on free cells
iou_free_known | IoU free, known | higher | IoU of free by P(occupied) < 1/2, on known cells
iou_occupied_known | IoU occupied, known | higher | IoU of occupied by P(occupied) > 1/2, on known cells
entropy | entropy |  | mean Shannon entropy of P(occupied) [bit]
dissonance | dissonance |  | mean 2 min(free, occupied)
mean_free | mean free |  | mean mass of free
mean_occupied | mean occupied |  | mean mass of occupied
mean_unknown | mean unknown |  | mean mass of unknown
kl_e10 | KL, E = 10 | lower | mean KL[grid || truth], truth of evidence 10 [nats]; the loss of `lite` (reverse KL); no \
proper score: a correct cell with evidence above 10 is penalised
kl_e1 | KL, E = 1 | lower | mean KL[grid || truth], truth of evidence 1 [nats]; penalises correct cells above evidence 1
kl_e1_scaled | KL, E = 1, e/10 | lower | kl_e1 with a tenth of the grid's evidence: 10 is certain, as in kl_e10
kl_e10_reverse | reverse KL, E = 10 | lower | mean KL[truth || grid], truth of evidence 10 [nats]
kl_e1_reverse | reverse KL, E = 1 | lower | mean KL[truth || grid], truth of evidence 1 [nats]
legacy_kl | released code's KL | lower | categorical KL of clipped evidence, as in the EviLOG code [nats]
legacy_accuracy | released code's accuracy |  | share of cells predicted unknown, the accuracy of the EviLOG code
"""  # name | title | better | description
# By name: title, direction of better values, description
METRICS = {name: Metric(*rest) for name, *rest in (row.split(" | ") for row in _TABLE.splitlines())}

_NEEDS = {
    "unknown": "iou_unknown auroc_unknown aupr_unknown aupr_known fpr95_unknown",
    "free": "iou_free from10_iou_free from50_iou_free iou_free_known false_occupied conflict_occupied free_recall_1 "
    "free_recall_01 ap_occupied ap_occupied_near",
    "occupied": "iou_occupied iou_occupied_known false_free missed_occupied missed_obstacles conflict_free "
    "free_recall_1 free_recall_01 ap_occupied ap_occupied_near",
    "known": "auroc_unknown aupr_unknown aupr_known fpr95_unknown brier nll aurc ause ece ece_relative ece_called ace "
    "interval_violation brier_relative brier_expected conflict map_score",
}  # metrics by the kind of true cells that they need; all metrics need cells that are not ignored


def score(counts: ConfusionSums) -> dict[str, float]:
    """Return the scores of `METRICS`, in their order; NaN for scores without cells.

    See `METRICS` for definitions and `reasons` for the reasons of NaN. Unless stated otherwise, means are over all
    cells that are not ignored. *Known* cells are truly free or occupied.

    Notes
    -----
    Calibration
        ECE is the mean distance of P(occupied) from the share of occupied cells in its bin, weighted by cells. Evidence
        limits P(occupied) = occupied + unknown / 2: an evidence of 10 gives at least 1/12, even for a certain model.
        For evidence bounded by convention, the relative probability occupied / (free + occupied) is the model's
        probability among known cells. ACE spreads cells in one of the 4097 levels of P evenly over their bins.
    Ranking
        AUROC, AUPR and average precision treat numbers in one of 4097 levels as ties.
    Selection
        In AURC and AUSE, the error of a cell is 1 if P(occupied) is on the wrong side of 1/2, 1/2 at P = 1/2, else 0.
        (Squared errors would favour unknown by definition, as it moves P towards 1/2.)
    Bounded risk
        The threshold of free_recall is chosen on the evaluated cells: with fewer than 1000 occupied cells, at most
        0.1 % means no cell. The pooled (micro) value has one threshold for all frames.
    Second order
        The expected Brier score is (P - occupied)**2 + P (1 - P) / (S + 1) with S the Dirichlet strength. It is
        least at infinite evidence, so it is not a proper score of evidence (Bengs et al. 2023) and not in the headline.
    MapScore
        Martin and Moravec (1996): sum over cells of 1 + log2(P_a P_b + (1 - P_a)(1 - P_b)); here with the truth
        as b, 0 or 1 on known cells (others add 0), and P(true state) of at least 1e-5. It is 1 - nll / ln 2.
    """
    total, known = counts.cells.sum(), counts.cells[1:].sum()
    to_truth, from_truth = (parts(sums.sum(axis=-1), total) for sums in (counts.to_truth, counts.from_truth))
    free, occupied = parts(counts.mass.sum(axis=0), total)
    overlap = areas.overlaps(counts.confusion)
    known_only = np.concatenate([np.zeros((1, 3)), counts.confusion_by_probability[1:]])
    overlap_known = areas.overlaps(known_only)
    of_known, of_unknown, _ = counts.unknown_hist
    aurc, ause = areas.risk_areas(counts)
    squared, nll = parts(counts.squared_error, known), float(parts(counts.log_loss.sum(), known))
    wrong_free, wrong_occupied = counts.mass[_OCCUPIED, 0], counts.mass[_FREE, 1]
    ece, ece_known, ece_relative = (_calibration_error(bins) for bins in counts.reliability)
    values = {
        "kl_e10": to_truth[1],
        "kl_e1": to_truth[0],
        "kl_e1_scaled": to_truth[2],
        "iou_free": overlap[_FREE],
        "iou_occupied": overlap[_OCCUPIED],
        "iou_unknown": overlap[_UNKNOWN],
        "brier": squared[0],
        "nll": nll,
        "false_free": parts(counts.detections[_OCCUPIED, 0], counts.cells[_OCCUPIED]),
        "missed_occupied": 1 - parts(counts.detections[_OCCUPIED, 1], counts.cells[_OCCUPIED]),
        "false_occupied": parts(counts.detections[_FREE, 1], counts.cells[_FREE]),
        "missed_obstacles": parts(counts.obstacles[1], counts.obstacles[0]),
        **_without_low(counts),
        **{name: areas.free_recall(counts.bel_free_hist, bound) for name, bound in FALSE_FREE.items()},
        "ap_occupied_near": areas.average_precision_of(counts, 1),
        "ap_occupied": areas.average_precision_of(counts, 0),
        "auroc_unknown": auroc(of_unknown, of_known),
        "aupr_unknown": average_precision(of_unknown, of_known),
        "aupr_known": average_precision(of_known[::-1], of_unknown[::-1]),
        "fpr95_unknown": false_positive_rate(of_unknown, of_known),
        "aurc": aurc,
        "ause": ause,
        "ece": ece,
        "ece_relative": ece_relative,
        "ece_called": ece_known,
        "ace": areas.equal_mass_error(counts),
        "interval_violation": areas.interval_violation(counts),
        "brier_relative": squared[1],
        "brier_expected": squared[2],
        "conflict": parts(wrong_free + wrong_occupied, known),
        "conflict_free": parts(wrong_free, counts.cells[_OCCUPIED]),
        "conflict_occupied": parts(wrong_occupied, counts.cells[_FREE]),
        "iou_free_known": overlap_known[_FREE],
        "iou_occupied_known": overlap_known[_OCCUPIED],
        "map_score": 1 - nll / np.log(2),
        "entropy": parts(counts.entropy.sum(), total),
        "dissonance": parts(counts.dissonance.sum(), total),
        "mean_free": free,
        "mean_occupied": occupied,
        "mean_unknown": 1 - free - occupied,
        "kl_e10_reverse": from_truth[1],
        "kl_e1_reverse": from_truth[0],
        "legacy_kl": parts(counts.evilog_kl.sum(), total),
        "legacy_accuracy": parts(counts.confusion[:, _UNKNOWN].sum(), total),
    }
    return {name: float(values[name]) for name in METRICS}


def reasons(counts: ConfusionSums) -> dict[str, str]:
    """Return the reason for each score that is NaN."""
    cells = [*counts.cells, counts.cells[1:].sum()]
    result = {}
    for name, value in score(counts).items():
        if not np.isnan(value):
            continue
        missing = [
            kind for (kind, needing), n in zip(_NEEDS.items(), cells, strict=True) if not n and name in needing.split()
        ]
        if counts.cells.sum() == 0:
            result[name] = "the truth ignores every cell"
        elif missing:
            result[name] = f"the truth has no {' and no '.join(missing)} cell"
        elif name.startswith("from"):
            result[name] = "the truth has no obstacle of this height, or no heights"
        else:
            result[name] = "the grid predicts every known cell as unknown"  # ece_called
    return result


def _without_low(counts: ConfusionSums) -> dict[str, float]:
    """Return the scores without occupied cells lower than each of `HEIGHTS`."""
    found: dict[str, float] = {}
    for height, predicted, detected in zip(HEIGHTS, counts.high_confusion, counts.high_detections, strict=True):
        cells, name = predicted.sum(), f"from{100 * height:.0f}"
        overlap = areas.overlaps(np.vstack([counts.confusion[:_OCCUPIED], predicted]))
        found |= {
            f"{name}_iou_free": overlap[_FREE] if cells else np.nan,
            f"{name}_iou_occupied": overlap[_OCCUPIED],
            f"{name}_false_free": float(parts(detected[0], cells)),
            f"{name}_missed_occupied": float(1 - parts(detected[1], cells)),
        }
    return found


def _calibration_error(bins: NDArray[Any]) -> float:
    count, predicted, observed = bins.T
    return float(parts(np.abs(predicted - observed).sum(), count.sum()))


def distances(spec: GridSpec) -> NDArray[np.float32]:
    """Return the distances of cell centres from the origin of the grid's frame, which is the sensor.

    Parameters
    ----------
    spec : GridSpec

    Returns
    -------
    (nx, ny) float32
        Horizontal distance [m].
    """
    x, y = spec.cell_centers
    return np.asarray(np.hypot(x, y).astype(np.float32))


def by_range(counts: ConfusionSums) -> dict[str, NDArray[np.float64]]:
    """Return scores by distance, a number per bin of `RANGES`.

    Parameters
    ----------
    counts : ConfusionSums
        Counts with distances.

    Returns
    -------
    dict of str to (ranges,) float64
        ``cells``, ``free_cells`` and ``occupied_cells`` (not ignored, truly free, truly occupied), and the metrics
        ``false_free``, ``missed_occupied``, ``false_occupied``, ``iou_free``, ``iou_occupied``, ``iou_unknown``,
        ``free_recall_1`` and ``free_recall_01`` (with a separate threshold of 1025 levels in each bin); NaN in bins
        without cells.
    """
    confusion, detections = counts.range_confusion, counts.range_detections
    cells = confusion.sum(axis=-1)
    overlap = np.array([overlaps(matrix) for matrix in confusion])
    return {
        "cells": cells.sum(axis=-1),
        "free_cells": cells[:, CellState.FREE],
        "occupied_cells": cells[:, CellState.OCCUPIED],
        "false_free": parts(detections[:, CellState.OCCUPIED, 0], cells[:, CellState.OCCUPIED]),
        "missed_occupied": 1 - parts(detections[:, CellState.OCCUPIED, 1], cells[:, CellState.OCCUPIED]),
        "false_occupied": parts(detections[:, CellState.FREE, 1], cells[:, CellState.FREE]),
        "iou_free": overlap[:, CellState.FREE],
        "iou_occupied": overlap[:, CellState.OCCUPIED],
        "iou_unknown": overlap[:, CellState.UNKNOWN],
        "free_recall_1": np.array([free_recall(hist, 0.01) for hist in counts.range_bel_free_hist]),
        "free_recall_01": np.array([free_recall(hist, 0.001) for hist in counts.range_bel_free_hist]),
    }
