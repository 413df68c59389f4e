"""Fusion operators of subjective logic for binomial opinions.

They act on the same pairs as the Dempster-Shafer rules and think in evidence ``e = W b / u``: cumulative
fusion adds it, averaging fusion takes its mean, weighted fusion its mean weighted by confidence ``1 - u``. A
mass with u = 0 (up to 4 units of rounding) has infinite evidence: it overrules all others, and several of them
are averaged.

Every operator takes two masses or a stack and its axis. Pairs and stacks agree for cumulative fusion alone, and
there only in cells with at most two dogmatic sources: a chain of pairs does not know of how many a mean is. For
the others a chain of pairs is not the operator. `consensus_compromise` is in `ogm.evidence.consensus`.

Base rates are not part of a pair. Where all sources share one, so does the result; where they differ, use
`cumulative_base_rate`, `confidence_base_rate`, or for averaging fusion the plain mean.

Sources: Jøsang, *Subjective Logic* (2016), chapter 12; Jøsang, Wang and Zhang, "Multi-source fusion in
subjective logic" (Fusion 2017); van der Heijden, Kopp and Kargl, "Multi-source fusion operations in
subjective logic" (Fusion 2018).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ogm.evidence.arrays import (
    Array,
    anywhere,
    check_alike,
    like,
    namespace,
    pack,
    per_cell,
    rounding,
    sources,
    split,
    tolerance_of,
)
from ogm.evidence.probability import maximize_uncertainty
from ogm.evidence.rules import OnConflict, dempster

__all__ = [
    "averaging",
    "belief_constraint",
    "confidence_base_rate",
    "cumulative",
    "cumulative_base_rate",
    "cumulative_epistemic",
    "cumulative_unfusion",
    "weighted",
]


def cumulative(
    a: Array,
    b: Array | None = None,
    *,
    axis: int | None = None,
    dogmatic_weights: Sequence[float] | None = None,
) -> Array:
    """Fuse independent observations by (aleatory) cumulative fusion: evidence adds.

    Commutative, and associative but where three or more sources are dogmatic; vacuous is neutral.

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
        free, occupied, total = f * v + g * u, o * v + p * u, u + v * (f + o)  # = u + v - u v
        both = (u <= rounding(a)) & (v <= rounding(a))
        if anywhere(xp, both):  # two dogmatic masses: their mean
            free, occupied = xp.where(both, f + g, free), xp.where(both, o + p, occupied)
            total = xp.where(both, 2 + 0 * total, total)
        return pack(xp, [free / total, occupied / total], a)
    return _by_evidence(xp, a, parts, dogmatic_weights, _sum_of_evidence)


