"""Evaluation of methods on the frames of a dataset, with resume, and selection of methods and frames."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.datasets import Dataset
from ogm.evaluation.cache import FrameResult, ResultCache, code_state, files_state
from ogm.evaluation.frame_pictures import draw_frame
from ogm.evaluation.methods import FusedMethod, Method, PrecomputedGrids, SingleScanMethod, as_methods
from ogm.evaluation.motion import MotionCollector
from ogm.evaluation.result import Evaluation, FrameInfo
from ogm.evaluation.tasks import NO_TRUTH, Draw, FrameTask, Progress
from ogm.fusion.resample import ResampleMethod
from ogm.grid import GridSpec
from ogm.metrics import ConfusionSums
from ogm.models.named import short_names
from ogm.scan import Frame
from ogm.storage.locks import locked
from ogm.storage.remote import ObjectPath

REPORT_FILES = ("report.html", "report.json", "frames.csv", "metrics.png", "frames.png")
PACKAGES = ("ogm-toolkit", "numpy", "numba", "scipy", "torch", "zarr")


def evaluate(
    methods: Mapping[str, Any] | Sequence[str],
    dataset: Sequence[Frame],
    spec: GridSpec | None = None,
    *,
    frames: Iterable[int] | None = None,
    out: str | Path | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Progress = iter,
    draw: Draw = draw_frame,
) -> Evaluation:
    """Evaluate methods on the same frames of a dataset.

    For a `FusedMethod`, open the dataset with ``others="later"``: its truth must not be made from scans in the map, and
    unobserved cells of a frame are left out, as the map may know them from other frames.

    Parameters
    ----------
    methods : dict of str to method, or list of str
        Methods by name in the report: a callable with ``.spec`` that maps a `Scan` to an `EvidentialGrid`; the name of
        a model, see `ogm.models.load_model`; a `SingleScanMethod`, `FusedMethod` or `PrecomputedGrids`. Or a list of
        names of models.
    dataset : sequence of Frame
        Frames with truth, from `ogm.datasets.open_dataset`. Without truth, see `evaluate_agreement`.
    spec : GridSpec, optional
        Evaluated cells, around the sensor. By default the 81.92 m x 56.32 m of the paper.
    frames : iterable of int, optional
        Numbers of the evaluated frames; by default all frames with truth. Fused methods also use all earlier frames of
        their sequences.
    out : path, optional
        Folder for finished frames, in ``frames/``, with their pictures. An interrupted run in this folder is resumed
        if data, methods and settings are unchanged. A callable is unchanged if its `repr`, or without one its
        attributes, and its source are.
    workers : int
        1 works in this process. More start processes on this machine, and a script that calls this must guard its own
        code by ``if __name__ == "__main__":``. Processes share the frames, or with fused methods the sequences. The
        result is identical. Methods and dataset must be picklable, as named methods and `ogm.datasets` are.
    scheduler : str, optional
        Address of a Dask scheduler to use instead, ``"tcp://host:port"``; its workers need dataset and `out` under the
        same paths.
    progress : function
        Iterates over the numbers of the frames to read, or with several workers of the finished frames, and may draw a
        progress bar.
    draw : function
        Draws a frame for `out`, see `ogm.evaluation.frame_pictures.draw_frame`.

    Raises
    ------
    ValueError
        If there is no method or no frame, a frame has no truth, a grid covers another area than `spec`, or `out`
        contains an unfinished run with other settings.
    TypeError
        If methods, dataset or `draw` cannot be pickled for other processes.
    BlockingIOError
        If another process evaluates into `out`.
    OSError
        If workers die repeatedly, the disk is full, or the scheduler cannot be reached. Finished frames are kept.
    KeyboardInterrupt
        With `out`, the message counts the finished frames.
    """
    spec = GridSpec.centered() if spec is None else spec
    used = as_methods(methods, spec)
    numbers = sorted(set(getattr(dataset, "with_truth", range(len(dataset))) if frames is None else frames))
    infos = checked_frames(used, dataset, numbers, truth=True)
    about = {"kind": ("format", "frames in Python"), "name": ("name", "frames"), "truth": ("description", "")}
    data = {key: getattr(dataset, *default) for key, default in about.items()} | getattr(dataset, "facts", {})
    facts = {
        name: {"description": method.description, "weights": getattr(method, "weights", None)}
        for name, method in used.items()
    }
    task, alone = FrameTask(used, spec, dataset, draw if out else None), workers == 1 and scheduler is None
    cache: ResultCache | None = None
    missing: Sequence[int] = numbers
    with ExitStack() as stack:
        if out is not None:
            settings = {"data": data, "methods": facts, "frames": infos, "numbers": numbers}
            cache = _open_cache(Path(out), task, settings, stack)
            missing = cache.missing(numbers)
            if len(missing) == len(numbers):
                for name in REPORT_FILES:  # left by another run; they would be mistaken for results of this run
                    (Path(out) / name).unlink(missing_ok=True)
        if alone:
            found = task.run(missing, progress, cache)
        else:
            found = task.share_out(missing, progress, cache, workers, scheduler)
        rows: Iterable[FrameResult]
        if cache is None:
            rows = (row for _, row in (found if alone else sorted(found)))  # type: ignore[misc]
        else:
            try:
                for _ in found:
                    pass
            except KeyboardInterrupt:
                kept = f"{cache.count(numbers)} of {len(numbers)} frames are finished and kept"
                raise KeyboardInterrupt(f"{kept}: repeat the command to resume") from None
            rows = map(cache.load, numbers)
        motion = MotionCollector(tuple(used))
        result = Evaluation.from_sums(tuple(used), spec, _collecting(rows, infos, motion), infos)
        result = replace(result, motion=motion.result(result.drives))
        if cache is not None:
            cache.note(finished=True)
        reused = len(numbers) - len(missing)
        return replace(result, data=data, facts=facts, numbers=tuple(numbers), cache=cache, reused=reused)


def _collecting(
    rows: Iterable[FrameResult], infos: Iterable[FrameInfo], motion: MotionCollector
) -> Iterator[tuple[tuple[ConfusionSums, ...], NDArray[np.float64]]]:
    """Yield sums and true shares of each frame, and collect its motion."""
    for row, info in zip(rows, infos, strict=True):
        motion.add(row.motion, info.sequence, info.stamp)
        yield row.sums, row.truth


def package_versions() -> dict[str, str]:
    """Return the versions of installed packages that results may depend on."""
    found = {}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def checked_frames(
    methods: Mapping[str, Method], dataset: Sequence[Frame], numbers: Sequence[int], *, truth: bool = False
) -> tuple[FrameInfo, ...]:
    """Return names, sequences and stamps of the evaluated frames; raise if the methods cannot use them."""
    if not numbers or not 0 <= numbers[0] <= numbers[-1] < len(dataset):
        raise ValueError(f"`frames` must be numbers in 0 ... {len(dataset) - 1}, at least one, got {numbers[:3]} ...")
    if truth and not getattr(dataset, "description", True) and dataset[numbers[0]].truth is None:  # may also raise
        raise ValueError(f"{dataset!r} has no truth to compare with; {NO_TRUTH}")
    frames = [dataset[k] for k in numbers]
    for name, method in methods.items():
        if not isinstance(method, SingleScanMethod):
            method.check(name, frames)
    return tuple(FrameInfo(frame.name, frame.sequence, frame.stamp) for frame in frames)


def _open_cache(out: Path, task: FrameTask, settings: Mapping[str, Any], stack: ExitStack) -> ResultCache:
    """Open the folder of finished frames with the full settings of the run; it is locked until `stack` ends."""
    methods, spec, dataset = task.methods, task.spec, task.dataset
    grids = [
        path for method in methods.values() if isinstance(method, PrecomputedGrids) for path in method.files.values()
    ]
    files = [Path(path) for path in (*getattr(dataset, "files", ()), *grids) if not isinstance(path, ObjectPath)]
    if out.exists() and not out.is_dir():
        raise ValueError(f"the report needs a folder, but {out} is a file; give another `out`")
    if out.resolve() in {(path if path.is_dir() else path.parent).resolve() for path in files}:
        raise ValueError(f"{out} contains the evaluated data, which the report would mix with; give another `out`")
    states = {
        "states": {name: method.state() for name, method in methods.items()},
        "versions": package_versions(),
        "grid": [spec.resolution, spec.shape, spec.origin],
        "files": files_state(files, excluded=out),
        "code": code_state(),
    }
    (out / "frames").mkdir(parents=True, exist_ok=True)
    stack.enter_context(locked(out / "frames"))
    return ResultCache(out / "frames", {**settings, **states})


def named_methods(
    models: Sequence[str],
    rules: Sequence[str],
    folders: Sequence[Path],
    spec: GridSpec,
    resampling: ResampleMethod | None = None,
) -> dict[str, Method]:
    """Return methods by short names: models, models fused by each rule, and folders of precomputed grids.

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
        If a model or a folder is given twice or does not exist.
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


def choose_frames(
    dataset: Dataset, samples: int | None = None, every: int = 1, seed: int = 0, *, truth: bool = True
) -> list[int]:
    """Return the numbers of every N-th frame, optionally a random sample of them, ascending.

    Parameters
    ----------
    dataset : Dataset
    samples : int, optional
        Number of frames to draw at random; by default all.
    every : int
        Step N, 1 or more.
    seed : int
        Random seed of the draw.
    truth : bool
        Whether to use only frames with truth.

    Raises
    ------
    ValueError
        If `every` is below 1, or there are fewer frames than `samples`.
    """
    if every < 1:
        raise ValueError(f"`every` must be at least 1, got {every}")
    numbers = np.array(dataset.with_truth if truth else range(len(dataset)), int)[::every]
    if samples is not None:
        if not 1 <= samples <= len(numbers):
            raise ValueError(f"`samples` must be in 1 ... {len(numbers)}, the frames of {dataset.name}, got {samples}")
        numbers = np.sort(np.random.default_rng(seed).choice(numbers, samples, replace=False))
    chosen: list[int] = numbers.tolist()
    return chosen
