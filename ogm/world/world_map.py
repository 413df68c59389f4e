"""Maps larger than memory: tiles in a folder, an archive or an object store, read and updated by window."""

import math
import os
from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.files import OgmError
from ogm.fusion.lookup import ScanLookup
from ogm.fusion.map_lock import MapLock, locked
from ogm.fusion.resample import ResampleMethod, view_layers
from ogm.fusion.window import affine_between, samples_per_axis
from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid
from ogm.locks import locked as locked_folder
from ogm.pose import check_pose, check_stamp
from ogm.world.cache import TileCache
from ogm.world.kernels import integrate, merge
from ogm.world.layout import LAYERS, WORLD_RULES, Box, Layout, StoredType, TileIndex, WorldRule, corners
from ogm.world.overviews import make_overviews
from ogm.world.stores import Mode, Url, is_remote, is_zip, local_path, reading, size
from ogm.world.tiles import TileStore, mass_of

__all__ = ["MEMORY", "WorldMap"]

MEMORY = 512e6  # [byte] of tiles that a map keeps
_LATEST = 2**32 - 2  # [s] that the layers of the last stamp can hold
_MASSES, _CONFLICT = slice(0, 2), slice(2, 4)


class WorldMap:
    """A map of belief masses in tiles, of any extent.

    Make one by `WorldMap.create`, open one by `WorldMap.open`; both work in ``with``, at whose end it is closed. A map
    that is open for writing keeps the tiles used last in memory, and writes them when others need the place, on `flush`
    and on `close`. What was not written when a process is killed is lost; each tile on disk is whole.

    Per cell it keeps the masses of free and occupied, the greatest conflict (free, then occupied, and the reverse),
    the number of scans that had a belief about it, and the whole second of the last of them.

    Attributes
    ----------
    url : str
    layout : Layout
        Resolution [m], cells along a side of a tile, type, rule, least unknown.
    crs : str or None
        Coordinate reference system of the map's axes.
    mode : {"r", "r+"}

    Notes
    -----
    In uint16, masses are rounded to the nearest n / 65535 after every scan, so each scan adds an error of at most
    1 / 131070, and evidence weaker than that is lost; conflict is kept in steps of 1 / 255. Nothing is ever forgotten:
    forgetting depends on the order of scans. One writer at a time: a local folder is locked, an object store is not.
    One thread may change the map while others read it.
    """

    def __init__(self, tiles: TileStore, mode: Mode, memory: float, lock_folder: bool = True) -> None:
        if not memory > 0:
            raise ValueError(f"memory must be above 0 bytes, got {memory}")
        self._tiles, self.mode, self.layout, self.crs = tiles, mode, tiles.layout, tiles.crs
        self.url, self.lock = tiles.url, MapLock()
        self._cache = TileCache(tiles, memory)
        self._open = ExitStack()
        if mode == "r+" and lock_folder and not is_remote(self.url):
            self._open.enter_context(locked_folder(local_path(self.url)))

    @classmethod
    def create(
        cls,
        url: Url,
        resolution: float = 0.16,
        tile: int = 512,
        *,
        crs: str | None = None,
        rule: WorldRule = "cautious",
        dtype: StoredType = "uint16",
        min_unknown: float = 0.02,
        memory: float = MEMORY,
        storage: Mapping[str, str] | None = None,
    ) -> "WorldMap":
        """Begin an empty map.

        Parameters
        ----------
        url : str or path
            A new or empty folder, or ``s3://bucket/prefix``.
        resolution : float
            Side of a cell [m].
        tile : int
            Cells along a side of a tile, a power of two.
        crs : str, optional
            Coordinate reference system, such as ``"EPSG:25832"``, projected, in metres.
        rule : {"cautious", "dempster", "cumulative"}
            By which scans and maps are combined.
        dtype : {"uint16", "float32"}
            Of what is stored.
        min_unknown : float
            Lower bound of unknown, [1e-4, 1).
        memory : float
            Of tiles in memory [byte].
        storage : mapping of str to str, optional
            Of the object store: endpoint, keys, region; see `ogm.world.stores.open_store`.

        Raises
        ------
        ValueError
            If the place is not empty, or a number is out of its range.
        ImportError
            If zarr or obstore is missing.
        OSError
            If the place cannot be written.
        """
        layout = Layout(float(resolution), tile, dtype, rule, float(min_unknown))
        return cls(TileStore.create(url, layout, crs, storage), "r+", memory)

    @classmethod
    def open(
        cls, url: Url, mode: Mode = "r", *, memory: float = MEMORY, storage: Mapping[str, str] | None = None
    ) -> "WorldMap":
        """Open a map: to read, or with the mode ``"r+"`` to read and change it.

        Parameters
        ----------
        url : str or path
            A folder, a ``.zip`` archive (to read), or ``s3://bucket/prefix``.
        mode : {"r", "r+"}
        memory, storage
            As for `create`.

        Raises
        ------
        FileNotFoundError
            If there is none.
        OgmError
            If it is damaged, of another kind or version.
        BlockingIOError
            If another process changes a map in a local folder.
        """
        if mode not in ("r", "r+"):
            raise ValueError(f"mode must be r or r+, got {mode!r}")
        return cls(TileStore.open(url, mode, storage), mode, memory)

    def __enter__(self) -> "WorldMap":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __repr__(self) -> str:
        one = self.layout
        return f"WorldMap({self.url!r}: cells of {one.resolution:g} m, tiles of {one.tile}, {one.rule}, {one.dtype})"

    @locked
    def integrate(
        self,
        grid: EvidentialGrid,
        T_map_sensor: ArrayLike,  # noqa: N803
        *,
        stamp: float | None = None,
        reliability: float = 1.0,
    ) -> int:
        """Combine a measurement grid with the map, by the map's rule.

        Parameters
        ----------
        grid : EvidentialGrid
            In the frame that the next argument takes to the map. Cells of the map take the masses at their centre, or,
            if the grid's cells are finer, the mean over the cell, as in `ogm.fusion.EvidentialMapper.update`.
        T_map_sensor : (4, 4) array
            Takes the grid's frame to the map [m].
        stamp : float, optional
            When it was measured [s], 0 to 2**32 - 2.
        reliability : float
            [0, 1]: the masses are discounted by it.

        Returns
        -------
        int
            Number of the map's cells that the grid has a belief about.

        Raises
        ------
        ValueError
            If the map is open to read alone, a pose is not rigid or leans by more than 45 degrees, the stamp is out of
            its range, or the grid lies beyond the lattice.
        """
        self._check_writable()
        if not isinstance(grid, EvidentialGrid):
            raise TypeError(f"a map is updated with an EvidentialGrid, got {type(grid).__name__}")
        if not 0 <= reliability <= 1:
            raise ValueError(f"reliability must be in [0, 1], got {reliability}")
        when = _second(stamp)
        T = check_pose(T_map_sensor, "T_map_sensor")
        box = self.layout.around(corners(grid.spec, T))
        self.layout.check_box(box)
        base = affine_between(self.layout.spec(box), grid.spec, T)
        mass, samples = np.ascontiguousarray(grid.mass, np.float32), samples_per_axis(self.layout.spec(box), grid.spec)
        rule, most, total = WORLD_RULES[self.layout.rule], 1 - self.layout.min_unknown, 0
        for index in self.layout.tiles_of(box):
            affine, at = base.copy(), self.layout.box_of(index)
            affine[:, 2] += base[:, :2] @ (at[0] - box[0], at[2] - box[2])
            changed = integrate(
                self._cache.get(index), ScanLookup(mass, affine, samples), reliability, rule, most, when
            )
            if changed:
                self._cache.mark_changed(index)
                total += changed
        return total

    @locked
    def window(
        self,
        spec: GridSpec,
        T_map_window: ArrayLike | None = None,  # noqa: N803
        *,
        method: ResampleMethod = "nearest",
        level: int = 0,
    ) -> EvidentialGrid:
        """Return a part of the map as a grid.

        Parameters
        ----------
        spec : GridSpec
            The cells. Where they are cells of the map they are returned as they are stored, else resampled once.
        T_map_window : (4, 4) array, optional
            Takes the coordinates of `spec` to the map, for example the pose of a vehicle [m]; by default they are the
            map's.
        method : {"nearest", "area", "cautious"}
            How cells are resampled, see `ogm.fusion.warp`.
        level : int
            Of overviews, whose cells have ``2**level`` times the side.

        Returns
        -------
        EvidentialGrid
            Unknown where nothing was seen.

        Raises
        ------
        OgmError
            If a tile is damaged, or there is no such level.
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
    def layers(self, spec: GridSpec) -> LayeredGrid:
        """Return what the map keeps beside the masses, for cells of the map.

        Parameters
        ----------
        spec : GridSpec
            Cells of the map, in its coordinates; see `cells`.

        Returns
        -------
        LayeredGrid
            ``free_to_occupied`` and ``occupied_to_free``, the greatest conflict [0, 1]; ``count`` of scans;
            ``last_seen`` [s], a whole second to the precision of float32 (128 s at times of today), NaN where unknown.

        Raises
        ------
        ValueError
            If the cells of `spec` are none of the map.
        """
        box = self._aligned(spec)
        stored = self._read(box, 0, slice(2, len(LAYERS)))
        step = np.float32(self.layout.step)
        stamp = stored[3].astype(np.float64) * 65536 + stored[4]
        layers = {LAYERS[2]: stored[0] * step, LAYERS[3]: stored[1] * step, LAYERS[4]: stored[2].astype(np.float32)}
        return LayeredGrid(spec, layers | {"last_seen": np.where(stamp > 0, stamp - 1, np.nan).astype(np.float32)})

    def cells(self, extent: tuple[float, float, float, float] | None = None, level: int = 0) -> GridSpec:
        """Return the cells of the map that cover an extent, by default all tiles.

        Parameters
        ----------
        extent : (x_min, x_max, y_min, y_max), optional
            [m]
        level : int

        Raises
        ------
        ValueError
            If the map is empty and no extent is given, or there are more than 2**28 cells: take a higher level.
        """
        if extent is not None:
            x0, x1, y0, y1 = extent
            return self.layout.spec(self.layout.around(np.array([(x0, y0), (x1, y1)]), level, margin=0), level)
        tiles = self.tiles()
        if not tiles:
            raise ValueError(f"{self.url} is empty: nothing was integrated, or not flushed")
        low, high = np.min(tiles, axis=0), np.max(tiles, axis=0) + 1
        n = self.layout.tile
        i, j = (int(one) * n >> level for one in low)
        k, m = (-(-int(one) * n >> level) for one in high)
        return self.layout.spec((i, k, j, m), level)

    @locked
    def tiles(self) -> list[TileIndex]:
        """Return the tiles that hold something, also those that are not written yet, in order; the store is listed."""
        return sorted({*self._tiles.tiles(), *self._cache.changed})

    @locked
    def merge(self, other: "WorldMap", rule: WorldRule | None = None) -> int:
        """Combine another map with this one, tile by tile; return the number of tiles that changed.

        Parameters
        ----------
        other : WorldMap
            Of the same resolution, tiles and type, in the same coordinates.
        rule : {"cautious", "dempster", "cumulative"}, optional
            By default this map's. All are associative and commutative, up to rounding.

        Raises
        ------
        ValueError
            If the maps have other cells, or this one is open to read alone.
        """
        self._check_writable()
        ours, theirs = self.layout, other.layout
        if (ours.resolution, ours.tile, ours.dtype) != (theirs.resolution, theirs.tile, theirs.dtype):
            raise ValueError(f"{other} has other cells than {self}: give both one resolution, tile and dtype")
        if self.crs != other.crs:
            raise ValueError(f"{other.url} has the crs {other.crs}, {self.url} has {self.crs}: they are two places")
        chosen = Layout(rule=rule or ours.rule).rule  # refuses what is none
        found = other.tiles()
        for index in found:
            merge(self._cache.get(index), other.tile(index), WORLD_RULES[chosen], 1 - ours.min_unknown)
            self._cache.mark_changed(index)
        return len(found)

    @locked
    def tile(self, index: TileIndex) -> NDArray[Any]:
        """Return a copy of a tile as it is stored, (7, tile, tile)."""
        return self._cache.get(index).copy() if index in self._cache else self._tiles.read_tile(index)

    @property
    def levels(self) -> int:
        """Number of levels that there are, 1 without overviews."""
        return self._tiles.levels

    @locked
    def build_overviews(self) -> int:
        """Make the levels of half the resolution each, anew, until four tiles hold all; return their number.

        A cell of a level has the greatest occupied of its four cells, and the mean of free as far as the sum allows
        (`ogm.fusion.coarsen`, "occupied"): walls and poles stay visible. Overviews do not follow later changes.
        """
        self._check_writable()
        self.flush()
        return make_overviews(self._tiles)

    @locked
    def flush(self) -> None:
        """Write all tiles that were changed."""
        self._cache.flush()

    def close(self) -> None:
        """Write all tiles that were changed, and let others change the map."""
        try:
            if self.mode == "r+":
                self.flush()
        finally:
            self._cache.clear()
            self._open.close()
            self.mode = "r"

    @locked
    def damage(self) -> list[tuple[TileIndex, OgmError]]:
        """Return the tiles that cannot be read, with the errors that tell why; all are read."""
        found = []
        for index in self._tiles.tiles():
            try:
                self._tiles.read_tile(index)
            except OgmError as error:
                found.append((index, error))
        return found

    def copy_to(self, url: str | os.PathLike[str]) -> None:
        """Write all that is on disk, overviews too, to a new ``.zip`` archive in one step.

        Raises
        ------
        ValueError
            If the name does not end in ``.zip``.
        """
        from ogm.world.copies import copy_to_zip

        if not is_zip(url):
            raise ValueError(f"a copy is one .zip archive, got {url}: other tools copy folders and buckets")
        if self.mode == "r+":
            self.flush()
        copy_to_zip(self._tiles.store, local_path(url))

    def describe(self) -> dict[str, str]:
        """Return what the map holds, as names and values to print; all its objects are listed."""
        tiles, layout = self.tiles(), self.layout
        with reading(self.url):
            stored = size(self._tiles.store, "")
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

    def _check_writable(self) -> None:
        if self.mode != "r+":
            raise ValueError(f"{self.url} is open to read alone, or closed: open it with the mode r+")

    def _aligned(self, spec: GridSpec) -> Box:
        box = self.layout.aligned(spec)
        if box is None:
            raise ValueError(f"{spec} has other cells than the map ({self.layout.resolution:g} m): see WorldMap.cells")
        return box

    def _masses(self, box: Box, level: int) -> NDArray[np.float32]:
        return mass_of(self._read(box, level, _MASSES), self.layout)

    def _read(self, box: Box, level: int, layers: slice) -> NDArray[Any]:
        """Return layers of some cells, (L, nx, ny), from the tiles in memory and else from the store."""
        self.layout.check_box(box, level)
        self.layout.spec(box, level)  # refuses too many cells
        kept = [index for index in self.layout.tiles_of(box) if index in self._cache] if level == 0 else []
        if not kept:
            return self._tiles.read(box, level, layers)
        out = np.zeros((layers.stop - layers.start, box[1] - box[0], box[3] - box[2]), self.layout.dtype)
        for index in self.layout.tiles_of(box):
            i, k, j, m = self.layout.box_of(index)
            a, b, c, d = max(i, box[0]), min(k, box[1]), max(j, box[2]), min(m, box[3])
            part = out[:, a - box[0] : b - box[0], c - box[2] : d - box[2]]
            if index in self._cache:
                part[:] = self._cache.get(index)[layers, a - i : b - i, c - j : d - j]
            else:
                part[:] = self._tiles.read((a, b, c, d), 0, layers)
        return out


def _second(stamp: float | None) -> int:
    """Return a stamp as it is stored: its whole second plus 1, 0 if unknown."""
    if stamp is None:
        return 0
    time = check_stamp(stamp)
    if not 0 <= time <= _LATEST:
        raise ValueError(f"stamp must be 0 to {_LATEST} s, got {time}")
    return math.floor(time) + 1
