"""Creation of dataset shards: in this process, in worker processes, or on a Dask cluster."""

import errno
import os
import shutil
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ogm.simulation.plan import DatasetPlan, moment
from ogm.simulation.sample import Beams, SimulatedSample
from ogm.simulation.store import SHARD, Damaged, Store
from ogm.storage.files import FilePath, finish_zarr, temporary_folder
from ogm.storage.locks import sweep
from ogm.storage.workers import DEATH_ERRORS, Workers

MEMORY = 1.5e9  # [byte] used by one worker with its town

SampleFunction = Callable[[DatasetPlan, str, int, int], SimulatedSample]


class Job(NamedTuple):
    """A shard to be made."""

    split: str
    shard: int
    samples: int


class Made(NamedTuple):
    """A finished shard with its seconds on one worker and the size of its files [byte]."""

    job: Job
    seconds: float
    size: int


class Estimate(NamedTuple):
    """Estimated cost of the missing samples: their number, total time [s] and size [byte], and seconds per sample.

    `per_sample` is the time on one worker. `seconds` includes `start_up`, in which towns are built and kernels
    compiled.
    """

    samples: int
    seconds: float
    size: float
    per_sample: float
    workers: int
    start_up: float = 0.0

    def __str__(self) -> str:
        minutes = self.seconds / 60
        hours = f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:.1f} h"
        time = f"{self.seconds:.0f} s" if minutes < 2 else hours
        start = f"{self.start_up:.0f} s to start, " if self.start_up >= 1 else ""
        size = f"{self.size / 1e6:.0f} MB ({self.size / self.samples / 1e3:.0f} kB each)"
        return (
            f"{self.samples} samples: about {time} with {self.workers} worker{'s' if self.workers > 1 else ''} "
            f"({start}{self.per_sample:.2f} s each), {size}"
        )


def begin(path: FilePath, plan: DatasetPlan, beams: Sequence[Beams], versions: dict[str, str]) -> Store:
    """Create a dataset, or open one with the same plan to continue it.

    Incomplete files of a killed run are removed. If the library versions changed, the dataset lists all versions that
    made it.

    Raises
    ------
    ValueError
        If the folder holds anything else, or the dataset has another plan.
    """
    path = Path(path)
    if Store.exists(path):
        before = Store.open(path)
        plan = plan.grown(DatasetPlan.from_dict(before.plan))
        made_by = {
            name: [*before.versions.get(name, version).split(", "), version] for name, version in versions.items()
        }
        versions = {name: ", ".join(dict.fromkeys(several)) for name, several in made_by.items()}
    store = Store.create(path, asdict(plan), plan.counts, beams, versions)
    _sweep(path)
    return store


@contextmanager
def swept(folder: Path, *, alone: bool) -> Iterator[None]:
    """Remove temporary files after an error or interrupt; `alone` states that no other process is writing."""
    try:
        yield
    except BaseException:
        finish_zarr()
        if alone and (folder / "zarr.json").exists():
            _sweep(folder)
        raise


def _sweep(folder: Path) -> None:
    """Remove files of killed writers. No process may be writing."""
    for path in [*folder.rglob("*.partial")]:
        path.unlink(missing_ok=True)
    sweep(folder)


def missing_shards(store: Store) -> list[Job]:
    """Return the shards still to be made, grouped by town.

    Raises
    ------
    Damaged
        If finished samples are damaged. All finished samples are read.
    """
    plan = DatasetPlan.from_dict(store.plan)
    if damaged := [(name, i, error) for name in store.counts for i, error in store[name].damage()]:
        others = ", ".join(f"sample {i} of {name}" for name, i, _ in damaged[1:20])
        raise Damaged(f"{damaged[0][2]}" + (f"; {len(damaged) - 1} more are damaged: {others}" if others else ""))
    todo: list[Job] = []
    for name in ("training", "validation", "sequences", "test"):
        made = store[name].facts[:, 0] > 0
        parts = np.split(made, range(SHARD, len(made), SHARD))
        todo += [Job(name, shard, len(part)) for shard, part in enumerate(parts) if not part.all()]
    towns = [moment(plan, job.split, job.shard * SHARD).town for job in todo]
    order = {town: k for k, town in enumerate(dict.fromkeys(towns))}
    return [job for _, job in sorted(zip(towns, todo, strict=True), key=lambda pair: order[pair[0]])]


def workers_that_fit() -> int:
    """Return the number of workers that fit this machine's cores and memory."""
    memory = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return max(1, min(len(os.sched_getaffinity(0)), int(memory / MEMORY)))


def check_workers(workers: int) -> int:
    """Return the number of cores; raise ValueError for a number of workers out of range."""
    cores = len(os.sched_getaffinity(0))
    if not 1 <= workers <= 64 * cores:
        raise ValueError(f"workers must be in 1 ... {64 * cores} on this machine, got {workers}")
    return cores


