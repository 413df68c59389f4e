"""Rules that redistribute conflict: PCR5, PCR6, PCR6+, Murphy's average, consensus & compromise.

For two sources PCR5, PCR6 and PCR6+ are the same rule. The rules are not associative: all sources are combined at once,
and a chain of pairs gives a different result, which depends on the order.

Sources: Smarandache and Dezert, *Advances and Applications of DSmT*, vol. 2 (2006), PCR5; Martin and Osswald,
same volume, PCR6; Dezert, Dezert and Smarandache, "Improvement of proportional conflict redistribution rules
of combination of basic belief assignments" (2021), PCR6+; Murphy, "Combining belief functions when evidence
conflicts" (2000); van der Heijden, Kopp and Kargl, "Multi-source fusion operations in subjective logic" (Fusion 2018).
"""

from collections.abc import Callable, Sequence
from functools import reduce
from itertools import product
from math import prod
from typing import Any

from ogm.evidence.arrays import Array, as_double, maybe_any, rounding, sources, stack_last
from ogm.evidence.kinds import takes_masses

_MAX_SOURCES = 8  # 3^8 products of masses
_UNKNOWN = 2  # index of unknown in (free, occupied, unknown)


@takes_masses()
def pcr5(*masses: Array, axis: int | None = None) -> Array:
    """Combine by PCR5: each conflicting product returns to its states, in proportion to their products.

    Commutative, not associative; the vacuous mass is neutral for two sources only.

    Parameters
    ----------
    *masses : (..., 2) float32 or float64, numpy or torch
        Masses (free, occupied) of two to eight sources, or a stack of sources along `axis`. The time grows as
        3^sources.
    axis : int, optional
        Leading axis of the stack that counts the sources.

    Returns
    -------
    (..., 2), the combined mass
    """
    return _redistribute(masses, axis, _product)


@takes_masses()
def pcr6(*masses: Array, axis: int | None = None) -> Array:
    """Combine by PCR6: each conflicting product returns to its sources, in proportion to their masses.

    Commutative, not associative; the vacuous mass is neutral for two sources only.

    Parameters
    ----------
    *masses, axis
        See `pcr5`.
    """
    return _redistribute(masses, axis, sum)


@takes_masses()
def pcr6_plus(*masses: Array, axis: int | None = None) -> Array:
    """Combine by PCR6+: like PCR6, restricted to the sources in conflict.

    Sources that contribute unknown to a product have no share in its conflict, so the vacuous mass is neutral for any
    number of sources. Commutative, not associative.

    Parameters
    ----------
    *masses, axis
        See `pcr5`.
    """
    return _redistribute(masses, axis, sum, parties=2)


@takes_masses()
def murphy(*masses: Array, axis: int | None = None) -> Array:
    """Combine by Murphy's rule: Dempster's rule on n copies of the mean of the n masses.

    Commutative, not associative; the vacuous mass is not neutral. Total conflict cannot occur.

    Parameters
    ----------
    *masses : (..., 2) float32 or float64, numpy or torch
        Masses (free, occupied) of two or more sources, or a stack of sources along `axis`.
    axis : int, optional
        Leading axis of the stack that counts the sources.

    Returns
    -------
    (..., 2), the combined mass
    """
    xp, parts = sources(masses, axis)
    n = len(parts)
    free, occupied, unknown = (sum(numbers) / n for numbers in zip(*parts, strict=True))
    # Commonalities multiply; scaled by the greater, n factors neither overflow nor underflow
    greater = xp.maximum(free, occupied) + unknown
    q_free, q_occupied = ((free + unknown) / greater) ** n, ((occupied + unknown) / greater) ** n
    q_whole = (unknown / greater) ** n
    total = q_free + q_occupied - q_whole
    return stack_last(xp, [(q_free - q_whole) / total, (q_occupied - q_whole) / total], masses[0])


