"""Consensus & compromise fusion of subjective logic.

Sources: van der Heijden, Kopp and Kargl, "Multi-source fusion operations in subjective logic" (Fusion 2018);
Jøsang, *Subjective Logic* (2016), section 12.6.
"""

from itertools import product
from typing import Any

from ogm.evidence.arrays import Array, pack, sources

__all__ = ["consensus_compromise"]


def consensus_compromise(a: Array, b: Array | None = None, *, axis: int | None = None) -> Array:
    """Fuse by consensus & compromise: keep what all agree on, share out the rest, turn conflict to unknown.

    Commutative and idempotent, vacuous is neutral for two sources; not associative. Discontinuous at
    agreement: two equal masses give themselves, two almost equal ones something far from it. Not for grids by
    default.

    Parameters
    ----------
    a, b, axis
        As for `cumulative`; at most 12 sources, as the work doubles with each.

    Notes
    -----
    Where the sources are equal nothing remains to be shared; their common mass is returned (the published
    formula divides zero by zero there).
    """
    xp, parts = sources(a, b, axis)
    if len(parts) > 12:
        raise ValueError(f"consensus_compromise takes at most 12 sources, got {len(parts)}")
    # Step 1, consensus: the belief that every source has at least.
    agreed_free, agreed_occupied = parts[0][0], parts[0][1]
    for free, occupied, _ in parts[1:]:
        agreed_free, agreed_occupied = xp.minimum(agreed_free, free), xp.minimum(agreed_occupied, occupied)
    rests = [(free - agreed_free, occupied - agreed_occupied) for free, occupied, _ in parts]
    unknowns = [unknown for _, _, unknown in parts]
    # Step 2, compromise: a residue meets the ignorance of all others, or their residues.
    free = _one_against_ignorance(rests, unknowns, 0) + _product([rest[0] for rest in rests])
    occupied = _one_against_ignorance(rests, unknowns, 1) + _product([rest[1] for rest in rests])
    both = 0 * free
    for states in product((0, 1), repeat=len(rests)):
        if 0 in states and 1 in states:
            both = both + _product([rest[state] for rest, state in zip(rests, states, strict=True)])
    # Step 3, normalise: all that is neither agreed nor unknown to everybody is shared out in proportion.
    ignorance = _product(unknowns)
    left = (1 - agreed_free - agreed_occupied - ignorance).clip(0)
    shared = free + occupied + both
    share = left / (shared + (shared == 0))
    return pack(xp, [agreed_free + share * free, agreed_occupied + share * occupied], a)


def _product(numbers: list[Any]) -> Any:
    result = numbers[0]
    for number in numbers[1:]:
        result = result * number
    return result


def _one_against_ignorance(rests: list[tuple[Any, Any]], unknowns: list[Any], state: int) -> Any:
    """Sum over the sources of its residue for a state times the unknown of all others."""
    total = 0 * unknowns[0]
    for i, rest in enumerate(rests):
        total = total + _product([rest[state], *(u for j, u in enumerate(unknowns) if j != i)])
    return total
