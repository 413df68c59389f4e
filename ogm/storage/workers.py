"""Where work is done beside this process: by processes of this machine, or by a Dask cluster."""

import multiprocessing.connection
import multiprocessing.resource_tracker
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from contextlib import ExitStack, contextmanager
from itertools import islice
from typing import Any

from ogm.extras import install_line

SCHEDULER_TIMEOUT = 20.0  # [s]
TRIES = 3  # times that workers are started before their deaths are an error
DIED = ("BrokenProcessPool", "KilledWorker", "CommClosedError", "CancelledError", "FutureCancelledError")
ENVIRONMENT = {"OMP_NUM_THREADS": "1"}  # of processes on this machine

Submit = Callable[[Callable[..., Any], Any], "Future[Any]"]


def work_off(
    function: Callable[[Any], Any], jobs: Sequence[Any], workers: int, scheduler: str | None = None
) -> Generator[tuple[int, Any], None, None]:
    """Yield number and result of each job as it is done: here, by processes of this machine, or by a Dask cluster.

    When a worker dies, workers are started anew for the jobs that are not done.

    Parameters
    ----------
    function : callable
        ``function(job)``; for more than one worker, it, the jobs and the results must be picklable.
    jobs : sequence
    workers : int
        1 works in this process.
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
    """Workers that do one list of jobs after another, started when there is the first job; a context manager.

    Parameters and errors: see `work_off`. When the block is left, they have ended.

    Attributes
    ----------
    count : int
        Number of workers; that of a cluster is known from the first job on.
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
        """Yield number and result of each job, as the function `work_off`; closed early, it ends the workers."""
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
                for k, result in as_completed(submit, _Numbered(function), todo, 2 * self.count):
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
    """Make errors of dead workers an OSError with the way out; `finished` is what they had finished, in words."""
    try:
        yield
    except Exception as error:
        if type(error).__name__ not in DIED:
            raise
        raise OSError(
            f"workers died ({type(error).__name__}), as when memory runs out; {finished} that were finished are kept: "
            "the same command goes on, perhaps with fewer `workers`"
        ) from error


class _Numbered:
    """A function of a job that comes with its number."""

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self.function = function

    def __call__(self, job: tuple[int, Any]) -> tuple[int, Any]:
        return job[0], self.function(job[1])


def as_completed(submit: Submit, function: Callable[[Any], Any], jobs: Sequence[Any], ahead: int) -> Iterator[Any]:
    """Yield results as they are done, a few jobs handed out at a time, so that they begin in their order."""
    later, running = iter(jobs), set[Future[Any]]()
    while True:
        running |= {submit(function, job) for job in islice(later, ahead - len(running))}
        if not running:
            return
        done, running = wait(running, return_when=FIRST_COMPLETED)
        yield from [one.result() for one in done]


@contextmanager
def cluster(scheduler: str) -> Iterator[tuple[Submit, int]]:
    """Connect to a Dask scheduler, ``"tcp://host:port"``; yield how to hand out work, and how many workers there are.

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
    """Start processes on this machine when there is work; yield how to hand it out, and how many there are.

    They are killed when the block is left by an error or an interrupt: asked to end, they would finish their work, or
    their start, first. If one of them dies, all end, and futures raise `concurrent.futures.BrokenExecutor`.
    """
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _end_with_parent)

    def submit(function: Callable[..., Any], what: Any) -> "Future[Any]":
        with _interrupt_delayed(), _environment():  # this may start a process
            return pool.submit(function, what)

    try:
        yield submit, workers
    except BaseException:
        for process in list((pool._processes or {}).values()):  # kill_workers() from Python 3.14 on
            process.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _end_with_parent() -> None:
    """End this worker when the process that started it ends, however that ends."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _environment() -> Iterator[None]:
    """Set the variables of workers for those that are started inside."""
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
    """Let SIGINT and SIGTERM take effect when the block is left; processes that are started inside ignore SIGINT.

    Blocking the signals in this thread alone would not do: another one, such as that of a progress display, may
    receive them, and then Python raises KeyboardInterrupt here all the same, in the middle of starting processes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    multiprocessing.resource_tracker.ensure_running()  # else it is started inside, and unblocks the signal then
    received: list[int] = []
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # is inherited by processes
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
