"""Tasks of workers that build a world map: sub-maps from frames, and tiles from the sub-maps of drives."""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.pipeline import grid_pose, map_scans
from ogm.fusion.window import affine_between
from ogm.scan import Frame, SensorModels
from ogm.storage.files import error_context
from ogm.world.cache import TileCache, integrate_grid
from ogm.world.drives import Drive, drive_array, submap_key
from ogm.world.kernels import discount, merge, moved
from ogm.world.layout import LAYERS, WORLD_RULES, TileIndex, checked_layers, corners, mass_of
from ogm.world.stores import reading, writing
from ogm.world.tiles import TileStore

_COMPARED = 64  # greatest number of tiles in which drives are compared


class Part(NamedTuple):
    """Sub-map that may have cells in a tile.

    Attributes
    ----------
    drive : str
    number : int
        Index of the sub-map in the drive.
    tiles : tuple of (int, int)
        Tiles of the sub-map that the tile may need.
    correction : (4, 4) float64 or None
        Transform of the sub-map's cells to their present place; None if they have not moved.
    """

    drive: str
    number: int
    tiles: tuple[TileIndex, ...]
    correction: NDArray[np.float64] | None


def parts_of_tiles(store: TileStore, drives: Iterable[Drive]) -> dict[TileIndex, list[Part]]:
    """Return the parts of every tile in the order of their combination: by drive, then by sub-map.

    So the map, to the last bit, depends neither on the order in which drives are built nor on the workers.

    Raises
    ------
    OgmError
        If a sub-map is moved beyond the map.
    """
    found: dict[TileIndex, list[Part]] = {}
    for drive in sorted(drives, key=lambda drive: drive.name):
        for number, submap in enumerate(drive.submaps):
            correction = submap.correction
            needed: dict[TileIndex, list[TileIndex]] = {}
            for tile in submap.tiles or ():
                for target in [tile] if correction is None else _targets(store, tile, correction):
                    needed.setdefault(target, []).append(tile)
            for target, tiles in needed.items():
                found.setdefault(target, []).append(Part(drive.name, number, tuple(sorted(tiles)), correction))
    return dict(sorted(found.items()))


def _targets(store: TileStore, tile: TileIndex, correction: NDArray[np.float64]) -> list[TileIndex]:
    """Return the tiles in which a moved tile may have cells."""
    layout = store.layout
    box = layout.around(corners(layout.spec(layout.box_of(tile)), correction))
    with error_context(f"a sub-map of a drive of {store.url} is moved beyond the map"):
        layout.check_box(box)
    return layout.tiles_of(box)


def fingerprint(parts: Iterable[Part], sources: Mapping[str, str]) -> np.uint64:
    """Return 64 bits that identify the parts of a tile, never 0; they depend on drives, models and poses."""
    sums = hashlib.sha256()
    for part in parts:
        sums.update(f"{part.drive} {sources[part.drive]} {part.number} {part.tiles}".encode())
        sums.update(b"" if part.correction is None else part.correction.tobytes())
    return np.uint64(int.from_bytes(sums.digest()[:8], "big") | 1)


def render_tile(store: TileStore, index: TileIndex, parts: Iterable[Part]) -> NDArray[Any]:
    """Return a tile, (7, tile, tile), combined from its parts by the rule of the map.

    The sub-maps of a drive are combined first. The result is discounted and combined with the other drives. Moved
    sub-maps are resampled once, by nearest cells.
    """
    layout = store.layout
    tile = layout.empty_tile()
    for drive in _tiles_of_drives(store, index, parts):
        discount(drive, layout.drive_reliability)
        merge(tile, drive, WORLD_RULES[layout.rule], 1 - layout.min_unknown)
    return tile


def _tiles_of_drives(store: TileStore, index: TileIndex, parts: Iterable[Part]) -> Iterator[NDArray[Any]]:
    """Yield the content of each drive in a tile: its combined sub-maps."""
    layout, drives = store.layout, _Drives(store)
    for _, of_drive in groupby(parts, lambda part: part.drive):
        drive = layout.empty_tile()
        for part in of_drive:
            tile = drives.read(part, index) if part.correction is None else _moved_tile(drives, index, part)
            merge(drive, tile, WORLD_RULES[layout.rule], 1 - layout.min_unknown)
        yield drive


