"""Losses per cell for networks that output evidence, and their mean over cells.

A loss takes evidence (..., 2), free and occupied, at least 0, and a target (..., 2) in [0, 1], the
probabilities that the truth is free and occupied; the rest to one is `unknown`, and (0, 0) is an unobserved cell.
It returns float32, or float64 if `evidence` is, per cell, (...). Half precision is computed in float32, and only
shapes and types are checked: a NaN in is a NaN out.

The default is `reverse_kl`; the others are those of the literature, for comparison.

    target, valid = targets(state)
    loss = masked_mean(reverse_kl(evidence, target), valid)
"""

import math
from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ogm.evidence.dirichlet import dirichlet_kl_gradient
from ogm.state import CellState

__all__ = [
    "Loss",
    "annealing",
    "class_weights",
    "digamma_loss",
    "log_loss",
    "masked_mean",
    "reverse_kl",
    "sum_of_squares",
    "targets",
    "undo_class_weights",
    "uniform_kl",
]

Loss = Callable[[Tensor, Tensor], Tensor]

_CHUNK = 32768  # cells at a time on a CPU, so that intermediate results stay near its cores


def reverse_kl(evidence: Tensor, target: Tensor, strength: float = 10.0) -> Tensor:
    """Return KL[Dir(1 + e) || Dir(1 + E y)] / E, the divergence from the target Dirichlet, per cell.

    Over labels that vary, its mean is least at e = E P(label), exactly: the evidence is a probability, and
    `unknown` is the probability that the truth is unknown too.

    Parameters
    ----------
    evidence : (..., 2) floating point
        At least 0.
    target : (..., 2)
        P(free), P(occupied); it gets no gradient.
    strength : float
        E, the evidence of a certain label. The least mass on unknown is 2 / (2 + E).

    Returns
    -------
    (...), at least 0
        A missed cell costs 1 - ln(1 + E) / E, a false one (ln(1 + E) - E / (1 + E)) / E.

    Raises
    ------
    TypeError, ValueError
        If shapes or types do not fit, or `strength` is not finite and greater than 0.

    Notes
    -----
    Malinin and Gales 2019. Value and gradient are those of `ogm.evidence.dirichlet`; there is no second derivative.
    A cell whose loss is not used has the gradient 0 even where its evidence is NaN.
    """
    _check(evidence, target)
    _check_strength(strength)
    loss: Tensor = _ReverseKL.apply(evidence, target.detach(), float(strength))
    return loss


def sum_of_squares(evidence: Tensor, target: Tensor, variant: Literal["paper", "released"] = "paper") -> Tensor:
    """Return the expected squared error sum (y - p)^2 + p (1 - p) / (S + 1), per cell.

    Parameters
    ----------
    evidence : (..., 2) floating point
        At least 0.
    target : (..., 2)
        P(free), P(occupied).
    variant : {"paper", "released"}
        "paper": p = alpha / S, the mean of the Dirichlet density, as printed. An unknown cell then pulls towards
        p = (0, 0), which no density has: without `uniform_kl` its evidence grows without bounds, for both
        states alike. "released": p = e / S, the belief masses, as in the code that the paper's authors
        published; least at no evidence in an unknown cell.

    Notes
    -----
    Sensoy et al. 2018, eq. 5. With "paper" it is the mean of ||y - p||^2 over p ~ Dir(1 + e).
    """
    _check(evidence, target)
    if variant not in ("paper", "released"):
        raise ValueError(f'variant must be "paper" or "released", got {variant!r}')
    e, y = _precise(evidence, target)
    total = e.sum(-1, keepdim=True) + 2
    p = (e + 1 if variant == "paper" else e) / total
    return ((y - p) ** 2 + p * (1 - p) / (total + 1)).sum(-1)


def log_loss(evidence: Tensor, target: Tensor) -> Tensor:
    """Return sum y (ln S - ln alpha), per cell: the negative log of the marginal likelihood (type II).

    It is 0 for unknown cells, and its optimum in a known cell is infinite evidence: add `uniform_kl`. Sensoy et al.
    2018, eq. 3.
    """
    _check(evidence, target)
    e, y = _precise(evidence, target)
    return (y * (torch.log(e.sum(-1, keepdim=True) + 2) - torch.log1p(e))).sum(-1)


