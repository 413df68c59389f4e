"""What the tiles of a built map were made from: a number per tile, so that building goes on where it was stopped."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.world.layout import TILES, TileIndex, checked_array, codecs
from ogm.world.stores import read_object, reading, writing
from ogm.world.tiles import TileStore

_NAME, _SIDE = "rendered", 64  # [tiles] along a side of a chunk
_OFTEN = 64  # tiles after which their numbers are written
_MEND = f"remove {_NAME}/, and build again: all tiles are made anew"


class Rendered:
    """The numbers of all tiles, `ogm.world.tasks.fingerprint`; 0 where none was made.

    Numbers that are noted are written now and then, and at the end of a ``with`` block. A tile whose number was not
    written is made again, with the same result.
    """

    def __init__(self, store: TileStore) -> None:
        self._store, what = store, f"the numbers of tiles of {store.url}"
        wanted: dict[str, Any] = {"shape": (TILES, TILES), "chunks": (_SIDE, _SIDE), "dtype": "uint64"}
        with reading(what, _MEND):
            self._array: Any = None
            if read_object(store.store, f"{store.prefix}{_NAME}/zarr.json") is not None:
                self._array = checked_array(store.root[_NAME], **wanted)
        if self._array is None:
            with writing(store.url, what):
                store.check_writer()
                self._array = store.root.create_array(_NAME, **wanted, **codecs(1))
        self._chunks: dict[TileIndex, NDArray[np.uint64]] = {}
        self._noted: dict[TileIndex, int] = {}

    def mark(self, index: TileIndex) -> np.uint64:
        """Return the number of a tile."""
        chunk, at = self._chunk(index)
        return np.uint64(chunk[at])

    def note(self, index: TileIndex, mark: np.uint64) -> None:
        """Keep the number of a tile that was made."""
        chunk, at = self._chunk(index)
        chunk[at] = mark
        where = (index[0] + TILES // 2) // _SIDE, (index[1] + TILES // 2) // _SIDE
        self._noted[where] = self._noted.get(where, 0) + 1
        if sum(self._noted.values()) >= _OFTEN:
            self.write()

    def write(self) -> None:
        """Write what was noted."""
        for i, j in self._noted:
            with writing(self._store.url, f"the numbers of tiles of {self._store.url}"):
                self._store.check_writer()
                self._array[i * _SIDE : (i + 1) * _SIDE, j * _SIDE : (j + 1) * _SIDE] = self._chunks[i, j]
        self._noted.clear()

    def __enter__(self) -> "Rendered":
        return self

    def __exit__(self, *error: object) -> None:
        self.write()

    def _chunk(self, index: TileIndex) -> tuple[NDArray[np.uint64], TileIndex]:
        i, j = index[0] + TILES // 2, index[1] + TILES // 2
        where = i // _SIDE, j // _SIDE
        if where not in self._chunks:
            a, b = where[0] * _SIDE, where[1] * _SIDE
            with reading(f"the numbers of tiles of {self._store.url}", _MEND):
                self._chunks[where] = np.asarray(self._array[a : a + _SIDE, b : b + _SIDE])
        return self._chunks[where], (i % _SIDE, j % _SIDE)
