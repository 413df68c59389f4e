"""Cache of tiles in memory, written back when it is full, and the integration of measurement grids into tiles."""

import math
from collections import OrderedDict
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.fusion.lookup import ScanLookup
from ogm.fusion.update_gate import check_measurement
from ogm.fusion.window import affine_between, samples_per_axis
from ogm.grid import EvidentialGrid
from ogm.pose import check_pose, check_stamp
from ogm.world.kernels import integrate
from ogm.world.layout import WORLD_RULES, TileIndex, WorldLayout, corners


class Tiles(Protocol):
    """Source and destination of tiles, such as `ogm.world.tiles.TileStore`."""

    layout: WorldLayout

    def read_tile(self, index: TileIndex) -> NDArray[Any]:
        """Return a tile, zeros if it does not exist."""

    def write_tile(self, index: TileIndex, tile: NDArray[Any]) -> None:
        """Write a tile in one step."""


class TileCache:
    """Tiles of level 0 that a map works on, bounded in memory.

    Parameters
    ----------
    tiles : Tiles
    memory : float
        Greatest size in memory [byte]; at least four tiles are kept.
    """

    def __init__(self, tiles: Tiles, memory: float) -> None:
        layout = tiles.layout
        self.tiles, self.max_tiles = tiles, max(4.0, memory / layout.empty_tile().nbytes)
        self._kept: OrderedDict[TileIndex, NDArray[Any]] = OrderedDict()
        self._changed: set[TileIndex] = set()

    def __contains__(self, index: TileIndex) -> bool:
        return index in self._kept

    @property
    def changed(self) -> list[TileIndex]:
        """Tiles that are not written yet, sorted."""
        return sorted(self._changed)

    def get(self, index: TileIndex) -> NDArray[Any]:
        """Return a tile, (7, tile, tile), from memory or from the store, and keep it in memory."""
        if index in self._kept:
            self._kept.move_to_end(index)
            return self._kept[index]
        tile = self.tiles.read_tile(index)
        self._make_place()
        self._kept[index] = tile
        return tile

    def mark_changed(self, index: TileIndex) -> None:
        """Mark a tile of `get` as changed, so that it is written later."""
        self._changed.add(index)

    def flush(self) -> None:
        """Write all changed tiles."""
        for index in self.changed:
            self._write(index)

    def clear(self) -> None:
        """Drop all tiles, including changed ones."""
        self._kept.clear()
        self._changed.clear()

    def _make_place(self) -> None:
        while len(self._kept) + 1 > self.max_tiles:
            oldest = next(iter(self._kept))
            if oldest in self._changed:
                self._write(oldest)
            del self._kept[oldest]

    def _write(self, index: TileIndex) -> None:
        self.tiles.write_tile(index, self._kept[index])
        self._changed.discard(index)


_LATEST = 2**32 - 2  # [s] greatest stamp that fits in the layers `seen_high` and `seen_low`


def integrate_grid(
    cache: TileCache,
    grid: EvidentialGrid,
    T_map_sensor: ArrayLike,  # noqa: N803
    *,
    stamp: float | None = None,
    reliability: float = 1.0,
) -> int:
    """Combine a measurement grid with tiles; see `WorldMap.integrate`."""
    check_measurement(grid, reliability)
    when, layout = _second(stamp), cache.tiles.layout
    T = check_pose(T_map_sensor, "T_map_sensor")
    box = layout.around(corners(grid.spec, T))
    layout.check_box(box)
    target = layout.spec(box)
    base, samples = affine_between(target, grid.spec, T), samples_per_axis(target, grid.spec)
    mass = np.ascontiguousarray(grid.mass, np.float32)
    rule, max_known, total = WORLD_RULES[layout.rule], 1 - layout.min_unknown, 0
    for index in layout.tiles_of(box):
        affine, at = base.copy(), layout.box_of(index)
        affine[:, 2] += base[:, :2] @ (at[0] - box[0], at[2] - box[2])
        scan, tile = ScanLookup(mass, affine, samples), cache.get(index)
        if changed := integrate(tile, scan, reliability, rule, max_known, when):
            cache.mark_changed(index)
            total += changed
    return total


def _second(stamp: float | None) -> int:
    """Return a stamp in its stored form: the whole second plus 1, 0 if unknown."""
    if stamp is None:
        return 0
    time = check_stamp(stamp)
    if not 0 <= time <= _LATEST:
        raise ValueError(f"stamp must be 0 to {_LATEST} s, got {time}")
    return math.floor(time) + 1
