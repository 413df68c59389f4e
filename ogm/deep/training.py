"""Training of a network on frames.

A run is a folder. ``best.safetensors`` and ``best.json`` are the averaged weights with the lowest validation loss,
``state.pt`` holds all that is needed to resume, ``log.csv`` the learning curve, and ``epoch-NNN.png`` shows fixed
validation frames.

>>> from pathlib import Path
>>> from ogm import GridSpec, open_dataset
>>> from ogm.deep.recipe import LITE_RECIPE
>>> from ogm.deep.training import train
>>> data = [open_dataset("data", split=name) for name in ("train", "val")]  # doctest: +SKIP
>>> train(*data, GridSpec.centered(), Path("runs/lite"), LITE_RECIPE)       # doctest: +SKIP
"""

import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from torch import nn
from torch.utils.data import DataLoader

from ogm.deep import losses
from ogm.deep.data import PLAIN, Batch, PillarDataset, training_ranges
from ogm.deep.network import NetworkConfig, PillarNetwork
from ogm.deep.order import EpochSampler, ShardSampler
from ogm.deep.recipe import LOSSES, Recipe, mean_loss
from ogm.evidence import evidence_to_mass
from ogm.grid import GridSpec
from ogm.scan import Frame
from ogm.state import predict_state
from ogm.storage.locks import locked

try:
    from lightning.fabric import Fabric

    from ogm.deep.training_run import TrainingBatch, TrainingRun, draw_predictions
except ImportError as error:
    raise ImportError(f'training lacks a package ({error}): pip install "ogm-toolkit[train,sim]"') from error

__all__ = ["ValidationScores", "check_recipe", "launch", "make_loader", "run_training", "train", "validate"]

_SAVE_EVERY = 120.0  # [s]
# In errors of torch.distributed
_PEER_ENDED = ("Connection closed by peer", "Connection reset by peer", "ncclRemoteError")


class Frames(Protocol):
    """Frames as batches of one: `PillarDataset`, or `ogm.deep.radar_data.RadarDataset`."""

    def __len__(self) -> int: ...

    def __getitem__(self, key: Any) -> "TrainingBatch": ...


class ValidationScores(NamedTuple):
    """Scores of a network on some frames; all cells of all frames have the same weight.

    Attributes
    ----------
    loss : float
        Mean of the recipe's loss.
    kl : float
        Mean of KL[prediction || truth] at the recipe's strength, divided by it, whatever the loss.
    free, occupied : float
        Intersection over union of the cells that `ogm.state.predict_state` gives this state.
    """

    loss: float
    kl: float
    free: float
    occupied: float

    def __str__(self) -> str:
        return f"validation {self.loss:.4f}, IoU free {self.free:.2f} occupied {self.occupied:.2f}"


def train(
    training: Sequence[Frame],
    validation: Sequence[Frame],
    spec: GridSpec,
    out: Path,
    recipe: Recipe,
    *,
    initial: PillarNetwork | None = None,
    resume: bool = False,
    accelerator: str = "auto",
    devices: int = 1,
    nodes: int = 1,
    precision: str | None = None,
    workers: int | None = None,
    picture_every: int = 1,
    facts: Mapping[str, Any] | None = None,
    progress: bool = True,
) -> Path:
    """Train a network and return the path of its best weights.

    Parameters
    ----------
    training, validation : sequence of Frame
        With scan, mount and truth, as ``open_dataset(path, split="training")`` gives them. The weights are chosen by
        `validation`.
    spec : GridSpec
        The network's grid, around the sensor.
    out : Path
        The run's folder.
    recipe : Recipe
    initial : PillarNetwork, optional
        Begin with its weights instead of random ones; the recipe's network may take further inputs.
    resume : bool
        Go on where a run with the same recipe, grid, data and number of processes stopped in `out`; the learning rate
        and the clipping may be others. Begin if there is none.
    accelerator, devices, nodes, precision
        As Lightning Fabric takes them. The default precision is bfloat16 where the accelerator or the processor has it,
        else float32.
    workers : int, optional
        Processes that prepare frames, beside each training process; by default half the cores, 12 at most.
    picture_every : int
        Epochs between pictures of validation frames; 0 draws none.
    facts : mapping, optional
        Provenance to keep beside the weights.
    progress : bool
        Show a progress bar.

    Raises
    ------
    ValueError
        If there are too few frames, the grid does not suit the network, `out` holds another run, or a number of the
        recipe is out of range.
    FloatingPointError
        If the loss is not finite; the batch is saved in the run's folder.
    MemoryError
        If the memory does not suffice.
    BlockingIOError
        If another process trains in `out`.
    OSError
        If another process of the training ended; the state after the last step is saved.
    """
    check_recipe(validation, recipe, out, resume)
    network = recipe.network
    if not isinstance(network, NetworkConfig):
        raise ValueError("this recipe is one of radar: give it to ogm.deep.radar_training.train_radar")
    fabric = launch(accelerator, devices, nodes, precision)
    options = network.z_range, recipe.seed, recipe.most_pillars, recipe.most_points, network.rays
    frames = PillarDataset(training, spec, recipe.augmentation, *options)
    fixed = PillarDataset(validation, spec, PLAIN, *options)
    run = TrainingRun(fabric, recipe, spec, out, len(frames), len(fixed), initial)
    known = {"seen": training_ranges(frames), **(facts or {})}
    draw = partial(draw_predictions, dataset=fixed, device=fabric.device)
    options_of_run: Any = {"resume": resume, "workers": workers, "progress": progress}
    return run_training(
        run, frames, fixed, Batch.joined, known, draw=draw, picture_every=picture_every, **options_of_run
    )


