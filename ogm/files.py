"""Files that are either whole or not there, and the error for those that are wrong."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

__all__ = ["OgmError", "atomic_write"]


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
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}.tmp")
    try:
        with open(temporary, mode.replace("w", "x"), encoding=None if "b" in mode else "utf-8") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
