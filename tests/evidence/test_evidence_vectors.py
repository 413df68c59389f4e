"""Published and recomputed numbers, each with its source.

The triples are (free, occupied, unknown); an opinion (belief, disbelief, uncertainty) of the literature is
(occupied, free, unknown) here.
"""

from typing import Any

import numpy as np
import pytest
import torch
from cases import each, refused
from masses import C1, C2, C3, A, B, pair, triple
from scipy import stats

from ogm import evidence
from ogm.evidence import Opinion, multinomial, powerset
from ogm.state import CellState


def opinion(b: float, d: float, u: float) -> tuple[float, float, float]:
    return d, b, u


def near(mass: np.ndarray, expected: Any, atol: float = 6e-7) -> None:
    """Compare a mass with a triple (free, occupied, unknown)."""
    np.testing.assert_allclose(triple(mass), expected, atol=atol)


# van der Heijden, Kopp, Kargl, "Multi-source fusion operations in subjective logic" (Fusion 2018), table with
# C1 = (.1, .3, .6), C2 = (.4, .2, .4), C3 = (.7, .1, .2), to more digits; CCF there is (.629, .182, .189).
@each(
    ("rule", "all_three", "first_two", "last_two"),
    [
        ("cumulative", (0.651163, 0.209302, 0.139535), (0.368421, 0.315789, 0.315789), (0.692308, 0.153846, 0.153846)),
        ("averaging", (0.509091, 0.163636, 0.327273), (0.28, 0.24, 0.48), (0.6, 0.133333, 0.266667)),
        ("weighted", (0.562162, 0.145946, 0.291892), (0.307692, 0.230769, 0.461538), (0.618182, 0.127273, 0.254545)),
        (
            "belief_constraint",
            (0.737864, 0.184466, 0.077670),
            (0.372093, 0.348837, 0.279070),
            (0.780488, 0.121951, 0.097561),
        ),
        ("consensus_compromise", (0.62875, 0.18225, 0.189), (0.4312, 0.2736, 0.2952), (0.696471, 0.149412, 0.154118)),
    ],
)
def test_fusion_2018(rule: str, all_three: tuple, first_two: tuple, last_two: tuple) -> None:
    fuse = getattr(evidence, rule)
    c1, c2, c3 = pair(C1), pair(C2), pair(C3)
    near(fuse(np.stack([c1, c2, c3]), axis=0), opinion(*all_three))
    near(fuse(c1, c2), opinion(*first_two))
    near(fuse(c2, c3), opinion(*last_two))


# Recomputed from the definitions (Smarandache and Dezert 2006; Dezert et al. 2021; Murphy 2000) for the same
# sources.
@each(("rule", "expected"), [
    ("pcr6_plus", (0.727914, 0.224086, 0.048)), ("pcr6", (0.669594, 0.202115, 0.128291)),
    ("pcr5", (0.654898, 0.216811, 0.128291)), ("murphy", (0.674699, 0.228916, 0.096386)),
])  # fmt: skip
def test_redistribution_of_three_sources(rule: str, expected: tuple) -> None:
    stack = np.stack([pair(C1), pair(C2), pair(C3)])
    near(getattr(evidence, rule)(stack, axis=0), opinion(*expected))


def test_redistribution_of_two_sources() -> None:
    for rule in (evidence.pcr5, evidence.pcr6, evidence.pcr6_plus):
        near(rule(pair(C1), pair(C2)), opinion(0.395238, 0.364762, 0.24))
        near(rule(pair(C2), pair(C3)), opinion(0.780889, 0.139111, 0.08))
    near(evidence.murphy(pair(C1), pair(C2)), opinion(0.357143, 0.357143, 0.285714))
    near(evidence.murphy(pair(C2), pair(C3)), opinion(0.757485, 0.134731, 0.107784))


def test_a_chain_of_pairs_is_not_the_rule_for_three() -> None:
    """The order matters in a chain, and no chain is the n-ary result (recomputed)."""
    c1, c2, c3 = pair(C1), pair(C2), pair(C3)
    pcr = evidence.pcr5
    near(pcr(pcr(c1, c2), c3), opinion(0.72312, 0.22888, 0.048))
    near(pcr(pcr(c3, c2), c1), opinion(0.729686, 0.222314, 0.048))
    chains = [("averaging", (0.576471, 0.141176, 0.282353)), ("weighted", (0.611414, 0.129529, 0.259057))]
    for name, expected in chains:
        fuse = getattr(evidence, name)
        near(fuse(fuse(c1, c2), c3), opinion(*expected))