@takes_masses()
def consensus_compromise(*masses: Array, axis: int | None = None) -> Array:
    """Fuse by consensus & compromise: keep common belief, redistribute the rest, turn conflict to unknown.

    Commutative and idempotent; the vacuous mass is neutral for two sources; not associative. Discontinuous at
    agreement: the result for two equal masses is the same mass; for two almost equal masses it is far from both.
    Not recommended for grids.

    Parameters
    ----------
    *masses, axis
        See `cumulative`; at most 12 sources, because the time doubles with each.

    Notes
    -----
    Jøsang (2016), section 12.6; van der Heijden, Kopp and Kargl (2018). The published formula divides zero by zero

    * where all sources are equal, so that no residue remains: the result is the common mass;
    * where two or more sources are dogmatic (unknown of at most 4 units of rounding) and another has no residue, such
      as (1, 0), (1, 0) and the vacuous mass: the result is the mean of the dogmatic masses. It is the limit if the
      dogmatic sources move the same small share of their residues to unknown.
    """
    xp, parts = sources(masses, axis)
    if len(parts) > 12:
        raise ValueError(f"consensus_compromise takes at most 12 sources, got {len(parts)}")
    # In float64, because the product of twelve unknowns may underflow in float32
    parts = [tuple(map(as_double, part)) for part in parts]
    # Step 1, consensus: the least belief of all sources
    agreed_free, agreed_occupied = (reduce(xp.minimum, [part[k] for part in parts]) for k in (0, 1))
    rests = [(free - agreed_free, occupied - agreed_occupied) for free, occupied, _ in parts]
    unknowns = [unknown * (unknown > rounding(masses[0])) for _, _, unknown in parts]
    # Step 2, compromise: products of a residue with the unknown of all others, or with residues of the other state
    free, occupied = (
        sum(_product([rest[k], *unknowns[:i], *unknowns[i + 1 :]]) for i, rest in enumerate(rests)) for k in (0, 1)
    )
    both = 0 * free
    for states in product((0, 1), repeat=len(rests)):
        if 0 in states and 1 in states:
            both = both + _product([rest[state] for rest, state in zip(rests, states, strict=True)])
    no_residue = free + occupied + both == 0
    if maybe_any(xp, no_residue):  # the limit: the residues of the dogmatic sources, if any
        free, occupied = (
            value + no_residue * sum(rest[k] * (unknown == 0) for rest, unknown in zip(rests, unknowns, strict=True))
            for k, value in enumerate((free, occupied))
        )
    # Step 3, normalisation: distribute the mass that is neither common belief nor common unknown, in proportion
    left = (1 - agreed_free - agreed_occupied - _product(unknowns)).clip(0)
    shared = free + occupied + both
    share = left / (shared + (shared == 0))
    return stack_last(xp, [agreed_free + share * free, agreed_occupied + share * occupied], masses[0])


def _redistribute(
    masses: Sequence[Array], axis: int | None, merged: Callable[[list[Any]], Any], parties: int = 3
) -> Array:
    """Sum over all choices of a state by each source, and return conflicting products to the states.

    The shares of free, of occupied and, with three parties, of unknown are in proportion to their `merged` masses.
    """
    xp, parts = sources(masses, axis)
    if len(parts) > _MAX_SOURCES:
        raise ValueError(
            f"PCR takes at most {_MAX_SOURCES} sources, got {len(parts)}; combine groups, or use an associative rule"
        )
    totals: list[Any] = [0 * parts[0][0], 0 * parts[0][0]]
    for states in product((0, 1, _UNKNOWN), repeat=len(parts)):
        picked = [part[state] for part, state in zip(parts, states, strict=True)]
        weight = _product(picked)
        if 0 in states and 1 in states:  # conflict
            shares = [
                merged([mass for mass, picked_state in zip(picked, states, strict=True) if picked_state == party])
                for party in range(parties)
                if party in states
            ]
            whole = sum(shares)
            zero = whole == 0
            weight = weight / (whole + zero if maybe_any(xp, zero) else whole)
            totals = [total + weight * part for total, part in zip(totals, shares, strict=False)]
        elif 0 in states or 1 in states:  # agreement
            state = 0 if 0 in states else 1
            totals[state] = totals[state] + weight
    return stack_last(xp, totals, masses[0])


def _product(numbers: list[Any]) -> Any:
    return prod(numbers[1:], start=numbers[0])
