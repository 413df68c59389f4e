"""Combination rules on frames of up to 6 states, for several masses or a stack of sources and its axis.

The rules of `ogm.evidence` from their general definitions, as a reference in the tests of the rules on pairs. All take
and return mass functions ``[..., 2**K]``.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import reduce
from itertools import product
from operator import and_, mul, or_
from typing import Any

import numpy as np

from ogm.evidence.arrays import Array, dtype_name, each_source, first_index, maybe_any, namespace, tolerance_of
from ogm.evidence.powerset.transforms import (
    difference_subsets,
    difference_supersets,
    masses_of,
    stack,
    sum_subsets,
    sum_supersets,
)
from ogm.evidence.rules import OnConflict, check_policy, refuse_total_conflict
from ogm.evidence.subjective import (
    Combine,
    confident_mean_of_evidence,
    fuse_by_evidence,
    mean_of_evidence,
    sum_of_evidence,
)

__all__ = [
    "averaging", "bold", "cautious", "conjunctive", "consensus_compromise", "cumulative", "dempster", "disjunctive",
    "dubois_prade", "murphy", "pcr5", "pcr6", "weighted", "yager",
]  # fmt: skip

MAX_CHOICES = 2**16  # greatest number of combinations of sets of all sources


def conjunctive(*masses: Array, axis: int | None = None) -> Array:
    """Combine by the unnormalised conjunctive rule: commonalities multiply; conflict has index 0."""
    return stack(_conjunctive(_each(masses, axis)), masses[0])


def disjunctive(*masses: Array, axis: int | None = None) -> Array:
    """Combine by the disjunctive rule: implicabilities multiply."""
    together = _product(map(sum_subsets, _each(masses, axis)))
    return stack(difference_subsets(together).clip(0), masses[0])


def dempster(*masses: Array, axis: int | None = None, on_conflict: OnConflict = "average") -> Array:
    """Combine by Dempster's rule: the conjunctive rule, normalised by 1 - conflict.

    In total conflict the result depends on `on_conflict`: "average" is the mean of the sources, "vacuous" all mass on
    the frame, "nan" NaN, and "raise" an error.
    """
    check_policy(on_conflict)
    parts, xp = _each(masses, axis), namespace(masses[0])
    result, none = parts[0], parts[0][0] < 0  # a single source does not change
    for part in parts[1:]:  # normalised after each source, so that many sources do not underflow
        joint = _conjunctive([result, part])
        surviving = joint[1:].sum(0)
        # The transforms may leave rounding errors in place of 0
        total = surviving <= len(joint) * np.finfo(dtype_name(masses[0])).eps
        result = xp.stack([0 * surviving, *(joint[1:] / xp.where(total, 1 + 0 * surviving, surviving))])
        none = none | total
    refuse_total_conflict(none, on_conflict)
    columns = list(result)
    if maybe_any(xp, none):
        average = sum(parts) / len(parts)
        for place in range(len(columns)):
            fill = float("nan") if on_conflict == "nan" else float(place == len(columns) - 1)
            instead = average[place] if on_conflict == "average" else fill + 0 * columns[place]
            columns[place] = xp.where(none, instead, columns[place])
    return stack(columns, masses[0])


def yager(*masses: Array, axis: int | None = None) -> Array:
    """Combine by Yager's rule: conflict goes to the whole frame."""
    joint = _conjunctive(_each(masses, axis))
    return stack([0 * joint[0], *joint[1:-1], joint[-1] + joint[0]], masses[0])


def dubois_prade(*masses: Array, axis: int | None = None) -> Array:
    """Combine by Dubois and Prade's rule: the conflict of disjoint sets goes to their union."""
    parts = _each(masses, axis)
    result = [0 * column for column in parts[0]]
    for places, picked in _choices(parts):
        place = reduce(and_, places) or reduce(or_, places)
        result[place] = result[place] + _product(picked)
    return stack(result, masses[0])


def pcr5(*masses: Array, axis: int | None = None) -> Array:
    """Combine by PCR5: conflict returns to its sets, in proportion to the products of their masses."""
    return _redistributed(masses, axis, _grouped)


def pcr6(*masses: Array, axis: int | None = None) -> Array:
    """Combine by PCR6: conflict returns to its sets, in proportion to the mass of each source."""
    return _redistributed(masses, axis, zip)


def murphy(*masses: Array, axis: int | None = None) -> Array:
    """Combine by Murphy's rule: Dempster's rule on n copies of the mean of n masses."""
    parts = _each(masses, axis)
    mean = stack(sum(parts) / len(parts), masses[0])
    return dempster(*[mean] * len(parts)) if len(parts) > 1 else mean


def cautious(*masses: Array, axis: int | None = None) -> Array:
    """Combine by the cautious rule: the minimum of the conjunctive weights, not normalised.

    The mass of the frame is read as at least 1e-6 (float32) or 1e-12 (float64), as in `ogm.evidence.cautious`.
    """
    return stack(_cautious(_each(masses, axis), masses[0]), masses[0])


