"""Masses of every kind: arrays, tensors, lists, whole numbers, triples and opinions."""

from typing import Any

import numpy as np
import pytest
import torch
from cases import each, refused
from masses import C3, CLOSED, A, B, pair, rule, triple

from ogm import EvidentialGrid, GridSpec, evidence
from ogm.evidence import Opinion, powerset

OPINIONS = [Opinion(*pair(one)) for one in (A, B, C3)]


@each("name", CLOSED)
def test_rules_return_the_kind_that_they_take(name: str) -> None:
    combine, masses = rule(name), [pair(one) for one in (A, B, C3)]
    expected = combine(*masses)
    assert combine(*OPINIONS) == Opinion.from_mass(expected)
    np.testing.assert_array_equal(combine(*[mass.tolist() for mass in masses]), expected)
    np.testing.assert_array_equal(combine(masses, axis=0), expected)
    np.testing.assert_array_equal(combine(OPINIONS, axis=0), expected)
    np.testing.assert_allclose(combine(*(A, B, C3)), triple(expected), atol=1e-15)
    np.testing.assert_allclose(combine(np.array([A, B, C3]), axis=0), triple(expected), atol=1e-15)
    tensors = [torch.tensor(mass, dtype=torch.float32) for mass in masses]
    for mixed in (combine(tensors[0], masses[1].tolist(), OPINIONS[2]), combine(tensors, axis=0)):
        assert mixed.dtype == torch.float32
        np.testing.assert_allclose(mixed, expected, atol=1e-6)
    grid = np.broadcast_to(masses[0].astype(np.float32), (3, 4, 2))
    mixed = combine(grid, OPINIONS[1], C3)
    assert (mixed.dtype, mixed.shape) == (np.float32, (3, 4, 2))
    np.testing.assert_allclose(mixed[1, 2], expected, atol=1e-6)


def test_whole_numbers_grids_and_open_triples_are_masses() -> None:
    np.testing.assert_array_equal(evidence.dempster([1, 0], np.array([0, 1])), (0.5, 0.5))
    assert evidence.yager([1, 0], torch.tensor([0.5, 0.25])).dtype == torch.float32
    assert evidence.yager(torch.tensor([1, 0]), torch.tensor([0, 1])).dtype == torch.float64
    spec = GridSpec(1.0, (2, 1), (0.0, 0.0))
    grid = EvidentialGrid(spec, np.array([[A[:2]], [B[:2]]], np.float32))
    np.testing.assert_array_equal(evidence.discount(grid, 0.5), grid.mass / 2)
    joint = evidence.conjunctive(OPINIONS[0], OPINIONS[1])
    np.testing.assert_allclose(joint, (0.23, 0.36, 0.09))
    np.testing.assert_allclose(evidence.conjunctive(joint, C3), evidence.conjunctive(A, B, C3))
    assert np.array(evidence.disjunctive(OPINIONS[0], OPINIONS[1])) == pytest.approx(np.array([0.05, 0.12]))
    refused(r"triples \(free, occupied, unknown\) that sum to 1.*close_world\(a\)", evidence.dempster, joint, C3)
    np.testing.assert_allclose(evidence.dempster(evidence.close_world(joint), C3[:2]), evidence.dempster(A, B, C3)[:2])


def test_what_is_no_mass_is_refused() -> None:
    refused("a must be masses: an array, a tensor, a list", evidence.dempster, "free", [0, 1], error=TypeError)
    refused("b must be masses.*of the same shape", evidence.dempster, [0, 1], [[0, 1], [0]], error=TypeError)
    refused(r"2 states.*got shape \(4,\)", evidence.dempster, [0.1, 0.2, 0.3, 0.4], [0, 1])
    refused("c must be non-negative", evidence.dempster, [0, 1], [0, 1], [0.9, 0.9])
    refused("the same dtype", evidence.dempster, np.zeros(2), [0, 1], np.zeros(2, np.float32), error=TypeError)


