"""Locks of folders and temporary files. The kernel frees them when their process ends, even by a kill.

They use ``flock``: on systems without it, and on file systems that refuse it, nothing is locked.
"""

import errno
import os
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


MAX_AGE = 86400.0  # [s] after which a temporary file is swept if there are no locks
_TEMPORARY = re.compile(r"\.ogm-[0-9a-f]{16}\.tmp")


@contextmanager
def locked(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Keep other processes out of a folder for the time of the ``with`` block.

    The lock is on the folder itself: no file marks it. A process forked inside the block does not hold it.

    Parameters
    ----------
    folder : path
        Existing folder that is written or resumed.

    Raises
    ------
    BlockingIOError
        If it is already locked, by this or another process.
    FileNotFoundError
        If there is no such folder.
    """
    if fcntl is None:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    _held.add(descriptor)
    try:
        if try_lock(descriptor) is False:
            text = "another process is writing to this folder: wait until it ends, or give another folder"
            raise BlockingIOError(errno.EWOULDBLOCK, text, str(folder))
        yield
    finally:
        if descriptor in _held:  # false in a process forked inside
            _held.remove(descriptor)
            os.close(descriptor)


_held: set[int] = set()


def _release_after_fork() -> None:
    """Close the locked folders in a forked process, which would hold their locks for its lifetime."""
    while _held:
        os.close(_held.pop())


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_release_after_fork)


def try_lock(descriptor: int) -> bool | None:
    """Lock an open file or folder if it is free; return success, or None if locks are not supported."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # some file systems have no locks, and network file systems have none for folders
        return None
    return True


def sweep(folder: str | os.PathLike[str]) -> None:
    """Remove temporary files that killed processes left in a folder.

    A running process holds the locks of its temporary files (`ogm.storage.files`), which stay. Without locks, files
    older than a day are removed.
    """
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in [entry for entry in entries if _TEMPORARY.fullmatch(entry.name)]:
            with suppress(OSError):
                _remove_unlocked(Path(entry.path))


def _remove_unlocked(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
    try:
        free = try_lock(descriptor)
        if free is None:
            free = time.time() - path.stat().st_mtime > MAX_AGE
        if free and path.is_dir():
            shutil.rmtree(path)
        elif free:
            path.unlink()
    finally:
        os.close(descriptor)
