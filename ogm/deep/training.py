"""Training of a network on frames.

The folder of a run contains the averaged weights with the lowest validation loss (``best.safetensors`` and
``best.json``), the state to resume from (``state.pt``), the learning curve (``log.csv``) and predictions for fixed
validation frames (``epoch-NNN.png``).

>>> from pathlib import Path
>>> from ogm import GridSpec, open_dataset
>>> from ogm.deep.recipe import LITE_RECIPE
>>> from ogm.deep.training import train
>>> data = [open_dataset("data", split=name) for name in ("train", "val")]  # doctest: +SKIP
>>> train(*data, GridSpec.centered(), Path("runs/lite"), LITE_RECIPE)       # doctest: +SKIP
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from ogm.deep.data import NO_AUGMENTATION, PillarDataset, training_ranges
from ogm.deep.network import PillarNetwork
from ogm.deep.recipe import LOSSES, Recipe
from ogm.extras import install_line
from ogm.grid import GridSpec
from ogm.scan import Frame

try:
    from lightning.fabric import Fabric

    from ogm.deep.training_loop import refuse_other_run, run_training
    from ogm.deep.training_run import TrainingRun, draw_predictions
except ImportError as error:
    raise ImportError(f"training lacks a package ({error}): {install_line('train,sim')}") from error

__all__ = ["train"]


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
        Frames with scan, mount and truth, see ``open_dataset(path, split="training")``. The best weights are chosen on
        `validation`.
    spec : GridSpec
        Grid of the network around the sensor.
    out : Path
        Folder of the run.
    recipe : Recipe
        Settings of the training.
    initial : PillarNetwork, optional
        Network with the initial weights, by default random. The recipe's network may have further inputs.
    resume : bool
        Resume the run in `out`, or start if the folder holds no run. Recipe, grid, data and number of processes must
        be the same, except for learning rate and gradient clipping.
    accelerator, devices, nodes, precision
        See Lightning Fabric. The default precision is bfloat16 if the accelerator or the processor supports it, else
        float32.
    workers : int, optional
        Number of processes that prepare frames, for each training process; by default half the cores, at most 12.
    picture_every : int
        Epochs between pictures of validation frames; 0 for no pictures.
    facts : mapping, optional
        Provenance, written to ``best.json``.
    progress : bool
        Whether to show a progress bar.

    Raises
    ------
    ValueError
        If there are too few frames, the grid does not fit the network, `out` holds another run, or a
        number of the recipe is out of range.
    FloatingPointError
        If the loss is not finite; the batch is saved in the folder of the run.
    MemoryError
        If there is not enough memory.
    BlockingIOError
        If another process trains in `out`.
    OSError
        If another process of the training ended; the state after the last step is saved.
    """
    _check_recipe(validation, recipe, out, resume)
    network = recipe.network
    inputs = (recipe.most_pillars, recipe.most_points, network.rays, recipe.kerbs)
    frames = PillarDataset(training, spec, recipe.augmentation, network.z_range, recipe.seed, *inputs)
    fixed = replace(frames, frames=validation, augmentation=NO_AUGMENTATION)
    fabric = _launch(accelerator, devices, nodes, precision)
    known = {"seen": training_ranges(frames), **(facts or {})}
    draw = partial(draw_predictions, dataset=fixed, device=fabric.device)
    run = TrainingRun(fabric, recipe, spec, out, len(frames), len(fixed), initial)
    shown: Any = {"draw": draw, "picture_every": picture_every, "progress": progress}
    return run_training(run, frames, fixed, known, resume=resume, workers=workers, **shown)


def _launch(accelerator: str, devices: int, nodes: int, precision: Any) -> Fabric:
    """Start the processes of a training; see `train` for the default precision."""
    if accelerator == "auto":  # Lightning would also choose accelerators without torch.segment_reduce
        accelerator = "cuda" if torch.cuda.is_available() else "cpu"
    if precision is None:
        cuda = accelerator in ("cuda", "gpu") and torch.cuda.is_available() and torch.cuda.is_bf16_supported()
        bfloat16 = cuda or (accelerator == "cpu" and _has_bfloat16())
        precision = "bf16-mixed" if bfloat16 else "32-true"
    try:
        fabric = Fabric(accelerator=accelerator, devices=devices, num_nodes=nodes, precision=precision)
    except (RuntimeError, ValueError) as error:  # Lightning's errors if there is no such accelerator
        raise ValueError(f"cannot train on {devices} x {accelerator} on this machine: {error}") from error
    fabric.launch()
    return fabric


def _has_bfloat16() -> bool:
    """Return whether the processor supports bfloat16 (AVX-512 BF16, or AMX), which trains 2 to 4 times as fast."""
    is_supported = getattr(torch.cpu, "_is_avx512_bf16_supported", None)
    return bool(is_supported and is_supported())


def _check_recipe(validation: Sequence[Any], recipe: Recipe, out: Path, resume: bool) -> None:
    """Raise ValueError if a number of a recipe is out of range, frames are missing, or `out` holds a run."""
    if recipe.loss not in LOSSES:
        raise ValueError(f"loss must be one of {', '.join(LOSSES)}, got {recipe.loss!r}")
    if recipe.epochs < 1 or recipe.batch < 1:
        raise ValueError(f"epochs and batch must be at least 1, got {recipe.epochs} and {recipe.batch}")
    if not (recipe.learning_rate > 0 and recipe.strength > 0):
        given = f"got {recipe.learning_rate} and {recipe.strength}"
        raise ValueError(f"learning_rate and strength must be greater than 0, {given}")
    if len(validation) == 0:
        raise ValueError("got no validation frames to choose the weights by: give a dataset with validation frames")
    refuse_other_run(out, resume)
