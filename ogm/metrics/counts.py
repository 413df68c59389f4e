"""What is counted of one grid against the truth.

Counts add up: the scores of one frame's counts are that frame's scores, and the scores of the sum of all frames'
counts are those of the pooled cells (micro averages).
"""

from math import inf
from operator import add
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ogm.metrics.counting import count_cells, count_ranges, look_around
from ogm.metrics.divergence import MIN_UNKNOWN, truth_means
from ogm.metrics.kernels import CLIP, sum_divergences, table
from ogm.state import CellState

__all__ = ["BINS", "LEVELS", "RANGES", "ConfusionSums", "accumulate"]

STRENGTHS = (1.0, 10.0)  # E, the evidence of the truth that divergences are taken for
BINS = 15  # of P(occupied) and of Bel(occupied), for reliability
SURE = 0.5  # a mass beyond this is a claim
LEVELS = 4097  # of histograms: 0, 1/4096, ..., 1
RANGES = (0.0, 10.0, 20.0, 30.0, 40.0, inf)  # [m] edges of bins; a cell on an edge is in the farther
RANGE_LEVELS = 1025  # of those by range: 0, 1/1024, ..., 1
LEAST = MIN_UNKNOWN / 2  # floor of the probability of what is true: a wrong dogmatic cell costs 11.5 nats
ROUNDING = 1e-6  # how far a mass may lie outside [0, 1], as float32 makes it

_UNKNOWN, _FREE, _OCCUPIED, _IGNORE = (int(one) for one in CellState)


