"""Masses a little outside the simplex, as rounding leaves them: tolerated by all rules."""

import warnings
from typing import Any

import numpy as np
import pytest
import torch
from cases import each
from cells import combine_cells
from hypothesis import given, settings
from hypothesis import strategies as st
from masses import DTYPES, RULES, rule

from ogm import evidence
from ogm.evidence import powerset
from ogm.evidence.arrays import rounding, split, split_open, tolerance_of

EVIDENCE_RULES = [evidence.cumulative, evidence.averaging, evidence.weighted]


@st.composite
def tolerated(draw: Any, dtype: Any, states: int) -> np.ndarray:
    """Draw a mass, at a corner or an edge more often than not, and push it out by up to the tolerance."""
    tolerance = tolerance_of(np.zeros(2, dtype))
    weights = draw(st.tuples(*[st.sampled_from([0, 0, 1, 3])] * (states + 1)).filter(any))
    push = draw(st.tuples(*[st.sampled_from([-1, -0.9, -0.5, -0.1, 0, 1e-3, 0.2, 0.5, 1])] * states))
    mass = (np.array(weights[:states]) / sum(weights) + 0.8 * tolerance * np.array(push)).astype(dtype)
    above = mass.sum() - 1 - 0.8 * tolerance
    if above > 0:
        mass[mass.argmax()] -= above
    evidence.check_mass(mass)
    return mass


@each("dtype", DTYPES)
@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_every_rule_maps_tolerated_masses_to_tolerated_masses(dtype: Any, data: Any) -> None:
    pairs, triples = ([data.draw(tolerated(dtype, states)) for _ in range(2)] for states in (2, 3))
    for name in RULES:
        a, b = pairs
        for result in (rule(name)(a, b), rule(name)(np.stack([a, b]), axis=0)):
            assert np.isfinite(result).all(), name
            evidence.check_mass(result)
    for name in ("conjunctive", "disjunctive"):
        evidence.check_mass(rule(name)(*triples))
    evidence.check_mass(evidence.close_world(triples[0]))


@each(
    ("combine", "a", "b", "expected"),
    [
        (evidence.dempster, (1.0000001, -1e-7), (2e-7, 1), (1, 0)),
        (evidence.weighted, (-5e-7, 0), (5e-7, 0), (0, 0)),
        (evidence.pcr5, (5e-7, 0.5), (0.5, -5e-7), evidence.pcr5(np.array([0, 0.5]), np.array([0.5, 0]))),
    ],
)
def test_a_negative_belief_is_read_as_none(combine: Any, a: Any, b: Any, expected: Any) -> None:
    numbers = [np.array(mass, np.float32) for mass in (a, b)]
    np.testing.assert_allclose(combine(*numbers), expected, atol=2e-6)
    tensors = [torch.tensor(mass, requires_grad=True) for mass in numbers]
    result = combine(*tensors)
    np.testing.assert_allclose(result.detach(), expected, atol=2e-6)
    result.sum().backward()
    assert all(torch.isfinite(mass.grad).all() for mass in tensors)  # type: ignore[arg-type]


@each("dtype", DTYPES)
def test_parts_of_a_tolerated_mass_lie_in_the_simplex(dtype: Any) -> None:
    t = 0.9 * tolerance_of(np.zeros(2, dtype))
    pairs = np.array([[1 + t, -t / 2], [0.5 + t / 2, 0.5 + t / 2], [-t, 0.3], [0, 1]], dtype)
    for numbers in (split(pairs), split_open(pairs)):
        assert min(part.min() for part in numbers) >= 0
        np.testing.assert_allclose(sum(numbers), 1, atol=3 * np.finfo(dtype).eps)
    triples = np.array([[1 + t, -t / 2, -t / 2], [0.5, 0.25, 0.25 + t], [-t, 0.3, 0.3], [0, 0, 1]], dtype)
    numbers = split_open(triples)
    assert min(part.min() for part in numbers) >= 0
    np.testing.assert_allclose(sum(numbers), 1, atol=3 * np.finfo(dtype).eps)
    parts = split_open(torch.from_numpy(triples))
    assert min(part.min() for part in parts) >= 0
    assert min(part.min() for part in split(torch.from_numpy(pairs))) >= 0


