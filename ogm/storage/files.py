"""Atomic writing of files, temporary folders, and `OgmError`, the error of the library for bad files.

>>> from ogm.storage.files import atomic_write
>>> with atomic_write("notes.txt", "w") as file:     # the complete new file, or the old one
...     _ = file.write("whole")
"""

import contextlib
import errno
import os
import re
import secrets
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from ogm.storage.locks import locked, sweep, try_lock

__all__ = [
    "DISK_ERRORS", "OgmError", "atomic_write", "error_text", "errors_with_path", "finish_zarr", "temporary_folder",
    "update_hint",
]  # fmt: skip

FilePath = str | os.PathLike[str]
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)  # a full or broken disk
_PREFIX = ".ogm-"
_swept: set[Path] = set()  # folders in which this process has removed leftovers of killed processes


class OgmError(ValueError):
    """Error of a file or message given to the library."""


def error_text(error: BaseException) -> str:
    """Return an error as a single line of text."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if isinstance(error, MemoryError) and (type(error) is not MemoryError or not error.args):
        return "out of memory: use a coarser `resolution`, a smaller grid or fewer points"
    return " ".join(str(error).split()) or type(error).__name__


@contextmanager
def atomic_write(path: str | os.PathLike[str], mode: str = "wb") -> Iterator[IO[Any]]:
    """Open a file that appears under its name only when it is complete.

    The bytes go to a temporary file in the same folder. The end of the ``with`` block flushes it to disk and renames
    it to `path` in one step. An error or an interrupt inside the block removes the temporary file and leaves a file
    that was at `path` untouched. Leftovers of a killed process are removed by the next process that writes to the
    folder. A replaced file keeps its permissions, and a symbolic link then leads to the new file. A folder that was
    removed during the block is created again.

    Parameters
    ----------
    path : path
        File to write. Its folder must exist.
    mode : {"wb", "w"}
        Binary or text (UTF-8).

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    OSError
        If the folder or the file cannot be written, `path` is a folder, a pipe or a device, or the disk is full.
    """
    target, permissions = replaced_path(path)
    if target.is_dir():
        raise IsADirectoryError(f"cannot write {path}: it is a folder; give a file name")
    _sweep_once(target.parent)
    with errors_with_path(target), _unnamed(target, mode) as (file, name):
        yield file
        file.flush()
        if permissions is not None:
            os.fchmod(file.fileno(), permissions)
        os.fsync(file.fileno())
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(name(), target)


def check_writable(path: FilePath, output: str) -> None:
    """Create the folder of an output, named for the error; raise OSError before any work if it is not writable."""
    try:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        target, _ = replaced_path(path)
        with tempfile.TemporaryFile(dir=target.parent):
            pass
    except OSError as error:
        raise OSError(f"{output} cannot be written into {Path(path).parent}: {error_text(error)}") from error


def replaced_path(path: FilePath) -> tuple[Path, int | None]:
    """Return the target of a write and the permissions of the existing file or folder.

    Returns
    -------
    target : Path
        Path with symbolic links resolved; its folder exists.
    permissions : int or None
        Mode bits; None if nothing exists at the path.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    PermissionError
        If the file is write-protected.
    FileExistsError
        If a pipe or a device has the name.
    """
    target = Path(os.path.realpath(path)) if os.path.islink(path) else Path(path)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: there is no folder {target.parent}; create it first")
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        return target, None
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise FileExistsError(f"cannot write {path}: it is a pipe or a device, wanted a file; give another name")
    if not os.access(target, os.W_OK):
        raise PermissionError(errno.EACCES, "it is write-protected: give another name, or change its mode", str(path))
    return target, stat.S_IMODE(mode)


@contextmanager
def temporary_folder(parent: Path) -> Iterator[Path]:
    """Create a folder in `parent` for libraries that write by name; it is removed at the end.

    If this process is killed, the next process that writes to `parent` removes it.
    """
    _sweep_once(parent)
    with contextlib.ExitStack() as stack:
        while True:
            folder = _temporary_name(parent)
            stack.callback(_remove, folder)
            folder.mkdir()
            with contextlib.suppress(FileNotFoundError, BlockingIOError):  # another process sweeps it
                stack.enter_context(locked(folder))
                if folder.exists():
                    break
        stack.callback(finish_zarr)
        yield folder


def _remove(folder: Path) -> None:
    """Remove a folder completely, even when interrupted."""
    try:
        shutil.rmtree(folder, ignore_errors=True)
    except KeyboardInterrupt:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def finish_zarr() -> None:
    """Wait for Zarr's pending writes: they run in threads, which an interrupt does not stop."""
    zarr = sys.modules.get("zarr.core.sync")
    if zarr is None or zarr.loop[0] is None:
        return
    import asyncio

    async def others() -> None:
        if tasks := asyncio.all_tasks() - {asyncio.current_task()}:
            await asyncio.wait(tasks)

    zarr.sync(others())


