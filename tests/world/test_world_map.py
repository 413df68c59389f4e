"""Maps in tiles: what comes in stands where it belongs, in memory, on disk and in a bucket."""

import threading
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from cases import each, refused
from world_reference import SlowMap

from ogm.evidence import cautious
from ogm.fusion import EvidentialMapper
from ogm.grid import EvidentialGrid, GridSpec
from ogm.pose import pose
from ogm.storage.files import OgmError
from ogm.world import WorldMap

Place = Callable[[], dict[str, Any]]
MakeGrid = Callable[..., EvidentialGrid]
POSES = [pose(3.1, -2.2, yaw=0.3), pose(9.7, 4.4, yaw=-2.0, pitch=0.05), pose(-11.3, 6.6, yaw=1.2), pose(3.0, -2.0)]
AROUND = GridSpec(0.5, (120, 110), (-32.0, -28.0))  # cells that hold all of it


def made(where: dict[str, Any], make_grid: MakeGrid, **options: Any) -> WorldMap:
    world = WorldMap.create(**where, resolution=0.5, tile=16, **options)
    for k, T in enumerate(POSES):
        world.integrate(make_grid(k), T, stamp=10.0 + 7.5 * k)
    return world


@each("rule", ["cautious", "dempster", "cumulative"])
@each("dtype", ["uint16", "float32"])
def test_scans_are_combined_as_the_slow_reference_does(
    tmp_path: Path, make_grid: MakeGrid, rule: str, dtype: str
) -> None:
    slow = SlowMap(0.5, rule)
    for k, T in enumerate(POSES):
        slow.integrate(make_grid(k), T, 10.0 + 7.5 * k)
    with made({"url": tmp_path / f"{rule} {dtype}"}, make_grid, rule=rule, dtype=dtype) as world:
        grid, layers = world.window(AROUND), world.layers(AROUND)
    expected = {name: np.zeros(AROUND.shape) for name in ("free", "occupied", "to_occupied", "to_free", "count")}
    seen = np.full(AROUND.shape, np.nan)
    for (i, j), mass in slow.mass.items():
        at = i + 64, j + 56
        expected["free"][at], expected["occupied"][at] = mass
        expected["to_occupied"][at], expected["to_free"][at] = slow.conflict[i, j]
        expected["count"][at], seen[at] = slow.count[i, j], slow.seen[i, j]
    assert np.count_nonzero(expected["count"]) > 2000
    # each of four scans adds half a step of 1/4095; near certainty the cumulative rule makes more of it
    np.testing.assert_allclose(grid.free, expected["free"], atol=5e-3 if dtype == "uint16" else 2e-6)
    np.testing.assert_allclose(grid.occupied, expected["occupied"], atol=5e-3 if dtype == "uint16" else 2e-6)
    tolerance = 0.5 / 255 + 1e-3 if dtype == "uint16" else 2e-6
    np.testing.assert_allclose(layers["free_to_occupied"], expected["to_occupied"], atol=tolerance)
    np.testing.assert_allclose(layers["occupied_to_free"], expected["to_free"], atol=tolerance)
    np.testing.assert_array_equal(layers["count"], expected["count"])
    np.testing.assert_array_equal(layers["last_seen"], seen)


def test_a_scan_is_rounded_to_the_stated_step(tmp_path: Path, make_grid: MakeGrid) -> None:
    grid = make_grid()
    bounded = EvidentialGrid(grid.spec, grid.mass * np.float32(0.97))
    with WorldMap.create(tmp_path / "map", 0.5, 16) as world:
        world.integrate(bounded, np.eye(4))
        error = np.abs(world.window(grid.spec).mass.astype(float) - bounded.mass)
    assert 0.4 / 4095 < error.max() <= 0.5 / 4095 + 1e-7


@each("dtype", ["uint16", "float32"])
def test_numbers_that_are_no_masses_change_no_map(tmp_path: Path, make_grid: MakeGrid, dtype: str) -> None:
    with made({"url": tmp_path / "map"}, make_grid, dtype=dtype) as world:
        before, grid = world.window(AROUND), make_grid()
        for value in (np.nan, np.inf, -0.2, 1.5, 0.6):
            none = EvidentialGrid.trusted(grid.spec, np.full_like(grid.mass, value))
            refused("of the grid must be in|must add up to 1 at most", world.integrate, none, np.eye(4), stamp=50.0)
        refused("reliability must be", world.integrate, grid, np.eye(4), reliability=np.nan)
        assert world.window(AROUND) == before