def cumulative_epistemic(
    a: Array, b: Array | None = None, *, axis: int | None = None, base_rate: Any = 0.5
) -> Array:
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
        `part` must not hold more evidence than `fused`. Where both are dogmatic, anything could have been the
        rest, and the vacuous mass is returned.

    Raises
    ------
    ValueError
        If a numpy `part` holds more evidence than `fused`, beyond rounding.
    """
    check_alike(fused, part, ("fused", "part"))
    xp = namespace(fused)
    f, o, u = split(fused, "fused")
    g, p, v = split(part, "part")
    free, occupied = f * v - g * u, o * v - p * u
    if xp is np:
        least = np.minimum(free, occupied)
        if least.size and not least.min() >= -tolerance_of(fused):
            index = tuple(int(i) for i in np.unravel_index(int(least.argmin()), least.shape))
            raise ValueError(
                f"part must not hold more evidence than fused, but at {list(index)} it does: what remains, "
                f"times both unknowns, is {least[index]} (tolerance {tolerance_of(fused):g})"
            )
    open_question = (u <= rounding(fused)) & (v <= rounding(fused))
    free, occupied = (
        xp.where(open_question, 0.0, free.clip(0)),
        xp.where(open_question, 0.0, occupied.clip(0)),
    )
    total = free + occupied + u * v
    total = total + (total == 0)
    return pack(xp, [free / total, occupied / total], fused)


def averaging(
    a: Array,
    b: Array | None = None,
    *,
    axis: int | None = None,
    dogmatic_weights: Sequence[float] | None = None,
) -> Array:
    """Fuse dependent observations by averaging fusion: the mean of the evidence.

    Commutative and idempotent, not associative (a stack is averaged in one go); vacuous is not neutral.

    Parameters
    ----------
    a, b, axis, dogmatic_weights
        As for `cumulative`.
    """
    xp, parts = sources(a, b, axis)
    return _by_evidence(xp, a, parts, dogmatic_weights, _mean_of_evidence)


def weighted(
    a: Array,
    b: Array | None = None,
    *,
    axis: int | None = None,
    dogmatic_weights: Sequence[float] | None = None,
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
    check_alike(a, b)
    f, o, u = split(a)
    g, p, v = split(b)
    return _weighted_rate(a, base_rate_a, base_rate_b, v * (f + o), u * (g + p))


def confidence_base_rate(a: Array, b: Array, base_rate_a: Any, base_rate_b: Any) -> Array:
    """Return the base rate of the weighted or belief constraint fusion of two masses.

    The mean weighted by confidence, (a_A (1 - u_A) + a_B (1 - u_B)) / (2 - u_A - u_B); the plain mean where
    both masses are vacuous.

    Parameters
    ----------
    a, b : (..., 2) float32 or float64, numpy or torch
    base_rate_a, base_rate_b : float or (...) array
        Base rates of occupied, in [0, 1].
    """
    check_alike(a, b)
    f, o, _ = split(a)
    g, p, _ = split(b)
    return _weighted_rate(a, base_rate_a, base_rate_b, f + o, g + p)


def _weighted_rate(mass: Any, rate_a: Any, rate_b: Any, weight_a: Any, weight_b: Any) -> Any:
    xp = namespace(mass)
    first, second = like(rate_a, weight_a, "base_rate_a"), like(rate_b, weight_a, "base_rate_b")
    total = weight_a + weight_b
    none = total <= rounding(mass)
    mean = (weight_a * first + weight_b * second) / (total + none)
    return per_cell(xp.where(none, 0.5 * (first + second) + 0 * total, mean), mass)


def _by_evidence(
    xp: Any, mass: Any, parts: list[tuple[Any, Any, Any]], weights: Sequence[float] | None, combine: Any
) -> Any:
    """Fuse n sources in terms of b / u, evidence over prior weight; average the dogmatic ones, if any."""
    weights = [1.0] * len(parts) if weights is None else list(weights)
    if len(weights) != len(parts) or not all(0 < weight < float("inf") for weight in weights):
        raise ValueError(
            f"dogmatic_weights must be {len(parts)} positive numbers, one per source, got {weights}"
        )
    dogmatic = [u <= rounding(mass) for _, _, u in parts]
    if not any(anywhere(xp, here) for here in dogmatic):
        return pack(xp, list(combine(parts)), mass)
    # Where some are dogmatic, their weighted mean; elsewhere the rule (with a stand-in for u = 0).
    share = [weight * (here + 0 * u) for weight, here, (*_, u) in zip(weights, dogmatic, parts, strict=True)]
    free = sum(s * f for s, (f, _, _) in zip(share, parts, strict=True))
    occupied = sum(s * o for s, (_, o, _) in zip(share, parts, strict=True))
    total: Any = sum(share)
    some = total > 0
    total = total + ~some
    fused = combine([(f, o, u + here) for here, (f, o, u) in zip(dogmatic, parts, strict=True)])
    return pack(
        xp, [xp.where(some, free / total, fused[0]), xp.where(some, occupied / total, fused[1])], mass
    )


def _sum_of_evidence(parts: list[tuple[Any, Any, Any]]) -> tuple[Any, Any]:
    free = sum(f / u for f, _, u in parts)
    occupied = sum(o / u for _, o, u in parts)
    return free / (1 + free + occupied), occupied / (1 + free + occupied)


def _mean_of_evidence(parts: list[tuple[Any, Any, Any]]) -> tuple[Any, Any]:
    free = sum(f / u for f, _, u in parts) / len(parts)
    occupied = sum(o / u for _, o, u in parts) / len(parts)
    return free / (1 + free + occupied), occupied / (1 + free + occupied)


def _confident_mean_of_evidence(parts: list[tuple[Any, Any, Any]]) -> tuple[Any, Any]:
    confidence = sum(f + o for f, o, _ in parts)
    free = sum((f + o) * f / u for f, o, u in parts)
    occupied = sum((f + o) * o / u for f, o, u in parts)
    total = confidence + free + occupied
    total = total + (total == 0)
    return free / total, occupied / total
