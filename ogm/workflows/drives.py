"""Many drives, a folder of results for each: made by any number of workers, and never twice."""

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
    """A drive that is done.

    Attributes
    ----------
    name : str
    facts : dict
        What the function that fused it returned.
    error : str
        Why there is no result; "" if there is.
    reused : bool
        Whether it was finished before.
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
    """Yield each drive as its results are written into ``out/NAME``, by processes or a Dask cluster.

    A drive's folder appears when all in it is written. A drive that has one is not fused again, so that the same call
    goes on where it was stopped.

    Parameters
    ----------
    drives : dict of str to sequence of Frame
        By name. For other processes picklable, as data sets of `ogm.datasets` are.
    fuse_drive : callable
        ``fuse_drive(frames, folder) -> facts`` writes its results into a new folder and returns what is worth
        knowing, as JSON holds it. Its repr is kept as what the drive was made by. For other processes picklable.
    out : path
        Made if need be.
    workers : int
        1 works in this process; more start processes of this machine.
    scheduler : str, optional
        Address of a Dask scheduler to use instead, ``"tcp://host:port"``, whose workers see `out` under the same path.

    Raises
    ------
    OgmError
        If a drive of that name was fused from other frames or by another function.
    BlockingIOError
        If another process fuses into `out`.
    OSError
        If workers die again and again, the disk is full, or the scheduler cannot be reached.
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
            for _, one in done:
                yield one


def drives_of(datasets: Iterable[tuple[Path, Dataset]]) -> dict[str, Dataset]:
    """Return the drives of datasets by name: that of the path, and of the sequence where it has several.

    Parameters
    ----------
    datasets : iterable of (Path, Dataset)
        Each with the path that it was opened from.

    Raises
    ------
    ValueError
        If two drives have one name.
    """
    drives: dict[str, Dataset] = {}
    for path, dataset in datasets:
        name = path.resolve().name.split(".")[0]
        parts = {f"{name}-{one}": dataset.select(numbers) for one, numbers in dataset.sequences.items()}
        for key, part in (parts or {name: dataset}).items():
            allowed = "".join(c if c.isalnum() or c in "-_." else "-" for c in key)
            if allowed in drives:
                raise ValueError(f"{path} has a drive {allowed}, as one before it: rename its folder, or leave it out")
            drives[allowed] = part
    return drives


class _Job(NamedTuple):
    """A drive that is to be fused."""

    name: str
    key: str
    frames: Sequence[Frame]


@dataclass(frozen=True)
class _Task:
    """What a worker does with a drive."""

    fuse_drive: FuseDrive
    out: Path

    def __call__(self, job: _Job) -> FusedDrive:
        try:
            if (
                facts := _finished(self.out / job.name, job.key)
            ) is not None:  # by a worker that died before it said so
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
    """Return a hash of what a drive's results depend on: names, stamps and poses of its frames, and the function."""
    if not name or name in (".", "..") or "/" in name or "\0" in name:
        raise ValueError(f"the name of a drive becomes that of a folder, got {name!r}")
    found = hashlib.sha256(repr(fuse_drive).encode())
    for one in getattr(frames, "refs", frames):
        place = None if one.T_map_sensor is None else np.asarray(one.T_map_sensor, np.float64).tobytes()
        found.update(repr((one.name, one.sequence, one.stamp, place)).encode("utf-8", "backslashreplace"))
    return found.hexdigest()


def _finished(folder: Path, key: str) -> dict[str, Any] | None:
    """Return the facts of a drive that was fused before; None if it was not."""
    if not folder.exists():
        return None
    other = f"{folder} holds results of other frames, or by other options: remove it, or give another folder"
    try:
        note = json.loads((folder / _NOTE).read_text())
        if note["format"] == _FORMAT and note["key"] == key:
            return dict(note["facts"])
    except FileNotFoundError:
        other = f"{folder} is no drive that was fused here: remove it, or give another folder"
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        other = f"{folder / _NOTE} cannot be read ({error}): remove {folder}, and the drive is fused again"
    raise OgmError(other)
