"""Combination rules on frames of up to 6 states, two sources at a time.

The same rules as in `ogm.evidence`, from their general definitions: the reference that the rules on pairs are tested
against. All take and return mass functions ``[..., 2**K]``.
"""

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np

from ogm.evidence.arrays import Array, check_alike, dtype_name, maybe_any, namespace, rounding, tolerance_of
from ogm.evidence.open_world import refuse_no_conflict
from ogm.evidence.powerset.transforms import (
    difference_subsets,
    difference_supersets,
    masses_of,
    stack,
    sum_subsets,
    sum_supersets,
)
from ogm.evidence.rules import OnConflict, check_policy, refuse_total_conflict

__all__ = [
    "averaging", "bold", "cautious", "conjunctive", "consensus_compromise", "cumulative", "dempster", "disjunctive",
    "dubois_prade", "murphy", "pcr5", "weighted", "yager",
]  # fmt: skip


def conjunctive(a: Array, b: Array) -> Array:
    """Combine by the unnormalised conjunctive rule: commonalities multiply; conflict is at place 0."""
    return stack(_conjunctive(*_two(a, b)), a)


def disjunctive(a: Array, b: Array) -> Array:
    """Combine by the disjunctive rule: implicabilities multiply."""
    first, second = _two(a, b)
    return stack(difference_subsets(sum_subsets(first) * sum_subsets(second)).clip(0), a)


def dempster(a: Array, b: Array, *, on_conflict: OnConflict = "average") -> Array:
    """Combine by Dempster's rule: conjunctive, divided by the sum of the surviving masses.

    In total conflict `on_conflict` decides: "average" is the mean of the sources, "vacuous" all mass on the
    frame, "nan" NaN, and "raise" an error.
    """
    check_policy(on_conflict)
    first, second = _two(a, b)
    xp = namespace(a)
    joint = _conjunctive(first, second)
    surviving = joint[1:].sum(0)
    none = surviving <= len(joint) * np.finfo(dtype_name(a)).eps  # the transforms leave rounding in place of 0
    refuse_total_conflict(none, on_conflict)
    result = [0 * surviving, *(joint[1:] / xp.where(none, 1 + 0 * surviving, surviving))]
    if maybe_any(xp, none):
        whole = len(result) - 1
        for place in range(len(result)):
            fill = float("nan") if on_conflict == "nan" else float(place == whole)
            average = 0.5 * (first[place] + second[place])
            result[place] = xp.where(none, average if on_conflict == "average" else fill + 0 * surviving, result[place])
    return stack(result, a)


def yager(a: Array, b: Array) -> Array:
    """Combine by Yager's rule: conflict goes to the whole frame."""
    joint = _conjunctive(*_two(a, b))
    return stack([0 * joint[0], *joint[1:-1], joint[-1] + joint[0]], a)


def dubois_prade(a: Array, b: Array) -> Array:
    """Combine by Dubois and Prade's rule: the conflict of A and B goes to their union."""
    first, second = _two(a, b)
    result = [0 * column for column in first]
    for (i, p), (j, q) in product(enumerate(first), enumerate(second)):
        place = i & j or i | j
        result[place] = result[place] + p * q
    return stack(result, a)


def pcr5(a: Array, b: Array) -> Array:
    """Combine by PCR5 (= PCR6 = PCR6+ for two sources): conflict goes back to its two sets, in proportion."""
    first, second = _two(a, b)
    result = list(_conjunctive(first, second))
    result[0] = first[0] + second[0] - first[0] * second[0]  # conflict of the sources themselves has no parties
    for (i, p), (j, q) in product(enumerate(first), enumerate(second)):
        if i and j and not i & j:
            share = p * q / (p + q + (p + q == 0))
            result[i], result[j] = result[i] + share * p, result[j] + share * q
    return stack(result, a)


def murphy(a: Array, b: Array) -> Array:
    """Combine by Murphy's rule: the mean of both, combined with itself by Dempster's rule."""
    first, second = _two(a, b)
    mean = stack(0.5 * (first + second), a)
    return dempster(mean, mean)


def cautious(a: Array, b: Array) -> Array:
    """Combine by the cautious rule: the smaller of the conjunctive weights; not normalised.

    As in `ogm.evidence.cautious`, the mass of the frame is read as at least 1e-6 (float32) or 1e-12 (float64).
    """
    return stack(_cautious(*_two(a, b), a), a)


def bold(a: Array, b: Array) -> Array:
    """Combine by the bold disjunctive rule: `cautious` on complements. Needs conflict > 0 in both."""
    first, second = (list(reversed(columns)) for columns in _two(a, b))
    xp = namespace(a)
    if xp is np:
        refuse_no_conflict([first[-1], second[-1]])
    return stack(reversed(_cautious(xp.stack(first), xp.stack(second), a)), a)


