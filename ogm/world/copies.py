"""Copies of a world map as one archive."""

import zipfile
from pathlib import Path
from typing import Any

from ogm.files import atomic_write
from ogm.world.stores import keys, reading

__all__ = ["copy_to_zip"]


def copy_to_zip(store: Any, path: Path) -> None:
    """Write all objects of a Zarr store to a new archive, which appears when it is whole."""
    from zarr.core.buffer import default_buffer_prototype
    from zarr.core.sync import sync

    with atomic_write(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        for key in keys(store, ""):
            with reading(key):
                archive.writestr(key, sync(store.get(key, default_buffer_prototype())).to_bytes())