def make_shards(
    store: Store, plan: DatasetPlan, function: SampleFunction, *, workers: int, scheduler: str | None = None
) -> Generator[Estimate | Made, None, None]:
    """Make all missing shards; yield an `Estimate`, then each finished shard.

    Workers write their shards themselves, so they must see the folder under the same path. The bytes depend on the plan
    only, not on the number or order of workers.

    Parameters
    ----------
    store : Store
        Dataset from `begin`.
    plan : DatasetPlan
    function : callable
        ``function(plan, split, index, threads)`` makes one sample with that number of processor cores; see
        `ogm.simulation.dataset.make_sample`.
    workers : int
        1 works in this process; larger numbers start processes on this machine. A script that calls this must then
        guard its own code by ``if __name__ == "__main__":``.
    scheduler : str, optional
        Address of a Dask scheduler to use instead, ``"tcp://host:port"``.

    Raises
    ------
    OSError
        If the disk is or would become full, workers died three times, or the scheduler cannot be reached. Yielded
        shards are complete.
    """
    cores = check_workers(workers)
    if not (todo := missing_shards(store)):
        return
    work = _Work(store.path.resolve(), plan, function, max(1, cores // workers))
    with _explained(store), Workers(workers, scheduler) as pool:
        (_, measured), *_ = pool.work_off(work.measure, todo[:1])
        yield _estimate(measured, todo, pool.count, store, _further_towns(plan, todo))
        yield from (made for _, made in pool.work_off(work.make, todo))


class _Work(NamedTuple):
    """The task of a worker."""

    path: Path
    plan: DatasetPlan
    function: SampleFunction
    threads: int

    def make(self, job: Job) -> Made:
        """Make and write a shard."""
        with _one_at_a_time:
            start = time.perf_counter()
            first = job.shard * SHARD
            samples = [self._sample(job, first + k) for k in range(job.samples)]
            size = Store.open(self.path).write(job.split, job.shard, samples)
            return Made(job, time.perf_counter() - start, size)

    def measure(self, job: Job) -> tuple[float, float, float]:
        """Return seconds and bytes per sample, and the seconds of start-up: building a town, compiling kernels."""
        with _one_at_a_time:
            beams, first = Store.open(self.path).beams, job.shard * SHARD
            times = [time.perf_counter()]
            for _ in range(2):
                sample = self._sample(job, first)
                times.append(time.perf_counter())
            begun, seconds = np.diff(times).tolist()
            with temporary_folder(self.path) as folder:
                trial = Store.create(folder, asdict(self.plan), {job.split: first + 1}, beams, {})
                size = trial.write(job.split, job.shard, [sample])
            rays = {lidar.name: lidar.shape[0] * lidar.shape[1] for lidar in beams}
            shares = [mount.share for mount in self.plan.mounts]
            mean = np.average([rays[mount.lidar] for mount in self.plan.mounts], weights=shares)
            return seconds, size * float(mean) / sample.steps.size, max(begun - seconds, 0.0)

    def _sample(self, job: Job, index: int) -> SimulatedSample:
        return self.function(self.plan, job.split, index, self.threads)


_one_at_a_time = threading.Lock()  # the threads of a worker share one town


def _further_towns(plan: DatasetPlan, todo: list[Job]) -> int:
    """Return the number of towns to build after the first sample's town."""
    splits = {job.split for job in todo}
    return (plan.towns if splits - {"test"} else 0) + (plan.test_towns if "test" in splits else 0) - 1


def _estimate(
    measured: tuple[float, float, float], todo: list[Job], workers: int, store: Store, further_towns: int
) -> Estimate:
    """Return the estimate; raise OSError if the samples will not fit on the disk."""
    count = sum(job.samples for job in todo)
    start_up = measured[2] * ((min(workers, len(todo)) > 1) + further_towns)  # the first worker has already started
    seconds, size = measured[0], count * measured[1]
    left = shutil.disk_usage(store.path).free
    if size > left:
        need = f"{count} samples need about {size / 1e6:,.1f} MB, but only {left / 1e6:,.1f} MB are free"
        raise OSError(errno.ENOSPC, f"{need}; free disk space, or make fewer samples", str(store.path))
    return Estimate(count, start_up + count * seconds / workers, size, seconds, workers, start_up)


@contextmanager
def _explained(store: Store) -> Iterator[None]:
    """Add the remedy to errors of full disks and dead workers."""
    try:
        yield
    except Exception as error:
        number = getattr(error, "errno", None)
        if getattr(error, "filename", None) == str(store.path):  # has its own message
            raise
        if number in (errno.ENOSPC, errno.EDQUOT):
            problem, way = "the disk is full", "free disk space"
        elif type(error).__name__ in DEATH_ERRORS:
            problem, way = f"workers died ({type(error).__name__}), as when memory runs out", "use fewer `workers`"
        else:
            raise
        way += f", then `ogm simulate {store.path} --resume`"
        text = f"{problem}; finished shards are complete: {way}"
        raise (OSError(number, text, str(store.path)) if number else OSError(text)) from error
