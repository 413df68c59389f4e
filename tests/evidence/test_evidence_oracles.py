"""Independent libraries, asked only what they are known to answer rightly.

* `py_dempster_shafer` 0.7: not for cautious combination of masses with both states believed (it raises).
* `pybelief` 0.1.0: its ``specificity`` is the Hartley measure, so it is compared under its right name.
* `evtools-dst` 0.27.1: everything asked here, within u > 0 and conflict < 1.

At total conflict and u = 0 the libraries disagree with each other; our policy is tested in
test_evidence_edges.py.
"""

from typing import Any

import numpy as np
import pybelief

from ogm import evidence
from ogm.evidence import powerset

CELLS = 300
STATES = "fo"


def random_pairs(count: int = 2) -> list[np.ndarray]:
    """Interior masses, simple masses and vacuous ones, u >= 0.01."""
    rng = np.random.default_rng(7)
    masses = rng.dirichlet([1, 1, 1], (count, CELLS))[..., :2]
    masses[:, ::10, 0] = 0
    masses[:, 5::10, 1] = 0
    masses[0, ::25] = 0
    return list(0.99 * masses)


def random_general(count: int = 2) -> list[np.ndarray]:
    return list(np.random.default_rng(8).dirichlet([0.7] * 8, (count, 100)))


# --- py_dempster_shafer ---


def to_pyds(pair: np.ndarray) -> Any:
    import pyds

    free, occupied = pair.tolist()
    return pyds.MassFunction({"f": free, "o": occupied, "fo": 1 - free - occupied})


def from_pyds(mass: Any) -> tuple[float, float]:
    return mass["f"], mass["o"]


def test_py_dempster_shafer_agrees() -> None:
    a, b = random_pairs()
    pairs = [(to_pyds(x), to_pyds(y)) for x, y in zip(a, b, strict=True)]
    answers = {"dempster": [from_pyds(x & y) for x, y in pairs], "disjunctive": [from_pyds(x | y) for x, y in pairs]}
    for name, expected in answers.items():
        np.testing.assert_allclose(getattr(evidence, name)(a, b), expected, atol=1e-14)
    conjunctive = [x.combine_conjunctive(y, normalization=False) for x, y in pairs]
    expected = [(*from_pyds(m), m[frozenset("fo")]) for m in conjunctive]
    np.testing.assert_allclose(evidence.conjunctive(a, b), expected, atol=1e-14)
    pignistic = [x.pignistic()["o"] for x, _ in pairs]
    np.testing.assert_allclose(evidence.pignistic(a), pignistic, atol=1e-14)
    hartley = [x.hartley_measure() for x, _ in pairs]
    np.testing.assert_allclose(evidence.nonspecificity(a), hartley, atol=1e-14)


# --- pybelief ---


def to_pybelief(pair: np.ndarray) -> pybelief.MassFunction:
    free, occupied = pair.tolist()
    return pybelief.MassFunction(["f", "o"], {1: free, 2: occupied, 3: 1 - free - occupied})


def from_pybelief(mass: pybelief.MassFunction) -> tuple[float, float]:
    return mass.belief(1), mass.belief(2)


def test_pybelief_agrees() -> None:
    a, b = random_pairs()
    pairs = [(to_pybelief(x), to_pybelief(y)) for x, y in zip(a, b, strict=True)]
    np.testing.assert_allclose(evidence.yager(a, b), [from_pybelief(x.combine_yager(y)) for x, y in pairs], atol=1e-14)
    np.testing.assert_allclose(
        evidence.dempster(a, b), [from_pybelief(x.combine_dempster(y)) for x, y in pairs], atol=1e-14
    )
    np.testing.assert_allclose(evidence.conflict(a, b), [x.conflict(y) for x, y in pairs], atol=1e-14)
    np.testing.assert_allclose(evidence.deng_entropy(a), [x.entropy_deng() for x, _ in pairs], atol=1e-13)
    np.testing.assert_allclose(evidence.nonspecificity(a), [x.specificity() for x, _ in pairs], atol=1e-14)
    np.testing.assert_allclose(
        evidence.plausibility_transform(a), [x.plausibility_transform()["o"] for x, _ in pairs], atol=1e-14
    )
    np.testing.assert_allclose(evidence.pignistic(a), [x.pignistic()["o"] for x, _ in pairs], atol=1e-14)


# --- evtools ---


def to_evtools(mass: np.ndarray, frame: str = STATES) -> Any:
    from evtools import dsvector

    return dsvector.DSVector.from_dense(list(frame), mass)


def test_evtools_agrees() -> None:
    from evtools import combinations

    a, b = random_pairs()
    pairs = [(to_evtools(x), to_evtools(y)) for x, y in zip(powerset.from_pair(a), powerset.from_pair(b), strict=True)]
    answers = {"conjunctive": combinations.crc, "dempster": combinations.dempster, "disjunctive": combinations.drc}
    for name, combine in answers.items():
        expected = powerset.to_triple(np.array([combine(x, y).dense for x, y in pairs]))
        result = getattr(evidence, name)(a, b)
        np.testing.assert_allclose(result, expected[:, : result.shape[-1]], atol=1e-12)
    betp = np.array([x.to_betp() for x, _ in pairs])
    np.testing.assert_allclose(evidence.pignistic(a), betp[:, 1], atol=1e-12)


def test_evtools_agrees_on_discounting() -> None:
    from evtools import corrections

    a, _ = random_pairs()
    betas = {frozenset("f"): 0.7, frozenset("o"): 0.4}
    expected = [corrections.contextual_discount(to_evtools(x), betas).dense for x in powerset.from_pair(a)]
    np.testing.assert_allclose(evidence.contextual_discount(a, 0.7, 0.4), np.array(expected)[:, 1:3], atol=1e-13)
    faded = [corrections.discount(to_evtools(x), 0.3).dense for x in powerset.from_pair(a)]
    np.testing.assert_allclose(evidence.discount(a, 0.3), np.array(faded)[:, 1:3], atol=1e-13)


def test_evtools_agrees_on_three_states_in_the_open_world() -> None:
    from evtools import combinations

    a, b = random_general()
    for name, combine in {
        "conjunctive": combinations.crc,
        "disjunctive": combinations.drc,
        "cautious": combinations.cautious,
        "bold": combinations.bold,
    }.items():
        for x, y in zip(a[:40], b[:40], strict=True):
            expected = combine(to_evtools(x, "abc"), to_evtools(y, "abc")).dense
            np.testing.assert_allclose(getattr(powerset, name)(x, y), expected, atol=1e-10, err_msg=name)