def test_a_map_in_tiles_is_that_of_the_mapper(tmp_path: Path, make_grid: MakeGrid) -> None:
    mapper = EvidentialMapper(AROUND, cautious, float("inf"), window="fixed", max_speed=float("inf"))
    for k, T in enumerate(POSES):
        mapper.update(make_grid(k), T, stamp=10.0 + 7.5 * k)
    with made({"url": tmp_path / "map"}, make_grid, dtype="float32") as world:
        np.testing.assert_allclose(world.window(AROUND).mass, mapper.grid.mass, atol=1e-6)


@pytest.mark.parametrize("place", ["folder", "s3"], indirect=True)
def test_what_is_written_is_what_was_in_memory(place: Place, make_grid: MakeGrid) -> None:
    where = place()
    with made(where, make_grid) as world:
        before, layers, tiles = world.window(AROUND), world.layers(AROUND), world.tiles()
    with WorldMap.open(**where) as again:
        again._cache.get((0, 0))  # the other tiles are not in memory
        again._cache.get((-1, 0))
        assert again.window(AROUND) == before
        assert again.layers(AROUND) == layers
        assert again.tiles() == tiles
        assert len(tiles) > 10


def test_the_memory_does_not_change_the_map(place: Place, make_grid: MakeGrid) -> None:
    where = place()
    with made(where, make_grid, memory=1.0) as small, made(place(), make_grid) as large:
        assert len(small._cache._kept) == 4 < len(large._cache._kept)
        assert small.window(AROUND) == large.window(AROUND)
        assert small.layers(AROUND) == large.layers(AROUND)


def test_flushed_tiles_outlive_the_process(place: Place, make_grid: MakeGrid) -> None:
    where = place()
    world = made(where, make_grid)
    world.flush()
    kept = world.window(AROUND)
    world.integrate(make_grid(9), POSES[0], stamp=99.0)
    assert world.window(AROUND) != kept
    with WorldMap.open(**where) as other:  # as if the first process was killed now
        assert other.window(AROUND) == kept
    world._cache.clear()
    world.close()


def test_where_nothing_was_seen_is_no_tile(place: Place) -> None:
    spec = GridSpec.centered(40.0, 40.0, 0.5)
    mass = np.zeros((80, 80, 2), np.float32)
    mass[:10, :10] = 0.5
    where = place()
    with WorldMap.create(**where, resolution=0.5, tile=16) as world:
        assert world.integrate(EvidentialGrid(spec, mass), np.eye(4)) == 100
    with WorldMap.open(**where) as world:
        assert world.tiles() == [(-3, -3), (-3, -2), (-2, -3), (-2, -2)]
        assert not world.window(GridSpec(0.5, (30, 30), (1000.0, -7000.0))).mass.any()


def test_reliability_discounts_a_scan(tmp_path: Path, make_grid: MakeGrid) -> None:
    grid = make_grid()
    with WorldMap.create(tmp_path / "map", 0.5, 16, dtype="float32") as world:
        world.integrate(grid, np.eye(4), reliability=0.25)
        np.testing.assert_allclose(world.window(grid.spec).mass, 0.25 * grid.mass, atol=1e-6)


def test_finer_scans_are_averaged(tmp_path: Path, make_grid: MakeGrid) -> None:
    fine = make_grid(shape=(40, 40), resolution=0.25)
    with WorldMap.create(tmp_path / "map", 0.5, 16, dtype="float32", min_unknown=1e-4) as world:
        world.integrate(fine, np.eye(4))
        mean = fine.mass.reshape(20, 2, 20, 2, 2).mean(axis=(1, 3))
        np.testing.assert_allclose(world.window(GridSpec(0.5, (20, 20), (-5.0, -5.0))).mass, mean, atol=1e-6)


def test_a_turned_window_is_resampled_once(place: Place, make_grid: MakeGrid) -> None:
    spec, T = GridSpec.centered(20.0, 12.0, 0.4), pose(2.0, 1.0, yaw=0.7)
    with made(place(), make_grid) as world:
        turned, source = world.window(spec, T), world.window(AROUND)
        for ix, iy in [(0, 0), (13, 7), (49, 29), (25, 3), (30, 22)]:
            x, y = spec.cell_centers[0][ix, 0], spec.cell_centers[1][0, iy]
            at = T[:2, :2] @ (x, y) + T[:2, 3]
            np.testing.assert_array_equal(turned.mass[ix, iy], source.mass[AROUND.index(*at)])


