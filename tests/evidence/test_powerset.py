"""General frames: transforms that invert each other, the reference of the binary rules, frames of three states."""

from itertools import combinations, product
from typing import Any

import numpy as np
from cases import each
from hypothesis import given, settings
from masses import DTYPES, RULES, SHAPES, arrays_of_masses, rule, tolerance

from ogm import evidence
from ogm.evidence import powerset

laws = settings(max_examples=30, deadline=None)
# For two sources PCR5, PCR6 and PCR6+ are one rule; belief constraint fusion is Dempster's rule.
# The cautious rule is the general one, closed.
GENERAL = {name: name for name in RULES if name != "cautious"} | {
    "pcr6": "pcr5",
    "pcr6_plus": "pcr5",
    "belief_constraint": "dempster",
}


def random_masses(states: int, shape: tuple, dtype: Any = np.float64, seed: int = 0) -> np.ndarray:
    """Draw mass functions with some empty sets, conflict and dogmatic cells among them."""
    rng = np.random.default_rng(seed)
    weights = rng.exponential(size=(*shape, 1 << states)) * (rng.random((*shape, 1 << states)) < 0.7)
    weights[..., -1] += 1e-3
    return (weights / weights.sum(-1, keepdims=True)).astype(dtype)


@laws
@given(masses=arrays_of_masses(2))
@each("name", [name for name in GENERAL if name != "cumulative_epistemic"])
def test_binary_rules_are_the_general_ones(name: str, masses: Any) -> None:
    a, b = masses
    back = powerset.to_triple if RULES[name].open_world else powerset.to_pair
    expected = back(getattr(powerset, GENERAL[name])(powerset.from_pair(a), powerset.from_pair(b)))
    result = rule(name)(a, b)
    assert expected.dtype == result.dtype
    np.testing.assert_allclose(result, expected[..., : result.shape[-1]], atol=20 * tolerance(a))


@settings(max_examples=10, deadline=None)
@given(masses=arrays_of_masses(3))
@each("name", [name for name in RULES if name in powerset.__all__ and name not in ("cautious", "consensus_compromise")])
def test_binary_rules_of_three_sources_are_the_general_ones(name: str, masses: Any) -> None:
    back = powerset.to_triple if RULES[name].open_world else powerset.to_pair
    stack = np.stack(masses)
    general = [powerset.from_pair(mass) for mass in masses]
    expected = rule(name)(*masses)
    combine = getattr(powerset, name)
    possible = powerset.conjunctive(*general)[..., 0] < 1 - 1e-6  # in total conflict each has its own convention
    for found in (combine(*general), combine(powerset.from_pair(stack), axis=0)):
        given_back = back(found)[..., : expected.shape[-1]]
        np.testing.assert_allclose(given_back[possible], expected[possible], atol=50 * tolerance(stack))


def test_sources_in_total_conflict_get_their_mean_by_dempster() -> None:
    sure, unsure, opposite = np.array([1.0, 0.0]), np.array([1 / 3, 1 / 3]), np.array([0.0, 1.0])
    general = powerset.dempster(*map(powerset.from_pair, (sure, unsure, opposite)))
    np.testing.assert_allclose(powerset.to_pair(general), [4 / 9, 4 / 9])  # of all three
    np.testing.assert_allclose(evidence.dempster(sure, unsure, opposite), [1 / 2, 1 / 2])  # of the dogmatic ones


def test_epistemic_fusion_is_the_general_cumulative_one_maximised() -> None:
    a, b = np.random.default_rng(0).dirichlet([1, 1, 1], (2, 50))[..., :2]
    fused = powerset.to_pair(powerset.cumulative(powerset.from_pair(a), powerset.from_pair(b)))
    np.testing.assert_allclose(evidence.cumulative_epistemic(a, b), evidence.maximize_uncertainty(fused), atol=1e-12)


@laws
@given(masses=arrays_of_masses(2))
def test_the_cautious_rule_is_the_general_one_closed(masses: Any) -> None:
    a, b = (evidence.discount(mass, 0.9) for mass in masses)
    general = powerset.to_triple(powerset.cautious(powerset.from_pair(a), powerset.from_pair(b)))
    np.testing.assert_allclose(evidence.cautious(a, b), evidence.close_world(general), atol=20 * tolerance(a))


@laws
@given(masses=arrays_of_masses(2, states=3, least_unknown=1, least_conflict=1))
@each("name", ["conjunctive", "disjunctive"])
def test_open_world_rules_are_the_general_ones(name: str, masses: Any) -> None:
    a, b = masses
    general = getattr(powerset, name)(powerset.from_pair(a), powerset.from_pair(b))
    np.testing.assert_allclose(rule(name)(a, b), powerset.to_triple(general), atol=20 * tolerance(a))