# Two conflicting sources, conflict 0.32. Conjunctive, Dempster, disjunctive, cautious and the fusion
# operators agree with independent libraries (see test_evidence_oracles.py), PCR5 and Murphy are recomputed.
@each(("rule", "expected"), [
    ("dempster", (0.338235, 0.529412, 0.132353)), ("yager", (0.23, 0.36, 0.41)),
    ("dubois_prade", (0.23, 0.36, 0.41)), ("disjunctive", (0.05, 0.12, 0.83)), ("pcr5", (0.37303, 0.53697, 0.09)),
    ("cumulative", (0.352941, 0.470588, 0.176471)), ("averaging", (0.3, 0.4, 0.3)), ("weighted", (0.3, 0.4, 0.3)),
    ("consensus_compromise", (0.283, 0.383, 0.334)), ("murphy", (0.355263, 0.526316, 0.118421)),
])  # fmt: skip
def test_two_conflicting_sources(rule: str, expected: tuple) -> None:
    near(getattr(evidence, rule)(pair(A), pair(B)), expected)


def test_two_conflicting_sources_in_the_open_world() -> None:
    np.testing.assert_allclose(evidence.conjunctive(pair(A), pair(B)), (0.23, 0.36, 0.09))
    general = powerset.cautious(powerset.from_pair(pair(A)), powerset.from_pair(pair(B)))
    np.testing.assert_allclose(powerset.to_triple(general), (0.25, 0.30, 0.15))
    assert evidence.conflict(pair(A), pair(B)) == pytest.approx(0.32)
    np.testing.assert_allclose(evidence.conflict_direction(pair(A), pair(B)), (0.30, 0.02))
    np.testing.assert_allclose(
        evidence.close_world(evidence.conjunctive(pair(A), pair(B))), evidence.dempster(pair(A), pair(B))
    )


def test_measures_of_one_mass() -> None:
    """Formulas of Smets, Cobb and Shenoy, Deng, Yager, Jirousek and Shenoy on A, recomputed."""
    a = pair(A)
    expected = {
        "pignistic": 0.35,
        "plausibility_transform": 0.384615,
        "deng_entropy": 1.960964,
        "nonspecificity": 0.3,
        "vacuity": 0.3,
        "specificity": 0.85,
        "dissonance": 0.4,
        "pignistic_entropy": 0.934068,
        "jirousek_shenoy_entropy": 1.261237,
        "yager_entropy": 0.360964,
    }
    for name, value in expected.items():
        assert getattr(evidence, name)(a) == pytest.approx(value, abs=6e-7), name
    np.testing.assert_allclose(evidence.mass_to_evidence(a), (10 / 3, 4 / 3))
    near(evidence.maximize_uncertainty(a), (0.3, 0, 0.7), atol=1e-15)


def test_entropies_at_the_corners() -> None:
    """Deng (2016) and Jirousek and Shenoy (2018): vacuous, and one bit of pure conflict."""
    vacuous, torn = np.zeros(2), np.array([0.5, 0.5])
    assert evidence.deng_entropy(vacuous) == pytest.approx(np.log2(3))
    assert evidence.jirousek_shenoy_entropy(vacuous) == pytest.approx(2)
    assert evidence.deng_entropy(torn) == pytest.approx(1)
    assert evidence.jirousek_shenoy_entropy(torn) == pytest.approx(1)
    assert evidence.dissonance(torn) == pytest.approx(1)
    # Not at the vacuous mass is Deng's entropy greatest, but at (1/5, 1/5, 3/5).
    assert evidence.deng_entropy(np.array([0.2, 0.2])) == pytest.approx(np.log2(5))


