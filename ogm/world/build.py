"""World maps built from drives by any number of workers: frames become sub-maps, sub-maps become tiles."""

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
    """Progress of a build.

    Attributes
    ----------
    stage : str
        "sub-maps" or "tiles".
    done, total : int
    skipped : int
        Frames skipped so far, which were damaged or had no pose.
    """

    stage: str
    done: int
    total: int
    skipped: int = 0


ProgressCallback = Callable[[Progress], object]


def build_world(
    world: WorldMap,
    drives: Mapping[str, Sequence[Frame]],
    ism: SensorModels,
    *,
    length: float = 50.0,
    workers: int = 1,
    scheduler: str | None = None,
    progress: ProgressCallback = lambda event: None,
) -> None:
    """Build a map from drives, or add drives to a built map; finished parts are not built again.

    A drive is cut into sub-maps of consecutive frames. Each sub-map is a task that fuses its frames by the map's rule.
    Then each tile of the map is a task that combines its sub-maps in a fixed order. So the map is identical to the last
    bit for any number of workers and interruptions. Sub-maps are kept, so that `rebuild_world` can move them.

    Parameters
    ----------
    world : WorldMap
        Map open for writing, empty or built before.
    drives : mapping of str to sequence of Frame
        Frames by name of the drive. For several workers the sequences must be picklable, as datasets of `ogm.datasets`
        are.
    ism : callable with `spec`, or mapping of str to these
        Sensor model; for several sensors one for each `Scan.sensor`. For several workers it must be picklable, as the
        models of `ogm.models.load_model` are. Its repr, without addresses, identifies the model of a drive.
    length : float
        Distance travelled within a sub-map [m].
    workers : int
        Number of processes: 1 works in this process; with more, processes are started on this machine.
    scheduler : str, optional
        Address of a Dask scheduler, ``"tcp://host:port"``, used instead. Its workers open the map by its URL.
    progress : callable
        Called with every `Progress`.

    Raises
    ------
    OgmError
        If the map has tiles that belong to no drive, or a drive of the same name was made from other frames or by
        another model.
    ValueError
        If the map is read-only, or a drive has no poses.
    OSError
        If workers die repeatedly, the disk is full, or the scheduler cannot be reached. Finished parts are kept.
    """
    store = _writable(world)
    made_by = re.sub(r" at 0x[0-9a-f]+", "", repr(ism))
    planned = [_begin(store, split_drive(name, drives[name], made_by, length)) for name in sorted(drives)]
    for drive in planned:
        for number in lost_tiles(store, drive):
            drive.submaps[number] = replace(drive.submaps[number], tiles=None)
    jobs = [
        SubMapJob(drive.name, k, drives[drive.name][slice(*submap.frames)])
        for drive in planned
        for k, submap in enumerate(drive.submaps)
        if submap.tiles is None
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
    progress: ProgressCallback = lambda event: None,
) -> None:
    """Move the sub-maps of drives to new poses, such as after a loop closure, and rebuild the affected tiles.

    Sub-maps are rigid: each moves with its anchor frame, and is resampled once from its original.

    Parameters
    ----------
    world : WorldMap
        Map open for writing, built by `build_world`.
    trajectories : mapping of str to Trajectory, to a mapping of int to (4, 4) array, or to a (K, 4, 4) array
        Poses ``T_map_sensor`` by name of the drive. A trajectory gives them by stamp, a mapping by frame number, an
        array for each frame. The frame number is the last number in a frame's name, or the index in the drive if names
        have no number. Other drives stay. None reads all tiles and rebuilds the damaged ones. Missing tiles, and tiles
        of removed drives, are rebuilt in all cases.
    workers, scheduler, progress
        See `build_world`.

    Raises
    ------
    OgmError, ValueError, OSError
        As in `build_world`; if a drive does not exist, or a trajectory does not cover it. Then nothing is changed.
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
    """Yield the results of jobs; after an error, local workers no longer write."""
    try:
        with closing(pool.work_off(function, jobs)) as results, deaths_explained(f"sub-maps and tiles of {url}"):
            yield results
    except BaseException:
        finish_zarr()
        raise


def _render(store: TileStore, pool: Workers, progress: ProgressCallback, damaged: Iterable[TileIndex] = ()) -> None:
    """Make tiles with changed parts, and missing or damaged tiles; remove tiles without parts."""
    drives = [load_drive(store, name) for name in drive_names(store)]
    sources = {drive.name: drive.source for drive in drives}
    wanted, rendered = parts_of_tiles(store, drives), Rendered(store)
    existing, broken = set(store.tiles()), set(damaged)
    sound = existing - broken
    for index in sorted((existing - wanted.keys()) | broken):  # Zarr reads a tile before replacing it, and would fail
        store.write_tile(index, store.layout.empty_tile())
        rendered.note(index, np.uint64(0))
    marks = {index: fingerprint(parts, sources) for index, parts in wanted.items()}
    jobs = [(index, wanted[index]) for index in wanted if index not in sound or rendered.mark(index) != marks[index]]
    _check_parts(store, drives, [part for _, parts in jobs for part in parts])
    for index, _ in jobs:  # no mark until the tile is written
        rendered.note(index, np.uint64(0))
    rendered.write()
    store.make_level(0)  # before the workers start, several of which would make it
    with rendered, _results(pool, partial(make_tile, MapPlace.of(store)), jobs, store.url) as results:
        progress(Progress("tiles", 0, len(jobs)))
        for done, (n, _) in enumerate(results, 1):
            rendered.note(jobs[n][0], marks[jobs[n][0]])
            progress(Progress("tiles", done, len(jobs)))


def _check_parts(store: TileStore, drives: Iterable[Drive], parts: Iterable[Part]) -> None:
    """Raise OgmError if tiles of sub-maps are missing that are needed: they would be treated as unseen."""
    needed = {(part.drive, part.number, index) for part in parts for index in part.tiles}
    for drive in drives:
        lost = lost_tiles(store, drive)
        missing = [(n, index) for n, tiles in lost.items() for index in tiles if (drive.name, n, index) in needed]
        if missing:
            raise OgmError(
                f"{len(missing)} tiles of sub-maps of drive {drive.name} of {store.url} are missing, such as "
                f"{submap_key(store, drive.name, *missing[0])}: `ogm world build` with that drive makes them again"
            )


def _writable(world: WorldMap) -> TileStore:
    """Return the store of a map that can be built from drives."""
    world.check_writable()
    world.flush()
    store = world.store
    if not drive_names(store) and store.tiles():
        raise OgmError(
            f"{store.url} has tiles that were integrated or merged, and no drives: building would remove them; build a "
            "second map, then combine them by WorldMap.merge"
        )
    world.forget_tiles()
    return store


def _begin(store: TileStore, drive: Drive) -> Drive:
    """Return a drive in its present state; begin it if it does not exist, or if its description is lost."""
    if not has_drive(store, drive.name):
        begin_drive(store, drive)
        return drive
    found = load_drive(store, drive.name)
    if found.source == drive.source:
        return found
    if not any(submap.tiles is not None for submap in found.submaps):
        begin_drive(store, drive)
        return drive
    raise OgmError(
        f"{store.url} has a drive {drive.name} that was made from other frames or poses, by another model or with "
        "another length of sub-maps: give the new drive another name, or remove the folder or prefix of the old one"
    )