def test_the_librarys_own_results_are_not_negative() -> None:
    x, y, z = np.random.default_rng(0).dirichlet([0.05] * 3, (3, 100_000)).astype(np.float32)[..., :2]
    assert evidence.deduction(x, y, z).mass.min() >= 0
    probability = np.random.default_rng(0).random(100_000).astype(np.float32)
    unknown = 2 * np.minimum(probability, 1 - probability)
    assert evidence.probability_to_mass(probability, unknown).min() >= 0


@pytest.mark.slow
@each("name", ["dempster", "yager", "cumulative"])
def test_kernels_read_negative_numbers_as_none(name: str) -> None:
    dtype, t = np.float32, 0.9 * tolerance_of(np.zeros(2, np.float32))
    # unknown below zero, beliefs below zero
    a = np.array([[1 + t, -t], [0.5 + t / 2, 0.5 + t / 2], [-t, 0.3], [1, 0]], dtype)
    b = np.array([[2 * t, 1 - 2 * t], [0, 1 + t], [0.4, -t], [-t, 0.5]], dtype)
    result = combine_cells(name, a, b)
    np.testing.assert_allclose(result, rule(name)(a, b), atol=1e-2 if name == "dempster" else 4 * t)
    assert result.min() >= 0
    assert (result.sum(-1) <= 1 + 3 * t).all()


ORDINARY = [(6e-8, 1), (1e-8, 1), (3e-7, 1.0000003), (1, 0), (0, 1), (0.5, 0.5), (1.0000001, -1e-7)]


def test_yager_entropy_of_almost_dogmatic_masses_is_finite() -> None:
    mass = np.array(ORDINARY, np.float32)
    entropy = evidence.yager_entropy(mass)
    assert ((entropy >= 0) & (entropy <= 1)).all()
    assert evidence.yager_entropy(np.array([1e-8, 1 - 1e-8])) == pytest.approx(
        -1e-8 * np.log2(1e-8) + 1e-8 / np.log(2), rel=1e-6
    )
    tensor = torch.tensor(ORDINARY, requires_grad=True)
    evidence.yager_entropy(tensor).sum().backward()
    assert torch.isfinite(tensor.grad).all()  # type: ignore[arg-type]


def test_measures_stay_in_range_on_a_saturated_map() -> None:
    scans = np.random.default_rng(0).dirichlet([0.3, 2, 0.2], (30, 5000))[..., :2].astype(np.float32)
    state = scans[0]
    for scan in scans[1:]:
        state = evidence.dempster(state, scan)
        for measure, most in [
            (evidence.yager_entropy, 1),
            (evidence.pignistic_entropy, 1),
            (evidence.jirousek_shenoy_entropy, 2),
            (evidence.deng_entropy, np.log2(5)),
            (evidence.plausibility_transform, 1),
        ]:
            values = measure(state)
            assert ((values >= -1e-6) & (values <= most + 1e-6)).all()
    tensor = torch.tensor(state, requires_grad=True)
    evidence.yager_entropy(tensor).sum().backward()
    assert torch.isfinite(tensor.grad).all()  # type: ignore[arg-type]


@each("dtype", DTYPES)
@each("units", [0, 1, 3, 4, 5, 6, 8, 20])
def test_the_same_masses_are_dogmatic_in_pairs_stacks_and_kernels(dtype: Any, units: int) -> None:
    """An unknown of up to 4 units of rounding counts as none, in each mass by itself."""
    eps = np.finfo(dtype).eps
    a, b = np.array([1, 0], dtype), np.array([0, 1 - units * eps], dtype)
    expected = (0.5, (1 - units * eps) / 2) if units <= 4 else (1, 0)
    for result in (
        evidence.cumulative(a, b),
        evidence.cumulative(b, a),
        evidence.cumulative(np.stack([a, b]), axis=0),
        evidence.cumulative(np.stack([a, b, 0 * a]), axis=0),
        evidence.cumulative(torch.tensor(a), torch.tensor(b)).numpy(),
        combine_cells("cumulative", a, b),
        combine_cells("cumulative", b, a),
    ):
        np.testing.assert_allclose(result, expected, atol=2 * eps)


def test_rounding_is_four_units() -> None:
    assert rounding(np.zeros(2, np.float32)) == pytest.approx(4.8e-7, rel=0.01)
    assert rounding(np.zeros(2)) == pytest.approx(8.9e-16, rel=0.01)


