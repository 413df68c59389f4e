"""Training of a network on frames.

A run is a folder. ``best.safetensors`` and ``best.json`` are the averaged weights with the lowest validation loss,
``state.pt`` holds the state to resume from, ``log.csv`` the learning curve, and ``epoch-NNN.png`` shows fixed
validation frames.

>>> from pathlib import Path
>>> from ogm import GridSpec, open_dataset
>>> from ogm.deep.recipe import LITE_RECIPE
>>> from ogm.deep.training import train
>>> data = [open_dataset("data", split=name) for name in ("train", "val")]  # doctest: +SKIP
>>> train(*data, GridSpec.centered(), Path("runs/lite"), LITE_RECIPE)       # doctest: +SKIP
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from ogm.deep.data import PLAIN, PillarDataset, training_ranges
from ogm.deep.network import NetworkConfig, PillarNetwork
from ogm.deep.polar import RadarGrid, RadarNoise
from ogm.deep.radar_data import RadarDataset
from ogm.deep.radar_network import RadarConfig, RadarNetwork
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
    spec: GridSpec | RadarGrid,
    out: Path,
    recipe: Recipe,
    *,
    noise: Callable[[str], RadarNoise] | None = None,
    initial: PillarNetwork | RadarNetwork | None = None,
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
        Frames with scan, mount and truth, as ``open_dataset(path, split="training")`` gives them, or with
        ``sensors=["radar"]`` for a network of radars. The weights are chosen by `validation`.
    spec : GridSpec or RadarGrid
        The network's grid, around the sensor: a `RadarGrid` for a network of radars.
    out : Path
        The run's folder.
    recipe : Recipe
    noise : callable, optional
        Returns field of view and errors of a radar by the name of its sensor; by default `RadarNoise()` for
        all radars. Only used for networks of radars.
    initial : PillarNetwork or RadarNetwork, optional
        Begin with its weights instead of random ones; the recipe's network may take further inputs.
    resume : bool
        Resume a run with the same recipe, grid, data and number of processes that stopped in `out`; the learning rate
        and the clipping may be others. Begin if there is none.
    accelerator, devices, nodes, precision
        See Lightning Fabric. The default precision is bfloat16 where the accelerator or the processor has it, else
        float32.
    workers : int, optional
        Processes that prepare frames, for each training process; by default half the cores, 12 at most.
    picture_every : int
        Epochs between pictures of validation frames; 0 draws none. Trainings of radars draw none.
    facts : mapping, optional
        Provenance, written to ``best.json``.
    progress : bool
        Show a progress bar.

    Raises
    ------
    ValueError
        If there are too few frames, the grid does not suit the network or its sensor, `out` holds another run, or a
        number of the recipe is out of range.
    FloatingPointError
        If the loss is not finite; the batch is saved in the run's folder.
    MemoryError
        If the memory does not suffice.
    BlockingIOError
        If another process trains in `out`.
    OSError
        If another process of the training ended; the state after the last step is saved.
    """
    _check_recipe(validation, recipe, out, resume)
    frames = _dataset(training, spec, recipe, noise)
    fixed: Any = replace(frames, frames=validation, augmentation=PLAIN)
    fabric = _launch(accelerator, devices, nodes, precision)
    known, draw = dict(facts or {}), None
    if isinstance(frames, PillarDataset):
        known = {"seen": training_ranges(frames), **known}
        draw = partial(draw_predictions, dataset=fixed, device=fabric.device)
    run = TrainingRun(fabric, recipe, spec, out, len(frames), len(fixed), initial)
    shown: Any = {"draw": draw, "picture_every": picture_every, "progress": progress}
    return run_training(run, frames, fixed, known, resume=resume, workers=workers, **shown)


def _dataset(
    frames: Sequence[Frame], spec: GridSpec | RadarGrid, recipe: Recipe, noise: Callable[[str], RadarNoise] | None
) -> PillarDataset | RadarDataset:
    """Return the frames as the recipe's network takes them."""
    network, augmentation = recipe.network, recipe.augmentation
    if isinstance(network, NetworkConfig) and isinstance(spec, GridSpec):
        limits = recipe.most_pillars, recipe.most_points
        return PillarDataset(frames, spec, augmentation, network.z_range, recipe.seed, *limits, network.rays)
    if isinstance(network, RadarConfig) and isinstance(spec, RadarGrid):
        return RadarDataset(frames, spec, noise, augmentation, recipe.seed)
    raise ValueError(f"networks of lidars take a GridSpec, networks of radars a RadarGrid, got {spec}")


def _launch(accelerator: str, devices: int, nodes: int, precision: Any) -> Fabric:
    """Start the processes of a training; see `train` for the default precision."""
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


def _check_recipe(validation: Sequence[Any], recipe: Recipe, out: Path, resume: bool) -> None:
    """Raise a ValueError if a number of a recipe is out of range, frames are missing, or `out` holds a run."""
    if recipe.loss not in LOSSES:
        raise ValueError(f"loss must be one of {', '.join(LOSSES)}, got {recipe.loss!r}")
    if recipe.epochs < 1 or recipe.batch < 1:
        raise ValueError(f"epochs and batch must be at least 1, got {recipe.epochs} and {recipe.batch}")
    if not (recipe.learning_rate > 0 and recipe.strength > 0):
        raise ValueError("learning_rate and strength must be greater than 0")
    if len(validation) == 0:
        raise ValueError("there are no validation frames to choose the weights by")
    refuse_other_run(out, resume)
