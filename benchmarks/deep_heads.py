"""What do a head at full resolution, and several heads, add to the shipped network? Its other layers stay as they are.

    python benchmarks/deep_heads.py DATA [--frames N] [--steps N] [--members N] [--real FOLDER]

DATA is a data set of `ogm simulate --recipe gen2` whose towns are not those of the shipped weights. On its training
split are trained, by the recipe of the shipped weights and on the same frames in the same order:

* head: the last layer alone, from the shipped one on;
* detail: the same with two more convolutions at full resolution, which see the pillars;
* several: last layers from random weights, each on drives drawn anew with replacement; their masses are averaged.

Evaluated are the validation split, frame by frame with 95 % intervals over drives, and the recordings of `quality`,
labelled cells only. Of each set too, how well a number tells the cells whose state is wrong (the larger mass against
the truth, known cells alone): the mass of unknown, of the shipped network and of several; the share of the smaller
mass; the spread of several (standard deviation of P(occupied)). Writes benchmarks/results/deep_heads.json.
"""

import _run as run  # first: it sets the number of threads
from _evaluation_record import compared
from _recordings import recordings

# isort: split
import copy
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track
from torch import nn
from torch.nn.functional import pixel_shuffle, relu, softplus

from ogm import GridSpec
from ogm.datasets import Dataset, open_dataset
from ogm.deep import DeepISM
from ogm.deep.checkpoint import load_network
from ogm.deep.data import PillarDataset
from ogm.deep.network import PillarNetwork
from ogm.deep.recipe import LITE_RECIPE, mean_loss
from ogm.deep.torch_engine import TorchEngine
from ogm.evaluation import evaluate
from ogm.metrics.areas import auroc
from ogm.state import CellState

SPEC = GridSpec.centered()
METRICS = ("nll", "brier", "false_free", "iou_free", "iou_occupied", "ece_relative", "auroc_unknown", "aurc")
BATCH, RATE, DETAIL = 4, 1e-3, 16
LEVELS = 4096  # of histograms, from which areas under curves are counted


class HeadInput(NamedTuple):
    """Output of the layers before the head for a frame, in half precision, without the zeros of the feature map."""

    where: torch.Tensor
    values: torch.Tensor
    shape: torch.Size
    part: torch.Tensor
    state: torch.Tensor
    drive: int


class Head(nn.Module):
    """A last layer; and, with channels, what they add at full resolution: nothing before training.

    Parameters
    ----------
    last : Conv2d
        Copied.
    width : int
        Channels of the feature map.
    channels : int
        At full resolution; 0 adds nothing.
    """

    def __init__(self, last: nn.Conv2d, width: int, channels: int = 0) -> None:
        super().__init__()
        self.last, self.channels = copy.deepcopy(last), channels
        if channels:
            self.near = nn.Conv2d(width, channels, 3, padding=1)
            self.context = nn.Conv2d(last.in_channels, 4 * channels, 1, bias=False)
            self.out = nn.Conv2d(channels, 2, 3, padding=1, bias=False)
            nn.init.zeros_(self.out.weight)

    def forward(self, feature_map: torch.Tensor, part: torch.Tensor) -> torch.Tensor:
        """Return evidence (batch, nx, ny, 2) from the feature map and what the neck gives."""
        x = pixel_shuffle(self.last(part), 2)
        if self.channels:
            x = x + self.out(relu(self.near(feature_map) + pixel_shuffle(self.context(part), 2)))
        return softplus(x).permute(0, 2, 3, 1)


class Heads(TorchEngine):
    """A network with other heads, as one sensor model: the mean of their masses."""

    def __init__(self, network: PillarNetwork, heads: Sequence[Head], description: Mapping[str, Any]) -> None:
        super().__init__(network, description=description)
        self.heads = heads
        self.last: list[NDArray[np.float32]] = []

    @torch.inference_mode()
    def masses(self, scans: Any, rays: Any = None) -> NDArray[np.float32]:
        """Return the mean masses; those of each head stay in `last`."""
        (scan,) = scans
        if rays is not None:
            scan = scan._replace(rays=torch.from_numpy(np.stack(rays)))
        feature_map = self.network.feature_map(scan)
        (part,) = self.network.joined(feature_map)
        self.last.clear()  # the engine on other grids shares the list
        for head in self.heads:
            evidence = head(feature_map, part)
            self.last.append((evidence / (evidence.sum(-1, keepdim=True) + 2)).numpy())
        return np.mean(self.last, axis=0, dtype=np.float32)


