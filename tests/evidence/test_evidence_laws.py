"""Laws that hold for all masses, in float32 and float64 and for every batch shape."""

import inspect
from typing import Any

import numpy as np
from cases import each
from hypothesis import given, settings
from hypothesis import strategies as st
from masses import CLOSED, RULES, arrays_of_masses, pair, rule, swapped, tolerance, triple

from ogm import evidence

laws = settings(max_examples=25, deadline=None)
three = settings(max_examples=15, deadline=None)
numbers = st.integers(0, 20).map(lambda n: n / 20)


def same(actual: Any, expected: Any, times: float = 1) -> None:
    assert actual.dtype == expected.dtype
    assert actual.shape == expected.shape
    np.testing.assert_allclose(actual, expected, atol=times * tolerance(np.asarray(expected)), rtol=0)


@laws
@given(masses=arrays_of_masses(2), axis=st.integers(0, 2))
@each("name", RULES)
def test_rules_give_masses_in_any_order_of_sources_and_states(name: str, masses: Any, axis: int) -> None:
    a, b = masses
    result, axis = rule(name)(a, b), axis % a.ndim
    assert result.dtype == a.dtype
    assert result.shape[:-1] == a.shape[:-1]
    evidence.check_mass(result)
    same(rule(name)(b, a), result)
    same(rule(name)(swapped(a), swapped(b)), swapped(result))
    same(rule(name)(np.stack([a, b], axis=axis), axis=axis), result)
    same(rule(name)(np.stack([a, b], axis=axis), axis=axis - a.ndim - 1), result)


@three
@given(masses=arrays_of_masses(3, least_unknown=1))
@each("name", [name for name, law in RULES.items() if law.associative])
def test_rules_are_associative(name: str, masses: Any) -> None:
    # Dempster's rule and cumulative fusion are not associative across cells without any unknown (their edge
    # policy).
    a, b, c = masses
    combine = rule(name)
    left, right = combine(combine(a, b), c), combine(a, combine(b, c))
    same(left, right, times=20)
    same(combine(np.stack([a, b, c]), axis=0), left, times=20)
    same(combine(a, b, c), left, times=20)


@each("name", [name for name, law in RULES.items() if not law.associative])
def test_rules_that_claim_no_associativity_have_none(name: str) -> None:
    a, b, c = pair((0.5, 0.2, 0.3)), pair((0.1, 0.6, 0.3)), pair((0.1, 0.7, 0.2))
    combine = rule(name)
    assert abs(combine(combine(a, b), c) - combine(a, combine(b, c))).max() > 1e-3


@laws
@given(mass=arrays_of_masses())
@each("name", [name for name, law in RULES.items() if law.vacuous_is_neutral])
def test_vacuous_is_neutral(name: str, mass: np.ndarray) -> None:
    same(rule(name)(mass, np.zeros_like(mass))[..., :2], mass)


@each("name", [name for name, law in RULES.items() if not law.vacuous_is_neutral])
def test_rules_that_claim_no_neutral_vacuous_have_none(name: str) -> None:
    mass = np.array([0.5, 0.2])
    assert abs(rule(name)(mass, 0 * mass)[..., :2] - mass).max() > 1e-3


@laws
@given(mass=arrays_of_masses())
@each("name", [name for name, law in RULES.items() if law.idempotent])
def test_rules_are_idempotent(name: str, mass: np.ndarray) -> None:
    same(rule(name)(mass, mass), mass)


@each("name", [name for name, law in RULES.items() if not law.idempotent])
def test_rules_that_claim_no_idempotence_have_none(name: str) -> None:
    mass = pair((0.5, 0.2, 0.3))
    assert abs(rule(name)(mass, mass)[..., :2] - mass).max() > 1e-3


@three
@given(masses=arrays_of_masses(4))
@each("name", CLOSED)
def test_the_order_in_a_stack_does_not_matter(name: str, masses: Any) -> None:
    combine = rule(name)
    same(combine(np.stack(masses), axis=0), combine(np.stack(masses[::-1]), axis=0))
    if name in ("dempster", "cumulative", "averaging", "weighted", "yager", "murphy"):
        same(combine(masses[0][None], axis=0), masses[0])


