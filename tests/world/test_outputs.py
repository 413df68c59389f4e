"""World maps in other formats, and the commands ``ogm world``."""

import json
from pathlib import Path

import numpy as np
import pytest
from cases import refused
from commands import completed, ogm
from PIL import Image
from wall_drive import write_drive
from world_frames import RandomGrids, StraightDrive

from ogm.grid import EvidentialGrid, GridSpec
from ogm.io import read_grid, read_placed_grid, write_poses
from ogm.plot.colours import colours
from ogm.pose import Trajectory, pose
from ogm.world import WorldMap, build_world, world_to_xarray, write_pyramid

FRAMES = 6
SMALL = ("--length", 24, "--width", 16, "--resolution", 0.5, "--tile", 32)
POSES = np.array([pose(0.7 * k, 0.05 * k, yaw=0.02 * k) for k in range(FRAMES)])
STAMPS = 1_700_000_000 + np.arange(FRAMES) / 10


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(tmp_path_factory.mktemp("drive"), POSES, STAMPS)


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> WorldMap:
    """Give a map of two drives with overviews."""
    world = WorldMap.create(tmp_path_factory.mktemp("town") / "map", 0.5, 32, crs="EPSG:25832")
    drives = {"a": StraightDrive(20), "b": StraightDrive(15, (0.0, 10.0, 1.5), 2)}
    build_world(world, drives, RandomGrids())
    world.build_overviews()
    world.close()
    return WorldMap.open(world.url)


def test_the_view_by_xarray_has_the_cells_of_the_windows(town: WorldMap) -> None:
    for level in range(2):
        lazy = world_to_xarray(town, level)
        assert lazy.free.chunks is not None  # nothing is read yet
        spec = town.cells(level=level)
        grid = town.window(spec, level=level)
        np.testing.assert_array_equal(lazy.free.values.T, grid.free)
        np.testing.assert_array_equal(lazy.occupied.values.T, grid.occupied)
        np.testing.assert_allclose(lazy.x.values, spec.cell_centers[0].ravel())
        np.testing.assert_allclose(lazy.y.values, spec.cell_centers[1].ravel())
        assert lazy.attrs["crs"] == "EPSG:25832"
    np.testing.assert_array_equal(world_to_xarray(town)["count"].values.T, town.layers(town.cells())["count"])


def test_pictures_show_the_cells_where_they_lie(town: WorldMap, tmp_path: Path) -> None:
    count = write_pyramid(town, tmp_path / "pictures")
    facts = json.loads((tmp_path / "pictures" / "tiles.json").read_text())
    files = list((tmp_path / "pictures").rglob("*.png"))
    assert len(files) == count > len(town.tiles())
    found = 0
    for path in files:
        z, x, y = int(path.parts[-3]), int(path.parts[-2]), int(path.stem)
        side = facts["resolution"][z]
        picture = np.asarray(Image.open(path))
        assert picture.shape == (32, 32, 4)
        for row, column in [(0, 0), (5, 17), (31, 2), (20, 30)]:
            at = facts["corner"][0] + (32 * x + column + 0.5) * side, facts["corner"][1] - (32 * y + row + 0.5) * side
            cell = town.window(
                GridSpec(side, (1, 1), (at[0] - side / 2, at[1] - side / 2)), level=facts["levels"] - 1 - z
            )
            free, occupied = cell.mass[0, 0]
            known = free + occupied
            assert abs(int(picture[row, column, 3]) - 255 * known) <= 0.51
            if known > 0:
                mixed = 255 * colours().mix(cell.mass[0, 0] / known)
                assert (np.abs(picture[row, column, :3] - mixed) <= 0.51).all()
                found += 1
    assert found > 20
    refused("already", write_pyramid, town, tmp_path / "pictures")
    with WorldMap.create(tmp_path / "empty", 0.5, 32) as empty:
        refused("no overviews", write_pyramid, empty, tmp_path / "more")


