"""`evaluate`: methods on the frames of a data set, chosen by names and numbers, frame by frame, with resume."""

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
    """Evaluate methods on the same frames of a data set.

    For a `FusedMethod`, open the data set with ``others="later"``: its truth must not be made of scans that the map has
    fused, and cells that a frame cannot observe are left out, as the map may know them from other frames.

    Parameters
    ----------
    methods : dict of str to method, or list of str
        By its name in the report: any callable with ``.spec`` that maps a `Scan` to an `EvidentialGrid`; the name of a
        model, see `ogm.models.load_model`; `SingleScanMethod`, `FusedMethod` or `PrecomputedGrids`. Or a list of names
        of models.
    dataset : sequence of Frame
        Frames with truth, as `ogm.datasets.open_dataset` returns them. Without truth, see `evaluate_agreement`.
    spec : GridSpec, optional
        The evaluated cells, around the sensor. By default the 81.92 m x 56.32 m of the paper.
    frames : iterable of int, optional
        Numbers of the evaluated frames; by default all that have truth. Fused methods take in all frames of a sequence
        up to them.
    out : path, optional
        Folder for finished frames, in ``frames/``, with their pictures. If all data, methods and settings are those of
        an interrupted run there, it is resumed. An own callable is the same if its `repr` and its source file are.
    workers : int
        1 works in this process; more start processes of this machine, and a script that calls this must guard its own
        code by ``if __name__ == "__main__":``. They share out frames, or with fused methods sequences. The result is
        the same to the last bit. Methods and data set must be picklable, as those by name and of `ogm.datasets` are.
    scheduler : str, optional
        Address of a Dask scheduler to use instead, ``"tcp://host:port"``, whose workers see data set and `out` under
        the same paths.
    progress : function
        Iterates over the numbers of the frames that are read, or with several workers finished, and may draw a progress
        bar.
    draw : function
        Draws a frame for `out`, see `ogm.evaluation.frame_pictures.draw_frame`.

    Raises
    ------
    ValueError
        If there is no method or no frame, a frame has no truth, a grid covers another area than `spec`, or `out` holds
        an unfinished run with other settings.
    TypeError
        If methods, data set or `draw` cannot be pickled for other processes.
    BlockingIOError
        If another process evaluates into `out`.
    OSError
        If workers die again and again, the disk is full, or the scheduler cannot be reached. Finished frames stay.
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
        name: {"description": one.description, "weights": getattr(one, "weights", None)} for name, one in used.items()
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
                for name in REPORT_FILES:  # of another run: they would look like this one's if it ended early
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
    """Yield sums and true shares of every frame, and collect its motion."""
    for row, info in zip(rows, infos, strict=True):
        motion.add(row.motion, info.sequence, info.stamp)
        yield row.sums, row.truth


def package_versions() -> dict[str, str]:
    """Return the versions of the packages that figures may depend on, as far as they are installed."""
    found = {}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def checked_frames(
    methods: Mapping[str, Method], dataset: Sequence[Frame], numbers: Sequence[int], *, truth: bool = False
) -> tuple[FrameInfo, ...]:
    """Return names, sequences and stamps of the evaluated frames, after a check of what the methods need of them."""
    if not numbers or not 0 <= numbers[0] <= numbers[-1] < len(dataset):
        raise ValueError(f"there must be frames to evaluate, in 0 ... {len(dataset) - 1}, got {numbers[:3]} ...")
    if truth and not getattr(dataset, "description", True) and dataset[numbers[0]].truth is None:  # may also raise
        raise ValueError(f"{dataset!r} has no truth to compare with; {NO_TRUTH}")
    frames = [dataset[k] for k in numbers]
    for name, method in methods.items():
        if not isinstance(method, SingleScanMethod):
            method.check(name, frames)
    return tuple(FrameInfo(one.name, one.sequence, one.stamp) for one in frames)


def _open_cache(out: Path, task: FrameTask, settings: Mapping[str, Any], stack: ExitStack) -> ResultCache:
    """Open the folder of finished frames, with all that decides what they hold; it is locked until `stack` ends."""
    methods, spec, dataset = task.methods, task.spec, task.dataset
    grids = [path for one in methods.values() if isinstance(one, PrecomputedGrids) for path in one.files.values()]
    files = [Path(one) for one in (*getattr(dataset, "files", ()), *grids) if not isinstance(one, ObjectPath)]
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out} is a file, but the report is a folder")
    if out.resolve() in {(path if path.is_dir() else path.parent).resolve() for path in files}:
        raise ValueError(f"{out} holds what is evaluated: pictures of the report would mix with it")
    states = {
        "states": {name: one.state() for name, one in methods.items()},
        "versions": package_versions(),
        "grid": [spec.resolution, spec.shape, spec.origin],
        "files": files_state(files, out),
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


def choose_frames(
    dataset: Dataset, samples: int | None = None, every: int = 1, seed: int = 0, *, truth: bool = True
) -> list[int]:
    """Return the numbers of frames, ascending: every N-th, and of these some that are drawn at random.

    Parameters
    ----------
    dataset : Dataset
    samples : int, optional
        Number of frames that are drawn; by default all.
    every : int
        1 or more.
    seed : int
        Random seed of the draw.
    truth : bool
        Whether only frames with truth are chosen.

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