def digamma_loss(evidence: Tensor, target: Tensor) -> Tensor:
    """Return sum y (digamma(S) - digamma(alpha)), per cell: the expected cross entropy.

    It is the mean of -sum y ln p over p ~ Dir(1 + e), and has the optima of `log_loss`. Sensoy et al. 2018, eq. 4.
    """
    _check(evidence, target)
    e, y = _precise(evidence, target)
    return (y * (torch.digamma(e.sum(-1, keepdim=True) + 2) - torch.digamma(e + 1))).sum(-1)


def uniform_kl(evidence: Tensor, target: Tensor) -> Tensor:
    """Return KL[Dir(1 + e (1 - y)) || Dir(1, 1)], per cell: the evidence that the target does not support.

    The losses of Sensoy et al. need it as a second term, weighted by `annealing`; alone it makes an unknown
    cell vacuous.
    """
    _check(evidence, target)
    e, y = _precise(evidence, target)
    return reverse_kl(e * (1 - y), torch.zeros_like(y), strength=1.0)


def annealing(epoch: float, epochs: float = 10.0) -> float:
    """Return the weight min(1, epoch / epochs) of `uniform_kl` in a sum of losses; `epoch` counts from 0."""
    if not (epoch >= 0 and epochs > 0):
        raise ValueError(f"epoch must be at least 0 and epochs greater than 0, got {epoch} and {epochs}")
    return min(1.0, epoch / epochs)


def targets(state: Tensor) -> tuple[Tensor, Tensor]:
    """Return the target and the valid cells of a truth's states.

    Parameters
    ----------
    state : (...) uint8
        0 unknown, 1 free, 2 occupied, 3 ignore.

    Returns
    -------
    target : (..., 2) float32
        (1, 0) where free, (0, 1) where occupied, (0, 0) elsewhere.
    valid : (...) bool
        False where the state is to be ignored.
    """
    if state.dtype != torch.uint8:
        raise TypeError(f"state must be uint8, got {state.dtype}; convert it with .to(torch.uint8)")
    target = torch.stack([state == CellState.FREE, state == CellState.OCCUPIED], -1)
    return target.float(), state != CellState.IGNORE


def masked_mean(loss: Tensor, valid: Tensor, weight: Tensor | None = None) -> Tensor:
    """Return the mean over the valid cells, of `weight` times the loss if weights are given.

    Parameters
    ----------
    loss : (...) floating point
        Values of cells that are not valid do not change the mean, not even NaN. With `reverse_kl` and `uniform_kl`
        they do not change the gradient either; with the other losses a NaN evidence has a NaN gradient.
    valid : (...) bool
    weight : (...), optional
        As from `class_weights`. The sum is divided by the number of valid cells, not of weights, as the
        paper's code does.

    Returns
    -------
    () float32 or float64
        0 where no cell is valid; still differentiable.
    """
    if valid.dtype != torch.bool:
        raise TypeError(f"valid must be bool, got {valid.dtype}")
    for name, tensor in (("valid", valid), ("weight", weight)):
        if tensor is not None and tensor.shape != loss.shape:
            raise ValueError(f"{name} must have the loss's shape {tuple(loss.shape)}, got {tuple(tensor.shape)}")
    kept = torch.where(valid, *_precise(loss), 0)
    if weight is not None:
        kept = kept * weight
    return kept.sum() / valid.sum().clamp(min=1)


def class_weights(target: Tensor, free: float = 1.0, occupied: float = 1.0, unknown: float = 1.0) -> Tensor:
    """Return a weight per cell by its class; for soft targets the expected one. The paper has occupied=100.

    Weights are greater than 0, and `undo_class_weights` undoes them. Returns (...), with the target's dtype.
    """
    _check_weights(free, occupied, unknown)
    _check_states(target, "target")
    return unknown + (free - unknown) * target[..., 0] + (occupied - unknown) * target[..., 1]


