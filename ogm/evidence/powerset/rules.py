"""Combination rules on frames of up to 6 states, two sources at a time.

The same rules as in `ogm.evidence`, from their general definitions and not from closed forms: there they are
the slow twin that the fast rules are tested against, and they serve frames such as {free, static, dynamic}.
All take and return mass functions ``[..., 2**K]``.
"""

from collections.abc import Callable
from functools import reduce
from typing import Any

import numpy as np

from ogm.evidence.arrays import (
    Array,
    anywhere,
    broadcast,
    check_alike,
    dtype_name,
    namespace,
    rounding,
    tolerance_of,
)
from ogm.evidence.open_world import refuse_no_conflict
from ogm.evidence.powerset.transforms import (
    Columns,
    difference_subsets,
    difference_supersets,
    split_columns,
    stack,
    sum_subsets,
    sum_supersets,
)
from ogm.evidence.rules import OnConflict, check_policy, refuse_total_conflict

__all__ = [
    "averaging",
    "bold",
    "cautious",
    "conjunctive",
    "consensus_compromise",
    "cumulative",
    "dempster",
    "disjunctive",
    "dubois_prade",
    "murphy",
    "pcr5",
    "weighted",
    "yager",
]


def conjunctive(a: Array, b: Array) -> Array:
    """Combine by the unnormalised conjunctive rule: commonalities multiply.

    Parameters
    ----------
    a, b : (..., 2**K) float32 or float64, numpy or torch
        Mass functions on one frame.

    Returns
    -------
    (..., 2**K); conflict is the mass on the empty set, place 0
    """
    return stack(_conjunctive(*_two(a, b)), a)


def disjunctive(a: Array, b: Array) -> Array:
    """Combine by the disjunctive rule: implicabilities multiply."""
    first, second = _two(a, b)
    below = zip(sum_subsets(first), sum_subsets(second), strict=True)
    return stack(_rounded(difference_subsets([p * q for p, q in below])), a)


def dempster(a: Array, b: Array, *, on_conflict: OnConflict = "average") -> Array:
    """Combine by Dempster's rule: conjunctive, divided by the sum of what survives.

    Parameters
    ----------
    a, b : (..., 2**K) float32 or float64, numpy or torch
        Mass functions on one frame.
    on_conflict : {"average", "vacuous", "nan", "raise"}
        What to return where nothing survives: the mean of the sources, all mass on the frame, NaN, or an
        error.
    """
    check_policy(on_conflict)
    first, second = _two(a, b)
    xp = namespace(a)
    joint = _conjunctive(first, second)
    surviving = _total(joint[1:])
    # What the transforms leave of nothing is rounding: as good as nothing.
    none = surviving <= len(joint) * np.finfo(dtype_name(a)).eps
    if not anywhere(xp, none):
        return stack([0 * surviving, *(column / surviving for column in joint[1:])], a)
    refuse_total_conflict(none, on_conflict)
    surviving = xp.where(none, 1 + 0 * surviving, surviving)
    columns = [0 * surviving, *(column / surviving for column in joint[1:])]
    whole = len(columns) - 1
    for place in range(len(columns)):
        if on_conflict == "average":
            fill = 0.5 * (first[place] + second[place])
        else:
            fill = (float("nan") if on_conflict == "nan" else float(place == whole)) + 0 * surviving
        columns[place] = xp.where(none, fill, columns[place])
    return stack(columns, a)


def yager(a: Array, b: Array) -> Array:
    """Combine by Yager's rule: conflict goes to the whole frame."""
    joint = _conjunctive(*_two(a, b))
    return stack([0 * joint[0], *joint[1:-1], joint[-1] + joint[0]], a)


def dubois_prade(a: Array, b: Array) -> Array:
    """Combine by Dubois and Prade's rule: the conflict of A and B goes to their union."""
    first, second = _two(a, b)
    result: Columns = [0 * column for column in first]
    for place_a, mass_a in enumerate(first):
        for place_b, mass_b in enumerate(second):
            place = place_a & place_b or place_a | place_b
            result[place] = result[place] + mass_a * mass_b
    return stack(result, a)


def pcr5(a: Array, b: Array) -> Array:
    """Combine by PCR5 (= PCR6 = PCR6+ for two sources): conflict goes back to its two sets, in proportion."""
    first, second = _two(a, b)
    xp = namespace(a)
    result = _conjunctive(first, second)
    result[0] = first[0] + second[0] - first[0] * second[0]  # conflict that was there before has no parties
    for place_a, mass_a in enumerate(first):
        for place_b, mass_b in enumerate(second):
            if place_a & place_b or not (place_a and place_b):
                continue
            both = mass_a + mass_b
            none = both == 0
            share = mass_a * mass_b / (both + none if anywhere(xp, none) else both)
            result[place_a] = result[place_a] + share * mass_a
            result[place_b] = result[place_b] + share * mass_b
    return stack(result, a)


def murphy(a: Array, b: Array) -> Array:
    """Combine by Murphy's rule: the mean of both, combined with itself by Dempster's rule."""
    mean = stack([0.5 * (p + q) for p, q in zip(*_two(a, b), strict=True)], a)
    return dempster(mean, mean)


def cautious(a: Array, b: Array) -> Array:
    """Combine by the cautious rule: the smaller of the conjunctive weights.

    As in `ogm.evidence.cautious`, the mass of the whole frame is read as at least 1e-6 (float32) or 1e-12
    (float64). The result is not normalised.
    """
    return stack(_cautious(*_two(a, b), a), a)


