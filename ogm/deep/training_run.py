"""`TrainingRun`: state of a training and the files of its folder."""

import csv
import importlib.metadata
import io
import math
import time
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning.fabric import Fabric

from ogm.deep.checkpoint import save_network
from ogm.deep.data import Batch, PillarDataset
from ogm.deep.losses import KERB
from ogm.deep.network import PillarNetwork, copy_weights
from ogm.deep.recipe import Recipe, learning_rate, mean_loss
from ogm.evidence import evidence_to_mass
from ogm.grid import EvidentialGrid, GridSpec
from ogm.state import Truth
from ogm.storage.files import OgmError, atomic_write

_MODULES = ("network", "average", "optimizer")


class TrainingRun:
    """State of a training, which can be saved and restored.

    Parameters
    ----------
    fabric : Fabric
        Lightning's launcher of the processes.
    recipe : Recipe
        Settings of the training.
    spec : GridSpec
        Grid of the network.
    out : Path
        Folder of the run.
    training, validation : int
        Numbers of frames.
    initial : PillarNetwork, optional
        Network with the initial weights; see `ogm.deep.network.copy_weights`.

    Attributes
    ----------
    step, epoch : int
        Numbers of completed steps, and of completed and validated epochs.
    average : PillarNetwork
        Exponential moving average of the network's weights.
    consistent : bool
        Whether network, average and step belong to the same step.
    """

    fabric: Fabric
    recipe: Recipe
    out: Path
    steps_per_epoch: int
    steps: int
    optimizer: Any
    step: int
    epoch: int
    best: float
    consistent: bool

    def __init__(
        self,
        fabric: Fabric,
        recipe: Recipe,
        spec: GridSpec,
        out: Path,
        training: int,
        validation: int,
        initial: PillarNetwork | None = None,
    ) -> None:
        self.fabric, self.recipe, self.out = fabric, recipe, out
        self.steps_per_epoch = training // fabric.world_size // recipe.batch
        self.steps = self.steps_per_epoch * recipe.epochs
        if self.steps == 0:
            need = f"one batch of {recipe.batch} for each of {fabric.world_size} processes"
            raise ValueError(f"{training} training frames are fewer than {need}: use a smaller `batch`")
        self._setup = {
            "recipe": repr(replace(recipe, learning_rate=0.0, clip=0.0)),  # a resumed run may change these two
            "spec": repr(spec),
            "frames": f"{training} for training, {validation} for validation",
            "processes": str(fabric.world_size),
        }
        torch.manual_seed(recipe.seed)
        build: Any = recipe.network.build  # torch declares no memory_format
        self.network = build(spec).to(memory_format=torch.channels_last)
        if initial is not None:
            copy_weights(initial, self.network)
        average = build(spec).to(memory_format=torch.channels_last)
        average.load_state_dict(self.network.state_dict())
        rates: Any = {"lr": recipe.learning_rate, "weight_decay": recipe.weight_decay}
        optimizer = torch.optim.AdamW(self.network.parameters(), **rates, fused=True)
        self._model, self.optimizer = fabric.setup(self.network, optimizer)
        self.average = average.to(fabric.device).eval()
        self.step, self.epoch, self.best = 0, 0, math.inf
        self.consistent = True
        self._losses: list[float] = []  # losses of the last 100 steps
        states = (module.state_dict().values() for module in (self.average, self.network))
        pairs = [pair for pair in zip(*states, strict=True) if pair[0].is_floating_point()]
        self._averaged, self._newest = ([pair[k] for pair in pairs] for k in range(2))
        self._buffers = [*self.network.buffers()]

    @property
    def recent_loss(self) -> float:
        """Mean loss of the last 100 steps."""
        return sum(self._losses) / max(len(self._losses), 1)

    def do_step(self, batch: Batch) -> None:
        """Update the weights by the gradient of a batch."""
        recipe, fabric = self.recipe, self.fabric
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(recipe, self.step, self.steps)
        averaged = min(recipe.average, (self.step + 1) / (self.step + 11))
        seed = (recipe.seed * self.steps + self.step) * fabric.world_size + fabric.global_rank
        torch.manual_seed(seed)  # for the dropout
        inputs, state = batch.on(fabric.device)
        with self._buffers_kept():
            loss = mean_loss(self._model(inputs), state, recipe, self.step / self.steps_per_epoch)
            self.optimizer.zero_grad()
            fabric.backward(loss)
            norm = 0.0
            if math.isfinite(recipe.clip):
                options: Any = {"max_norm": recipe.clip, "error_if_nonfinite": False}
                norm = fabric.clip_gradients(self._model, self.optimizer, **options)
            value = float(loss.detach())  # waits for the accelerator, which has the whole step to do by now
            finite = torch.tensor(float(math.isfinite(value + norm)), device=fabric.device)
            if fabric.all_reduce(finite, reduce_op="mean") != 1:  # all processes stop together
                cause = value if fabric.world_size > 1 else value + float(norm)  # gradients are those of all processes
                raise nonfinite_loss_error(self.out, batch, cause, self.step)
            self.consistent = False
        self.optimizer.step()
        self.step += 1
        with torch.no_grad():
            torch._foreach_lerp_(self._averaged, self._newest, 1 - averaged)
        self._losses = [*self._losses[-99:], value]
        self.consistent = True

    @contextmanager
    def _buffers_kept(self) -> Iterator[None]:
        """Restore the network's buffers after an error or interrupt; a forward pass changes batch statistics."""
        kept = [buffer.clone() for buffer in self._buffers]
        try:
            yield
        except BaseException:
            for buffer, before in zip(self._buffers, kept, strict=True):
                buffer.copy_(before)
            raise

    def record(self, scores: Mapping[str, float], speed: float, facts: Mapping[str, Any]) -> None:
        """Append an epoch to the learning curve, and save its weights if its loss is the lowest.

        Parameters
        ----------
        scores : mapping
            Validation scores, including ``loss``.
        speed : float
            Steps per second.
        facts : mapping
            Further entries of the description of the weights.
        """
        counts = {"epoch": self.epoch + 1, "step": self.step}
        row = {**counts, "training_loss": self.recent_loss, **scores}
        row["samples_per_s"] = speed * self.recipe.batch * self.fabric.world_size
        _add_row(self.out / "log.csv", row)
        if scores["loss"] < self.best:
            versions = {name: importlib.metadata.version(name) for name in ("torch", "lightning", "numpy")}
            result = {**counts, "validation": dict(scores)}
            about = {"recipe": asdict(self.recipe), "result": result, "versions": versions, **facts}
            save_network(self.out / "best.safetensors", self.average, about)
            self.best = scores["loss"]  # set last, so that a run stopped before saves the weights again

    def save(self) -> float:
        """Write ``state.pt`` and return the time [s] of a monotonic clock."""
        if self.fabric.is_global_zero:
            state = {name: getattr(self, name).state_dict() for name in _MODULES}
            numbers = {"step": self.step, "epoch": self.epoch, "best": self.best, "losses": self._losses}
            archive = io.BytesIO()  # torch.save to a file would hide the error of a full disk
            torch.save({"setup": self._setup, **state, **numbers}, archive)
            with atomic_write(self.out / "state.pt") as file:
                file.write(archive.getbuffer())
        return time.monotonic()

    def restore(self) -> None:
        """Read ``state.pt``. Only tensors, texts and numbers are unpickled."""
        path = self.out / "state.pt"
        try:
            with zipfile.ZipFile(path) as archive:  # torch does not check the checksums
                if damaged := archive.testzip():
                    raise OgmError(f"its part {damaged} is damaged: the checksum differs")
            state = torch.load(path, map_location="cpu", weights_only=True)
            for name, wanted in self._setup.items():
                if state["setup"][name] != wanted:
                    change = f"{state['setup'][name]}, now {wanted}; give the same options and data, or another `out`"
                    raise ValueError(f"it was started with another {name}: {change}")
            for name in _MODULES:
                getattr(self, name).load_state_dict(state[name])
            self.step, self.epoch, self.best = int(state["step"]), int(state["epoch"]), float(state["best"])
            self._losses = [float(loss) for loss in state.get("losses", ())]
        except Exception as error:  # torch raises various errors for damaged files
            raise OgmError(f"cannot resume from {path}: {error}") from error