@laws
@given(mass=arrays_of_masses())
def test_binary_transforms_are_the_general_ones(mass: np.ndarray) -> None:
    general = powerset.from_pair(mass)
    np.testing.assert_array_equal(powerset.to_pair(general), mass)
    np.testing.assert_allclose(powerset.pignistic(general)[..., 1], evidence.pignistic(mass), atol=tolerance(mass))
    np.testing.assert_allclose(
        powerset.plausibility_transform(general)[..., 1], evidence.plausibility_transform(mass), atol=tolerance(mass)
    )
    np.testing.assert_allclose(
        powerset.to_pair(powerset.discount(general, 0.7)), evidence.discount(mass, 0.7), atol=tolerance(mass)
    )
    np.testing.assert_allclose(
        powerset.to_pair(powerset.contextual_discount(general, [0.7, 0.4])),
        evidence.contextual_discount(mass, 0.7, 0.4),
        atol=tolerance(mass),
    )


@each("states", range(1, 7))
@each("dtype", DTYPES)
@each("shape", SHAPES)
def test_transforms_invert_each_other(states: int, dtype: Any, shape: tuple) -> None:
    mass = random_masses(states, shape, dtype)
    for there, back in [
        (powerset.mass_to_commonality, powerset.commonality_to_mass),
        (powerset.mass_to_implicability, powerset.implicability_to_mass),
        (powerset.mass_to_belief, powerset.belief_to_mass),
        (powerset.mass_to_plausibility, powerset.plausibility_to_mass),
    ]:
        result = back(there(mass))
        assert result.dtype == dtype
        np.testing.assert_allclose(result, mass, atol=1e-5 if dtype == np.float32 else 1e-13)


def test_transforms_are_their_definitions() -> None:
    mass = random_masses(3, (20,))
    sets = range(8)
    for a in sets:
        q = sum(mass[:, b] for b in sets if b & a == a)
        b_ = sum(mass[:, b] for b in sets if b & a == b)
        bel = sum(mass[:, b] for b in sets if b and b & a == b)
        pl = sum((mass[:, b] for b in sets if b & a), np.zeros(20))
        np.testing.assert_allclose(powerset.mass_to_commonality(mass)[:, a], q, atol=1e-14)
        np.testing.assert_allclose(powerset.mass_to_implicability(mass)[:, a], b_, atol=1e-14)
        np.testing.assert_allclose(powerset.mass_to_belief(mass)[:, a], bel, atol=1e-14)
        np.testing.assert_allclose(powerset.mass_to_plausibility(mass)[:, a], pl, atol=1e-14)


@each("name", ["conjunctive", "disjunctive", "yager", "dempster", "dubois_prade"])
def test_general_rules_are_their_definitions(name: str) -> None:
    """Pair by pair of subsets, as in the papers, on four states."""
    a, b = random_masses(4, (10,), seed=1), random_masses(4, (10,), seed=2)
    expected = np.zeros_like(a)
    for x, y in product(range(16), repeat=2):
        place = {"disjunctive": x | y, "dubois_prade": x & y or x | y}.get(name, x & y)
        expected[:, place] += a[:, x] * b[:, y]
    if name == "yager":
        expected[:, -1] += expected[:, 0]
    if name in ("yager", "dempster"):
        expected[:, 0] = 0
    expected /= expected.sum(-1, keepdims=True)
    np.testing.assert_allclose(getattr(powerset, name)(a, b), expected, atol=1e-13)


@each("states", [3, 4])
def test_general_consensus_compromise_is_its_definition(states: int) -> None:
    """Pair by pair of sets (van der Heijden et al. 2018), with base rates in proportion to the sizes of sets."""
    whole = frozenset(range(states))
    place = {subset: sum(1 << k for k in subset) for n in range(states + 1) for subset in combinations(whole, n)}
    sets = {frozenset(subset): number for subset, number in place.items() if subset and len(subset) < states}
    for a, b in zip(random_masses(states, (20,), seed=3), random_masses(states, (20,), seed=4), strict=True):
        a[0] = b[0] = 0
        a, b = a / a.sum(), b / b.sum()
        agreed = {one: min(a[n], b[n]) for one, n in sets.items()}
        compromise = dict.fromkeys([*sets, whole], 0.0)
        for (x, i), (y, j) in product(sets.items(), repeat=2):
            residues = (a[i] - agreed[x]) * (b[j] - agreed[y])
            both = (len(x & y) / len(x)) * (len(x & y) / len(y))
            compromise[x | y] += (1 - both) * residues
            if x & y:
                compromise[x & y] += both * residues
        for x, i in sets.items():
            compromise[x] += (a[i] - agreed[x]) * b[-1] + (b[i] - agreed[x]) * a[-1]
        left = 1 - sum(agreed.values()) - a[-1] * b[-1]
        expected = np.zeros(1 << states)
        for x, i in sets.items():
            expected[i] = agreed[x] + left * compromise[x] / sum(compromise.values())
        expected[-1] = 1 - expected.sum()
        np.testing.assert_allclose(powerset.consensus_compromise(a, b), expected, atol=1e-12)