def bold(a: Array, b: Array) -> Array:
    """Combine by the bold disjunctive rule: `cautious` on complements. Needs conflict > 0 in both."""
    first, second = _two(a, b)
    if namespace(a) is np:
        refuse_no_conflict([first[0], second[0]])
    return stack(_cautious(first[::-1], second[::-1], a)[::-1], a)


def cumulative(a: Array, b: Array) -> Array:
    """Fuse hyper-opinions by cumulative fusion; the mass of the whole frame is their unknown."""
    return _fuse(a, b, lambda u, v: (v, u), lambda u, v: u + v - u * v)


def averaging(a: Array, b: Array) -> Array:
    """Fuse hyper-opinions by averaging fusion; the mass of the whole frame is their unknown."""
    return _fuse(a, b, lambda u, v: (v, u), lambda u, v: u + v)


def weighted(a: Array, b: Array) -> Array:
    """Fuse hyper-opinions by weighted fusion; the mass of the whole frame is their unknown."""
    return _fuse(a, b, lambda u, v: ((1 - u) * v, (1 - v) * u), lambda u, v: u + v - 2 * u * v)


def consensus_compromise(a: Array, b: Array) -> Array:
    """Fuse hyper-opinions by consensus & compromise, with relative base rates |A and B| / |B|.

    van der Heijden, Kopp and Kargl (2018); where nothing is left to share, the rest is unknown.
    """
    first, second = _two(a, b)
    xp = namespace(a)
    agreed = [xp.minimum(p, q) for p, q in zip(first[:-1], second[:-1], strict=True)]
    rest_a = [p - c for p, c in zip(first[:-1], agreed, strict=True)]
    rest_b = [q - c for q, c in zip(second[:-1], agreed, strict=True)]
    compromise: Columns = [p * second[-1] + q * first[-1] for p, q in zip(rest_a, rest_b, strict=True)]
    compromise.append(0 * first[-1])
    for place_a, p in enumerate(rest_a):
        for place_b, q in enumerate(rest_b):
            if not (place_a and place_b):
                continue
            shared, union = place_a & place_b, place_a | place_b
            rate = shared.bit_count() ** 2 / (place_a.bit_count() * place_b.bit_count())
            compromise[union] = compromise[union] + (1 - rate) * p * q
            if shared:
                compromise[shared] = compromise[shared] + rate * p * q
    unknown = first[-1] * second[-1]
    left = (1 - _total(agreed) - unknown).clip(0)
    total = _total(compromise)
    share = left / (total + (total == 0))
    result = [c + share * x for c, x in zip(agreed, compromise[:-1], strict=True)]
    return stack([*result, 1 - _total(result)], a)


def _two(a: Any, b: Any) -> tuple[Columns, Columns]:
    first, second = split_columns(a, "a"), split_columns(b, "b")
    check_alike(a, b)
    if len(first) != len(second):
        raise ValueError(
            f"a and b must be on one frame, got {len(first)} and {len(second)} subsets on their last axes"
        )
    if tuple(a.shape) == tuple(b.shape):
        return first, second
    pairs = [broadcast(namespace(a), [p, q]) for p, q in zip(first, second, strict=True)]
    return [pair[0] for pair in pairs], [pair[1] for pair in pairs]


def _total(columns: Columns) -> Any:
    return reduce(lambda p, q: p + q, columns)


def _rounded(columns: Columns) -> Columns:
    """Set to zero what differences of sums left below it: the exact result is a sum of products."""
    return [column.clip(0) for column in columns]


def _conjunctive(first: Columns, second: Columns) -> Columns:
    above = zip(sum_supersets(first), sum_supersets(second), strict=True)
    return _rounded(difference_supersets([p * q for p, q in above]))


def _cautious(first: Columns, second: Columns, mass: Any) -> Columns:
    xp = namespace(mass)
    log_first, log_second = _log_weights(first, mass), _log_weights(second, mass)
    least = [xp.minimum(p, q) for p, q in zip(log_first, log_second, strict=True)]
    # A simple mass function A^w has commonality 1 inside A and w elsewhere.
    least.append(0 * least[0])
    inside = sum_supersets(least)
    log_commonality = [inside[0] - column for column in inside]
    # The empty set is inside every A: its commonality is 1.
    return _rounded(difference_supersets([xp.exp(column) for column in log_commonality]))


def _log_weights(columns: Columns, mass: Any) -> Columns:
    """Return ln w(A) of Smets' canonical decomposition for all A but the whole frame."""
    xp = namespace(mass)
    dogmatic_safe = [*columns[:-1], columns[-1].clip(tolerance_of(mass))]
    logs = [xp.log(q) for q in [1 + 0 * columns[0], *sum_supersets(dogmatic_safe)[1:]]]
    return [-column for column in difference_supersets(logs)[:-1]]


def _fuse(
    a: Any, b: Any, weights: Callable[[Any, Any], tuple[Any, Any]], total: Callable[[Any, Any], Any]
) -> Any:
    """Weight beliefs by the other's unknown; two dogmatic sources have equal weight, two vacuous stay so."""
    first, second = _two(a, b)
    xp = namespace(a)
    u, v = first[-1], second[-1]
    dogmatic = (u <= rounding(a)) & (v <= rounding(a))
    weight_a, weight_b = (xp.where(dogmatic, 1 + 0 * w, w) for w in weights(u, v))
    scale = xp.where(dogmatic, 2 + 0 * u, total(u, v))
    scale = scale + (scale == 0)
    result = [(weight_a * p + weight_b * q) / scale for p, q in zip(first[:-1], second[:-1], strict=True)]
    return stack([*result, 1 - _total(result)], a)
