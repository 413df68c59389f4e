"""Losses per cell for networks that output evidence, and their mean over cells.

A loss takes evidence (..., 2) for free and occupied, at least 0, and a target (..., 2) in [0, 1], the probabilities
that the truth is free and occupied; the remainder to 1 is unknown, so (0, 0) is an unobserved cell. It returns a value
per cell (...), float64 for float64 evidence, else float32. Half precision is computed in float32. Only shapes and types
are checked; NaN evidence gives NaN.

The default is `reverse_kl`; the others are losses from the literature, for comparison::

    target, valid = targets(state)
    loss = masked_mean(reverse_kl(evidence, target), valid)

>>> import torch
>>> from ogm.deep.losses import reverse_kl
>>> evidence, target = torch.tensor([[10.0, 0.0], [0.0, 10.0]]), torch.tensor([[1.0, 0.0], [1.0, 0.0]])
>>> loss = reverse_kl(evidence, target)                                     # correct, and certain of the opposite
>>> bool(loss[0] < 1e-4 < loss[1])
True
"""

import math
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ogm.deep.loss_kernel import fill_reverse_kl
from ogm.evidence.dirichlet import dirichlet_kl_gradient
from ogm.state import CellState
from ogm.threads import shared_threads

__all__ = [
    "KERB", "class_weights", "digamma_loss", "kerb_weights", "log_loss", "masked_mean", "reverse_kl", "sum_of_squares",
    "targets", "uniform_kl",
]  # fmt: skip

KERB = np.uint8(4)  # a true state of kerbs for training: unknown, with a greater weight
_KERB_WEIGHT = 4.0


def reverse_kl(evidence: Tensor, target: Tensor, strength: float = 10.0) -> Tensor:
    """Return KL[Dir(1 + e) || Dir(1 + E y)] / E, the divergence from the target Dirichlet, per cell.

    For varying labels, the mean has its minimum exactly at e = E P(label). The evidence is thus a scaled probability,
    and `unknown` the probability that the truth is unknown.

    Parameters
    ----------
    evidence : (..., 2) floating point
        Evidence for free and occupied, at least 0.
    target : (..., 2)
        P(free), P(occupied); gets no gradient.
    strength : float
        E, the evidence of a certain label. The smallest mass on unknown is 2 / (2 + E).

    Returns
    -------
    (...)
        Loss, at least 0. A missed cell costs 1 - ln(1 + E) / E, a false one (ln(1 + E) - E / (1 + E)) / E.

    Raises
    ------
    TypeError, ValueError
        If shapes or types do not fit, or `strength` is not finite and greater than 0.

    Notes
    -----
    Malinin and Gales 2019. For value and gradient see `ogm.evidence.dirichlet`; there is no second derivative.
    A cell with an unused loss has the gradient 0, even if its evidence is NaN.
    """
    _check_positive("strength", strength)
    apply: Any = _ReverseKL.apply
    loss: Tensor = apply(*_checked(evidence, target.detach()), float(strength))
    return loss


def sum_of_squares(evidence: Tensor, target: Tensor, variant: Literal["paper", "released"] = "paper") -> Tensor:
    """Return the expected squared error sum (y - p)^2 + p (1 - p) / (S + 1), per cell.

    Parameters
    ----------
    evidence : (..., 2) floating point
        Evidence for free and occupied, at least 0.
    target : (..., 2)
        P(free), P(occupied).
    variant : {"paper", "released"}
        "paper": p = alpha / S, the mean of the Dirichlet density, as printed. The target p = (0, 0) of an unknown
        cell cannot be reached by a density: without `uniform_kl`, the evidence of both states grows without bound.
        "released": p = e / S, the belief masses, as in the published code of the paper's authors; an unknown cell has
        its minimum at zero evidence.

    Notes
    -----
    Sensoy et al. 2018, eq. 5. With "paper" it is the mean of ||y - p||^2 over p ~ Dir(1 + e).
    """
    e, y = _checked(evidence, target)
    if variant not in ("paper", "released"):
        raise ValueError(f'variant must be "paper" or "released", got {variant!r}')
    total = e.sum(-1, keepdim=True) + 2
    p = (e + 1 if variant == "paper" else e) / total
    return ((y - p) ** 2 + p * (1 - p) / (total + 1)).sum(-1)