@each("name", sorted(set(GENERAL.values()) - {"cumulative_epistemic"} | {"pcr6", "cautious", "bold"}))
@each("dtype", DTYPES)
@each("shape", SHAPES)
def test_general_rules_give_mass_functions(name: str, dtype: Any, shape: tuple) -> None:
    a, b = random_masses(3, shape, dtype, seed=1), random_masses(3, shape, dtype, seed=2)
    if name == "bold":
        a, b = (powerset.discount(m, 0.5) * dtype(0.9) + dtype(0.1) * np.eye(8, dtype=dtype)[0] for m in (a, b))
    combine = getattr(powerset, name)
    result = combine(a, b)
    assert result.dtype == dtype
    assert result.shape == a.shape
    powerset.check_powerset(result, tolerance=1e-4 if dtype == np.float32 else 1e-10)
    np.testing.assert_allclose(result, combine(b, a), atol=1e-4 if dtype == np.float32 else 1e-10)


def test_general_cautious_reads_certainty_as_almost_certain() -> None:
    certain, other = np.array([0, 1.0]), np.array([0.3, 0.5])
    for a, b in ((certain, certain), (certain, other), (other, certain)):
        general = powerset.cautious(powerset.from_pair(a), powerset.from_pair(b))
        closed = evidence.close_world(powerset.to_triple(general))
        np.testing.assert_allclose(closed, evidence.cautious(a, b), atol=1e-9)


def test_general_cautious_and_bold_are_idempotent() -> None:
    mass = random_masses(3, (30,)) * 0.9 + 0.1 * np.eye(8)[0]
    np.testing.assert_allclose(powerset.cautious(mass, mass), mass, atol=1e-9)
    np.testing.assert_allclose(powerset.bold(mass, mass), mass, atol=1e-9)


def test_general_rules_broadcast() -> None:
    grid, one = random_masses(3, (4, 5)), random_masses(3, ())
    for combine in (powerset.dempster, powerset.dubois_prade, powerset.cumulative):
        expected = combine(grid, np.broadcast_to(one, grid.shape).copy())
        np.testing.assert_allclose(combine(grid, one), expected, atol=1e-15)


def test_coarsening_undoes_refining() -> None:
    groups = [(0,), (1, 3), (2,)]
    mass = random_masses(3, (10,))
    np.testing.assert_array_equal(powerset.coarsen(powerset.refine(mass, groups), groups), mass)
    # Beliefs in sets of groups do not change by refining.
    fine = powerset.refine(mass, groups)
    bel, fine_bel = powerset.mass_to_belief(mass), powerset.mass_to_belief(fine)
    np.testing.assert_allclose(fine_bel[:, powerset.subset(0, 1, 3)], bel[:, powerset.subset(0, 1)])


def test_static_and_dynamic_coarsen_to_occupied() -> None:
    free, static, dynamic = 0, 1, 2
    mass = np.zeros(8)
    mass[powerset.subset(dynamic)], mass[powerset.subset(static, dynamic)] = 0.3, 0.4
    mass[powerset.subset(free, static)], mass[powerset.subset(free, static, dynamic)] = 0.1, 0.2
    coarse = powerset.to_pair(powerset.coarsen(mass, [(free,), (static, dynamic)]))
    np.testing.assert_allclose(coarse, (0, 0.7))
    assert powerset.subset() == 0
    assert powerset.subset(1, 1) == 2


def test_contextual_discount_with_equal_reliabilities_is_not_plain_discounting_of_three_states() -> None:
    mass = np.eye(8)[powerset.subset(0)]
    contextual = powerset.contextual_discount(mass, [0.5, 0.5, 0.5])
    expected = np.zeros(8)
    for i, j in product((0, 1), repeat=2):
        expected[1 | i << 1 | j << 2] = 0.25
    np.testing.assert_allclose(contextual, expected)
