"""What is counted of one grid against the truth, and the scores that follow from it.

Counts add up: the scores of one frame's counts are that frame's scores, and the scores of the sum of all frames'
counts are those of the pooled cells (micro averages).
"""

from operator import add
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ogm.metrics.divergence import CLIP, MIN_UNKNOWN, truth_means
from ogm.metrics.kernels import count_cells, table
from ogm.metrics.ranking import auroc_of_histograms

__all__ = ["METRICS", "Metric", "Tally", "called", "score", "tally"]

STRENGTHS = (1.0, 10.0)  # E, the evidence of the truth that divergences are taken for
BINS = 15  # of P(occupied), for the calibration error
SURE = 0.5  # a mass beyond this is a claim
LEVELS = 2**16  # bins of unknown, for the AUROC

_UNKNOWN, _FREE, _OCCUPIED, _IGNORE = 0, 1, 2, 3  # states of a cell, as in ogm.truth


class Metric(NamedTuple):
    """What a score means.

    Attributes
    ----------
    title : str
        For tables and pictures.
    better : {"lower", "higher", ""}
        Which of two is the better one; "" where neither is.
    says : str
    """

    title: str
    better: str
    says: str


METRICS: dict[str, Metric] = {
    "kl_e10": Metric("KL, E = 10", "lower", "mean KL[grid || truth], truth of evidence 10 [nats]"),
    "kl_e1": Metric("KL, E = 1", "lower", "mean KL[grid || truth], truth of evidence 1 [nats]"),
    "kl_e1_scaled": Metric(
        "KL, E = 1, e/10",
        "lower",
        "the same with a tenth of the grid's evidence: 10 means sure, as in kl_e10",
    ),
    "kl_e10_reverse": Metric(
        "reverse KL, E = 10", "lower", "mean KL[truth || grid], truth of evidence 10 [nats]"
    ),
    "kl_e1_reverse": Metric(
        "reverse KL, E = 1", "lower", "mean KL[truth || grid], truth of evidence 1 [nats]"
    ),
    "legacy_kl": Metric(
        "released code's KL", "lower", "the released code's categorical KL of clipped evidence [nats]"
    ),
    "iou_free": Metric(
        "IoU free", "higher", "IoU of free cells; a cell is what has most mass, unknown included"
    ),
    "iou_occupied": Metric("IoU occupied", "higher", "IoU of occupied cells, likewise"),
    "iou_unknown": Metric("IoU unknown", "higher", "IoU of unknown cells, likewise"),
    "iou_free_known": Metric(
        "IoU free, known", "higher", "IoU of free by P(occupied) < 1/2, on cells whose truth is known"
    ),
    "iou_occupied_known": Metric(
        "IoU occupied, known", "higher", "IoU of occupied by P(occupied) > 1/2, on known cells"
    ),
    "auroc_unknown": Metric(
        "AUROC unknown", "higher", "AUROC of the mass of unknown for cells whose truth is unknown"
    ),
    "ece": Metric("ECE", "lower", "expected calibration error of P(occupied) on known cells, 15 bins"),
    "ece_called": Metric(
        "ECE, called",
        "lower",
        "the same on those known cells that the grid does not call unknown",
    ),
    "ece_relative": Metric(
        "ECE, relative",
        "lower",
        "the same of occupied / (free + occupied), 1/2 where both are 0",
    ),
    "brier": Metric("Brier", "lower", "mean squared error of P(occupied) on known cells"),
    "brier_relative": Metric("Brier, relative", "lower", "the same of occupied / (free + occupied)"),
    "false_free": Metric("false free", "lower", "share of occupied cells with a mass of free above 1/2"),
    "missed_occupied": Metric(
        "missed occupied", "lower", "share of occupied cells without a mass of occupied above 1/2"
    ),
    "false_occupied": Metric(
        "false occupied", "lower", "share of free cells with a mass of occupied above 1/2"
    ),
    "mean_free": Metric("mean free", "", "mean mass of free"),
    "mean_occupied": Metric("mean occupied", "", "mean mass of occupied"),
    "mean_unknown": Metric("mean unknown", "", "mean mass of unknown"),
}


