"""Atomic writing for libraries that open files by name or write folders."""

import ctypes
import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ogm.storage.files import errors_with_path, replaced_path, temporary_folder

_HERE, _EXCHANGE = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux


@contextmanager
def whole_path(path: Path) -> Iterator[Path]:
    """Yield a free path on the disk of `path`; the file or folder written there is renamed to `path` at the end.

    See `ogm.storage.files.atomic_write`. An existing folder of that name is removed after it has been replaced.
    """
    target, permissions = replaced_path(path)
    with errors_with_path(path), temporary_folder(target.parent) as folder:
        temporary = folder / path.name
        yield temporary
        if permissions is not None:
            temporary.chmod(permissions)
        if temporary.is_dir():
            _replace_folder(temporary, target)
        else:
            descriptor = os.open(temporary, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
            os.replace(temporary, target)


def _replace_folder(written: Path, path: Path) -> None:
    """Rename a folder, replacing an existing folder, on Linux in one step."""
    while True:
        try:
            os.rename(written, path)
            return
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
        try:
            exchange = ctypes.CDLL(None, use_errno=True).renameat2
        except AttributeError:  # a kill between these two steps leaves the old folder under a hidden name
            os.rename(path, written.parent.with_suffix(".old"))
            os.rename(written, path)
            os.rename(written.parent.with_suffix(".old"), written)
            return
        if exchange(_HERE, os.fsencode(written), _HERE, os.fsencode(path), _EXCHANGE) == 0:
            return
        if ctypes.get_errno() != errno.ENOENT:  # ENOENT: another process has just moved it, try again
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), str(path))