def test_jousselme_distance() -> None:
    """Jousselme, Grenier, Bosse (2001), corners of the simplex."""
    free, occupied, vacuous = np.array([1.0, 0]), np.array([0, 1.0]), np.zeros(2)
    assert evidence.jousselme_distance(free, occupied) == pytest.approx(1)
    assert evidence.jousselme_distance(free, vacuous) == pytest.approx(0.5**0.5)
    assert evidence.jousselme_distance(free, np.array([0.5, 0.5])) == pytest.approx(0.5)
    assert evidence.jousselme_distance(pair(A), pair(B)) == pytest.approx(0.4)


def test_degree_of_conflict() -> None:
    """Josang (2016), section 4.8, on A and B."""
    assert evidence.degree_of_conflict(pair(A), pair(B)) == pytest.approx(0.196)


# Smarandache and Dezert (2006), PCR5 examples; Dempster for the first.
@each(
    ("a", "b", "expected"),
    [
        ((0.6, 0, 0.4), (0, 0.3, 0.7), (0.54, 0.18, 0.28)),
        ((0.6, 0, 0.4), (0.2, 0.3, 0.5), (0.62, 0.18, 0.20)),
        ((0.6, 0.3, 0.1), (0.2, 0.3, 0.5), (0.584, 0.366, 0.050)),
    ],
)
def test_pcr5_of_the_textbook(a: tuple, b: tuple, expected: tuple) -> None:
    near(evidence.pcr5(pair(a), pair(b)), expected, atol=1e-12)


def test_dempster_of_the_pcr_textbook() -> None:
    combined = evidence.dempster(pair((0.6, 0, 0.4)), pair((0, 0.3, 0.7)))
    near(combined, (0.512195, 0.146341, 0.341463))


# Zadeh (1979): two doctors, three diseases M, C, T. Dempster as published, PCR5 and Murphy recomputed.
@each(
    ("sure", "conflict", "pcr5", "murphy"),
    [
        (0.99, 0.9999, (0.499851, 0.499851, 0.000298), (0.499898, 0.499898, 0.000204)),
        (0.9, 0.99, (0.486, 0.486, 0.028), (0.487952, 0.487952, 0.024096)),
    ],
)
def test_zadeh(sure: float, conflict: float, pcr5: tuple, murphy: tuple) -> None:
    first, second = np.zeros(8), np.zeros(8)
    first[powerset.subset(0)], first[powerset.subset(2)] = sure, 1 - sure
    second[powerset.subset(1)], second[powerset.subset(2)] = sure, 1 - sure
    singles = [powerset.subset(i) for i in range(3)]
    assert powerset.conjunctive(first, second)[0] == pytest.approx(conflict)
    np.testing.assert_allclose(powerset.dempster(first, second)[singles], (0, 0, 1), atol=1e-12)
    np.testing.assert_allclose(powerset.pcr5(first, second)[singles], pcr5, atol=6e-7)
    np.testing.assert_allclose(powerset.murphy(first, second)[singles], murphy, atol=6e-7)


@each(("rule", "expected"), [
    ("dempster", (0.497487, 0.497487, 0.005025)), ("cumulative", (0.497487, 0.497487, 0.005025)),
    ("yager", (0.0099, 0.0099, 0.9802)), ("consensus_compromise", (0.0099, 0.0099, 0.9802)),
    ("pcr5", (0.49995, 0.49995, 0.0001)),
])  # fmt: skip
def test_zadeh_with_two_states(rule: str, expected: tuple) -> None:
    """Recomputed. For two opposite simple masses Dempster's rule and cumulative fusion coincide."""
    combined = getattr(evidence, rule)(pair((0.99, 0, 0.01)), pair((0, 0.99, 0.01)))
    near(combined, expected)


def test_pcr6_plus_keeps_the_vacuous_source_neutral() -> None:
    """Dezert et al. (2021): PCR6 does not; recomputed."""
    stack = np.stack([pair((0.6, 0.2, 0.2)), pair((0.2, 0.7, 0.1)), np.zeros(2)])
    near(evidence.pcr6(stack, axis=0), (0.33528, 0.43354, 0.23118), atol=6e-6)
    plus = triple(evidence.pcr6_plus(stack, axis=0))
    np.testing.assert_allclose(plus, (0.433846, 0.546154, 0.02), atol=6e-7)
    np.testing.assert_allclose(plus, triple(evidence.pcr5(stack[0], stack[1])), atol=1e-15)


