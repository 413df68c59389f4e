"""Masses for the tests: strategies, shapes, and the laws of each rule."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from hypothesis import strategies as st

from ogm import evidence

SHAPES = [(), (5,), (2, 3), (0,)]
DTYPES = [np.float32, np.float64]

# Mass triples (free, occupied, unknown) of the published examples.
A, B = (0.5, 0.2, 0.3), (0.1, 0.6, 0.3)
C1, C2, C3 = (0.3, 0.1, 0.6), (0.2, 0.4, 0.4), (0.1, 0.7, 0.2)


def pair(triple: tuple[float, ...], dtype: Any = np.float64) -> np.ndarray:
    return np.array(triple[:2], dtype)


def triple(mass: np.ndarray) -> np.ndarray:
    """Return (free, occupied, unknown) of a pair."""
    return np.concatenate([mass, 1 - mass.sum(-1, keepdims=True)], axis=-1)


def swapped(mass: np.ndarray) -> np.ndarray:
    """Exchange free and occupied; conflict, where there is one, stays."""
    return np.concatenate([mass[..., 1::-1], mass[..., 2:]], axis=-1)


def tolerance(mass: np.ndarray) -> float:
    return 2e-5 if mass.dtype == np.float32 else 1e-10


@st.composite
def arrays_of_masses(
    draw: Callable[..., Any], count: int = 1, *, states: int = 2, least_unknown: int = 0, least_conflict: int = 0
) -> Any:
    """Draw `count` mass arrays of one shape and dtype, edges and corners of the simplex included.

    Weights are whole numbers: (free, occupied, unknown[, conflict]) / sum.
    """
    shape = draw(st.sampled_from(SHAPES))
    dtype = draw(st.sampled_from(DTYPES))
    weight = st.one_of(st.integers(0, 100), st.sampled_from([0, 1, 100]))
    cells = int(np.prod(shape))
    result = []
    for _ in range(count):
        rows = [draw(st.tuples(*[weight] * (states + 1))) for _ in range(cells)]
        weights = np.array(rows, float).reshape(*shape, states + 1)
        weights[..., 2] = np.maximum(weights[..., 2], least_unknown)
        if states == 3:
            weights[..., 3] = np.maximum(weights[..., 3], least_conflict)
        weights[weights.sum(-1) == 0] = 1
        weights = weights / weights.sum(-1, keepdims=True)
        result.append(weights[..., :states].astype(dtype))
    return result[0] if count == 1 else tuple(result)


@dataclass(frozen=True)
class Laws:
    """The laws of a rule, as in the table of the documentation."""

    associative: bool
    vacuous_is_neutral: bool
    idempotent: bool
    open_world: bool = False


RULES = {
    "conjunctive": Laws(True, True, False, open_world=True),
    "dempster": Laws(True, True, False),
    "yager": Laws(False, True, False),
    "dubois_prade": Laws(False, True, False),
    "disjunctive": Laws(True, False, False, open_world=True),
    "cautious": Laws(True, True, True),
    "pcr5": Laws(False, True, False),
    "pcr6": Laws(False, True, False),
    "pcr6_plus": Laws(False, True, False),
    "murphy": Laws(False, False, False),
    "cumulative": Laws(True, True, False),
    "cumulative_epistemic": Laws(False, False, False),
    "averaging": Laws(False, False, True),
    "weighted": Laws(False, True, True),
    "belief_constraint": Laws(True, True, False),
    "consensus_compromise": Laws(False, True, True),
}
CLOSED = [name for name, laws in RULES.items() if not laws.open_world]


def rule(name: str) -> Callable[..., Any]:
    return getattr(evidence, name)