class Tally(NamedTuple):
    """Sums over cells; those that the truth ignores are in none of them. Add two with `plus`.

    Wherever an axis is called `truth` or `call`, it has the three states 0 unknown, 1 free, 2 occupied.

    Attributes
    ----------
    cells : (truth,)
        Number of cells.
    mass : (truth, 2)
        Sums of the masses of free and occupied.
    to_truth : (3, truth)
        Sums of KL[grid || truth] for a truth of evidence 1, of 10, and of 1 with a tenth of the grid's evidence.
    from_truth : (2, truth)
        Sums of KL[truth || grid] for a truth of evidence 1 and of 10.
    legacy : (truth,)
        Sums of `legacy_kl`.
    calls : (truth, call)
        Confusion of the calls by most mass, see `called`.
    likelier : (truth, call)
        Confusion of the calls by P(occupied) below, above 1/2; 0 where it is 1/2.
    claims : (truth, 2)
        Cells with a mass of free, of occupied, above 1/2.
    reliability : (3, 15, 3)
        For P(occupied) on all known cells, on those that are not called unknown, and for the relative P(occupied)
        on all known cells: in bins of it, cells, sum of P, cells that are occupied.
    squared : (2,)
        Sums of (P - occupied)**2 over known cells, of P(occupied) and of the relative one.
    doubt : (2, 65536)
        Histograms of unknown over [0, 1], of cells whose truth is known and unknown.
    """

    cells: NDArray[np.float64]
    mass: NDArray[np.float64]
    to_truth: NDArray[np.float64]
    from_truth: NDArray[np.float64]
    legacy: NDArray[np.float64]
    calls: NDArray[np.float64]
    likelier: NDArray[np.float64]
    claims: NDArray[np.float64]
    reliability: NDArray[np.float64]
    squared: NDArray[np.float64]
    doubt: NDArray[np.float64]

    def plus(self, other: Self) -> "Tally":
        """Return the counts of both."""
        return Tally(*map(add, self, other))


