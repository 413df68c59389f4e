"""The tasks of workers that build a world map: a sub-map from frames, a tile from sub-maps."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ogm.fusion.pipeline import grid_pose, map_scans
from ogm.scan import Frame, SensorModels
from ogm.world.cache import TileCache
from ogm.world.drives import drive_array
from ogm.world.integration import integrate_grid
from ogm.world.layout import TileIndex
from ogm.world.render import Part, render_tile
from ogm.world.stores import writing
from ogm.world.tiles import TileStore


class MapPlace(NamedTuple):
    """Where workers find the map, and the token of its writer."""

    url: str
    storage: Mapping[str, str]
    writer: str

    @classmethod
    def of(cls, store: TileStore) -> "MapPlace":
        """Return the place of a map that is open here."""
        return cls(store.url, store.storage, store.writer)

    def open(self) -> TileStore:
        """Open the map in a worker."""
        return TileStore.open(self.url, "r+", self.storage, self.writer)


class SubMapJob(NamedTuple):
    """A sub-map to be made."""

    drive: str
    number: int
    frames: Sequence[Frame]


class MadeSubMap(NamedTuple):
    """A sub-map that is on disk."""

    tiles: tuple[TileIndex, ...]
    mapped: int


def make_submap(place: MapPlace, ism: SensorModels, job: SubMapJob) -> MadeSubMap:
    """Make a sub-map."""
    submap = SubMapTiles(place.open(), job.drive, job.number)
    cache, mapped = TileCache(submap, float("inf")), 0
    for frame, grid in map_scans([one for one in job.frames if one.T_map_sensor is not None], ism):
        integrate_grid(cache, grid, grid_pose(frame), stamp=frame.stamp)
        mapped += 1
    tiles = tuple(cache.changed)
    cache.flush()
    return MadeSubMap(tiles, mapped)


class SubMapTiles:
    """The tiles of a sub-map that is made, for a `TileCache`."""

    def __init__(self, store: TileStore, drive: str, number: int) -> None:
        self.layout, self._store, self._number = store.layout, store, number
        self._array, self._name = drive_array(store, drive), drive

    def read_tile(self, index: TileIndex) -> np.ndarray:
        """Return an empty tile: a sub-map is always made from its first frame on."""
        return self.layout.empty_tile()

    def write_tile(self, index: TileIndex, tile: np.ndarray) -> None:
        """Write a tile in one step."""
        i, k, j, m = self.layout.box_of(index)
        offset = self.layout.cells // 2
        with writing(self._store.url, f"tile {index} of sub-map {self._number} of drive {self._name}"):
            self._store.check_writer()
            self._array[self._number, :, i + offset : k + offset, j + offset : m + offset] = tile


def make_tile(place: MapPlace, job: tuple[TileIndex, list[Part]]) -> None:
    """Make a tile of the map from sub-maps."""
    store = place.open()
    store.write_tile(job[0], render_tile(store, *job))