@each("dtype", DTYPES)
def test_unfusing_and_evidence_know_rounding(dtype: Any) -> None:
    eps = np.finfo(dtype).eps
    for units, vacuous in [(4, True), (8, False)]:
        mass = np.array([0, 1 - units * eps], dtype)
        rest = evidence.cumulative_unfusion(np.array([0, 1], dtype), mass)
        np.testing.assert_allclose(rest, (0, 0) if vacuous else (0, 1), atol=1e-6)
        assert np.isinf(evidence.mass_to_evidence(mass)[1]) == vacuous
        assert evidence.mass_to_evidence(mass)[0] == 0


@each("fuse", EVIDENCE_RULES)
def test_a_chain_of_dogmatic_masses_is_not_the_stack(fuse: Any) -> None:
    free, occupied = np.array([1.0, 0]), np.array([0, 1.0])
    np.testing.assert_allclose(fuse(np.stack([free, free, occupied]), axis=0), (2 / 3, 1 / 3))
    np.testing.assert_allclose(fuse(fuse(free, free), occupied), (1 / 2, 1 / 2))


@each("fuse", EVIDENCE_RULES)
@each("weights", [[0.1, 0.2], [0.1, 0.7]])
def test_dogmatic_weights_keep_double_precision_in_torch(fuse: Any, weights: list) -> None:
    a, b = np.array([1.0, 0]), np.array([0.3, 0.7])
    result = fuse(torch.tensor(a), torch.tensor(b), dogmatic_weights=weights)
    assert result.dtype == torch.float64
    np.testing.assert_allclose(result, fuse(a, b, dogmatic_weights=weights), rtol=1e-15)


def test_total_conflict_in_general_frames_warns_of_nothing() -> None:
    nothing = np.array([1.0, 0, 0, 0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isnan(powerset.pignistic(nothing)).all()
        assert np.isnan(powerset.plausibility_transform(nothing)).all()


@each("base_rate", [0.0, 0.2, 0.9, 1.0])
def test_maximal_uncertainty_by_its_definition(base_rate: float) -> None:
    masses = np.random.default_rng(0).dirichlet([1, 1, 1], 200)[:, :2]
    p = evidence.mass_to_probability(masses, base_rate)
    with np.errstate(divide="ignore"):  # no bound where a base rate is 0 or 1
        u = np.minimum(p / np.float64(base_rate), (1 - p) / np.float64(1 - base_rate))
    expected = np.stack([1 - p - (1 - base_rate) * u, p - base_rate * u], axis=-1)
    rates: list[Any] = [base_rate, np.full(200, base_rate)]
    for rate in rates:
        np.testing.assert_allclose(evidence.maximize_uncertainty(masses, rate), expected, atol=1e-12)


def test_maximal_uncertainty_of_one_sided_masses_with_extreme_base_rates() -> None:
    free, occupied, vacuous = np.array([0.3, 0]), np.array([0, 0.3]), np.zeros(2)
    np.testing.assert_array_equal(evidence.maximize_uncertainty(occupied, 1.0), vacuous)
    np.testing.assert_array_equal(evidence.maximize_uncertainty(free, 0.0), vacuous)
    np.testing.assert_allclose(evidence.maximize_uncertainty(free, 1.0), free)
    np.testing.assert_allclose(evidence.maximize_uncertainty(occupied, 0.0), occupied)


def test_degree_of_conflict_depends_on_the_base_rate() -> None:
    a, b = np.array([0.5, 0.2]), np.array([0.1, 0.3])  # P = 0.2 + 0.3 a, 0.3 + 0.6 a
    for rate in (0.0, 0.1, 0.9):
        expected = (0.1 + 0.3 * rate) * 0.7 * 0.4
        assert evidence.degree_of_conflict(a, b, rate) == pytest.approx(expected)
        assert evidence.degree_of_conflict(a, b, base_rate=rate) == pytest.approx(expected)


@each("rate", [evidence.cumulative_base_rate, evidence.confidence_base_rate])
def test_base_rates_without_weight_are_averaged_up_to_rounding(rate: Any) -> None:
    eps = np.finfo(float).eps
    assert rate([1.0, 1 - eps], [0.2, 0.6]) == pytest.approx(0.4)  # not 0.6
    assert rate([1.0, 1 - 100 * eps], [0.2, 0.6]) == pytest.approx(0.6)


def test_divergence_of_random_near_densities_is_never_negative() -> None:
    rng = np.random.default_rng(0)
    alpha = 10 ** rng.uniform(-3, 7, (100_000, 2))
    other = alpha * (1 + 10 ** rng.uniform(-16, -2, (100_000, 1)) * rng.normal(size=(100_000, 2)))
    assert evidence.dirichlet_kl(alpha, other).min() >= 0
