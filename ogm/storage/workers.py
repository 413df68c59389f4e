"""Worker processes on this machine, or of a Dask cluster."""

import multiprocessing.connection
import multiprocessing.resource_tracker
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import islice
from typing import Any

from ogm.extras import install_line

SCHEDULER_TIMEOUT = 20.0  # [s]
TRIES = 3  # starts of workers before their deaths are an error
DEATH_ERRORS = ("BrokenProcessPool", "KilledWorker", "CommClosedError", "CancelledError", "FutureCancelledError")
ENVIRONMENT = {"OMP_NUM_THREADS": "1"}  # of worker processes on this machine

Submit = Callable[[Callable[..., Any], Any], "Future[Any]"]


def work_off(
    function: Callable[[Any], Any], jobs: Sequence[Any], workers: int, scheduler: str | None = None
) -> Generator[tuple[int, Any], None, None]:
    """Yield number and result of each finished job, from this process, local workers, or a Dask cluster.

    When a worker dies, new workers are started for the unfinished jobs.

    Parameters
    ----------
    function : callable
        ``function(job)``. With more than one worker, the function, jobs and results must be picklable.
    jobs : sequence
    workers : int
        Number of processes; 1 works in this process.
    scheduler : str, optional
        Address of a Dask scheduler to use instead, ``"tcp://host:port"``.

    Raises
    ------
    BrokenExecutor
        If workers died `TRIES` times.
    OSError
        If the scheduler cannot be reached.
    """
    with Workers(workers, scheduler) as pool:
        yield from pool.work_off(function, jobs)


class Workers:
    """Workers for several lists of jobs, started by the first job; a context manager.

    Parameters and errors: see `work_off`. The workers have ended when the block is left.

    Attributes
    ----------
    count : int
        Number of workers; for a cluster, known once the first job is submitted.
    """

    def __init__(self, workers: int, scheduler: str | None = None) -> None:
        self.workers, self.scheduler, self.count = workers, scheduler, workers
        self._running = ExitStack()
        self._submit: tuple[Submit, int] | None = None

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *error: Any) -> None:
        self._running.__exit__(*error)

    def work_off(self, function: Callable[[Any], Any], jobs: Sequence[Any]) -> Generator[tuple[int, Any], None, None]:
        """Yield number and result of each job, see the function `work_off`; closing it early ends the workers."""
        if self.workers == 1 and self.scheduler is None:
            yield from ((k, function(job)) for k, job in enumerate(jobs))
            return
        done: set[int] = set()
        for again in reversed(range(TRIES)):
            todo = [(k, job) for k, job in enumerate(jobs) if k not in done]
            if not todo:
                return
            try:
                if self._submit is None:
                    started = cluster(self.scheduler) if self.scheduler else processes(self.workers)
                    self._submit = self._running.enter_context(started)
                submit, self.count = self._submit
                for k, result in as_completed(submit, partial(_numbered, function), todo, 2 * self.count):
                    done.add(k)
                    yield k, result
                return
            except BaseException as error:
                self._submit = None
                self._running.__exit__(type(error), error, error.__traceback__)
                if not (isinstance(error, BrokenExecutor) and again):
                    raise


@contextmanager
def deaths_explained(finished: str) -> Iterator[None]:
    """Turn errors of dead workers into an OSError with advice; `finished` names the kept results, in plural."""
    try:
        yield
    except Exception as error:
        if type(error).__name__ not in DEATH_ERRORS:
            raise
        raise OSError(
            f"workers died ({type(error).__name__}), probably because memory ran out; finished {finished} are kept: "
            "run the same command again to resume, if necessary with fewer `workers`"
        ) from error


def _numbered(function: Callable[[Any], Any], job: tuple[int, Any]) -> tuple[int, Any]:
    """Return the number of a numbered job and its result."""
    return job[0], function(job[1])


def as_completed(submit: Submit, function: Callable[[Any], Any], jobs: Sequence[Any], ahead: int) -> Iterator[Any]:
    """Yield results in order of completion; only `ahead` jobs are submitted at a time, so they start in order."""
    later, running = iter(jobs), set[Future[Any]]()
    while True:
        running |= {submit(function, job) for job in islice(later, ahead - len(running))}
        if not running:
            return
        done, running = wait(running, return_when=FIRST_COMPLETED)
        yield from [future.result() for future in done]


@contextmanager
def cluster(scheduler: str) -> Iterator[tuple[Submit, int]]:
    """Connect to a Dask scheduler, ``"tcp://host:port"``; yield its submit function and the number of workers.

    Raises
    ------
    OSError
        If it cannot be reached, or has no workers.
    ImportError
        If Dask is missing.
    """
    try:
        from distributed import Client
    except ImportError as error:
        text = f"a scheduler needs Dask, which is missing ({error}): {install_line('world')}"
        raise ImportError(text) from error
    connect: Any = Client  # without types
    with connect(scheduler, timeout=SCHEDULER_TIMEOUT, set_as_default=False) as client:
        count = len(client.ncores())
        if not count:
            raise OSError(f"the scheduler {scheduler} has no workers; start some with `dask worker {scheduler}`")
        with client.get_executor(pure=False) as executor:
            yield executor.submit, count


@contextmanager
def processes(workers: int) -> Iterator[tuple[Submit, int]]:
    """Yield a submit function of processes on this machine, and their number; they start with the first job.

    They are killed when the block is left by an error or an interrupt: a polite request would wait for their work or
    their start. If one of them dies, all end, and futures raise `concurrent.futures.BrokenExecutor`.
    """
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _end_with_parent)

    def submit(function: Callable[..., Any], job: Any) -> "Future[Any]":
        with _interrupt_delayed(), _environment():  # this may start a process
            return pool.submit(function, job)

    try:
        yield submit, workers
    except BaseException:
        for process in list((pool._processes or {}).values()):  # kill_workers() from Python 3.14 on
            process.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _end_with_parent() -> None:
    """End this worker when its parent process ends, for any reason."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _environment() -> Iterator[None]:
    """Set the environment variables of workers while they are started."""
    before = {name: os.environ.get(name) for name in ENVIRONMENT}
    os.environ.update(ENVIRONMENT)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _interrupt_delayed() -> Iterator[None]:
    """Delay SIGINT and SIGTERM until the block is left; processes started inside ignore SIGINT.

    Blocking the signals in this thread is not enough: another thread, such as a progress display, may receive them, and
    Python would still raise KeyboardInterrupt here while processes are started.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    multiprocessing.resource_tracker.ensure_running()  # if started inside, it would unblock the signal
    received: list[int] = []
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # inherited by processes
    handled = [number for number in (signal.SIGINT, signal.SIGTERM) if callable(signal.getsignal(number))]
    before = {number: signal.signal(number, lambda got, _: received.append(got)) for number in handled}
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in before.items():
            signal.signal(number, handler)
    if received:
        signal.raise_signal(received[0])
