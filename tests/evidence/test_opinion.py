"""Mass, opinion, evidence, Dirichlet, probability: conversions there and back."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from cases import each
from hypothesis import given, settings
from hypothesis import strategies as st
from masses import DTYPES, A, arrays_of_masses, pair, tolerance

from ogm import evidence
from ogm.evidence import Opinion

laws = settings(max_examples=60, deadline=None)
weights = st.sampled_from([0.5, 1.0, 2.0, 3.0])
rates = st.integers(0, 10).map(lambda n: n / 10)


def test_an_opinion_reads_well() -> None:
    assert repr(Opinion(0.0, 0.91, 0.09)) == "Opinion(free=0.00, occupied=0.91, unknown=0.09)"
    assert repr(Opinion(0.5, 0.2, base_rate=0.25)) == (
        "Opinion(free=0.50, occupied=0.20, unknown=0.30, base_rate=0.25)"
    )


def test_an_opinion_is_a_value() -> None:
    opinion = Opinion(free=0.5, occupied=0.2)
    assert opinion == Opinion(0.5, 0.2, 0.3)
    assert hash(opinion) == hash(Opinion(0.5, 0.2, 0.3))
    with pytest.raises(dataclasses.FrozenInstanceError):
        opinion.free = 0.1  # type: ignore[misc]
    assert opinion.unknown == pytest.approx(0.3)
    assert opinion.base_rate == 0.5
    assert opinion.probability == pytest.approx(0.35)
    np.testing.assert_array_equal(opinion.mass, (0.5, 0.2))


@each("dtype", DTYPES)
def test_an_opinion_is_made_of_a_mass(dtype: Any) -> None:
    opinion = Opinion.from_mass(np.array([0.1, 0.9], dtype), base_rate=0.2)
    assert opinion.occupied == pytest.approx(0.9)
    assert opinion.unknown == pytest.approx(0, abs=1e-6)
    assert opinion.base_rate == 0.2
    assert Opinion.from_mass(torch.tensor([0.25, 0.5])) == Opinion(0.25, 0.5, 0.25)
    assert Opinion(0.3, 0.7 + 5e-7).unknown == 0


@laws
@given(mass=arrays_of_masses(least_unknown=1), weight=weights)
def test_evidence_and_back(mass: np.ndarray, weight: float) -> None:
    e = evidence.mass_to_evidence(mass, weight)
    assert e.dtype == mass.dtype
    np.testing.assert_allclose(evidence.evidence_to_mass(e, weight), mass, atol=tolerance(mass))
    # The definition: u = W / (W + sum of evidence).
    unknown = weight / (weight + e.sum(-1))
    np.testing.assert_allclose(unknown, evidence.unknown(mass), atol=tolerance(mass))


@laws
@given(mass=arrays_of_masses(least_unknown=1), weight=weights, rate=rates)
def test_alpha_and_back(mass: np.ndarray, weight: float, rate: float) -> None:
    e = evidence.mass_to_evidence(mass, weight)
    alpha = evidence.evidence_to_alpha(e, weight, rate)
    # The mean of the Dirichlet density is the projected probability.
    mean = alpha[..., 1] / alpha.sum(-1)
    np.testing.assert_allclose(mean, evidence.mass_to_probability(mass, rate), atol=tolerance(mass))
    np.testing.assert_allclose(alpha.sum(-1), weight + e.sum(-1), rtol=1e-5)
    # Back, but for what rounding takes of small evidence beside the prior.
    back = evidence.alpha_to_evidence(alpha + np.asarray(1e-5, mass.dtype), weight, rate)
    np.testing.assert_allclose(back, e, rtol=1e-4, atol=2e-5)


def test_defaults_make_alpha_evidence_plus_one() -> None:
    e = np.array([3.0, 0.5])
    np.testing.assert_array_equal(evidence.evidence_to_alpha(e), e + 1)
    np.testing.assert_array_equal(evidence.alpha_to_evidence(e + 1), e)


@laws
@given(mass=arrays_of_masses(), rate=rates)
def test_probability_and_back(mass: np.ndarray, rate: float) -> None:
    maximal = evidence.maximize_uncertainty(mass, rate)
    for m in (mass, evidence.discount(maximal, 0.999)):
        p, u = evidence.mass_to_probability(m, rate), evidence.unknown(m)
        assert p.dtype == mass.dtype
        free_and_occupied = np.stack([1 - p - (1 - rate) * u, p - rate * u], -1)
        np.testing.assert_allclose(free_and_occupied, m, atol=tolerance(m))
    np.testing.assert_allclose(
        evidence.probability_to_mass(np.asarray(p), 0.0), np.stack([1 - p, p], -1), atol=tolerance(mass)
    )


def test_probability_to_mass_inverts_the_projection() -> None:
    np.testing.assert_allclose(evidence.probability_to_mass(np.array(0.35), 0.3), pair(A))
    np.testing.assert_allclose(evidence.probability_to_mass(np.array([0.26]), np.array([0.3]), 0.2), [pair(A)])


@laws
@given(st.floats(-30, 30))
def test_log_odds_and_back(log_odds: float) -> None:
    mass = evidence.log_odds_to_mass(np.array(log_odds))
    evidence.check_mass(mass)
    assert evidence.mass_to_log_odds(mass) == pytest.approx(log_odds, rel=1e-3, abs=1e-12)
    assert mass.min() == 0
    p = evidence.plausibility_transform(mass)
    assert p == pytest.approx(1 / (1 + np.exp(-log_odds)), abs=1e-12)


def test_log_odds_of_certainty_is_infinite() -> None:
    certain = np.array([[1.0, 0], [0, 1], [0, 0], [0.5, 0.5]])
    np.testing.assert_array_equal(evidence.mass_to_log_odds(certain), (-np.inf, np.inf, 0, 0))
    np.testing.assert_array_equal(evidence.log_odds_to_mass(np.array([-np.inf, np.inf, 0])), certain[:3])
    rounded = np.array([[np.nextafter(np.float32(1), 2), 0], [0, np.nextafter(np.float32(1), 2)]], np.float32)
    np.testing.assert_array_equal(evidence.mass_to_log_odds(rounded), (-np.inf, np.inf))
    np.testing.assert_array_equal(evidence.mass_to_log_odds(torch.from_numpy(rounded)).numpy(), (-np.inf, np.inf))


def test_dempster_on_simple_masses_is_the_bayesian_update() -> None:
    """Adding log-odds cell by cell and Dempster's rule on simple masses end in the same probability."""
    updates = np.array([0.85, -0.4, -0.4, 2.2, -0.4])
    mass = evidence.dempster(evidence.log_odds_to_mass(updates), axis=0)
    assert evidence.mass_to_log_odds(mass) == pytest.approx(updates.sum())


