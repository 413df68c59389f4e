"""World maps built from drives by any number of workers: frames to sub-maps, sub-maps to tiles."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ogm.pose import Trajectory
from ogm.scan import Frame, SensorModels
from ogm.storage.files import OgmError, finish_zarr
from ogm.storage.workers import Workers, deaths_explained
from ogm.world.drives import (
    Drive,
    begin_drive,
    drive_names,
    has_drive,
    load_drive,
    lost_tiles,
    save_drive,
    split_drive,
    submap_key,
)
from ogm.world.layout import TileIndex
from ogm.world.rendered import Rendered
from ogm.world.tasks import MapPlace, Part, SubMapJob, fingerprint, make_submap, make_tile, parts_of_tiles
from ogm.world.tiles import TileStore
from ogm.world.world_map import WorldMap


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
    ism: SensorModels,
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
    ism : callable with `spec`, or mapping of str to these
        The sensor model; of several sensors one for each `Scan.sensor`. For several workers picklable, as the models of
        `ogm.models.load_model` are. Its repr, without addresses, is kept as what the drive was made by.
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
    made_by = re.sub(r" at 0x[0-9a-f]+", "", repr(ism))
    planned = [_begin(store, split_drive(name, drives[name], made_by, length)) for name in sorted(drives)]
    for drive in planned:
        for number in lost_tiles(store, drive):
            drive.submaps[number] = replace(drive.submaps[number], tiles=None)
    jobs = [
        SubMapJob(drive.name, k, drives[drive.name][slice(*one.frames)])
        for drive in planned
        for k, one in enumerate(drive.submaps)
        if one.tiles is None
    ]
    by_name, skipped = {drive.name: drive for drive in planned}, 0
    with Workers(workers, scheduler) as pool:
        with _results(pool, partial(make_submap, MapPlace.of(store), ism), jobs, store.url) as results:
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
    trajectories: Mapping[str, Trajectory | Mapping[int, Any] | Sequence[Any]] | None = None,
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
    trajectories : mapping of str to Trajectory, to a mapping of int to (4, 4) array, or to a (K, 4, 4) array
        By name of the drive: poses ``T_map_sensor`` by stamp, by frame number (the last number in a frame's name; where
        names have none, the place in the drive), or of each frame. Drives that are not named stay. None reads all
        tiles, and makes those anew that are damaged; missing ones, and those of drives that were removed, are made in
        any case.
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
    with Workers(workers, scheduler) as pool:
        _render(store, pool, progress, damaged)


@contextmanager
def _results(
    pool: Workers, function: Callable[[Any], Any], jobs: Sequence[Any], url: str
) -> Iterator[Iterator[tuple[int, Any]]]:
    """Yield the results of jobs; after an error no worker of this machine writes."""
    try:
        with closing(pool.work_off(function, jobs)) as results, deaths_explained(f"sub-maps and tiles of {url}"):
            yield results
    except BaseException:
        finish_zarr()
        raise


def _render(store: TileStore, pool: Workers, progress: Tell, damaged: Iterable[TileIndex] = ()) -> None:
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
    with rendered, _results(pool, partial(make_tile, MapPlace.of(store)), jobs, store.url) as results:
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