@laws
@given(mass=arrays_of_masses(4))
def test_pcr6_plus_and_weighted_ignore_vacuous_sources_in_any_stack(mass: Any) -> None:
    with_vacuous = np.stack([*mass, np.zeros_like(mass[0])])
    for fuse in (evidence.pcr6_plus, evidence.weighted, evidence.yager, evidence.dempster, evidence.cumulative):
        same(fuse(with_vacuous, axis=0), fuse(np.stack(mass), axis=0))


@laws
@given(masses=arrays_of_masses(2, least_unknown=1))
def test_dempster_adds_log_odds(masses: Any) -> None:
    a, b = masses
    expected = evidence.mass_to_log_odds(a) + evidence.mass_to_log_odds(b)
    same(evidence.mass_to_log_odds(evidence.dempster(a, b)), expected, times=200)


@laws
@given(masses=arrays_of_masses(2, least_unknown=5))
def test_unfusion_inverts_cumulative_fusion(masses: Any) -> None:
    a, b = masses
    same(evidence.cumulative_unfusion(evidence.cumulative(a, b), a), b, times=200)


@laws
@given(masses=arrays_of_masses(2, least_unknown=1))
def test_cumulative_fusion_adds_evidence(masses: Any) -> None:
    a, b = masses
    total = evidence.mass_to_evidence(a) + evidence.mass_to_evidence(b)
    same(evidence.cumulative(a, b), evidence.evidence_to_mass(total), times=5)


@laws
@given(masses=arrays_of_masses(2, least_unknown=1))
def test_averaging_fusion_averages_evidence(masses: Any) -> None:
    a, b = masses
    mean = (evidence.mass_to_evidence(a) + evidence.mass_to_evidence(b)) / 2
    same(evidence.averaging(a, b), evidence.evidence_to_mass(mean), times=5)


@laws
@given(masses=arrays_of_masses(2))
def test_combining_never_adds_ignorance(masses: Any) -> None:
    a, b = masses
    least = np.minimum(evidence.unknown(a), evidence.unknown(b))
    assert (evidence.unknown(evidence.cumulative(a, b)) <= least + tolerance(a)).all()
    open_mass = evidence.conjunctive(a, b)
    assert (open_mass[..., 2] <= least + tolerance(a)).all()


@laws
@given(masses=arrays_of_masses(2))
def test_yager_is_the_conjunctive_rule_with_conflict_as_unknown(masses: Any) -> None:
    a, b = masses
    open_mass = evidence.conjunctive(a, b)
    same(evidence.yager(a, b), open_mass[..., :2])
    same(1 - open_mass.sum(-1), evidence.conflict(a, b), times=5)
    same(evidence.close_world(open_mass), evidence.dempster(a, b), times=5)


@laws
@given(masses=arrays_of_masses(2))
def test_conflict_splits_by_direction(masses: Any) -> None:
    a, b = masses
    both = evidence.conflict_direction(a, b)
    same(both.sum(-1), evidence.conflict(a, b))
    same(both, evidence.conflict_direction(b, a)[..., ::-1])
    same(both, evidence.conflict_direction(swapped(a), swapped(b))[..., ::-1])


@laws
@given(mass=arrays_of_masses(), first=numbers, second=numbers)
def test_discounts_compose(mass: np.ndarray, first: float, second: float) -> None:
    for discount in (evidence.discount, evidence.discount_evidence):
        same(discount(discount(mass, first), second), discount(mass, first * second), times=5)
        same(discount(mass, 1.0), mass)
        same(discount(mass, 0.0), np.zeros_like(mass))


@laws
@given(mass=arrays_of_masses(), one=numbers, other=numbers)
def test_forgetting_does_not_depend_on_the_steps(mass: np.ndarray, one: float, other: float) -> None:
    step = evidence.discount_over_time(evidence.discount_over_time(mass, one, 0.7), other, 0.7)
    same(step, evidence.discount_over_time(mass, one + other, 0.7), times=5)
    same(evidence.discount_over_time(mass, 3.0, half_life=3.0), mass / 2)
    same(evidence.discount_over_time(mass, 3.0, half_life=float("inf")), mass)


