"""Sums of Dirichlet divergences over the cells of a grid, from a table of ln Gamma and digamma.

The truth of a cell is one of three densities: Dir(1, 1) for unknown, Dir(1 + E, 1) for free and Dir(1, 1 + E) for
occupied, with E the assumed evidence of the truth. With ``e`` the evidence of the grid, ``alpha = 1 + e``, ``S`` their
sum and ``t = digamma(alpha) - digamma(S)``, the expectation of ln p,

    KL[Dir(alpha) || truth]  =  sum e t - ln B(alpha) - (ln(1 + E) + E t_true)
    KL[truth || Dir(alpha)]  =  ln B(alpha) - sum e t' + (ln(1 + E) + E t'_true)

with t' the expectation of ln p under the truth; without the parentheses if the truth is unknown. A single lookup of the
special functions per cell thus gives every E and both directions, and sums over cells need no value per cell. The
definition, and the reference of the tests, is `ogm.evidence.dirichlet_kl`.
"""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.extras import import_extra
from ogm.jit import inline, vector
from ogm.state import CellState

MIN_UNKNOWN = 2e-5  # least mass of unknown: evidence up to 1e5, the limit of the resolution of float32 masses
MIN_EVIDENCE = 1e-7  # Keras' epsilon: least evidence in the divergence of the EviLOG code

_BITS = 7  # of the mantissa: 2**7 entries of the table per octave
_OCTAVES = 18  # from 1 to 2.6e5, above the largest alpha
_BLOCK = 256  # cells processed together, for vector instructions
_OCCUPIED = int(CellState.OCCUPIED)  # the last state that is not ignored


class DivergenceSums(NamedTuple):
    """Sums over the cells of each true state (unknown, free, occupied), for several scales of the evidence.

    Attributes
    ----------
    uniform_kl : (scales, 3)
        KL[grid || Dir(1, 1)].
    free, occupied : (scales, 3)
        Evidence.
    log_free, log_occupied : (scales, 3)
        Expectations of ln p: digamma(1 + evidence) - digamma(2 + both).
    log_beta : (scales, 3)
        ln B(1 + free, 1 + occupied).
    clipped_log_free, clipped_log_occupied : (3,)
        ln of the unscaled evidence, clipped to [1e-7, 1].
    """

    uniform_kl: NDArray[np.float64]
    free: NDArray[np.float64]
    occupied: NDArray[np.float64]
    log_free: NDArray[np.float64]
    log_occupied: NDArray[np.float64]
    log_beta: NDArray[np.float64]
    clipped_log_free: NDArray[np.float64]
    clipped_log_occupied: NDArray[np.float64]


def sum_divergences(
    mass: NDArray[np.floating], state: NDArray[np.uint8], scales: NDArray[np.float64]
) -> DivergenceSums:
    """Return sums for the divergences of all cells.

    Parameters
    ----------
    mass : (N, 2) float array
        Masses of free and occupied; unknown is taken as at least 2e-5.
    state : (N,) uint8
        True states; ignored cells are left out.
    scales : (scales,) float64
        Factors of the evidence, in (0, 1].
    """
    sums = DivergenceSums(*np.zeros((6, len(scales), 3)), *np.zeros((2, 3)))
    _sum_divergences(mass, state, scales, _table(), sums)
    return sums


def to_truth(sums: DivergenceSums, scale: int, cells: NDArray[Any], strength: float) -> NDArray[np.float64]:
    """Return sums of KL[grid || truth] [nats] for each true state, (3,): the paper's direction, prediction first.

    A missed cell costs E - ln(1 + E), a false detection with evidence e in an unknown cell ln(1 + e) - e / (1 + e). The
    measure strongly depends on E and penalises evidence above E: with E = 1, a correct cell with evidence 10 costs
    0.89, a vacuous cell 0.31.

    Parameters
    ----------
    sums : DivergenceSums
    scale : int
        Index of the scale.
    cells : (3,)
        Number of cells of each true state.
    strength : float
        E, the evidence of the truth in known cells.
    """
    log_true = np.array([0.0, sums.log_free[scale, CellState.FREE], sums.log_occupied[scale, CellState.OCCUPIED]])
    known = np.array([0.0, 1.0, 1.0])
    divergence: NDArray[np.float64] = np.maximum(
        sums.uniform_kl[scale] - known * (np.log1p(strength) * cells + strength * log_true), 0.0
    )
    return divergence


