"""Files and folders that libraries write by name and that are either whole or not there."""

import ctypes
import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ogm.storage.files import naming, replaced_path, temporary_folder

_HERE, _EXCHANGE = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux


@contextmanager
def whole_path(path: Path) -> Iterator[Path]:
    """Give a free path on the disk of `path`; what was written there gets the name `path` in the end.

    See `ogm.storage.files.atomic_write`; for libraries that open their file by name or write a folder. A folder that
    has the name already is removed when the new one is in its place.
    """
    target, permissions = replaced_path(path)
    with naming(path), temporary_folder(target.parent) as folder:
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
    """Give a folder its name. One that has it already takes the other's, on Linux in the same step."""
    while True:
        try:
            os.rename(written, path)
            return
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
        try:
            exchange = ctypes.CDLL(None, use_errno=True).renameat2
        except AttributeError:  # a kill between these two steps leaves the folder beside, under a hidden name
            os.rename(path, written.parent.with_suffix(".old"))
            os.rename(written, path)
            os.rename(written.parent.with_suffix(".old"), written)
            return
        if exchange(_HERE, os.fsencode(written), _HERE, os.fsencode(path), _EXCHANGE) == 0:
            return
        if ctypes.get_errno() != errno.ENOENT:  # which is that another process has just moved it: again
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), str(path))
