"""Rules that share conflict out to those who caused it: PCR5, PCR6, PCR6+, and Murphy's average.

For two sources PCR5, PCR6 and PCR6+ are one and the same rule. None of them is associative: a stack is
combined in one go, and a chain of pairs is not the rule and depends on the order.

Sources: Smarandache and Dezert, *Advances and Applications of DSmT*, vol. 2 (2006), PCR5; Martin and Osswald,
same volume, PCR6; Dezert, Dezert and Smarandache, "Improvement of proportional conflict redistribution rules
of combination of basic belief assignments" (2021), PCR6+; Murphy, "Combining belief functions when evidence
conflicts" (2000).
"""

from collections.abc import Callable
from itertools import product
from math import prod
from typing import Any

from ogm.evidence.arrays import Array, anywhere, pack, sources

__all__ = ["murphy", "pcr5", "pcr6", "pcr6_plus"]

_MOST_SOURCES = 8  # 3^8 products of masses
_UNKNOWN = 2  # place of the unknown in (free, occupied, unknown)


def pcr5(a: Array, b: Array | None = None, *, axis: int | None = None) -> Array:
    """Combine by PCR5: each conflicting product goes back to its states, in proportion to their products.

    Commutative, not associative; vacuous is neutral for two sources, not for more.

    Parameters
    ----------
    a, b : (..., 2) float32 or float64, numpy or torch
        Masses (free, occupied). Without `b`, `a` is a stack of sources along `axis`.
    axis : int, optional
        The leading axis of `a` that counts the sources, at most 8: the work grows as 3^sources.

    Returns
    -------
    (..., 2), the combined mass
    """
    return _redistribute(a, b, axis, _in_proportion_to_products)


def pcr6(a: Array, b: Array | None = None, *, axis: int | None = None) -> Array:
    """Combine by PCR6: each conflicting product goes back to its sources, in proportion to their masses.

    Commutative, not associative; vacuous is neutral for two sources, not for more.

    Parameters
    ----------
    a, b, axis
        As for `pcr5`.
    """
    return _redistribute(a, b, axis, _in_proportion_to_sums)


def pcr6_plus(a: Array, b: Array | None = None, *, axis: int | None = None) -> Array:
    """Combine by PCR6+: as PCR6, but only to sources that take part in the conflict.

    A source that says "unknown" in a product has no share in its conflict, so the vacuous mass is neutral for
    any number of sources. Commutative, not associative.

    Parameters
    ----------
    a, b, axis
        As for `pcr5`.
    """
    return _redistribute(a, b, axis, _in_proportion_to_sums_of_the_conflicting)


def murphy(a: Array, b: Array | None = None, *, axis: int | None = None) -> Array:
    """Combine by Murphy's rule: Dempster's rule on n copies of the mean of the n masses.

    Commutative, not associative, vacuous is not neutral. Total conflict cannot happen.

    Parameters
    ----------
    a, b : (..., 2) float32 or float64, numpy or torch
        Masses (free, occupied). Without `b`, `a` is a stack of sources along `axis`.
    axis : int, optional
        The leading axis of `a` that counts the sources.

    Returns
    -------
    (..., 2), the combined mass
    """
    xp, parts = sources(a, b, axis)
    n = len(parts)
    free, occupied, unknown = (sum(numbers) / n for numbers in zip(*parts, strict=True))
    # Commonalities multiply; scaled by the greater one, n of them neither overflow nor vanish.
    greater = xp.maximum(free, occupied) + unknown
    q_free, q_occupied = ((free + unknown) / greater) ** n, ((occupied + unknown) / greater) ** n
    q_whole = (unknown / greater) ** n
    total = q_free + q_occupied - q_whole
    return pack(xp, [(q_free - q_whole) / total, (q_occupied - q_whole) / total], a)


def _redistribute(a: Any, b: Any, axis: int | None, share: Callable[..., list[Any]]) -> Any:
    """Sum over all ways in which every source picks a state; conflicting ones are shared out by `share`."""
    xp, parts = sources(a, b, axis)
    if len(parts) > _MOST_SOURCES:
        raise ValueError(
            f"PCR takes at most {_MOST_SOURCES} sources, got {len(parts)}; "
            f"combine in groups, or use an associative rule"
        )
    totals: list[Any] = [0 * parts[0][0], 0 * parts[0][0]]
    for states in product((0, 1, _UNKNOWN), repeat=len(parts)):
        picked = [part[state] for part, state in zip(parts, states, strict=True)]
        weight = prod(picked[1:], start=picked[0])
        if 0 in states and 1 in states:  # conflict
            parts_of_it = share(states, picked)
            whole = sum(parts_of_it)
            none = whole == 0
            weight = weight / (whole + none if anywhere(xp, none) else whole)
            totals = [total + weight * part for total, part in zip(totals, parts_of_it, strict=False)]
        elif 0 in states or 1 in states:  # agreement
            state = 0 if 0 in states else 1
            totals[state] = totals[state] + weight
    return pack(xp, totals, a)


def _in_proportion_to_products(states: tuple[int, ...], picked: list[Any]) -> list[Any]:
    shares = []
    for wanted in (0, 1, _UNKNOWN):
        mine = [mass for state, mass in zip(states, picked, strict=True) if state == wanted]
        shares.append(prod(mine[1:], start=mine[0]) if mine else 0 * picked[0])
    return shares


def _in_proportion_to_sums(states: tuple[int, ...], picked: list[Any]) -> list[Any]:
    return [
        sum(
            (mass for state, mass in zip(states, picked, strict=True) if state == wanted), start=0 * picked[0]
        )
        for wanted in (0, 1, _UNKNOWN)
    ]


def _in_proportion_to_sums_of_the_conflicting(states: tuple[int, ...], picked: list[Any]) -> list[Any]:
    return _in_proportion_to_sums(states, picked)[:_UNKNOWN]
