"""Maps built from drives: one result for any workers, whoever is killed; drives that move after a loop closure."""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import each, refused
from world_frames import RandomGrids, StraightDrive, grid_of

from ogm.evidence import cautious, cumulative, dempster, discount
from ogm.grid import GridSpec
from ogm.pose import Trajectory, inverse, pose
from ogm.scan import Frame, Mount, Scan
from ogm.storage.files import OgmError
from ogm.world import Progress, WorldMap, build_world, rebuild_world
from ogm.world.drives import drive_names, load_drive, split_drive
from ogm.world.stores import erase, keys
from ogm.world.tasks import contradictions

Place = Callable[[], dict[str, Any]]
DRIVES = {
    "b": StraightDrive(30, (0.0, 0.0, 0.2), 1, damaged=(4,), lost=(11,)),
    "a": StraightDrive(24, (40.0, -10.0, 1.3), 2),
    "c": StraightDrive(20, (10.0, 20.0, -0.5), 3),
}
RULES = {"cautious": cautious, "dempster": dempster, "cumulative": cumulative}
AROUND = GridSpec(0.5, (280, 280), (-60.0, -60.0))
OPTIONS: dict[str, Any] = {"resolution": 0.5, "tile": 32, "rule": "dempster"}
# no bound of certainty, which acts at other moments, and no discount
UNBOUNDED = OPTIONS | {"dtype": "float32", "min_unknown": 1e-4, "drive_reliability": 1.0}


def built(where: dict[str, Any], drives: dict[str, Any] = DRIVES, **options: Any) -> WorldMap:
    world = WorldMap.create(**where, **OPTIONS)
    build_world(world, drives, RandomGrids(), length=15.0, **options)
    return world


def same(a: WorldMap, b: WorldMap) -> bool:
    return a.tiles() == b.tiles() and all(np.array_equal(a.tile(index), b.tile(index)) for index in a.tiles())


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of all drives, built by one process in one go; tests change copies of it."""
    path = tmp_path_factory.mktemp("whole") / "map"
    built({"url": path}).close()
    return path


@pytest.fixture
def whole(folder: Path) -> Iterator[WorldMap]:
    with WorldMap.open(folder) as world:
        yield world


@pytest.fixture
def copied(folder: Path, tmp_path: Path) -> Iterator[WorldMap]:
    """A copy of `whole`, to be changed."""
    shutil.copytree(folder, tmp_path / "map")
    with WorldMap.open(tmp_path / "map", "r+") as world:
        yield world


@pytest.fixture
def built_map(place: Place, folder: Path) -> Iterator[WorldMap]:
    """A map as `whole` in a place, to be changed."""
    where = place()
    if isinstance(where["url"], Path):
        shutil.copytree(folder, where["url"])
    else:
        built(where).close()
    with WorldMap.open(**where, mode="r+") as world:
        yield world


@pytest.fixture(scope="session")
def integrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of all scans of all drives, one after the other."""
    path = tmp_path_factory.mktemp("integrated") / "map"
    with WorldMap.create(path, **UNBOUNDED) as world:
        for drive in DRIVES.values():
            for k in range(len(drive)):
                if k not in drive.damaged and k not in drive.lost:
                    world.integrate(grid_of(1000 * drive.seed + k), drive.pose(k), stamp=100.0 * drive.seed + 0.5 * k)
    return path


def test_a_built_map_is_that_of_its_scans(place: Place, integrated: Path) -> None:
    with WorldMap.create(**place(), **UNBOUNDED) as world, WorldMap.open(integrated) as plain:
        build_world(world, DRIVES, RandomGrids(), length=15.0)
        assert world.tiles() == plain.tiles()
        for name in ("count", "last_seen"):
            np.testing.assert_array_equal(world.layers(AROUND)[name], plain.layers(AROUND)[name])
        np.testing.assert_allclose(world.window(AROUND).mass, plain.window(AROUND).mass, atol=1e-5)
        drives = [load_drive(world.store, name) for name in drive_names(world.store)]
        assert all(submap.tiles is not None for drive in drives for submap in drive.submaps)


@pytest.mark.slow
@each("rule", ["cautious", "dempster", "cumulative"])
def test_the_map_of_each_drive_is_discounted_before_it_meets_the_others(tmp_path: Path, rule: str) -> None:
    """Whatever the number of its sub-maps, and in whatever order drives are built."""
    options = OPTIONS | {"rule": rule, "dtype": "float32", "min_unknown": 1e-4}
    drives = {"a": DRIVES["a"][:16], "b": DRIVES["b"][14:]}  # around where they cross
    alone = []
    (tmp_path / rule).mkdir()
    for name in "ab":
        with WorldMap.create(tmp_path / rule / name, **options, drive_reliability=1.0) as world:
            build_world(world, {name: drives[name]}, RandomGrids(), length=15.0)
            alone.append(discount(world.window(AROUND).mass, 0.7))
    with WorldMap.create(tmp_path / rule / "both", **options, drive_reliability=0.7) as world:
        for name in "ba":
            build_world(world, {name: drives[name]}, RandomGrids(), length=15.0)
        np.testing.assert_allclose(world.window(AROUND).mass, RULES[rule](*alone), atol=2e-5)
    assert np.all([one.sum(axis=-1) > 0 for one in alone], axis=0).sum() > 20  # cells of both


