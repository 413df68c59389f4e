"""Fusing many drives, a folder of results for each, by any number of workers and resumable."""

import hashlib
import json
import os
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ogm.datasets import Dataset
from ogm.scan import Frame
from ogm.storage.files import DISK_ERRORS, OgmError, atomic_write, error_text, temporary_folder
from ogm.storage.locks import locked
from ogm.storage.workers import deaths_explained, work_off

_FORMAT = "ogm.fused/1"
_NOTE = "drive.json"
FuseDrive = Callable[[Sequence[Frame], Path], Mapping[str, Any]]


class FusedDrive(NamedTuple):
    """Result of a drive.

    Attributes
    ----------
    name : str
    facts : dict
        Facts returned by the fusing function.
    error : str
        Reason for a missing result, else "".
    reused : bool
        Whether the drive was finished before.
    """

    name: str
    facts: Mapping[str, Any]
    error: str = ""
    reused: bool = False


def fuse_drives(
    drives: Mapping[str, Sequence[Frame]],
    fuse_drive: FuseDrive,
    out: str | os.PathLike[str],
    *,
    workers: int = 1,
    scheduler: str | None = None,
) -> Generator[FusedDrive, None, None]:
    """Fuse drives into folders ``out/NAME`` with processes or a Dask cluster, and yield each finished drive.

    A drive's folder appears when it is complete. Drives with a folder are not fused again, so that the same call
    resumes an interrupted run.

    Parameters
    ----------
    drives : dict of str to sequence of Frame
        Frames by name of the drive; for other processes picklable, as datasets of `ogm.datasets` are.
    fuse_drive : callable
        ``fuse_drive(frames, folder) -> facts`` writes its results into a new folder and returns facts for JSON. Its
        repr identifies the results. For other processes picklable.
    out : path
        Folder of the results, created if missing.
    workers : int
        1 works in this process; more start processes on this machine.
    scheduler : str, optional
        Address of a Dask scheduler to use instead, ``"tcp://host:port"``; its workers need `out` under the same path.

    Raises
    ------
    OgmError
        If results of the same name are of other frames or of another function.
    BlockingIOError
        If another process fuses into `out`.
    OSError
        If workers die repeatedly, the disk is full, or the scheduler cannot be reached.
    """
    out = Path(out).absolute()
    out.mkdir(parents=True, exist_ok=True)
    with locked(out):
        keys = {name: _key(name, frames, fuse_drive) for name, frames in drives.items()}
        jobs = []
        for name, frames in drives.items():
            if (facts := _finished(out / name, keys[name])) is None:
                jobs.append(_Job(name, keys[name], frames))
            else:
                yield FusedDrive(name, facts, reused=True)
        task = _Task(fuse_drive, out)
        with closing(work_off(task, jobs, workers, scheduler)) as done, deaths_explained("drives"):
            for _, drive in done:
                yield drive


def drives_of(datasets: Iterable[tuple[Path, Dataset]]) -> dict[str, Dataset]:
    """Return the drives of datasets by name: the name of the path, and of the sequence if there are several.

    Parameters
    ----------
    datasets : iterable of (Path, Dataset)
        Each dataset with its path.

    Raises
    ------
    ValueError
        If two drives have one name.
    """
    drives: dict[str, Dataset] = {}
    for path, dataset in datasets:
        name = path.resolve().name.split(".")[0]
        parts = {f"{name}-{sequence}": dataset.select(numbers) for sequence, numbers in dataset.sequences.items()}
        for key, part in (parts or {name: dataset}).items():
            allowed = "".join(c if c.isalnum() or c in "-_." else "-" for c in key)
            if allowed in drives:
                raise ValueError(f"{path} has a second drive of the name {allowed}: rename its folder, or leave it out")
            drives[allowed] = part
    return drives


class _Job(NamedTuple):
    """A drive to fuse."""

    name: str
    key: str
    frames: Sequence[Frame]


@dataclass(frozen=True)
class _Task:
    """Work on one drive, picklable for other processes."""

    fuse_drive: FuseDrive
    out: Path

    def __call__(self, job: _Job) -> FusedDrive:
        try:
            facts = _finished(self.out / job.name, job.key)
            if facts is not None:  # by a worker that died before its report
                return FusedDrive(job.name, facts)
            with temporary_folder(self.out) as folder:
                made = folder / job.name
                made.mkdir()
                facts = dict(self.fuse_drive(job.frames, made))
                with atomic_write(made / _NOTE, "w") as file:
                    json.dump({"format": _FORMAT, "key": job.key, "facts": facts}, file, indent=1)
                os.rename(made, self.out / job.name)
        except (ValueError, TypeError, OSError) as error:
            if isinstance(error, OSError) and error.errno in DISK_ERRORS:
                raise
            return FusedDrive(job.name, {}, error_text(error))
        return FusedDrive(job.name, facts)


def _key(name: str, frames: Sequence[Frame], fuse_drive: FuseDrive) -> str:
    """Return a hash of names, stamps and poses of a drive's frames, and of the fusing function."""
    if not name or name in (".", "..") or "/" in name or "\0" in name:
        raise ValueError(f"the name of a drive must be a valid folder name, got {name!r}")
    key = hashlib.sha256(repr(fuse_drive).encode())
    for frame in getattr(frames, "refs", frames):
        T = None if frame.T_map_sensor is None else np.asarray(frame.T_map_sensor, np.float64).tobytes()
        key.update(repr((frame.name, frame.sequence, frame.stamp, T)).encode("utf-8", "backslashreplace"))
    return key.hexdigest()


def _finished(folder: Path, key: str) -> dict[str, Any] | None:
    """Return the facts of a drive that was fused before, else None."""
    if not folder.exists():
        return None
    other = f"{folder} contains results of other frames or options: remove it, or give another folder"
    try:
        note = json.loads((folder / _NOTE).read_text())
        if note["format"] == _FORMAT and note["key"] == key:
            return dict(note["facts"])
    except FileNotFoundError:
        other = f"{folder} is no result of this command: remove it, or give another folder"
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        other = f"{folder / _NOTE} cannot be read ({error}): remove {folder}, and the drive is fused again"
    raise OgmError(other)