@torch.no_grad()
def draw_predictions(path: Path, network: PillarNetwork, dataset: PillarDataset, device: torch.device | str) -> None:
    """Draw points, truth and prediction of two fixed frames."""
    from ogm.plot import Panel, mass_panel, points_panel, save_picture

    panels: list[Panel] = []
    for i in sorted({0, len(dataset) // 2}):
        batch = dataset[i]
        evidence = network(batch.pillars.to(device))[0].cpu().numpy()
        panels += [
            points_panel(batch.pillars.features[:, :4].numpy(), dataset.spec, f"sample {i}", 0.0),
            mass_panel(Truth(dataset.spec, batch.state[0].numpy() % KERB).grid, "truth"),
            mass_panel(EvidentialGrid.trusted(dataset.spec, evidence_to_mass(evidence)), "network"),
        ]
    save_picture(path, *panels)


def nonfinite_loss_error(folder: Path, batch: Batch, loss: float, step: int) -> FloatingPointError:
    """Return the error for a non-finite loss; the batch is saved if the loss is of this process."""
    if math.isfinite(loss):
        return FloatingPointError(f"the loss of another process is not finite at step {step}: see its message")
    path = folder / f"batch-{step}.npz"
    with atomic_write(path) as file:
        arrays: Any = batch.arrays()
        np.savez_compressed(file, **arrays, state=batch.state.numpy(), numbers=np.array(batch.numbers))
    way_out = "continue from the last saved state by `resume` with a smaller `learning_rate`"
    became = f"the loss or its gradient became {loss} at step {step}"
    return FloatingPointError(f"{became}, the batch is in {path}: {way_out}")


def _add_row(path: Path, row: Mapping[str, float]) -> None:
    """Write the row of an epoch after the rows of earlier epochs; rows of a stopped run are replaced."""
    rows: list[dict[str, Any]] = []
    if path.exists():
        with open(path, newline="") as file:
            rows = [earlier for earlier in csv.DictReader(file) if int(earlier["epoch"]) < row["epoch"]]
    rows.append({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})
    with atomic_write(path, "w") as file:
        writer = csv.DictWriter(file, list(row), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