def test_pignistic_is_the_projection_with_base_rate_one_half() -> None:
    mass = pair(A)
    assert evidence.pignistic(mass) == evidence.mass_to_probability(mass) == pytest.approx(0.35)
    assert evidence.mass_to_probability(mass, 0.9) == pytest.approx(0.47)


@each("dtype", DTYPES)
@each("shape", [(), (5,), (2, 3), (0,)])
def test_conversions_keep_shape_and_dtype(dtype: Any, shape: tuple) -> None:
    mass = np.full((*shape, 2), 0.25, dtype)
    cells = np.full(shape, 2, dtype)
    per_pair = [
        evidence.mass_to_evidence(mass),
        evidence.evidence_to_mass(mass),
        evidence.evidence_to_alpha(mass),
        evidence.maximize_uncertainty(mass, 0.3),
        evidence.log_odds_to_mass(cells),
        evidence.counts_to_mass(cells, cells),
        evidence.probability_to_mass(cells / 4, 0.1),
        evidence.renormalize(mass),
    ]
    per_cell = [
        evidence.unknown(mass),
        evidence.mass_to_probability(mass),
        evidence.plausibility_transform(mass),
        evidence.mass_to_log_odds(mass),
    ]
    for value in per_pair:
        assert (value.dtype, value.shape) == (dtype, (*shape, 2))
    for value in per_cell:
        assert (value.dtype, value.shape) == (dtype, shape)