# Golden table of go-subjectivelogic (Ulm university, Apache-2.0), recomputed to 1e-8:
# x = (.6, .3, .1, a = 0), y = (.091, .604, .305, a = .4), as (b, d, u, a).
X, Y = np.array([0.3, 0.6]), np.array([0.604, 0.091])


@each(
    ("rule", "expected"),
    [
        ("cumulative", (0.51295060, 0.40560748, 0.08144192)),
        ("averaging", (0.47432099, 0.37506173, 0.15061728)),
        ("weighted", (0.49716424, 0.36141860, 0.14141715)),
        ("belief_constraint", (0.40422743, 0.54579715, 0.04997542)),
    ],
)
def test_go_golden_table(rule: str, expected: tuple) -> None:
    near(getattr(evidence, rule)(X, Y), opinion(*expected), atol=1e-8)


def test_go_golden_base_rates() -> None:
    assert evidence.cumulative_base_rate([0.1, 0.305], [0.0, 0.4]) == pytest.approx(0.08081395, abs=1e-8)
    assert evidence.confidence_base_rate([0.1, 0.305], [0.0, 0.4]) == pytest.approx(0.17429467, abs=1e-8)


def test_go_golden_trust() -> None:
    """x's trust in y uses the base rate of x, 0; y's trust in x that of y, 0.4."""
    x_trusts_y = evidence.trust_discount(Y, X, base_rate=0.0)
    y_trusts_x = evidence.trust_discount(X, Y, base_rate=0.4)
    near(x_trusts_y, opinion(0.0546, 0.3624, 0.583), atol=1e-12)
    near(y_trusts_x, opinion(0.1278, 0.0639, 0.8083), atol=1e-12)
    near(evidence.discount(X, 0.85), opinion(0.51, 0.255, 0.235), atol=1e-12)


def test_go_cumulative_of_dogmatic_and_uncertain_numbers() -> None:
    fused = evidence.cumulative(pair(opinion(0.4, 0, 0.6)), pair(opinion(0.7, 0, 0.3)))
    near(fused, opinion(0.75, 0, 0.25), atol=1e-12)


# Josang (2016), examples of chapters 7, 9 and 12; printed to two digits, recomputed to more.
def test_book_multiplication() -> None:
    mass, base_rate = evidence.multiplication(pair(opinion(0.75, 0.15, 0.10)), pair(opinion(0.10, 0, 0.90)), 0.5, 0.2)
    near(mass, opinion(0.154444, 0.15, 0.695556))
    assert base_rate == pytest.approx(0.1)


def test_book_comultiplication() -> None:
    mass, base_rate = evidence.comultiplication(pair(opinion(0.75, 0.15, 0.10)), pair(opinion(0.35, 0, 0.65)), 0.5, 0.2)
    near(mass, opinion(0.8375, 0.065, 0.0975), atol=1e-12)
    assert base_rate == pytest.approx(0.6)


def test_book_deduction() -> None:
    mass, base_rate = evidence.deduction(
        pair(opinion(0, 0.4, 0.6)), pair(opinion(0.55, 0.3, 0.15)), pair(opinion(0.1, 0.75, 0.15)), 0.5
    )
    near(mass, opinion(0.151429, 0.48, 0.368571))
    assert base_rate == pytest.approx(0.382353, abs=6e-7)


# Josang (2016), sections 9.6 and 10.8, as printed; the crate subjective-logic (Apache-2.0) tests the same numbers.
def test_book_multinomial_deduction() -> None:
    """Match fixing: two states of the cause, three of the consequence."""
    y = multinomial.deduction([0.9, 0.0], [[0.0, 0.8, 0.1], [0.7, 0.0, 0.1]], base_rate=[0.1, 0.9])
    np.testing.assert_allclose(y.base_rate, (0.778, 0.099, 0.123), atol=5e-4)
    np.testing.assert_allclose(y.mass, (0.063, 0.728, 0.100), atol=5e-4)
    projected = multinomial.projected_probability(y.mass, y.base_rate)
    np.testing.assert_allclose(projected, (0.148, 0.739, 0.113), atol=5e-4)


