"""`run_training`: steps and epochs of a training, with validation, learning curve and saved states."""

import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from functools import partial
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from torch import nn
from torch.utils.data import DataLoader, Sampler

from ogm.deep import losses
from ogm.deep.data import Batch, PillarDataset
from ogm.deep.order import EpochSampler, ShardSampler
from ogm.deep.recipe import Recipe, mean_loss
from ogm.deep.training_run import TrainingRun
from ogm.state import CellState
from ogm.storage.locks import locked

_SAVE_EVERY = 120.0  # [s] between saved states
# Texts in errors of torch.distributed
_PEER_ENDED = ("Connection closed by peer", "Connection reset by peer", "ncclRemoteError")


class ValidationScores(NamedTuple):
    """Validation scores of a network, with equal weight for all cells of all frames.

    Attributes
    ----------
    loss : float
        Mean of the recipe's loss.
    kl : float
        Mean of `ogm.deep.losses.reverse_kl` at the recipe's strength, for any loss of the recipe.
    free, occupied : float
        Intersection over union of the cells predicted as free or occupied by `ogm.state.predict_state`.
    """

    loss: float
    kl: float
    free: float
    occupied: float

    def __str__(self) -> str:
        return f"validation {self.loss:.4f}, IoU free {self.free:.2f} occupied {self.occupied:.2f}"


def run_training(
    run: TrainingRun,
    frames: PillarDataset,
    fixed: PillarDataset,
    facts: Mapping[str, Any],
    *,
    draw: Callable[[Path, Any], None] | None = None,
    picture_every: int = 0,
    resume: bool = False,
    workers: int | None = None,
    progress: bool = True,
) -> Path:
    """Do all remaining steps of a training and return the path of its best weights.

    Parameters
    ----------
    run : TrainingRun
        New run; a saved state in its folder is restored.
    frames, fixed : PillarDataset
        Training frames with keys (epoch, i), see `PillarDataset`, and validation frames.
    facts : mapping
        Provenance, written to ``best.json``.
    draw : callable, optional
        Draws the predictions of a network to a file.
    picture_every, resume, workers, progress
        See `ogm.deep.training.train`.
    """
    recipe, fabric, out = run.recipe, run.fabric, run.out
    place, shards = (recipe.seed, fabric.global_rank, fabric.world_size), frames.shards
    order = EpochSampler(len(frames), *place)
    if shards is not None:
        order = ShardSampler(shards, *place, batch=recipe.batch)
    device = fabric.device
    loader = make_loader(frames, order, recipe.batch, workers, device)
    checked = make_loader(fixed, range(len(fixed)), recipe.batch, workers, device)
    out.mkdir(parents=True, exist_ok=True)
    with locked(out) if fabric.is_global_zero else nullcontext():
        refuse_other_run(out, resume)
        if (out / "state.pt").exists():
            run.restore()
        bar = _bar(progress and fabric.is_global_zero, run.steps, run.step)
        with bar as show, _memory_advice(recipe):
            try:
                pictures = draw if picture_every else None
                _train_epochs(run, loader, order, checked, (pictures, picture_every), facts, show)
            except KeyboardInterrupt:
                if run.consistent:  # otherwise the last saved state is kept
                    run.save()
                raise
            except RuntimeError as error:
                if not any(text in str(error) for text in _PEER_ENDED):
                    raise
                if run.consistent:
                    run.save()
                text = f"another process of the training in {out} ended: start all processes again with `resume`"
                raise OSError(text) from error
    return out / "best.safetensors"


def _train_epochs(
    run: TrainingRun,
    loader: DataLoader[Any],
    order: EpochSampler,
    checked: DataLoader[Any],
    pictures: tuple[Callable[[Path, Any], None] | None, int],
    facts: Mapping[str, Any],
    show: Callable[..., None],
) -> None:
    """Do all remaining steps; score, record and save after every epoch."""
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
            scores = validate(run.average, checked, recipe, fabric.device)
            run.record(scores._asdict(), speed, facts)
            show(scores=scores)
            draw, every = pictures
            if draw is not None and (run.epoch + 1) % every == 0:
                draw(out / f"epoch-{run.epoch + 1:03d}.png", run.average)
        run.epoch += 1
        saved = run.save()
        fabric.barrier()


