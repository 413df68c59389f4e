"""Copies of a world map as one archive."""

import zipfile
from pathlib import Path
from typing import Any

from ogm.storage.files import atomic_write
from ogm.world.stores import keys, read_object, reading
from ogm.world.writer import WRITER


def copy_to_zip(store: Any, path: Path) -> None:
    """Write all objects of a Zarr store to a new archive, which appears when it is whole."""
    with atomic_write(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        for key in keys(store, ""):
            with reading(key):
                if key != WRITER and (content := read_object(store, key)) is not None:  # else removed meanwhile
                    archive.writestr(key, content)