@laws
@given(mass=arrays_of_masses(least_unknown=1), reliability=numbers)
def test_evidence_discounting_scales_evidence(mass: np.ndarray, reliability: float) -> None:
    scaled = evidence.mass_to_evidence(mass) * reliability
    same(evidence.discount_evidence(mass, reliability), evidence.evidence_to_mass(scaled.astype(mass.dtype)))


@laws
@given(mass=arrays_of_masses(), reliability=numbers)
def test_discounting_by_one_number_and_by_an_array_agree(mass: np.ndarray, reliability: float) -> None:
    per_cell = np.full(mass.shape[:-1], reliability, mass.dtype)
    for discount in (evidence.discount, evidence.discount_evidence):
        same(discount(mass, per_cell), discount(mass, reliability))
    same(evidence.contextual_discount(mass, per_cell, per_cell), evidence.discount(mass, reliability))


@laws
@given(masses=arrays_of_masses(2), base_rate=numbers)
def test_trust_discounting_is_discounting_by_the_projected_trust(masses: Any, base_rate: float) -> None:
    mass, trust = masses
    reliability = evidence.mass_to_probability(trust, base_rate)
    same(evidence.trust_discount(mass, trust, base_rate), evidence.discount(mass, reliability))


@laws
@given(masses=arrays_of_masses(2))
def test_full_distrust_turns_an_opposite_discount_around(masses: Any) -> None:
    mass, trust = masses
    distrust, full_trust = np.zeros_like(mass), np.zeros_like(mass)
    distrust[..., 0], full_trust[..., 1] = 1, 1
    same(evidence.trust_discount_opposite(mass, distrust), swapped(mass))
    same(evidence.trust_discount_opposite(mass, full_trust), mass)
    evidence.check_mass(evidence.trust_discount_opposite(mass, trust))


@laws
@given(mass=arrays_of_masses())
def test_probabilities_lie_between_belief_and_plausibility(mass: np.ndarray) -> None:
    free, occupied = mass[..., 0], mass[..., 1]
    for transform in (evidence.pignistic, evidence.plausibility_transform):
        probability = transform(mass)
        assert (occupied - tolerance(mass) <= probability).all()
        assert (probability <= 1 - free + tolerance(mass)).all()


@laws
@given(mass=arrays_of_masses(), base_rate=numbers)
def test_uncertainty_maximisation_keeps_the_probability(mass: np.ndarray, base_rate: float) -> None:
    maximal = evidence.maximize_uncertainty(mass, base_rate)
    evidence.check_mass(maximal)
    same(evidence.mass_to_probability(maximal, base_rate), evidence.mass_to_probability(mass, base_rate), times=5)
    assert (evidence.unknown(maximal) >= evidence.unknown(mass) - tolerance(mass)).all()
    assert (maximal.min(-1) <= tolerance(mass)).all()
    same(evidence.maximize_uncertainty(maximal, base_rate), maximal, times=5)


@laws
@given(masses=arrays_of_masses(2), base_rate=numbers)
def test_measures_lie_in_their_ranges(masses: Any, base_rate: float) -> None:
    a, b = masses
    ranges = {
        "conflict": (0, 1, evidence.conflict(a, b)),
        "degree_of_conflict": (0, 1, evidence.degree_of_conflict(a, b, base_rate)),
        "jousselme": (0, 1, evidence.jousselme_distance(a, b)),
        "vacuity": (0, 1, evidence.vacuity(a)),
        "dissonance": (0, 1, evidence.dissonance(a)),
        "specificity": (0.5, 1, evidence.specificity(a)),
        "yager": (0, 1, evidence.yager_entropy(a)),
        "pignistic": (0, 1, evidence.pignistic_entropy(a)),
        "jirousek_shenoy": (0, 2, evidence.jirousek_shenoy_entropy(a)),
        "deng": (0, np.log2(5), evidence.deng_entropy(a)),
    }
    for name, (low, high, value) in ranges.items():
        assert value.dtype == a.dtype, name
        assert value.shape == a.shape[:-1], name
        assert ((value >= low - tolerance(a)) & (value <= high + tolerance(a))).all(), name


