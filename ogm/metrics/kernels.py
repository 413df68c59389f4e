"""What is done for every cell, compiled by numba: special functions from a table, and all counts in one pass."""

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["count_cells", "densities", "look_up", "table"]

BITS = 10  # of the mantissa: places of the table per octave
OCTAVES = 18  # from 1 to 2.6e5, above the largest alpha


@lru_cache(maxsize=1)
def table() -> NDArray[np.float64]:
    """Return places and, at each, ln Gamma and its first three derivatives, (places, 5)."""
    from scipy import special  # here, as it would double the time that the import takes

    within = 1 + (np.arange(1 << BITS) + 0.5) / (1 << BITS)
    x = (2.0 ** np.arange(OCTAVES)[:, None] * within).ravel()
    rows = x, special.gammaln(x), special.digamma(x), special.polygamma(1, x), special.polygamma(2, x)
    return np.stack(rows, axis=-1)


@njit(cache=True, nogil=True)
def look_up(x: float, places: Any) -> Any:
    """Return ln Gamma(x) and digamma(x) for 1 <= x < 2**18, to 1e-11 (1 + value) and 2e-10.

    Taylor's polynomials around the nearest of 1024 places per octave: faster than the functions themselves.
    """
    mantissa, exponent = math.frexp(x)  # x = mantissa 2**exponent, mantissa in [1/2, 1)
    place = ((exponent - 1) << BITS) + int((2.0 * mantissa - 1.0) * (1 << BITS))
    d = x - places[place, 0]
    slope = d * places[place, 3]
    curve = 0.5 * d * d * places[place, 4]
    digamma = places[place, 2]
    return places[place, 1] + d * (digamma + 0.5 * slope + curve / 3.0), digamma + slope + curve


@njit(cache=True, nogil=True)
def _density(free: float, occupied: float, places: Any) -> Any:
    """Return both expectations of ln p and ln B of Dir(1 + free, 1 + occupied)."""
    log_gamma_free, digamma_free = look_up(1.0 + free, places)
    log_gamma_occupied, digamma_occupied = look_up(1.0 + occupied, places)
    log_gamma, digamma = look_up(2.0 + free + occupied, places)
    return digamma_free - digamma, digamma_occupied - digamma, log_gamma_free + log_gamma_occupied - log_gamma


@njit(cache=True, nogil=True)
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
    for k in range(mass.shape[0]):
        free, occupied = max(float(mass[k, 0]), 0.0), max(float(mass[k, 1]), 0.0)
        factor = 2.0 * scale / max(1.0 - free - occupied, min_unknown)
        out[0, k], out[1, k] = free * factor, occupied * factor
        out[2, k], out[3, k], out[4, k] = _density(out[0, k], out[1, k], places)


@njit(cache=True, nogil=True)
def count_cells(
    mass: Any,
    state: Any,
    scales: Any,
    min_unknown: float,
    clip: float,
    sure: float,
    places: Any,
    cells: Any,
    masses: Any,
    sums: Any,
    logs: Any,
    calls: Any,
    likelier: Any,
    claims: Any,
    reliability: Any,
    squared: Any,
    doubt: Any,
) -> None:
    """Count everything that `ogm.metrics.Tally` needs. States: 0 unknown, 1 free, 2 occupied, else left out.

    Parameters
    ----------
    mass : (N, 2) float array
    state : (N,) uint8
    scales : (scales,) float64
        Factors of the evidence to take the sums for.
    min_unknown, clip, sure : float
        Floor of unknown, floor of the evidence in `logs`, and the mass beyond which a claim is one.
    places : array
        What `table` returns.
    cells, masses, calls, likelier, claims, reliability, squared, doubt : float64 arrays
        Added to, as `Tally` has them.
    sums : (scales, 6, 3) float64
        Added to: KL[grid || Dir(1, 1)], and the five rows of `densities`, for every truth.
    logs : (2, 3) float64
        Added to: ln of the evidence of free and occupied, clipped to [clip, 1], for every truth.
    """
    bins, levels = reliability.shape[1], doubt.shape[1]
    for k in range(state.shape[0]):
        truth = state[k]
        if truth > 2:
            continue
        free, occupied = max(float(mass[k, 0]), 0.0), max(float(mass[k, 1]), 0.0)
        unknown = 1.0 - free - occupied
        cells[truth] += 1.0
        masses[truth, 0] += free
        masses[truth, 1] += occupied

        # Divergences
        factor = 2.0 / max(unknown, min_unknown)
        for n in range(scales.shape[0]):
            e_free, e_occupied = scales[n] * factor * free, scales[n] * factor * occupied
            log_free, log_occupied, log_beta = _density(e_free, e_occupied, places)
            sums[n, 0, truth] += e_free * log_free + e_occupied * log_occupied - log_beta
            sums[n, 1, truth] += e_free
            sums[n, 2, truth] += e_occupied
            sums[n, 3, truth] += log_free
            sums[n, 4, truth] += log_occupied
            sums[n, 5, truth] += log_beta
        logs[0, truth] += math.log(min(max(factor * free, clip), 1.0))
        logs[1, truth] += math.log(min(max(factor * occupied, clip), 1.0))

        # Calls
        call = 0
        if occupied > unknown and occupied >= free:
            call = 2
        elif free > unknown and free > occupied:
            call = 1
        calls[truth, call] += 1.0
        likelier[truth, 2 if occupied > free else 1 if free > occupied else 0] += 1.0
        claims[truth, 0] += free > sure
        claims[truth, 1] += occupied > sure
        level = int(min(max(unknown, 0.0), 1.0) * (levels - 1) + 0.5)
        doubt[0 if truth > 0 else 1, level] += 1.0

        # Probability, on known cells
        if truth == 0:
            continue
        probability = 0.5 * (1.0 + occupied - free)
        happened = 1.0 if truth == 2 else 0.0
        squared[0] += (probability - happened) ** 2
        relative = occupied / (free + occupied) if free + occupied > 0.0 else 0.5
        squared[1] += (relative - happened) ** 2
        for n in range(3):
            if n == 1 and call == 0:
                continue
            claimed = relative if n == 2 else probability
            place = min(int(claimed * bins), bins - 1)
            reliability[n, place, 0] += 1.0
            reliability[n, place, 1] += claimed
            reliability[n, place, 2] += happened
