"""Special functions from a table, and the sums that divergences need, compiled by numba."""

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["CLIP", "densities", "look_up", "sum_divergences", "table"]

BITS = 7  # of the mantissa: places of the table per octave
OCTAVES = 18  # from 1 to 2.6e5, above the largest alpha
BLOCK = 256  # cells that are worked on together, for vector instructions
CLIP = 1e-7  # Keras' epsilon: floor of the evidence in the released code's divergence
FAST = {"contract"}  # a b + c in one instruction; nothing else is bent


@lru_cache(maxsize=1)
def table() -> NDArray[np.float64]:
    """Return places x and, at each, Taylor's coefficients of ln Gamma up to the fifth, (places, 8); one is spare."""
    from scipy import special  # here, as it would double the time that the import takes

    within = 1 + (np.arange(1 << BITS) + 0.5) / (1 << BITS)
    x = (2.0 ** np.arange(OCTAVES)[:, None] * within).ravel()
    slopes = (special.polygamma(n, x) / math.factorial(n + 1) for n in range(5))
    return np.stack([x, special.gammaln(x), *slopes, np.zeros_like(x)], axis=-1)


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def look_up(x: float, bits: int, places: Any) -> Any:
    """Return ln Gamma(x) and digamma(x) for 1 <= x < 2**18, to 1e-11 (1 + value) and 1e-11.

    Taylor's polynomials around the nearest of 128 places per octave: faster than the functions themselves.

    Parameters
    ----------
    x : float64
    bits : int64
        The same eight bytes: exponent and mantissa say which place it is.
    places : array
        What `table` returns.
    """
    at = (bits >> (52 - BITS)) - (1023 << BITS)
    d = x - places[at, 0]
    one, two, three, four, five = places[at, 2], places[at, 3], places[at, 4], places[at, 5], places[at, 6]
    log_gamma = places[at, 1] + d * (one + d * (two + d * (three + d * (four + d * five))))
    return log_gamma, one + d * (2.0 * two + d * (3.0 * three + d * (4.0 * four + d * 5.0 * five)))


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _evidence(mass: Any, start: int, count: int, min_unknown: float, out: Any) -> None:
    """Fill the evidence of free and occupied of `count` cells from `start` on, (2, block)."""
    for i in range(count):
        free, occupied = max(float(mass[start + i, 0]), 0.0), max(float(mass[start + i, 1]), 0.0)
        factor = 2.0 / max(1.0 - free - occupied, min_unknown)
        out[0, i], out[1, i] = factor * free, factor * occupied


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _alphas(evidence: Any, count: int, scale: float, out: Any) -> None:
    """Fill 1 + evidence of free and of occupied, and their sum, (3, block)."""
    for i in range(count):
        out[0, i] = 1.0 + scale * evidence[0, i]
        out[1, i] = 1.0 + scale * evidence[1, i]
        out[2, i] = 2.0 + scale * (evidence[0, i] + evidence[1, i])


@njit(cache=True, nogil=True, fastmath=FAST, inline="always")
def _density(alpha: Any, bits: Any, i: int, places: Any) -> Any:
    """Return both expectations of ln p and ln B of the Dirichlet density of cell i; `bits` are those of `alpha`."""
    log_gamma_free, digamma_free = look_up(alpha[0, i], bits[0, i], places)
    log_gamma_occupied, digamma_occupied = look_up(alpha[1, i], bits[1, i], places)
    log_gamma, digamma = look_up(alpha[2, i], bits[2, i], places)
    return digamma_free - digamma, digamma_occupied - digamma, log_gamma_free + log_gamma_occupied - log_gamma


@njit(cache=True, nogil=True, fastmath=FAST)
def densities(mass: Any, scale: float, min_unknown: float, places: Any, out: Any) -> None:
    """Fill evidence of free and occupied, both expectations of ln p, and ln B of every cell: the rows of `out`.

    Parameters
    ----------
    mass : (N, 2) float array
    scale, min_unknown : float
        As in `ogm.metrics.density`.
    places : array
        What `table` returns.
    out : (5, N) float64
    """
    evidence, alpha = np.empty((2, BLOCK)), np.empty((3, BLOCK))
    bits = alpha.view(np.int64)
    for start in range(0, mass.shape[0], BLOCK):
        count = min(BLOCK, mass.shape[0] - start)
        _evidence(mass, start, count, min_unknown, evidence)
        _alphas(evidence, count, scale, alpha)
        for i in range(count):
            k = start + i
            out[0, k], out[1, k] = scale * evidence[0, i], scale * evidence[1, i]
            out[2, k], out[3, k], out[4, k] = _density(alpha, bits, i, places)


@njit(cache=True, nogil=True, fastmath=FAST)
def sum_divergences(
    mass: Any,
    state: Any,
    scales: Any,
    min_unknown: float,
    clip: float,
    places: Any,
    sums: Any,
    logs: Any,
) -> None:
    """Add up what the divergences of all cells need. States: 0 unknown, 1 free, 2 occupied, else left out.

    Parameters
    ----------
    mass : (N, 2) float array
    state : (N,) uint8
    scales : (scales,) float64
        Factors of the evidence to take the sums for.
    min_unknown, clip : float
        Floor of unknown, and floor of the evidence in `logs`.
    places : array
        What `table` returns.
    sums : (scales, 6, 3) float64
        Added to: KL[grid || Dir(1, 1)], and the five rows of `densities`, for every truth.
    logs : (2, 3) float64
        Added to: ln of the evidence of free and occupied, clipped to [clip, 1], for every truth.
    """
    evidence, alpha = np.empty((2, BLOCK)), np.empty((3, BLOCK))
    bits = alpha.view(np.int64)
    for start in range(0, state.shape[0], BLOCK):
        count = min(BLOCK, state.shape[0] - start)
        _evidence(mass, start, count, min_unknown, evidence)
        for n in range(scales.shape[0]):
            _alphas(evidence, count, scales[n], alpha)
            for i in range(count):
                truth = state[start + i]
                if truth > 2:
                    continue
                free, occupied = scales[n] * evidence[0, i], scales[n] * evidence[1, i]
                log_free, log_occupied, log_beta = _density(alpha, bits, i, places)
                sums[n, 0, truth] += free * log_free + occupied * log_occupied - log_beta
                sums[n, 1, truth] += free
                sums[n, 2, truth] += occupied
                sums[n, 3, truth] += log_free
                sums[n, 4, truth] += log_occupied
                sums[n, 5, truth] += log_beta
        for i in range(count):
            truth = state[start + i]
            if truth > 2:
                continue
            for row in range(2):
                if evidence[row, i] < 1.0:
                    logs[row, truth] += math.log(max(evidence[row, i], clip))