@torch.no_grad()
def stored(network: PillarNetwork, dataset: Dataset, numbers: Sequence[int]) -> list[HeadInput]:
    """Run all layers but the head on frames, augmented as in a training."""
    drives = {name: k for k, name in enumerate(sorted({dataset.refs[i].sequence for i in numbers}))}
    frames = PillarDataset(dataset, SPEC, LITE_RECIPE.augmentation, network.config.z_range, 1, rays=True)
    found = []
    for i in track(numbers, "running the layers before the head"):
        batch = frames[0, i]
        feature_map = network.feature_map(batch.pillars).permute(0, 2, 3, 1)
        (part,) = network.joined(feature_map.permute(0, 3, 1, 2))
        where = feature_map.flatten().nonzero()[:, 0]
        values = feature_map.flatten()[where].half()
        drive = drives[dataset.refs[i].sequence]
        found.append(HeadInput(where.int(), values, feature_map.shape, part.half(), batch.state, drive))
    return found


def feature_map_of(one: HeadInput) -> torch.Tensor:
    flat = torch.zeros(one.shape.numel())
    flat[one.where.long()] = one.values.float()
    return flat.view(one.shape)


def train_head(head: Head, frames: Sequence[HeadInput], steps: int, seed: int, name: str) -> Head:
    """Train a head on what the other layers made of frames; in place."""
    parameters = list(head.parameters())
    optimizer = torch.optim.AdamW(parameters, RATE, weight_decay=LITE_RECIPE.weight_decay)
    order, losses = np.random.default_rng(seed), []
    bar = track(range(steps), f"training {name}")
    for step in bar:
        optimizer.param_groups[0]["lr"] = RATE * (0.5 + 0.5 * math.cos(math.pi * step / steps))
        batch = [frames[k] for k in order.integers(0, len(frames), BATCH)]
        part = torch.cat([one.part for one in batch]).float().contiguous(memory_format=torch.channels_last)
        features = part.new_zeros(0)
        if head.channels:
            features = torch.cat([feature_map_of(one) for one in batch]).permute(0, 3, 1, 2)
        evidence = head(features, part)
        loss = mean_loss(evidence, torch.cat([one.state for one in batch]), LITE_RECIPE, math.inf)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(parameters, LITE_RECIPE.clip)
        optimizer.step()
        losses.append(float(loss.detach()))
    print(f"{name}: loss {np.mean(losses[:50]):.4f} -> {np.mean(losses[-50:]):.4f}", file=sys.stderr)
    return head


def resampled(frames: Sequence[HeadInput], seed: int) -> list[HeadInput]:
    """Draw drives with replacement."""
    drives = sorted({one.drive for one in frames})
    chosen = np.random.default_rng((1, seed)).choice(drives, len(drives))
    return [one for drive in chosen for one in frames if one.drive == drive]


def scores_of(models: Mapping[str, DeepISM], dataset: Dataset, numbers: Sequence[int]) -> dict[str, Any]:
    """Evaluate the ways, each against the shipped network, and how well numbers tell the wrong cells."""
    result = evaluate(dict(models), dataset, SPEC, frames=list(numbers))
    return {**compared(result, "shipped", METRICS), "wrong cells": wrong_cells(models, dataset, numbers)}