def from_truth(sums: DivergenceSums, scale: int, cells: NDArray[Any], strength: float) -> NDArray[np.float64]:
    """Return sums of KL[truth || grid] [nats] for each true state, (3,): the other direction, see `to_truth`.

    It grows linearly with evidence that is not in the truth: a confident model is penalised in every truly unknown
    cell.
    """
    digamma = import_extra("scipy.special", "evaluate").digamma  # here, as it would double the import time

    # Expectations of ln p under Dir(1 + E, 1), for the true state and the other.
    one, alpha, total = (float(digamma(x)) for x in (1.0, 1.0 + strength, 2.0 + strength))
    sure, rest = alpha - total, one - total
    offset = float(np.log1p(strength) + strength * sure)
    log_free, log_occupied = np.array([-1.0, sure, rest]), np.array([-1.0, rest, sure])
    divergence: NDArray[np.float64] = np.maximum(
        sums.log_beta[scale]
        + np.array([0.0, offset, offset]) * cells
        - sums.free[scale] * log_free
        - sums.occupied[scale] * log_occupied,
        0.0,
    )
    return divergence


@lru_cache(maxsize=1)
def _table() -> NDArray[np.float64]:
    """Return positions x with Taylor coefficients of ln Gamma up to the fifth, (positions, 8); the last is unused."""
    special = import_extra("scipy.special", "evaluate")  # here, as it would double the import time

    within = 1 + (np.arange(1 << _BITS) + 0.5) / (1 << _BITS)
    x = (2.0 ** np.arange(_OCTAVES)[:, None] * within).ravel()
    slopes = (special.polygamma(n, x) / math.factorial(n + 1) for n in range(5))
    return np.stack([x, special.gammaln(x), *slopes, np.zeros_like(x)], axis=-1)


@inline
def _look_up(x: float, bits: int, places: Any) -> Any:
    """Return ln Gamma(x) and digamma(x) for 1 <= x < 2**18, to 1e-11 (1 + value) and 1e-11.

    Taylor polynomials around the nearest of 128 positions per octave, which is faster than the functions. `bits` are
    the eight bytes of x as int64: exponent and mantissa give the position.
    """
    at = (bits >> (52 - _BITS)) - (1023 << _BITS)
    d = x - places[at, 0]
    one, two, three, four, five = places[at, 2], places[at, 3], places[at, 4], places[at, 5], places[at, 6]
    log_gamma = places[at, 1] + d * (one + d * (two + d * (three + d * (four + d * five))))
    return log_gamma, one + d * (2.0 * two + d * (3.0 * three + d * (4.0 * four + d * 5.0 * five)))


@vector
def _sum_divergences(mass: Any, state: Any, scales: Any, places: Any, sums: DivergenceSums) -> None:
    evidence, alpha = np.empty((2, _BLOCK)), np.empty((3, _BLOCK))
    bits = alpha.view(np.int64)
    for start in range(0, state.shape[0], _BLOCK):
        count = min(_BLOCK, state.shape[0] - start)
        for i in range(count):
            free, occupied = max(float(mass[start + i, 0]), 0.0), max(float(mass[start + i, 1]), 0.0)
            factor = 2.0 / max(1.0 - free - occupied, MIN_UNKNOWN)
            evidence[0, i], evidence[1, i] = factor * free, factor * occupied
        for n in range(scales.shape[0]):
            for i in range(count):
                alpha[0, i] = 1.0 + scales[n] * evidence[0, i]
                alpha[1, i] = 1.0 + scales[n] * evidence[1, i]
                alpha[2, i] = 2.0 + scales[n] * (evidence[0, i] + evidence[1, i])
            for i in range(count):
                truth = state[start + i]
                if truth > _OCCUPIED:
                    continue
                free, occupied = scales[n] * evidence[0, i], scales[n] * evidence[1, i]
                log_gamma_free, digamma_free = _look_up(alpha[0, i], bits[0, i], places)
                log_gamma_occupied, digamma_occupied = _look_up(alpha[1, i], bits[1, i], places)
                log_gamma, digamma = _look_up(alpha[2, i], bits[2, i], places)
                log_free, log_occupied = digamma_free - digamma, digamma_occupied - digamma
                log_beta = log_gamma_free + log_gamma_occupied - log_gamma
                sums.uniform_kl[n, truth] += free * log_free + occupied * log_occupied - log_beta
                sums.free[n, truth] += free
                sums.occupied[n, truth] += occupied
                sums.log_free[n, truth] += log_free
                sums.log_occupied[n, truth] += log_occupied
                sums.log_beta[n, truth] += log_beta
        for i in range(count):
            truth = state[start + i]
            if truth > _OCCUPIED:
                continue
            if evidence[0, i] < 1.0:
                sums.clipped_log_free[truth] += math.log(max(evidence[0, i], MIN_EVIDENCE))
            if evidence[1, i] < 1.0:
                sums.clipped_log_occupied[truth] += math.log(max(evidence[1, i], MIN_EVIDENCE))
