"""Maps larger than memory: tiles in a folder, an archive or an object store, read and updated by window."""

import os
import zipfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any

from numpy.typing import ArrayLike

from ogm.fusion.mapper import locked
from ogm.grid import EvidentialGrid
from ogm.storage.files import OgmError, atomic_write
from ogm.world.cache import integrate_grid
from ogm.world.drives import drive_names
from ogm.world.kernels import merge
from ogm.world.layout import WORLD_RULES, StoredType, WorldLayout, WorldRule
from ogm.world.map_reading import MapReader
from ogm.world.stores import Mode, Url, is_zip, keys, local_path, open_store, read_object, reading
from ogm.world.tiles import TileStore, make_overviews
from ogm.world.writer import WRITER, one_writer

MEMORY = 512e6  # [byte] default size of the tiles that a map keeps in memory


class WorldMap(MapReader):
    """Map of belief masses in tiles, of any extent.

    Make a map by `WorldMap.create`, open it by `WorldMap.open`. In a ``with`` block it is closed at the end. A map that
    is open for writing keeps recently used tiles in memory. It writes them when memory is full, on `flush` and on
    `close`. When a process is killed, unwritten changes are lost; each tile on disk is complete.

    It stores for each cell the masses of free and occupied, the greatest conflict (free -> occupied, and the reverse),
    the number of scans that observed the cell, and the whole second of the last of them.

    Attributes
    ----------
    url : str
    layout : WorldLayout
        Resolution [m], cells along a side of a tile, type, rule, least unknown, reliability of drives.
    crs : str or None
        Coordinate reference system of the map's axes.
    store : TileStore
        Arrays of the map.
    mode : {"r", "r+"}

    Notes
    -----
    In uint16, masses are rounded to the nearest n / 4095 after every scan: each scan adds an error of at most 1 / 8190,
    and weaker evidence is lost. Conflict is stored in steps of 1 / 255. The map never forgets, since forgetting depends
    on the order of scans. It has one writer at a time (`ogm.world.writer`). One thread may change the map while other
    threads read it.
    """

    def __init__(self, tiles: TileStore, mode: Mode, memory: float, held: ExitStack | None = None) -> None:
        super().__init__(tiles, memory)
        self.mode = mode
        self._built: bool | None = None  # whether it is built from drives; None if not yet known
        self._held = held or ExitStack()  # right to write

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
        drive_reliability: float = 0.8,
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
            Rule for combining scans and maps.
        dtype : {"uint16", "float32"}
            Type of the stored layers.
        min_unknown : float
            Lower bound of unknown, [1 / 4095, 1), in float32 [1e-4, 1).
        drive_reliability : float
            Shafer's discount of the map of a drive before `build_world` combines it with other drives, (0, 1].
        memory : float
            Greatest size of tiles in memory [byte].
        storage : mapping of str to str, optional
            Configuration of the object store: endpoint, keys, region; see `ogm.world.stores.open_store`.

        Raises
        ------
        ValueError
            If the place is not empty, or a number is out of its range.
        ImportError
            If zarr or obstore is missing.
        OSError
            If the place cannot be written, or another process is writing there.
        """
        layout = WorldLayout(float(resolution), tile, dtype, rule, float(min_unknown), float(drive_reliability))
        place = open_store(url, "r+", storage)
        return cls._writing(url, place, memory, lambda: TileStore.create(url, layout, crs, storage))

    @classmethod
    def open(
        cls, url: Url, mode: Mode = "r", *, memory: float = MEMORY, storage: Mapping[str, str] | None = None
    ) -> "WorldMap":
        """Open a map: for reading, or with the mode ``"r+"`` for reading and writing.

        Parameters
        ----------
        url : str or path
            A folder, a ``.zip`` archive (read only), or ``s3://bucket/prefix``.
        mode : {"r", "r+"}
        memory, storage
            See `create`.

        Raises
        ------
        FileNotFoundError
            If the map does not exist.
        OgmError
            If it is damaged, or has another format or version.
        BlockingIOError
            If another process has the map open for writing. For an object store this check takes a few seconds, or half
            a minute after that process was killed.
        """
        if mode not in ("r", "r+"):
            raise ValueError(f"mode must be r or r+, got {mode!r}")
        tiles = TileStore.open(url, mode, storage)
        return cls(tiles, mode, memory) if mode == "r" else cls._writing(url, tiles.store, memory, lambda: tiles)

    @classmethod
    def _writing(cls, url: Url, place: Any, memory: float, tiles: Callable[[], TileStore]) -> "WorldMap":
        """Return a map that is open for writing, by this process only."""
        with ExitStack() as held:
            writer = held.enter_context(one_writer(url, place))
            opened = tiles()
            opened.writer = writer
            return cls(opened, "r+", memory, held.pop_all())
        raise AssertionError

    def __enter__(self) -> "WorldMap":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __repr__(self) -> str:
        layout = self.layout
        return (
            f"WorldMap({self.url!r}: cells of {layout.resolution:g} m, tiles of {layout.tile}, {layout.rule}, "
            f"{layout.dtype})"
        )

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
            Measurement grid. Cells of the map take the masses at their centre, or the mean over the cell if the grid's
            cells are finer, as in `ogm.fusion.EvidentialMapper.update`.
        T_map_sensor : (4, 4) array
            Takes the grid's frame to the map [m].
        stamp : float, optional
            Time of the measurement [s], 0 to 2**32 - 2.
        reliability : float
            Reliability, [0, 1], by which masses are discounted.

        Returns
        -------
        int
            Number of cells of the map that the grid observes.

        Raises
        ------
        ValueError
            If the map is read-only, a pose is not rigid or tilted by more than 45 degrees, the stamp is out of its
            range, or the grid lies beyond the lattice.
        """
        self._check_plain()
        return integrate_grid(self._cache, grid, T_map_sensor, stamp=stamp, reliability=reliability)

    @locked
    def merge(self, other: "WorldMap", rule: WorldRule | None = None) -> int:
        """Combine another map with this one, tile by tile; return the number of tiles that changed.

        Parameters
        ----------
        other : WorldMap
            Map with the same resolution, tiles and type, in the same coordinates.
        rule : {"cautious", "dempster", "cumulative"}, optional
            Rule, by default this map's. All are associative and commutative, up to rounding.

        Raises
        ------
        ValueError
            If the maps have different cells, or this one is read-only.
        """
        self._check_plain()
        ours, theirs = self.layout, other.layout
        if (ours.resolution, ours.tile, ours.dtype) != (theirs.resolution, theirs.tile, theirs.dtype):
            raise ValueError(f"{other} has other cells than {self}: merge maps of equal resolution, tile and dtype")
        if self.crs != other.crs:
            raise ValueError(f"{other.url} has the crs {other.crs}, {self.url} has {self.crs}: merge maps of equal crs")
        chosen = WorldLayout(rule=rule or ours.rule).rule  # raises for an unknown rule
        found = other.tiles()
        for index in found:
            merge(self._cache.get(index), other.tile(index), WORLD_RULES[chosen], 1 - ours.min_unknown)
            self._cache.mark_changed(index)
        return len(found)

    @locked
    def build_overviews(self) -> int:
        """Make all overviews, levels of half the resolution each; return the number of levels.

        The top level has at most 2 x 2 tiles. A cell of a level has the greatest occupied of its four cells, and the
        mean of free bounded by 1 - occupied, so walls and poles stay visible. Overviews do not follow later changes.
        """
        self.check_writable()
        self.flush()
        return make_overviews(self.store)

    @locked
    def flush(self) -> None:
        """Write all changed tiles."""
        self._cache.flush()

    def close(self) -> None:
        """Write all changed tiles, and allow other processes to change the map."""
        try:
            if self.mode == "r+":
                self.flush()
        finally:
            self._cache.clear()
            self._held.close()
            self.mode = "r"

    def copy_to(self, url: str | os.PathLike[str]) -> None:
        """Write the whole map on disk, with overviews, to a new ``.zip`` archive in one step.

        Raises
        ------
        ValueError
            If the name does not end in ``.zip``.
        """
        if not is_zip(url):
            raise ValueError(f"a copy must be a .zip archive, got {url}: copy folders and buckets by other tools")
        if self.mode == "r+":
            self.flush()
        place = self.store.store
        with atomic_write(local_path(url)) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
            for key in keys(place, ""):
                with reading(key):
                    if key != WRITER and (content := read_object(place, key)) is not None:  # None: removed meanwhile
                        archive.writestr(key, content)

    def check_writable(self) -> None:
        """Raise ValueError if the map is read-only or closed."""
        if self.mode != "r+":
            raise ValueError(f"{self.url} is read-only or closed: open it with mode='r+'")

    def _check_plain(self) -> None:
        """Raise an error if scans cannot be combined with the map."""
        self.check_writable()
        if self._built is None:
            self._built = bool(drive_names(self.store))
        if self._built:
            raise OgmError(
                f"{self.url} is built from drives, which determine its tiles: add drives by build_world, or merge it "
                "into another map"
            )

    def forget_tiles(self) -> None:
        """Drop the tiles in memory, which another writer changes; changed tiles must be flushed before."""
        self._cache.clear()
        self._built = None
