"""Discounting of masses from unreliable or old sources.

Sources: Shafer (1976), chapter 11; Mercier, Quost and Denœux, "Refined modeling of sensor reliability in the
belief function framework using contextual discounting" (2008); Jøsang, *Subjective Logic* (2016), chapter 14.
"""

from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from ogm.evidence.arrays import Array, as_like, namespace, split, split_two, stack_last
from ogm.evidence.kinds import takes_masses


def _rate_of_the_first(unknowns: Sequence[float], base_rates: Sequence[float]) -> float:
    """Return the base rate of the advisor's opinion; trust in the advisor has a separate base rate."""
    return base_rates[0]


@takes_masses("mass")
def discount(mass: Array, reliability: Any) -> Array:
    """Return Shafer's discounted mass: beliefs times the reliability, the rest unknown.

    Discounts compose: discounting by r1 and then by r2 is discounting by r1 r2.

    Parameters
    ----------
    mass : (..., 2) float32 or float64, numpy or torch
    reliability : float or (...) array
        In [0, 1]; 1 keeps the mass, 0 gives the vacuous mass.
    """
    free, occupied, _ = split(mass)
    r = as_like(reliability, free, "reliability")
    if isinstance(r, float):  # the same in a single pass
        return cast(Array, cast(Any, mass) * r)
    return stack_last(namespace(mass), [r * free, r * occupied], mass)


@takes_masses("mass")
def discount_evidence(mass: Array, reliability: Any) -> Array:
    """Multiply the evidence of a mass by the reliability.

    b' = r b / (u + r (1 - u)). Strong masses lose less than by `discount`. A dogmatic mass has infinite evidence and
    does not change for r > 0; r = 0 gives the vacuous mass.

    Parameters
    ----------
    mass : (..., 2) float32 or float64, numpy or torch
    reliability : float or (...) array
        In [0, 1]; 1 keeps the mass, 0 gives the vacuous mass.
    """
    free, occupied, unknown = split(mass)
    xp = namespace(mass)
    r = as_like(reliability, free, "reliability")
    strength = unknown + r * (free + occupied)
    strength = strength + (strength == 0)
    return stack_last(xp, [r * free / strength, r * occupied / strength], mass)


@takes_masses("mass")
def discount_over_time(mass: Array, elapsed: Any, half_life: float) -> Array:
    """Discount a mass by its age: `discount` by 2^(-elapsed / half_life).

    With this exponential law, the result does not depend on the number of time steps.

    Parameters
    ----------
    mass : (..., 2) float32 or float64, numpy or torch
    elapsed : float or (...) array
        Time since the measurement [s], at least 0.
    half_life : float
        Time in which belief halves [s], greater than 0; infinity keeps the mass.
    """
    if not half_life > 0:
        raise ValueError(f"half_life must be greater than 0 s, got {half_life}; use infinity for no forgetting")
    age = as_like(elapsed, split(mass)[0], "elapsed", high=float("inf"))
    return discount(mass, 0.5 ** (age / half_life))


@takes_masses("mass")
def contextual_discount(mass: Array, reliability_if_free: Any, reliability_if_occupied: Any) -> Array:
    """Discount a mass by reliabilities that depend on the true state.

    A source that is unreliable *when the cell is occupied* gives weak evidence for free, so

    free' = reliability_if_occupied * free,   occupied' = reliability_if_free * occupied.

    Free space fades faster than obstacles if `reliability_if_occupied` is smaller than `reliability_if_free`. If both
    are equal, this is `discount`.

    Parameters
    ----------
    mass : (..., 2) float32 or float64, numpy or torch
    reliability_if_free, reliability_if_occupied : float or (...) array
        In [0, 1]; 1 keeps the mass.

    Notes
    -----
    Mercier, Quost and Denœux (2008): the disjunctive combination of `mass` with a mass per context, which has
    1 - reliability on the context and the rest on the empty set.
    """
    free, occupied, _ = split(mass)
    if_free = as_like(reliability_if_free, free, "reliability_if_free")
    if_occupied = as_like(reliability_if_occupied, free, "reliability_if_occupied")
    return stack_last(namespace(mass), [if_occupied * free, if_free * occupied], mass)


@takes_masses("mass", "trust", numbers="trust", base_rates={"trust": "base_rate"}, rate=_rate_of_the_first)
def trust_discount(mass: Array, trust: Any, base_rate: Any = 0.5) -> Array:
    """Discount an advisor's mass by the projected probability of trust in the advisor.

    Parameters
    ----------
    mass : (..., 2) float32 or float64, numpy or torch
        The advisor's opinion.
    trust : float, or (..., 2) of the same library and dtype
        Probability of trust in [0, 1], see the reliability of `discount`; or the opinion about the advisor,
        (distrust, trust) in the order of (free, occupied).
    base_rate : float or (...) array
        Prior trust in an advisor, in [0, 1].

    Notes
    -----
    Jøsang (2016), section 14.3 (probability-sensitive trust discounting).
    """
    if isinstance(trust, int | float | np.generic):
        return discount(mass, trust)
    (free, occupied, _), (_, trusted, unknown) = split_two(mass, trust, ("mass", "trust"))
    r = trusted + as_like(base_rate, free, "base_rate") * unknown
    return stack_last(namespace(mass), [r * free, r * occupied], mass)


@takes_masses("mass", "trust", rate=_rate_of_the_first)
def trust_discount_opposite(mass: Array, trust: Array) -> Array:
    """Discount an advisor's mass, with distrust as evidence for the opposite of the advisor's opinion.

    free' = trust free + distrust occupied,   occupied' = trust occupied + distrust free.

    Parameters
    ----------
    mass : (..., 2) float32 or float64, numpy or torch
        The advisor's opinion.
    trust : (..., 2) of the same library and dtype
        Opinion about the advisor, (distrust, trust) in the order of (free, occupied).

    Notes
    -----
    Jøsang, Marsh and Pope, "Exploring different types of trust propagation" (2006), opposite belief
    favouring.
    """
    (free, occupied, _), (distrusted, trusted, _) = split_two(mass, trust, ("mass", "trust"))
    opposite = [trusted * free + distrusted * occupied, trusted * occupied + distrusted * free]
    return stack_last(namespace(mass), opposite, mass)
