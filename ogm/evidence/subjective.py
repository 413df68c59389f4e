"""Fusion operators of subjective logic for binomial opinions.

They act on the same pairs as the Dempster-Shafer rules, in terms of evidence ``e = W b / u``: cumulative
fusion adds it, averaging fusion takes its mean, weighted fusion its mean weighted by confidence ``1 - u``. A
mass with u = 0 (up to 4 units of rounding) has infinite evidence: it overrules all others, and several of them
are averaged.

Every operator takes two masses or a stack and its axis. Pairs and stacks agree for cumulative fusion alone, and
there only in cells with at most two dogmatic sources: a chain of pairs loses the number of sources of a mean. For
the others a chain of pairs is not the operator. `consensus_compromise` is in `ogm.evidence.proportional`.

Base rates are not part of a pair. Where all sources share one, so does the result; where they differ, use
`cumulative_base_rate`, `confidence_base_rate`, or for averaging fusion the plain mean.

Sources: Jøsang, *Subjective Logic* (2016), chapter 12; Jøsang, Wang and Zhang, "Multi-source fusion in
subjective logic" (Fusion 2017); van der Heijden, Kopp and Kargl, "Multi-source fusion operations in
subjective logic" (Fusion 2018).
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from ogm.evidence.arrays import (
    Array,
    as_like,
    maybe_any,
    namespace,
    per_cell,
    refuse,
    rounding,
    sources,
    split_two,
    stack_last,
    tolerance_of,
)
from ogm.evidence.probability import maximize_uncertainty
from ogm.evidence.rules import OnConflict, dempster


def cumulative(
    a: Array, b: Array | None = None, *, axis: int | None = None, dogmatic_weights: Sequence[float] | None = None
) -> Array:
    """Fuse independent observations by (aleatory) cumulative fusion: evidence adds.

    ``b = (b1 u2 + b2 u1) / (u1 + u2 - u1 u2)``. Commutative, and associative except where three or more sources are
    dogmatic; vacuous is neutral.

    Parameters
    ----------
    a, b : (..., 2) float32 or float64, numpy or torch
        Masses (free, occupied). Without `b`, `a` is a stack of sources along `axis`.
    axis : int, optional
        The leading axis of `a` that counts the sources.
    dogmatic_weights : one number per source, optional
        Relative weights for cells in which several sources are dogmatic; equal by default.

    Returns
    -------
    (..., 2), the fused mass
    """
    xp, parts = sources(a, b, axis)
    if len(parts) == 2 and dogmatic_weights is None:
        (f, o, u), (g, p, v) = parts
        free, occupied, total = added_evidence(f, o, u, g, p, v)
        both = (u <= rounding(a)) & (v <= rounding(a))
        if maybe_any(xp, both):  # two dogmatic masses: their mean
            free, occupied = xp.where(both, f + g, free), xp.where(both, o + p, occupied)
            total = xp.where(both, 2 + 0 * total, total)
        return stack_last(xp, [free / total, occupied / total], a)
    return _by_evidence(xp, a, parts, dogmatic_weights, _sum_of_evidence)


def added_evidence(f: Any, o: Any, u: Any, g: Any, p: Any, v: Any) -> tuple[Any, Any, Any]:
    """Return (free, occupied) of the cumulative fusion of (f, o, u) and (g, p, v), times a divisor, and the divisor.

    The divisor is u + v - u v. `ogm.evidence.kernels` compiles this same function.
    """
    return f * v + g * u, o * v + p * u, u + v * (f + o)


def cumulative_epistemic(a: Array, b: Array | None = None, *, axis: int | None = None, base_rate: Any = 0.5) -> Array:
    """Fuse opinions about one fixed fact: cumulative fusion, then maximal uncertainty.

    Not associative, and the vacuous mass is not neutral, as every result is uncertainty-maximised.

    Parameters
    ----------
    a, b, axis
        As for `cumulative`.
    base_rate : float or (...) array
        Prior probability of occupied, in [0, 1].
    """
    return maximize_uncertainty(cumulative(a, b, axis=axis), base_rate)


def cumulative_unfusion(fused: Array, part: Array) -> Array:
    """Return what was fused with `part` to give `fused`: evidence subtracts.

    ``cumulative(part, cumulative_unfusion(fused, part))`` is `fused` again.

    Parameters
    ----------
    fused, part : (..., 2) float32 or float64, numpy or torch
        `part` must not hold more evidence than `fused`. Where both are dogmatic the rest is undetermined, and the
        vacuous mass is returned.

    Raises
    ------
    ValueError
        If a numpy `part` holds more evidence than `fused`, beyond rounding.
    """
    xp = namespace(fused)
    (f, o, u), (g, p, v) = split_two(fused, part, ("fused", "part"))
    free, occupied = f * v - g * u, o * v - p * u
    if xp is np:
        least, must = np.minimum(free, occupied), "not be negative, as part must not hold more evidence than fused"
        refuse(least < -tolerance_of(fused), least, "what remains", must)
    dogmatic = (u <= rounding(fused)) & (v <= rounding(fused))
    free, occupied = (xp.where(dogmatic, 0.0, belief.clip(0)) for belief in (free, occupied))
    total = free + occupied + u * v
    total = total + (total == 0)
    return stack_last(xp, [free / total, occupied / total], fused)


def averaging(
    a: Array, b: Array | None = None, *, axis: int | None = None, dogmatic_weights: Sequence[float] | None = None
) -> Array:
    """Fuse dependent observations by averaging fusion: the mean of the evidence.

    Commutative and idempotent, not associative (a stack is averaged in one go); vacuous is not neutral.

    Parameters
    ----------
    a, b, axis, dogmatic_weights
        As for `cumulative`.
    """
    xp, parts = sources(a, b, axis)
    return _by_evidence(xp, a, parts, dogmatic_weights, partial(_sum_of_evidence, divisor=len(parts)))


def weighted(
    a: Array, b: Array | None = None, *, axis: int | None = None, dogmatic_weights: Sequence[float] | None = None
) -> Array:
    """Fuse by weighted belief fusion: the mean of the evidence, weighted by confidence 1 - u.

    Commutative and idempotent, vacuous is neutral; not associative (a stack is fused in one go).

    Parameters
    ----------
    a, b, axis, dogmatic_weights
        As for `cumulative`.
    """
    xp, parts = sources(a, b, axis)
    return _by_evidence(xp, a, parts, dogmatic_weights, _confident_mean_of_evidence)


def belief_constraint(
    a: Array, b: Array | None = None, *, axis: int | None = None, on_conflict: OnConflict = "average"
) -> Array:
    """Fuse by belief constraint fusion: Dempster's rule under its name in subjective logic.

    Parameters
    ----------
    a, b, axis, on_conflict
        As for `dempster`. The base rate of the result is `confidence_base_rate`.
    """
    return dempster(a, b, axis=axis, on_conflict=on_conflict)


def cumulative_base_rate(a: Array, b: Array, base_rate_a: Any, base_rate_b: Any) -> Array:
    """Return the base rate of the cumulative fusion of two masses with different base rates.

    The mean weighted by evidence, (a_A u_B (1 - u_A) + a_B u_A (1 - u_B)) / (u_A + u_B - 2 u_A u_B); the
    plain mean where both masses are vacuous or both dogmatic.

    Parameters
    ----------
    a, b : (..., 2) float32 or float64, numpy or torch
    base_rate_a, base_rate_b : float or (...) array
        Base rates of occupied, in [0, 1].
    """
    (f, o, u), (g, p, v) = split_two(a, b)
    return _weighted_rate(a, (base_rate_a, base_rate_b), (v * (f + o), u * (g + p)))


def confidence_base_rate(a: Array, b: Array, base_rate_a: Any, base_rate_b: Any) -> Array:
    """Return the base rate of the weighted or belief constraint fusion of two masses.

    The mean weighted by confidence, (a_A (1 - u_A) + a_B (1 - u_B)) / (2 - u_A - u_B); the plain mean where
    both masses are vacuous.

    Parameters
    ----------
    a, b, base_rate_a, base_rate_b
        As for `cumulative_base_rate`.
    """
    (f, o, _), (g, p, _) = split_two(a, b)
    return _weighted_rate(a, (base_rate_a, base_rate_b), (f + o, g + p))


def _weighted_rate(mass: Array, rates: tuple[Any, Any], weights: tuple[Any, Any]) -> Array:
    xp = namespace(mass)
    first, second = as_like(rates[0], weights[0], "base_rate_a"), as_like(rates[1], weights[0], "base_rate_b")
    total = weights[0] + weights[1]
    none = total <= rounding(mass)
    mean = (weights[0] * first + weights[1] * second) / (total + none)
    return per_cell(xp.where(none, 0.5 * (first + second) + 0 * total, mean), mass)


def _by_evidence(
    xp: Any,
    mass: Array,
    parts: list[tuple[Any, Any, Any]],
    weights: Sequence[float] | None,
    combine: Callable[[list[tuple[Any, Any, Any]]], tuple[Any, Any]],
) -> Array:
    """Fuse n sources in terms of b / u, evidence over prior weight; average the dogmatic ones, if any."""
    weights = [1.0] * len(parts) if weights is None else list(weights)
    if len(weights) != len(parts) or not all(0 < weight < float("inf") for weight in weights):
        raise ValueError(f"dogmatic_weights must be {len(parts)} positive numbers, one per source, got {weights}")
    dogmatic = [u <= rounding(mass) for _, _, u in parts]
    if not any(maybe_any(xp, here) for here in dogmatic):
        return stack_last(xp, list(combine(parts)), mass)
    # Where some are dogmatic, their weighted mean; elsewhere the rule, with 1 in place of u = 0.
    share = [weight * (here + 0 * u) for weight, here, (*_, u) in zip(weights, dogmatic, parts, strict=True)]
    total: Any = sum(share)
    some = total > 0
    total = total + ~some
    fused = combine([(f, o, u + here) for here, (f, o, u) in zip(dogmatic, parts, strict=True)])
    means = [sum(s * part[k] for s, part in zip(share, parts, strict=True)) / total for k in (0, 1)]
    return stack_last(xp, [xp.where(some, *pair) for pair in zip(means, fused, strict=True)], mass)


def _sum_of_evidence(parts: list[tuple[Any, Any, Any]], divisor: int = 1) -> tuple[Any, Any]:
    free = sum(f / u for f, _, u in parts) / divisor
    occupied = sum(o / u for _, o, u in parts) / divisor
    return free / (1 + free + occupied), occupied / (1 + free + occupied)


def _confident_mean_of_evidence(parts: list[tuple[Any, Any, Any]]) -> tuple[Any, Any]:
    confidence = sum(f + o for f, o, _ in parts)
    free = sum((f + o) * f / u for f, o, u in parts)
    occupied = sum((f + o) * o / u for f, o, u in parts)
    total = confidence + free + occupied
    total = total + (total == 0)
    return free / total, occupied / total
