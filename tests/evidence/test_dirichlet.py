"""Entropy and divergence of Dirichlet densities against 60 digits, closed forms and published values."""

from typing import Any

import mpmath
import numpy as np
import pytest
import torch
from cases import each
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ogm import evidence
from ogm.evidence.dirichlet import dirichlet_kl_gradient

exponents = st.floats(-3, 7)
laws = settings(max_examples=80, deadline=None)


def exact_kl(alpha: Any, other: Any) -> Any:
    with mpmath.workdps(60):
        a, b = [mpmath.mpf(float(x)) for x in alpha], [mpmath.mpf(float(x)) for x in other]
        log_beta_a = sum(map(mpmath.loggamma, a)) - mpmath.loggamma(sum(a))
        log_beta_b = sum(map(mpmath.loggamma, b)) - mpmath.loggamma(sum(b))
        total = sum((x - y) * mpmath.digamma(x) for x, y in zip(a, b, strict=True))
        return log_beta_b - log_beta_a + total - (sum(a) - sum(b)) * mpmath.digamma(sum(a))


def exact_entropy(alpha: Any) -> Any:
    with mpmath.workdps(60):
        a = [mpmath.mpf(float(x)) for x in alpha]
        log_beta = sum(map(mpmath.loggamma, a)) - mpmath.loggamma(sum(a))
        total = sum((x - 1) * mpmath.digamma(x) for x in a)
        return log_beta + (sum(a) - len(a)) * mpmath.digamma(sum(a)) - total


# Computed with 60 digits.
VECTORS = [
    ((1, 1), (2, 1), 0.30685281944),
    ((2, 1), (1, 1), 0.19314718056),
    ((2, 1), (1, 2), 1),
    ((1, 1), (11, 1), 7.6021047272),
    ((11, 1), (2, 1), 0.886566274057),
    ((1.5, 1.5), (1, 1), 0.0484172947105),
    ((101, 3), (100, 3), 1.45152709829e-4),
    ((1001, 1), (1000, 1), 4.99334082534e-7),
    ((1e4, 1e4), (1.01e4, 1e4), 0.248775851163),
    ((0.1, 0.1), (1.1, 0.1), 4.44156786326),
    ((1e5, 1), (1, 1), 10.512935465),
]


@each(("alpha", "other", "expected"), VECTORS)
def test_kl_vectors(alpha: tuple, other: tuple, expected: float) -> None:
    a, b = np.array(alpha, float), np.array(other, float)
    assert evidence.dirichlet_kl(a, b) == pytest.approx(expected, rel=1e-11)
    single = evidence.dirichlet_kl(a.astype(np.float32), b.astype(np.float32))
    assert single.dtype == np.float32
    assert single == pytest.approx(expected, rel=1e-4)
    assert evidence.dirichlet_kl(torch.tensor(a), torch.tensor(b)).item() == pytest.approx(expected, rel=1e-11)


@each("e", [0.5, 1.0, 10.0, 1e3])
def test_kl_of_missed_false_and_opposite_cells(e: float) -> None:
    """Closed forms: e - ln(1 + e), ln(1 + e) - e / (1 + e), and e times the harmonic number of e."""
    nothing, something, opposite = np.ones(2), np.array([1 + e, 1]), np.array([1, 1 + e])
    assert evidence.dirichlet_kl(nothing, something) == pytest.approx(e - np.log1p(e), rel=1e-12)
    assert evidence.dirichlet_kl(something, nothing) == pytest.approx(np.log1p(e) - e / (1 + e), rel=1e-12)
    harmonic = float(mpmath.harmonic(e))
    assert evidence.dirichlet_kl(something, opposite) == pytest.approx(e * harmonic, rel=1e-12)


@laws
@given(st.lists(st.tuples(exponents, exponents), min_size=2, max_size=4))
def test_kl_is_exact_for_all_sizes_of_alpha(logs: list) -> None:
    alpha, other = 10 ** np.array(logs).T
    exact = exact_kl(alpha, other)
    assert abs(evidence.dirichlet_kl(alpha, other) - exact) <= 1e-11 * (1 + exact)


@laws
@given(st.lists(st.tuples(exponents, st.floats(-1, 1)), min_size=2, max_size=4), st.floats(-7, -0.5))
@example([(5.0, 1.0), (0.5625, 0.25), (7.0, 1.0)], -7.0)
def test_kl_is_exact_and_never_negative_for_near_densities(parts: list, log_step: float) -> None:
    alpha = 10 ** np.array([part[0] for part in parts])
    other = alpha * (1 + np.array([part[1] for part in parts]) * 10**log_step)
    exact = exact_kl(alpha, other)
    value = evidence.dirichlet_kl(alpha, other)
    assert value >= 0
    assert abs(value - exact) <= 1e-11 * (1 + exact)
    if exact > 1e-14:
        assert abs(value - exact) <= 1e-2 * exact


