"""Loops divided among threads, for kernels that release the GIL."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import Self


def spans(size: int, parts: int) -> list[tuple[int, int]]:
    """Return [0, size) in parts, as first and last + 1."""
    return [(size * k // parts, size * (k + 1) // parts) for k in range(parts)]


class Threads:
    """Some threads, of which the calling one is the first; the others live as long as the context.

    Parameters
    ----------
    count : int
        At least 1.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self._pool = ThreadPoolExecutor(count - 1) if count > 1 else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._pool is not None:
            self._pool.shutdown()

    def run(self, function: Callable[[int], None]) -> None:
        """Call a function with 0, 1, ... in one thread each, and wait for all."""
        others = [self._pool.submit(function, k) for k in range(1, self.count)] if self._pool else []
        try:
            function(0)
        finally:
            for other in others:
                other.result()

    def divide(self, size: int, function: Callable[[tuple[int, int]], None]) -> None:
        """Call a function with the parts of [0, size)."""
        parts = spans(size, self.count)
        self.run(lambda k: function(parts[k]))
