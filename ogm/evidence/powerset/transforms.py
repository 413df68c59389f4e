"""Mass functions, their columns, and the fast Möbius transforms (Kennes and Smets, 1990).

Each transform is K passes of 2^(K-1) additions on columns, arrays (2**K, ...) with the power set on the first axis.
"""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from ogm.evidence.arrays import Array, check_float, namespace, per_cell, refuse_worst, split_open, tolerance_of

__all__ = [
    "belief_to_mass", "check_powerset", "commonality_to_mass", "from_beliefs", "from_pair", "implicability_to_mass",
    "mass_to_belief", "mass_to_commonality", "mass_to_implicability", "mass_to_plausibility", "plausibility_to_mass",
    "subset", "to_beliefs", "to_pair", "to_triple",
]  # fmt: skip

MAX_STATES = 6


def subset(*states: int) -> int:
    """Return the index on the last axis of the set of the given states; ``subset()`` is the empty set."""
    if any(not 0 <= state < MAX_STATES for state in states):
        raise ValueError(f"states must be numbers from 0 to {MAX_STATES - 1}, got {states}")
    return sum(1 << state for state in set(states))


def check_powerset(mass: Any, tolerance: float | None = None, name: str = "mass") -> None:
    """Raise ValueError unless every cell is a mass function: non-negative, with sum 1.

    The default tolerance is 2^K times 1e-6 (float32) or 1e-12 (float64).
    """
    columns_of(mass, name)
    values = mass if namespace(mass) is np else mass.detach().cpu().numpy()
    tolerance = tolerance_of(mass) * values.shape[-1] if tolerance is None else tolerance
    outside = np.maximum(-values.min(-1), abs(values.sum(-1) - 1))
    refuse_worst(outside, tolerance, values, name, "be non-negative and sum to 1 over the power set in every cell")


def from_pair(mass: Array) -> Array:
    """Return the mass function (conflict, free, occupied, unknown) of a pair or an open-world triple."""
    free, occupied, unknown, conflict = split_open(mass)
    return stack([conflict, free, occupied, unknown], mass)


def to_pair(mass: Array) -> Array:
    """Return the pair (free, occupied) of a mass function on two states without conflict."""
    conflict, free, occupied, _ = masses_of(mass, states=2)
    if namespace(mass) is np and conflict.size and conflict.max() > tolerance_of(mass):
        raise ValueError(
            f"mass must not have conflict, got up to {conflict.max()}; use to_triple, or normalise by dempster"
        )
    return stack([free, occupied], mass)


def to_triple(mass: Array) -> Array:
    """Return the open-world triple (free, occupied, unknown) of a mass function on two states; the rest is conflict."""
    _, free, occupied, unknown = masses_of(mass, states=2)
    return stack([free, occupied, unknown], mass)


def from_beliefs(belief: Array) -> Array:
    """Return the mass function of beliefs in single states (..., K); the rest is unknown."""
    xp = check_float(belief, "belief")
    given: Any = belief
    states = given.shape[-1] if given.ndim else 0
    if not 2 <= states <= MAX_STATES:
        raise ValueError(f"belief must be in 2 to {MAX_STATES} states on its last axis, got shape {tuple(given.shape)}")
    columns = [0 * given[..., 0]] * (1 << states)
    for state in range(states):
        columns[1 << state] = given[..., state]
    columns[-1] = 1 - given.sum(-1)
    mass = stack(columns, belief)
    if xp is np:
        check_powerset(mass, name="the mass function of belief")
    return mass


def to_beliefs(mass: Array) -> Array:
    """Return the beliefs in single states (..., K) of a mass function; all other masses become unknown."""
    columns = masses_of(mass)
    return stack([columns[1 << state] for state in range(len(columns).bit_length() - 1)], mass)


def mass_to_commonality(mass: Array) -> Array:
    """Return the commonality function, q(A) = sum of m(B) over all B that contain A."""
    return stack(sum_supersets(masses_of(mass)), mass)


def commonality_to_mass(commonality: Array) -> Array:
    """Return the mass function of a commonality function."""
    return stack(difference_supersets(columns_of(commonality, "commonality")), commonality)


