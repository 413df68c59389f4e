"""Make data sets: shards that are independent of each other, on one core or on many with Dask."""

import errno
import logging
import os
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from ogm.simulation.plan import Plan, moment
from ogm.simulation.sample import Beams, Sample
from ogm.simulation.store import SHARD, Store

__all__ = ["Estimate", "Job", "Made", "begin", "check_workers", "jobs", "make", "workers_that_fit"]

MEMORY = 1.5e9  # [byte] that one worker takes, with its town
PATIENCE = 20.0  # [s] until a scheduler that does not answer is given up
_QUIET = logging.CRITICAL + 1

SampleFunction = Callable[[Plan, str, int], Sample]


class Job(NamedTuple):
    """One shard to be made."""

    split: str
    shard: int
    samples: int


class Made(NamedTuple):
    """One shard that is on disk; seconds on one worker, bytes of its files."""

    job: Job
    seconds: float
    size: int


class Estimate(NamedTuple):
    """What making the rest of a data set will take.

    Attributes
    ----------
    samples : int
        To be made.
    seconds : float
        On all workers together, from now on.
    size : float
        [byte]
    per_sample : float
        Seconds on one worker, measured.
    workers : int
        That will make them.
    """

    samples: int
    seconds: float
    size: float
    per_sample: float
    workers: int


def begin(
    path: str | os.PathLike[str], plan: Plan, beams: Sequence[Beams], versions: dict[str, str]
) -> Store:
    """Begin a data set, or open one that was begun by the same plan, to go on with it.

    Whatever a killed run left half written is removed. Where other versions of libraries go on, the data set
    names all that made it.

    Raises
    ------
    ValueError
        If the folder holds something else, or the data set was begun by another plan.
    """
    path = Path(path)
    if Store.exists(path):
        before = Store.open(path)
        plan = plan.grown(Plan.from_dict(before.plan))
        versions = {name: _added(before.versions.get(name), one) for name, one in versions.items()}
    store = Store.create(path, plan.as_dict(), plan.counts, beams, versions)
    store.sweep()
    return store


def _added(before: str | None, version: str) -> str:
    """Return the versions that made a data set so far, and this one."""
    if before is None or version in before.split(", "):
        return before or version
    return f"{before}, {version}"