@each("rule", ["cautious", "dempster", "cumulative"])
def test_a_merge_is_that_of_all_scans(place: Place, make_grid: MakeGrid, rule: Any) -> None:
    def part(numbers: range) -> WorldMap:
        world = WorldMap.create(**place(), resolution=0.5, tile=16, rule=rule, dtype="float32", min_unknown=1e-4)
        for k in numbers:  # at a reliability that keeps all masses below the bound, with which rules are associative
            world.integrate(make_grid(k), POSES[k], stamp=10.0 + 7.5 * k, reliability=0.8)
        return world

    with part(range(4)) as whole, part(range(2)) as first, part(range(2, 4)) as second:
        assert first.merge(second) == len(second.tiles())
        tolerance = 1e-5
        np.testing.assert_allclose(first.window(AROUND).mass, whole.window(AROUND).mass, atol=tolerance)
        merged, layers = first.layers(AROUND), whole.layers(AROUND)
        for name in ("count", "last_seen"):
            np.testing.assert_array_equal(merged[name], layers[name])


def test_merging_with_a_map_of_nothing_changes_nothing(place: Place, make_grid: MakeGrid) -> None:
    with made(place(), make_grid) as world, WorldMap.create(**place(), resolution=0.5, tile=16) as empty:
        before, layers = world.window(AROUND), world.layers(AROUND)
        world.merge(empty)
        assert (world.window(AROUND), world.layers(AROUND)) == (before, layers)
        empty.merge(world)
        assert (empty.window(AROUND), empty.layers(AROUND)) == (before, layers)


def test_overviews_keep_what_is_occupied(place: Place, make_grid: MakeGrid) -> None:
    with made(place(), make_grid) as world:
        assert world.levels == 1
        count = world.build_overviews()
        assert world.levels == count >= 3
        full = world.window(world.cells())
        for level in range(1, count):
            half = world.window(world.cells(level=level), level=level)
            n = 2**level
            i, j = (round(a / 0.5) - round(b / 0.5) for a, b in zip(full.spec.origin, half.spec.origin, strict=True))
            padded = np.zeros((half.spec.shape[0] * n, half.spec.shape[1] * n))
            padded[i : i + full.spec.shape[0], j : j + full.spec.shape[1]] = full.occupied
            blocks = padded.reshape(half.spec.shape[0], n, half.spec.shape[1], n).max(axis=(1, 3))
            np.testing.assert_array_equal(half.occupied, blocks.astype(np.float32))
            assert (half.free + half.occupied).max() <= 1 + 1e-6
            assert half.free.max() > 0.1
        assert world.build_overviews() == count


def test_a_zip_archive_has_all_of_the_map(place: Place, tmp_path: Path, make_grid: MakeGrid) -> None:
    with made(place(), make_grid) as world:
        world.build_overviews()
        world.copy_to(tmp_path / "map.zip")
        with WorldMap.open(tmp_path / "map.zip") as packed:
            assert packed.window(AROUND) == world.window(AROUND)
            assert packed.layers(AROUND) == world.layers(AROUND)
            assert packed.tiles() == world.tiles()
            assert packed.levels == world.levels
    refused("zip archive, which cannot be changed", WorldMap.open, tmp_path / "map.zip", "r+")
    assert len(set(zipfile.ZipFile(tmp_path / "map.zip").namelist())) > 10


@each("tile", [16, 512])
def test_a_folder_is_read_as_zarr_reads_it(tmp_path: Path, make_grid: MakeGrid, tile: int) -> None:
    with WorldMap.create(tmp_path / "map", 0.5, tile) as world:
        for k, T in enumerate(POSES):
            world.integrate(make_grid(k), T, stamp=10.0 + 7.5 * k)
        world.build_overviews()
        world.forget_tiles()
        for level in (0, 1):
            array, half = zarr.open_group(tmp_path / "map", mode="r")[str(level)], world.layout.cells >> (level + 1)
            for i, k, j, n in ((-30, 41, -29, 17), (-300, 300, -40, 44), (3, 4, -1, 0), (256, 257, 900, 901)):
                for layers in (slice(0, 2), slice(None)) if level else (slice(0, 2), slice(2, 7), slice(None)):
                    found = world.store.read((i, k, j, n), level, layers)
                    np.testing.assert_array_equal(found, array[layers, i + half : k + half, j + half : n + half])
                    assert found.any() or i >= 3