def run_training(
    run: TrainingRun,
    frames: Frames,
    fixed: Frames,
    joined: Callable[[Sequence[Any]], Any],
    facts: Mapping[str, Any],
    *,
    draw: Callable[[Path, Any], None] | None = None,
    picture_every: int = 0,
    resume: bool = False,
    workers: int | None = None,
    progress: bool = True,
) -> Path:
    """Do all steps of a training that are left, and return the path of its best weights.

    Parameters
    ----------
    run : TrainingRun
        Not begun yet; the state in its folder is taken over.
    frames, fixed : dataset of batches of one
        For training, and to choose the weights by. `frames` takes keys (epoch, i), as of `PillarDataset`.
    joined : callable
        Makes one batch of several.
    facts : mapping
        To keep beside the weights.
    draw : callable, optional
        Draws a picture into a file, of a network.
    picture_every, resume, workers, progress
        As of `train`.
    """
    recipe, fabric, out = run.recipe, run.fabric, run.out
    place, shards = (recipe.seed, fabric.global_rank, fabric.world_size), getattr(frames, "shards", None)
    order = EpochSampler(len(frames), *place)
    if shards is not None:
        order = ShardSampler(shards, *place, batch=recipe.batch)
    loader = make_loader(frames, order, recipe.batch, workers, joined)
    out.mkdir(parents=True, exist_ok=True)
    with locked(out) if fabric.is_global_zero else nullcontext():
        _refuse_other_run(out, resume)
        if (out / "state.pt").exists():
            run.restore()
        bar = _bar(progress and fabric.is_global_zero, run.steps, run.step)
        with bar as show, _memory_advice(recipe):
            try:
                pictures = draw if picture_every else None
                _train_epochs(run, loader, order, fixed, (pictures, picture_every), facts, show)
            except KeyboardInterrupt:
                if run.consistent:  # else the state that was saved before is the one to resume from
                    run.save()
                raise
            except RuntimeError as error:
                if not any(text in str(error) for text in _PEER_ENDED):
                    raise
                if run.consistent:
                    run.save()
                text = f"another process of the training in {out} ended: start all again with --resume"
                raise OSError(text) from error
    return out / "best.safetensors"


def _train_epochs(
    run: TrainingRun,
    loader: DataLoader[Any],
    order: EpochSampler,
    fixed: Frames,
    pictures: tuple[Callable[[Path, Any], None] | None, int],
    facts: Mapping[str, Any],
    show: Callable[..., None],
) -> None:
    """Do all steps that are left; score, record and save after every epoch."""
    recipe, fabric, out = run.recipe, run.fabric, run.out
    saved = time.monotonic()
    while run.epoch < recipe.epochs:
        began, first = time.monotonic(), run.step
        order.epoch, order.skip = run.epoch, (first - run.epoch * run.steps_per_epoch) * recipe.batch
        for batch in loader:
            run.do_step(batch)
            show(completed=run.step, loss=run.recent_loss, epoch=run.step / run.steps_per_epoch)
            if time.monotonic() - saved > _SAVE_EVERY:
                saved = run.save()
        if fabric.is_global_zero:
            speed = (run.step - first) / (time.monotonic() - began)  # [steps / s]
            scores = validate(run.average, fixed, recipe, fabric.device)
            run.record(scores._asdict(), speed, facts)
            show(scores=scores)
            draw, every = pictures
            if draw is not None and (run.epoch + 1) % every == 0:
                draw(out / f"epoch-{run.epoch + 1:03d}.png", run.average)
        run.epoch += 1
        saved = run.save()
        fabric.barrier()


@torch.no_grad()
def validate(network: nn.Module, dataset: Frames, recipe: Recipe, device: torch.device) -> ValidationScores:
    """Score a network on frames, by the loss as it is after all annealing, so that epochs can be compared."""
    network.eval()
    loss = kl = cells = 0.0
    counts = np.zeros((3, 3))  # true state, predicted state
    for i in range(len(dataset)):
        batch = dataset[i]
        evidence, state = network(batch.inputs(device)), batch.state.to(device)
        target, valid = losses.targets(state)
        count = int(valid.sum())
        loss += count * float(mean_loss(evidence, state, recipe, math.inf))
        kl += count * float(losses.masked_mean(losses.reverse_kl(evidence, target, recipe.strength), valid))
        cells += count
        predicted = predict_state(evidence_to_mass(evidence.cpu().numpy()))
        pairs = (3 * batch.state.numpy() + predicted)[valid.cpu().numpy()]
        counts += np.bincount(pairs, minlength=9).reshape(3, 3)
    iou = np.diag(counts) / np.maximum(counts.sum(0) + counts.sum(1) - np.diag(counts), 1)
    return ValidationScores(loss / max(cells, 1), kl / max(cells, 1), float(iou[1]), float(iou[2]))


