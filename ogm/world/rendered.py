"""Marks of the tiles of a built map, which identify their parts, so that an interrupted build resumes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.world.layout import TILES, TileIndex, checked_array, codecs
from ogm.world.stores import read_object, reading, writing
from ogm.world.tiles import TileStore

_NAME, _SIDE = "rendered", 64  # [tiles] along a side of a chunk
_TILES_PER_WRITE = 64  # new marks after which they are written
_REPAIR = f"remove {_NAME}/, and build again: all tiles are made again"


class Rendered:
    """Marks of all tiles, `ogm.world.tasks.fingerprint`; 0 for tiles that were not made.

    New marks are written from time to time, and at the end of a ``with`` block. A tile without a written mark is made
    again, with the same result.
    """

    def __init__(self, store: TileStore) -> None:
        self._store, self._subject = store, f"the marks of tiles of {store.url}"
        wanted: dict[str, Any] = {"shape": (TILES, TILES), "chunks": (_SIDE, _SIDE), "dtype": "uint64"}
        with reading(self._subject, _REPAIR):
            self._array: Any = None
            if read_object(store.store, f"{store.prefix}{_NAME}/zarr.json") is not None:
                self._array = checked_array(store.root[_NAME], **wanted)
        if self._array is None:
            with writing(store.url, self._subject):
                store.check_writer()
                self._array = store.root.create_array(_NAME, **wanted, **codecs(1))
        self._chunks: dict[TileIndex, NDArray[np.uint64]] = {}
        self._noted: dict[TileIndex, int] = {}

    def mark(self, index: TileIndex) -> np.uint64:
        """Return the mark of a tile."""
        chunk, at = self._chunk(index)
        return np.uint64(chunk[at])

    def note(self, index: TileIndex, mark: np.uint64) -> None:
        """Set the mark of a tile that was made."""
        chunk, at = self._chunk(index)
        chunk[at] = mark
        corner = (index[0] + TILES // 2) // _SIDE, (index[1] + TILES // 2) // _SIDE
        self._noted[corner] = self._noted.get(corner, 0) + 1
        if sum(self._noted.values()) >= _TILES_PER_WRITE:
            self.write()

    def write(self) -> None:
        """Write the new marks."""
        for i, j in self._noted:
            with writing(self._store.url, self._subject):
                self._store.check_writer()
                self._array[i * _SIDE : (i + 1) * _SIDE, j * _SIDE : (j + 1) * _SIDE] = self._chunks[i, j]
        self._noted.clear()

    def __enter__(self) -> "Rendered":
        return self

    def __exit__(self, *error: object) -> None:
        self.write()

    def _chunk(self, index: TileIndex) -> tuple[NDArray[np.uint64], TileIndex]:
        i, j = index[0] + TILES // 2, index[1] + TILES // 2
        corner = i // _SIDE, j // _SIDE
        if corner not in self._chunks:
            a, b = corner[0] * _SIDE, corner[1] * _SIDE
            with reading(self._subject, _REPAIR):
                self._chunks[corner] = np.asarray(self._array[a : a + _SIDE, b : b + _SIDE])
        return self._chunks[corner], (i % _SIDE, j % _SIDE)
