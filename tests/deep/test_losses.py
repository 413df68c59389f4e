"""Losses: their optima, gradients and expectations, and what a mask and weights do to them."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from cases import each, refused
from scipy import optimize, special
from torch import Tensor

from ogm.deep.losses import (
    KERB,
    class_weights,
    digamma_loss,
    kerb_weights,
    log_loss,
    masked_mean,
    reverse_kl,
    sum_of_squares,
    targets,
    uniform_kl,
)
from ogm.deep.network import LITE
from ogm.deep.recipe import Recipe, mean_loss
from ogm.evidence import dirichlet_kl
from ogm.evidence.dirichlet import dirichlet_kl_gradient
from ogm.state import CellState


def paper(evidence: Tensor, target: Tensor) -> Tensor:
    return sum_of_squares(evidence, target)


def released(evidence: Tensor, target: Tensor) -> Tensor:
    return sum_of_squares(evidence, target, "released")


LOSSES = [reverse_kl, paper, released, log_loss, digamma_loss, uniform_kl]
KNOWN_AND_UNKNOWN = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]], dtype=torch.float64)

every_loss = each("loss", LOSSES)


def cells(n: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Give evidence from 1e-6 to 1e6 and targets: free, occupied, unknown and soft ones."""
    g = torch.Generator().manual_seed(seed)
    evidence = 10 ** (torch.rand(n, 2, generator=g, dtype=torch.float64) * 12 - 6)
    evidence[: n // 10] = 0
    target = torch.rand(n, 2, generator=g, dtype=torch.float64) / 2
    kind = torch.randint(0, 4, (n,), generator=g)
    target[kind < 3] = KNOWN_AND_UNKNOWN[kind[kind < 3]]
    return evidence.to(dtype), target.to(dtype)


def optimum(
    loss: Callable[[Tensor, Tensor], Tensor],
    chances: tuple[float, float, float],
    weights: tuple[float, float, float] = (1, 1, 1),
) -> Any:
    """Find the evidence (2,) where the expected loss of a cell with these chances of its states is least."""
    share = torch.tensor(chances, dtype=torch.float64) * torch.tensor(weights, dtype=torch.float64)

    def expected(evidence: Any) -> tuple[float, Any]:
        e = torch.tensor(evidence, requires_grad=True)
        value = (share * loss(e.expand(3, 2), KNOWN_AND_UNKNOWN)).sum() / share.sum()
        value.backward()
        return value.item(), e.grad.numpy()

    tight = {"ftol": 1e-15, "gtol": 1e-10, "maxiter": 1000}
    options = {"jac": True, "bounds": [(0, None)] * 2, "options": tight}
    found = [optimize.minimize(expected, np.array(start), **options) for start in ((0.1, 0.1), (5.0, 5.0))]
    return min(found, key=lambda one: one.fun).x


def with_uniform(loss: Callable[[Tensor, Tensor], Tensor], share: float) -> Callable:
    return lambda evidence, target: loss(evidence, target) + share * uniform_kl(evidence, target)


# --- reverse KL: value and gradient ---


@each("strength", [1.0, 10.0, 1e3, 1e6])
@each("dtype, tolerance", [(torch.float32, 2e-6), (torch.float64, 1e-13)])
def test_reverse_kl_is_the_exact_divergence(strength: float, dtype: torch.dtype, tolerance: float) -> None:
    evidence, target = cells(10_000, dtype=dtype)
    expected = dirichlet_kl(1 + evidence.double().numpy(), 1 + strength * target.double().numpy()) / strength
    found = reverse_kl(evidence, target, strength)
    assert found.dtype == dtype
    assert found.min() >= 0
    np.testing.assert_allclose(found.double(), expected, rtol=tolerance, atol=tolerance * (2 + 10 / strength))


@each("strength", [1.0, 10.0, 1e3])
@each("dtype, tolerance", [(torch.float32, 1e-6), (torch.float64, 1e-8)])
def test_reverse_kl_has_the_gradient_of_the_closed_form(strength: float, dtype: torch.dtype, tolerance: float) -> None:
    evidence, target = cells(5_000, dtype=dtype)
    evidence.requires_grad_()
    reverse_kl(evidence, target, strength).sum().backward()
    a, b = 1 + evidence.detach().double().numpy(), 1 + strength * target.double().numpy()
    s, t = a.sum(-1, keepdims=True), b.sum(-1, keepdims=True)
    expected = ((a - b) * special.polygamma(1, a) - (s - t) * special.polygamma(1, s)) / strength
    np.testing.assert_allclose(evidence.grad.double(), expected, rtol=tolerance, atol=tolerance)


def test_reverse_kl_is_the_expected_log_ratio_of_the_densities() -> None:
    evidence, target = torch.tensor([4.0, 1.5]).double(), torch.tensor([0.7, 0.1]).double()
    one = torch.distributions.Dirichlet(1 + evidence)
    other = torch.distributions.Dirichlet(1 + 10 * target)
    p = sample(one)
    ratio = one.log_prob(p) - other.log_prob(p)
    assert_mean(ratio, 10 * reverse_kl(evidence, target))


@each("strength", [1.0, 10.0, 20.0])
@each("dtype", [torch.float32, torch.float64])
def test_what_reverse_kl_charges(strength: float, dtype: torch.dtype) -> None:
    nothing = torch.zeros(2, dtype=dtype)
    claim = torch.tensor([0, strength], dtype=dtype)
    occupied = torch.tensor([0, 1], dtype=dtype)
    free = occupied.flip(-1)
    missed = 1 - math.log1p(strength) / strength
    invented = math.log1p(strength) / strength - 1 / (1 + strength)
    opposite = special.digamma(strength + 1) - special.digamma(1)
    close = {"rel": 1e-5}
    assert reverse_kl(nothing, occupied, strength).item() == pytest.approx(missed, **close)
    assert reverse_kl(claim, nothing, strength).item() == pytest.approx(invented, **close)
    assert reverse_kl(claim, free, strength).item() == pytest.approx(opposite, **close)
    assert reverse_kl(claim, occupied, strength).item() == pytest.approx(0, abs=1e-6)
    assert reverse_kl(nothing, nothing, strength).item() == pytest.approx(0, abs=1e-7)


def test_reverse_kl_starts_without_dead_cells() -> None:
    evidence = torch.zeros(2, 2, dtype=torch.float64, requires_grad=True)
    target = torch.tensor([[0.0, 1.0], [0.0, 0.0]])
    reverse_kl(evidence, target, 10.0).sum().backward()
    expected = [[math.pi**2 / 6 - 1, -1.0], [0.0, 0.0]]
    torch.testing.assert_close(evidence.grad, torch.tensor(expected, dtype=torch.float64))


@each("strength", [0.1, 1.0, 10.0, 1e3, 1e6])
def test_the_compiled_reverse_kl_agrees_with_its_reference(strength: float) -> None:
    evidence, target = cells(20_000, seed=7, dtype=torch.float32)
    leaf = evidence.clone().requires_grad_()
    loss = reverse_kl(leaf, target, strength)
    loss.sum().backward()
    value, gradient = (part / strength for part in dirichlet_kl_gradient(evidence + 1, target * strength + 1))
    assert (loss - value).abs().max() > 0  # else the reference is compared with itself
    assert ((loss - value).abs() <= 2e-6 * (2 + 10 / strength + value)).all()
    torch.testing.assert_close(leaf.grad, gradient, rtol=2e-6, atol=2e-6 * (1 + 1 / strength))


def test_nan_evidence_gives_nan_in_its_cell_alone() -> None:
    evidence, target = cells(100, seed=8, dtype=torch.float32)
    evidence[[3, 50], [0, 1]] = math.nan
    evidence.requires_grad_()
    loss = reverse_kl(evidence, target)
    loss.sum().backward()
    expected = torch.zeros(100, dtype=torch.bool)
    expected[[3, 50]] = True
    assert (loss.isnan() == expected).all()
    assert (evidence.grad.isnan().any(-1) == expected).all()


def test_reverse_kl_is_the_same_in_pieces_by_threads_and_in_any_layout(monkeypatch: pytest.MonkeyPatch) -> None:
    evidence, target = cells(2 * 150 * 131, seed=1, dtype=torch.float32)
    shape = (2, 150, 131, 2)
    evidence, target = evidence.view(shape), target.view(shape)
    states_first = evidence.permute(0, 3, 1, 2).contiguous().permute(0, 2, 3, 1)
    assert states_first.stride() != evidence.stride()
    results = []
    for e, threads in ((evidence, 1), (states_first, 1), (evidence, 3)):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        leaf = e.detach().requires_grad_()
        loss = reverse_kl(leaf, target)
        loss.sum().backward()
        assert leaf.grad.stride() == leaf.stride()
        results.append((loss.detach(), leaf.grad))
    row = evidence[1, 100].clone().requires_grad_()
    loss = reverse_kl(row, target[1, 100])
    loss.sum().backward()
    for other in results[1:]:
        torch.testing.assert_close(other, results[0], rtol=0, atol=0)
    close = {"rtol": 1e-5, "atol": 1e-6}  # vectorised and remaining elements may be rounded differently
    torch.testing.assert_close(loss.detach(), results[0][0][1, 100], **close)
    torch.testing.assert_close(row.grad, results[0][1][1, 100], **close)


def test_reverse_kl_reads_no_value_back() -> None:
    """On an accelerator a value that decides what is done next would be waited for."""
    evidence = torch.rand(3, 4, 2, device="meta", requires_grad=True)
    loss = masked_mean(reverse_kl(evidence, torch.rand(3, 4, 2, device="meta")), evidence[..., 0] > 0)
    loss.backward()
    assert evidence.grad.shape == evidence.shape


def test_reverse_kl_has_no_second_derivative() -> None:
    evidence = torch.ones(3, 2, requires_grad=True)
    loss = reverse_kl(evidence, torch.zeros(3, 2)) ** 2
    (first,) = torch.autograd.grad(loss.sum(), evidence, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        first.sum().backward()


# --- all losses ---


@every_loss
def test_gradients_agree_with_finite_differences(loss: Callable[[Tensor, Tensor], Tensor]) -> None:
    g = torch.Generator().manual_seed(3)
    evidence = (torch.rand(4, 5, 2, generator=g, dtype=torch.float64) * 30 + 1e-3).requires_grad_()
    target = torch.rand(4, 5, 2, generator=g, dtype=torch.float64) / 2
    target[0, :3] = KNOWN_AND_UNKNOWN
    assert torch.autograd.gradcheck(lambda e: loss(e, target), (evidence,))


@every_loss
def test_losses_are_the_same_when_free_and_occupied_swap(loss: Callable[[Tensor, Tensor], Tensor]) -> None:
    evidence, target = cells(1000, seed=2)
    torch.testing.assert_close(loss(evidence.flip(-1), target.flip(-1)), loss(evidence, target), rtol=1e-10, atol=1e-13)


@every_loss
@each("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_losses_are_finite_and_not_negative_from_none_to_much_evidence(
    loss: Callable[[Tensor, Tensor], Tensor], dtype: torch.dtype
) -> None:
    levels = torch.tensor([0, 1e-30, 1e-8, 1, 1e3, 1e6], dtype=torch.float64)
    evidence = torch.cartesian_prod(levels, levels)[:, None].expand(-1, 3, -1).to(dtype).requires_grad_()
    value = loss(evidence, KNOWN_AND_UNKNOWN.to(dtype).expand(evidence.shape))
    value.sum().backward()
    assert torch.isfinite(value).all()
    assert torch.isfinite(evidence.grad).all()
    assert value.min() >= 0


@every_loss
@each("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_is_computed_in_single(loss: Callable[[Tensor, Tensor], Tensor], dtype: torch.dtype) -> None:
    evidence, target = cells(500, seed=4)
    half = evidence.clamp(max=3e4).to(dtype)
    half, single = half.clone().requires_grad_(), half.float().requires_grad_()
    found, expected = loss(half, target.float()), loss(single, target.float())
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, expected, rtol=0, atol=0)
    found.sum().backward()
    expected.sum().backward()
    assert half.grad.dtype == dtype
    torch.testing.assert_close(half.grad, single.grad.to(dtype), rtol=0.02, atol=1e-3)


@every_loss
def test_losses_under_autocast_and_of_empty_batches(loss: Callable[[Tensor, Tensor], Tensor]) -> None:
    evidence, target = cells(200, seed=5, dtype=torch.float32)
    with torch.autocast("cpu", torch.bfloat16):
        found = loss(evidence, target)
    torch.testing.assert_close(found, loss(evidence, target), rtol=0, atol=0)
    evidence = torch.zeros(0, 4, 2, requires_grad=True)
    value = loss(evidence, torch.zeros(0, 4, 2))
    value.sum().backward()
    assert (value.shape, evidence.grad.shape) == ((0, 4), (0, 4, 2))


# --- expectations over the density ---


def sample(density: torch.distributions.Dirichlet) -> Tensor:
    torch.manual_seed(0)
    return density.sample((200_000,))


def assert_mean(samples: Tensor, expected: Tensor) -> None:
    """Hold that the samples' mean is the expected one, within five of its standard errors."""
    error = samples.std() / math.sqrt(len(samples))
    assert 0 < error < 0.02 * abs(expected)  # else this tests nothing
    assert abs(samples.mean() - expected) < 5 * error


@each("evidence, target", [((0.0, 0.0), (1.0, 0.0)), ((2.5, 0.4), (0.0, 1.0)), ((9.0, 3.0), (0.0, 0.0)),
                           ((2.5, 0.4), (0.3, 0.5))])  # fmt: skip
def test_losses_are_the_dirichlet_expectations(evidence: tuple, target: tuple) -> None:
    e, y = torch.tensor(evidence).double(), torch.tensor(target).double()
    p = sample(torch.distributions.Dirichlet(1 + e))
    assert_mean(((y - p) ** 2).sum(-1), paper(e, y))
    if y.sum() > 0:
        assert_mean(-(y * p.log()).sum(-1), digamma_loss(e, y))


@each("evidence", [(0.0, 0.0), (2.5, 0.4), (9.0, 3.0)])
def test_log_loss_is_the_log_of_the_expected_likelihood(evidence: tuple) -> None:
    e, free = torch.tensor(evidence).double(), torch.tensor([1.0, 0.0]).double()
    p = sample(torch.distributions.Dirichlet(1 + e))
    assert_mean(p[:, 0], torch.exp(-log_loss(e, free)))
    assert log_loss(e, free) < digamma_loss(e, free)  # Jensen


def test_released_variant_takes_belief_for_probability() -> None:
    evidence, target = torch.tensor([1.0, 0.0]), torch.tensor([1.0, 0.0])  # belief 1/3, S = 3
    assert released(evidence, target).item() == pytest.approx((2 / 3) ** 2 + (1 / 3) * (2 / 3) / 4)
    assert paper(evidence, target).item() == pytest.approx(2 * (1 / 3) ** 2 + 2 * (1 / 3) * (2 / 3) / 4)


def test_uniform_kl_charges_only_evidence_that_the_target_denies() -> None:
    evidence, target = cells(2000, seed=6)
    denied = (evidence * (1 - target)).numpy()
    expected = dirichlet_kl(1 + denied, np.ones_like(denied))
    np.testing.assert_allclose(uniform_kl(evidence, target), expected, rtol=1e-12, atol=1e-14)
    right = torch.tensor([[50.0, 0.0], [0.0, 50.0]])
    torch.testing.assert_close(uniform_kl(right, torch.eye(2)), torch.zeros(2), rtol=0, atol=1e-6)


# --- optima ---


@each("share, evidence", [(0.1, 3.70), (0.5, 0.413), (1.0, 0.18)])
def test_printed_loss_puts_evidence_into_unknown_cells(share: float, evidence: float) -> None:
    found = optimum(with_uniform(paper, share), (0, 0, 1))
    assert found == pytest.approx([evidence] * 2, rel=0.02)


def test_printed_loss_without_uniform_kl_wants_endless_conflict_in_unknown_cells() -> None:
    levels = torch.tensor([0, 1, 10, 1e3, 1e5]).double()
    loss = paper(levels[:, None].expand(-1, 2), torch.zeros(5, 2))
    assert (loss.diff() < 0).all()


@each("share", [0.0, 0.1, 1.0])
def test_released_loss_leaves_unknown_cells_vacuous(share: float) -> None:
    assert optimum(with_uniform(released, share), (0, 0, 1)) == pytest.approx([0, 0], abs=1e-8)


@each("loss", [log_loss, digamma_loss])
def test_log_losses_leave_unknown_cells_to_uniform_kl(loss: Callable[[Tensor, Tensor], Tensor]) -> None:
    evidence, _ = cells(100)
    assert (loss(evidence, torch.zeros_like(evidence)) == 0).all()
    assert optimum(with_uniform(loss, 1.0), (0, 0, 1)) == pytest.approx([0, 0], abs=1e-5)


@each("loss", [paper, released, log_loss, digamma_loss])
def test_losses_of_the_literature_want_endless_evidence_in_known_cells(
    loss: Callable[[Tensor, Tensor], Tensor],
) -> None:
    free = torch.tensor([[0, 0], [1, 0], [10, 0], [1e3, 0], [1e5, 0]]).double()
    value = with_uniform(loss, 1.0)(free, KNOWN_AND_UNKNOWN[0].expand(5, 2))
    assert (value.diff() < 0).all()


# Chances (P_F, P_O, P_U) of a cell's states, weight of occupied, and the masses (free, occupied) of each loss
TABLE = [
    ((0.99, 0.01, 0), 1, [(0.92, 0), (0.94, 0), (0.96, 0), (0.82, 0.01)]),
    ((0.99, 0.01, 0), 100, [(0.05, 0.06), (0.18, 0.18), (0.12, 0.13), (0.41, 0.42)]),
    ((0.9, 0.1, 0), 100, [(0, 0.72), (0, 0.79), (0, 0.73), (0.07, 0.76)]),
    ((0.5, 0, 0.5), 1, [(0.27, 0.02), (0.25, 0.01), (0.33, 0), (0.71, 0)]),
    ((0, 0.1, 0.9), 1, [(0.06, 0.09), (0, 0), (0, 0.05), (0, 0.33)]),
]


@pytest.mark.slow
@each("chances, weight, masses", TABLE)
def test_optima_of_cells_whose_state_varies(chances: tuple, weight: float, masses: list) -> None:
    literature = [with_uniform(loss, 1.0) for loss in (paper, released, digamma_loss)]
    for loss, expected in zip([*literature, reverse_kl], masses, strict=True):
        e = optimum(loss, chances, (1, weight, 1))
        assert e / (e.sum() + 2) == pytest.approx(expected, abs=0.0055)


@each("strength", [1.0, 10.0])
def test_reverse_kl_of_a_batch_is_least_at_the_evidence_of_its_frequencies(strength: float) -> None:
    state = torch.from_numpy(np.random.default_rng(0).choice(4, 5000, p=[0.3, 0.4, 0.1, 0.2]).astype(np.uint8))
    target, valid = targets(state)
    frequency = target[valid].double().mean(0)
    evidence = (strength * frequency).requires_grad_()
    mean = masked_mean(reverse_kl(evidence.expand(5000, 2), target, strength), valid)
    mean.backward()
    torch.testing.assert_close(evidence.grad, torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-12)
    for step in (-0.01, 0.01):
        for axis in (0, 1):
            moved = evidence.detach().clone()
            moved[axis] += step * strength
            assert masked_mean(reverse_kl(moved.expand(5000, 2), target, strength), valid) > mean


@each("weight, chances", [(1, (0.6, 0.1, 0.3)), (100, (0.2, 0.01, 0.79)), (0.5, (0.05, 0.9, 0.05))])
def test_the_optimum_under_class_weights(weight: float, chances: tuple) -> None:
    weights = (1, weight, 1)
    weighted = torch.from_numpy(optimum(reverse_kl, chances, weights))
    shares = np.multiply(weights, chances)
    assert weighted.numpy() == pytest.approx(10 * shares[:2] / shares.sum(), abs=1e-5)


def test_a_kerb_is_unknown_where_it_is_more_probable_than_free() -> None:
    """Evidence of 2, at which free and unknown are equal, where both are as probable."""
    weight = float(kerb_weights(torch.tensor([int(KERB)]))[0])
    assert optimum(reverse_kl, (0.5, 0.0, 0.5), (1, 1, weight)) == pytest.approx([2, 0], abs=1e-5)
    state = torch.tensor([*map(int, CellState), int(KERB)], dtype=torch.uint8)
    assert kerb_weights(state).tolist() == [1, 1, 1, 1, weight]
    target, valid = targets(state)
    assert (target[4].tolist(), bool(valid[4])) == ([0, 0], True)
    # A batch of a recipe has the same optimum.
    evidence = torch.tensor([2.0, 0.0], dtype=torch.float64, requires_grad=True)
    pair = torch.tensor([int(CellState.FREE), int(KERB)], dtype=torch.uint8)
    mean_loss(evidence.expand(2, 2), pair, Recipe(LITE), 1.0).backward()
    assert float(evidence.grad[0]) == pytest.approx(0, abs=1e-9)


def test_class_weights_move_the_optimum_of_a_batch() -> None:
    state = torch.from_numpy(np.random.default_rng(1).choice(3, 4000, p=[0.5, 0.4, 0.1]).astype(np.uint8))
    target, valid = targets(state)
    weight = class_weights(target, 30)
    evidence = torch.zeros(2, dtype=torch.float64)
    evidence[:] = 10 * (weight[:, None] * target).sum(0) / weight.sum()
    evidence.requires_grad_()
    masked_mean(reverse_kl(evidence.expand(4000, 2), target), valid, weight).backward()
    torch.testing.assert_close(evidence.grad, torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-6)


# --- targets, mask, weights ---


def test_targets_of_states() -> None:
    target, valid = targets(torch.tensor([[0, 1], [2, 3]], dtype=torch.uint8))
    assert target.dtype == torch.float32
    assert target.tolist() == [[[0, 0], [1, 0]], [[0, 1], [0, 0]]]
    assert valid.tolist() == [[True, True], [True, False]]


def test_masked_mean_is_the_mean_of_the_valid_cells() -> None:
    g = torch.Generator().manual_seed(8)
    loss, valid = torch.rand(7, 9, generator=g), torch.rand(7, 9, generator=g) < 0.4
    weight = torch.rand(7, 9, generator=g)
    torch.testing.assert_close(masked_mean(loss, valid), loss[valid].mean())
    torch.testing.assert_close(masked_mean(loss, valid, weight), (loss * weight)[valid].mean())
    assert masked_mean(loss.bfloat16(), valid).dtype == torch.float32


def test_half_precision_is_summed_in_single() -> None:
    loss = torch.full((100_000,), 0.1, dtype=torch.float16)
    assert masked_mean(loss, torch.ones(100_000, dtype=torch.bool)).item() == pytest.approx(0.1, rel=1e-3)


@every_loss
def test_ignored_cells_get_no_gradient_at_all(loss: Callable[[Tensor, Tensor], Tensor]) -> None:
    evidence, target = cells(300, seed=9, dtype=torch.float32)
    evidence = (evidence.clamp(max=100) + 0.1).requires_grad_()
    valid = torch.arange(300) % 3 > 0
    masked_mean(loss(evidence, target), valid).backward()
    assert (evidence.grad[~valid] == 0).all()
    assert (evidence.grad[valid & (target.sum(-1) > 0)] != 0).any()


@each("loss", [reverse_kl, uniform_kl])
def test_nan_in_ignored_cells_reaches_neither_mean_nor_gradient(loss: Callable[[Tensor, Tensor], Tensor]) -> None:
    evidence, target = cells(300, seed=10, dtype=torch.float32)
    valid = torch.arange(300) % 3 > 0
    clean, dirty = evidence.clone().requires_grad_(), evidence.clone()
    dirty[~valid] = math.nan
    dirty.requires_grad_()
    means = [masked_mean(loss(e, target), valid) for e in (clean, dirty)]
    for mean in means:
        mean.backward()
    assert means[0] == means[1]
    assert (dirty.grad == clean.grad).all()


@every_loss
def test_nan_in_a_valid_cell_is_seen_and_no_valid_cell_costs_nothing(loss: Callable[[Tensor, Tensor], Tensor]) -> None:
    evidence = torch.ones(4, 2)
    evidence[2, 0] = math.nan
    assert torch.isnan(masked_mean(loss(evidence, torch.eye(2).repeat(2, 1)), torch.ones(4, dtype=torch.bool)))
    evidence = torch.ones(5, 2, requires_grad=True)
    mean = masked_mean(loss(evidence, torch.zeros(5, 2)), torch.zeros(5, dtype=torch.bool))
    mean.backward()
    assert mean == 0
    assert (evidence.grad == 0).all()


def test_class_weights_of_hard_and_soft_targets() -> None:
    target = torch.tensor([[1, 0], [0, 1], [0, 0], [0.5, 0.25]])
    assert class_weights(target, 100).tolist() == [1, 100, 1, 25.75]


# --- bad input ---


@every_loss
def test_losses_refuse_what_does_not_fit(loss: Callable[[Tensor, Tensor], Tensor]) -> None:
    good = torch.zeros(4, 3, 2)
    refused("floating point, got torch.int64", loss, good.long(), good, error=TypeError)
    refused(r"2 states .* got shape \(4, 2, 3\)", loss, good.view(4, 2, 3), good.view(4, 2, 3))
    refused(r"shape \(4, 3, 2\), got \(4, 3\): make it with `targets`", loss, good, good[..., 0])
    refused("2 states", loss, torch.tensor(1.0), torch.tensor(1.0))


@each("strength", [0.0, -1.0, math.nan, math.inf])
def test_strength_must_be_a_positive_number(strength: float) -> None:
    refused("strength must be finite and greater than 0", reverse_kl, torch.zeros(2), torch.zeros(2), strength)


def test_other_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match='"paper" or "released", got \'printed\''):
        sum_of_squares(torch.zeros(2), torch.zeros(2), "printed")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"state must be uint8, got torch.int64: convert"):
        targets(torch.zeros(3, dtype=torch.int64))
    refused("valid must be bool, got torch.float32", masked_mean, torch.zeros(3), torch.ones(3), error=TypeError)
    with pytest.raises(ValueError, match=r"weight must have the loss's shape \(3,\), got \(3, 1\)"):
        masked_mean(torch.zeros(3), torch.ones(3, dtype=torch.bool), torch.ones(3, 1))
    for weight in (0, -1, math.nan, math.inf):
        refused("class weight must be finite and greater than 0", class_weights, torch.zeros(2), weight)
    refused(r"2 states .* got shape \(3,\)", class_weights, torch.zeros(3), 2)
