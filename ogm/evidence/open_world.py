"""Rules of the open world, in which conflict is kept as mass on the empty set.

They return triples ``(free, occupied, conflict)`` and take triples and pairs; a pair is a triple without
conflict. Without the conflict, the pair of the conjunctive rule would be numerically Yager's, and the unknown
derived from it would include the conflict. `close_world` returns pairs. All four rules are associative.

Sources: Smets and Kennes, "The transferable belief model" (1994); Smets, "Belief functions: the disjunctive
rule of combination" (1993); Denœux, "Conjunctive and disjunctive combination of belief functions induced by
nondistinct bodies of evidence" (2008).
"""

from collections.abc import Iterable
from functools import reduce
from typing import Any

import numpy as np

from ogm.evidence.arrays import Array, first_index, namespace, open_sources, split_open, stack_last, tolerance_of
from ogm.evidence.rules import OnConflict, check_policy, normalized, resolve


def conjunctive(a: Array, b: Array | None = None, *, axis: int | None = None) -> Array:
    """Combine by the unnormalised conjunctive rule of the transferable belief model.

    Commutative and associative; the vacuous mass is neutral. Conflict is kept as mass on the empty set.

    Parameters
    ----------
    a, b : (..., 2) or (..., 3) float32 or float64, numpy or torch
        Pairs (free, occupied) or triples (free, occupied, conflict). Without `b`, `a` is a stack along
        `axis`.
    axis : int, optional
        The leading axis of `a` that counts the sources.

    Returns
    -------
    (..., 3), (free, occupied, conflict); unknown is 1 minus their sum
    """
    xp, parts = open_sources(a, b, axis)
    free, occupied, unknown, conflict = parts[0]
    for f, o, u, c in parts[1:]:
        free, occupied, unknown, conflict = (
            free * (f + u) + unknown * f,
            occupied * (o + u) + unknown * o,
            unknown * u,
            free * o + occupied * f + conflict + c - conflict * c,
        )
    return stack_last(xp, [free, occupied, conflict], a)


def disjunctive(a: Array, b: Array | None = None, *, axis: int | None = None) -> Array:
    """Combine by the disjunctive rule: at least one source is reliable, it is not known which.

    Commutative and associative; vacuous is absorbing, and total conflict (all mass on the empty set) is
    neutral. Never produces conflict.

    Parameters
    ----------
    a, b : (..., 2) or (..., 3) float32 or float64, numpy or torch
        Pairs (free, occupied) or triples (free, occupied, conflict). Without `b`, `a` is a stack along
        `axis`.
    axis : int, optional
        The leading axis of `a` that counts the sources.

    Returns
    -------
    (..., 2) if all sources are pairs, else (..., 3)
    """
    xp, parts = open_sources(a, b, axis)
    free, occupied, _, conflict = parts[0]
    for f, o, _, c in parts[1:]:
        free, occupied, conflict = (free * (f + c) + conflict * f, occupied * (o + c) + conflict * o, conflict * c)
    closed = all(mass.shape[-1] == 2 for mass in (a, b) if mass is not None)  # type: ignore[attr-defined]
    return stack_last(xp, [free, occupied] if closed else [free, occupied, conflict], a)


def cautious(a: Array, b: Array | None = None, *, axis: int | None = None) -> Array:
    """Combine dependent sources by Denœux's cautious rule: the least committed that is as informed as each.

    Commutative, associative and idempotent; repeated evidence counts once. Vacuous is neutral only
    for separable masses (at most one state believed); in general the result is a w-least committed one.

    Parameters
    ----------
    a, b : (..., 2) or (..., 3) float32 or float64, numpy or torch
        Pairs (free, occupied) or triples (free, occupied, conflict). Without `b`, `a` is a stack along
        `axis`.
    axis : int, optional
        The leading axis of `a` that counts the sources.

    Returns
    -------
    (..., 3), (free, occupied, conflict); `close_world` normalises it

    Notes
    -----
    Undefined for unknown = 0: unknown is read as at least 1e-6 (float32) or 1e-12 (float64).
    """
    xp, parts = open_sources(a, b, axis)
    weights = (_weights(free, occupied, unknown.clip(tolerance_of(a))) for free, occupied, unknown, _ in parts)
    w_free, w_occupied, w_empty = _least(xp, weights)
    free = (1 - w_free) * w_occupied * w_empty
    occupied = (1 - w_occupied) * w_free * w_empty
    conflict = (1 - free - occupied - w_free * w_occupied * w_empty).clip(0)
    return stack_last(xp, [free, occupied, conflict], a)