def undo_class_weights(
    evidence: Tensor, free: float = 1.0, occupied: float = 1.0, unknown: float = 1.0, strength: float = 10.0
) -> Tensor:
    """Return the evidence that minimises `reverse_kl` without these class weights.

    With weights w the loss is least at e = E w P / sum(w P); so P is proportional to e / w for free and
    occupied, and to (E - sum e) / w for unknown. For the other losses there is no such closed form.

    Parameters
    ----------
    evidence : (..., 2) floating point
        At least 0. Where the sum exceeds E, P(unknown) is 0 and the sum is kept.
    free, occupied, unknown : float
        The weights given to `class_weights`.
    strength : float
        E of `reverse_kl`.

    Returns
    -------
    (..., 2), with the evidence's dtype
        E P. Exact for labels that are certain (targets of 0 and 1), as the weight of a soft target is a mean.

    Raises
    ------
    ValueError
        If a weight or `strength` is not finite and greater than 0.
    """
    _check_weights(free, occupied, unknown)
    _check_strength(strength)
    _check_states(evidence, "evidence")
    total = evidence.sum(-1, keepdim=True).clamp(min=strength)
    share = evidence / evidence.new_tensor([free, occupied])
    rest = (total - evidence.sum(-1, keepdim=True)) / unknown
    return total * share / (share.sum(-1, keepdim=True) + rest)


class _ReverseKL(torch.autograd.Function):
    """KL[Dir(1 + e) || Dir(1 + E t)] / E and its gradient, in one pass."""

    @staticmethod
    def forward(ctx: Any, evidence: Tensor, target: Tensor, strength: float) -> Tensor:
        e, t = _precise(evidence.detach(), target)
        gradient = torch.empty_like(e)  # laid out in memory as the evidence is, which may be states first
        free, occupied = e[..., 0].reshape(-1), e[..., 1].reshape(-1)
        t_free, t_occupied = t[..., 0].reshape(-1), t[..., 1].reshape(-1)
        loss, slope = torch.empty_like(free), e.new_empty((2, free.numel()))
        size = _CHUNK if e.device.type == "cpu" else max(free.numel(), 1)
        for start in range(0, free.numel(), size):
            chunk = slice(start, start + size)
            alpha = torch.stack([free[chunk], occupied[chunk]]).add_(1)
            other = torch.stack([t_free[chunk], t_occupied[chunk]]).mul_(strength).add_(1)
            value, force = dirichlet_kl_gradient(alpha.T, other.T)
            loss[chunk], slope[:, chunk] = value / strength, force.T / strength
        gradient[..., 0], gradient[..., 1] = slope.view(2, *e.shape[:-1])
        ctx.save_for_backward(gradient)
        ctx.dtype = evidence.dtype
        return loss.view(e.shape[:-1])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = ctx.saved_tensors
        outer = outer[..., None]
        return torch.where(outer == 0, 0, gradient * outer).to(ctx.dtype), None, None


def _check(evidence: Tensor, target: Tensor) -> None:
    if not evidence.is_floating_point():
        raise TypeError(f"evidence must be floating point, got {evidence.dtype}")
    _check_states(evidence, "evidence")
    if target.shape != evidence.shape:
        raise ValueError(
            f"target must have the evidence's shape {tuple(evidence.shape)}, got {tuple(target.shape)}; "
            "`targets` makes it from states"
        )


def _check_states(tensor: Tensor, name: str) -> None:
    if tensor.ndim == 0 or tensor.shape[-1] != 2:
        raise ValueError(
            f"{name} must have 2 states (free, occupied) on its last axis, got shape {tuple(tensor.shape)}"
        )


def _check_weights(free: float, occupied: float, unknown: float) -> None:
    if not all(0 < weight < math.inf for weight in (free, occupied, unknown)):
        raise ValueError(
            f"class weights must be finite and greater than 0, got free={free}, occupied={occupied}, unknown={unknown}"
        )


def _check_strength(strength: float) -> None:
    if not 0 < strength < math.inf:
        raise ValueError(f"strength must be finite and greater than 0, got {strength}")


def _precise(*tensors: Tensor) -> list[Tensor]:
    """Return the tensors in float32, or float64 where the first has it."""
    dtype = torch.promote_types(tensors[0].dtype, torch.float32)
    return [tensor.to(dtype) for tensor in tensors]