@contextmanager
def error_context(where: object, *kinds: type[Exception]) -> Iterator[None]:
    """Raise errors of the given kinds, by default ValueError, as `OgmError` with their place in front."""
    caught = kinds or (ValueError,)
    try:
        yield
    except caught as error:
        raise OgmError(f"{where}: {error}") from error


@contextmanager
def errors_with_path(path: str | os.PathLike[str]) -> Iterator[None]:
    """Give disk errors the path that is written; the system names no file, or a temporary one."""
    try:
        yield
    except OSError as error:
        temporary = error.filename is None or f"{os.sep}{_PREFIX}" in f"{os.sep}{error.filename}"
        if temporary and (error.errno in DISK_ERRORS or error.filename is not None):
            raise type(error)(error.errno, error.strerror, str(path)) from error
        raise


def _sweep_once(folder: Path) -> None:
    folder = folder.absolute()
    if folder not in _swept:
        _swept.add(folder)
        sweep(folder)


def _temporary_name(folder: Path) -> Path:
    """Return a free name in a folder, hidden and short."""
    return folder / f"{_PREFIX}{secrets.token_hex(8)}.tmp"


@contextmanager
def _unnamed(target: Path, mode: str) -> Iterator[tuple[IO[Any], Callable[[], Path]]]:
    """Open a temporary file in a folder; yield it, and a function that gives it a name and returns the name.

    On Linux and most file systems the file has no name until then, so a killed process leaves nothing behind.
    """
    temporary, encoding = _temporary_name(target.parent), None if "b" in mode else "utf-8"
    try:
        descriptor = os.open(target.parent, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o666)
        linked = f"/proc/self/fd/{descriptor}"
        if not os.path.exists(linked):
            os.close(descriptor)
            raise OSError(errno.ENOTSUP, os.strerror(errno.ENOTSUP))
    except (OSError, AttributeError):  # no unnamed files on this system
        file, name = _named(temporary, mode.replace("w", "x"), encoding), lambda: temporary
    else:
        file = open(descriptor, mode, encoding=encoding)  # noqa: SIM115
        try_lock(descriptor)

        def name() -> Path:
            os.link(linked, temporary, src_dir_fd=descriptor, follow_symlinks=True)  # src_dir_fd: Python follows links
            return temporary

    try:
        with file:
            yield file, name
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise


def update_hint(found: object, *known: str) -> str:
    """Return advice for a stated format, such as ogm.poses/2, newer than all known versions; else ""."""
    name, _, version = str(found).rpartition("/")
    versions = [int(stated.rpartition("/")[2]) for stated in known if stated.rpartition("/")[0] == name]
    if not versions or not re.fullmatch("[0-9]{1,9}", version) or int(version) <= max(versions):
        return ""
    return ": it comes from a newer release of ogm; update ogm (pip install --upgrade ogm-toolkit)"


def _named(temporary: Path, mode: str, encoding: str | None) -> IO[Any]:
    """Open a new file and lock it, so that no other process sweeps it."""
    while True:
        file = open(temporary, mode, encoding=encoding)  # noqa: SIM115
        if try_lock(file.fileno()) is not False and temporary.exists():
            return file
        file.close()
        temporary.unlink(missing_ok=True)
