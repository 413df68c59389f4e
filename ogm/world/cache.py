"""Tiles in memory: the ones used last, written back when others need their place."""

from collections import OrderedDict
from typing import Any, Protocol

from numpy.typing import NDArray

from ogm.world.layout import TileIndex, WorldLayout


class Tiles(Protocol):
    """Where tiles come from and go to, such as `ogm.world.tiles.TileStore`."""

    layout: WorldLayout

    def read_tile(self, index: TileIndex) -> NDArray[Any]:
        """Return a tile, zeros where there is none."""

    def write_tile(self, index: TileIndex, tile: NDArray[Any]) -> None:
        """Write a tile in one step."""


class TileCache:
    """The tiles of level 0 that a map works on, at most so many bytes of them.

    Parameters
    ----------
    tiles : Tiles
    memory : float
        [byte]; at least four tiles are kept.
    """

    def __init__(self, tiles: Tiles, memory: float) -> None:
        layout = tiles.layout
        self.tiles, self.most = tiles, max(4.0, memory / layout.empty_tile().nbytes)
        self._kept: OrderedDict[TileIndex, NDArray[Any]] = OrderedDict()
        self._changed: set[TileIndex] = set()

    def __contains__(self, index: TileIndex) -> bool:
        return index in self._kept

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def changed(self) -> list[TileIndex]:
        """Tiles that are not written yet, in order."""
        return sorted(self._changed)

    def get(self, index: TileIndex) -> NDArray[Any]:
        """Return a tile, (7, tile, tile), from memory or as it is stored; it is kept in memory."""
        if index in self._kept:
            self._kept.move_to_end(index)
            return self._kept[index]
        tile = self.tiles.read_tile(index)
        self._make_place()
        self._kept[index] = tile
        return tile

    def mark_changed(self, index: TileIndex) -> None:
        """Note that a tile of `get` was changed, and must be written."""
        self._changed.add(index)

    def flush(self) -> None:
        """Write all tiles that were changed; what is written is not lost, whatever comes."""
        for index in self.changed:
            self._write(index)

    def clear(self) -> None:
        """Drop all tiles, also those that were changed."""
        self._kept.clear()
        self._changed.clear()

    def _make_place(self) -> None:
        while len(self._kept) + 1 > self.most:
            oldest = next(iter(self._kept))
            if oldest in self._changed:
                self._write(oldest)
            del self._kept[oldest]

    def _write(self, index: TileIndex) -> None:
        self.tiles.write_tile(index, self._kept[index])
        self._changed.discard(index)
