"""Conversions between masses and the probability of occupied, log-odds and counts.

Sources: Smets and Kennes, "The transferable belief model" (1994); Jøsang, *Subjective Logic* (2016), chapter
3; Cobb and Shenoy, "On the plausibility transformation method for translating belief function models to
probability models" (2006).
"""

from typing import Any

import numpy as np

from ogm.evidence.arrays import Array, as_like, check_float, namespace, per_cell, split, stack_last
from ogm.evidence.kinds import takes_masses


@takes_masses("mass", gives_masses=False, base_rates={"mass": "base_rate"})
def mass_to_probability(mass: Array, base_rate: Any = 0.5) -> Array:
    """Return the projected probability of occupied, P = occupied + a * unknown.

    It is the mean alpha_occupied / sum(alpha) of the Dirichlet density, and for a = 0.5 the pignistic probability.

    Parameters
    ----------
    mass : (..., 2) float32 or float64, numpy or torch
    base_rate : float or (...) array
        Prior probability a of occupied, in [0, 1].

    Returns
    -------
    (...), in [0, 1]
    """
    _, occupied, u = split(mass)
    return per_cell(occupied + as_like(base_rate, occupied, "base_rate") * u, mass)


def probability_to_mass(probability: Any, unknown: Any, base_rate: Any = 0.5) -> Any:
    """Return the mass with a given projected probability of occupied and a given unknown.

    The inverse of `mass_to_probability`: occupied = P - a u, free = 1 - P - (1 - a) u. With ``unknown = 0`` the result
    is the dogmatic (Bayesian) mass.

    Raises
    ------
    ValueError
        If `unknown` is too large for `probability`; `maximize_uncertainty` gives the greatest possible unknown.
    """
    xp = check_float(probability, "probability")
    u = as_like(unknown, probability, "unknown")
    rate = as_like(base_rate, probability, "base_rate")
    as_like(probability, probability, "probability")
    free = 1 - probability - (1 - rate) * u
    occupied = probability - rate * u
    mass = stack_last(xp, [free, occupied], probability)
    free, occupied, _ = split(mass, "the mass of this probability and unknown")
    return stack_last(xp, [free, occupied], probability)


@takes_masses("mass", gives_masses=False)
def pignistic(mass: Array) -> Array:
    """Return the pignistic probability of occupied, occupied + unknown / 2 (Smets and Kennes, 1994)."""
    return mass_to_probability(mass, 0.5)


@takes_masses("mass", gives_masses=False)
def plausibility_transform(mass: Array) -> Array:
    """Return the plausibility transform, Pl(O) / (Pl(F) + Pl(O)) (Cobb and Shenoy, 2006).

    Dempster's rule multiplies plausibilities, so it adds the log-odds of this probability.
    """
    free, occupied, u = split(mass)
    return per_cell((occupied + u) / ((free + u) + (occupied + u)), mass)


@takes_masses("mass", gives_masses=False)
def mass_to_log_odds(mass: Array) -> Array:
    """Return the log-odds of occupied of the plausibility transform, ln(Pl(O) / Pl(F)).

    The log-odds of a Bayesian grid: Dempster's rule adds them. A dogmatically occupied (free) cell has +inf (-inf).
    """
    free, occupied, _ = split(mass)
    xp = namespace(mass)
    with np.errstate(divide="ignore"):
        return per_cell(xp.log1p(-free.clip(None, 1)) - xp.log1p(-occupied.clip(None, 1)), mass)


def log_odds_to_mass(log_odds: Array) -> Array:
    """Return the least committed mass with the given log-odds, with belief in a single state.

    l > 0 gives occupied = 1 - exp(-l), l < 0 gives free = 1 - exp(l), and the rest is unknown. Dempster's rule on these
    masses adds log-odds. The inverse is `mass_to_log_odds`.

    Parameters
    ----------
    log_odds : (...) float32 or float64, numpy or torch
        Natural logarithm of the odds of occupied.
    """
    xp = check_float(log_odds, "log_odds")
    given: Any = log_odds
    if xp is np and np.isnan(given).any():
        raise ValueError("log_odds must not be NaN")
    return stack_last(xp, [-xp.expm1(given.clip(None, 0)), -xp.expm1(-given.clip(0))], log_odds)


@takes_masses("mass", base_rates={"mass": "base_rate"})
def maximize_uncertainty(mass: Array, base_rate: Any = 0.5) -> Array:
    """Return the mass of the same projected probability with the greatest unknown.

    u = min(P / a, (1 - P) / (1 - a)); one of the beliefs becomes zero (Jøsang 2016, section 3.5.6).

    Parameters
    ----------
    mass : (..., 2) float32 or float64, numpy or torch
    base_rate : float or (...) array
        Prior probability a of occupied, in [0, 1].
    """
    free, occupied, u = split(mass)
    xp = namespace(mass)
    rate = as_like(base_rate, occupied, "base_rate")
    probability = occupied + rate * u
    opposite = free + (1 - rate) * u
    # Cross-multiplied, without a bound for base rates of 0 and 1, to avoid division by zero
    occupied_wins = (probability * (1 - rate) >= opposite * rate) & (rate < 1)
    zero = 0 * u
    as_occupied = probability - rate * opposite / xp.where(occupied_wins, 1 - rate, 1.0 + zero).clip(1e-30)
    as_free = opposite - (1 - rate) * probability / xp.where(occupied_wins, 1.0 + zero, rate + zero).clip(1e-30)
    return stack_last(xp, [xp.where(occupied_wins, zero, as_free), xp.where(occupied_wins, as_occupied, zero)], mass)


def counts_to_mass(hits: Array, passes: Array, p_miss: float = 0.8, p_false_alarm: float = 0.05) -> Array:
    """Return the mass of a cell in which `hits` rays ended and through which `passes` rays went.

    Each hit is a simple mass 1 - p_false_alarm on occupied, and each pass a simple mass 1 - p_miss on free. All are
    combined at once by Yager's rule:

    occupied = p_miss^passes (1 - p_false_alarm^hits),   free = p_false_alarm^hits (1 - p_miss^passes).

    Parameters
    ----------
    hits, passes : (...) float32 or float64, numpy or torch
        Numbers of rays or their weights, at least 0.
    p_miss : float
        Probability in [0, 1] that a ray passes through an occupied cell.
    p_false_alarm : float
        Probability in [0, 1] that a ray ends in a free cell.
    """
    xp = check_float(hits, "hits")
    reflections: Any = hits
    transmissions = as_like(passes, hits, "passes", high=float("inf"))
    as_like(hits, hits, "hits", high=float("inf"))
    missed = as_like(p_miss, hits, "p_miss") ** transmissions
    false = as_like(p_false_alarm, hits, "p_false_alarm") ** reflections
    return stack_last(xp, [false * (1 - missed), missed * (1 - false)], hits)