def test_book_multinomial_abduction() -> None:
    """Military intelligence: from movements that are seen to the plan.

    The printed beliefs are of inverted conditionals of maximal uncertainty, as in Josang, "Conditional reasoning with
    subjective logic" (2008), which the book's formula of relevance reduces; probabilities are the same.
    """
    conditionals, prior = np.array([[0.5, 0.25, 0.25], [0, 0.5, 0.5], [0, 0.25, 0.75]]), [0.7, 0.2, 0.1]
    inverse = multinomial.inversion(conditionals, prior)
    maximal = multinomial.maximize_uncertainty(inverse.mass, prior)
    np.testing.assert_allclose(maximal, [(1, 0, 0), (0, 0.17, 0), (0, 0.14, 0.14)], atol=5e-3)
    printed = multinomial.deduction([0, 0.43, 0], maximal, inverse.base_rate)
    np.testing.assert_allclose(printed.mass, (0, 0.07, 0), atol=5e-3)
    np.testing.assert_allclose(printed.base_rate, prior)
    for found in (printed, multinomial.abduction([0, 0.43, 0], conditionals, prior)):
        projected = multinomial.projected_probability(found.mass, found.base_rate)
        np.testing.assert_allclose(projected, (0.65, 0.26, 0.09), atol=5e-3)
    # The greatest unknown of the plan, 5/6 and 5/7, times the irrelevance of the movement, 0.75 and 0.5
    np.testing.assert_allclose(1 - inverse.mass.sum(-1), (0, 5 / 6 * 0.75, 5 / 7 * 0.5), atol=1e-12)
    # Certain movements: Bayes' theorem, with base rates of movements (0.35, 0.3, 0.35).
    bayes = conditionals * [[0.7], [0.2], [0.1]]
    for k, certain in enumerate(np.eye(3)):
        x = multinomial.abduction(certain, conditionals, base_rate=[0.7, 0.2, 0.1])
        expected = bayes[:, k] / bayes[:, k].sum()
        np.testing.assert_allclose(multinomial.projected_probability(x.mass, x.base_rate), expected, atol=1e-12)
    np.testing.assert_allclose(inverse.base_rate, bayes.sum(0))


def test_abduction_of_a_detection_is_bayes_theorem_with_unknown() -> None:
    """A detector that misses 20 % and has 5 % false alarms, and a prior of 1 %."""
    hit, false_alarm = pair(opinion(0.8, 0.2, 0)), pair(opinion(0.05, 0.95, 0))
    mass, rate = evidence.abduction(pair(opinion(1, 0, 0)), hit, false_alarm, base_rate_x=0.01)
    assert evidence.mass_to_probability(mass, rate) == pytest.approx(0.01 * 0.8 / (0.01 * 0.8 + 0.99 * 0.05))
    # An irrelevant detector says nothing, and neither does a vacuous one.
    for either in (hit, np.zeros(2)):
        near(evidence.abduction(pair(opinion(1, 0, 0)), either, either, 0.3).mass, (0, 0, 1), atol=1e-12)
    # Unknown in the conditionals, and in the observation, is unknown in the conclusion.
    unsure = evidence.abduction(pair(opinion(1, 0, 0)), 0.9 * hit, 0.9 * false_alarm, 0.3).mass
    sure, vague = (evidence.abduction(one * pair(opinion(1, 0, 0)), hit, false_alarm, 0.3).mass for one in (1, 0.5))
    assert evidence.unknown(sure) < min(evidence.unknown(unsure), evidence.unknown(vague))


def test_multinomial_opinions_fuse_as_hyper_opinions() -> None:
    """The crate subjective-logic: (0.98, 0.01, 0) and (0, 0.01, 0.90), as Zadeh's doctors with some doubt."""
    doctors = [powerset.from_beliefs(np.array(one)) for one in ([0.98, 0.01, 0], [0, 0.01, 0.90])]
    printed = (0.890, 0.010, 0.091), (0.882, 0.010, 0.090), (0.889, 0.010, 0.083)
    for name, beliefs in zip(("cumulative", "averaging", "weighted"), printed, strict=True):
        fused = powerset.to_beliefs(getattr(powerset, name)(*doctors))
        np.testing.assert_allclose(fused, beliefs, atol=6e-4, err_msg=name)
    epistemic = multinomial.maximize_uncertainty(powerset.to_beliefs(powerset.cumulative(*doctors)))
    np.testing.assert_allclose(epistemic, (0.880, 0, 0.081), atol=6e-4)
    projected = powerset.projected_probability(doctors[1], [0.5, 0.3, 0.2])
    np.testing.assert_allclose(projected, multinomial.projected_probability([0, 0.01, 0.9], [0.5, 0.3, 0.2]))
    np.testing.assert_allclose(projected, (0.045, 0.037, 0.918))
    hyper = np.zeros(8)
    hyper[powerset.subset(0, 1)], hyper[powerset.subset(2)] = 0.6, 0.4
    np.testing.assert_allclose(powerset.projected_probability(hyper, [0.5, 0.25, 0.25]), (0.4, 0.2, 0.4))