@each("alpha", [(2.0, 5.0), (0.3, 40.0), (7.0, 1.5, 3.0)])
def test_the_series_for_near_densities_has_three_orders(alpha: tuple) -> None:
    """The third is some 1e-5 of the value where it ends, at a relative difference of 1e-4."""
    for sign in (1, -1):
        other = np.array(alpha) * (1 + sign * 9e-5 * np.array([1, -0.4, 0.2])[: len(alpha)])
        assert evidence.dirichlet_kl(np.array(alpha), other) == pytest.approx(float(exact_kl(alpha, other)), rel=1e-7)


def test_kl_is_never_negative_in_float32() -> None:
    """The textbook formula in float32 is: -5e-4 at alpha = 1e3."""
    rng = np.random.default_rng(0)
    alpha = (10 ** rng.uniform(0, 6, (100_000, 2))).astype(np.float32)
    other = (alpha * (1 + rng.uniform(-1e-3, 1e-3, alpha.shape))).astype(np.float32)
    assert evidence.dirichlet_kl(alpha, other).min() >= 0
    assert (evidence.dirichlet_kl(alpha, alpha) == 0).all()


@laws
@given(st.lists(exponents, min_size=2, max_size=4))
def test_entropy_is_exact(logs: list) -> None:
    alpha = 10 ** np.array(logs)
    exact = exact_entropy(alpha)
    assert abs(evidence.dirichlet_entropy(alpha) - exact) <= 1e-12 * (1 + abs(exact))
    tensor = evidence.dirichlet_entropy(torch.tensor(alpha)).item()
    assert abs(tensor - exact) <= 1e-12 * (1 + abs(exact))


@each("shape", [(), (5,), (2, 3), (0,)])
@each("dtype", [np.float32, np.float64])
def test_shapes_and_dtypes(shape: tuple, dtype: Any) -> None:
    alpha = np.full((*shape, 3), 2, dtype)
    for value in (evidence.dirichlet_kl(alpha, alpha + 1), evidence.dirichlet_entropy(alpha)):
        assert value.shape == shape
        assert value.dtype == dtype


@each("alpha", [(3.0, 3.0), (5.0, 5.0), (9.99, 10.01), (10.0, 3.0), (0.5, 9.0)])
def test_entropy_is_exact_around_the_begin_of_the_series(alpha: tuple) -> None:
    """Six terms of the asymptotic series give 1e-15 from 10 on, and only 1e-11 at 3."""
    exact = exact_entropy(np.array(alpha))
    assert abs(evidence.dirichlet_entropy(np.array(alpha)) - exact) <= 3e-14 * (1 + abs(exact))


@each("states", [2, 3])
def test_gradient_is_the_difference_quotient(states: int) -> None:
    rng = np.random.default_rng(0)
    alpha, other = 1 + 10 ** rng.uniform(-2, 2, (2, 200, states))
    value, gradient = dirichlet_kl_gradient(alpha, other)
    np.testing.assert_array_equal(value, evidence.dirichlet_kl(alpha, other))
    folded = dirichlet_kl_gradient(alpha.reshape(10, 20, states), other.reshape(10, 20, states))
    np.testing.assert_array_equal(folded[1].reshape(200, states), gradient)
    for k in range(states):
        step = 1e-5 * alpha[:, k, None] * np.eye(states)[k]
        above, below = (evidence.dirichlet_kl(alpha + sign * step, other) for sign in (1, -1))
        np.testing.assert_allclose(gradient[:, k], (above - below) / (2 * step[:, k]), rtol=1e-6, atol=1e-6)


@each("states", [2, 3])
def test_gradient_in_single_precision_is_that_in_double(states: int) -> None:
    rng = np.random.default_rng(1)
    alpha, other = (1 + 10 ** rng.uniform(-6, 5, (2, 5000, states))).astype(np.float32)
    exact = dirichlet_kl_gradient(alpha.astype(float), other.astype(float))
    for found in (
        dirichlet_kl_gradient(alpha, other),
        [one.numpy() for one in dirichlet_kl_gradient(torch.from_numpy(alpha), torch.from_numpy(other))],
    ):
        scale = 1 + other.sum(-1)  # of the terms that nearly cancel
        assert [one.dtype for one in found] == [np.float32, np.float32]
        assert found[0].min() >= 0
        assert (abs(found[0] - exact[0]) <= 2e-6 * (exact[0] + scale)).all()
        assert (abs(found[1] - exact[1]) <= 2e-6 * (abs(exact[1]) + scale[:, None])).all()
