"""Closed-world Dempster-Shafer rules for the frame {free, occupied}.

Every rule takes several masses, ``rule(a, b, c)``, or a stack of sources and its axis, ``rule(stack, axis=0)``. Masses
have any leading shape and any kind (see `ogm.evidence.kinds`). `dempster` is associative except in cells of total
conflict between dogmatic sources, where the result depends on `on_conflict`. The other rules combine all sources at
once, and chains of pairs give different results.

Sources: Dempster (1967); Shafer (1976); Yager, "On the Dempster-Shafer framework and new combination rules"
(1987); Dubois and Prade, "Representation and combination of uncertainty with belief functions and possibility
measures" (1988); Denœux, "Conjunctive and disjunctive combination of belief functions induced by nondistinct
bodies of evidence" (2008).
"""

from functools import reduce
from typing import Any, Literal, get_args

from ogm.evidence.arrays import Array, first_index, maybe_any, sources, stack_last, tolerance_of
from ogm.evidence.base_rates import confidence_base_rate
from ogm.evidence.kinds import takes_masses

OnConflict = Literal["average", "vacuous", "nan", "raise"]
SMOOTH_GAIN = 0.25  # share of a scan in the average of `smooth`
OLD_OCCUPIED_LOSS, NEW_OCCUPIED_LOSS = 0.75, 0.5  # shares of the contradiction in `revise`


@takes_masses(rate=confidence_base_rate)
def dempster(*masses: Array, axis: int | None = None, on_conflict: OnConflict = "average") -> Array:
    """Combine independent, reliable sources by Dempster's rule: agreement, normalised.

    ``free = (f1 f2 + f1 u2 + u1 f2) / (1 - C)``, occupied likewise, with the conflict C = f1 o2 + o1 f2. The divisor
    1 - C is computed without cancellation as the sum of the numerators. Commutative, and associative except in cells of
    total conflict; the vacuous mass is neutral.

    Parameters
    ----------
    *masses : (..., 2) float32 or float64, numpy or torch
        Masses (free, occupied) of two or more sources, or a stack of sources along `axis`.
    axis : int, optional
        Leading axis of the stack that counts the sources.
    on_conflict : {"average", "vacuous", "nan", "raise"}
        Result in total conflict (dogmatically free against dogmatically occupied): the mean of the dogmatic sources,
        which for two sources is (0.5, 0.5), the limit for equal strength; the vacuous mass; NaN; or ValueError.

    Returns
    -------
    (..., 2), the combined mass
    """
    check_policy(on_conflict)
    xp, parts = sources(masses, axis)
    free, occupied, unknown = parts[0]
    for number, part in enumerate(parts[1:], start=2):
        free, occupied, unknown = agreement(free, occupied, unknown, *part)
        # Normalise after each source, so that long stacks do not underflow; total conflict remains
        free, occupied, surviving, none = normalized(xp, free, occupied, unknown)
        if number < len(parts):
            unknown = unknown / surviving
    if len(parts) == 1 or not maybe_any(xp, none):
        return stack_last(xp, [free, occupied], masses[0])
    return resolve(xp, masses[0], free, occupied, none, _mean_of_the_dogmatic(parts), on_conflict)


