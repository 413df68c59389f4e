"""Measures of the conflict between masses, and of the uncertainty of a mass.

Entropies are in bits.
"""

from typing import Any

from ogm.evidence.arrays import Array, namespace, per_cell, split, split_two, stack_last
from ogm.evidence.conversions import evidence_to_alpha, mass_to_evidence, unknown
from ogm.evidence.dirichlet import dirichlet_kl
from ogm.evidence.kinds import takes_masses
from ogm.evidence.probability import mass_to_probability, plausibility_transform


@takes_masses("a", "b", gives_masses=False)
def conflict(a: Array, b: Array) -> Array:
    """Return the conflict of two sources, free_a occupied_b + occupied_a free_b, in [0, 1].

    It is the mass of the empty set before normalisation (Shafer, 1976).

    Parameters
    ----------
    a, b : (..., 2) float32 or float64, numpy or torch
    """
    (f, o, _), (g, p, _) = split_two(a, b)
    return per_cell(f * p + o * g, a)


@takes_masses("before", "now", gives_masses=False)
def conflict_direction(before: Array, now: Array) -> Array:
    """Return the conflict by direction: (free -> occupied, occupied -> free).

    The first is large where an object appeared, the second where an object disappeared. Both are signs of moving
    objects in a map (Moras, Cherfaoui and Bonnifait, "Credibilist occupancy grids for vehicle perception", 2011).

    Parameters
    ----------
    before, now : (..., 2) float32 or float64, numpy or torch
        For example the map and a new measurement grid.

    Returns
    -------
    (..., 2): free_before occupied_now, and occupied_before free_now; the sum is `conflict`
    """
    (f, o, _), (g, p, _) = split_two(before, now, ("before", "now"))
    return stack_last(namespace(before), [f * p, o * g], before)


@takes_masses("a", "b", gives_masses=False, base_rates={"a": "base_rate", "b": "base_rate"})
def degree_of_conflict(a: Array, b: Array, base_rate: Any = 0.5) -> Array:
    """Return Jøsang's degree of conflict, |P_a - P_b| (1 - u_a) (1 - u_b), in [0, 1].

    Projected distance times conjunctive certainty (Jøsang 2016, section 4.8).
    """
    (f, o, _), (g, p, _) = split_two(a, b)
    p_a: Any = mass_to_probability(a, base_rate)
    distance = abs(p_a - mass_to_probability(b, base_rate))
    return per_cell(distance * (f + o) * (g + p), a)


@takes_masses("a", "b", gives_masses=False)
def jousselme_distance(a: Array, b: Array) -> Array:
    """Return Jousselme's distance of two masses, in [0, 1].

    sqrt(d' D d / 2) with D the Jaccard indices of the focal sets (Jousselme, Grenier and Bossé, 2001); with
    two states it reduces to the Euclidean distance of the pairs over sqrt(2).
    """
    (f, o, _), (g, p, _) = split_two(a, b)
    xp = namespace(a)
    square = 0.5 * ((f - g) ** 2 + (o - p) ** 2)
    same = square == 0
    return per_cell(xp.where(same, 0 * square, xp.sqrt(square + same)), a)


@takes_masses("a", "b", gives_masses=False, base_rates={"a": "base_rate", "b": "base_rate"})
def kl_divergence(
    a: Array, b: Array, base_rate: Any = 0.5, prior_weight: float = 2.0, min_unknown: float = 2e-5
) -> Array:
    """Return the Kullback-Leibler divergence KL[a || b] of the Beta densities of two masses [nats], never negative.

    The opposite direction, ``kl_divergence(b, a)``, differs much: see `dirichlet_kl`.

    Parameters
    ----------
    a, b : (..., 2) float32 or float64, numpy or torch
    base_rate : float or (...) array
        Prior probability of occupied, in (0, 1).
    prior_weight : float
        W > 0, the prior weight; 2 makes the vacuous opinion the uniform density.
    min_unknown : float
        Lower bound of unknown, because a dogmatic mass has no density; by default evidence is at most 1e5.

    Returns
    -------
    (...), in [0, inf)
    """
    split_two(a, b)
    evidences = (mass_to_evidence(mass, prior_weight, min_unknown) for mass in (a, b))
    return dirichlet_kl(*(evidence_to_alpha(evidence, prior_weight, base_rate) for evidence in evidences))


