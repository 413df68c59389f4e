"""Dempster-Shafer rules for the frame {free, occupied}, in a closed world: pairs in, pairs out.

Every rule takes n masses, ``rule(a, b, c)``, or a stack of sources and its axis, ``rule(stack, axis=0)``, with
any leading shape, and of any kind: see `ogm.evidence.kinds`. `dempster` is associative, so a chain of pairs agrees
wherever something survives; in cells of total conflict between dogmatic sources the policy `on_conflict` decides, and
a chain may end elsewhere. The other rules combine all sources at once, and a chain of pairs gives something else.

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
OLD_OCCUPIED_LOSS, NEW_OCCUPIED_LOSS = 0.75, 0.5  # shares of a contradiction by which `revise` discounts occupied


@takes_masses(rate=confidence_base_rate)
def dempster(*masses: Array, axis: int | None = None, on_conflict: OnConflict = "average") -> Array:
    """Combine independent, reliable sources by Dempster's rule: agreement, normalised.

    ``free = (f1 f2 + f1 u2 + u1 f2) / (1 - C)``, occupied likewise, with the conflict C = f1 o2 + o1 f2; computed
    as division by the sum of the surviving masses, which is 1 - C without cancellation. Commutative, and
    associative except in cells of total conflict; the vacuous mass is neutral.

    Parameters
    ----------
    *masses : (..., 2) float32 or float64, numpy or torch
        Masses (free, occupied) of two or more sources, or one stack of sources along `axis`.
    axis : int, optional
        Leading axis of the stack that counts the sources.
    on_conflict : {"average", "vacuous", "nan", "raise"}
        What to return in total conflict (dogmatically free against dogmatically occupied): the mean of the
        dogmatic sources, for two of them (0.5, 0.5), the limit of two equally strong ones; the vacuous mass; NaN;
        or an error.

    Returns
    -------
    (..., 2), the combined mass
    """
    check_policy(on_conflict)
    xp, parts = sources(masses, axis)
    free, occupied, unknown = parts[0]
    for number, part in enumerate(parts[1:], start=2):
        free, occupied, unknown = agreement(free, occupied, unknown, *part)
        # Normalise at once, so that long stacks do not underflow. Total conflict remains total conflict.
        free, occupied, surviving, none = normalized(xp, free, occupied, unknown)
        if number < len(parts):
            unknown = unknown / surviving
    if len(parts) == 1 or not maybe_any(xp, none):
        return stack_last(xp, [free, occupied], masses[0])
    return resolve(xp, masses[0], free, occupied, none, _mean_of_the_dogmatic(parts), on_conflict)


@takes_masses()
def yager(*masses: Array, axis: int | None = None) -> Array:
    """Combine by Yager's rule: agreement survives, conflict becomes unknown.

    Commutative, vacuous is neutral, not associative: a stack is combined in one go (conjunctively, all
    conflict to unknown at the end), a chain of pairs is not the same.

    Parameters
    ----------
    *masses : (..., 2) float32 or float64, numpy or torch
        Masses (free, occupied) of two or more sources, or one stack of sources along `axis`.
    axis : int, optional
        Leading axis of the stack that counts the sources.

    Returns
    -------
    (..., 2), the combined mass
    """
    xp, parts = sources(masses, axis)
    free, occupied, unknown = parts[0]
    for part in parts[1:]:
        free, occupied, unknown = agreement(free, occupied, unknown, *part)
    return stack_last(xp, [free, occupied], masses[0])


@takes_masses()
def dubois_prade(*masses: Array, axis: int | None = None) -> Array:
    """Combine by Dubois and Prade's rule: the conflict of A and B goes to "A or B".

    With two states, "free or occupied" is everything, so this is exactly `yager`; in larger frames
    (`ogm.evidence.powerset`) the two differ.
    """
    return yager(*masses, axis=axis)


@takes_masses()
def cautious(*masses: Array, axis: int | None = None) -> Array:
    """Combine dependent sources by Denœux's cautious rule: the greatest evidence of each state.

    ``free / unknown = max(f1 / u1, f2 / u2)``, occupied likewise. Commutative, associative and idempotent; the
    vacuous mass is neutral. Repeated evidence, as from one scan to the next, adds nothing.

    Parameters
    ----------
    *masses : (..., 2) float32 or float64, numpy or torch
        Masses (free, occupied) of two or more sources, or one stack of sources along `axis`.
    axis : int, optional
        Leading axis of the stack that counts the sources.

    Returns
    -------
    (..., 2), the combined mass

    Notes
    -----
    Normalised, as all rules of pairs; `ogm.evidence.powerset.cautious` keeps the conflict. Normalising leaves the
    weights w = unknown / (belief + unknown) as they are, so the rule is the greatest Dirichlet evidence of each state,
    max(2 free / unknown) and max(2 occupied / unknown), where `cumulative` takes the sum and `averaging` the mean.
    Unknown is read as at least 1e-6 (float32) or 1e-12 (float64).
    """
    xp, parts = sources(masses, axis)
    least = tolerance_of(masses[0])
    ratios = [(free / unknown.clip(least), occupied / unknown.clip(least)) for free, occupied, unknown in parts]
    for_free, for_occupied = (reduce(xp.maximum, column) for column in zip(*ratios, strict=True))
    total = 1 + for_free + for_occupied
    return stack_last(xp, [for_free / total, for_occupied / total], masses[0])


@takes_masses("prior", "new")
def revise(prior: Array, new: Array) -> Array:
    """Revise the masses of a map by those of a scan: free falls at the first contradiction, occupied by and by.

    With the masses (F, O) of the map, (f, o) of the scan, and ``(x)+ = max(x, 0)``::

        occupied = max(O (1 - 3/4 (f - F)+), o (1 - 1/2 (F - f)+))
        free = min(max(F (1 - (o - O)+), f (1 - (O - o)+)), 1 - occupied)

    Each state keeps its greatest mass, as by `cautious`: claims that every scan repeats do not add up.
    Before, each mass is discounted by how much more the other side believes in the contrary: free by all of it,
    occupied of the map by three quarters, occupied of the scan by half. So one scan of occupied takes a cell of free
    0.9 to 0.1, and one scan of free takes a cell of occupied 0.9 to 0.29, which is unknown, and the next to free.

    Not symmetric, not associative; idempotent, and the vacuous mass is neutral.

    Parameters
    ----------
    prior, new : (..., 2) float32 or float64, numpy or torch
        Masses (free, occupied) of the map, and of a scan that came after it.

    Returns
    -------
    (..., 2), the masses of the map after the scan

    Notes
    -----
    To discount one state alone is contextual discounting: Mercier, Quost and Denoeux, "Refined modeling of sensor
    reliability in the belief function framework using contextual discounting" (2008). That the contradiction sets the
    rate, and the three shares, are our own, chosen on simulated validation drives (docs/fusion.md).
    """
    xp, ((F, O, _), (f, o, _)) = sources((prior, new), None)  # noqa: N806, E741  as above
    occupied = xp.maximum(O * (1 - OLD_OCCUPIED_LOSS * (f - F).clip(0)), o * (1 - NEW_OCCUPIED_LOSS * (F - f).clip(0)))
    free = xp.maximum(F * (1 - (o - O).clip(0)), f * (1 - (O - o).clip(0)))
    return stack_last(xp, [xp.minimum(free, 1 - occupied), occupied], prior)


@takes_masses("prior", "new")
def smooth(prior: Array, new: Array) -> Array:
    """Average occupied over the scans of a map, the last ones most, and lose free at the first contradiction.

    With the masses (F, O) of the map, (f, o) of the scan, ``(x)+ = max(x, 0)`` and ``k = max(1/4, 1 - 16 (F + O))``::

        where o >= f:   occupied = O + k (o - O)+,   free = F (1 - o)
        elsewhere:      occupied = O (1 - f / 4),    free = min(F + f (1 - F) (1 - O), max(F, f, 1 - 2 (1 - f)^2))

    and free is at most 1 - occupied. Occupied is an exponential average, with a gain of 1 where the map knows nothing:
    in a free cell three scans of occupied 0.9 in turn make an obstacle, the first of them makes it unknown, and three
    or four scans of free 0.9 clear it. So a cell beside a wall that errors of ranges and poses hit now and then
    does not flicker. Free of 0.8 that scans repeat grows to 0.92, and no further; free of at most 0.5 does not grow.

    Not symmetric, not associative; the vacuous mass is neutral.

    Parameters
    ----------
    prior, new : (..., 2) float32 or float64, numpy or torch
        Masses (free, occupied) of the map, and of a scan that came after it.

    Returns
    -------
    (..., 2), the masses of the map after the scan

    Notes
    -----
    Our own; the gain was chosen on made halls with errors of ranges and poses (docs/fusion.md).
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

    Sums of products only: nothing cancels, and a belief of 1e-8 is not lost beside one of 1. `ogm.evidence.kernels`
    compiles this same function.
    """
    return free * (f + u) + unknown * f, occupied * (o + u) + unknown * o, unknown * u


def normalized(xp: Any, free: Any, occupied: Any, unknown: Any) -> tuple[Any, Any, Any, Any]:
    """Return (free, occupied) divided by the sum of all three, the divisor, and the cells of total conflict.

    In those the masses stay 0, and the divisor is 1.
    """
    surviving = free + occupied + unknown
    none = surviving == 0
    if maybe_any(xp, none):
        surviving = surviving + none
    return free / surviving, occupied / surviving, surviving, none


def check_policy(on_conflict: str) -> None:
    """Refuse a policy that does not exist."""
    if on_conflict not in get_args(OnConflict):
        raise ValueError(f"on_conflict must be one of {', '.join(get_args(OnConflict))}, got {on_conflict!r}")


def refuse_total_conflict(none: Any, on_conflict: OnConflict) -> None:
    """Raise in the policy "raise" if there is a cell of total conflict."""
    if on_conflict == "raise" and bool(none.any()):
        raise ValueError(
            f"{int(none.sum())} cells are in total conflict, the first at {first_index(none)}; "
            f"choose another on_conflict: average, vacuous or nan"
        )


def _mean_of_the_dogmatic(parts: list[tuple[Any, Any, Any]]) -> tuple[Any, Any]:
    """Return the mean of the sources that are dogmatic for one state; in total conflict both states have some."""
    for_free = sum((o + u == 0) + 0 * u for _, o, u in parts)
    for_occupied = sum((f + u == 0) + 0 * u for f, _, u in parts)
    votes = (for_free + for_occupied).clip(1)
    return for_free / votes, for_occupied / votes


def resolve(
    xp: Any, mass: Array, free: Any, occupied: Any, none: Any, average: tuple[Any, Any], on_conflict: OnConflict
) -> Array:
    """Fill the cells of total conflict according to the policy; on entry they hold (0, 0), the vacuous mass."""
    refuse_total_conflict(none, on_conflict)
    if on_conflict in ("average", "nan"):
        fill = average if on_conflict == "average" else (xp.nan, xp.nan)
        free, occupied = xp.where(none, fill[0], free), xp.where(none, fill[1], occupied)
    return stack_last(xp, [free, occupied], mass)