def mass_to_implicability(mass: Array) -> Array:
    """Return the implicability function, b(A) = sum of m(B) over all B in A, with the empty set."""
    return stack(sum_subsets(masses_of(mass)), mass)


def implicability_to_mass(implicability: Array) -> Array:
    """Return the mass function of an implicability function."""
    return stack(difference_subsets(columns_of(implicability, "implicability")), implicability)


def mass_to_belief(mass: Array) -> Array:
    """Return the belief function, bel(A) = sum of m(B) over all B in A except the empty set."""
    columns = masses_of(mass)
    return stack(sum_subsets(namespace(mass).stack([0 * columns[0], *columns[1:]])), mass)


def belief_to_mass(belief: Array) -> Array:
    """Return the mass function of a belief function; 1 - bel(frame) is conflict."""
    columns = columns_of(belief, "belief")
    return stack([1 - columns[-1], *difference_subsets(columns)[1:]], belief)


def mass_to_plausibility(mass: Array) -> Array:
    """Return the plausibility function, pl(A) = sum of m(B) over all B that meet A."""
    below = sum_subsets(masses_of(mass))
    return stack(reversed(below[-1] - below), mass)


def plausibility_to_mass(plausibility: Array) -> Array:
    """Return the mass function of a plausibility function; 1 - pl(frame) is conflict."""
    columns = columns_of(plausibility, "plausibility")
    xp = namespace(plausibility)
    return stack(difference_subsets(1 - xp.stack(list(reversed(columns)))), plausibility)


def columns_of(values: Any, name: str, states: int | None = None) -> Any:
    """Check library, dtype and last axis; return the columns."""
    xp = check_float(values, name)
    size = values.shape[-1] if values.ndim else 0
    if size < 2 or size & (size - 1):
        raise ValueError(f"{name} must have 2^K numbers on its last axis, got shape {tuple(values.shape)}")
    if size > 1 << MAX_STATES:
        raise ValueError(
            f"frames of at most {MAX_STATES} states are supported, got {size.bit_length() - 1}; coarsen the frame first"
        )
    if states is not None and size != 1 << states:
        raise ValueError(f"{name} must be on a frame of {states} states, got shape {tuple(values.shape)}")
    columns = xp.moveaxis(values, -1, 0)
    return np.ascontiguousarray(columns) if xp is np else columns.contiguous()


def masses_of(mass: Any, name: str = "mass", states: int | None = None) -> Any:
    """Check a mass function (values too, in numpy) and return its columns."""
    columns = columns_of(mass, name, states)
    if namespace(mass) is np:
        slack, total = tolerance_of(mass) * len(columns), columns.sum(0)
        if not (mass.min(initial=0) >= -slack and (abs(total - 1) <= slack).all()):
            check_powerset(mass, name=name)
    return columns


def stack(columns: Iterable[Any], mass: Array) -> Array:
    """Return columns with the power set on the last axis, in the dtype of `mass`."""
    return per_cell(namespace(mass).stack(list(columns), -1), mass)


def sum_subsets(columns: Any) -> Any:
    """Apply the zeta transform: replace each number by the sum over the subsets."""
    return _butterfly(columns, lambda without, with_: (without, with_ + without))


def difference_subsets(columns: Any) -> Any:
    """Apply the Möbius transform, the inverse of `sum_subsets`."""
    return _butterfly(columns, lambda without, with_: (without, with_ - without))


def sum_supersets(columns: Any) -> Any:
    """Apply the zeta transform: replace each number by the sum over the supersets."""
    return _butterfly(columns, lambda without, with_: (without + with_, with_))


def difference_supersets(columns: Any) -> Any:
    """Apply the Möbius transform, the inverse of `sum_supersets`."""
    return _butterfly(columns, lambda without, with_: (without - with_, with_))


def _butterfly(columns: Any, step: Callable[[Any, Any], tuple[Any, Any]]) -> Any:
    """Apply `step` state by state to pairs of sets without and with the state (Kennes and Smets 1990)."""
    xp, shape, bit = namespace(columns), tuple(columns.shape), 1
    while bit < shape[0]:
        pairs = columns.reshape(shape[0] // (2 * bit), 2, bit, *shape[1:])
        columns = xp.stack(step(pairs[:, 0], pairs[:, 1]), 1).reshape(shape)
        bit *= 2
    return columns
