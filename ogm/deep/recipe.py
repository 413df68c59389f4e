"""Recipes, the settings of a training, and presets of ogm and of the paper.

>>> from dataclasses import replace
>>> from ogm.deep.recipe import LITE_RECIPE
>>> replace(LITE_RECIPE, epochs=3, batch=2).epochs
3
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from torch import Tensor

from ogm.deep import losses
from ogm.deep.data import ROTATION, Augmentation
from ogm.deep.network import LITE, PAPER, NetworkConfig

__all__ = ["LITE_RECIPE", "LOSSES", "PAPER_RECIPE", "PRESETS", "Recipe", "learning_rate", "mean_loss"]

LOSSES: dict[str, Callable[[Tensor, Tensor, float], Tensor]] = {  # evidence, target, strength -> loss per cell
    "reverse-kl": losses.reverse_kl,
    "squares-printed": lambda e, y, _: losses.sum_of_squares(e, y, "paper"),
    "squares-released": lambda e, y, _: losses.sum_of_squares(e, y, "released"),
    "log": lambda e, y, _: losses.log_loss(e, y),
    "digamma": lambda e, y, _: losses.digamma_loss(e, y),
}


@dataclass(frozen=True)
class Recipe:
    """Settings of a training, stored with the weights.

    Parameters
    ----------
    network : NetworkConfig
        Network to train.
    epochs : int
        Number of passes over all frames.
    batch : int
        Frames per step and process.
    loss : str
        Name in `LOSSES`.
    strength : float
        Evidence of a known cell, E of `ogm.deep.losses.reverse_kl`.
    uniform_kl : float
        Final weight of `ogm.deep.losses.uniform_kl`, reached after 10 epochs.
    occupied_weight : float
        Weight of occupied cells in the loss; 100 in the paper.
    learning_rate, weight_decay : float
        Learning rate and weight decay of AdamW.
    warmup : int
        Steps in which the learning rate grows from 0.
    final_rate : float
        Share of the learning rate at the end of the cosine schedule; 1 keeps it constant.
    clip : float
        Largest norm of the gradient.
    average : float
        Decay per step of the exponential moving average of the weights; 0 uses the current weights.
    kerbs : {"unknown", "ignore", "occupied", "free"}
        State of kerbs in the truth, see `ogm.state.Truth.with_kerbs`; unknown ones have the weight of
        `ogm.deep.losses.kerb_weights`.
    augmentation : Augmentation
        Random changes of the training frames.
    most_pillars, most_points : int
        Limits of `ogm.deep.data.PillarDataset`; 0 for no limit.
    seed : int
        Seed of weights, order, augmentation and dropout.
    """

    network: NetworkConfig
    epochs: int = 10
    batch: int = 8
    loss: str = "reverse-kl"
    strength: float = 10.0
    uniform_kl: float = 0.0
    occupied_weight: float = 1.0
    learning_rate: float = 2e-3
    weight_decay: float = 1e-2
    warmup: int = 100
    final_rate: float = 0.01
    clip: float = 1.0
    average: float = 0.998
    kerbs: str = "occupied"
    augmentation: Augmentation = Augmentation()
    most_pillars: int = 0
    most_points: int = 0
    seed: int = 0


LITE_RECIPE = Recipe(  # of the shipped weights, which started from earlier weights with half the learning rate
    replace(LITE, rays=True), epochs=11, batch=4, kerbs="unknown", augmentation=Augmentation(sector=0.25)
)
PAPER_RECIPE = Recipe(  # van Kempen et al. 2021, Sec. V; learning rate and dropout of the published code
    replace(PAPER, evidence="relu"),
    epochs=100,
    batch=5,
    loss="squares-printed",
    uniform_kl=1.0,
    occupied_weight=100.0,
    learning_rate=1e-4,
    weight_decay=0.0,
    warmup=0,
    final_rate=1.0,
    clip=math.inf,
    average=0.0,
    augmentation=ROTATION,
    most_pillars=10_000,
    most_points=100,
)
_PAPER = replace(PAPER, rays=True, dropout=0.0)  # random numbers of dropout take a quarter of a step on a processor
PRESETS = {"lite": LITE_RECIPE, "paper": Recipe(_PAPER, kerbs="unknown"), "published": PAPER_RECIPE}


def mean_loss(evidence: Tensor, state: Tensor, recipe: Recipe, epoch: float) -> Tensor:
    """Return the loss of a recipe, averaged over all cells that are not ignored."""
    target, valid = losses.targets(state)
    loss = LOSSES[recipe.loss](evidence, target, recipe.strength)
    if recipe.uniform_kl:
        loss = loss + recipe.uniform_kl * min(1.0, epoch / 10) * losses.uniform_kl(evidence, target)
    weight = losses.kerb_weights(state)
    if recipe.occupied_weight != 1:
        weight = weight * losses.class_weights(target, recipe.occupied_weight)
    return losses.masked_mean(loss, valid, weight)


def learning_rate(recipe: Recipe, step: int, total: int) -> float:
    """Return the learning rate of a step: linear warm-up, then cosine decay to the final share."""
    up = min(1.0, (step + 1) / recipe.warmup) if recipe.warmup else 1.0
    cosine = 0.5 * (1 + math.cos(math.pi * step / total))
    return recipe.learning_rate * up * (recipe.final_rate + (1 - recipe.final_rate) * cosine)
