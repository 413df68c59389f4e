"""Torch twins: same numbers as numpy, right gradients, nothing leaves the device."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from cases import each
from hypothesis import given, settings
from masses import RULES, arrays_of_masses, rule, tolerance

from ogm import evidence
from ogm.evidence import multinomial, powerset

laws = settings(max_examples=15, deadline=None)

# Functions of one mass, and of two; on tensors and on arrays alike.
OF_ONE: dict[str, Callable[[Any], Any]] = {
    name: getattr(evidence, name)
    for name in [
        "unknown", "mass_to_probability", "pignistic", "plausibility_transform", "vacuity", "dissonance",
        "nonspecificity", "specificity", "yager_entropy", "pignistic_entropy", "jirousek_shenoy_entropy",
        "deng_entropy", "evidence_to_mass", "evidence_to_alpha", "renormalize", "log_odds_to_mass",
    ]
} | {
    "mass_to_evidence": lambda mass: evidence.mass_to_evidence(mass, min_unknown=1e-3),
    "maximize_uncertainty": lambda mass: evidence.maximize_uncertainty(mass, 0.3),
    "discount": lambda mass: evidence.discount(mass, 0.7),
    "discount_per_cell": lambda mass: evidence.discount(mass, mass[..., 0]),
    "discount_evidence": lambda mass: evidence.discount_evidence(mass, 0.7),
    "discount_over_time": lambda mass: evidence.discount_over_time(mass, mass[..., 0], 2.0),
    "contextual_discount": lambda mass: evidence.contextual_discount(mass, 0.7, mass[..., 1]),
    "trust_discount_number": lambda mass: evidence.trust_discount(mass, 0.7),
    "counts_to_mass": lambda mass: evidence.counts_to_mass(mass[..., 0], mass[..., 1]),
    "probability_to_mass": lambda mass: evidence.probability_to_mass(mass[..., 0], 0.0),
    "alpha_to_evidence": lambda mass: evidence.alpha_to_evidence(mass + 1),
    "dirichlet_entropy": lambda mass: evidence.dirichlet_entropy(mass * 30 + 0.1),
    "close_world": lambda mass: evidence.close_world(evidence.conjunctive(mass, mass)),
}  # fmt: skip
OF_TWO: dict[str, Callable[[Any, Any], Any]] = (
    {name: rule(name) for name in RULES}
    | {
        name: getattr(evidence, name)
        for name in [
        "conflict", "conflict_direction", "degree_of_conflict", "jousselme_distance", "trust_discount",
        "trust_discount_opposite",
    ]
    }
    | {
        "multiplication": lambda a, b: evidence.multiplication(a, b, 0.3, 0.6).mass,
        "comultiplication": lambda a, b: evidence.comultiplication(a, b, 0.3, 0.6).mass,
        "deduction": lambda a, b: evidence.deduction(a, b, a).mass,
        "abduction": lambda a, b: evidence.abduction(a, b, a, 0.3).mass,
        "kl_divergence": evidence.kl_divergence,
        "degree_of_falsity": evidence.degree_of_falsity,
        "reconciling_reliability": evidence.reconciling_reliability,
        "projected_probability": lambda a, b: multinomial.projected_probability(a, [0.2, 0.8]) * b[..., :1],
        "unfusion": lambda a, b: evidence.cumulative_unfusion(evidence.cumulative(a, b), a),
        "cumulative_base_rate": lambda a, b: evidence.cumulative_base_rate([a[..., 0], b[..., 0]], [0.3, 0.6]),
        "confidence_base_rate": lambda a, b: evidence.confidence_base_rate([a[..., 0], b[..., 0]], [0.3, 0.6]),
        "dirichlet_kl": lambda a, b: evidence.dirichlet_kl(a * 30 + 0.1, b * 30 + 0.1),
    }
)  # fmt: skip
GENERAL: dict[str, Callable[[Any, Any], Any]] = {
    name: getattr(powerset, name)
    for name in [
        "conjunctive", "disjunctive", "dempster", "yager", "dubois_prade", "pcr5", "murphy", "cautious",
        "cumulative", "averaging", "weighted", "consensus_compromise",
    ]
}  # fmt: skip


def agree(result: Any, expected: Any, times: float = 1) -> None:
    assert isinstance(result, torch.Tensor)
    assert str(result.dtype).endswith(str(expected.dtype))
    assert tuple(result.shape) == expected.shape
    np.testing.assert_allclose(result.numpy(), expected, atol=times * tolerance(np.asarray(expected)), rtol=1e-4)


@laws
@given(mass=arrays_of_masses())
@each("name", OF_ONE)
def test_functions_of_one_mass_agree_with_numpy(name: str, mass: np.ndarray) -> None:
    agree(OF_ONE[name](torch.from_numpy(mass)), OF_ONE[name](mass), times=10)


@laws
@given(masses=arrays_of_masses(2, least_unknown=1))
@each("name", OF_TWO)
def test_functions_of_two_masses_agree_with_numpy(name: str, masses: Any) -> None:
    a, b = masses
    agree(OF_TWO[name](torch.from_numpy(a), torch.from_numpy(b)), OF_TWO[name](a, b), times=100)


STACKED = ["dempster", "cumulative", "averaging", "weighted", "pcr6_plus", "murphy", "consensus_compromise"]


@laws
@given(masses=arrays_of_masses(3))
@each("name", STACKED)
def test_stacks_and_certainties_agree_with_numpy(name: str, masses: Any) -> None:
    stack = np.stack(masses)
    agree(rule(name)(torch.from_numpy(stack), axis=0), rule(name)(stack, axis=0), times=10)


def test_general_frames_agree_with_numpy() -> None:
    a, b = np.random.default_rng(0).dirichlet([1] * 8, (2, 3, 4))
    for combine in GENERAL.values():
        agree(combine(torch.from_numpy(a), torch.from_numpy(b)), combine(a, b))
    for name in ("mass_to_commonality", "mass_to_belief", "mass_to_plausibility", "pignistic"):
        agree(getattr(powerset, name)(torch.from_numpy(a)), getattr(powerset, name)(a))


def inner_masses(count: int) -> list[torch.Tensor]:
    """Masses inside the simplex, where everything is differentiable."""
    drawn = np.random.default_rng(1).dirichlet([3, 3, 3], (count, 2, 3))[..., :2]
    return [torch.tensor(mass, requires_grad=True) for mass in drawn]


@pytest.mark.slow
@each("name", OF_ONE)
def test_gradients_of_functions_of_one_mass(name: str) -> None:
    assert torch.autograd.gradcheck(OF_ONE[name], inner_masses(1))


@each("name", OF_TWO)
def test_gradients_of_functions_of_two_masses(name: str) -> None:
    assert torch.autograd.gradcheck(OF_TWO[name], inner_masses(2))


@pytest.mark.slow
@each("name", [*STACKED, "yager"])
def test_gradients_of_stacks(name: str) -> None:
    stack = torch.stack(inner_masses(3)).detach().requires_grad_()
    assert torch.autograd.gradcheck(lambda masses: rule(name)(masses, axis=0), [stack])


@pytest.mark.slow
@each("name", sorted(set(GENERAL) - {"consensus_compromise"}))
def test_gradients_of_general_rules(name: str) -> None:
    drawn = np.random.default_rng(1).dirichlet([3] * 4, (2, 2))
    masses = [torch.tensor(mass, requires_grad=True) for mass in drawn]
    assert torch.autograd.gradcheck(GENERAL[name], masses)


@pytest.mark.slow
def test_second_derivatives_of_the_divergence() -> None:
    a, b = (torch.tensor(x, requires_grad=True) for x in np.random.default_rng(2).uniform(0.5, 20, (2, 3, 2)))
    assert torch.autograd.gradgradcheck(evidence.dirichlet_kl, [a, b])


@each("name", ["dempster", "cumulative", "averaging", "weighted", "pcr5", "yager", "murphy"])
def test_gradients_are_finite_at_the_corners(name: str) -> None:
    corners = torch.tensor([[1.0, 0], [0, 1], [0, 0], [0.5, 0.5]], dtype=torch.float64)
    a = corners.repeat(4, 1).requires_grad_()
    b = corners.repeat_interleave(4, 0).requires_grad_()
    rule(name)(a, b).sum().backward()
    assert torch.isfinite(a.grad).all()  # type: ignore[arg-type]
    assert torch.isfinite(b.grad).all()  # type: ignore[arg-type]


def test_gradients_of_measures_are_finite_at_corners_and_where_a_distance_is_zero() -> None:
    for measure in (
        evidence.deng_entropy,
        evidence.jirousek_shenoy_entropy,
        evidence.yager_entropy,
        evidence.dissonance,
        lambda mass: evidence.jousselme_distance(mass, mass.detach()),
    ):
        corners = torch.tensor([[1.0, 0], [0, 1], [0, 0], [0.5, 0.5], [0.5, 0.2]], requires_grad=True)
        measure(corners).sum().backward()
        assert torch.isfinite(corners.grad).all(), measure  # type: ignore[arg-type]


def test_near_densities_have_a_gradient() -> None:
    alpha = torch.tensor([[10.0, 3.0], [10.0, 3.0]], dtype=torch.float64, requires_grad=True)
    other = torch.tensor([[10.0, 3.0], [10.0001, 3.0]], dtype=torch.float64)
    evidence.dirichlet_kl(alpha, other).sum().backward()
    assert torch.isfinite(alpha.grad).all()  # type: ignore[arg-type]


@each(("function", "shapes"), [
    *((OF_ONE[name], [(5, 2)]) for name in OF_ONE),
    *((OF_TWO[name], [(5, 2)] * 2) for name in OF_TWO if name != "dirichlet_kl"),
    *((GENERAL[name], [(5, 8)] * 2) for name in GENERAL),
])  # fmt: skip
@pytest.mark.slow
def test_tensors_of_an_accelerator_stay_there(function: Any, shapes: list[tuple[int, ...]]) -> None:
    """The meta device holds shapes and no values: reading one, or leaving for numpy, is an error on it."""
    assert function(*(torch.zeros(shape, device="meta") for shape in shapes)).device.type == "meta"
    alpha = torch.ones(5, 2, device="meta")
    assert evidence.dirichlet_kl(alpha, alpha).device.type == "meta"


def test_parameters_are_tensors() -> None:
    mass = torch.nn.Parameter(torch.tensor([0.5, 0.2]))
    assert evidence.dempster(mass, mass).requires_grad


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@each("name", OF_TWO)
def test_cuda_tensors_give_the_same_numbers(name: str) -> None:
    a, b = np.random.default_rng(0).dirichlet([1, 1, 1], (2, 40))[..., :2].copy()
    result = OF_TWO[name](torch.from_numpy(a).cuda(), torch.from_numpy(b).cuda())
    assert result.device.type == "cuda"
    np.testing.assert_allclose(result.cpu().numpy(), OF_TWO[name](a, b), atol=1e-9)
