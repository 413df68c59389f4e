"""Files that are either whole or not there, and the error for those that are wrong.

>>> from ogm.storage.files import atomic_write
>>> with atomic_write("notes.txt", "w") as file:     # all of it, or the old file
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
    "OF_DISK", "OgmError", "atomic_write", "error_text", "finish_zarr", "naming", "temporary_folder", "update_hint",
]  # fmt: skip

FilePath = str | os.PathLike[str]
OF_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)  # errors of a full or broken disk
_PREFIX = ".ogm-"
_swept: set[Path] = set()  # folders that this process has cleared of what killed ones left


class OgmError(ValueError):
    """Something is wrong with a file or a message that was given to the library."""


def error_text(error: BaseException) -> str:
    """Return an error as one line of text."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if isinstance(error, MemoryError) and (type(error) is not MemoryError or not error.args):
        return "out of memory: use a coarser `resolution`, a smaller grid or fewer points"
    return " ".join(str(error).split()) or type(error).__name__


@contextmanager
def atomic_write(path: str | os.PathLike[str], mode: str = "wb") -> Iterator[IO[Any]]:
    """Open a file that appears under its name only when all of it has been written.

    The bytes go to a temporary file in the same folder; the end of the ``with`` block flushes it to disk and
    renames it over `path` in one step. An error or an interrupt inside the block removes the temporary file
    and leaves the file that was at `path` before untouched. What a killed process left is removed by the next one that
    writes to the folder. A file that is replaced keeps its permissions, and a symbolic link leads to the new file. A
    folder that was removed within the block is made again.

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
        If the folder or the file cannot be written, `path` is a folder, a pipe or a device, or the disk is full.
    """
    target, permissions = replaced_path(path)
    if target.is_dir():
        raise IsADirectoryError(f"cannot write {path}: it is a folder; give a file name")
    _sweep_once(target.parent)
    with naming(target), _unnamed(target, mode) as (file, name):
        yield file
        file.flush()
        if permissions is not None:
            os.fchmod(file.fileno(), permissions)
        os.fsync(file.fileno())
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(name(), target)


def check_writable(path: FilePath, what: str) -> None:
    """Make the folder of an output; raise OSError, before any work, if the output cannot be written there."""
    try:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        target, _ = replaced_path(path)
        with tempfile.TemporaryFile(dir=target.parent):
            pass
    except OSError as error:
        raise OSError(f"{what} cannot be written into {Path(path).parent}: {error_text(error)}") from error


def replaced_path(path: FilePath) -> tuple[Path, int | None]:
    """Return the place of a file or folder that is written, and the permissions of what it replaces.

    Returns
    -------
    target : Path
        Behind symbolic links; its folder exists.
    permissions : int or None
        Bits of the mode; None if there is nothing.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    PermissionError
        If the file may not be written.
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
    """Make a folder in `parent` for what libraries write by name; it is removed in the end.

    If this process is killed, the next one that writes to `parent` removes it.
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
    """Remove a folder, all of it even when interrupted."""
    try:
        shutil.rmtree(folder, ignore_errors=True)
    except KeyboardInterrupt:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def finish_zarr() -> None:
    """Wait until Zarr has written what it began: it writes in threads of its own, which an interrupt does not stop."""
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
    """Raise errors of some kinds, by default ValueError, as `OgmError` that begins with where they happened."""
    caught = kinds or (ValueError,)
    try:
        yield
    except caught as error:
        raise OgmError(f"{where}: {error}") from error


@contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Give errors of a full or broken disk the path that is written; the system names none, or a temporary one."""
    try:
        yield
    except OSError as error:
        temporary = error.filename is None or f"{os.sep}{_PREFIX}" in f"{os.sep}{error.filename}"
        if temporary and (error.errno in OF_DISK or error.filename is not None):
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
    """Open a temporary file in a folder; give it, and a function that names it and returns the name.

    Where the system can (Linux, most file systems), the file has no name before, so that nothing of it stays when the
    process is killed.
    """
    temporary, encoding = _temporary_name(target.parent), None if "b" in mode else "utf-8"
    try:
        descriptor = os.open(target.parent, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o666)
        linked = f"/proc/self/fd/{descriptor}"
        if not os.path.exists(linked):
            os.close(descriptor)
            raise OSError(errno.ENOTSUP, os.strerror(errno.ENOTSUP))
    except (OSError, AttributeError):  # no such files here
        file, name = _named(temporary, mode.replace("w", "x"), encoding), lambda: temporary
    else:
        file = open(descriptor, mode, encoding=encoding)  # noqa: SIM115
        try_lock(descriptor)

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


def _named(temporary: Path, mode: str, encoding: str | None) -> IO[Any]:
    """Open a new file and lock it, so that no other process sweeps it."""
    while True:
        file = open(temporary, mode, encoding=encoding)  # noqa: SIM115
        if try_lock(file.fileno()) is not False and temporary.exists():
            return file
        file.close()
        temporary.unlink(missing_ok=True)