def log_loss(evidence: Tensor, target: Tensor) -> Tensor:
    """Return sum y (ln S - ln alpha), per cell: the negative log of the marginal likelihood (type II).

    It is 0 for unknown cells, and its optimum in a known cell is infinite evidence, so add `uniform_kl`. See Sensoy et
    al. 2018, eq. 3.
    """
    e, y = _checked(evidence, target)
    return (y * (torch.log(e.sum(-1, keepdim=True) + 2) - torch.log1p(e))).sum(-1)


def digamma_loss(evidence: Tensor, target: Tensor) -> Tensor:
    """Return sum y (digamma(S) - digamma(alpha)), per cell: the expected cross entropy.

    It is the mean of -sum y ln p over p ~ Dir(1 + e), and has the optima of `log_loss`. See Sensoy et al. 2018, eq. 4.
    """
    e, y = _checked(evidence, target)
    return (y * (torch.digamma(e.sum(-1, keepdim=True) + 2) - torch.digamma(e + 1))).sum(-1)


def uniform_kl(evidence: Tensor, target: Tensor) -> Tensor:
    """Return KL[Dir(1 + e (1 - y)) || Dir(1, 1)], per cell: a penalty of evidence against the target.

    The losses of Sensoy et al. need it as a second term with a weight that grows from 0 to 1 over the first epochs.
    On its own, it makes unknown cells vacuous.
    """
    e, y = _checked(evidence, target)
    return reverse_kl(e * (1 - y), torch.zeros_like(y), strength=1.0)


def targets(state: Tensor) -> tuple[Tensor, Tensor]:
    """Return the target and the valid cells for true states.

    Parameters
    ----------
    state : (...) uint8
        0 unknown, 1 free, 2 occupied, 3 ignore; `KERB` is unknown.

    Returns
    -------
    target : (..., 2) float32
        (1, 0) for free, (0, 1) for occupied, (0, 0) for other states.
    valid : (...) bool
        False for ignored cells.
    """
    if state.dtype != torch.uint8:
        raise TypeError(f"state must be uint8, got {state.dtype}: convert it with .to(torch.uint8)")
    dim = min(state.ndim, 1)  # in memory the states are after the batch, like a network's evidence
    target = torch.stack([state == CellState.FREE, state == CellState.OCCUPIED], dim).float().movedim(dim, -1)
    return target, state != CellState.IGNORE


def masked_mean(loss: Tensor, valid: Tensor, weight: Tensor | None = None) -> Tensor:
    """Return the mean of the loss, optionally weighted, over valid cells.

    Parameters
    ----------
    loss : (...) floating point
        Loss per cell. Invalid cells do not change the mean, not even with NaN. With `reverse_kl` and `uniform_kl` they
        do not change the gradient either; with the other losses NaN evidence has a NaN gradient.
    valid : (...) bool
        Cells to average.
    weight : (...), optional
        Weight per cell, see `class_weights`. The weighted sum is divided by the number of valid cells, not by the sum
        of weights, as in the paper's code.

    Returns
    -------
    () float32 or float64
        Mean; 0 and still differentiable if no cell is valid.
    """
    if valid.dtype != torch.bool:
        raise TypeError(f"valid must be bool, got {valid.dtype}")
    for name, tensor in (("valid", valid), ("weight", weight)):
        if tensor is not None and tensor.shape != loss.shape:
            raise ValueError(f"{name} must have the loss's shape {tuple(loss.shape)}, got {tuple(tensor.shape)}")
    kept = torch.where(valid, _precise(loss)[0], 0)
    if weight is not None:
        kept = kept * weight
    return kept.sum() / valid.sum().clamp(min=1)