def bold(a: Array, b: Array | None = None, *, axis: int | None = None) -> Array:
    """Combine dependent sources by Denœux's bold disjunctive rule, the dual of `cautious`.

    Commutative, associative and idempotent. Defined only for masses with conflict > 0.

    Parameters
    ----------
    a, b : (..., 3) float32 or float64, numpy or torch
        Triples (free, occupied, conflict). Without `b`, `a` is a stack of sources along `axis`.
    axis : int, optional
        The leading axis of `a` that counts the sources.

    Returns
    -------
    (..., 3), (free, occupied, conflict)

    Raises
    ------
    ValueError
        If a source of a numpy array has no conflict in some cell.
    """
    xp, parts = open_sources(a, b, axis, states=(3,))
    if xp is np:
        refuse_no_conflict([conflict for *_, conflict in parts])
    w_free, w_occupied, w_whole = _least(
        xp, (_weights(free, occupied, conflict) for free, occupied, _, conflict in parts)
    )
    free = (1 - w_free) * w_occupied * w_whole
    occupied = (1 - w_occupied) * w_free * w_whole
    return stack_last(xp, [free, occupied, w_free * w_occupied * w_whole], a)


def close_world(open_mass: Array, *, on_conflict: OnConflict = "average") -> Array:
    """Return the closed-world pair of an open-world triple: Dempster's normalisation.

    Parameters
    ----------
    open_mass : (..., 3) float32 or float64, numpy or torch
        Triples (free, occupied, conflict).
    on_conflict : {"average", "vacuous", "nan", "raise"}
        What to return where conflict is 1. The sources are not known here: "average" is (0.5, 0.5), the limit
        of two equally strong ones.

    Returns
    -------
    (..., 2), masses (free, occupied)

    Notes
    -----
    Conflict near 1 leaves few digits for the rest: in float32, ``close_world(conjunctive(a, b))`` is good to
    6e-8 / (1 - conflict) at best. `dempster` has no such loss, as it never forms the conflict.
    """
    check_policy(on_conflict)
    xp = namespace(open_mass)
    free, occupied, unknown, _ = split_open(open_mass, "open_mass", states=(3,))
    free, occupied, _, none = normalized(xp, free, occupied, unknown)
    return resolve(xp, open_mass, free, occupied, none, (0.5, 0.5), on_conflict)


def refuse_no_conflict(conflicts: list[Any]) -> None:
    """Raise if a source of the bold rule, given by its conflict in every cell, has none somewhere."""
    for number, conflict in enumerate(conflicts):
        none = ~(np.asarray(conflict) > 0)
        if none.any():
            raise ValueError(
                f"the bold rule needs conflict > 0 in every cell of every source, but source {number} has none in "
                f"{int(none.sum())} cells, the first at {first_index(none)}; use disjunctive without conflict"
            )


def _least(xp: Any, weights: Iterable[tuple[Any, ...]]) -> list[Any]:
    """Return the least weight of each set over the sources."""
    return [reduce(xp.minimum, column) for column in zip(*weights, strict=True)]


def _weights(free: Any, occupied: Any, base: Any) -> tuple[Any, Any, Any]:
    """Return the weights of the canonical decomposition: of free, of occupied, and of the set opposite to the base.

    With unknown as base these are Smets' conjunctive weights, the last that of the empty set; with conflict as base
    the disjunctive ones, the last that of the whole frame.
    """
    return base / (free + base), base / (occupied + base), (free + base) * (occupied + base) / base
