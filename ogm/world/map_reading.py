"""Reading of a world map: windows, layers, tiles, and a description."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.evidence import Opinion
from ogm.fusion.mapper import MapLock, locked
from ogm.fusion.resample import ResampleMethod, view_layers
from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid, Sampling, sampled_opinions
from ogm.pose import check_pose
from ogm.storage.files import OgmError
from ogm.world.cache import TileCache
from ogm.world.layout import LAYERS, Box, TileIndex, corners, mass_of
from ogm.world.stores import reading, size
from ogm.world.tiles import TileStore

_MASSES = slice(0, 2)


class MapReader:
    """Read access to a map of belief masses in tiles; `WorldMap` adds write access.

    Attributes
    ----------
    store : TileStore
    layout : WorldLayout
    crs : str or None
    url : str
    lock : MapLock
    """

    def __init__(self, tiles: TileStore, memory: float) -> None:
        if not memory > 0:
            raise ValueError(f"memory must be greater than 0 bytes, got {memory}")
        self.store, self.layout, self.crs, self.url = tiles, tiles.layout, tiles.crs, tiles.url
        self.lock, self._cache = MapLock(), TileCache(tiles, memory)

    @locked
    def window(
        self,
        spec: GridSpec,
        T_map_window: ArrayLike | None = None,  # noqa: N803
        *,
        method: ResampleMethod = "nearest",
        level: int = 0,
    ) -> EvidentialGrid:
        """Return a window of the map as a grid.

        Parameters
        ----------
        spec : GridSpec
            Cells of the window. Cells of the map are returned as stored, other cells are resampled once.
        T_map_window : (4, 4) array, optional
            Takes coordinates of `spec` to the map [m], such as the pose of a vehicle; identity by default.
        method : {"nearest", "area", "cautious"}
            Resampling method, see `ogm.fusion.warp`.
        level : int
            Level of the overviews, with cells of ``2**level`` times the side.

        Returns
        -------
        EvidentialGrid
            The window; unseen cells are unknown.

        Raises
        ------
        OgmError
            If a tile is damaged, or the level does not exist.
        ValueError
            If the window lies beyond the lattice, or would need more than 2**28 cells of the map.
        """
        box = self.layout.aligned(spec, level) if T_map_window is None else None
        if box is not None:
            return EvidentialGrid.trusted(spec, self._masses(box, level))
        T = np.eye(4) if T_map_window is None else check_pose(T_map_window, "T_map_window")
        around = self.layout.around(corners(spec, T), level, margin=2)
        source = self.layout.spec(around, level)
        return EvidentialGrid.trusted(spec, view_layers(self._masses(around, level), source, spec, T, method))

    @locked
    def opinion_at(self, points: ArrayLike, method: Sampling = "nearest") -> Opinion | NDArray[np.float32]:
        """Return the opinion of the map at any points, see `EvidentialGrid.opinion_at`.

        Only tiles that hold points are read. Places that were never seen, or lie beyond the lattice, are unknown.

        Raises
        ------
        OgmError
            If a tile is damaged.
        """
        half, side = self.layout.cells >> 1, self.layout.tile

        def masses(cell: NDArray[np.float64]) -> NDArray[np.float32]:
            found = np.zeros(cell.shape, np.float32)
            inside = ((cell >= -half) & (cell < half)).all(axis=-1)
            tiles = np.floor(cell / side)
            for tile in np.unique(tiles[inside].reshape(-1, 2), axis=0):
                in_tile = inside & (tiles == tile).all(axis=-1)
                i, j = cell[in_tile].astype(np.int64).T
                box = int(i.min()), int(i.max()) + 1, int(j.min()), int(j.max()) + 1
                found[in_tile] = self._masses(box, 0)[i - box[0], j - box[2]]
            return found

        return sampled_opinions(points, (0.0, 0.0), self.layout.resolution, masses, method)

    @locked
    def layers(self, spec: GridSpec) -> LayeredGrid:
        """Return conflict, count and last observation of cells of the map.

        Parameters
        ----------
        spec : GridSpec
            Cells of the map, in its coordinates, see `cells`.

        Returns
        -------
        LayeredGrid
            ``free_to_occupied`` and ``occupied_to_free``, the greatest conflict [0, 1]; ``count`` of scans;
            ``last_seen`` [s], a whole second in float32 (128 s precision for present-day stamps), NaN if unknown.

        Raises
        ------
        ValueError
            If the cells of `spec` are not cells of the map.
        """
        box = self.layout.aligned(spec)
        if box is None:
            raise ValueError(
                f"{spec} has other cells than the map ({self.layout.resolution:g} m): take a grid of WorldMap.cells"
            )
        stored = self._read(box, 0, slice(2, len(LAYERS)))
        step = np.float32(self.layout.steps["conflict"])
        stamp = stored[3].astype(np.float64) * 65536 + stored[4]
        layers = {LAYERS[2]: stored[0] * step, LAYERS[3]: stored[1] * step, LAYERS[4]: stored[2].astype(np.float32)}
        return LayeredGrid(spec, layers | {"last_seen": np.where(stamp > 0, stamp - 1, np.nan).astype(np.float32)})

    def cells(self, extent: tuple[float, float, float, float] | None = None, level: int = 0) -> GridSpec:
        """Return the cells of the map that cover an extent, by default of all tiles.

        Parameters
        ----------
        extent : (x_min, x_max, y_min, y_max), optional
            Extent in map coordinates [m].
        level : int

        Raises
        ------
        ValueError
            If the map is empty and no extent is given, or there are more than 2**28 cells: use a higher level.
        """
        if extent is not None:
            x0, x1, y0, y1 = extent
            return self.layout.spec(self.layout.around(np.array([(x0, y0), (x1, y1)]), level, margin=0), level)
        tiles = self.tiles()
        if not tiles:
            raise ValueError(f"{self.url} is empty: integrate grids into it, then flush it")
        low, high = np.min(tiles, axis=0), np.max(tiles, axis=0) + 1
        n = self.layout.tile
        i, j = (int(edge) * n >> level for edge in low)
        k, m = (-(-int(edge) * n >> level) for edge in high)
        return self.layout.spec((i, k, j, m), level)

    @locked
    def tiles(self) -> list[TileIndex]:
        """Return the tiles with content, including unwritten ones, sorted; the store is listed."""
        return sorted({*self.store.tiles(), *self._cache.changed})

    @locked
    def tile(self, index: TileIndex) -> NDArray[Any]:
        """Return a copy of a tile in its stored form, (7, tile, tile)."""
        return self._cache.get(index).copy() if index in self._cache else self.store.read_tile(index)

    @property
    def levels(self) -> int:
        """Number of levels, 1 without overviews."""
        return self.store.levels

    @locked
    def damage(self) -> list[tuple[TileIndex, OgmError]]:
        """Return the unreadable tiles with their errors; all tiles are read."""
        found = []
        for index in self.store.tiles():
            try:
                self.store.read_tile(index)
            except OgmError as error:
                found.append((index, error))
        return found

    def describe(self) -> dict[str, str]:
        """Return a summary of the map as names and values to print; all its objects are listed."""
        tiles, layout = self.tiles(), self.layout
        with reading(self.url):
            stored = size(self.store.store, "")
        facts = {
            "map": self.url,
            "cells": f"{layout.resolution:g} m, {layout.dtype}, {layout.rule}, unknown >= {layout.min_unknown:g}",
            "tiles": f"{len(tiles)} of {layout.tile} x {layout.tile} cells, {self.levels} levels",
            "size": f"{stored / 1e6:.1f} MB",
        }
        if tiles:
            (i, j), (k, m) = np.min(tiles, axis=0), np.max(tiles, axis=0) + 1
            side = layout.tile * layout.resolution
            facts["extent"] = f"x {i * side:g} to {k * side:g} m, y {j * side:g} to {m * side:g} m"
        return facts | ({"crs": self.crs} if self.crs else {})

    def _masses(self, box: Box, level: int) -> NDArray[np.float32]:
        return mass_of(self._read(box, level, _MASSES), self.layout)

    def _read(self, box: Box, level: int, layers: slice) -> NDArray[Any]:
        """Return layers of a box of cells, (L, nx, ny), from tiles in memory and from the store."""
        self.layout.check_box(box, level)
        self.layout.spec(box, level)  # raises for too many cells
        kept = [index for index in self.layout.tiles_of(box) if index in self._cache] if level == 0 else []
        if not kept:
            return self.store.read(box, level, layers)
        out = np.zeros((layers.stop - layers.start, box[1] - box[0], box[3] - box[2]), self.layout.dtype)
        for index in self.layout.tiles_of(box):
            i, k, j, m = self.layout.box_of(index)
            a, b, c, d = max(i, box[0]), min(k, box[1]), max(j, box[2]), min(m, box[3])
            part = out[:, a - box[0] : b - box[0], c - box[2] : d - box[2]]
            if index in self._cache:
                part[:] = self._cache.get(index)[layers, a - i : b - i, c - j : d - j]
            else:
                part[:] = self.store.read((a, b, c, d), 0, layers)
        return out
