"""Files and folders that libraries write by name and that are either whole or not there; reasons of their errors."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ogm.files import naming, temporary_name

__all__ = ["reason", "whole_path"]


@contextmanager
def whole_path(path: Path) -> Iterator[Path]:
    """Give a free name in the folder of `path`; what was written there gets the name `path` in the end.

    As `ogm.files.atomic_write`, for libraries that open their file by name or write a folder. A folder that has the
    name already is put aside, and removed when the new one is in its place.
    """
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: there is no folder {path.parent}; create it first")
    temporary, old = (temporary_name(path, f".{what}{path.suffix}") for what in ("tmp", "old"))
    try:
        with naming(path):
            yield temporary
            if temporary.is_dir():
                if path.is_dir():
                    os.replace(path, old)
            else:
                with open(temporary, "rb") as file:
                    os.fsync(file.fileno())
            os.replace(temporary, path)
            shutil.rmtree(old, ignore_errors=True)
    except BaseException:
        if temporary.is_dir():
            shutil.rmtree(temporary, ignore_errors=True)
        temporary.unlink(missing_ok=True)
        if old.exists():
            os.replace(old, path)
        raise


def reason(error: BaseException, path: Path) -> str:
    """Return the text of a library's error without the path, which ours begins with."""
    return str(error).replace(str(path), "it").replace(f"{path.name}: ", "") or type(error).__name__
