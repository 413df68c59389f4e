"""Training of the network of radar, by the engine of `ogm.deep.training`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ogm.deep.polar import RadarGrid
from ogm.deep.radar_data import RadarBatch, RadarDataset, RadarFrame
from ogm.deep.recipe import RADAR_RECIPE, Recipe
from ogm.deep.training import check_recipe, launch, run_training
from ogm.deep.training_run import TrainingRun

__all__ = ["train_radar"]


def train_radar(
    training: Sequence[RadarFrame],
    validation: Sequence[RadarFrame],
    out: Path,
    recipe: Recipe = RADAR_RECIPE,
    *,
    polar: RadarGrid | None = None,
    resume: bool = False,
    accelerator: str = "auto",
    precision: str | None = None,
    workers: int | None = None,
    facts: Mapping[str, Any] | None = None,
    progress: bool = True,
) -> Path:
    """Train a network of radar and return the path of its best weights.

    Parameters
    ----------
    training, validation : sequence of RadarFrame
        The weights are chosen by `validation`.
    out : Path
        The run's folder, as of `ogm.deep.training.train`.
    recipe : Recipe
        Its network is a `RadarConfig`.
    polar : RadarGrid, optional
    resume, accelerator, precision, workers, facts, progress
        As of `ogm.deep.training.train`.

    Raises
    ------
    ValueError, FloatingPointError, MemoryError, BlockingIOError
        As of `ogm.deep.training.train`.
    """
    check_recipe(validation, recipe, out, resume)
    polar = polar or RadarGrid()
    fabric = launch(accelerator, 1, 1, precision)
    frames = RadarDataset(training, polar, recipe.augmentation, recipe.seed)
    fixed = RadarDataset(validation, polar)
    run = TrainingRun(fabric, recipe, polar, out, len(frames), len(fixed))
    options: Any = {"resume": resume, "workers": workers, "progress": progress}
    return run_training(run, frames, fixed, RadarBatch.joined, facts or {}, **options)
