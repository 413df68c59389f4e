"""Discounting, probabilities and changes of frame for mass functions ``[..., 2**K]``."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ogm.evidence.arrays import Array, like
from ogm.evidence.powerset.transforms import MOST_STATES, Columns, split_columns, stack, subset

__all__ = [
    "coarsen",
    "contextual_discount",
    "discount",
    "pignistic",
    "plausibility_transform",
    "refine",
]


def discount(mass: Array, reliability: Any) -> Array:
    """Return Shafer's discounted mass function: all masses times the reliability, the rest on the frame.

    Parameters
    ----------
    mass : (..., 2**K) float32 or float64, numpy or torch
    reliability : float or (...) array
        In [0, 1]; 1 keeps all.
    """
    columns = split_columns(mass)
    r = like(reliability, columns[0], "reliability")
    faded = [r * column for column in columns]
    return stack([*faded[:-1], faded[-1] + (1 - r)], mass)


def contextual_discount(mass: Array, reliabilities: Sequence[Any]) -> Array:
    """Return the mass of a source whose reliability depends on the true state (Mercier et al., 2008).

    Parameters
    ----------
    mass : (..., 2**K) float32 or float64, numpy or torch
    reliabilities : K numbers or (...) arrays
        Reliability of the source if state i is the true one, in [0, 1].
    """
    columns = split_columns(mass)
    if 1 << len(reliabilities) != len(columns):
        raise ValueError(
            f"give one reliability per state, {len(columns).bit_length() - 1}, got {len(reliabilities)}"
        )
    for state, reliability in enumerate(reliabilities):
        r = like(reliability, columns[0], f"reliabilities[{state}]")
        bit = 1 << state
        columns = [
            column + (1 - r) * columns[place ^ bit] if place & bit else r * column
            for place, column in enumerate(columns)
        ]
    return stack(columns, mass)


def pignistic(mass: Array) -> Array:
    """Return the pignistic probabilities, (..., K): every mass shared equally by the states of its set.

    Conflict is normalised away; where it is all there is, the result is NaN.
    """
    columns = split_columns(mass)
    states = range(len(columns).bit_length() - 1)
    alive = sum(columns[2:], start=columns[1])
    shares: list[Any] = [
        sum(column / place.bit_count() for place, column in enumerate(columns) if place >> state & 1)
        for state in states
    ]
    with np.errstate(invalid="ignore"):
        return stack([share / alive for share in shares], mass)


def plausibility_transform(mass: Array) -> Array:
    """Return the plausibilities of the single states, normalised to a probability, (..., K).

    Where conflict is all there is, the result is NaN.
    """
    columns = split_columns(mass)
    plausible: list[Any] = [
        sum(column for place, column in enumerate(columns) if place >> state & 1)
        for state in range(len(columns).bit_length() - 1)
    ]
    total = sum(plausible)
    with np.errstate(invalid="ignore"):
        return stack([number / total for number in plausible], mass)


def coarsen(mass: Array, groups: Sequence[Sequence[int]]) -> Array:
    """Return the mass function on a coarser frame whose states are groups of the old ones.

    A set becomes the set of all groups it touches (outer reduction). With states (free, static, dynamic),
    ``coarsen(mass, [(0,), (1, 2)])`` is the mass on (free, occupied).

    Parameters
    ----------
    mass : (..., 2**K) float32 or float64, numpy or torch
    groups : sequence of sequences of state numbers
        A partition of the states 0 ... K-1.
    """
    columns = split_columns(mass)
    bits = _partition(groups, len(columns).bit_length() - 1)
    result: Columns = [0 * columns[0]] * (1 << len(bits))
    for place, column in enumerate(columns):
        target = sum(1 << i for i, group in enumerate(bits) if group & place)
        result[target] = result[target] + column
    return stack(result, mass)


def refine(mass: Array, groups: Sequence[Sequence[int]]) -> Array:
    """Return the mass function on a finer frame in which state i becomes the group of states ``groups[i]``.

    Nothing is learnt by it (vacuous extension): ``coarsen(refine(mass, groups), groups)`` is `mass`.

    Parameters
    ----------
    mass : (..., 2**K) float32 or float64, numpy or torch
    groups : K sequences of state numbers
        A partition of the states of the finer frame.
    """
    columns = split_columns(mass)
    states = sum(len(group) for group in groups)
    bits = _partition(groups, states)
    if 1 << len(bits) != len(columns):
        raise ValueError(f"give one group per state, {len(columns).bit_length() - 1}, got {len(bits)}")
    result: Columns = [0 * columns[0]] * (1 << states)
    for place, column in enumerate(columns):
        result[sum(group for i, group in enumerate(bits) if place >> i & 1)] = column
    return stack(result, mass)


def _partition(groups: Sequence[Sequence[int]], states: int) -> list[int]:
    """Return the places of the groups, or refuse them if they are no partition of the states."""
    flat = sorted(state for group in groups for state in group)
    if flat != list(range(states)) or not all(groups):
        raise ValueError(f"groups must be a partition of the states 0 to {states - 1}, got {list(groups)}")
    if states > MOST_STATES:
        raise ValueError(f"frames of at most {MOST_STATES} states are supported, got {states}")
    return [subset(*group) for group in groups]
