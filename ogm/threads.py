"""Loops divided among threads, for kernels that release the GIL, and iteration one item ahead."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from itertools import islice
from types import TracebackType
from typing import Self, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def spans(size: int, parts: int) -> list[tuple[int, int]]:
    """Divide [0, size) into parts (first, last + 1)."""
    return [(size * k // parts, size * (k + 1) // parts) for k in range(parts)]


class Threads:
    """Pool of threads for a ``with`` block, including the calling thread.

    Parameters
    ----------
    count : int
        Number of threads, at least 1.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self._pool = ThreadPoolExecutor(count - 1) if count > 1 else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._pool is not None:
            self._pool.shutdown()

    def run(self, function: Callable[[int], Result]) -> list[Result]:
        """Call a function with 0, 1, ... in a thread each, wait for all, and return the results."""
        futures = [self._pool.submit(function, k) for k in range(1, self.count)] if self._pool else []
        try:
            first = function(0)
        finally:
            wait(futures)
        return [first, *(future.result() for future in futures)]

    def divide(self, size: int, function: Callable[[tuple[int, int]], None]) -> None:
        """Call a function with each part of [0, size), a part per thread."""
        parts = spans(size, self.count)
        self.run(lambda k: function(parts[k]))


@cache
def shared_threads(count: int) -> Threads:
    """Return threads that live as long as the process, because the start of a thread takes up to milliseconds."""
    return Threads(count)


if hasattr(os, "register_at_fork"):  # a child process has no threads of its parent
    os.register_at_fork(after_in_child=shared_threads.cache_clear)


def one_ahead(items: Iterable[Item]) -> Iterator[Item]:
    """Yield items in order, while another thread takes the next one from the iterable.

    An error of the iterable is raised after the items before it. Closing the iterator waits for the thread.
    """
    iterator = iter(items)
    with ThreadPoolExecutor(1, "ogm-ahead") as pool:
        coming = pool.submit(lambda: list(islice(iterator, 1)))  # empty at the end
        while item := coming.result():
            coming = pool.submit(lambda: list(islice(iterator, 1)))
            yield from item
