"""Training: one loop, to be read from top to bottom.

A run is a folder. ``best.safetensors`` and ``best.json`` are the averaged weights with the lowest validation loss,
``state.pt`` all that is needed to go on after a kill, ``log.csv`` the learning curve, ``epoch-NNN.png`` fixed
validation samples.
"""

import csv
import importlib.metadata
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from torch.utils.data import DataLoader

from ogm.deep import losses
from ogm.deep.checkpoint import save_network
from ogm.deep.data import PLAIN, Batch, PillarDataset, Samples, Shuffled, join, training_ranges
from ogm.deep.network import Network
from ogm.deep.recipe import LOSSES, Recipe, learning_rate, mean_loss
from ogm.evidence import evidence_to_mass
from ogm.files import atomic_write
from ogm.grid import GridSpec

try:
    from lightning.fabric import Fabric
except ImportError as error:
    raise ImportError(f'training lacks a package ({error}): pip install "ogm-toolkit[deep,sim]"') from error

__all__ = [
    "Scores",
    "train",
    "usual_precision",
    "usual_workers",
    "validate",
]


def usual_workers() -> int:
    """Return how many processes should prepare samples here: half the cores, 12 at most."""
    return min(12, max(1, len(os.sched_getaffinity(0)) // 2 if hasattr(os, "sched_getaffinity") else 1))


def usual_precision(accelerator: str = "auto") -> str:
    """Return how to compute: bfloat16 where the accelerator has it, else float32."""
    cuda = (
        accelerator in ("auto", "cuda", "gpu")
        and torch.cuda.is_available()
        and torch.cuda.is_bf16_supported()
    )
    return "bf16-mixed" if cuda else "32-true"


class Scores(NamedTuple):
    """How a network does on some samples; all cells of all samples count alike.

    Attributes
    ----------
    loss : float
        Mean of the recipe's loss.
    kl : float
        Mean of KL[prediction || truth] at the recipe's strength, divided by it, whatever the loss.
    free, occupied : float
        Intersection over union of cells called free, or occupied: the larger evidence, where the two together are
        above 1/2 of the recipe's strength.
    """

    loss: float
    kl: float
    free: float
    occupied: float


def train(
    training: Samples,
    validation: Samples,
    spec: GridSpec,
    out: Path,
    recipe: Recipe,
    *,
    resume: bool = False,
    accelerator: str = "auto",
    devices: int = 1,
    nodes: int = 1,
    precision: Any = "32-true",
    workers: int = 1,
    save_every: float = 120.0,
    picture_every: int = 1,
    facts: Mapping[str, Any] | None = None,
    progress: bool = True,
) -> Path:
    """Train a network and return the path of its best weights.

    Parameters
    ----------
    training, validation : Samples
        Splits of a data set. The weights are chosen by `validation`.
    spec : GridSpec
        The network's grid, around the sensor.
    out : Path
        The run's folder.
    recipe : Recipe
    resume : bool
        Go on where a run with the same recipe, grid, data and number of processes stopped in `out`; the learning rate
        and the clipping may be others. Begin if there is none.
    accelerator, devices, nodes, precision
        As Lightning Fabric takes them.
    workers : int
        Processes that prepare samples, beside each training process.
    save_every : float
        Time between saved states [s].
    picture_every : int
        Epochs between pictures of validation samples; 0 draws none.
    facts : mapping, optional
        Provenance to keep beside the weights.
    progress : bool
        Show a progress bar.

    Raises
    ------
    ValueError
        If a split is empty, the grid does not suit the network, `out` holds another run, or a recipe's number makes
        no sense.
    FloatingPointError
        If the loss is not finite; the batch is saved in the run's folder.
    MemoryError
        If the memory does not suffice.
    """
    _check(training, validation, recipe, out, resume)
    if accelerator == "auto":  # Lightning would take others, for which torch lacks segment_reduce
        accelerator = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        fabric = Fabric(accelerator=accelerator, devices=devices, num_nodes=nodes, precision=precision)
    except (RuntimeError, ValueError) as error:  # Lightning's, if there is no such accelerator
        raise ValueError(f"cannot train on {devices} x {accelerator} here: {error}") from error
    fabric.launch()
    torch.manual_seed(recipe.seed)
    network = Network(recipe.network, spec).to(memory_format=torch.channels_last)
    average = Network(recipe.network, spec).to(memory_format=torch.channels_last)
    average.load_state_dict(network.state_dict())
    optimizer = torch.optim.AdamW(
        network.parameters(), recipe.learning_rate, weight_decay=recipe.weight_decay
    )
    model, optimizer = fabric.setup(network, optimizer)
    average = average.to(fabric.device).eval()

    options = {"z_range": recipe.network.z_range, "seed": recipe.seed}
    limits = {"most_pillars": recipe.most_pillars, "most_points": recipe.most_points}
    scenes = PillarDataset(training, spec, recipe.augmentation, **options, **limits)  # type: ignore[arg-type]
    checks = PillarDataset(validation, spec, PLAIN, **options, **limits)  # type: ignore[arg-type]
    order = Shuffled(len(scenes), recipe.seed, fabric.global_rank, fabric.world_size)
    loader: DataLoader[Batch] = DataLoader(
        scenes,
        recipe.batch,
        sampler=order,
        num_workers=workers,
        collate_fn=join,
        drop_last=True,
        prefetch_factor=4 if workers else None,
    )
    per_epoch = len(training) // fabric.world_size // recipe.batch
    total = per_epoch * recipe.epochs
    if per_epoch == 0:
        raise ValueError(
            f"{len(training)} training samples are fewer than {fabric.world_size} batches of {recipe.batch}, "
            "one per process"
        )
    setup = {
        "recipe": repr(replace(recipe, learning_rate=0.0, clip=0.0)),  # these two may change on the way
        "spec": repr(spec),
        "samples": f"{len(training)} for training, {len(validation)} for validation",
        "processes": str(fabric.world_size),
    }

    out.mkdir(parents=True, exist_ok=True)
    facts = {"seen": training_ranges(scenes), **(facts or {})}
    step, judged, best = 0, 0, math.inf
    if resume and (out / "state.pt").exists():
        step, judged, best = _restore(out / "state.pt", setup, network, average, optimizer)

    def keep() -> None:
        if fabric.is_global_zero:
            numbers = {"step": step, "judged": judged, "best": best}
            _store(out / "state.pt", setup, network, average, optimizer, numbers)

    saved, began = time.monotonic(), (time.monotonic(), step)
    recent: list[float] = []
    whole = True  # network, average and step belong together
    with _bar(progress and fabric.is_global_zero, total, step) as show:
        try:
            while judged < recipe.epochs:
                order.epoch, order.skip = judged, (step - judged * per_epoch) * recipe.batch
                for batch in loader:
                    for group in optimizer.param_groups:
                        group["lr"] = learning_rate(recipe, step, total)
                    torch.manual_seed(
                        (recipe.seed * total + step) * fabric.world_size + fabric.global_rank
                    )  # dropout
                    pillars, state = batch.pillars.to(fabric.device), batch.state.to(fabric.device)
                    loss = mean_loss(model(pillars), state, recipe, step / per_epoch)
                    value = float(loss.detach())
                    if not _finite_everywhere(fabric, value):
                        raise _nonfinite_loss_error(out, batch, value, step)
                    optimizer.zero_grad()
                    fabric.backward(loss)
                    if math.isfinite(recipe.clip):
                        fabric.clip_gradients(model, optimizer, max_norm=recipe.clip)
                    whole = False
                    optimizer.step()
                    step += 1
                    _update_ema(average, network, min(recipe.average, step / (step + 10)))
                    whole = True
                    recent = [*recent[-99:], value]
                    show(step, loss=sum(recent) / len(recent), epoch=step / per_epoch)
                    if time.monotonic() - saved > save_every:
                        keep()
                        saved = time.monotonic()
                # An epoch is over
                epoch = judged + 1
                if fabric.is_global_zero:
                    seconds = time.monotonic() - began[0]
                    speed = (step - began[1]) * recipe.batch * fabric.world_size / seconds
                    scores = validate(average, checks, recipe, fabric.device)
                    _log(out / "log.csv", epoch, step, sum(recent) / max(len(recent), 1), scores, speed)
                    show(step, scores=scores)
                    if scores.loss < best:
                        best = scores.loss
                        result = {"epoch": epoch, "step": step, "validation": scores._asdict()}
                        save_network(out / "best.safetensors", average, _facts(recipe, facts, result))
                    if picture_every and epoch % picture_every == 0:
                        _picture(out / f"epoch-{epoch:03d}.png", average, checks, fabric.device)
                judged = epoch
                keep()
                saved = time.monotonic()
                began = (time.monotonic(), step)
                fabric.barrier()
        except KeyboardInterrupt:
            if whole:  # else the state of some seconds or minutes ago is the one to go on from
                keep()
            raise
        except (torch.OutOfMemoryError, RuntimeError) as error:
            memory = "alloc" in str(error) or "DataLoader worker" in str(error)  # the kernel killed it
            if not (isinstance(error, torch.OutOfMemoryError) or memory):
                raise
            raise MemoryError(
                f"out of memory with batches of {recipe.batch}: use a smaller --batch, or fewer --workers"
            ) from error
    return out / "best.safetensors"


@torch.no_grad()
def validate(
    network: Network, scenes: PillarDataset, recipe: Recipe, device: torch.device | str = "cpu"
) -> Scores:
    """Score a network on samples, by the loss as it is after all annealing, so that epochs can be compared."""
    network.eval()
    loss = kl = 0.0
    cells = 0
    counts = np.zeros((3, 3))
    for i in range(len(scenes)):
        batch = scenes[i]
        evidence, state = network(batch.pillars.to(device)), batch.state.to(device)
        target, valid = losses.targets(state)
        count = int(valid.sum())
        loss += count * float(mean_loss(evidence, state, recipe, math.inf))
        kl += count * float(losses.masked_mean(losses.reverse_kl(evidence, target, recipe.strength), valid))
        cells += count
        called = torch.where(evidence.sum(-1) > recipe.strength / 2, 1 + evidence.argmax(-1), 0)
        counts += np.bincount((3 * state[valid] + called[valid]).cpu().numpy(), minlength=9).reshape(3, 3)
    iou = np.diag(counts) / np.maximum(counts.sum(0) + counts.sum(1) - np.diag(counts), 1)
    return Scores(loss / max(cells, 1), kl / max(cells, 1), float(iou[1]), float(iou[2]))


@torch.no_grad()
def _update_ema(average: Network, network: Network, decay: float) -> None:
    for mine, its in zip(average.state_dict().values(), network.state_dict().values(), strict=True):
        if mine.is_floating_point():
            mine.lerp_(its, 1 - decay)
        else:
            mine.copy_(its)


def _finite_everywhere(fabric: Fabric, value: float) -> bool:
    """Say whether the loss is finite on every process, so that all stop where one must."""
    finite = torch.tensor(float(math.isfinite(value)), device=fabric.device)
    return bool(fabric.all_reduce(finite, reduce_op="mean") == 1)


def _store(
    path: Path,
    setup: Mapping[str, str],
    network: Network,
    average: Network,
    optimizer: Any,
    numbers: Mapping[str, float],
) -> None:
    state = {
        "setup": dict(setup),
        "network": network.state_dict(),
        "average": average.state_dict(),
        "optimizer": optimizer.state_dict(),
        **numbers,
    }
    with atomic_write(path) as file:
        torch.save(state, file)


def _restore(
    path: Path, setup: Mapping[str, str], network: Network, average: Network, optimizer: Any
) -> tuple[int, int, float]:
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        for name, wanted in setup.items():
            if state["setup"][name] != wanted:
                raise ValueError(
                    f"it was begun with another {name}: {state['setup'][name]}, now {wanted}; give the same options "
                    "and data, or another --out"
                )
        network.load_state_dict(state["network"])
        average.load_state_dict(state["average"])
        optimizer.load_state_dict(state["optimizer"])
        return int(state["step"]), int(state["judged"]), float(state["best"])
    except Exception as error:  # whatever torch makes of a foreign or damaged file
        raise ValueError(f"cannot resume from {path}: {error}") from error


def _nonfinite_loss_error(out: Path, batch: Batch, value: float, step: int) -> FloatingPointError:
    if math.isfinite(value):
        return FloatingPointError(
            f"the loss of another process is not finite at step {step}; see its message"
        )
    path = out / f"batch-{step}.npz"
    with atomic_write(path) as file:
        np.savez_compressed(
            file,
            features=batch.pillars.features.numpy(),
            lengths=batch.pillars.lengths.numpy(),
            cells=batch.pillars.cells.numpy(),
            state=batch.state.numpy(),
            numbers=np.array(batch.numbers),
        )
    return FloatingPointError(
        f"the loss became {value} at step {step}; the batch is in {path}; --resume with a smaller "
        "--learning-rate goes on from the last saved state"
    )


def _log(path: Path, epoch: int, step: int, loss: float, scores: Scores, speed: float) -> None:
    """Append a row to the learning curve."""
    row = {"epoch": epoch, "step": step, "training_loss": loss, **scores._asdict(), "samples_per_s": speed}
    new = not path.exists()
    with open(path, "a", newline="") as file:
        writer = csv.DictWriter(file, list(row))
        if new:
            writer.writeheader()
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})