def bold(*masses: Array, axis: int | None = None) -> Array:
    """Combine by Denœux's bold disjunctive rule: `cautious` on complements; all sources need conflict > 0."""
    xp, parts = namespace(masses[0]), _each(masses, axis)
    for number, part in enumerate(parts if xp is np else ()):
        if not (part[0] > 0).all():
            none = ~(part[0] > 0)
            raise ValueError(
                f"the bold rule needs conflict > 0 in every cell of every source, but in source {number} it is 0 in "
                f"{int(none.sum())} cells, the first at {first_index(none)}; for such masses use disjunctive"
            )
    complements = [xp.stack(list(part)[::-1]) for part in parts]
    return stack(list(_cautious(complements, masses[0]))[::-1], masses[0])


def cumulative(*masses: Array, axis: int | None = None) -> Array:
    """Fuse hyper-opinions by cumulative fusion; the mass of the whole frame is their unknown."""
    return _fused(masses, axis, sum_of_evidence)


def averaging(*masses: Array, axis: int | None = None) -> Array:
    """Fuse hyper-opinions by averaging fusion; the mass of the whole frame is their unknown."""
    return _fused(masses, axis, mean_of_evidence)


def weighted(*masses: Array, axis: int | None = None) -> Array:
    """Fuse hyper-opinions by weighted fusion; the mass of the whole frame is their unknown."""
    return _fused(masses, axis, confident_mean_of_evidence)


def consensus_compromise(a: Array, b: Array) -> Array:
    """Fuse two hyper-opinions by consensus & compromise, with relative base rates |A and B| / |B|.

    See van der Heijden, Kopp and Kargl (2018). If no residue remains to share, the rest is unknown.
    """
    first, second = _each([a, b], None)
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


def _each(masses: Sequence[Any], axis: int | None) -> list[Any]:
    """Return the columns of each source, (2**K, ...), of the same shape."""
    xp, sources = each_source(masses, axis, masses_of)
    counts = [len(source) for source in sources]
    if len(set(counts)) > 1:
        raise ValueError(
            f"a and b must be on one frame, got {' and '.join(map(str, counts))} subsets on their last axes"
        )
    shapes = [tuple(source[0].shape) for source in sources]
    shape = np.broadcast_shapes(*shapes)
    if all(other == shape for other in shapes):
        return [xp.stack(list(source)) for source in sources]
    return [xp.stack([xp.broadcast_to(column, shape) for column in source]) for source in sources]


def _product(factors: Iterable[Any]) -> Any:
    return reduce(mul, factors)


def _conjunctive(parts: Sequence[Any]) -> Any:
    """Return the columns of the conjunction; exact masses are sums of products, so negative numbers are rounding."""
    return difference_supersets(_product(map(sum_supersets, parts))).clip(0)


def _choices(parts: Sequence[Any]) -> Iterator[tuple[tuple[int, ...], list[Any]]]:
    """Yield all choices of a set by each source: the indices of the sets, and their masses."""
    count = len(parts[0]) ** len(parts)
    if count > MAX_CHOICES:
        raise ValueError(
            f"{len(parts)} sources on {len(parts[0])} sets have {count} combinations of sets, more than {MAX_CHOICES}: "
            "combine fewer sources, or coarsen the frame"
        )
    for places in product(range(len(parts[0])), repeat=len(parts)):
        yield places, [part[place] for part, place in zip(parts, places, strict=True)]


def _redistributed(
    masses: Sequence[Array], axis: int | None, shared: Callable[..., Iterable[tuple[int, Any]]]
) -> Array:
    """Share conflicting products among their sets; `shared` converts indices and masses to indices and shares."""
    parts = _each(masses, axis)
    result = list(_conjunctive(parts))
    result[0] = 1 - _product(1 - part[0] for part in parts)  # conflict within a source has no sets to return to
    for places, picked in _choices(parts):
        if all(places) and not reduce(and_, places):
            shares = list(shared(places, picked))
            whole: Any = sum(share for _, share in shares)
            weight = _product(picked) / (whole + (whole == 0))
            for place, share in shares:
                result[place] = result[place] + weight * share
    return stack(result, masses[0])


def _grouped(places: Sequence[int], picked: Sequence[Any]) -> list[tuple[int, Any]]:
    """Return the product of the masses of each set."""
    groups: dict[int, Any] = {}
    for place, mass in zip(places, picked, strict=True):
        groups[place] = groups[place] * mass if place in groups else mass
    return list(groups.items())


def _cautious(parts: Sequence[Any], mass: Any) -> Any:
    xp = namespace(mass)
    # Simple mass functions A^w with the least w; their commonality is 1 inside A and w elsewhere
    least = reduce(xp.minimum, [_log_weights(part, mass) for part in parts])
    inside = sum_supersets(least)
    return difference_supersets(xp.exp(inside[0] - inside)).clip(0)


def _log_weights(columns: Any, mass: Any) -> Any:
    """Return ln w(A) of Smets' canonical decomposition, and 0 for the whole frame."""
    xp = namespace(mass)
    q = sum_supersets(xp.stack([*columns[:-1], columns[-1].clip(tolerance_of(mass))]))
    logs = xp.stack([0 * q[0], *xp.log(q[1:])])  # q of the empty set is 1
    return xp.stack([*-difference_supersets(logs)[:-1], 0 * logs[0]])


def _fused(masses: Sequence[Array], axis: int | None, combine: Combine) -> Array:
    xp, parts = namespace(masses[0]), _each(masses, axis)
    return _with_unknown(fuse_by_evidence(xp, masses[0], parts, combine), masses[0])


def _with_unknown(beliefs: list[Any], mass: Array) -> Array:
    return stack([*beliefs, 1 - sum(beliefs)], mass)