def kerb_weights(state: Tensor) -> Tensor:
    """Return a weight per cell, (...) float32: 4 for `KERB`, else 1.

    With it, the optimum of `reverse_kl` has its greatest mass on unknown exactly where a kerb is more probable than
    free: with the probabilities P and 1 - P, e = E (1 - P) / (1 - P + 4 P), which is below 2, the evidence at which
    free and unknown are equal, from P = 1/2 on (E = 10). With equal weights P would have to be 0.8.
    """
    return 1 + (_KERB_WEIGHT - 1) * (state == int(KERB)).float()


def class_weights(target: Tensor, occupied: float) -> Tensor:
    """Return a weight per cell, (...): `occupied` for occupied cells, else 1, interpolated for soft targets.

    The paper uses 100. The result has the dtype of the target.
    """
    _check_positive("class weight", occupied)
    _check_states(target, "target")
    return 1 + (occupied - 1) * target[..., 1]


class _ReverseKL(torch.autograd.Function):
    """Computation of KL[Dir(1 + e) || Dir(1 + E t)] / E together with its gradient."""

    @staticmethod
    def forward(ctx: Any, evidence: Tensor, target: Tensor, strength: float) -> Tensor:
        if evidence.device.type == "cpu" and evidence.dtype == torch.float32:
            loss, gradient = _compiled_reverse_kl(evidence, target, strength)
        else:
            divergence = dirichlet_kl_gradient(evidence + 1, target * strength + 1)
            loss, gradient = (part / strength for part in divergence)
        ctx.save_for_backward(gradient)
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = ctx.saved_tensors
        outer = outer[..., None]
        return torch.where(outer == 0, 0, gradient * outer), None, None


def _compiled_reverse_kl(evidence: Tensor, target: Tensor, strength: float) -> tuple[Tensor, Tensor]:
    """Return loss and gradient, by a compiled kernel; the gradient has the states first in memory, like a network's."""
    shape = evidence.shape[:-1]
    batch, cells = math.prod(shape[:1]), math.prod(shape[1:])
    e, t = (tensor.detach().reshape(batch, cells, 2).mT.contiguous().numpy() for tensor in (evidence, target))
    loss, gradient = torch.empty(batch, cells), torch.empty(batch, 2, cells)
    arrays = e, t, strength, loss.numpy(), gradient.numpy()
    shared_threads(torch.get_num_threads()).divide(cells, lambda span: fill_reverse_kl(*arrays, *span))
    return loss.view(shape), gradient.mT.view(evidence.shape)


def _checked(evidence: Tensor, target: Tensor) -> list[Tensor]:
    """Check shapes and types; return both tensors in float32, or in float64 for float64 evidence."""
    if not evidence.is_floating_point():
        raise TypeError(f"evidence must be floating point, got {evidence.dtype}")
    _check_states(evidence, "evidence")
    if target.shape != evidence.shape:
        shapes = f"shape {tuple(evidence.shape)}, got {tuple(target.shape)}"
        raise ValueError(f"target must have the evidence's {shapes}: make it with `targets`")
    return _precise(evidence, target)


def _check_states(tensor: Tensor, name: str) -> None:
    if tensor.ndim == 0 or tensor.shape[-1] != 2:
        raise ValueError(f"{name} must have 2 states (free, occupied) last, got shape {tuple(tensor.shape)}")


def _check_positive(name: str, value: float) -> None:
    if not 0 < value < math.inf:
        raise ValueError(f"{name} must be finite and greater than 0, got {value}")


def _precise(*tensors: Tensor) -> list[Tensor]:
    """Return the tensors in float32, or in float64 if the first tensor is float64."""
    dtype = torch.promote_types(tensors[0].dtype, torch.float32)
    return [tensor.to(dtype) for tensor in tensors]