def _facts(recipe: Recipe, facts: Mapping[str, Any] | None, result: Mapping[str, Any]) -> dict[str, Any]:
    versions = {name: importlib.metadata.version(name) for name in ("torch", "lightning", "numpy")}
    return {"recipe": asdict(recipe), "result": dict(result), "versions": versions, **(facts or {})}


@torch.no_grad()
def _picture(path: Path, network: Network, scenes: PillarDataset, device: torch.device | str) -> None:
    """Show two fixed samples: points, truth, and what the network says."""
    from ogm.grid import EvidentialGrid
    from ogm.plot import Panel, masses, points, save_picture
    from ogm.state import Truth

    panels: list[Panel] = []
    for i in sorted({0, len(scenes) // 2}):
        batch = scenes[i]
        evidence = network(batch.pillars.to(device))[0].cpu().numpy()
        grid = EvidentialGrid.trusted(scenes.spec, evidence_to_mass(evidence))
        panels += [
            points(batch.pillars.features[:, :4].numpy(), scenes.spec, f"sample {i}", 0.0),
            masses(Truth(scenes.spec, batch.state[0].numpy()).grid, "truth"),
            masses(grid, "network"),
        ]
    save_picture(path, *panels)


@contextmanager
def _bar(visible: bool, total: int, done: int) -> Iterator[Callable[..., None]]:
    columns = (
        TextColumn("epoch {task.fields[epoch]:.1f}"),
        BarColumn(),
        TextColumn("loss {task.fields[loss]:.4f}  {task.fields[scores]}"),
        TimeRemainingColumn(elapsed_when_finished=True, compact=True),
    )
    with Progress(*columns, disable=not visible) as bar:
        task = bar.add_task("training", total=total, completed=done, loss=math.nan, epoch=0.0, scores="")

        def show(step: int, scores: Scores | None = None, **fields: float) -> None:
            said = {}
            if scores is not None:
                said["scores"] = (
                    f"validation {scores.loss:.4f}, IoU free {scores.free:.2f} occupied {scores.occupied:.2f}"
                )
            bar.update(task, completed=step, **fields, **said)  # type: ignore[arg-type]

        yield show


def _check(training: Samples, validation: Samples, recipe: Recipe, out: Path, resume: bool) -> None:
    if recipe.loss not in LOSSES:
        raise ValueError(f"loss must be one of {', '.join(LOSSES)}, got {recipe.loss!r}")
    if recipe.epochs < 1 or recipe.batch < 1:
        raise ValueError(f"epochs and batch must be at least 1, got {recipe.epochs} and {recipe.batch}")
    if not (recipe.learning_rate > 0 and recipe.strength > 0):
        raise ValueError("learning_rate and strength must be greater than 0")
    if len(training) < recipe.batch:
        raise ValueError(f"{len(training)} training samples are fewer than one batch of {recipe.batch}")
    if len(validation) == 0:
        raise ValueError("there are no validation samples to choose the weights by")
    if not resume and (out / "state.pt").exists():
        raise ValueError(f"{out} holds a run already; go on with --resume, or give another --out")
