"""Base rates of fused opinions from sources with different base rates, for any number of sources and states.

Sources: Jøsang, *Subjective Logic* (2016), chapter 12; van der Heijden, Kopp and Kargl, "Multi-source fusion
operations in subjective logic" (Fusion 2018).
"""

from collections.abc import Sequence
from math import prod
from typing import Any

import numpy as np

from ogm.evidence.arrays import namespace, per_cell, rounding


def cumulative_base_rate(unknowns: Sequence[Any], base_rates: Sequence[Any]) -> Any:
    """Return the base rate of the cumulative fusion of sources with different base rates.

    The mean weighted by evidence; for two sources (a_A u_B (1 - u_A) + a_B u_A (1 - u_B)) / (u_A + u_B - 2 u_A u_B).
    The plain mean if all sources are vacuous, or several are dogmatic.

    Parameters
    ----------
    unknowns : sequence of float or (...) array
        Mass of unknown of each source.
    base_rates : sequence of float or (...) array
        Base rate of occupied of each source, in [0, 1]. Arrays broadcast: for base rates (..., K) of K states, give
        ``unknown[..., None]``.
    """
    others = [prod([*unknowns[:k], *unknowns[k + 1 :]]) for k in range(len(unknowns))]
    return _weighted_rate([(1 - u) * rest for u, rest in zip(unknowns, others, strict=True)], base_rates)


def confidence_base_rate(unknowns: Sequence[Any], base_rates: Sequence[Any]) -> Any:
    """Return the base rate of the weighted or belief constraint fusion of sources with different base rates.

    The mean weighted by confidence, for two sources (a_A (1 - u_A) + a_B (1 - u_B)) / (2 - u_A - u_B); the plain mean
    if all sources are vacuous.

    Parameters
    ----------
    unknowns, base_rates
        See `cumulative_base_rate`.
    """
    return _weighted_rate([1 - u for u in unknowns], base_rates)


def averaging_base_rate(unknowns: Sequence[Any], base_rates: Sequence[Any]) -> Any:
    """Return the base rate of the averaging fusion of sources with different base rates: the plain mean."""
    return _weighted_rate([0 * u for u in unknowns], base_rates)


def _weighted_rate(weights: Sequence[Any], rates: Sequence[Any]) -> Any:
    """Return the weighted mean of base rates, and the plain mean where all weights are 0."""
    if len(rates) != len(weights):
        raise ValueError(f"give one base rate per source, {len(weights)}, got {len(rates)}")
    for rate in rates:
        if not hasattr(rate, "detach") and not ((np.asarray(rate) >= 0) & (np.asarray(rate) <= 1)).all():
            raise ValueError(f"base_rates must lie in [0, 1], got {rate}")
    xp = next((namespace(values) for values in (*weights, *rates) if hasattr(values, "detach")), np)
    total: Any = sum(weights)
    total = total if xp is not np else np.asarray(total, None if hasattr(total, "dtype") else np.float64)
    no_weight = total <= rounding(total)
    mean = sum(weight * rate for weight, rate in zip(weights, rates, strict=True)) / (total + no_weight)
    return per_cell(xp.where(no_weight, sum(rates) / len(rates) + 0 * total, mean), total)