def cumulative(a: Array, b: Array) -> Array:
    """Fuse hyper-opinions by cumulative fusion; the mass of the whole frame is their unknown."""
    return _fuse(a, b, lambda u, v: (v, u, u + v - u * v))


def averaging(a: Array, b: Array) -> Array:
    """Fuse hyper-opinions by averaging fusion; the mass of the whole frame is their unknown."""
    return _fuse(a, b, lambda u, v: (v, u, u + v))


def weighted(a: Array, b: Array) -> Array:
    """Fuse hyper-opinions by weighted fusion; the mass of the whole frame is their unknown."""
    return _fuse(a, b, lambda u, v: ((1 - u) * v, (1 - v) * u, u + v - 2 * u * v))


def consensus_compromise(a: Array, b: Array) -> Array:
    """Fuse hyper-opinions by consensus & compromise, with relative base rates |A and B| / |B|.

    van der Heijden, Kopp and Kargl (2018); where no residue is left to share, the rest is unknown.
    """
    first, second = _two(a, b)
    agreed = namespace(a).minimum(first, second)[:-1]
    rest_a, rest_b = first[:-1] - agreed, second[:-1] - agreed
    compromise = [*(rest_a * second[-1] + rest_b * first[-1]), 0 * first[-1]]
    for (i, p), (j, q) in product(enumerate(rest_a), enumerate(rest_b)):
        if i and j:
            rate = (i & j).bit_count() ** 2 / (i.bit_count() * j.bit_count())
            compromise[i | j] = compromise[i | j] + (1 - rate) * p * q
            if i & j:
                compromise[i & j] = compromise[i & j] + rate * p * q
    left = (1 - agreed.sum(0) - first[-1] * second[-1]).clip(0)
    total: Any = sum(compromise)
    share = left / (total + (total == 0))
    return _with_unknown([c + share * x for c, x in zip(agreed, compromise[:-1], strict=True)], a)


def _two(a: Any, b: Any) -> tuple[Any, Any]:
    first, second = masses_of(a, "a"), masses_of(b, "b")
    check_alike(a, b)
    if len(first) != len(second):
        raise ValueError(f"a and b must be on one frame, got {len(first)} and {len(second)} subsets on their last axes")
    if tuple(a.shape) == tuple(b.shape):
        return first, second
    xp = namespace(a)
    both = xp.broadcast_arrays(a, b) if xp is np else xp.broadcast_tensors(a, b)
    return xp.moveaxis(both[0], -1, 0), xp.moveaxis(both[1], -1, 0)


def _conjunctive(first: Any, second: Any) -> Any:
    # The exact result is a sum of products: differences below zero are rounding.
    return difference_supersets(sum_supersets(first) * sum_supersets(second)).clip(0)


def _cautious(first: Any, second: Any, mass: Any) -> Any:
    xp = namespace(mass)
    # Simple mass functions A^w with the least w; one has commonality 1 inside A and w elsewhere.
    least = xp.minimum(_log_weights(first, mass), _log_weights(second, mass))
    inside = sum_supersets(least)
    return difference_supersets(xp.exp(inside[0] - inside)).clip(0)


def _log_weights(columns: Any, mass: Any) -> Any:
    """Return ln w(A) of Smets' canonical decomposition, and 0 for the whole frame."""
    xp = namespace(mass)
    q = sum_supersets(xp.stack([*columns[:-1], columns[-1].clip(tolerance_of(mass))]))
    logs = xp.stack([0 * q[0], *xp.log(q[1:])])  # q of the empty set is 1
    return xp.stack([*-difference_supersets(logs)[:-1], 0 * logs[0]])


def _fuse(a: Array, b: Array, weights: Callable[[Any, Any], tuple[Any, Any, Any]]) -> Array:
    """Weight beliefs by the other's unknown; two dogmatic sources have equal weight, two vacuous stay so."""
    first, second = _two(a, b)
    u, v = first[-1], second[-1]
    dogmatic = (u <= rounding(a)) & (v <= rounding(a))
    weight_a, weight_b, total = (
        namespace(a).where(dogmatic, instead + 0 * u, number)
        for instead, number in zip((1, 1, 2), weights(u, v), strict=True)
    )
    return _with_unknown(list((weight_a * first[:-1] + weight_b * second[:-1]) / (total + (total == 0))), a)


def _with_unknown(beliefs: list[Any], mass: Array) -> Array:
    return stack([*beliefs, 1 - sum(beliefs)], mass)