@laws
@given(masses=arrays_of_masses(3))
def test_jousselme_is_a_distance(masses: Any) -> None:
    a, b, c = masses
    distance = evidence.jousselme_distance
    same(distance(a, a), np.zeros_like(a[..., 0]))
    same(distance(a, b), distance(b, a))
    assert (distance(a, c) <= distance(a, b) + distance(b, c) + tolerance(a)).all()
    # The closed form is the published one, with the matrix of Jaccard indices.
    jaccard = np.array([[1, 0, 0.5], [0, 1, 0.5], [0.5, 0.5, 1]])
    d = triple(a).astype(float) - triple(b)
    quadratic = np.sqrt(np.maximum(np.einsum("...i,ij,...j->...", d, jaccard, d) / 2, 0))
    np.testing.assert_allclose(distance(a, b), quadratic, atol=1e-3 if a.dtype == np.float32 else 1e-7)


def twentieths(low: int, high: int) -> st.SearchStrategy[tuple[float, float]]:
    """Return a strategy of two multiples of 1 / 20."""
    return st.tuples(*[st.integers(low, high).map(lambda count: count / 20)] * 2)


@laws
@given(masses=arrays_of_masses(2), rates=twentieths(0, 19))
def test_multiplication_multiplies_probabilities(masses: Any, rates: tuple[float, float]) -> None:
    (x, y), (a, r) = masses, rates
    both, rate = evidence.multiplication(x, y, a, r)
    evidence.check_mass(both)
    product = evidence.mass_to_probability(x, a) * evidence.mass_to_probability(y, r)
    same(evidence.mass_to_probability(both, rate), product, times=5)


@laws
@given(masses=arrays_of_masses(2), rates=twentieths(1, 20))
def test_comultiplication_is_the_dual_of_multiplication(masses: Any, rates: tuple[float, float]) -> None:
    (x, y), (a, r) = masses, rates
    either, rate = evidence.comultiplication(x, y, a, r)
    neither = evidence.multiplication(swapped(x), swapped(y), 1 - a, 1 - r)
    same(either, swapped(neither.mass), times=5)
    same(rate, 1 - neither.base_rate, times=5)


@laws
@given(masses=arrays_of_masses(3), base_rate=numbers)
def test_deduction_follows_the_law_of_total_probability(masses: Any, base_rate: float) -> None:
    x, if_true, if_false = masses
    y, rate = evidence.deduction(x, if_true, if_false, base_rate)
    evidence.check_mass(y, tolerance=tolerance(x))
    p = evidence.mass_to_probability(x, base_rate)
    p_true, p_false_alarm = (evidence.mass_to_probability(c, rate) for c in (if_true, if_false))
    same(evidence.mass_to_probability(evidence.renormalize(y), rate), p * p_true + (1 - p) * p_false_alarm, times=5)


@three
@given(conditionals=arrays_of_masses(2))
def test_deduction_from_certainty_is_the_conditional(conditionals: Any) -> None:
    if_true, if_false = conditionals
    certain = np.zeros_like(if_true)
    certain[..., 1] = 1
    same(evidence.deduction(certain, if_true, if_false).mass, if_true, times=5)
    same(evidence.deduction(swapped(certain), if_true, if_false).mass, if_false, times=5)


@each("base_rate", [0.1, 0.5, 0.8])
def test_deduction_from_nothing_keeps_what_both_conditionals_hold(base_rate: float) -> None:
    """The most unknown that keeps the projected probability and the belief and disbelief that both have at least."""
    rng = np.random.default_rng(0)
    if_true, if_false = rng.dirichlet([1, 1, 1], (2, 400))[..., :2]
    y, rate = evidence.deduction(np.zeros((400, 2)), if_true, if_false, base_rate)
    spare = y - np.minimum(if_true, if_false)
    assert spare.min() >= -1e-12
    np.testing.assert_allclose(spare.min(axis=-1), 0, atol=1e-12)
    p_true, p_false = (evidence.mass_to_probability(one, rate) for one in (if_true, if_false))
    same(evidence.mass_to_probability(y, rate), base_rate * p_true + (1 - base_rate) * p_false)