def test_drives_are_cut_by_their_length(whole: WorldMap) -> None:
    drive = load_drive(whole.store, "b")
    frames = [one.frames for one in drive.submaps]
    assert (frames[0][0], frames[-1][1]) == (0, 30)
    assert [first for first, _ in frames[1:]] == [last + (last == 11) for _, last in frames[:-1]]  # 11 has no pose
    assert all(6 <= last - first <= 9 for first, last in frames[:-1])  # 2 m apart, 15 m
    assert sum(one.mapped for one in drive.submaps) == 28


@pytest.mark.slow
def test_the_order_and_number_of_builds_do_not_matter(place: Place, whole: WorldMap) -> None:
    with WorldMap.create(**place(), **OPTIONS) as other:
        for names in ("c", "ab", "abc"):
            build_world(other, {name: DRIVES[name] for name in names}, RandomGrids(), length=15.0)
        assert same(whole, other)


@pytest.mark.slow
@each("workers", [2, 3])
def test_any_number_of_workers_gives_the_same_map(tmp_path: Path, whole: WorldMap, workers: int) -> None:
    with built({"url": tmp_path / str(workers)}, workers=workers) as many:
        assert same(whole, many)


@pytest.mark.slow
def test_workers_write_to_an_object_store(s3: dict[str, str], whole: WorldMap) -> None:
    where = {"url": "s3://maps/of-workers", "storage": s3}
    with built(where, workers=2) as many:
        assert same(whole, many)


@pytest.mark.slow
def test_a_dask_cluster_gives_the_same_map(tmp_path: Path, whole: WorldMap) -> None:
    from distributed import LocalCluster

    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        built({"url": tmp_path / "many"}, scheduler=cluster.scheduler_address) as many,
    ):
        assert same(whole, many)


@pytest.mark.slow
def test_a_worker_that_is_killed_is_replaced(tmp_path: Path, whole: WorldMap) -> None:
    marker = tmp_path / "was killed"
    with WorldMap.create(tmp_path / "many", **OPTIONS) as many:
        build_world(many, DRIVES, RandomGrids(2013, str(marker)), length=15.0, workers=2)
        assert marker.exists()
        assert same(whole, many)


def test_what_is_finished_is_not_made_again(tmp_path: Path, whole: WorldMap) -> None:
    class Stop(Exception):
        pass

    def stops(event: Progress) -> None:
        if (event.stage, event.done) in (("sub-maps", 5), ("tiles", 3)):
            raise Stop

    events: list[Progress] = []
    where = {"url": tmp_path / "map"}
    with WorldMap.create(**where, **OPTIONS) as world:
        for _ in range(3):  # twice within the sub-maps, then within the tiles
            with pytest.raises(Stop):
                build_world(world, DRIVES, RandomGrids(), length=15.0, progress=stops)
    with WorldMap.open(**where, mode="r+") as world:
        build_world(world, DRIVES, RandomGrids(), length=15.0, progress=events.append)
        assert events[0] == Progress("sub-maps", 0, 0)
        assert events[1].total == len(whole.tiles()) - 3
        assert same(world, whole)
        events.clear()
        build_world(world, DRIVES, RandomGrids(), length=15.0, progress=events.append)
        assert [event.total for event in events] == [0, 0]


@pytest.mark.slow
def test_a_removed_drive_leaves_the_map(built_map: WorldMap, tmp_path: Path) -> None:
    two = {name: DRIVES[name] for name in "ac"}
    with built({"url": tmp_path / "without"}, two) as without:
        if Path(built_map.url).is_dir():
            shutil.rmtree(Path(built_map.url) / "drives/b")
        for key in keys(built_map.store.store, f"{built_map.store.prefix}drives/b/"):
            erase(built_map.store.store, key)
        rebuild_world(built_map)
        assert same(built_map, without)


def test_a_moved_drive_lies_where_its_scans_would(built_map: WorldMap, tmp_path: Path) -> None:
    """A shift by whole cells moves the cells alone; the sub-maps of the other drives stay."""
    shift = pose(4.0, -2.5)
    drive = DRIVES["a"]
    moved = {k: shift @ drive.pose(k) for k in range(len(drive))}
    rebuild_world(built_map, {"a": moved})
    with WorldMap.create(tmp_path / "expected", **OPTIONS) as expected:
        for one in (DRIVES["a"], DRIVES["b"], DRIVES["c"]):
            for k in range(len(one)):
                T = shift @ one.pose(k) if one.seed == 2 else one.pose(k)
                if k not in one.damaged and k not in one.lost:
                    expected.integrate(grid_of(1000 * one.seed + k), T, stamp=100.0 * one.seed + 0.5 * k)
        np.testing.assert_array_equal(built_map.layers(AROUND)["count"], expected.layers(AROUND)["count"])