def wrong_cells(models: Mapping[str, DeepISM], dataset: Dataset, numbers: Sequence[int]) -> dict[str, Any]:
    """Return the areas under ROC curves for telling known cells whose state is wrong, and the mean unknown of both."""
    names = ("unknown", "smaller mass", "unknown of several", "spread of several")
    counts = {name: np.zeros((2, LEVELS)) for name in names}
    sums = {name: np.zeros((2, 2)) for name in ("shipped", "several")}  # (right, wrong): cells, unknown
    for i in numbers:
        frame = dataset[i]
        grids = {name: models[name](frame.scan) for name in sums}
        each = models["several"].engine.last
        state = frame.truth.crop(SPEC).state
        known = (state == CellState.FREE) | (state == CellState.OCCUPIED)
        occupied = state[known] == CellState.OCCUPIED
        mass = {name: grid.mass[known] for name, grid in grids.items()}
        probability = [one[0][known][:, 1] + (1 - one[0][known].sum(-1)) / 2 for one in each]
        numbers_of = {
            "unknown": 1 - mass["shipped"].sum(-1),
            "smaller mass": 2 * mass["shipped"].min(-1) / np.maximum(mass["shipped"].sum(-1), 1e-6),
            "unknown of several": 1 - mass["several"].sum(-1),
            "spread of several": 2 * np.std(probability, axis=0),
        }
        for name, values in numbers_of.items():
            one = mass["several" if "several" in name else "shipped"]
            wrong = (one[:, 1] > one[:, 0]) != occupied
            level = np.clip(values * LEVELS, 0, LEVELS - 1).astype(int)
            for k in (0, 1):
                counts[name][k] += np.bincount(level[wrong == k], minlength=LEVELS)
        for name, one in mass.items():
            wrong = (one[:, 1] > one[:, 0]) != occupied
            for k in (0, 1):
                sums[name][k] += (wrong == k).sum(), (1 - one[wrong == k].sum(-1)).sum()
    areas = {name: auroc(table[1], table[0]) for name, table in counts.items()}
    unknown = {
        name: {
            "share wrong": float(t[1, 0] / t[:, 0].sum()),
            **{k: float(u / n) for k, (n, u) in zip(("right", "wrong"), t, strict=True)},
        }
        for name, t in sums.items()
    }
    return {"auroc": areas, "mean unknown": unknown}


def main() -> None:
    parser = run.Parser(__doc__, real=True)
    parser.add_argument("data", type=Path)
    parser.add_argument("--frames", type=int, default=600, help="of the training split, evenly spread")
    parser.add_argument("--steps", type=int, default=1000, help=f"of {BATCH} frames")
    parser.add_argument("--members", type=int, default=5, help="last layers of the way several")
    parser.add_argument("--validation", type=int, help="evaluate the first N validation frames only")
    given = parser.parse_args()
    record: dict[str, Any] = {
        "environment": run.environment("ray", **{"lite, float32": run.ROOT / "ogm" / "data" / "lite.safetensors"}),
        "frames": given.frames,
        "steps": given.steps,
    }
    record |= {"members": given.members, "sets": {}}

    network, description = load_network(run.ROOT / "ogm" / "data" / "lite.safetensors")
    training, validation = (open_dataset(given.data, split=name) for name in ("training", "validation"))
    chosen = np.linspace(0, len(training) - 1, min(given.frames, len(training))).astype(int).tolist()
    frames = stored(network, training, chosen)
    width = network.config.pillar + 2 * network.config.rays
    several = []
    for seed in range(given.members):
        torch.manual_seed(seed)
        one = Head(network.head, width)
        one.last.reset_parameters()
        several.append(train_head(one, resampled(frames, seed), given.steps, seed, f"last layer {seed}"))
    heads = {
        "shipped": [Head(network.head, width)],
        "head": [train_head(Head(network.head, width), frames, given.steps, 0, "head")],
        "detail": [train_head(Head(network.head, width, DETAIL), frames, given.steps, 0, "detail")],
        "several": several,
    }
    models = {name: DeepISM(Heads(network, some, description), SPEC) for name, some in heads.items()}
    sets = {"validation": validation[: given.validation], **dict(recordings(given.real))}
    for name, frames in sets.items():
        record["sets"][name] = scores_of(models, frames, range(len(frames)))
        run.write_record(given.out, record)


if __name__ == "__main__":
    main()