def test_defaults_are_those_of_the_literature() -> None:
    """Base rate 1/2 and prior weight 2 (Jøsang 2016); the sensor's error rates of counts as in `RayISM`."""
    wanted = {"base_rate": 0.5, "prior_weight": 2, "p_miss": 0.8, "p_false_alarm": 0.05}
    found = set()
    for function in (getattr(evidence, name) for name in evidence.__all__ if callable(getattr(evidence, name))):
        for name, parameter in inspect.signature(function).parameters.items():
            name = name.removesuffix("_x").removesuffix("_y")
            if name in wanted and parameter.default not in (parameter.empty, None):
                assert parameter.default == wanted[name], (function, name)
                found.add(name)
    assert found == set(wanted)


@laws
@given(hits=st.integers(0, 6), passes=st.integers(0, 6), miss=numbers, false=numbers)
def test_count_masses_are_yagers_rule_on_simple_masses(hits: int, passes: int, miss: float, false: float) -> None:
    sources = [[0, 1 - false]] * hits + [[1 - miss, 0]] * passes + [[0, 0]]
    expected = evidence.yager(np.array(sources, float), axis=0)
    same(evidence.counts_to_mass(np.array(float(hits)), np.array(float(passes)), miss, false), expected)


@laws
@given(masses=arrays_of_masses(3, least_unknown=1))
def test_the_cautious_rule_takes_the_greatest_evidence(masses: Any) -> None:
    stack = np.stack(masses)
    expected = evidence.mass_to_evidence(stack).max(axis=0)
    found = evidence.cautious(stack, axis=0)
    np.testing.assert_allclose(found, evidence.evidence_to_mass(expected), atol=tolerance(found))
    chain = evidence.cautious(evidence.cautious(masses[0], masses[1]), masses[2])
    np.testing.assert_allclose(chain, found, atol=20 * tolerance(found))


@laws
@given(masses=arrays_of_masses(2))
def test_a_revision_discounts_what_is_contradicted_and_keeps_the_greatest(masses: Any) -> None:
    prior, new = masses
    excess = new - prior  # of the scan over the map, for each state
    against_map, against_scan = excess.clip(0), (-excess).clip(0)
    kept = evidence.contextual_discount(prior, 1 - 0.75 * against_map[..., 0], 1 - against_map[..., 1])
    taken = evidence.contextual_discount(new, 1 - 0.5 * against_scan[..., 0], 1 - against_scan[..., 1])
    greatest = np.maximum(kept, taken)
    greatest[..., 0] = np.minimum(greatest[..., 0], 1 - greatest[..., 1])
    found = evidence.revise(prior, new)
    same(found, greatest)
    evidence.check_mass(found)
    same(evidence.revise(prior, prior), prior)
    same(evidence.revise(prior, 0 * prior), prior)
    same(evidence.revise(0 * prior, prior), prior)
    again = evidence.revise(found, new)
    assert (again <= np.maximum(found, new) + tolerance(found)).all()  # claims do not add up


def smoothed(F: float, O: float, f: float, o: float) -> tuple[float, float]:  # noqa: E741
    """Return the belief of one cell by the words of `smooth`: an average, and free that falls or grows."""
    if o >= f:
        share = max(0.25, 1 - 16 * (F + O))
        O, F = max((1 - share) * O + share * o, O), F - F * o  # noqa: E741
    else:
        grown = 1 - (1 - F) * (1 - f * (1 - O))
        O, F = O - O * f / 4, min(grown, max(F, f, f + (1 - f) * (2 * f - 1)))  # noqa: E741
    return min(F, 1 - O), O


@laws
@given(masses=arrays_of_masses(2))
def test_smooth_averages_occupied_and_keeps_no_free_that_is_contradicted(masses: Any) -> None:
    prior, new = masses
    found = evidence.smooth(prior, new)
    pairs = zip(prior.reshape(-1, 2).tolist(), new.reshape(-1, 2).tolist(), strict=True)
    same(found, np.array([smoothed(*a, *b) for a, b in pairs], found.dtype).reshape(found.shape))
    evidence.check_mass(found)
    same(evidence.smooth(prior, 0 * prior), prior)
    repeated = found
    for _ in range(40):
        repeated = evidence.smooth(repeated, new)
    bound = np.maximum(prior, np.stack([np.maximum(new[..., 0], 1 - 2 * (1 - new[..., 0]) ** 2), new[..., 1]], axis=-1))
    assert (repeated <= bound + tolerance(found)).all()