def contradictions(store: TileStore, drives: Iterable[Drive]) -> tuple[int, int]:
    """Return the number of cells in which drives contradict each other, and of cells that at least two drives know.

    A drive knows a cell if its mass of free or of occupied exceeds 1/2. In large maps only `_COMPARED` tiles are read.
    """
    of_tiles = parts_of_tiles(store, drives).items()
    shared = [(index, parts) for index, parts in of_tiles if len({part.drive for part in parts}) > 1]
    chosen = shared[:: -(-len(shared) // _COMPARED) or 1]
    against = common = 0
    for index, parts in chosen:
        tiles = list(_tiles_of_drives(store, index, parts))
        free, occupied = (sum(mass_of(tile, store.layout)[..., k] > 0.5 for tile in tiles) for k in (0, 1))
        against += int(np.count_nonzero((free > 0) & (occupied > 0)))
        common += int(np.count_nonzero(free + occupied > 1))
    return against, common


def _moved_tile(drives: "_Drives", index: TileIndex, part: Part) -> NDArray[Any]:
    """Return the cells of a moved sub-map in a tile."""
    assert part.correction is not None
    layout = drives.layout
    rows, columns = zip(*part.tiles, strict=True)
    i, j, n = min(rows), min(columns), layout.tile
    tile = layout.empty_tile()
    source = np.zeros((len(LAYERS), (max(rows) - i + 1) * n, (max(columns) - j + 1) * n), tile.dtype)
    for at in part.tiles:
        a, b = (at[0] - i) * n, (at[1] - j) * n
        source[:, a : a + n, b : b + n] = drives.read(part, at)
    area = layout.spec((i * n, i * n + source.shape[1], j * n, j * n + source.shape[2]))
    moved(source, affine_between(layout.spec(layout.box_of(index)), area, part.correction), tile)
    return tile


class _Drives:
    """Cache of the arrays of drives that a tile needs."""

    def __init__(self, store: TileStore) -> None:
        self.layout, self._store, self._arrays = store.layout, store, dict[str, Any]()

    def read(self, part: Part, index: TileIndex) -> NDArray[Any]:
        """Return a tile of a sub-map, (7, tile, tile)."""
        store = self._store
        i, k, j, m = store.layout.box_of(index)
        offset = store.layout.cells // 2
        subject = f"tile {index} of sub-map {part.number} of drive {part.drive} of {store.url}"
        key = submap_key(store, part.drive, part.number, index)
        with reading(subject, f"remove {key}, then `ogm world build` with that drive makes it again"):
            if part.drive not in self._arrays:
                self._arrays[part.drive] = drive_array(store, part.drive)
            rows, columns = slice(i + offset, k + offset), slice(j + offset, m + offset)
            return checked_layers(np.asarray(self._arrays[part.drive][part.number, :, rows, columns]))


class MapPlace(NamedTuple):
    """Address of a map for workers, and the token of its writer."""

    url: str
    storage: Mapping[str, str]
    writer: str

    @classmethod
    def of(cls, store: TileStore) -> "MapPlace":
        """Return the address of an open map."""
        return cls(store.url, store.storage, store.writer)

    def open(self) -> TileStore:
        """Return the store of the map, opened in a worker."""
        return TileStore.open(self.url, "r+", self.storage, self.writer)


class SubMapJob(NamedTuple):
    """Sub-map to be made."""

    drive: str
    number: int
    frames: Sequence[Frame]


class MadeSubMap(NamedTuple):
    """Sub-map that is on disk: its tiles, and the number of fused frames."""

    tiles: tuple[TileIndex, ...]
    mapped: int


def make_submap(place: MapPlace, ism: SensorModels, job: SubMapJob) -> MadeSubMap:
    """Make a sub-map."""
    submap = SubMapTiles(place.open(), job.drive, job.number)
    cache, mapped = TileCache(submap, float("inf")), 0
    for frame, grid in map_scans([frame for frame in job.frames if frame.T_map_sensor is not None], ism):
        integrate_grid(cache, grid, grid_pose(frame), stamp=frame.stamp)
        mapped += 1
    tiles = tuple(cache.changed)
    cache.flush()
    return MadeSubMap(tiles, mapped)


class SubMapTiles:
    """Tiles of a sub-map in the making, for a `TileCache`."""

    def __init__(self, store: TileStore, drive: str, number: int) -> None:
        self.layout, self._store, self._number = store.layout, store, number
        self._array, self._name = drive_array(store, drive), drive

    def read_tile(self, index: TileIndex) -> np.ndarray:
        """Return an empty tile: a sub-map is always made from its first frame."""
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
