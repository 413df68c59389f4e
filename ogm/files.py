"""Files that are either whole or not there, and the error for those that are wrong."""

import contextlib
import errno
import os
import re
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

__all__ = ["OgmError", "atomic_write", "naming", "temporary_name", "update_hint"]

_OF_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)


class OgmError(ValueError):
    """Something is wrong with a file or a message that was given to the library."""


@contextmanager
def atomic_write(path: str | os.PathLike[str], mode: str = "wb") -> Iterator[IO]:
    """Open a file that appears under its name only when all of it has been written.

    The bytes go to a temporary file in the same folder; the end of the ``with`` block flushes it to disk and
    renames it over `path` in one step. An error or an interrupt inside the block removes the temporary file
    and leaves the file that was at `path` before untouched.

    Parameters
    ----------
    path : path
        The file to write. Its folder must exist.
    mode : {"wb", "w"}
        Binary or text (UTF-8).

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    OSError
        If the folder cannot be written or the disk is full.
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"cannot write {target}: there is no folder {target.parent}; create it first")
    if target.is_dir():
        raise IsADirectoryError(f"cannot write {target}: it is a folder; give a file name")
    with naming(target), _unnamed(target, mode) as (file, name):
        yield file
        file.flush()
        os.fsync(file.fileno())
        os.replace(name(), target)


@contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Give errors of a full or broken disk the path that is written; the system names none, or a temporary one."""
    try:
        yield
    except OSError as error:
        temporary = error.filename is None or os.path.basename(str(error.filename)).startswith(_PREFIX)
        if temporary and (error.errno in _OF_DISK or error.filename is not None):
            raise type(error)(error.errno, error.strerror, str(path)) from error
        raise


def temporary_name(path: Path, ending: str = ".tmp") -> Path:
    """Return a free name in the folder of a path, hidden, short whatever the path's name is."""
    return path.with_name(f"{_PREFIX}{secrets.token_hex(8)}{ending}")


_PREFIX = ".ogm-"


@contextmanager
def _unnamed(target: Path, mode: str) -> Iterator[tuple[IO, Callable[[], Path]]]:
    """Open a temporary file in a folder; give it, and a function that names it and returns the name.

    Where the system can (Linux, most file systems), the file has no name before, so that nothing of it stays when the
    process is killed.
    """
    temporary, encoding = temporary_name(target), None if "b" in mode else "utf-8"
    try:
        descriptor = os.open(target.parent, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o666)
        linked = f"/proc/self/fd/{descriptor}"
        if not os.path.exists(linked):
            os.close(descriptor)
            raise OSError(errno.ENOTSUP, os.strerror(errno.ENOTSUP))
    except (OSError, AttributeError):  # no such files here
        file, name = open(temporary, mode.replace("w", "x"), encoding=encoding), lambda: temporary  # noqa: SIM115
    else:
        file = open(descriptor, mode, encoding=encoding)  # noqa: SIM115

        def name() -> Path:
            os.link(linked, temporary, src_dir_fd=descriptor, follow_symlinks=True)  # with it, Python follows the link
            return temporary

    try:
        with file:
            yield file, name
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise


def update_hint(found: object, *known: str) -> str:
    """Return what to do about a stated format, such as ogm.poses/2, that is newer than all known ones; else ""."""
    name, _, version = str(found).rpartition("/")
    versions = [int(one.rpartition("/")[2]) for one in known if one.rpartition("/")[0] == name]
    if not versions or not re.fullmatch("[0-9]{1,9}", version) or int(version) <= max(versions):
        return ""
    return ": it comes from a newer release of ogm; update ogm (pip install --upgrade ogm-toolkit)"
