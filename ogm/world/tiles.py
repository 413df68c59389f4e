"""Tiles of a world map on disk or in an object store: one Zarr array per level, one shard per tile.

Levels of half the resolution each are overviews, down to a city on one screen, in which walls and poles stay visible.
"""

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.extras import import_extra
from ogm.storage.archive import attributes_checksum
from ogm.storage.files import OgmError, update_hint
from ogm.storage.remote import is_remote
from ogm.world.kernels import MASS_STEPS
from ogm.world.layout import LAYERS, TILES, Box, TileIndex, WorldLayout, checked_array, checked_layers, codecs, mass_of
from ogm.world.shards import read_shards
from ogm.world.stores import Mode, Url, erase, is_zip, keys, local_path, open_store, reading, writing
from ogm.world.writer import WRITER, check_writer

FORMAT = "ogm.world/1"
_REPAIR = "`ogm world rebuild` makes it again if the map is built from drives; else restore it from a copy"


class TileStore:
    """Arrays of a world map.

    Open one by `TileStore.open` or `TileStore.create`. A tile is one object of the store, written in one step: a reader
    finds the old tile or the new one, even after a crash.

    Attributes
    ----------
    url : str
    layout : WorldLayout
    crs : str or None
    writer : str
        Token of `ogm.world.writer.one_writer`, which must be current for writing; "" for no check.
    """

    def __init__(
        self, url: Url, root: Any, attributes: Mapping[str, Any], storage: Mapping[str, str] | None = None
    ) -> None:
        self.storage, self.writer = dict(storage or {}), ""
        self.url, self.root, self.store = str(url), root, root.store
        self.layout = WorldLayout(**{field.name: attributes[field.name] for field in fields(WorldLayout)})
        self.crs = attributes["crs"]
        self._folder = None if is_remote(url) or is_zip(url) else local_path(url)
        self._arrays: dict[str, Any] = {}

    @classmethod
    def create(
        cls, url: Url, layout: WorldLayout, crs: str | None, storage: Mapping[str, str] | None = None
    ) -> "TileStore":
        """Begin an empty map at a new or empty URL; for errors see `WorldMap.create`."""
        zarr, place = import_extra("zarr", "world"), open_store(url, "r+", storage)
        with reading(url):
            if set(keys(place, "")) - {WRITER}:
                kind = "objects already: give another prefix" if is_remote(url) else "files already: give a new folder"
                raise OgmError(f"{url} contains {kind}, or open the map by WorldMap.open")
        attributes: dict[str, Any] = {
            "format": FORMAT,
            **asdict(layout),
            "crs": crs,
            "layers": list(LAYERS),
            "axes": "[layer, ix (x forward), iy (y left)]; cell 0 of the map is in the middle of the array",
            "steps": layout.steps,
        }
        attributes["sha256"] = attributes_checksum(attributes)
        with writing(url, url):
            root = zarr.create_group(place, zarr_format=3, attributes=attributes)  # one object, so never a partial map
            return cls(url, root, attributes, storage)

    @classmethod
    def open(cls, url: Url, mode: Mode, storage: Mapping[str, str] | None = None, writer: str = "") -> "TileStore":
        """Open a map; for errors see `WorldMap.open`."""
        zarr, place = import_extra("zarr", "world"), open_store(url, mode, storage)
        if not (is_remote(url) or local_path(url).exists()):
            raise FileNotFoundError(f"there is no world map {url}: make it by WorldMap.create or `ogm world build`")
        try:
            with reading(url):
                root = zarr.open_group(place, mode=mode)
        except FileNotFoundError as error:
            raise FileNotFoundError(f"there is no world map at {url}: it has no Zarr group ({error})") from error
        attributes = dict(root.attrs)
        found = attributes.get("format")
        if found != FORMAT:
            raise OgmError(
                f"{url} has the format {found}, this version of ogm reads {FORMAT}"
                + (update_hint(found, FORMAT) or ": it is not a world map")
            )
        if attributes.get("sha256") != attributes_checksum(attributes):
            raise OgmError(f"the attributes of {url} are damaged (SHA-256 differs): restore zarr.json from a copy")
        try:
            opened = cls(url, root, attributes, storage)
            opened.writer = writer
            return opened
        except (ValueError, TypeError, KeyError) as error:
            raise OgmError(f"the attributes of {url} are invalid ({error}): restore zarr.json from a copy") from error

    @property
    def levels(self) -> int:
        """Number of levels, 1 without overviews."""
        with reading(self.url):
            count = 1
            while str(count) in self.root:
                count += 1
            return count

    def array(self, level: int) -> Any:
        """Return the Zarr array of a level; a missing level 0 is made if the map is open for writing."""
        name = str(level)
        if name not in self._arrays:
            with reading(f"level {level} of {self.url}", "restore its zarr.json from a copy"):
                if level == 0 and not self.store.read_only:
                    self.make_level(0)
                if name in self.root:
                    self._arrays[name] = checked_array(self.root[name], **self.layout.array(level))
                elif level == 0:
                    raise OgmError(f"{self.url} has no array of tiles: open it once for writing, which makes the array")
                else:
                    raise OgmError(
                        f"{self.url} has {self.levels} levels, no level {level}: WorldMap.build_overviews makes levels"
                    )
        return self._arrays[name]

    def make_level(self, level: int) -> None:
        """Make the Zarr array of a level, unless it exists."""
        name = str(level)
        if name not in self._arrays and name not in self.root:
            with writing(self.url, f"level {level} of {self.url}"):
                try:
                    self._arrays[name] = self.root.create_array(name, **self.layout.array(level), **codecs())
                except ValueError:
                    if name not in self.root:  # else another worker has made it
                        raise

    def remove_level(self, level: int) -> None:
        """Remove a level of overviews with its tiles."""
        self._arrays.pop(str(level), None)
        with writing(self.url, f"level {level} of {self.url}"):
            self.check_writer()
            for key in reversed(keys(self.store, f"{self.prefix}{level}/")):  # zarr.json last
                erase(self.store, key)

    def check_writer(self) -> None:
        """Raise BlockingIOError if another process has become the writer of the map."""
        if self.writer:
            check_writer(self.url, self.store, self.writer)

    def read(self, box: Box, level: int = 0, layers: slice = slice(None)) -> NDArray[Any]:
        """Return the layers of a box of cells in stored form, (L, nx, ny)."""
        array, offset = self.array(level), self.layout.cells >> (level + 1)  # raises if its description is invalid
        with reading(self._place(box, level), _REPAIR if level == 0 else "WorldMap.build_overviews makes it again"):
            if self._folder is None:
                rows, columns = slice(box[0] + offset, box[1] + offset), slice(box[2] + offset, box[3] + offset)
                return checked_layers(np.asarray(array[layers, rows, columns]), layers)
            return checked_layers(read_shards(self.layout, level, box, layers, self._folder / str(level)), layers)

    def read_tile(self, index: TileIndex, level: int = 0) -> NDArray[Any]:
        """Return a tile in stored form, (L, tile, tile); zeros if it does not exist."""
        return self.read(self.layout.box_of(index), level)

    def write_tile(self, index: TileIndex, tile: NDArray[Any], level: int = 0) -> None:
        """Write a tile in one step; a tile without seen cells is removed."""
        array, offset = self.array(level), self.layout.cells >> (level + 1)
        i, k, j, n = self.layout.box_of(index)
        with writing(self.url, self._place((i, k, j, n), level)):
            self.check_writer()
            if tile.any():
                array[:, i + offset : k + offset, j + offset : n + offset] = tile
            else:
                erase(self.store, self.key(index, level))

    def tiles(self, level: int = 0) -> list[TileIndex]:
        """Return the existing tiles, sorted; the store is listed."""
        half = TILES >> (level + 1)
        prefix = f"{self.prefix}{level}/c/0/"
        with reading(self.url):
            found = [key.removeprefix(prefix).split("/") for key in keys(self.store, prefix)]
            return sorted((int(i) - half, int(j) - half) for i, j in found)

    def key(self, index: TileIndex, level: int = 0) -> str:
        """Return the key of a tile's object."""
        half = TILES >> (level + 1)
        return f"{self.prefix}{level}/c/0/{index[0] + half}/{index[1] + half}"

    @property
    def prefix(self) -> str:
        """Prefix of the keys of all its objects."""
        return f"{self.root.path}/" if self.root.path else ""

    def _place(self, box: Box, level: int) -> str:
        tiles = self.layout.tiles_of(box)
        of_level = f" of level {level}" if level else ""
        several = f"tile {tiles[0]}" if len(tiles) == 1 else f"tiles {tiles[0]} to {tiles[-1]}"
        return f"{several}{of_level} of {self.url}"