def test_multinomial_refuses_what_is_no_opinion() -> None:
    refused("belief must be non-negative and sum to at most 1", multinomial.projected_probability, [0.9, 0.4, 0])
    refused("3 prior probabilities with sum 1", multinomial.projected_probability, [0.1, 0.4, 0], [0.5, 0.4, 0.2])
    refused("at least 2 states", multinomial.deduction, [0.1], [[0.5]])
    refused("2 to 6 states", powerset.from_beliefs, np.zeros(7))
    refused("one base rate per state, 2, got 1", powerset.projected_probability, np.array([0, 0, 0, 1.0]), [0.5])


# Expected costs by torchbelief 0.3.0 (`decide`, utilities -cost): criteria maximin, pignistic, maximax.
@each(("criterion", "costs", "expected"), [
    ("belief", {}, (0, 2, 1, 0)), ("pignistic", {}, (1, 2, 1, 0)), ("plausibility", {}, (1, 2, 1, 2)),
    ("belief", {"cost_false_free": 10}, (0, 2, 0, 0)), ("pignistic", {"cost_false_free": 10}, (0, 2, 0, 0)),
    ("plausibility", {"cost_false_free": 10, "cost_abstention": 2}, (2, 2, 1, 2)),
    ("pignistic", {"cost_false_occupied": 4, "cost_abstention": np.inf}, (1, 2, 1, 1)),
])  # fmt: skip
def test_decisions(criterion: Any, costs: Any, expected: tuple) -> None:
    masses = np.array([(0.45, 0.2), (0.05, 0.9), (0.9, 0.05), (0, 0)])
    for given in (masses, torch.tensor(masses)):
        assert tuple(evidence.decide(given, criterion, **costs).tolist()) == expected
    assert evidence.decide(Opinion(0.1, 0.3, base_rate=0.9), "pignistic") == CellState.OCCUPIED


def test_blame_falls_on_the_source_that_contradicts_the_others() -> None:
    """Schubert (2011): the conflict of all without a source, and with it; then the discount that reconciles it."""
    sources = np.array([(0.0, 0.8), (0.1, 0.7), (0.9, 0.0), (0.0, 0.5)])
    falsity = evidence.degree_of_falsity(sources, axis=0)
    both = 1 - evidence.conjunctive(sources, axis=0).sum()
    for k, found in enumerate(falsity):
        without = 1 - evidence.conjunctive(np.delete(sources, k, axis=0), axis=0).sum()
        assert found == pytest.approx((both - without) / (1 - without))
    assert falsity.argmax() == 2
    reliability = evidence.reconciling_reliability(*sources, remaining_conflict=0.2)
    others = evidence.dempster(*np.delete(sources, 2, axis=0))
    assert evidence.conflict(evidence.discount(sources[2], reliability[2]), others) == pytest.approx(0.2)
    agreeing = evidence.reconciling_reliability(sources[0], sources[1], remaining_conflict=0.2)
    np.testing.assert_array_equal(agreeing, 1)


def test_divergence_of_masses_both_ways() -> None:
    """KL of Beta densities by its definition; a dogmatic mass counts as an evidence of 1e5."""
    a, b = pair(A), pair(B)
    for first, second in ((a, b), (b, a)):
        alpha, beta = ((2 * mass / evidence.unknown(mass) + 1) for mass in (first, second))
        x = np.linspace(0, 1, 20001)[1:-1]
        p, q = (stats.beta(one[1], one[0]) for one in (alpha, beta))
        expected = np.trapezoid(p.pdf(x) * (p.logpdf(x) - q.logpdf(x)), x)
        assert evidence.kl_divergence(first, second) == pytest.approx(expected, rel=1e-4)
    assert evidence.kl_divergence(a, a) == 0
    assert np.isfinite(evidence.kl_divergence([1, 0], [0, 1]))
    assert evidence.kl_divergence(Opinion(*a), Opinion(*b)) == evidence.kl_divergence(a, b)


