"""Discounting, probabilities and changes of frame for mass functions ``[..., 2**K]``."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ogm.evidence.arrays import Array, as_like
from ogm.evidence.powerset.transforms import MAX_STATES, masses_of, stack, subset

__all__ = [
    "coarsen",
    "contextual_discount",
    "discount",
    "pignistic",
    "plausibility_transform",
    "projected_probability",
    "refine",
]


def pignistic(mass: Array) -> Array:
    """Return the pignistic probabilities, (..., K): each mass is shared equally by the states of its set.

    Masses are normalised by 1 - conflict; in total conflict the result is NaN.
    """
    return projected_probability(mass)


def projected_probability(mass: Array, base_rate: Sequence[Any] | None = None) -> Array:
    """Return the projected probabilities, (..., K): each mass is shared in proportion to base rates.

    Parameters
    ----------
    mass : (..., 2**K)
        Mass function (hyper-opinion, Jøsang (2016), section 3.6).
    base_rate : K numbers or (...) arrays, optional
        Prior probabilities of the states, greater than 0; by default equal, for the pignistic probability.
    """
    columns = masses_of(mass)
    states = range(_states(columns))
    rates: Sequence[Any] = [1.0] * len(states) if base_rate is None else base_rate
    if len(rates) != len(states):
        raise ValueError(f"give one base rate per state, {len(states)}, got {len(rates)}")
    rates = [as_like(rate, columns[0], f"base_rate[{state}]", low=1e-12) for state, rate in enumerate(rates)]
    totals = [sum(rates[state] for state in states if place >> state & 1) for place in range(len(columns))]
    shares: list[Any] = [
        sum(rates[state] * column / totals[place] for place, column in enumerate(columns) if place >> state & 1)
        for state in states
    ]
    with np.errstate(invalid="ignore"):
        return stack([share / columns[1:].sum(0) for share in shares], mass)


def plausibility_transform(mass: Array) -> Array:
    """Return the normalised plausibilities of single states, (..., K); NaN in total conflict."""
    columns = masses_of(mass)
    plausible: list[Any] = [
        sum(column for place, column in enumerate(columns) if place >> state & 1) for state in range(_states(columns))
    ]
    with np.errstate(invalid="ignore"):
        return stack([number / sum(plausible) for number in plausible], mass)


def discount(mass: Array, reliability: Any) -> Array:
    """Return Shafer's discounted mass function: masses times the reliability, the rest on the frame.

    `reliability` is a float or (...) array in [0, 1]; 1 keeps the masses.
    """
    columns = masses_of(mass)
    r = as_like(reliability, columns[0], "reliability")
    return stack([*(r * columns[:-1]), r * columns[-1] + (1 - r)], mass)


def contextual_discount(mass: Array, reliabilities: Sequence[Any]) -> Array:
    """Discount by reliabilities that depend on the true state (Mercier et al., 2008).

    `reliabilities` are K numbers or (...) arrays in [0, 1]; number i is the reliability in state i.
    """
    columns = list(masses_of(mass))
    if len(reliabilities) != _states(columns):
        raise ValueError(f"give one reliability per state, {_states(columns)}, got {len(reliabilities)}")
    for state, reliability in enumerate(reliabilities):
        r = as_like(reliability, columns[0], f"reliabilities[{state}]")
        bit = 1 << state
        columns = [
            column + (1 - r) * columns[place ^ bit] if place & bit else r * column
            for place, column in enumerate(columns)
        ]
    return stack(columns, mass)


def coarsen(mass: Array, groups: Sequence[Sequence[int]]) -> Array:
    """Return the mass function on the coarser frame of `groups`, a partition of the states.

    A set becomes the set of all groups that it meets (outer reduction). With states (free, static, dynamic),
    ``coarsen(mass, [(0,), (1, 2)])`` is the mass on (free, occupied).
    """
    columns = masses_of(mass)
    bits = _partition(groups, _states(columns))
    result = [0 * columns[0]] * (1 << len(bits))
    for place, column in enumerate(columns):
        target = sum(1 << i for i, group in enumerate(bits) if group & place)
        result[target] = result[target] + column
    return stack(result, mass)


def refine(mass: Array, groups: Sequence[Sequence[int]]) -> Array:
    """Return the mass function on a finer frame, with the states ``groups[i]`` for state i.

    This is the vacuous extension: ``coarsen(refine(mass, groups), groups)`` is `mass`.
    """
    columns = masses_of(mass)
    states = sum(len(group) for group in groups)
    bits = _partition(groups, states)
    if len(bits) != _states(columns):
        raise ValueError(f"give one group per state, {_states(columns)}, got {len(bits)}")
    result = [0 * columns[0]] * (1 << states)
    for place, column in enumerate(columns):
        result[sum(group for i, group in enumerate(bits) if place >> i & 1)] = column
    return stack(result, mass)


def _states(columns: Any) -> int:
    return len(columns).bit_length() - 1


def _partition(groups: Sequence[Sequence[int]], states: int) -> list[int]:
    """Return the indices of the groups; raise ValueError unless they are a partition of the states."""
    flat = sorted(state for group in groups for state in group)
    if flat != list(range(states)) or not all(groups):
        raise ValueError(f"groups must be a partition of the states 0 to {states - 1}, got {list(groups)}")
    if states > MAX_STATES:
        raise ValueError(f"frames of at most {MAX_STATES} states are supported, got {states}")
    return [subset(*group) for group in groups]
