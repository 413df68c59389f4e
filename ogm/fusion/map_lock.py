"""The lock of a map: one thread updates it, any number of threads read it, and each sees a whole state."""

import functools
import os
import threading
import weakref
from collections.abc import Callable
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


class MapLock:
    """A lock that its owner may take again, for ``with``.

    A copy of it, by `copy`, `pickle` or a spawned process, is a lock of its own, which is free. A process forks only
    while no other thread has a lock of a map, so that the maps of the child are whole and their locks free; it waits
    for that for at most `_PATIENCE`.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        with _registry:
            _all_locks.add(self)

    def __enter__(self) -> "MapLock":
        self._lock.acquire()
        return self

    def acquire(self, timeout: float) -> bool:
        """Take the lock; return whether it was free within some time [s]."""
        return self._lock.acquire(timeout=timeout)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._lock.release()

    def __reduce__(self) -> tuple[type["MapLock"], tuple[()]]:
        return MapLock, ()


_PATIENCE = 10.0  # [s] that a fork waits for a lock: longer than any update, and two threads may wait for each other
_all_locks: "weakref.WeakSet[MapLock]" = weakref.WeakSet()
_registry = threading.Lock()  # of the set; held for so short a time that nothing waits within
_at_fork: list[MapLock] = []


def locked(method: Callable[Concatenate[Any, P], R]) -> Callable[Concatenate[Any, P], R]:
    """Return a method that has the lock of its map while it runs."""

    @functools.wraps(method)
    def with_lock(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> R:
        with self.lock:
            return method(self, *args, **kwargs)

    return with_lock


def _before_fork() -> None:
    with _registry:
        locks = list(_all_locks)
    _at_fork.extend(lock for lock in locks if lock.acquire(_PATIENCE))
    _registry.acquire()


def _after_fork() -> None:
    _registry.release()
    while _at_fork:
        _at_fork.pop().__exit__(None, None, None)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_before_fork, after_in_parent=_after_fork, after_in_child=_after_fork)