def test_book_unfusion() -> None:
    rest = evidence.cumulative_unfusion(pair(opinion(0.9, 0.05, 0.05)), pair(opinion(0.7, 0.1, 0.2)))
    near(rest, opinion(0.90625, 0.03125, 0.0625), atol=1e-12)


def test_book_uncertainty_maximisation_and_epistemic_fusion() -> None:
    near(evidence.maximize_uncertainty(pair(opinion(0.7, 0.1, 0.2))), opinion(0.6, 0, 0.4), atol=1e-12)
    one, other = pair(opinion(0.7, 0.1, 0.2)), pair(opinion(0.1, 0.6, 0.3))
    near(evidence.cumulative(one, other), opinion(0.522727, 0.340909, 0.136364))
    near(evidence.cumulative_epistemic(one, other), opinion(0.181818, 0, 0.818182))


def test_tbmlib() -> None:
    """Example of the C# library TBMLib, after Smets: m = (empty .09, F .3, O .6, frame .01)."""
    m = np.array([0.09, 0.3, 0.6, 0.01])
    np.testing.assert_allclose(powerset.mass_to_commonality(m), (1, 0.31, 0.61, 0.01))
    np.testing.assert_allclose(powerset.pignistic(m), (0.335165, 0.664835), atol=6e-7)


@each(("hits", "passes", "expected"), [
    (1, 0, (0, 0.95, 0.05)), (0, 1, (0.2, 0, 0.8)), (1, 3, (0.0244, 0.4864, 0.4892)),
    (2, 5, (0.001681, 0.326861, 0.671458)), (0, 10, (0.892626, 0, 0.107374)),
])  # fmt: skip
def test_count_masses(hits: int, passes: int, expected: tuple) -> None:
    """Counting lidar model of a public evidential occupancy code (2024), recomputed."""
    mass = evidence.counts_to_mass(np.array(float(hits)), np.array(float(passes)))
    near(mass, expected)


def test_mass_and_evidence_discounting_differ() -> None:
    """Shafer (1976) and the scaling of Dirichlet evidence, on A with reliability 0.9."""
    near(evidence.discount(pair(A), 0.9), (0.45, 0.18, 0.37), atol=1e-7)
    near(evidence.discount_evidence(pair(A), 0.9), (0.4839, 0.1935, 0.3226), atol=6e-5)


def test_steady_state_of_discounted_cumulative_fusion() -> None:
    """One unit of evidence a step, discounted by 0.9: total evidence 10, unknown 1/6."""
    step = evidence.evidence_to_mass(np.array([0.0, 1.0]))
    mass = np.zeros(2)
    for _ in range(400):
        mass = evidence.cumulative(evidence.discount_evidence(mass, 0.9), step)
    assert evidence.unknown(mass) == pytest.approx(1 / 6)


def test_steady_state_of_discounted_dempster() -> None:
    """Same simple mass 0.7 each step, discount 0.9: unknown (1 - r)(1 - m) / (1 - r (1 - m))."""
    mass = np.zeros(2)
    for _ in range(400):
        mass = evidence.dempster(evidence.discount(mass, 0.9), np.array([0.0, 0.7]))
    assert evidence.unknown(mass) == pytest.approx(0.1 * 0.3 / (1 - 0.9 * 0.3))
    assert evidence.unknown(mass) == pytest.approx(0.0411, abs=5e-5)


def test_forgetting_at_ten_hertz() -> None:
    """exp(-0.1 s / tau) for tau of 0.5, 1, 2 and 5 s; the half-life is tau ln 2."""
    for tau, reliability in [(0.5, 0.819), (1, 0.905), (2, 0.951), (5, 0.980)]:
        mass = evidence.discount_over_time(np.array([0.0, 1.0]), 0.1, half_life=tau * np.log(2))
        assert mass[1] == pytest.approx(reliability, abs=5e-4)