class ConfusionSums(NamedTuple):
    """Sums over cells; those that the truth ignores are in none of them. Add two with `plus`.

    Wherever an axis is called `truth` or `call`, it has the three states 0 unknown, 1 free, 2 occupied. A *known*
    cell is one whose truth is free or occupied. A histogram has 4097 levels, 0, 1/4096, ..., 1; a number counts
    at the nearest one. One tally takes 0.4 MB, most of it zeros.

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
    intervals : (15, 4)
        In bins of Bel(occupied) on known cells: cells, sums of Bel(occupied) and Pl(occupied), cells that are
        occupied.
    squared : (3,)
        Sums over known cells of (P - occupied)**2 for P(occupied) and for the relative one, and of the first's
        expectation under the grid's Beta density.
    surprise : (truth,)
        Sums of -ln P(true state) over known cells [nats], P being at least 1e-5.
    entropy : (truth,)
        Sums of Shannon's entropy of P(occupied) [bit].
    dissonance : (truth,)
        Sums of 2 min(free, occupied).
    doubt : (3, 4097)
        Histograms of unknown, of known cells, of cells whose truth is unknown, and of the known ones that are
        wrong by P(occupied); one of P = 1/2 is half wrong.
    likely : (3, 4097)
        Histograms of P(occupied), of free cells and of occupied ones, and the sum of P over both.
    close : (3, 4097)
        Histograms of P(occupied), of known cells with and without an occupied cell within one cell (their eight
        neighbours and themselves); and occupied cells by the largest P(occupied) within one cell that is not
        ignored.
    clear : (2, 4097)
        Histograms of Bel(free), of free cells and of occupied ones.
    obstacles : (2,)
        Groups of occupied cells that touch at a side or corner, and those of them without a cell of
        P(occupied) > 1/2 within one cell.
    range_calls : (ranges, truth, call), range_claims : (ranges, truth, 2), range_clear : (ranges, 2, 1025)
        The same as `calls`, `claims` and `clear`, by the bins of `RANGES`; zeros if no distances were given.
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
    intervals: NDArray[np.float64]
    squared: NDArray[np.float64]
    surprise: NDArray[np.float64]
    entropy: NDArray[np.float64]
    dissonance: NDArray[np.float64]
    doubt: NDArray[np.float64]
    likely: NDArray[np.float64]
    close: NDArray[np.float64]
    clear: NDArray[np.float64]
    obstacles: NDArray[np.float64]
    range_calls: NDArray[np.float64]
    range_claims: NDArray[np.float64]
    range_clear: NDArray[np.float64]

    def plus(self, other: Self) -> "ConfusionSums":
        """Return the counts of both."""
        return ConfusionSums(*map(add, self, other))


def accumulate(
    mass: NDArray[np.floating], state: NDArray[np.uint8], distance: NDArray[np.floating] | None = None
) -> ConfusionSums:
    """Count everything that the scores and the curves need of one grid.

    Parameters
    ----------
    mass : (nx, ny, 2) float array
        Masses of free and occupied, as `EvidentialGrid.mass`.
    state : (nx, ny) uint8
        True states, as `Truth.state`: 0 unknown, 1 free, 2 occupied, 3 ignored.
    distance : (nx, ny) float array, optional
        Distances of the cells from the sensor [m], see `distances`; without them nothing is counted by range.

    Returns
    -------
    Tally

    Raises
    ------
    ValueError
        If the shapes do not fit, something is no mass (NaN, below 0, a sum above 1), a state is none of the four,
        or a distance is negative or NaN.
    TypeError
        If the masses are not floating numbers.
    """
    _check(mass, state)
    truths, calls = 3, 3
    cells, masses, claims = np.zeros(truths), np.zeros((truths, 2)), np.zeros((truths, 2))
    confusion, likelier = np.zeros((truths, calls)), np.zeros((truths, calls))
    reliability, intervals, squared = np.zeros((3, BINS, 3)), np.zeros((BINS, 4)), np.zeros(3)
    surprise, entropy, dissonance = np.zeros((3, truths))
    doubt, likely, close = np.zeros((3, 3, LEVELS))
    clear, obstacles = np.zeros((2, LEVELS)), np.zeros(2)
    mass, state = np.ascontiguousarray(mass), np.ascontiguousarray(state)
    near = np.zeros(state.shape, np.uint8)
    look_around(mass, state, near, close[2], obstacles)
    flat, states = mass.reshape(-1, 2), state.ravel()
    count_cells(
        flat,
        states,
        near.ravel(),
        LEAST,
        SURE,
        cells,
        masses,
        confusion,
        likelier,
        claims,
        reliability,
        intervals,
        squared,
        surprise,
        entropy,
        dissonance,
        doubt,
        likely,
        close,
        clear,
    )
    scales = np.array([1.0, STRENGTHS[0] / STRENGTHS[1]])
    sums, logs = np.zeros((len(scales), 6, truths)), np.zeros((2, truths))
    sum_divergences(flat, states, scales, MIN_UNKNOWN, CLIP, table(), sums, logs)
    ranges = len(RANGES) - 1
    range_calls, range_claims = np.zeros((ranges, truths, calls)), np.zeros((ranges, truths, 2))
    range_clear = np.zeros((ranges, 2, RANGE_LEVELS))
    if distance is not None:
        _check_distance(distance, state)
        far = np.ascontiguousarray(distance.ravel())
        count_ranges(flat, states, far, np.array(RANGES), SURE, range_calls, range_claims, range_clear)
    full, weak = sums
    return ConfusionSums(
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
        intervals=intervals,
        squared=squared,
        surprise=surprise,
        entropy=entropy,
        dissonance=dissonance,
        doubt=doubt,
        likely=likely,
        close=close,
        clear=clear,
        obstacles=obstacles,
        range_calls=range_calls,
        range_claims=range_claims,
        range_clear=range_clear,
    )


def _check(mass: NDArray, state: NDArray) -> None:
    if mass.ndim != 3 or mass.shape[-1] != 2 or mass.shape[:-1] != state.shape:
        raise ValueError(
            f"mass must have shape (nx, ny, 2) and state (nx, ny) of the same cells, got {mass.shape} and "
            f"{state.shape}; crop the truth to the grid's spec"
        )
    if mass.dtype not in (np.float32, np.float64):
        raise TypeError(
            f"mass must be float32 or float64, got {mass.dtype}; convert it: mass.astype('float32')"
        )
    if state.dtype != np.uint8 or (state.size and state.max() > _IGNORE):
        raise ValueError(
            f"state must be uint8 with 0 unknown, 1 free, 2 occupied, 3 ignore, got {state.dtype} up to "
            f"{state.max() if state.size else 'nothing'}"
        )
    if not state.size:
        return
    least, most = float(mass.min()), float((mass[..., 0] + mass[..., 1]).max())
    if not np.isfinite(least + most):
        raise ValueError("mass holds NaN or inf: a grid of masses has neither, see ogm.evidence.check_mass")
    if least < -ROUNDING or most > 1 + ROUNDING:
        raise ValueError(
            f"masses are at least 0 and free + occupied at most 1, got {least:g} and {most:g}; evidence becomes "
            "masses by ogm.evidence.evidence_to_mass"
        )


def _check_distance(distance: NDArray, state: NDArray) -> None:
    if distance.shape != state.shape or distance.dtype.kind != "f":
        raise ValueError(
            f"distance must be a float array of the cells' shape {state.shape}, got {distance.dtype} "
            f"{distance.shape}; see ogm.metrics.distances"
        )
    if not distance.min(initial=0.0) >= 0:
        raise ValueError(f"distances [m] are at least 0, got {distance.min()}")


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
