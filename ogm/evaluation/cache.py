"""Results of finished frames on disk, to resume an interrupted evaluation."""

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.evaluation.motion import FrameMotion
from ogm.metrics import ConfusionSums, MotionSums, PredictionSums
from ogm.metrics.detection_time import ObjectCells
from ogm.storage.archive import UNREADABLE
from ogm.storage.files import OgmError, atomic_write, update_hint

_FORMAT = "ogm.frames/1"
_MOTION: dict[str, Any] = {  # parts of a FrameMotion
    "motion": MotionSums, "objects": ObjectCells, "predicted": PredictionSums,
}  # fmt: skip


class FrameResult(NamedTuple):
    """Result of a frame.

    Attributes
    ----------
    sums : tuple of ConfusionSums
        Sums of each method.
    truth : (4,) float64
        Shares of cells with true state unknown, free, occupied, ignored.
    pictures : dict of str to bytes
        See `ogm.evaluation.frame_pictures.draw_frame`.
    motion : dict of int to FrameMotion
        Motion by the index of the method, for methods with dynamic grids; empty if the true motion is unknown.
    """

    sums: tuple[ConfusionSums, ...]
    truth: NDArray[np.float64]
    pictures: dict[str, bytes]
    motion: dict[int, FrameMotion] = {}


class ResultCache:
    """Finished frames in a folder, one file each, with the settings of the run.

    Parameters
    ----------
    folder : Path
        Created if missing. Frames of a *finished* run with other settings are removed, nothing else.
    settings : dict
        Everything that the results depend on, for JSON.

    Raises
    ------
    OgmError
        If the folder contains an unfinished run with other settings, or a run.json of another program.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        self.folder, self.settings = folder, settings
        self.key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
        note = self._read_note()
        if note["key"] != self.key:
            frames = [path for path in folder.glob("*.npz") if path.stem.isdecimal()]
            if frames and not note["finished"]:
                raise OgmError(
                    f"{folder} contains {len(frames)} frames of an unfinished run with other data, methods, settings "
                    "or version of ogm, or with files that have changed: repeat that command to resume it, give "
                    "another `out`, or delete the folder"
                )
            for path in frames:
                path.unlink()
        folder.mkdir(parents=True, exist_ok=True)
        self.note(finished=False)

    def missing(self, numbers: Iterable[int]) -> list[int]:
        """Return the unfinished frames among `numbers`; damaged files are removed and count as unfinished."""
        found = []
        for number in numbers:
            try:
                self.load(number)
            except UNREADABLE:
                self._path(number).unlink(missing_ok=True)
                found.append(number)
        return found

    def count(self, numbers: Iterable[int]) -> int:
        """Return the number of finished frames among `numbers`; call `missing` before, which removes damaged files."""
        return sum(self._path(number).exists() for number in numbers)

    def load(self, frame: int) -> FrameResult:
        """Return a finished frame; raise one of `UNREADABLE` if its file is missing or damaged."""
        with open(self._path(frame), "rb") as file, np.load(file, allow_pickle=False) as data:
            if str(data["key"]) != self.key:
                raise ValueError(f"{self._path(frame)} is a frame of another run")
            columns = [data[f"sums {name}"] for name in ConfusionSums._fields]
            pictures = {name[8:]: data[name].tobytes() for name in data.files if name[:8] == "picture "}
            sums = tuple(ConfusionSums(*row) for row in zip(*columns, strict=True))
            return FrameResult(sums, data["truth"], pictures, _read_motion(data))

    def save(self, frame: int, result: FrameResult) -> None:
        """Write a frame in one step."""
        columns = zip(ConfusionSums._fields, zip(*result.sums, strict=True), strict=True)
        arrays: dict[str, Any] = {"key": np.array(self.key), "truth": result.truth}
        arrays |= {f"sums {name}": np.stack(column) for name, column in columns}
        arrays |= {f"picture {name}": np.frombuffer(data, np.uint8) for name, data in result.pictures.items()}
        for k, motion in result.motion.items():
            for (part, kind), values in zip(_MOTION.items(), motion, strict=True):
                arrays |= {f"{part} {k} {name}": array for name, array in zip(kind._fields, values, strict=True)}
        with atomic_write(self._path(frame)) as file:
            np.savez_compressed(file, **arrays)

    def _path(self, frame: int) -> Path:
        return self.folder / f"{frame:06d}.npz"

    def _read_note(self) -> dict[str, Any]:
        note = self.folder / "run.json"
        if not note.exists():
            return {"key": self.key}
        hint = ""
        with suppress(ValueError, RecursionError):  # no JSON
            found = json.loads(note.read_text())
            if isinstance(found, dict) and found.get("format") == _FORMAT and {"key", "finished"} <= found.keys():
                return found
            hint = update_hint(found.get("format"), _FORMAT) if isinstance(found, dict) else ""
        raise OgmError(f"{note} is damaged or no file of `ogm evaluate`{hint}: give another folder")

    def note(self, *, finished: bool) -> None:
        """Write the settings to run.json, and whether all frames are finished."""
        facts = {"format": _FORMAT, "key": self.key, "finished": finished, "settings": self.settings}
        with atomic_write(self.folder / "run.json", "w") as file:
            json.dump(facts, file, indent=1)


def _read_motion(data: Mapping[str, Any]) -> dict[int, FrameMotion]:
    """Return the motion of a frame by the index of the method."""
    found = {}
    for k in sorted({int(name.split()[1]) for name in data if name.startswith("motion ")}):
        parts = (kind(*(data[f"{part} {k} {name}"] for name in kind._fields)) for part, kind in _MOTION.items())
        found[k] = FrameMotion(*parts)
    return found


def files_state(paths: Iterable[Path], excluded: Path | None = None) -> str:
    """Return a hash that changes when files are added, removed or rewritten.

    Parameters
    ----------
    paths : iterable of Path
        Files, and folders with all files below. The hash covers names, sizes and times of the last change.
    excluded : Path, optional
        A folder to leave out.
    """
    left_out = None if excluded is None else excluded.resolve()
    rows = []
    for root in (path.resolve() for path in paths):
        for path in (root, *sorted(root.rglob("*"))):
            if path.is_file() and left_out not in path.parents:
                stat = path.stat()
                rows.append((os.fsencode(path), stat.st_size, stat.st_mtime_ns))
    return hashlib.sha256(repr(rows).encode()).hexdigest()


def code_state() -> str:
    """Return a hash of the source code of ogm, since its version does not change during development."""
    code = [path.read_bytes() for path in sorted(Path(__file__).parents[1].rglob("*.py"))]
    return hashlib.sha256(b"".join(code)).hexdigest()