def launch(accelerator: str, devices: int, nodes: int, precision: Any) -> Fabric:
    """Start the processes of a training; the default precision is as of `train`."""
    if accelerator == "auto":  # Lightning would take others, for which torch lacks segment_reduce
        accelerator = "cuda" if torch.cuda.is_available() else "cpu"
    if precision is None:
        cuda = accelerator in ("cuda", "gpu") and torch.cuda.is_available() and torch.cuda.is_bf16_supported()
        bfloat16 = cuda or (accelerator == "cpu" and _has_bfloat16())
        precision = "bf16-mixed" if bfloat16 else "32-true"
    try:
        fabric = Fabric(accelerator=accelerator, devices=devices, num_nodes=nodes, precision=precision)
    except (RuntimeError, ValueError) as error:  # Lightning's, if there is no such accelerator
        raise ValueError(f"cannot train on {devices} x {accelerator} here: {error}") from error
    fabric.launch()
    return fabric


def _has_bfloat16() -> bool:
    """Return whether the processor multiplies bfloat16 (AVX-512 BF16, or AMX): two to four times as fast to train."""
    asked = getattr(torch.cpu, "_is_avx512_bf16_supported", None)
    return bool(asked and asked())


def make_loader(
    frames: Frames, order: EpochSampler, batch: int, workers: int | None, joined: Callable[[Sequence[Any]], Any]
) -> DataLoader[Any]:
    """Return what loads batches in an order, by so many processes beside this one; None takes half the cores."""
    if workers is None:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
        workers = min(12, max(1, cores // 2))
    ahead: Any = 4 if workers else None
    options: dict[str, Any] = {"num_workers": workers, "prefetch_factor": ahead, "collate_fn": joined}
    if workers and isinstance(order, ShardSampler):  # connections do not survive a fork
        options |= {"multiprocessing_context": "spawn", "persistent_workers": True, "worker_init_fn": _end_at_once}
    options["drop_last"] = True
    given: Any = frames
    return DataLoader(given, batch, sampler=order, **options)


def _end_at_once(worker: int) -> None:
    """Let this loading process end when its queues are flushed: one in eight is aborted when C++ objects are freed."""
    Finalize(None, os._exit, args=(0,), exitpriority=-100)


@contextmanager
def _memory_advice(recipe: Recipe) -> Iterator[None]:
    """Turn torch's errors about too little memory into one with the way out."""
    try:
        yield
    except RuntimeError as error:  # torch.OutOfMemoryError among them
        killed = "alloc" in str(error) or "DataLoader worker" in str(error)  # by the operating system
        if not (isinstance(error, torch.OutOfMemoryError) or killed):
            raise
        text = f"out of memory with batches of {recipe.batch}: use a smaller --batch, or fewer --workers"
        raise MemoryError(text) from error


@contextmanager
def _bar(visible: bool, total: int, done: int) -> Iterator[Callable[..., None]]:
    """Show a progress bar; the function that is returned updates its fields."""
    columns = (
        TextColumn("epoch {task.fields[epoch]:.1f}"),
        BarColumn(),
        TextColumn("loss {task.fields[loss]:.4f}  {task.fields[scores]}"),
        TimeRemainingColumn(elapsed_when_finished=True, compact=True),
    )
    with Progress(*columns, disable=not visible) as bar:
        task = bar.add_task("training", total=total, completed=done, loss=math.nan, epoch=0.0, scores="")
        yield partial(bar.update, task)


def check_recipe(validation: Sequence[Any], recipe: Recipe, out: Path, resume: bool) -> None:
    """Raise a ValueError if a number of a recipe is out of range, frames are missing, or `out` holds a run."""
    if recipe.loss not in LOSSES:
        raise ValueError(f"loss must be one of {', '.join(LOSSES)}, got {recipe.loss!r}")
    if recipe.epochs < 1 or recipe.batch < 1:
        raise ValueError(f"epochs and batch must be at least 1, got {recipe.epochs} and {recipe.batch}")
    if not (recipe.learning_rate > 0 and recipe.strength > 0):
        raise ValueError("learning_rate and strength must be greater than 0")
    if len(validation) == 0:
        raise ValueError("there are no validation frames to choose the weights by")
    _refuse_other_run(out, resume)


def _refuse_other_run(out: Path, resume: bool) -> None:
    if not resume and (out / "state.pt").exists():
        raise ValueError(f"{out} holds a run already; go on with --resume, or give another --out")
