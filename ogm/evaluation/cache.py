"""Finished frames on disk, so that an interrupted evaluation resumes."""

import hashlib
import json
import os
import zipfile
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.files import atomic_write
from ogm.metrics import ConfusionSums

__all__ = ["FrameResult", "ResultCache", "code_state", "files_state"]

_FORMAT = "ogm.frames/1"
_UNREADABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)


class FrameResult(NamedTuple):
    """What is kept of a frame.

    Attributes
    ----------
    sums : tuple of ConfusionSums
        Of every method.
    truth : (4,) float64
        Shares of the cells whose truth is unknown, free, occupied, ignored.
    pictures : dict of str to bytes
        See `ogm.evaluation.frame_pictures.draw_frame`.
    """

    sums: tuple[ConfusionSums, ...]
    truth: NDArray[np.float64]
    pictures: dict[str, bytes]


class ResultCache:
    """Finished frames in a folder, one file each, and the settings that they depend on.

    Parameters
    ----------
    folder : Path
        Made if need be. Frames of a *finished* run with other settings are removed, nothing else.
    settings : dict
        All that decides what the frames hold, as JSON can hold it.

    Raises
    ------
    ValueError
        If the folder holds an unfinished run with other settings, or a run.json that is not from here.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        self.folder, self.settings = folder, settings
        self.key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
        if folder.exists() and not folder.is_dir():
            raise ValueError(f"{folder} is a file, but frames are kept in a folder of that name; rename it")
        self._note = folder / "run.json"
        self._complete: set[int] = set()  # frames that were read or written since, so that none is read twice
        note = self._read_note()
        if note is not None and note.get("key") != self.key:
            if note.get("format") != _FORMAT:
                raise ValueError(f"{self._note} is damaged or not from `ogm evaluate`: give another folder")
            frames = [path for path in folder.glob("*.npz") if path.stem.isdecimal()]
            if frames and not note.get("finished"):
                raise ValueError(
                    f"{folder} holds {len(frames)} frames of an unfinished run with other data, methods or settings, "
                    "with files that have changed since, or by another ogm: repeat that command to resume it, give "
                    "another --out, or delete the folder"
                )
            for path in frames:
                path.unlink()
        folder.mkdir(parents=True, exist_ok=True)
        self._write_note(finished=False)

    def finish(self) -> None:
        """Note that all frames are there."""
        self._write_note(finished=True)

    def missing(self, numbers: Iterable[int]) -> list[int]:
        """Return those of some frames that are not finished, or whose files are damaged."""
        return [k for k in numbers if k not in self._complete and self.load(k) is None]

    def load(self, frame: int) -> FrameResult | None:
        """Return a frame; None if it is not finished, or its file is damaged."""
        try:
            with open(self._path(frame), "rb") as file, np.load(file, allow_pickle=False) as data:
                if str(data["key"]) != self.key:
                    return None
                columns = [data[f"sums {name}"] for name in ConfusionSums._fields]
                pictures = {name[8:]: data[name].tobytes() for name in data.files if name[:8] == "picture "}
                sums = tuple(ConfusionSums(*row) for row in zip(*columns, strict=True))
                self._complete.add(frame)
                return FrameResult(sums, data["truth"], pictures)
        except _UNREADABLE:
            return None

    def save(self, frame: int, result: FrameResult) -> None:
        """Keep a frame, whole or not at all."""
        arrays: dict[str, Any] = {"key": np.array(self.key), "truth": result.truth}
        for name in ConfusionSums._fields:
            arrays[f"sums {name}"] = np.stack([getattr(one, name) for one in result.sums])
        for name, data in result.pictures.items():
            arrays[f"picture {name}"] = np.frombuffer(data, np.uint8)
        with atomic_write(self._path(frame)) as file:
            np.savez_compressed(file, **arrays)
        self._complete.add(frame)

    def _path(self, frame: int) -> Path:
        return self.folder / f"{frame:06d}.npz"

    def _read_note(self) -> dict[str, Any] | None:
        try:
            found = json.loads(self._note.read_text())
        except FileNotFoundError:
            return None
        except ValueError:
            return {}  # damaged
        return found if isinstance(found, dict) else {}

    def _write_note(self, *, finished: bool) -> None:
        note = {"format": _FORMAT, "key": self.key, "finished": finished, "settings": self.settings}
        with atomic_write(self._note, "w") as file:
            json.dump(note, file, indent=1)


def files_state(paths: Iterable[Path], besides: Path | None = None) -> str:
    """Return a hash that changes when files are added, removed or rewritten.

    Parameters
    ----------
    paths : iterable of Path
        Files, and folders with all below. Names, sizes and times of the last change count; nothing is read.
    besides : Path, optional
        A folder that is left out.
    """
    left_out = None if besides is None else besides.resolve()
    found = []
    for path in paths:
        for folder, below, names in os.walk(path):
            below[:] = sorted(name for name in below if Path(folder, name).resolve() != left_out)
            if Path(folder).resolve() != left_out:
                found += [Path(folder, name) for name in sorted(names)]
        found += [path] if path.is_file() else []
    rows = [(os.fsencode(one), stat.st_size, stat.st_mtime_ns) for one in found if (stat := _stat(one))]
    return hashlib.sha256(repr(rows).encode()).hexdigest()


def _stat(path: Path) -> os.stat_result | None:
    try:
        return path.stat()
    except OSError:  # a link to nothing
        return None


def code_state() -> str:
    """Return a hash that changes with every line of ogm: its version stays during development."""
    root = Path(str(resources.files("ogm")))
    sums = [hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(root.rglob("*.py"))]
    return hashlib.sha256("".join(sums).encode()).hexdigest()