def make_overviews(store: TileStore) -> int:
    """Make levels above 0, tile by tile, until one has at most 2 x 2 tiles; return the number of levels."""
    layout, level, tiles = store.layout, 0, store.tiles()
    n = layout.tile
    for above in reversed(range(1, store.levels)):
        store.remove_level(above)
    while level == 0 or (tiles and np.ptp(tiles, axis=0).max() > 1):
        level += 1
        existing, tiles = set(tiles), sorted({(i >> 1, j >> 1) for i, j in tiles})
        store.make_level(level)
        for index in tiles:
            made = layout.empty_tile(2)
            for di, dj in ((0, 0), (0, 1), (1, 0), (1, 1)):
                below = 2 * index[0] + di, 2 * index[1] + dj
                if below in existing:
                    stored = store.read(layout.box_of(below), level - 1, slice(0, 2))
                    rows, columns = slice(di * n // 2, (di + 1) * n // 2), slice(dj * n // 2, (dj + 1) * n // 2)
                    made[:, rows, columns] = _halved(stored, layout)
            store.write_tile(index, made, level)
    return level + 1


def _halved(stored: NDArray[Any], layout: WorldLayout) -> NDArray[Any]:
    """Return stored masses (2, n, n) at half the resolution, in stored form."""
    blocks = mass_of(stored, layout).reshape(stored.shape[1] // 2, 2, stored.shape[2] // 2, 2, 2)
    half: NDArray[Any] = blocks.mean(axis=(1, 3))
    half[..., 1] = blocks[..., 1].max(axis=(1, 3))
    half[..., 0] = np.minimum(half[..., 0], 1 - half[..., 1])
    if layout.dtype == "float32":
        return half.transpose(2, 0, 1)
    steps: NDArray[Any] = np.rint(half * np.float32(MASS_STEPS)).astype(np.uint16)
    steps[..., 0] = np.minimum(steps[..., 0], MASS_STEPS - steps[..., 1])
    return steps.transpose(2, 0, 1)