def test_functions_of_opinions_take_their_base_rates() -> None:
    sure, unsure = Opinion(0.1, 0.8, base_rate=0.2), Opinion(0.0, 0.3, base_rate=0.6)
    assert evidence.mass_to_probability(sure) == pytest.approx(sure.probability)
    assert evidence.mass_to_probability(sure, 0.5) == pytest.approx(0.85)
    assert evidence.maximize_uncertainty(sure).probability == pytest.approx(sure.probability)
    assert evidence.maximize_uncertainty(sure, 0.5) == Opinion.from_mass(evidence.maximize_uncertainty([0.1, 0.8], 0.5))
    # Rates by evidence, by confidence, and the plain mean; the rules that have no formula refuse.
    by_evidence = (0.2 * 0.9 * 0.7 + 0.6 * 0.3 * 0.1) / (0.9 * 0.7 + 0.3 * 0.1)
    assert evidence.cumulative(sure, unsure).base_rate == pytest.approx(by_evidence)
    for fuse in (evidence.weighted, evidence.belief_constraint, evidence.dempster):
        assert fuse(sure, unsure).base_rate == pytest.approx((0.2 * 0.9 + 0.6 * 0.3) / 1.2)
    assert evidence.averaging(sure, unsure).base_rate == pytest.approx(0.4)
    assert evidence.cumulative_epistemic(sure, unsure).base_rate == pytest.approx(by_evidence)
    refused("the same base rate, got 0.2, 0.6", evidence.yager, sure, unsure)
    refused("the same base rate", evidence.kl_divergence, sure, unsure)
    both = evidence.multiplication(sure, unsure)
    assert both == sure & unsure
    assert (both.base_rate, both.probability) == pytest.approx((0.12, sure.probability * unsure.probability))
    assert evidence.trust_discount(OPINIONS[0], unsure) == evidence.discount(OPINIONS[0], unsure.probability)


def test_opinions_have_operators() -> None:
    a, b, _ = OPINIONS
    assert a + b == evidence.cumulative(a, b)
    assert np.array((a + b) - b) == pytest.approx(np.array(a))
    assert 0.8 * a == a * np.float64(0.8) == np.float64(0.8) * a == evidence.discount(a, 0.8)
    assert ~~a == a
    assert (~a).probability == pytest.approx(1 - a.probability)
    assert (a | b).probability == pytest.approx((~(~a & ~b)).probability)  # De Morgan
    for operation in (lambda: a + 1, lambda: a - 1, lambda: a * b, lambda: a & 1, lambda: a | 1):
        with pytest.raises(TypeError):
            operation()


@each("mass", [pair(A), OPINIONS[0], A[:2], torch.tensor(pair(A))])
def test_trust_is_a_number_or_an_opinion(mass: Any) -> None:
    for trust in (0.8, np.float64(0.8), [0.2, 0.8], [0.1, 0.7]):
        np.testing.assert_allclose(np.asarray(evidence.trust_discount(mass, trust)), 0.8 * pair(A))
    np.testing.assert_allclose(np.asarray(evidence.trust_discount(mass, trust=OPINIONS[1])), 0.75 * pair(A))


@each("name", ["dempster", "cumulative", "averaging", "weighted", "yager", "pcr6", "murphy", "cautious"])
def test_gradients_of_several_sources_and_of_triples(name: str) -> None:
    drawn = np.random.default_rng(1).dirichlet([3, 3, 3], (3, 2))
    pairs = [torch.tensor(mass[..., :2], requires_grad=True) for mass in drawn]
    assert torch.autograd.gradcheck(rule(name), pairs)
    free, occupied = torch.tensor(drawn[0, 0, :2], requires_grad=True)
    rule(name)(torch.stack([free, occupied]), [0.5, 0.2], OPINIONS[1])[1].backward()
    found = [torch.tensor(mass, requires_grad=True) for mass in drawn]
    result = rule(name)(*found)
    np.testing.assert_allclose(result.detach(), triple(rule(name)(*pairs).detach().numpy()), atol=1e-12)
    result[..., 1].sum().backward()
    assert torch.isfinite(torch.stack([mass.grad for mass in found])).all()  # type: ignore[arg-type,misc]


def test_general_frames_take_several_sources() -> None:
    a, b, c = np.random.default_rng(0).dirichlet([1] * 8, (3, 5))
    for name in ("conjunctive", "disjunctive", "dempster", "cumulative", "cautious"):
        combine = getattr(powerset, name)
        np.testing.assert_allclose(combine(a, b, c), combine(combine(a, b), c), atol=1e-9)
        np.testing.assert_allclose(combine(np.stack([a, b[:1] + 0 * b, c]), axis=0), combine(a, b[0], c), atol=1e-12)
    for name in ("yager", "dubois_prade", "pcr5", "pcr6", "murphy", "averaging", "weighted"):
        combine = getattr(powerset, name)
        powerset.check_powerset(combine(a, b, c))
        np.testing.assert_allclose(combine(a, b, c), combine(c, a, b), atol=1e-12)
        assert abs(combine(a, b, c) - combine(combine(a, b), c)).max() > 1e-3
    refused("more than 65536", powerset.pcr6, *[np.eye(64)[1]] * 3)
