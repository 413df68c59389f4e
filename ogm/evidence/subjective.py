"""Fusion operators of subjective logic for binomial opinions.

They act on pairs like the Dempster-Shafer rules, in terms of evidence ``e = W b / u``: cumulative fusion adds evidence,
averaging fusion takes the mean, and weighted fusion the mean weighted by confidence ``1 - u``. A mass with u = 0 (up to
4 units of rounding) is dogmatic: its evidence is infinite. Dogmatic masses overrule all others and are averaged.

Every operator takes several masses, or a stack and its axis. A chain of pairs is equivalent only for cumulative fusion,
in cells with at most two dogmatic sources, because a mean of dogmatic masses loses the number of sources.
`consensus_compromise` is in `ogm.evidence.proportional`.

Base rates are not part of a pair. If all sources have the same base rate, so does the result. For different base rates
use `cumulative_base_rate`, `confidence_base_rate` or `averaging_base_rate`, as the operators do for opinions.

Sources: Jøsang, *Subjective Logic* (2016), chapter 12; Jøsang, Wang and Zhang, "Multi-source fusion in
subjective logic" (Fusion 2017); van der Heijden, Kopp and Kargl, "Multi-source fusion operations in
subjective logic" (Fusion 2018).
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ogm.evidence.arrays import (
    Array,
    maybe_any,
    namespace,
    refuse,
    rounding,
    sources,
    split_two,
    stack_last,
    tolerance_of,
)
from ogm.evidence.base_rates import averaging_base_rate, confidence_base_rate, cumulative_base_rate
from ogm.evidence.kinds import takes_masses
from ogm.evidence.probability import maximize_uncertainty
from ogm.evidence.rules import OnConflict, dempster

Combine = Callable[[Sequence[Any]], list[Any]]


@takes_masses(rate=cumulative_base_rate)
def cumulative(*masses: Array, axis: int | None = None, dogmatic_weights: Sequence[float] | None = None) -> Array:
    """Fuse independent observations by (aleatory) cumulative fusion: evidence adds.

    ``b = (b1 u2 + b2 u1) / (u1 + u2 - u1 u2)``. Commutative, and associative except where three or more sources are
    dogmatic; the vacuous mass is neutral.

    Parameters
    ----------
    *masses : (..., 2) float32 or float64, numpy or torch
        Masses (free, occupied) of two or more sources, or a stack of sources along `axis`.
    axis : int, optional
        Leading axis of the stack that counts the sources.
    dogmatic_weights : one number per source, optional
        Relative weights for cells in which several sources are dogmatic; equal by default.

    Returns
    -------
    (..., 2), the fused mass
    """
    xp, parts = sources(masses, axis)
    if len(parts) == 2 and dogmatic_weights is None:
        (f, o, u), (g, p, v) = parts
        free, occupied, total = added_evidence(f, o, u, g, p, v)
        both = (u <= rounding(masses[0])) & (v <= rounding(masses[0]))
        if maybe_any(xp, both):  # two dogmatic masses: their mean
            free, occupied = xp.where(both, f + g, free), xp.where(both, o + p, occupied)
            total = xp.where(both, 2 + 0 * total, total)
        return stack_last(xp, [free / total, occupied / total], masses[0])
    return stack_last(xp, fuse_by_evidence(xp, masses[0], parts, sum_of_evidence, dogmatic_weights), masses[0])


def added_evidence(f: Any, o: Any, u: Any, g: Any, p: Any, v: Any) -> tuple[Any, Any, Any]:
    """Return (free, occupied) of the cumulative fusion of (f, o, u) and (g, p, v), times a divisor, and the divisor.

    The divisor is u + v - u v. `ogm.evidence.kernels` compiles this function.
    """
    return f * v + g * u, o * v + p * u, u + v * (f + o)


def cumulative_epistemic(*masses: Array, axis: int | None = None, base_rate: Any = None) -> Array:
    """Fuse opinions about one fixed fact: cumulative fusion, then maximal uncertainty.

    Not associative, and the vacuous mass is not neutral, because the uncertainty of every result is maximised.

    Parameters
    ----------
    *masses, axis
        See `cumulative`.
    base_rate : float or (...) array, optional
        Prior probability of occupied, in [0, 1]; by default the base rate of the opinions, or 1/2 for masses.
    """
    fused = cumulative(*masses, axis=axis)
    return maximize_uncertainty(fused) if base_rate is None else maximize_uncertainty(fused, base_rate)


@takes_masses("fused", "part")
def cumulative_unfusion(fused: Array, part: Array) -> Array:
    """Subtract the evidence of `part` from `fused`, the inverse of `cumulative`.

    ``cumulative(part, cumulative_unfusion(fused, part))`` is `fused`.

    Parameters
    ----------
    fused, part : (..., 2) float32 or float64, numpy or torch
        `part` must not have more evidence than `fused`. Where both are dogmatic, the difference is undetermined, and
        the result is the vacuous mass.

    Raises
    ------
    ValueError
        If a numpy `part` has more evidence than `fused`, beyond rounding.
    """
    xp = namespace(fused)
    (f, o, u), (g, p, v) = split_two(fused, part, ("fused", "part"))
    free, occupied = f * v - g * u, o * v - p * u
    if xp is np:
        lesser, must = np.minimum(free, occupied), "not be negative (part must not have more evidence than fused)"
        refuse(lesser < -tolerance_of(fused), lesser, "fused - part", must)
    dogmatic = (u <= rounding(fused)) & (v <= rounding(fused))
    free, occupied = (xp.where(dogmatic, 0.0, belief.clip(0)) for belief in (free, occupied))
    total = free + occupied + u * v
    total = total + (total == 0)
    return stack_last(xp, [free / total, occupied / total], fused)


@takes_masses(rate=averaging_base_rate)
def averaging(*masses: Array, axis: int | None = None, dogmatic_weights: Sequence[float] | None = None) -> Array:
    """Fuse dependent observations by averaging fusion: the mean of the evidence.

    Commutative and idempotent, not associative; the vacuous mass is not neutral.

    Parameters
    ----------
    *masses, axis, dogmatic_weights
        See `cumulative`.
    """
    xp, parts = sources(masses, axis)
    return stack_last(xp, fuse_by_evidence(xp, masses[0], parts, mean_of_evidence, dogmatic_weights), masses[0])


@takes_masses(rate=confidence_base_rate)
def weighted(*masses: Array, axis: int | None = None, dogmatic_weights: Sequence[float] | None = None) -> Array:
    """Fuse by weighted belief fusion: the mean of the evidence, weighted by confidence 1 - u.

    Commutative and idempotent, not associative; the vacuous mass is neutral.

    Parameters
    ----------
    *masses, axis, dogmatic_weights
        See `cumulative`.
    """
    xp, parts = sources(masses, axis)
    fused = fuse_by_evidence(xp, masses[0], parts, confident_mean_of_evidence, dogmatic_weights)
    return stack_last(xp, fused, masses[0])


@takes_masses(rate=confidence_base_rate)
def belief_constraint(*masses: Array, axis: int | None = None, on_conflict: OnConflict = "average") -> Array:
    """Fuse by belief constraint fusion, the name of Dempster's rule in subjective logic.

    Parameters
    ----------
    *masses, axis, on_conflict
        See `dempster`. The base rate of the result is from `confidence_base_rate`.
    """
    return dempster(*masses, axis=axis, on_conflict=on_conflict)


def fuse_by_evidence(
    xp: Any, mass: Any, parts: Sequence[Any], combine: Combine, dogmatic_weights: Sequence[float] | None = None
) -> list[Any]:
    """Return the fused beliefs of several sources from b / u, evidence over prior weight.

    Parameters
    ----------
    xp : module
        numpy or torch.
    mass : array
        Array of the dtype of the sources, which sets the greatest unknown of a dogmatic mass.
    parts : sequence of (belief, ..., unknown)
        Columns of each source.
    combine : function
        Function of parts that returns beliefs: `sum_of_evidence`, `mean_of_evidence` or `confident_mean_of_evidence`.
    dogmatic_weights : one number per source, optional
        Relative weights for cells in which several sources are dogmatic; equal by default.
    """
    weights = [1.0] * len(parts) if dogmatic_weights is None else list(dogmatic_weights)
    if len(weights) != len(parts) or not all(0 < weight < float("inf") for weight in weights):
        raise ValueError(f"dogmatic_weights must be {len(parts)} positive numbers, one per source, got {weights}")
    dogmatic = [part[-1] <= rounding(mass) for part in parts]
    if not any(maybe_any(xp, here) for here in dogmatic):
        return combine(parts)
    # The weighted mean of dogmatic sources, if any; in other cells the rule, with 1 in place of u = 0
    share = [weight * (here + 0 * part[-1]) for weight, here, part in zip(weights, dogmatic, parts, strict=True)]
    total: Any = sum(share)
    is_dogmatic = total > 0
    total = total + ~is_dogmatic
    fused = combine([(*part[:-1], part[-1] + here) for here, part in zip(dogmatic, parts, strict=True)])
    beliefs = zip(*(part[:-1] for part in parts), strict=True)
    means = [sum(s * b for s, b in zip(share, column, strict=True)) / total for column in beliefs]
    return [xp.where(is_dogmatic, *pair) for pair in zip(means, fused, strict=True)]


def sum_of_evidence(parts: Sequence[Any], divisor: int = 1) -> list[Any]:
    """Return the beliefs of the sum of the evidence of sources, over a divisor."""
    columns = zip(*([b / part[-1] for b in part[:-1]] for part in parts), strict=True)
    evidence = [sum(column) / divisor for column in columns]
    total = 1 + sum(evidence)
    return [number / total for number in evidence]


def mean_of_evidence(parts: Sequence[Any]) -> list[Any]:
    """Return the beliefs of the mean evidence of sources."""
    return sum_of_evidence(parts, len(parts))


def confident_mean_of_evidence(parts: Sequence[Any]) -> list[Any]:
    """Return the beliefs of the mean evidence of sources, weighted by their confidence 1 - u."""
    confidence = [sum(part[:-1]) for part in parts]
    scaled = ([c * b / part[-1] for b in part[:-1]] for c, part in zip(confidence, parts, strict=True))
    evidence = [sum(column) for column in zip(*scaled, strict=True)]
    total = sum(confidence) + sum(evidence)
    total = total + (total == 0)
    return [number / total for number in evidence]