def test_a_tile_that_is_read_is_from_before_or_after_a_write(tmp_path: Path) -> None:
    with WorldMap.create(tmp_path / "map", 0.5, 512) as world:
        noise = np.random.default_rng(0).integers(0, 60, (7, 512, 512), np.uint16)
        tiles = [np.full_like(noise, 7), noise % 50]  # whose shards differ in size
        world.store.write_tile((0, 0), tiles[0])
        reader, ended, found = WorldMap.open(tmp_path / "map"), threading.Event(), set()

        def write() -> None:
            for k in range(12):
                world.store.write_tile((0, 0), tiles[k % 2])
            ended.set()

        thread = threading.Thread(target=write)
        thread.start()
        while not ended.is_set():
            box = reader.store.read((200, 300, 200, 300), 0, slice(0, 2))
            same = [bool(np.array_equal(box, tile[:2, 200:300, 200:300])) for tile in tiles]
            assert sum(same) == 1
            found.add(same[0])
        thread.join()
    assert found == {True, False}


def test_a_tile_that_is_cut_off_is_refused(tmp_path: Path, make_grid: MakeGrid) -> None:
    with made({"url": tmp_path / "map"}, make_grid) as world:
        index = world.tiles()[0]
    path = tmp_path / "map" / world.store.key(index)
    data = path.read_bytes()
    with WorldMap.open(tmp_path / "map") as world:
        for size in (0, 50, len(data) // 2, len(data) - 1):
            path.write_bytes(data[:size])
            refused(rf"tile \({index[0]}, {index[1]}\)", world.tile, index, error=OgmError)


@pytest.mark.slow
def test_every_flipped_byte_of_a_tile_is_found(tmp_path: Path, make_grid: MakeGrid) -> None:
    with made({"url": tmp_path / "map"}, make_grid) as world:
        clean = {index: world.tile(index) for index in world.tiles()}
    file = max((tmp_path / "map" / "0" / "c").rglob("*"), key=lambda one: one.stat().st_size if one.is_file() else 0)
    data = file.read_bytes()
    half = 2**21
    index = int(file.parent.name) - half, int(file.name) - half
    found = 0
    with WorldMap.open(tmp_path / "map") as world:
        for at in range(0, len(data), max(1, len(data) // 30)):
            file.write_bytes(data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :])
            damage = world.damage()
            if damage:
                assert [one for one, _ in damage] == [index]
                assert f"tile {index}" in str(damage[0][1])
            else:  # a byte that means nothing
                np.testing.assert_array_equal(world.tile(index), clean[index])
            found += bool(damage)
        file.write_bytes(data)
        assert world.damage() == []
    assert found > 25


def test_damaged_attributes_are_refused(tmp_path: Path, make_grid: MakeGrid) -> None:
    made({"url": tmp_path / "map"}, make_grid).close()
    file = tmp_path / "map" / "zarr.json"
    text = file.read_text()
    for before, after, wanted in (
        ('"resolution": 0.5', '"resolution": 0.25', "SHA-256 differs"),
        ("ogm.world/1", "ogm.world/7", "newer release"),
        ("ogm.world/1", "something", "not a world map"),
        ("{", "[", "cannot be read"),
    ):
        file.write_text(text.replace(before, after, 1))
        refused(wanted, WorldMap.open, tmp_path / "map", error=OgmError)


def test_places_that_make_no_sense_are_refused(place: Place, tmp_path: Path, make_grid: MakeGrid) -> None:
    where = place()
    refused("no world map", WorldMap.open, **where, error=FileNotFoundError)
    made(where, make_grid).close()
    refused("already", WorldMap.create, **where)
    message = "storage options are only for object stores"
    refused(message, WorldMap.create, tmp_path / "other", storage={"region": "x"})
    (tmp_path / "file").write_text("no map")
    refused("is a file", WorldMap.open, tmp_path / "file", error=OgmError)
    refused("the archive .* does not exist", WorldMap.open, tmp_path / "none.zip", error=FileNotFoundError)


def test_a_folder_has_one_writer(tmp_path: Path, make_grid: MakeGrid) -> None:
    with made({"url": tmp_path / "map"}, make_grid) as world:
        refused("", WorldMap.open, tmp_path / "map", "r+", error=BlockingIOError)
        world.flush()
        WorldMap.open(tmp_path / "map").close()
    WorldMap.open(tmp_path / "map", "r+").close()


def test_a_map_open_to_read_does_not_change(tmp_path: Path, make_grid: MakeGrid) -> None:
    world = made({"url": tmp_path / "map"}, make_grid)
    world.close()
    for closed in (world, WorldMap.open(tmp_path / "map")):
        refused("is read-only", closed.integrate, make_grid(), np.eye(4))
        refused("is read-only", closed.merge, closed)
        refused("is read-only", closed.build_overviews)


def test_numbers_out_of_range_are_refused(tmp_path: Path) -> None:
    for name, value, wanted in (
        ("tile", 100, "power of two"),
        ("resolution", -1, "resolution must be positive"),
        ("rule", "yager", "depend on the order"),
        ("dtype", "uint8", "uint16 or float32"),
        ("min_unknown", 0, "min_unknown"),
        ("min_unknown", 2e-4, "min_unknown"),
        ("drive_reliability", 0, "drive_reliability"),
        ("drive_reliability", 1.1, "drive_reliability"),
        ("memory", 0, "memory"),
    ):
        refused(wanted, WorldMap.create, tmp_path / "map", **{name: value})


def test_scans_that_make_no_sense_are_refused(tmp_path: Path, make_grid: MakeGrid) -> None:
    with WorldMap.create(tmp_path / "map", 0.5, 16) as world, WorldMap.create(tmp_path / "b", 0.25, 16) as finer:
        add, grid = world.integrate, make_grid()
        refused("must be rigid", add, grid, np.diag([1, 1, 2, 1.0]))
        refused("is tilted by", add, grid, pose(pitch=1.2))
        refused("stamp must be 0", add, grid, np.eye(4), stamp=-1.0)
        refused("reliability", add, grid, np.eye(4), reliability=1.5)
        refused("beyond the map", add, grid, pose(1e12))
        refused("too far", add, grid, pose(1e300))
        refused("EvidentialGrid", add, grid.mass, np.eye(4), error=TypeError)
        refused("other cells", world.merge, finer)
        refused("is empty", world.cells)
        refused("other cells than the map", world.layers, GridSpec(0.5, (4, 4), (0.1, 0.0)))
        refused("no level 3", world.window, AROUND, level=3)
        refused("must be a .zip archive", world.copy_to, tmp_path / "copy")


def test_counts_and_stamps_stay_in_their_range(tmp_path: Path) -> None:
    spec = GridSpec(0.5, (1, 1), (0.0, 0.0))
    grid = EvidentialGrid(spec, np.full((1, 1, 2), 0.25, np.float32))
    with WorldMap.create(tmp_path / "map", 0.5, 16) as world:
        world.integrate(grid, np.eye(4), stamp=2**32 - 2)
        world.integrate(grid, np.eye(4), stamp=5.0)  # a late scan does not put the clock back
        assert world.layers(spec)["last_seen"][0, 0] == np.float32(2**32 - 2)
        world._cache.get((0, 0))[4, 0, 0] = 65534
        for _ in range(3):
            world.integrate(grid, np.eye(4))
        assert world.layers(spec)["count"][0, 0] == 65535
        world.merge(world)
        assert world.layers(spec)["count"][0, 0] == 65535


def test_far_from_the_origin_cells_are_as_exact(place: Place, make_grid: MakeGrid) -> None:
    x, y = 691_608.0, 5_334_760.0  # of UTM, in whole cells
    with made(place(), make_grid) as near, WorldMap.create(**place(), resolution=0.5, tile=16) as far:
        for k, T in enumerate(POSES):
            far.integrate(make_grid(k), pose(x, y) @ T, stamp=10.0 + 7.5 * k)
        there = far.window(GridSpec(0.5, AROUND.shape, (AROUND.origin[0] + x, AROUND.origin[1] + y)))
        same = (there.mass == near.window(AROUND).mass).all(axis=-1)
        assert same.mean() > 0.999  # centres on edges of cells may round the other way


def test_opinions_are_those_of_the_cells_however_far_apart_points_are(tmp_path: Path, make_grid: MakeGrid) -> None:
    points = np.random.default_rng(0).uniform(-35, 30, (100, 2))
    with made({"url": tmp_path / "w"}, make_grid) as world:
        grid = world.window(AROUND)
        for method in ("nearest", "bilinear"):
            inside = AROUND.contains(*points.T)
            np.testing.assert_array_equal(
                world.opinion_at(points, method)[inside], grid.opinion_at(points[inside], method)
            )
            far = np.append(points, [[3e6, 2e6], [1e9, 0.0]], axis=0)  # the last one lies beyond the lattice
            np.testing.assert_array_equal(world.opinion_at(far, method)[-2:], [[0, 0, 1]] * 2)
        assert (grid.opinion_at(points)[:, 2] < 1).sum() > 5
        assert world.opinion_at((3.1, -2.2)) == grid.opinion_at((3.1, -2.2))