def test_a_map_is_built_moved_and_exported_by_commands(drive: Path, tmp_path: Path) -> None:
    url = tmp_path / "map"
    given = ("--poses", drive / "poses.csv", "--crs", "EPSG:25832", *SMALL)
    result = completed("world", "build", drive, "--out", url, *given)
    assert f"{FRAMES} frames, 1 of 1 sub-maps" in result.output
    with WorldMap.open(url) as world:
        assert world.layout.tile == 32
        assert world.window(GridSpec(0.5, (1, 1), (10.0, 0.0))).occupied[0, 0] > 0.5
        assert world.window(GridSpec(0.5, (1, 1), (5.0, 0.0))).free[0, 0] > 0.5
        whole = world.window(world.cells())
    info = ogm("world", "info", url).output
    assert "EPSG:25832" in info
    assert f"{FRAMES} frames" in info
    name = f"{drive.name}-{drive.name}" if f"{drive.name}-{drive.name}" in info else drive.name
    extent = ("--extent", -5, 15, -6, 6)
    for ending in ("tif", "npz", "yaml", "nc"):
        assert ogm("world", "export", url, tmp_path / f"part.{ending}", *extent).exit_code == 0
    part = read_grid(tmp_path / "part.npz")
    assert part.spec.extent == (-5.0, 15.0, -6.0, 6.0)
    placed = read_placed_grid(tmp_path / "part.tif")
    assert isinstance(placed.grid, EvidentialGrid)
    np.testing.assert_array_equal(placed.grid.mass, part.mass)
    assert placed.crs is not None
    assert ogm("world", "export", url, tmp_path / "map.zip").exit_code == 0
    with WorldMap.open(tmp_path / "map.zip") as packed:
        assert packed.window(packed.cells()) == whole
    assert "pictures" in ogm("world", "export", url, tmp_path / "pictures").output
    assert ogm("view", url, "--out", tmp_path / "map.html").exit_code == 0
    assert (tmp_path / "map.html").stat().st_size > 10_000
    # a loop closure moves the wall by 4 m
    moved = np.array([pose(4.0) @ T for T in POSES])
    write_poses(tmp_path / "moved.csv", Trajectory(STAMPS, moved))
    assert ogm("world", "rebuild", url, "--drive", name, "--poses", tmp_path / "moved.csv").exit_code == 0
    with WorldMap.open(url) as world:
        assert world.window(GridSpec(0.5, (1, 1), (14.0, 0.0))).occupied[0, 0] > 0.5
        assert world.window(GridSpec(0.5, (1, 1), (10.0, 0.0))).free[0, 0] > 0.5
    graph = "".join(f"VERTEX_SE2 {k} {T[0, 3]} {T[1, 3]} {0.02 * k}\n" for k, T in enumerate(POSES))
    (tmp_path / "back.g2o").write_text(graph)
    assert ogm("world", "rebuild", url, "--drive", name, "--poses", tmp_path / "back.g2o").exit_code == 0
    with WorldMap.open(url) as world:
        again = world.window(whole.spec)
        assert np.abs(again.mass - whole.mass).max(axis=-1).mean() < 0.02  # angles of g2o are rounded


@pytest.mark.slow
def test_a_map_is_built_into_a_bucket_by_the_environment(
    drive: Path, s3: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    environment = {
        "AWS_ENDPOINT_URL": s3["endpoint"],
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_REGION": "us-east-1",
        "AWS_ALLOW_HTTP": "true",
    }
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    url = "s3://maps/by-command"
    assert ogm("world", "build", drive, "--poses", drive / "poses.csv", "--out", url, *SMALL).exit_code == 0
    assert f"{FRAMES} frames, 1 of 1" in ogm("world", "info", url).output
    with WorldMap.open(url, storage=s3) as world:
        assert world.window(GridSpec(0.5, (1, 1), (10.0, 0.0))).occupied[0, 0] > 0.5


def test_commands_refuse_what_makes_no_sense(drive: Path, tmp_path: Path) -> None:
    (tmp_path / "bare").mkdir()
    for path in drive.glob("*.bin"):  # without the poses
        (tmp_path / "bare" / path.name).write_bytes(path.read_bytes())
    for words, wanted in (
        (("build", tmp_path / "bare", "--out", tmp_path / "map", *SMALL), "has a pose"),
        (("build", drive, drive, "--poses", drive / "poses.csv", "--out", tmp_path / "map"), "once per dataset"),
        (("build", drive, "--out", tmp_path / "map", "--ism", "nothing"), "nothing"),
        (("info", tmp_path / "none"), "no world map"),
        (("export", tmp_path / "none", tmp_path / "x.tif"), "no world map"),
    ):
        result = ogm("world", *words)
        assert result.exit_code == 2, words
        assert wanted in " ".join(result.output.split()), result.output