def called(mass: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Say what every cell is called: the state with the most mass, unknown being one of the three.

    A tie with unknown is unknown, a tie of free and occupied is occupied.

    Parameters
    ----------
    mass : (..., 2) float array
        Masses of free and occupied.

    Returns
    -------
    (...) uint8
        0 unknown, 1 free, 2 occupied.
    """
    free, occupied = mass[..., 0].astype(np.float64), mass[..., 1].astype(np.float64)
    rest = 1 - free - occupied
    is_free, is_occupied = (free > rest) & (free > occupied), (occupied > rest) & (occupied >= free)
    return is_free * np.uint8(_FREE) + is_occupied * np.uint8(_OCCUPIED)


def tally(mass: NDArray[np.floating], state: NDArray[np.uint8]) -> Tally:
    """Count everything that the scores need of one grid.

    Parameters
    ----------
    mass : (nx, ny, 2) float array
        Masses of free and occupied, as `EvidentialGrid.mass`.
    state : (nx, ny) uint8
        True states, as `Truth.state`: 0 unknown, 1 free, 2 occupied, 3 ignored.

    Returns
    -------
    Tally

    Raises
    ------
    ValueError
        If the shapes do not fit, a mass is NaN, or a state is none of the four.
    """
    _check(mass, state)
    truths, calls = 3, 3
    cells, masses, claims = np.zeros(truths), np.zeros((truths, 2)), np.zeros((truths, 2))
    confusion, likelier = np.zeros((truths, calls)), np.zeros((truths, calls))
    reliability, squared, doubt = np.zeros((3, BINS, 3)), np.zeros(2), np.zeros((2, LEVELS))
    scales = np.array([1.0, STRENGTHS[0] / STRENGTHS[1]])
    sums, logs = np.zeros((len(scales), 6, truths)), np.zeros((2, truths))
    count_cells(
        np.ascontiguousarray(mass.reshape(-1, 2)),
        np.ascontiguousarray(state.ravel()),
        scales,
        MIN_UNKNOWN,
        CLIP,
        SURE,
        table(),
        cells,
        masses,
        sums,
        logs,
        confusion,
        likelier,
        claims,
        reliability,
        squared,
        doubt,
    )
    full, weak = sums
    return Tally(
        cells=cells,
        mass=masses,
        to_truth=np.stack(
            [*(_to_truth(full, cells, e) for e in STRENGTHS), _to_truth(weak, cells, STRENGTHS[0])]
        ),
        from_truth=np.stack([_from_truth(full, cells, e) for e in STRENGTHS]),
        legacy=_legacy(logs, cells),
        calls=confusion,
        likelier=likelier,
        claims=claims,
        reliability=reliability,
        squared=squared,
        doubt=doubt,
    )


def score(counts: Tally) -> dict[str, float]:
    """Turn counts into the scores of `METRICS`, in their order; NaN where no cell speaks for one.

    See `METRICS` for what each means. The mean divergences are over all cells that are not ignored. A
    calibration error is the mean distance of P(occupied) from how often a bin's cells are occupied, weighted by
    cells. The AUROC takes two masses of unknown for equal that share a bin of 1/65535.

    P(occupied) = occupied + unknown / 2 comes no nearer to 0 and 1 than the evidence allows: to 1/12 for an
    evidence of 10, however sure the model is. Where evidence is bounded by convention, the relative one, occupied /
    (free + occupied), says what the model holds likely among known cells.
    """
    total, known = counts.cells.sum(), counts.cells[1:].sum()
    to_truth, from_truth = (_part(sums.sum(axis=-1), total) for sums in (counts.to_truth, counts.from_truth))
    free, occupied = _part(counts.mass.sum(axis=0), total)
    overlap = _overlap(counts.calls)
    likelier = _overlap(counts.likelier[1:])
    values = {
        "kl_e10": to_truth[1],
        "kl_e1": to_truth[0],
        "kl_e1_scaled": to_truth[2],
        "kl_e10_reverse": from_truth[1],
        "kl_e1_reverse": from_truth[0],
        "legacy_kl": _part(counts.legacy.sum(), total),
        "iou_free": overlap[_FREE],
        "iou_occupied": overlap[_OCCUPIED],
        "iou_unknown": overlap[_UNKNOWN],
        "iou_free_known": likelier[_FREE],
        "iou_occupied_known": likelier[_OCCUPIED],
        "auroc_unknown": auroc_of_histograms(counts.doubt[1], counts.doubt[0]),
        "ece": _calibration_error(counts.reliability[0]),
        "ece_called": _calibration_error(counts.reliability[1]),
        "ece_relative": _calibration_error(counts.reliability[2]),
        "brier": _part(counts.squared[0], known),
        "brier_relative": _part(counts.squared[1], known),
        "false_free": _part(counts.claims[_OCCUPIED, 0], counts.cells[_OCCUPIED]),
        "missed_occupied": 1 - _part(counts.claims[_OCCUPIED, 1], counts.cells[_OCCUPIED]),
        "false_occupied": _part(counts.claims[_FREE, 1], counts.cells[_FREE]),
        "mean_free": free,
        "mean_occupied": occupied,
        "mean_unknown": 1 - free - occupied,
    }
    return {name: float(values[name]) for name in METRICS}


def _check(mass: NDArray, state: NDArray) -> None:
    if mass.ndim < 2 or mass.shape[-1] != 2 or mass.shape[:-1] != state.shape:
        raise ValueError(
            f"mass must have shape (nx, ny, 2) and state (nx, ny) of the same cells, got {mass.shape} and "
            f"{state.shape}; crop the truth to the grid's spec"
        )
    if state.dtype != np.uint8 or (state.size and state.max() > _IGNORE):
        raise ValueError(
            f"state must be uint8 with 0 unknown, 1 free, 2 occupied, 3 ignore, got {state.dtype} up to "
            f"{state.max() if state.size else 'nothing'}"
        )
    if not np.isfinite(mass.sum()):
        raise ValueError("mass holds NaN or inf: a grid of masses has neither, see ogm.evidence.check_mass")


def _to_truth(sums: NDArray, cells: NDArray, strength: float) -> NDArray[np.float64]:
    """Return the sums of `kl_to_truth` for every truth."""
    spent, _, _, log_free, log_occupied, _ = sums
    mean_log = np.array([0.0, log_free[_FREE], log_occupied[_OCCUPIED]])
    known = np.array([0.0, 1.0, 1.0])
    return np.maximum(spent - known * (np.log1p(strength) * cells + strength * mean_log), 0.0)


def _from_truth(sums: NDArray, cells: NDArray, strength: float) -> NDArray[np.float64]:
    """Return the sums of `kl_from_truth` for every truth."""
    _, free, occupied, _, _, log_beta = sums
    sure, rest, offset = truth_means(strength)
    free_says, occupied_says = np.array([-1.0, sure, rest]), np.array([-1.0, rest, sure])
    offsets = np.array([0.0, offset, offset])
    return np.maximum(log_beta + offsets * cells - free * free_says - occupied * occupied_says, 0.0)


def _legacy(logs: NDArray, cells: NDArray) -> NDArray[np.float64]:
    """Return the sums of `legacy_kl` for every truth: it is linear in two logarithms."""
    weights = np.array([[CLIP, 1.0, CLIP], [CLIP, CLIP, 1.0]])
    faint = CLIP * np.log(CLIP) * np.array([2.0, 1.0, 1.0])
    return faint * cells - (weights * logs).sum(axis=0)


def _part(some: NDArray | float, whole: float) -> NDArray:
    return np.asarray(some, np.float64) / (whole if whole > 0 else np.nan)


def _overlap(confusion: NDArray) -> list[float]:
    """Return intersection over union of every call; `confusion` may lack truths that are not looked at."""
    skipped = 3 - len(confusion)
    full = np.concatenate([np.zeros((skipped, 3)), confusion])
    union = full.sum(axis=0) + full.sum(axis=1) - np.diag(full)
    return [float(_part(full[k, k], union[k])) for k in range(3)]


def _calibration_error(bins: NDArray) -> float:
    count, claimed, happened = bins.T
    return float(_part(np.abs(claimed - happened).sum(), count.sum()))
