"""Frame after frame against the truth, what is finished kept on disk, so that an interrupted run goes on."""

import hashlib
import json
import os
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.cli.methods import Methods
from ogm.cli.source import Source
from ogm.cli.views import frame_view
from ogm.files import atomic_write
from ogm.grid import GridSpec
from ogm.metrics import ConfusionSums, Evaluation, accumulate, distances

__all__ = ["ResultCache", "FrameResult", "run_evaluation", "state_of_code", "state_of_files"]

FORMAT = "ogm.judged/1"
View = Callable[
    [Any, NDArray[np.uint8], Sequence[NDArray[np.float32]], GridSpec, float | None], dict[str, bytes]
]
UNREADABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)


class FrameResult(NamedTuple):
    """What is kept of a frame.

    Attributes
    ----------
    counts : tuple of Tally
        Of every method.
    truth : (4,) float64
        Shares of the cells whose truth is unknown, free, occupied, ignored.
    views : dict of str to bytes
        Its pictures, see `ogm.cli.views.frame_view`.
    """

    counts: tuple[ConfusionSums, ...]
    truth: NDArray[np.float64]
    views: dict[str, bytes]


class ResultCache:
    """Finished frames in a folder, one file each, and what they were judged by.

    Parameters
    ----------
    folder : Path
        Made if need be. Frames of a *finished* run by other settings are removed, nothing else.
    settings : dict
        All that decides what the frames hold, as JSON can hold it.

    Raises
    ------
    ValueError
        If the folder holds an unfinished run by other settings, or a run.json that is not from here.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        self.folder = folder
        self.key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
        if folder.exists() and not folder.is_dir():
            raise ValueError(
                f"{folder} is a file; frames are kept in a folder of that name: give another --out"
            )
        self._note = folder / "run.json"
        begun = self._begun()
        if begun is not None and begun.get("key") != self.key:
            if begun.get("format") != FORMAT:
                raise ValueError(f"{self._note} is damaged or not from `ogm evaluate`: give another --out")
            frames = [path for path in folder.glob("*.npz") if path.stem.isdecimal()]
            if frames and not begun.get("finished"):
                raise ValueError(
                    f"{folder} holds {len(frames)} frames of an unfinished run with other data, methods or settings, "
                    "with files that have changed since, or by another ogm: repeat that command to go on, give "
                    "another --out, or delete the folder"
                )
            for path in frames:
                path.unlink()
        folder.mkdir(parents=True, exist_ok=True)
        self._write(finished=False, settings=settings)
        self.settings = settings
        self._whole: set[int] = (
            set()
        )  # frames that were read or written since, so that none is read to look twice

    def finish(self) -> None:
        """Note that all frames are there and reported."""
        self._write(finished=True, settings=self.settings)

    def missing(self, numbers: Iterable[int]) -> list[int]:
        """Return those of some frames that are not finished, or whose files are damaged."""
        return [k for k in numbers if k not in self._whole and self.load(k) is None]

    def load(self, frame: int) -> FrameResult | None:
        """Return a frame; None if it is not finished, or its file is damaged."""
        try:
            with open(self._path(frame), "rb") as file, np.load(file, allow_pickle=False) as data:
                if str(data["key"]) != self.key:
                    return None
                columns = [data[f"counts {name}"] for name in ConfusionSums._fields]
                views = {name[5:]: data[name].tobytes() for name in data.files if name.startswith("view ")}
                counts = tuple(ConfusionSums(*row) for row in zip(*columns, strict=True))
                self._whole.add(frame)
                return FrameResult(counts, data["truth"], views)
        except UNREADABLE:
            return None

    def save(self, frame: int, judged: FrameResult) -> None:
        """Keep a frame, whole or not at all."""
        columns = {
            f"counts {name}": np.stack([getattr(one, name) for one in judged.counts])
            for name in ConfusionSums._fields
        }
        views = {f"view {name}": np.frombuffer(data, np.uint8) for name, data in judged.views.items()}
        arrays: dict[str, Any] = {"key": np.array(self.key), "truth": judged.truth, **columns, **views}
        with atomic_write(self._path(frame)) as file:
            np.savez_compressed(file, **arrays)
        self._whole.add(frame)

    def _path(self, frame: int) -> Path:
        return self.folder / f"{frame:06d}.npz"

    def _begun(self) -> dict[str, Any] | None:
        try:
            found = json.loads(self._note.read_text())
        except FileNotFoundError:
            return None
        except ValueError:
            return {}  # damaged
        return found if isinstance(found, dict) else {}

    def _write(self, *, finished: bool, settings: Mapping[str, Any]) -> None:
        with atomic_write(self._note, "w") as file:
            note = {"format": FORMAT, "key": self.key, "finished": finished, "settings": settings}
            json.dump(note, file, indent=1)


def state_of_files(paths: Iterable[Path], besides: Path | None = None) -> str:
    """Return a number that is another one when files are added, removed, or written anew.

    Parameters
    ----------
    paths : iterable of Path
        Files, and folders with all that lies below; told by name, size and time of the last change, not read.
    besides : Path, optional
        A folder that is left out.
    """
    left_out = None if besides is None else besides.resolve()
    found = []
    for path in paths:
        for folder, below, names in os.walk(path):
            below[:] = sorted(name for name in below if Path(folder, name).resolve() != left_out)
            found += (
                [Path(folder, name) for name in sorted(names)] if Path(folder).resolve() != left_out else []
            )
        found += [path] if path.is_file() else []
    lines = [(os.fsencode(one), stat.st_size, stat.st_mtime_ns) for one in found if (stat := _stat(one))]
    return hashlib.sha256(repr(lines).encode()).hexdigest()


def _stat(path: Path) -> os.stat_result | None:
    try:
        return path.stat()
    except OSError:  # a link to nothing
        return None


def state_of_code() -> str:
    """Return a number that is another one when a line of ogm changes: its version stays while it is worked on."""
    root = Path(str(resources.files("ogm")))
    sums = [hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(root.rglob("*.py"))]
    return hashlib.sha256("".join(sums).encode()).hexdigest()


def run_evaluation(
    source: Source,
    numbers: Sequence[int],
    methods: Methods,
    archive: ResultCache,
    tick: Callable[[Iterable[int]], Iterable[int]] = iter,
    view: View = frame_view,
) -> Evaluation:
    """Judge methods on frames.

    Parameters
    ----------
    source : Source
    numbers : sequence of int
        Of the frames that are judged, ascending. Where methods remember, they are also shown all frames of the same
        sequences in between and before.
    methods : Methods
    archive : Archive
        Keeps the frames with their pictures; those that it has already are not judged again.
    tick : function
        Iterates over the numbers of the frames that are read, and may draw a progress bar.
    view : function
        ``view(points, state, masses, spec, ground_z)`` draws a frame, as `ogm.cli.views.frame_view` does.
    """
    spec = methods.spec
    missing = archive.missing(numbers)
    wanted, away = set(missing), distances(spec)
    for number in tick(_shown(source, missing, methods.remember)):
        item = source.read(number)
        if number not in wanted:
            methods.show(source.frames[number], item)
            continue
        grids = methods.grids(source.frames[number], item)
        state = item.truth.crop(spec).state
        masses = [grid.mass for grid in grids.values()]
        counts = tuple(accumulate(mass, state, away) for mass in masses)
        truth = np.bincount(state.ravel(), minlength=4) / state.size
        ground = None if item.T_vehicle_sensor is None else -float(item.T_vehicle_sensor[2, 3])
        archive.save(number, FrameResult(counts, truth, view(item.points, state, masses, spec, ground)))

    def kept(number: int) -> tuple[Sequence[ConfusionSums], NDArray[np.float64]]:
        one = archive.load(number)
        if one is None:
            raise ValueError(
                f"{archive.folder} lost the finished frame {source.frames[number].name}: repeat the command"
            )
        return one.counts, one.truth

    return Evaluation.from_counts(methods.names, spec, map(kept, numbers))


def _shown(source: Source, missing: Sequence[int], remember: bool) -> list[int]:
    """Return the frames to read: the missing ones, and for methods that remember all before them in their sequence."""
    if not remember:
        return list(missing)
    last: dict[str, int] = {}
    for number in missing:
        last[source.frames[number].sequence] = number
    return [k for k, frame in enumerate(source.frames) if k <= last.get(frame.sequence, -1)]