def jobs(store: Store) -> list[Job]:
    """Say which shards are still to be made, those of one town after each other."""
    plan = Plan.from_dict(store.plan)
    todo = []
    for name in ("training", "validation", "sequences", "test"):
        split = store[name]
        made = split.facts[:, 0] > 0
        for shard in range(-(-len(split) // SHARD)):
            part = made[shard * SHARD : (shard + 1) * SHARD]
            if not part.all():
                todo.append(Job(name, shard, len(part)))
    towns = [moment(plan, job.split, job.shard * SHARD).town for job in todo]
    order = {town: k for k, town in enumerate(dict.fromkeys(towns))}
    return [job for _, job in sorted(zip(towns, todo, strict=True), key=lambda pair: order[pair[0]])]


def workers_that_fit() -> int:
    """Return how many workers this machine's cores and memory allow."""
    try:
        memory = float(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (ValueError, OSError):
        memory = 8e9
    return max(1, min(len(os.sched_getaffinity(0)), int(memory / MEMORY)))


def check_workers(workers: int) -> int:
    """Return the number, or raise ValueError where it is none that makes sense on this machine."""
    most = 64 * len(os.sched_getaffinity(0))
    if not 1 <= workers <= most:
        raise ValueError(f"workers must be in 1 ... {most} on this machine, got {workers}")
    return workers


def make(
    store: Store,
    plan: Plan,
    function: SampleFunction,
    prepare: Callable[[int], None],
    *,
    workers: int,
    scheduler: str | None = None,
) -> Generator[Estimate | Made, None, None]:
    """Make all shards that are missing: yields one `Estimate`, then each shard as it reaches the disk.

    Workers write their shards themselves, so they must see the folder under the same path. The bytes depend on
    the plan only, not on the number of workers nor on who makes which shard.

    Parameters
    ----------
    store : Store
        From `begin`.
    plan : Plan
    function : callable
        ``function(plan, split, index)`` makes one sample: `ogm.simulation.dataset.sample`.
    prepare : callable
        Told in each worker how many cores its samples may use:
        `ogm.simulation.dataset.threads_per_sample`.
    workers : int
        1 works in this process, without Dask; more start processes on this machine (and a script that calls
        this must guard its own code by ``if __name__ == "__main__":``).
    scheduler : str, optional
        Address of a Dask scheduler to use instead, ``"tcp://host:port"``.

    Raises
    ------
    OSError
        If the disk is full or will be, a worker died three times over, or the scheduler cannot be reached.
        Shards that were yielded are whole.
    """
    todo = jobs(store)
    if not todo:
        return
    check_workers(workers)
    cores = len(os.sched_getaffinity(0))
    work = _Work(store.path, plan, function, prepare, max(1, cores // workers))
    with _told(store):
        if workers == 1 and scheduler is None:
            yield _estimate([work.measure(todo[0])], todo, 1, store)
            for job in todo:
                yield work(job)
        else:
            yield from _with_dask(work, todo, store, workers, scheduler)


class _Work:
    """What a worker does; travels to it, so it holds no state but its task."""

    def __init__(
        self, path: Path, plan: Plan, function: SampleFunction, prepare: Callable[[int], None], threads: int
    ) -> None:
        self.path, self.plan, self.function = path.resolve(), plan, function
        self.prepare, self.threads = prepare, threads

    def __call__(self, job: Job) -> Made:
        """Make a shard and write it."""
        with _one_at_a_time:
            start = time.perf_counter()
            self.prepare(self.threads)
            first = job.shard * SHARD
            samples = [self.function(self.plan, job.split, first + k) for k in range(job.samples)]
            size = Store.open(self.path).write(job.split, job.shard, samples)
            return Made(job, time.perf_counter() - start, size)

    def measure(self, job: Job) -> tuple[float, float]:
        """Return the seconds and bytes of a sample, once its town stands and the kernels are compiled."""
        with _one_at_a_time:
            self.prepare(self.threads)
            store, first = Store.open(self.path), job.shard * SHARD
            self.function(self.plan, job.split, first)
            start = time.perf_counter()
            sample = self.function(self.plan, job.split, first)
            seconds = time.perf_counter() - start
            with tempfile.TemporaryDirectory() as folder:
                trial = Store.create(Path(folder) / "trial", {}, {job.split: first + 1}, store.beams, {})
                size = trial.write(job.split, job.shard, [sample])
            return seconds, size * _mean_rays(self.plan, store.beams) / sample.steps.size


_one_at_a_time = threading.Lock()  # a worker with several threads still has one town


def _mean_rays(plan: Plan, beams: Sequence[Beams]) -> float:
    """Return the rays of a mean sample of the plan."""
    rays = {one.name: one.shape[0] * one.shape[1] for one in beams}
    total = sum(mount.share for mount in plan.mounts)
    return sum(mount.share * rays[mount.lidar] for mount in plan.mounts) / total


def _estimate(measured: list[tuple[float, float]], todo: list[Job], workers: int, store: Store) -> Estimate:
    """Say what is to come, and refuse to begin what will not fit on the disk."""
    count = sum(job.samples for job in todo)
    seconds = sum(one for one, _ in measured) / len(measured)
    size = count * sum(one for _, one in measured) / len(measured)
    left = shutil.disk_usage(store.path).free
    if size > left:
        raise OSError(
            f"{count} samples need about {size / 1e9:.2f} GB, {store.path} has {left / 1e9:.2f} GB left; "
            "free some, or ask for fewer samples"
        )
    return Estimate(count, count * seconds / workers, size, seconds, workers)


def _with_dask(
    work: _Work, todo: list[Job], store: Store, workers: int, scheduler: str | None
) -> Generator[Estimate | Made, None, None]:
    """Hand the shards out, a few more than there are workers at a time, so that towns come one by one."""
    from distributed import as_completed

    with _client(workers, scheduler) as client:
        crew = list(client.ncores())
        if not crew:
            raise OSError(
                f"the scheduler {scheduler} has no workers; start some with `dask worker {scheduler}`"
            )
        # A worker that dies comes back under another address: its trial may then be run by any.
        trials = [
            client.submit(work.measure, todo[0], workers=[one], allow_other_workers=True, pure=False)
            for one in crew
        ]
        measured = [future.result() for future in as_completed(trials, loop=client.loop)]
        yield _estimate(measured, todo, len(crew), store)
        queue = iter(todo)
        ahead = [job for _, job in zip(range(2 * len(crew)), queue, strict=False)]
        running = as_completed((client.submit(work, job, pure=False) for job in ahead), loop=client.loop)
        for future in running:
            yield future.result()
            future.release()
            following = next(queue, None)
            if following is not None:
                running.add(client.submit(work, following, pure=False))


@contextmanager
def _client(workers: int, scheduler: str | None) -> Iterator[Any]:
    """Connect to a scheduler, or start workers on this machine; silent, and gone when the block is left."""
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise ImportError(
            f'several workers need Dask, which is missing ({error}): pip install "ogm-toolkit[sim]"'
        ) from error
    if scheduler is not None:
        with Client(scheduler, timeout=PATIENCE, set_as_default=False) as client:
            yield client
        return
    settings = {
        "distributed.nanny.pre-spawn-environ": {"OMP_NUM_THREADS": 1, "MALLOC_TRIM_THRESHOLD_": 65536}
    }
    # Ctrl-C waits until all processes stand, and they, who inherit the mask, leave it to this one.
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with (
            _hushed("distributed"),
            dask.config.set(settings),
            LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                dashboard_address=":0",
                silence_logs=_QUIET,
                memory_limit=0,
            ) as cluster,
            Client(cluster, set_as_default=False) as client,
        ):
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
            yield client
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@contextmanager
def _hushed(name: str) -> Iterator[None]:
    """Let a logger and those below it say nothing."""
    log = logging.getLogger(name)
    before = log.handlers, log.propagate
    log.handlers, log.propagate = [logging.NullHandler()], False
    try:
        yield
    finally:
        log.handlers, log.propagate = before


@contextmanager
def _told(store: Store) -> Iterator[None]:
    """Say what to do about what goes wrong on the way."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise OSError(
                f"the disk that holds {store.path} is full; finished shards are whole: make room, then "
                f"`ogm simulate {store.path} --resume`"
            ) from error
        raise
    except Exception as error:
        if type(error).__name__ in ("KilledWorker", "CommClosedError", "CancelledError"):
            raise OSError(
                f"workers died ({type(error).__name__}), as when memory runs out; finished shards are whole: "
                f"use fewer --workers, then `ogm simulate {store.path} --resume`"
            ) from error
        raise