def test_frames_are_found_by_the_number_in_their_names_or_by_row() -> None:
    scan, mount = Scan(np.zeros((1, 4), np.float32)), Mount(1.9)
    named = [Frame(scan, mount, T_map_sensor=pose(10.0 * k), name=f"scan {k + 60:04d}") for k in range(6)]
    plain = [replace(frame, name="scan") for frame in named]
    numbers = {k + 60: pose(0.0, float(k)) for k in range(6)}
    rows = np.array([*numbers.values()])
    for frames, poses in ((named, numbers), (named, rows), (plain, rows), (plain, dict(enumerate(rows)))):
        drive = split_drive("a", frames, "", 20.0)
        moved = drive.by_number(poses)
        assert [one.pose[1, 3] for one in moved.submaps] == [float(one.anchor) for one in drive.submaps]
    refused(
        "frame 61 of drive a, an anchor, has no pose",
        split_drive("a", named, "", 20.0).by_number,
        dict(enumerate(rows)),
    )
    assert len(moved.submaps) > 1


@pytest.mark.slow
def test_a_turned_drive_is_resampled_once(tmp_path: Path) -> None:
    """Each cell is that of the unmoved map at its centre, taken back."""
    drive, turn = DRIVES["a"], pose(1.2, 0.7, yaw=0.4)
    poses = np.array([turn @ drive.pose(k) for k in range(len(drive))])
    stamps = np.array([200 + 0.5 * k for k in range(len(drive))])
    with WorldMap.create(tmp_path / "map", **OPTIONS) as world:
        build_world(world, {"a": drive}, RandomGrids(), length=1e6)  # one rigid sub-map
        before, layers = world.window(AROUND), world.layers(AROUND)
        rebuild_world(world, {"a": Trajectory(stamps, poses)})
        after, counted = world.window(AROUND), world.layers(AROUND)
        x, y = np.broadcast_arrays(*AROUND.cell_centers)
        T = inverse(turn)
        back = [T[0, 0] * x + T[0, 1] * y + T[0, 3], T[1, 0] * x + T[1, 1] * y + T[1, 3]]
        inside = AROUND.contains(*back)
        ix, iy = AROUND.index(*(one[inside] for one in back))
        np.testing.assert_array_equal(after.mass[inside], before.mass[ix, iy])
        np.testing.assert_array_equal(counted["count"][inside], layers["count"][ix, iy])
        assert (counted["count"] > 0).sum() > 3000
        rebuild_world(world, {"a": {k: drive.pose(k) for k in range(len(drive))}})  # and back: nothing has been lost
        assert world.window(AROUND) == before


def test_the_conflict_of_drives_is_that_of_the_cells_that_two_know(copied: WorldMap) -> None:
    drives = [load_drive(copied.store, name) for name in drive_names(copied.store)]
    against, common = contradictions(copied.store, drives)
    assert 0.2 < against / common < 0.6  # of random grids
    assert contradictions(copied.store, drives[:1]) == (0, 0)
    copied.close()


def test_drives_that_make_no_sense_are_refused(copied: WorldMap, tmp_path: Path, make_grid: Callable) -> None:
    drive, model, moments = DRIVES["a"], RandomGrids(), Trajectory([0.0, 1.0], [np.eye(4), np.eye(4)])
    with copied as world:
        refused("made from other frames", build_world, world, {"a": DRIVES["b"]}, model, length=15.0, error=OgmError)
        refused("built from drives", world.integrate, make_grid(), np.eye(4), error=OgmError)
        refused("no drive 'x'", rebuild_world, world, {"x": {}}, error=OgmError)
        refused("frame .* an anchor, has no pose", rebuild_world, world, {"a": {}})
        refused("poses are not extrapolated", rebuild_world, world, {"a": moments})
        refused("letters, digits", build_world, world, {"../a": drive}, model)
        refused("has a pose", build_world, world, {"d": StraightDrive(3, lost=(0, 1, 2))}, model)
    with WorldMap.create(tmp_path / "plain", **OPTIONS) as plain:
        plain.integrate(make_grid(), np.eye(4))
        refused("integrated or merged", build_world, plain, DRIVES, model, error=OgmError)
    refused("is read-only", build_world, WorldMap.open(tmp_path / "map"), DRIVES, model)


def test_a_damaged_sub_map_is_named(copied: WorldMap, tmp_path: Path) -> None:
    assert copied.tiles()
    for file in (tmp_path / "map" / "drives" / "a" / "c").rglob("*"):
        if file.is_file():
            file.write_bytes(file.read_bytes()[:-30] + bytes(30))
    shutil.rmtree(tmp_path / "map" / "0" / "c")
    refused("of sub-map .* of drive a .* remove drives/a/c/", rebuild_world, copied, error=OgmError)
