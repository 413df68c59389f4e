"""Decisions by expected cost, and the contradiction of each source to the others.

Sources: Denœux, "Decision-making with belief functions: a review" (2019); Chow, "On optimum recognition error and
reject tradeoff" (1970); Schubert, "Conflict management in Dempster-Shafer theory using the degree of falsity" (2011).
"""

from typing import Any, Literal, cast, get_args

import numpy as np

from ogm.evidence.arrays import Array, as_like, broadcast, namespace, sources, split, stack_last
from ogm.evidence.kinds import takes_masses
from ogm.evidence.measures import conflict
from ogm.evidence.rules import dempster

Criterion = Literal["belief", "pignistic", "plausibility"]
ABSTAIN, FREE, OCCUPIED = 0, 1, 2  # values of `ogm.CellState`


@takes_masses("mass", gives_masses=False, base_rates={"mass": "base_rate"})
def decide(
    mass: Array,
    criterion: Criterion = "belief",
    *,
    cost_false_free: float = 1.0,
    cost_false_occupied: float = 1.0,
    cost_abstention: float = 0.5,
    base_rate: Any = 0.5,
) -> Any:
    """Return the decision of least expected cost for each cell: free, occupied, or abstention.

    Parameters
    ----------
    mass : (..., 2) float32 or float64, numpy or torch
    criterion : {"belief", "pignistic", "plausibility"}
        Probability of a state in the expected cost: belief (cautious, an upper bound of the cost), projected
        probability, or plausibility (a lower bound of the cost).
    cost_false_free, cost_false_occupied : float
        Cost of deciding for free where the cell is occupied, and the reverse, at least 0.
    cost_abstention : float
        Cost of no decision, at least 0. With the other costs 1, a state is chosen if its probability exceeds
        1 - cost_abstention; infinity always decides.
    base_rate : float or (...) array
        Prior probability of occupied, in [0, 1], for the projected probability.

    Returns
    -------
    (...) uint8
        Values of `ogm.CellState`: 1 free, 2 occupied, 0 abstention. For equal costs, abstention wins, then occupied.
    """
    if criterion not in get_args(Criterion):
        raise ValueError(f"criterion must be one of {', '.join(get_args(Criterion))}, got {criterion!r}")
    costs = {"false_free": cost_false_free, "false_occupied": cost_false_occupied, "abstention": cost_abstention}
    for name, cost in costs.items():
        if not cost >= 0:
            raise ValueError(f"cost_{name} must be at least 0, got {cost}")
    xp, (free, occupied, unknown) = namespace(mass), split(mass)
    rate = as_like(base_rate, free, "base_rate")
    share_free, share_occupied = {"belief": (0, 0), "pignistic": (1 - rate, rate), "plausibility": (1, 1)}[criterion]
    cost_free = cost_false_free * (1 - free - share_free * unknown)
    cost_occupied = cost_false_occupied * (1 - occupied - share_occupied * unknown)
    is_free = (cost_free < cost_occupied) & (cost_free < cost_abstention)
    is_occupied = (cost_occupied <= cost_free) & (cost_occupied < cost_abstention)
    decision = is_free * FREE + is_occupied * OCCUPIED
    return decision.astype(np.uint8) if xp is np else decision.to(xp.uint8)


@takes_masses(gives_masses=False)
def degree_of_falsity(*masses: Array, axis: int | None = None) -> Array:
    """Return the conflict of each source with the combination of all others by Dempster's rule, in [0, 1].

    The source with the greatest degree is the most likely error. Equal to Schubert's (C - C_i) / (1 - C_i), with the
    conflict C of all sources, and C_i of all sources without source i.

    Parameters
    ----------
    *masses : (..., 2) float32 or float64, numpy or torch
        Masses (free, occupied) of two or more sources, or a stack of sources along `axis`.
    axis : int, optional
        Leading axis of the stack that counts the sources.

    Returns
    -------
    (sources, ...)
    """
    xp, parts = sources(masses, axis)
    if len(parts) < 2:
        raise ValueError(f"degree_of_falsity compares sources: give at least two, got {len(parts)}")
    pairs = [stack_last(xp, [free, occupied], masses[0]) for free, occupied, _ in parts]
    conflicts: list[Any] = [
        conflict(pair, others[0] if len(others) == 1 else dempster(*others))
        for pair, others in ((pair, pairs[:k] + pairs[k + 1 :]) for k, pair in enumerate(pairs))
    ]
    return cast(Array, xp.stack(broadcast(xp, conflicts)))


def reconciling_reliability(*masses: Array, axis: int | None = None, remaining_conflict: float = 0.1) -> Array:
    """Return the greatest reliability of each source that removes its contradiction to the others.

    Conflict is proportional to reliability: after `discount` of the source, its conflict with the combination of the
    others is at most `remaining_conflict`.

    Parameters
    ----------
    *masses, axis
        See `degree_of_falsity`.
    remaining_conflict : float
        Tolerated conflict, in [0, 1].

    Returns
    -------
    (sources, ...), in [0, 1]
    """
    if not 0 <= remaining_conflict <= 1:
        raise ValueError(f"remaining_conflict must lie in [0, 1], got {remaining_conflict}")
    falsity: Any = degree_of_falsity(*masses, axis=axis)
    xp = namespace(falsity)
    low = falsity <= remaining_conflict
    return cast(Array, xp.where(low, 1 + 0 * falsity, remaining_conflict / (falsity + low)))