def vacuity(mass: Array) -> Array:
    """Return unknown, the uncertainty from lack of evidence (Jøsang, Cho and Chen, 2018)."""
    return unknown(mass)


@takes_masses("mass", gives_masses=False)
def dissonance(mass: Array) -> Array:
    """Return the uncertainty from contradicting evidence, 2 min(free, occupied), in [0, 1].

    This is the binary case of sum_i b_i Bal_i with Bal = 1 - |b_i - b_j| / (b_i + b_j) (Jøsang, Cho and Chen, 2018).
    """
    free, occupied, _ = split(mass)
    return per_cell(2 * namespace(mass).minimum(free, occupied), mass)


def nonspecificity(mass: Array) -> Array:
    """Return the generalised Hartley measure, sum m(A) log2 |A|; for two states it is unknown."""
    return unknown(mass)


@takes_masses("mass", gives_masses=False)
def specificity(mass: Array) -> Array:
    """Return Yager's specificity, sum m(A) / |A| = free + occupied + unknown / 2, in [0.5, 1]."""
    free, occupied, u = split(mass)
    return per_cell(free + occupied + 0.5 * u, mass)


@takes_masses("mass", gives_masses=False)
def yager_entropy(mass: Array) -> Array:
    """Return Yager's entropy, -sum m(A) log2 Pl(A), in [0, 1] bit (Yager, 1983, as dissonance)."""
    free, occupied, u = split(mass)
    xp = namespace(mass)
    # Plausibility as belief + unknown: 1 - other belief may round to less than the belief, even to zero
    logs = _times_log2(xp, free, (free + u).clip(None, 1))
    return per_cell(-logs - _times_log2(xp, occupied, (occupied + u).clip(None, 1)), mass)


@takes_masses("mass", gives_masses=False)
def pignistic_entropy(mass: Array) -> Array:
    """Return Shannon's entropy of the pignistic probability, in [0, 1] bit."""
    return per_cell(_binary_entropy(namespace(mass), mass_to_probability(mass)), mass)


@takes_masses("mass", gives_masses=False)
def jirousek_shenoy_entropy(mass: Array) -> Array:
    """Return the total uncertainty of Jiroušek and Shenoy (2018), in [0, 2] bit; 2 for the vacuous mass.

    Shannon's entropy of the plausibility transform, plus `nonspecificity`.
    """
    return per_cell(_binary_entropy(namespace(mass), plausibility_transform(mass)) + unknown(mass), mass)


@takes_masses("mass", gives_masses=False)
def deng_entropy(mass: Array) -> Array:
    """Return Deng's entropy, -sum m(A) log2(m(A) / (2^|A| - 1)), in bit (Deng, 2016).

    The maximum, log2(5), is at free = occupied = 1/5 and not at the vacuous mass (log2(3)): do not use it as a
    measure of unknown.
    """
    free, occupied, u = split(mass)
    xp = namespace(mass)
    logs = _times_log2(xp, free, free) + _times_log2(xp, occupied, occupied)
    return per_cell(-logs - _times_log2(xp, u, u / 3), mass)


def _times_log2(xp: Any, x: Any, y: Any) -> Any:
    """Return x log2(y), and 0 where x is 0."""
    zero = x <= 0
    return x * xp.log2(xp.where(zero, 1 + 0 * y, y))


def _binary_entropy(xp: Any, p: Any) -> Any:
    return -_times_log2(xp, p, p) - _times_log2(xp, 1 - p, 1 - p)
