"""How far a grid's Dirichlet densities are from those of the truth, fast enough for every cell of every frame.

The truth of a cell is one of three densities: Dir(1, 1) where it is unknown, Dir(1 + E, 1) where it is free and
Dir(1, 1 + E) where it is occupied, E being the strength that one grants the truth. With ``e`` the evidence of the
grid, ``alpha = 1 + e``, ``S`` their sum and ``t = digamma(alpha) - digamma(S)``, the expectation of ln p,

    KL[Dir(alpha) || truth]  =  sum e t - ln B(alpha) - (ln(1 + E) + E t_true)
    KL[truth || Dir(alpha)]  =  ln B(alpha) - sum e t' + (ln(1 + E) + E t'_true)

with t' the same expectation under the truth; what stands in parentheses is absent where the truth is unknown. So
one look at the special functions per cell (`density`) serves every E and both directions, and sums over cells
need no value per cell. The slow twin is `ogm.evidence.dirichlet_kl`.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.metrics.kernels import densities, table

__all__ = ["MIN_UNKNOWN", "Density", "density", "kl_from_truth", "kl_to_truth"]

MIN_UNKNOWN = 2e-5  # floor of unknown: evidence ends at 1e5, the most that float32 masses can tell

_UNKNOWN, _FREE, _OCCUPIED = 0, 1, 2  # states of a cell, as in ogm.truth


class Density(NamedTuple):
    """What the divergences need to know of every cell's Dirichlet density. All float64, of the cells' shape.

    Attributes
    ----------
    free, occupied : (...)
        Evidence, at least 0.
    log_free, log_occupied : (...)
        Expectations of ln p: digamma(1 + evidence) - digamma(2 + both), at most 0.
    log_beta : (...)
        ln B(1 + free, 1 + occupied), at most 0.
    """

    free: NDArray[np.float64]
    occupied: NDArray[np.float64]
    log_free: NDArray[np.float64]
    log_occupied: NDArray[np.float64]
    log_beta: NDArray[np.float64]


def density(mass: NDArray[np.floating], *, scale: float = 1.0, min_unknown: float = MIN_UNKNOWN) -> Density:
    """Turn masses into Dirichlet densities.

    Parameters
    ----------
    mass : (..., 2) float array
        Masses of free and occupied; they are not checked again.
    scale : float
        Evidence is multiplied by it, in (0, 1].
    min_unknown : float
        Floor of the mass of unknown, at least 2e-5: a dogmatic cell (unknown = 0) would have infinite evidence
        and infinite divergence from every truth. The default lets evidence end at 1e5; such a cell then costs
        about 8 nats where it is right and 120 where it is wrong, towards a truth of evidence 10.

    Returns
    -------
    Density
    """
    if not 0 < scale <= 1:
        raise ValueError(f"scale must be in (0, 1], got {scale}")
    if not MIN_UNKNOWN <= min_unknown < 1:
        raise ValueError(f"min_unknown must be in [{MIN_UNKNOWN}, 1), got {min_unknown}")
    shape = mass.shape[:-1]
    cells = np.empty((5, math.prod(shape)))
    densities(np.ascontiguousarray(mass.reshape(-1, 2)), float(scale), float(min_unknown), table(), cells)
    return Density(*cells.reshape(5, *shape))


def kl_to_truth(cells: Density, state: NDArray[np.uint8], strength: float) -> NDArray[np.float64]:
    """Return KL[grid || truth] of every cell in nats: the paper's direction, prediction first.

    A missed cell costs E - ln(1 + E), a false claim of evidence e on an unknown one ln(1 + e) - e / (1 + e).

    Parameters
    ----------
    cells : Density
        Of the grid, see `density`.
    state : (...) uint8
        True states: 0 unknown, 1 free, 2 occupied, 3 ignored.
    strength : float
        E > 0, the evidence of the truth for a cell that it knows. The measure depends much on it, and punishes
        what is surer than the truth as well: with E = 1, a cell that is right with evidence 10 costs 0.89, one
        that says nothing 0.31.

    Returns
    -------
    (...), at least 0; NaN where the truth is ignored
    """
    _check_strength(strength)
    spent, base = _excess(cells), np.log1p(strength)
    free, occupied = (spent - base - strength * log for log in (cells.log_free, cells.log_occupied))
    return np.maximum(_pick(state, spent, free, occupied), 0.0)


def kl_from_truth(cells: Density, state: NDArray[np.uint8], strength: float) -> NDArray[np.float64]:
    """Return KL[truth || grid] of every cell in nats: the other direction, see `kl_to_truth`.

    It grows linearly with evidence that is not in the truth: a confident model pays for every cell that the
    truth leaves unknown.
    """
    sure, rest, offset = truth_means(strength)
    free, occupied, beta = cells.free, cells.occupied, cells.log_beta
    return np.maximum(
        _pick(
            state,
            beta + free + occupied,
            beta + offset - free * sure - occupied * rest,
            beta + offset - free * rest - occupied * sure,
        ),
        0.0,
    )


def _excess(cells: Density) -> NDArray[np.float64]:
    """Return KL[grid || Dir(1, 1)] of every cell: what its claims cost before they are found true."""
    return cells.free * cells.log_free + cells.occupied * cells.log_occupied - cells.log_beta


def truth_means(strength: float) -> tuple[float, float, float]:
    """Return the expectations of ln p under Dir(1 + E, 1), for the true state and the other, and -ln B + E t'."""
    from scipy.special import digamma  # here, as it would double the time that the import takes

    _check_strength(strength)
    one, alpha, total = (float(digamma(x)) for x in (1.0, 1.0 + strength, 2.0 + strength))
    return alpha - total, one - total, float(np.log1p(strength) + strength * (alpha - total))


def _pick(state: NDArray, unknown: NDArray, free: NDArray, occupied: NDArray) -> NDArray[np.float64]:
    known = np.where(state == _FREE, free, np.where(state == _OCCUPIED, occupied, np.nan))
    return np.where(state == _UNKNOWN, unknown, known)


def _check_strength(strength: float) -> None:
    if not 0 < strength <= 1e5:
        raise ValueError(f"strength is the evidence of the truth, above 0 and at most 1e5, got {strength}")