@takes_masses()
def yager(*masses: Array, axis: int | None = None) -> Array:
    """Combine by Yager's rule: conjunctively, with conflict as unknown.

    Commutative; the vacuous mass is neutral. Not associative: several sources are combined conjunctively, and all
    conflict becomes unknown at the end; a chain of pairs gives a different result.

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
    return stack_last(xp, reduce(lambda joint, part: agreement(*joint, *part), parts)[:2], masses[0])


@takes_masses()
def dubois_prade(*masses: Array, axis: int | None = None) -> Array:
    """Combine by Dubois and Prade's rule: the conflict of A and B is mass of "A or B".

    For two states, "free or occupied" is unknown, so the rule is `yager`. On larger frames (`ogm.evidence.powerset`)
    they differ.
    """
    return yager(*masses, axis=axis)


@takes_masses()
def cautious(*masses: Array, axis: int | None = None) -> Array:
    """Combine dependent sources by Denœux's cautious rule: the greatest evidence of each state.

    ``free / unknown = max(f1 / u1, f2 / u2)``, occupied likewise. Commutative, associative and idempotent; the
    vacuous mass is neutral. Repeated evidence, as in consecutive scans, adds nothing.

    Parameters
    ----------
    *masses : (..., 2) float32 or float64, numpy or torch
        Masses (free, occupied) of two or more sources, or a stack of sources along `axis`.
    axis : int, optional
        Leading axis of the stack that counts the sources.

    Returns
    -------
    (..., 2), the combined mass

    Notes
    -----
    Normalised, like all rules of pairs; `ogm.evidence.powerset.cautious` keeps the conflict. Normalisation does not
    change the weights w = unknown / (belief + unknown). The result thus has the greatest Dirichlet evidence of each
    state, max(2 free / unknown) and max(2 occupied / unknown); `cumulative` has the sum and `averaging` the mean.
    Unknown is read as at least 1e-6 (float32) or 1e-12 (float64).
    """
    xp, parts = sources(masses, axis)
    min_unknown = tolerance_of(masses[0])
    ratios = [
        (free / unknown.clip(min_unknown), occupied / unknown.clip(min_unknown)) for free, occupied, unknown in parts
    ]
    for_free, for_occupied = (reduce(xp.maximum, column) for column in zip(*ratios, strict=True))
    total = 1 + for_free + for_occupied
    return stack_last(xp, [for_free / total, for_occupied / total], masses[0])


@takes_masses("prior", "new")
def revise(prior: Array, new: Array) -> Array:
    """Revise the masses of a map by a scan: free falls at the first contradiction, occupied gradually.

    With the masses (F, O) of the map, (f, o) of the scan, and ``(x)+ = max(x, 0)``::

        occupied = max(O (1 - 3/4 (f - F)+), o (1 - 1/2 (F - f)+))
        free = min(max(F (1 - (o - O)+), f (1 - (O - o)+)), 1 - occupied)

    Each state keeps the greater mass, as in `cautious`, so repeated equal scans do not add up. First, each mass is
    discounted by the excess of the other source's belief in the opposite state: free by the full excess, occupied of
    the map by three quarters, occupied of the scan by half. A scan of occupied 0.9 changes a cell of free 0.9 to free
    0.1. A scan of free 0.9 changes a cell of occupied 0.9 to occupied 0.29, which is unknown, and the next scan to
    free.

    Not symmetric, not associative; idempotent, and the vacuous mass is neutral.

    Parameters
    ----------
    prior, new : (..., 2) float32 or float64, numpy or torch
        Masses (free, occupied) of the map, and of a later scan.

    Returns
    -------
    (..., 2), the masses of the map after the scan

    Notes
    -----
    Discounting a single state is contextual discounting: Mercier, Quost and Denœux, "Refined modeling of sensor
    reliability in the belief function framework using contextual discounting" (2008). The dependence on the
    contradiction and the three shares are our own, chosen on simulated validation drives (docs/fusion.md).
    """
    xp, ((F, O, _), (f, o, _)) = sources((prior, new), None)  # noqa: N806, E741  as above
    occupied = xp.maximum(O * (1 - OLD_OCCUPIED_LOSS * (f - F).clip(0)), o * (1 - NEW_OCCUPIED_LOSS * (F - f).clip(0)))
    free = xp.maximum(F * (1 - (o - O).clip(0)), f * (1 - (O - o).clip(0)))
    return stack_last(xp, [xp.minimum(free, 1 - occupied), occupied], prior)


@takes_masses("prior", "new")
def smooth(prior: Array, new: Array) -> Array:
    """Smooth occupied over recent scans of a map, and lose free at the first contradiction.

    With the masses (F, O) of the map, (f, o) of the scan, ``(x)+ = max(x, 0)`` and ``k = max(1/4, 1 - 16 (F + O))``::

        where o >= f:   occupied = O + k (o - O)+,   free = F (1 - o)
        elsewhere:      occupied = O (1 - f / 4),    free = min(F + f (1 - F) (1 - O), max(F, f, 1 - 2 (1 - f)^2))

    and free is at most 1 - occupied. Occupied is an exponential average, with a gain of 1 in an unknown cell of the
    map. In a free cell, the first scan of occupied 0.9 makes the cell unknown, and the third makes it an obstacle;
    three or four scans of free 0.9 clear it. So cells next to a wall, with occasional hits by range and pose errors, do
    not flicker. Repeated scans of free 0.8 increase free to 0.92 at most; free of at most 0.5 does not grow.

    Not symmetric, not associative; the vacuous mass is neutral.

    Parameters
    ----------
    prior, new : (..., 2) float32 or float64, numpy or torch
        Masses (free, occupied) of the map, and of a later scan.

    Returns
    -------
    (..., 2), the masses of the map after the scan

    Notes
    -----
    Our own rule; the gain was chosen on simulated halls with range and pose errors (docs/fusion.md).
    """
    xp, ((F, O, _), (f, o, _)) = sources((prior, new), None)  # noqa: N806, E741  as above
    gain = (1 - (F + O) / SMOOTH_GAIN**2).clip(SMOOTH_GAIN)
    hit = o >= f
    occupied = xp.where(hit, O + gain * (o - O).clip(0), O * (1 - SMOOTH_GAIN * f))
    grown = xp.minimum(F + f * (1 - F) * (1 - O), xp.maximum(F, xp.maximum(f, 1 - 2 * (1 - f) ** 2)))
    free = xp.where(hit, F * (1 - o), grown)
    return stack_last(xp, [xp.minimum(free, 1 - occupied), occupied], prior)


def agreement(free: Any, occupied: Any, unknown: Any, f: Any, o: Any, u: Any) -> tuple[Any, Any, Any]:
    """Return the unnormalised conjunction (free, occupied, unknown) of two masses; the rest to 1 is conflict.

    Sums of products only, so small beliefs are not lost by cancellation. `ogm.evidence.kernels` compiles this function.
    """
    return free * (f + u) + unknown * f, occupied * (o + u) + unknown * o, unknown * u


def normalized(xp: Any, free: Any, occupied: Any, unknown: Any) -> tuple[Any, Any, Any, Any]:
    """Return (free, occupied) divided by the sum of all three, the divisor, and a mask of total conflict.

    In total conflict the masses are 0 and the divisor is 1.
    """
    surviving = free + occupied + unknown
    none = surviving == 0
    if maybe_any(xp, none):
        surviving = surviving + none
    return free / surviving, occupied / surviving, surviving, none


def check_policy(on_conflict: str) -> None:
    """Raise ValueError for an unknown policy."""
    if on_conflict not in get_args(OnConflict):
        raise ValueError(f"on_conflict must be one of {', '.join(get_args(OnConflict))}, got {on_conflict!r}")


def refuse_total_conflict(none: Any, on_conflict: OnConflict) -> None:
    """Raise ValueError for cells of total conflict if the policy is "raise"."""
    if on_conflict == "raise" and bool(none.any()):
        raise ValueError(
            f"{int(none.sum())} cells are in total conflict, the first at {first_index(none)}; "
            "use another on_conflict: average, vacuous or nan"
        )


def _mean_of_the_dogmatic(parts: list[tuple[Any, Any, Any]]) -> tuple[Any, Any]:
    """Return the mean of the dogmatic sources; in total conflict each state has at least one."""
    for_free = sum((o + u == 0) + 0 * u for _, o, u in parts)
    for_occupied = sum((f + u == 0) + 0 * u for f, _, u in parts)
    votes = (for_free + for_occupied).clip(1)
    return for_free / votes, for_occupied / votes


def resolve(
    xp: Any, mass: Array, free: Any, occupied: Any, none: Any, average: tuple[Any, Any], on_conflict: OnConflict
) -> Array:
    """Fill cells of total conflict, which hold (0, 0), according to the policy."""
    refuse_total_conflict(none, on_conflict)
    if on_conflict in ("average", "nan"):
        fill = average if on_conflict == "average" else (xp.nan, xp.nan)
        free, occupied = xp.where(none, fill[0], free), xp.where(none, fill[1], occupied)
    return stack_last(xp, [free, occupied], mass)
