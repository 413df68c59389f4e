"""Methods and frames of an evaluation, chosen by names and numbers as ``ogm evaluate`` is given them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ogm.datasets import Dataset
from ogm.evaluation.methods import FusedMethod, Method, PrecomputedGrids, SingleScanMethod
from ogm.fusion.resample import ResampleMethod
from ogm.grid import GridSpec
from ogm.models.named import short_names


def named_methods(
    models: Sequence[str],
    rules: Sequence[str],
    folders: Sequence[Path],
    spec: GridSpec,
    resampling: ResampleMethod | None = None,
) -> dict[str, Method]:
    """Return the models, each of them fused by every rule, and the folders of precomputed grids, by short names.

    Parameters
    ----------
    models : sequence of str
        Names of `ogm.models.load_model`.
    rules : sequence of str
        Names in `ogm.evidence.map_rules.MAP_RULES`.
    folders : sequence of Path
        Folders of grids.
    spec : GridSpec
        Cells of the models' grids.
    resampling : {"area", "nearest", "cautious"}, optional
        See `PrecomputedGrids`.

    Raises
    ------
    ValueError
        If a model or a folder is given twice, or there is none of the name.
    """
    scans = {short: SingleScanMethod.named(name, spec) for short, name in short_names(models).items()}
    methods: dict[str, Method] = dict(scans)
    for name, method in scans.items():
        for rule in rules:
            methods[f"{name} + {rule}"] = FusedMethod.by_rule(name, method.model, rule, spec)
    for folder in folders:
        name = folder.resolve().name
        name = name if name not in methods else str(folder)
        if name in methods:
            raise ValueError(f"{folder} is given twice; give each folder once")
        methods[name] = PrecomputedGrids.in_folder(folder, resampling)
    return methods


def choose_frames(dataset: Dataset, samples: int | None = None, every: int = 1, seed: int = 0) -> list[int]:
    """Return the numbers of frames with truth, ascending: every N-th, and of these some that are drawn at random.

    Parameters
    ----------
    dataset : Dataset
    samples : int, optional
        Number of frames that are drawn; by default all.
    every : int
        1 or more.
    seed : int
        Random seed of the draw.

    Raises
    ------
    ValueError
        If `every` is below 1, or there are fewer frames than `samples`.
    """
    if every < 1:
        raise ValueError(f"--every must be at least 1, got {every}")
    numbers = np.array(dataset.with_truth, int)[::every]
    if samples is not None:
        if not 1 <= samples <= len(numbers):
            raise ValueError(f"--samples must be in 1 ... {len(numbers)}, the frames of {dataset.name}, got {samples}")
        numbers = np.sort(np.random.default_rng(seed).choice(numbers, samples, replace=False))
    chosen: list[int] = numbers.tolist()
    return chosen
