"""Open-world rules, which keep conflict as mass of the empty set.

In a triple (free, occupied, unknown), the rest to 1 is conflict. `conjunctive` returns triples also for pairs, because
its result has conflict; the pair alone would be the result of Yager's rule, with conflict as part of unknown.
`close_world` returns pairs. Both rules are associative. The open-world cautious and bold rules are in
`ogm.evidence.powerset`.

Sources: Smets and Kennes, "The transferable belief model" (1994); Smets, "Belief functions: the disjunctive
rule of combination" (1993).
"""

from functools import reduce

from ogm.evidence.arrays import Array, each_source, namespace, split_open, stack_last
from ogm.evidence.kinds import takes_masses
from ogm.evidence.rules import OnConflict, agreement, check_policy, normalized, resolve


@takes_masses(gives_masses=False, triples=True)
def conjunctive(*masses: Array, axis: int | None = None) -> Array:
    """Combine by the unnormalised conjunctive rule of the transferable belief model.

    Commutative and associative; the vacuous mass is neutral. Conflict is the mass of the empty set.

    Parameters
    ----------
    *masses : (..., 2) or (..., 3) float32 or float64, numpy or torch
        Pairs (free, occupied) or triples (free, occupied, unknown) of two or more sources, or a stack along `axis`.
    axis : int, optional
        Leading axis of the stack that counts the sources.

    Returns
    -------
    (..., 3), triples (free, occupied, unknown); conflict is 1 minus the sum
    """
    xp, parts = each_source(masses, axis, split_open)
    joint = reduce(lambda joint, part: agreement(*joint, *part), (part[:3] for part in parts))
    return stack_last(xp, joint, masses[0])


@takes_masses(triples=True)
def disjunctive(*masses: Array, axis: int | None = None) -> Array:
    """Combine by the disjunctive rule: at least one source, not known which, is reliable.

    Commutative and associative. The vacuous mass is absorbing, and total conflict (all mass on the empty set) is
    neutral. The rule creates no conflict.

    Parameters
    ----------
    *masses : (..., 2) or (..., 3) float32 or float64, numpy or torch
        Pairs (free, occupied) or triples (free, occupied, unknown) of two or more sources, or a stack along `axis`.
    axis : int, optional
        Leading axis of the stack that counts the sources.

    Returns
    -------
    (..., 2) if all sources are pairs, else (..., 3)
    """
    xp, parts = each_source(masses, axis, split_open)
    free, occupied, _, conflict = parts[0]
    for f, o, _, c in parts[1:]:
        free, occupied, conflict = (free * (f + c) + conflict * f, occupied * (o + c) + conflict * o, conflict * c)
    closed = all(mass.shape[-1] == 2 for mass in masses)  # type: ignore[attr-defined]
    unknown = [] if closed else [(1 - (free + occupied) - conflict).clip(0)]
    return stack_last(xp, [free, occupied, *unknown], masses[0])


@takes_masses("open_mass", gives_masses=False, triples=True)
def close_world(open_mass: Array, *, on_conflict: OnConflict = "average") -> Array:
    """Return the closed-world pair of an open-world triple: Dempster's normalisation.

    Parameters
    ----------
    open_mass : (..., 3) float32 or float64, numpy or torch
        Triples (free, occupied, unknown).
    on_conflict : {"average", "vacuous", "nan", "raise"}
        Result where conflict is 1. The sources are not known: "average" is (0.5, 0.5), the limit for two equally
        strong sources.

    Returns
    -------
    (..., 2), masses (free, occupied)
    """
    check_policy(on_conflict)
    xp = namespace(open_mass)
    free, occupied, unknown, _ = split_open(open_mass, "open_mass", states=(3,))
    free, occupied, _, none = normalized(xp, free, occupied, unknown)
    return resolve(xp, open_mass, free, occupied, none, (0.5, 0.5), on_conflict)
