"""World maps built from drives by any number of workers: frames to sub-maps, sub-maps to tiles."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ogm.files import OgmError, finish_zarr
from ogm.fusion.pipeline import grid_pose, map_scans
from ogm.pool import work_off
from ogm.pose import Trajectory
from ogm.scan import Frame, SensorModels
from ogm.world.cache import TileCache
from ogm.world.drives import (
    Drive,
    SubMap,
    begin_drive,
    drive_array,
    drive_names,
    has_drive,
    load_drive,
    lost_tiles,
    save_drive,
    split_drive,
    submap_key,
)
from ogm.world.integration import integrate_grid
from ogm.world.layout import TileIndex
from ogm.world.render import Part, fingerprint, parts_of_tiles, render_tile
from ogm.world.rendered import Rendered
from ogm.world.stores import writing
from ogm.world.tiles import TileStore
from ogm.world.world_map import WorldMap

__all__ = ["Progress", "build_world", "rebuild_world"]

MakeModel = Callable[[], SensorModels]
_DIED = ("BrokenProcessPool", "KilledWorker", "CommClosedError", "CancelledError", "FutureCancelledError")


class Progress(NamedTuple):
    """How far a build is.

    Attributes
    ----------
    stage : str
        "sub-maps" or "tiles".
    done, total : int
    skipped : int
        Frames that were damaged or had no pose, so far.
    """

    stage: str
    done: int
    total: int
    skipped: int = 0


Tell = Callable[[Progress], object]


def build_world(
    world: WorldMap,
    drives: Mapping[str, Sequence[Frame]],
    make_model: MakeModel,
    *,
    length: float = 50.0,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Tell = lambda event: None,
) -> None:
    """Build a map from drives, or add drives to one that was built; what is finished already is not made again.

    A drive is cut into sub-maps of consecutive frames. Each is one task, and made by the map's rule; then each tile of
    the map is one task, which combines the sub-maps in it in a fixed order. So the map is the same to the last bit for
    any number of workers, and however often building was stopped. Sub-maps are kept, so that `rebuild_world` can move
    them.

    Parameters
    ----------
    world : WorldMap
        Open for writing; empty, or built before.
    drives : mapping of str to sequence of Frame
        By name. For several workers the sequences must be picklable, as data sets of `ogm.datasets` are.
    make_model : callable
        Returns the sensor model, once per worker; picklable and hashable, such as a frozen dataclass. Its repr is kept
        as what the drive was made by.
    length : float
        Of the way along which a sub-map's frames were taken [m].
    workers : int
        1 works in this process; more start processes of this machine.
    scheduler : str, optional
        Address of a Dask scheduler to use instead, ``"tcp://host:port"``, whose workers reach the map by its URL.
    progress : callable
        Called with each `Progress`.

    Raises
    ------
    OgmError
        If the map has tiles that no drive made, or a drive of that name was made from other frames or by another model.
    ValueError
        If the map is open to read alone, or a drive has no poses.
    OSError
        If workers die again and again, the disk is full, or the scheduler cannot be reached. What is finished stays.
    """
    store = _writable(world)
    pool = _Pool(workers, scheduler)
    planned = [_begin(store, split_drive(name, drives[name], repr(make_model), length)) for name in sorted(drives)]
    for drive in planned:
        for number in lost_tiles(store, drive):
            drive.submaps[number] = replace(drive.submaps[number], tiles=None)
    make = _Make(_Place.of(store), make_model)
    jobs = [
        _Job(drive.name, k, _part(drives[drive.name], one))
        for drive in planned
        for k, one in enumerate(drive.submaps)
        if one.tiles is None
    ]
    by_name, skipped = {drive.name: drive for drive in planned}, 0
    with pool.work_off(make, jobs, store.url) as results:
        progress(Progress("sub-maps", 0, len(jobs)))
        for done, (n, made) in enumerate(results, 1):
            drive, number = by_name[jobs[n].drive], jobs[n].number
            frames = drive.submaps[number].frames
            drive.submaps[number] = replace(drive.submaps[number], tiles=made.tiles, mapped=made.mapped)
            save_drive(store, drive)
            skipped += frames[1] - frames[0] - made.mapped
            progress(Progress("sub-maps", done, len(jobs), skipped))
    _render(store, pool, progress)


def rebuild_world(
    world: WorldMap,
    trajectories: Mapping[str, Trajectory | Mapping[int, Any]] | None = None,
    *,
    workers: int = 1,
    scheduler: str | None = None,
    progress: Tell = lambda event: None,
) -> None:
    """Move the sub-maps of drives to other poses, as after a loop closure, and make the tiles anew that this changes.

    Sub-maps are rigid: each moves with its anchor frame, and is resampled once, from what was measured.

    Parameters
    ----------
    world : WorldMap
        Open for writing, built by `build_world`.
    trajectories : mapping of str to Trajectory, or to a mapping of int to (4, 4) array
        By name of the drive: poses ``T_map_sensor`` by stamp, or by frame number. Drives that are not named stay. None
        reads all tiles, and makes those anew that are damaged; missing ones, and those of drives that were removed, are
        made in any case.
    workers, scheduler, progress
        As for `build_world`.

    Raises
    ------
    OgmError, ValueError, OSError
        As `build_world`; if there is no such drive, or a trajectory does not cover it. Then nothing is changed.
    """
    store = _writable(world)
    moved = []
    for name, poses in (trajectories or {}).items():
        drive = load_drive(store, name)
        moved.append(drive.along(poses) if isinstance(poses, Trajectory) else drive.by_number(poses))
    for drive in moved:
        save_drive(store, drive)
    damaged = [] if trajectories else [index for index, _ in world.damage()]
    _render(store, _Pool(workers, scheduler), progress, damaged)


class _Pool(NamedTuple):
    """Where work is done."""

    workers: int
    scheduler: str | None

    @contextmanager
    def work_off(
        self, function: Callable[[Any], Any], jobs: Sequence[Any], url: str
    ) -> Iterator[Iterator[tuple[int, Any]]]:
        """Yield the results; in the end no worker of this machine writes."""
        try:
            working: Any = work_off(function, jobs, self.workers, self.scheduler)
            with closing(working) as results:
                yield results
        except BaseException as error:
            finish_zarr()
            if type(error).__name__ not in _DIED:
                raise
            raise OSError(
                f"workers died ({type(error).__name__}), as when memory runs out; finished sub-maps and tiles of "
                f"{url} are complete: the same command goes on, perhaps with fewer workers"
            ) from error


class _Place(NamedTuple):
    """Where workers find the map, and the token of its writer."""

    url: str
    storage: Mapping[str, str]
    writer: str

    @classmethod
    def of(cls, store: TileStore) -> "_Place":
        return cls(store.url, store.storage, store.writer)

    def open(self) -> TileStore:
        return TileStore.open(self.url, "r+", self.storage, self.writer)


class _Job(NamedTuple):
    """A sub-map to be made."""

    drive: str
    number: int
    frames: Sequence[Frame]


class _Made(NamedTuple):
    """A sub-map that is on disk."""

    tiles: tuple[TileIndex, ...]
    mapped: int


class _Make:
    """The task that makes a sub-map."""

    def __init__(self, place: _Place, make_model: MakeModel) -> None:
        self.place, self.make_model = place, make_model

    def __call__(self, job: _Job) -> _Made:
        store = self.place.open()
        submap = _SubMapTiles(store, job.drive, job.number)
        cache, mapped = TileCache(submap, float("inf")), 0
        for frame, grid in map_scans(
            [one for one in job.frames if one.T_map_sensor is not None], _model(self.make_model)
        ):
            integrate_grid(cache, grid, grid_pose(frame), stamp=frame.stamp)
            mapped += 1
        tiles = tuple(cache.changed)
        cache.flush()
        return _Made(tiles, mapped)


_models: dict[MakeModel, SensorModels] = {}  # of this process, the last one


def _model(make_model: MakeModel) -> SensorModels:
    if make_model not in _models:
        _models.clear()
        _models[make_model] = make_model()
    return _models[make_model]


class _SubMapTiles:
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


class _RenderTile:
    """The task that makes a tile of the map from sub-maps."""

    def __init__(self, place: _Place) -> None:
        self.place = place

    def __call__(self, job: tuple[TileIndex, list[Part]]) -> None:
        store = self.place.open()
        store.write_tile(job[0], render_tile(store, *job))


def _render(store: TileStore, pool: _Pool, progress: Tell, damaged: Iterable[TileIndex] = ()) -> None:
    """Make the tiles whose parts have changed, or that are missing or damaged; remove those that have no part."""
    drives = [load_drive(store, name) for name in drive_names(store)]
    sources = {one.name: one.source for one in drives}
    wanted, rendered = parts_of_tiles(store, drives), Rendered(store)
    there, broken = set(store.tiles()), set(damaged)
    sound = there - broken
    for index in sorted((there - wanted.keys()) | broken):  # Zarr reads what it replaces, and would fail
        store.write_tile(index, store.layout.empty_tile())
        rendered.note(index, np.uint64(0))
    marks = {index: fingerprint(parts, sources) for index, parts in wanted.items()}
    jobs = [(index, wanted[index]) for index in wanted if index not in sound or rendered.mark(index) != marks[index]]
    _check_parts(store, drives, [part for _, parts in jobs for part in parts])
    for index, _ in jobs:  # a tile that is written is that of its number, or has none
        rendered.note(index, np.uint64(0))
    rendered.write()
    store.make_level(0)  # before several workers would
    with rendered, pool.work_off(_RenderTile(_Place.of(store)), jobs, store.url) as results:
        progress(Progress("tiles", 0, len(jobs)))
        for done, (n, _) in enumerate(results, 1):
            rendered.note(jobs[n][0], marks[jobs[n][0]])
            progress(Progress("tiles", done, len(jobs)))


def _check_parts(store: TileStore, drives: Iterable[Drive], parts: Iterable[Part]) -> None:
    """Raise OgmError if tiles of sub-maps are needed that are not there: they would be taken for unseen."""
    needed = {(part.drive, part.number, index) for part in parts for index in part.tiles}
    for drive in drives:
        lost = lost_tiles(store, drive)
        missing = [(n, index) for n, tiles in lost.items() for index in tiles if (drive.name, n, index) in needed]
        if missing:
            raise OgmError(
                f"{len(missing)} tiles of sub-maps of drive {drive.name} of {store.url} are lost, such as "
                f"{submap_key(store, drive.name, *missing[0])}: `ogm world build` with that drive makes them anew"
            )


def _writable(world: WorldMap) -> TileStore:
    """Return the store of a map that drives can be built into."""
    world.check_writable()
    world.flush()
    store = world.store
    if not drive_names(store) and store.tiles():
        raise OgmError(
            f"{store.url} has tiles that were integrated or merged, and no drives: building would remove them; build "
            "into another place, then WorldMap.merge"
        )
    world.forget_tiles()
    return store


def _begin(store: TileStore, drive: Drive) -> Drive:
    """Return a drive as far as it is made; begin it if there is none, or if its description is lost."""
    if not has_drive(store, drive.name):
        begin_drive(store, drive)
        return drive
    found = load_drive(store, drive.name)
    if found.source == drive.source:
        return found
    if not any(one.tiles is not None for one in found.submaps):
        begin_drive(store, drive)
        return drive
    raise OgmError(
        f"{store.url} has a drive {drive.name} that was made from other frames or poses, by another model or of "
        "another length of sub-maps: give the new one another name, or remove the old one's folder, or prefix"
    )


def _part(frames: Sequence[Frame], submap: SubMap) -> Sequence[Frame]:
    return frames[slice(*submap.frames)]
