"""Where work is done beside this process: by processes of this machine, or by a Dask cluster."""

import multiprocessing.connection
import multiprocessing.resource_tracker
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

__all__ = ["Submit", "cluster", "processes"]

SCHEDULER_TIMEOUT = 20.0  # [s]
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "MALLOC_TRIM_THRESHOLD_": "65536"}  # of processes on this machine

Submit = Callable[[Callable[..., Any], Any], "Future[Any]"]


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
        text = f'a scheduler needs Dask, which is missing ({error}): pip install "ogm-toolkit[world]"'
        raise ImportError(text) from error
    with Client(scheduler, timeout=SCHEDULER_TIMEOUT, set_as_default=False) as client:
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