@torch.no_grad()
def validate(network: nn.Module, batches: Iterable[Batch], recipe: Recipe, device: torch.device) -> ValidationScores:
    """Score a network on frames, with the loss after all annealing, so that epochs are comparable."""
    network.eval()
    sums = torch.zeros(3, dtype=torch.float64, device=device)  # of the loss, of the KL, and cells
    counts = torch.zeros(9, dtype=torch.int64, device=device)  # true state, predicted state
    for batch in batches:
        inputs, state = batch.on(device)
        evidence = network(inputs)
        target, valid = losses.targets(state)
        count = valid.sum()
        loss = mean_loss(evidence, state, recipe, math.inf)
        kl = losses.masked_mean(losses.reverse_kl(evidence, target, recipe.strength), valid)
        sums += count * torch.stack([loss, kl, torch.ones_like(kl)])
        known = torch.where(state == int(losses.KERB), int(CellState.UNKNOWN), state.long())
        counts += torch.bincount((3 * known + _predicted(evidence))[valid], minlength=9)
    (loss, kl, cells), table = sums.tolist(), counts.view(3, 3).cpu().numpy()
    iou = np.diag(table) / np.maximum(table.sum(0) + table.sum(1) - np.diag(table), 1)
    return ValidationScores(loss / max(cells, 1), kl / max(cells, 1), float(iou[1]), float(iou[2]))


def _predicted(evidence: torch.Tensor) -> torch.Tensor:
    """Return the predicted state of evidence (..., 2), as `predict_state` of its masses; unknown has the evidence 2."""
    free, occupied = evidence.double().unbind(-1)
    is_free, is_occupied = (free > 2) & (free > occupied), (occupied > 2) & (occupied >= free)
    return is_free * int(CellState.FREE) + is_occupied * int(CellState.OCCUPIED)


def make_loader(
    frames: PillarDataset, order: Sampler[Any] | range, batch: int, workers: int | None, device: torch.device
) -> DataLoader[Any]:
    """Return a loader of batches for a device.

    Parameters
    ----------
    frames : PillarDataset
    order : Sampler or range
        Keys of the frames; an incomplete last batch of a `Sampler` is left out.
    batch : int
        Frames of a batch.
    workers : int, optional
        Number of loading processes, by default half the cores.
    device : torch.device
        Batches for CUDA are copied while the device computes.
    """
    if workers is None:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
        workers = min(12, max(1, cores // 2))
    ahead: Any = 4 if workers else None
    options: dict[str, Any] = {"num_workers": workers, "prefetch_factor": ahead, "collate_fn": Batch.joined}
    trains = isinstance(order, Sampler)
    options |= {"pin_memory": device.type == "cuda", "persistent_workers": trains and workers > 0, "drop_last": trains}
    if workers and frames.shards is not None:  # connections do not survive a fork
        options |= {"multiprocessing_context": "spawn", "worker_init_fn": _end_at_once}
    given: Any = frames
    return DataLoader(given, batch, sampler=order, **options)


def _end_at_once(worker: int) -> None:
    """Make a loading process end after flushing its queues; freeing its C++ objects aborts one in eight."""
    Finalize(None, os._exit, args=(0,), exitpriority=-100)


@contextmanager
def _memory_advice(recipe: Recipe) -> Iterator[None]:
    """Replace torch's errors about missing memory by a MemoryError with the way out."""
    try:
        yield
    except RuntimeError as error:  # includes torch.OutOfMemoryError
        killed = "alloc" in str(error) or "DataLoader worker" in str(error)  # by the operating system
        if not (isinstance(error, torch.OutOfMemoryError) or killed):
            raise
        text = f"out of memory with batches of {recipe.batch}: use a smaller `batch`, or fewer `workers`"
        raise MemoryError(text) from error


@contextmanager
def _bar(visible: bool, total: int, done: int) -> Iterator[Callable[..., None]]:
    """Show a progress bar; yield the function that updates its fields."""
    columns = (
        TextColumn("epoch {task.fields[epoch]:.1f}"),
        BarColumn(),
        TextColumn("loss {task.fields[loss]:.4f}  {task.fields[scores]}"),
        TimeRemainingColumn(elapsed_when_finished=True, compact=True),
    )
    with Progress(*columns, disable=not visible) as bar:
        task = bar.add_task("training", total=total, completed=done, loss=math.nan, epoch=0.0, scores="")
        yield partial(bar.update, task)


def refuse_other_run(out: Path, resume: bool) -> None:
    """Raise ValueError if a folder holds a run and `resume` is not set."""
    if not resume and (out / "state.pt").exists():
        raise ValueError(f"{out} already holds a run: continue it with `resume`, or give another `out`")
