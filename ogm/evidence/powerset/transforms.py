"""Mass functions on a frame of K states as arrays ``[..., 2**K]``, and their fast Möbius transforms.

The last axis is the power set: place ``A`` belongs to the set whose states are the bits of ``A``. With the
states (free, static, dynamic), place 0b000 is the empty set, 0b001 is {free}, 0b110 is {static, dynamic} and
0b111 is the whole frame; `subset` spells the places. For K = 2 and (free, occupied) the four numbers are
(conflict, free, occupied, unknown).

Each transform is K passes of 2^(K-1) additions (Kennes and Smets, "Computational aspects of the Möbius
transformation", 1990) on columns, one array of cells per subset: no loop over cells, no matrix of size 4^K.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from ogm.evidence.arrays import Array, dtype_name, namespace, split_open, tolerance_of

__all__ = [
    "belief_to_mass",
    "check_powerset",
    "commonality_to_mass",
    "from_pair",
    "implicability_to_mass",
    "mass_to_belief",
    "mass_to_commonality",
    "mass_to_implicability",
    "mass_to_plausibility",
    "plausibility_to_mass",
    "subset",
    "to_pair",
    "to_triple",
]

MOST_STATES = 6

Columns = list[Any]  # one array of cells per subset


def subset(*states: int) -> int:
    """Return the place on the last axis of the set of these states; ``subset()`` is the empty set."""
    if any(not 0 <= state < MOST_STATES for state in states):
        raise ValueError(f"states must be numbers from 0 to {MOST_STATES - 1}, got {states}")
    return sum(1 << state for state in set(states))


def from_pair(mass: Array) -> Array:
    """Return the mass function (conflict, free, occupied, unknown) of a pair or an open-world triple."""
    free, occupied, unknown, conflict = split_open(mass)
    return stack([conflict, free, occupied, unknown], mass)


def to_pair(mass: Array) -> Array:
    """Return the pair (free, occupied) of a mass function on two states.

    Raises
    ------
    ValueError
        If the frame has not 2 states, or if a numpy mass function has conflict: use `to_triple`, or
        normalise.
    """
    columns = split_columns(mass, states=2)
    if namespace(mass) is np and columns[0].size and columns[0].max() > tolerance_of(mass):
        raise ValueError(
            f"a pair has no place for conflict, got up to {columns[0].max()}; "
            f"use to_triple, or dempster to normalise"
        )
    return stack(columns[1:3], mass)


def to_triple(mass: Array) -> Array:
    """Return the open-world triple (free, occupied, conflict) of a mass function on two states."""
    columns = split_columns(mass, states=2)
    return stack([columns[1], columns[2], columns[0]], mass)


def mass_to_commonality(mass: Array) -> Array:
    """Return q(A) = sum of m(B) over all B that contain A."""
    return stack(sum_supersets(split_columns(mass)), mass)


def commonality_to_mass(commonality: Array) -> Array:
    """Return the mass function of a commonality function."""
    return stack(difference_supersets(form_columns(commonality, "commonality")), commonality)


def mass_to_implicability(mass: Array) -> Array:
    """Return b(A) = sum of m(B) over all B inside A, the empty set included."""
    return stack(sum_subsets(split_columns(mass)), mass)


def implicability_to_mass(implicability: Array) -> Array:
    """Return the mass function of an implicability function."""
    return stack(difference_subsets(form_columns(implicability, "implicability")), implicability)


def mass_to_belief(mass: Array) -> Array:
    """Return bel(A) = sum of m(B) over all B inside A but the empty set."""
    columns = split_columns(mass)
    return stack(sum_subsets([0 * columns[0], *columns[1:]]), mass)


def belief_to_mass(belief: Array) -> Array:
    """Return the mass function of a belief function; what bel(frame) lacks to 1 is conflict."""
    columns = form_columns(belief, "belief")
    masses = difference_subsets(columns)
    return stack([1 - columns[-1], *masses[1:]], belief)


def mass_to_plausibility(mass: Array) -> Array:
    """Return pl(A) = sum of m(B) over all B that meet A."""
    below = sum_subsets(split_columns(mass))
    return stack([below[-1] - column for column in reversed(below)], mass)


def plausibility_to_mass(plausibility: Array) -> Array:
    """Return the mass function of a plausibility function; what pl(frame) lacks to 1 is conflict."""
    columns = form_columns(plausibility, "plausibility")
    return stack(difference_subsets([1 - column for column in reversed(columns)]), plausibility)


def check_powerset(mass: Any, tolerance: float | None = None, name: str = "mass") -> None:
    """Raise unless every cell is a mass function: non-negative, with sum 1.

    Parameters
    ----------
    mass : (..., 2**K) float32 or float64, numpy or torch
        K from 1 to 6.
    tolerance : float, optional
        How far a mass may lie below 0 or a sum from 1; by default 2^K times 1e-6 (float32) or 1e-12
        (float64).
    name : str
        What the error message calls the array.

    Raises
    ------
    ValueError
        If a cell is NaN or no mass function; the message names the worst cell, its value and the tolerance.
    """
    columns = form_columns(mass, name)
    values = mass if namespace(mass) is np else mass.detach().cpu().numpy()
    tolerance = tolerance_of(mass) * len(columns) if tolerance is None else tolerance
    if values.size == 0:
        return
    outside = np.maximum(-values.min(-1), abs(values.sum(-1) - 1))
    outside = np.where(np.isnan(outside), np.inf, outside)
    if (outside <= tolerance).all():
        return
    index = tuple(int(i) for i in np.unravel_index(int(outside.argmax()), outside.shape))
    place = f"{name}[{', '.join(map(str, (*index, ':')))}]"
    raise ValueError(
        f"{name} must be non-negative and sum to 1 over the power set in every cell (tolerance "
        f"{tolerance:g}), but the worst cell, {place}, is {values[index].tolist()}"
    )


def form_columns(values: Any, name: str, states: int | None = None) -> Columns:
    """Check library, dtype and last axis; return one array of cells per subset."""
    namespace(values, name)
    if dtype_name(values) not in ("float32", "float64"):
        raise TypeError(f"{name} must be float32 or float64, got {dtype_name(values)}")
    size = values.shape[-1] if values.ndim else 0
    if size < 2 or size & (size - 1):
        raise ValueError(f"{name} must have 2^K numbers on its last axis, got shape {tuple(values.shape)}")
    if size > 1 << MOST_STATES:
        raise ValueError(
            f"frames of at most {MOST_STATES} states are supported, got {size.bit_length() - 1}; "
            f"coarsen the frame first"
        )
    if states is not None and size != 1 << states:
        raise ValueError(f"{name} must be on a frame of {states} states, got shape {tuple(values.shape)}")
    return [values[..., i] for i in range(size)]


def split_columns(mass: Any, name: str = "mass", states: int | None = None) -> Columns:
    """Check a mass function (values too, in numpy) and return one array of cells per subset."""
    columns = form_columns(mass, name, states)
    if namespace(mass) is np:
        total: Any = sum(columns[1:], start=columns[0])
        slack = tolerance_of(mass) * len(columns)
        if not (
            mass.min(initial=0) >= -slack
            and total.min(initial=1) >= 1 - slack
            and total.max(initial=1) <= 1 + slack
        ):
            check_powerset(mass, name=name)
    return columns


def stack(columns: Columns, mass: Any) -> Any:
    """Put columns back on a last axis, in the dtype of `mass`."""
    xp = namespace(mass)
    if xp is np:
        return np.stack(columns, axis=-1).astype(mass.dtype, copy=False)
    return xp.stack(columns, dim=-1)


def sum_subsets(columns: Columns) -> Columns:
    """Zeta transform: each place becomes the sum over its subsets."""
    return _butterfly(columns, lambda with_bit, without: (with_bit + without, without))


def difference_subsets(columns: Columns) -> Columns:
    """Möbius transform: inverse of `sum_subsets`."""
    return _butterfly(columns, lambda with_bit, without: (with_bit - without, without))


def sum_supersets(columns: Columns) -> Columns:
    """Zeta transform: each place becomes the sum over its supersets."""
    return _butterfly(columns, lambda with_bit, without: (with_bit, without + with_bit))


def difference_supersets(columns: Columns) -> Columns:
    """Möbius transform: inverse of `sum_supersets`."""
    return _butterfly(columns, lambda with_bit, without: (with_bit, without - with_bit))


def _butterfly(columns: Columns, step: Callable[[Any, Any], tuple[Any, Any]]) -> Columns:
    """Pass over the states; in each pass treat the pairs of subsets that differ in that state alone."""
    result = list(columns)
    bit = 1
    while bit < len(result):
        for place in range(len(result)):
            if place & bit:
                result[place], result[place ^ bit] = step(result[place], result[place ^ bit])
        bit <<= 1
    return result
