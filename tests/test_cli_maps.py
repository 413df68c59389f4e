"""``ogm convert``, and maps of every format from ``ogm map`` and ``ogm fuse``."""

import errno
import importlib
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from cases import each, fail_call
from click.testing import Result
from commands import completed, ogm, refused_command
from wall_drive import HEIGHT, WALL, write_drive

from ogm.fusion import resampled
from ogm.geometric import RayISM
from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid
from ogm.io import GridLog, PlacedGrid, occupancy_from_costs, read_grid, read_placed_grid, write_grid
from ogm.io.logs import open_log
from ogm.io.messages import grid_from_occupancy_grid, transforms_from_tf
from ogm.io.messages.grids import occupancy_values
from ogm.planning import costmap
from ogm.pose import pose
from ogm.state import predict_state

FRAMES = 4
SMALL = ("--length", 24, "--width", 16, "--resolution", 0.5)
POSES = np.array([pose(0.7 * k, 0.05 * k, 0.1 * k, yaw=0.02 * k) for k in range(FRAMES)])
STAMPS = 1_700_000_000 + np.arange(FRAMES) / 10
SPEC = GridSpec(0.25, (9, 5), (-1.75, 2.5))


def grid() -> EvidentialGrid:
    mass = np.random.default_rng(1).dirichlet((1, 1, 1), SPEC.shape)[..., :2].astype(np.float32)
    mass[2:8, 1] = 0.05, 0.9
    mass[0] = 0
    return EvidentialGrid(SPEC, mass)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(tmp_path_factory.mktemp("drive"), POSES, STAMPS)


def fused(drive: Path, out: Path, *words: object) -> Result:
    given = ("--poses", drive / "poses.csv", "--sensor-height", HEIGHT, *SMALL)
    return ogm("fuse", drive, *given, "--out", out, *words)


def test_a_chain_of_conversions_brings_the_same_masses_back(tmp_path: Path) -> None:
    write_grid(tmp_path / "0.npz", grid())
    endings = ("tif", "nc", "zarr", "npz")
    for k, ending in enumerate(endings):
        before = next(tmp_path.glob(f"{k}.*"))
        result = completed("convert", before, tmp_path / f"{k + 1}.{ending}")
        assert "9 x 5 of 0.25 m" in result.output
    assert read_grid(tmp_path / "4.npz") == grid()


def test_a_pose_and_a_system_place_the_map_on_earth(tmp_path: Path) -> None:
    write_grid(tmp_path / "m.npz", grid())
    words = ("--crs", "EPSG:25832", "--pose", 367000, 5600000, -0.5)
    assert ogm("convert", tmp_path / "m.npz", tmp_path / "new" / "m.tif", *words).exit_code == 0
    placed = read_placed_grid(tmp_path / "new" / "m.tif")
    wanted = PlacedGrid(grid(), pose(367000, 5600000, yaw=-0.5)).corner
    assert placed.crs == "EPSG:25832"
    assert placed.corner == pytest.approx(wanted, abs=1e-8)
    refused_command("rotated by", "convert", tmp_path / "new" / "m.tif", tmp_path / "back.npz")
    assert ogm("convert", tmp_path / "new" / "m.tif", tmp_path / "m.yaml", "--mode", "raw").exit_code == 0
    assert read_placed_grid(tmp_path / "m.yaml").corner == pytest.approx(wanted, abs=1e-8)


def test_pictures_need_their_extent(tmp_path: Path) -> None:
    write_grid(tmp_path / "m.png", grid())
    assert "--length and --width" in ogm("convert", tmp_path / "m.png", tmp_path / "m.npz").output
    assert "both" in ogm("convert", tmp_path / "m.png", tmp_path / "m.npz", "--length", 4).output
    words = ("--length", 2.25, "--width", 1.25, "--resolution", 0.25)
    assert ogm("convert", tmp_path / "m.png", tmp_path / "m.npz", *words).exit_code == 0
    again = read_grid(tmp_path / "m.npz")
    assert again.spec == GridSpec.centered(2.25, 1.25, 0.25)
    np.testing.assert_allclose(again.mass, grid().mass, atol=1 / 255)


@each("words, message", [
        (("m.npz", "x.txt"), "a grid is written as .npz, .yaml"), (("m.npz", "m.npz"), "would overwrite"),
        (("m.yaml", "m.png"), "would overwrite"), (("none.npz", "x.tif"), "there is no file"),
        (("m.txt", "x.tif"), "no readable grid"), (("m.npz", "x.tif", "--mode", "raw"), "mode must be"),
        (("m.npz", "x.yaml", "--mode", "grey"), "mode must be"),
        (("m.npz", "x.tif", "--message", "grid-map"), "message is only for"),
        (("m.npz", "x.tif", "--topic", "/map"), "topic is only for"),
        (("m.npz", "x.tif", "--crs", "EPSG:4326"), "not projected in metres"),
        (("m.npz", "."), "a grid is written as"), (("m.npz", "m.yaml/x.tif"), "m.yaml"),
    ])  # fmt: skip
def test_wrong_words_are_one_line_and_exit_code_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("m.npz", "m.yaml"):
        write_grid(name, grid())
    before = sorted(tmp_path.iterdir())
    result = refused_command(message, "convert", *words)
    assert sum(line.startswith("ogm: ") for line in result.output.splitlines()) == 1, result.output
    assert sorted(tmp_path.iterdir()) == before


@each("name", ["rasterio", "xarray", "netCDF4", "zarr", "rosbags", "foxglove"])
def test_a_missing_package_is_named_with_the_line_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, drive: Path, name: str
) -> None:
    """Before the work: the scans of the drive are not read."""
    real_import, real_find = importlib.import_module, importlib.util.find_spec

    def missing(module: str, *more: object, **named: object) -> object:
        if module.split(".")[0] == name:
            raise ModuleNotFoundError(f"No module named {module!r}")
        return real_import(module, *more, **named)

    scientific = importlib.import_module("ogm.io.grids.scientific")
    monkeypatch.setattr(importlib, "import_module", missing)
    monkeypatch.setattr(scientific, "find_spec", lambda module: None if module == name else real_find(module))
    monkeypatch.setattr(RayISM, "__call__", None)
    ending = {"rasterio": "tif", "zarr": "zarr", "rosbags": "bag", "foxglove": "mcap"}.get(name, "nc")
    words = ("--message", "foxglove-grid") if name == "foxglove" else ()
    result = fused(drive, tmp_path / f"m.{ending}", *words)
    assert result.exit_code == 2
    assert f"m.{ending} cannot be written: {name} is not installed: " in result.output
    assert not list(tmp_path.iterdir())


@each("numbers, message, mapped", [
        (range(FRAMES), "no scan has evidence on the grid, nothing is written: .*divide them by 1000", False),
        ([1, 2], "2 of 4 scans have no evidence on the grid, the first: .*divide them by 1000", True),
    ])  # fmt: skip
def test_a_drive_that_shows_nothing_is_an_error_and_a_part_of_it_one_line(
    tmp_path: Path, numbers: Sequence[int], message: str, mapped: bool
) -> None:
    drive = write_drive(tmp_path, POSES, STAMPS)
    for k in numbers:
        points = np.fromfile(drive / f"{k}.bin", np.float32).reshape(-1, 4)
        (points * np.float32([1000, 1000, 1000, 1])).tofile(drive / f"{k}.bin")
    result = fused(drive, tmp_path / "m.npz")
    assert (result.exit_code == 0) == mapped
    assert len(re.findall(message, result.output)) == 1
    assert (tmp_path / "m.npz").exists() == mapped


def test_all_formats_hold_the_map_of_the_drive(drive: Path, tmp_path: Path) -> None:
    assert fused(drive, tmp_path / "m.npz").exit_code == 0
    wanted = EvidentialGrid.load(tmp_path / "m.npz")
    assert wanted.at(WALL + 0.25, 1.0).occupied > 0.7
    for ending in ("tif", "nc", "zarr", "yaml", "png", "mcap", "db3", "bag"):
        result = fused(drive, tmp_path / f"m.{ending}")
        assert result.exit_code == 0, result.output
        assert f"m.{ending}" in result.output
        again = read_grid(tmp_path / f"m.{ending}", wanted.spec)
        assert again.spec.shape == wanted.spec.shape
        assert again.spec.origin == pytest.approx(wanted.spec.origin)
        if ending in ("tif", "nc", "zarr"):
            assert np.array_equal(again.mass, wanted.mass)
        elif ending == "png":
            np.testing.assert_allclose(again.mass, wanted.mass, atol=1 / 255)
        else:
            assert np.array_equal(predict_state(again.mass), predict_state(wanted.mass))
    assert result.output.count("mapped") == 1


@each("ending", ["mcap", "db3", "bag"])
def test_a_log_has_the_map_and_the_pose_after_each_scan(drive: Path, tmp_path: Path, ending: str) -> None:
    assert fused(drive, tmp_path / f"m.{ending}").exit_code == 0
    assert fused(drive, tmp_path / "m.npz").exit_code == 0
    with open_log(tmp_path / f"m.{ending}") as log:
        messages = list(log.messages())
        assert log.topics["/map"].type == "nav_msgs/msg/OccupancyGrid"
    assert [one.topic for one in messages] == ["/tf", "/map"] * FRAMES
    assert [one.log_time for one in messages[::2]] == pytest.approx(STAMPS, abs=1e-6)
    for k, (tf, map_) in enumerate(zip(messages[::2], messages[1::2], strict=True)):
        (one,) = transforms_from_tf(tf.decode())
        assert (one.parent, one.child, one.stamp) == ("map", "vehicle", pytest.approx(STAMPS[k], abs=1e-6))
        np.testing.assert_allclose(one.T_parent_child, POSES[k] @ pose(z=-HEIGHT), atol=1e-9)  # on the ground
        message = map_.decode()
        made, T = grid_from_occupancy_grid(message)
        assert message.header.frame_id == "map"
        assert T[2, 3] == pytest.approx(0.1 * k - HEIGHT)
        assert made.spec.contains(*POSES[k][:2, 3])
    wanted = EvidentialGrid.load(tmp_path / "m.npz")
    assert np.array_equal(occupancy_values(made), occupancy_values(wanted))


def test_ctrl_c_keeps_the_maps_so_far(drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fail_call(monkeypatch, RayISM, "__call__", 3)
    assert fused(drive, tmp_path / "m.mcap", "--message", "grid-map").exit_code == 130
    with open_log(tmp_path / "m.mcap") as log:
        assert log.topics["/map"].count == 2
        assert log.topics["/map"].type == "grid_map_msgs/msg/GridMap"
    placed = read_placed_grid(tmp_path / "m.mcap")
    assert placed.grid.at(WALL + 0.25, 1.0).occupied > 0.5
    assert list(placed.layers.layers) == ["free_to_occupied", "occupied_to_free"]


def test_ctrl_c_while_the_first_map_is_logged_keeps_it(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_call(monkeypatch, GridLog, "write", 1)
    assert fused(drive, tmp_path / "m.mcap").exit_code == 130
    assert read_grid(tmp_path / "m.mcap").at(WALL + 0.25, 1.0).occupied > 0.5


def test_a_full_disk_leaves_earlier_outputs(drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(tmp_path / "m.db3"))
    fail_call(monkeypatch, GridLog, "write", 2, full)
    for name in ("m.db3", "poses.txt"):
        (tmp_path / name).write_text("earlier")
    result = fused(drive, tmp_path / "m.db3", "--save-poses", tmp_path / "poses.txt")
    assert result.exit_code == 1
    assert "m.db3: No space left on device" in result.output
    assert [(tmp_path / name).read_text() for name in ("m.db3", "poses.txt")] == ["earlier", "earlier"]


def test_nothing_that_is_read_or_no_grid_is_overwritten(drive: Path, tmp_path: Path) -> None:
    (tmp_path / "data.zarr").mkdir()
    result = fused(drive, tmp_path / "data.zarr")
    assert result.exit_code == 2
    assert "is no grid of ogm" in result.output
    refused_command(
        "would replace the input", "fuse", drive / "0.bin", drive / "m.bag", "--out", drive / "m.bag", *SMALL
    )
    result = fused(drive, tmp_path / "m.png", "--picture", tmp_path / "m.png")
    assert "both be written" in result.output
    result = fused(drive, tmp_path / "m.npz", "--message", "grid-map")
    assert "message is only for" in result.output


@each("ending", ["zarr", "png", "mcap"])
def test_a_scan_is_mapped_to_every_format(drive: Path, tmp_path: Path, ending: str) -> None:
    words = ("--sensor-height", HEIGHT, *SMALL)
    for _ in range(2):  # the second time over the first
        completed("map", drive / "0.bin", "--out", tmp_path / f"m.{ending}", *words)
    assert ogm("map", drive / "0.bin", "--out", tmp_path / "m.npz", *words).exit_code == 0
    wanted = EvidentialGrid.load(tmp_path / "m.npz")
    again = read_grid(tmp_path / f"m.{ending}", wanted.spec)
    assert again.spec.shape == wanted.spec.shape
    if ending in ("tif", "nc", "zarr"):
        assert again == wanted
    if ending == "mcap":
        assert read_placed_grid(tmp_path / "m.mcap").frame_id == "vehicle"


@each("words", [(), ("--ism", "ray", "--window", "fixed", "--half-life", "inf")])
def test_a_drive_goes_on_with_a_saved_map(drive: Path, tmp_path: Path, words: Sequence[object]) -> None:
    far = POSES + pose(900.0) - pose()
    for name, poses, stamps in (("a", POSES[:2], STAMPS[:2]), ("b", POSES[2:], STAMPS[2:]), ("far", far, STAMPS)):
        (tmp_path / name).mkdir()
        write_drive(tmp_path / name, poses, stamps)
    assert fused(drive, tmp_path / "whole.npz", *words).exit_code == 0
    assert fused(tmp_path / "a", tmp_path / "a.npz", *words).exit_code == 0
    result = fused(tmp_path / "b", tmp_path / "b.npz", "--continue", tmp_path / "a.npz", *words)
    assert result.exit_code == 0, result.output
    whole, found = (read_placed_grid(tmp_path / f"{name}.npz") for name in ("whole", "b"))
    assert found.stamp == whole.stamp
    around = resampled(found, whole.grid.spec)
    np.testing.assert_allclose(around.grid.mass, whole.grid.mass, atol=1e-5)
    for name in ("free_to_occupied", "occupied_to_free"):
        np.testing.assert_allclose(around.layers[name], whole.layers[name], atol=1e-5)
    if words:
        return
    late = fused(tmp_path / "a", tmp_path / "c.npz", "--continue", tmp_path / "b.npz")
    assert "it does not age in between" in late.output
    assert late.exit_code == 0
    result = fused(tmp_path / "far", tmp_path / "d.npz", "--continue", tmp_path / "a.npz")
    assert "has no cell in the window" in result.output
    result = fused(drive, tmp_path / "d.npz", "--continue", tmp_path / "a.npz", "--dynamic")
    assert "a saved map is continued by the rules revise, cautious" in result.output


def test_maps_are_merged_cut_and_made_coarser(tmp_path: Path) -> None:
    layers = LayeredGrid(SPEC, {"slope": grid().free, "occupied_to_free": grid().occupied})
    write_grid(tmp_path / "a.npz", PlacedGrid(grid(), layers=layers))
    words = ("--merge", tmp_path / "a.npz", "--merge-pose", 1.0, 0.0, 0.0, "--rule", "dempster")
    assert (
        "layers  slope, occupied_to_free" in completed("convert", tmp_path / "a.npz", tmp_path / "b.tif", *words).output
    )
    merged = read_placed_grid(tmp_path / "b.tif")
    assert merged.grid.spec.shape == (13, 5)
    np.testing.assert_array_equal(merged.grid.mass[:4], grid().mass[:4])
    completed("convert", tmp_path / "b.tif", tmp_path / "c.npz", "--extent", -1.75, -0.75, 2.5, 9, "--side", 0.5)
    assert read_placed_grid(tmp_path / "c.npz").grid.spec == GridSpec(0.5, (2, 3), SPEC.origin)
    completed("convert", tmp_path / "b.tif", tmp_path / "d.yaml", "--layer", "slope", "--layer-values", 1, 0)
    assert "mode: scale" in (tmp_path / "d.yaml").read_text()
    values = occupancy_values(read_grid(tmp_path / "d.yaml"))[:9]
    np.testing.assert_array_equal(values, np.rint(100 * (1 - grid().free)))
    for message, words in (
        ("--merge-pose and --rule need --merge", ("--rule", "dempster")),
        ("there is no layer 'step'", ("--layer", "step")),
        ("--rule must be one of", ("--merge", tmp_path / "a.npz", "--rule", "bayes")),
        ("touches no cell of the map", ("--extent", 50, 60, 0, 1)),
    ):
        refused_command(message, "convert", tmp_path / "b.tif", tmp_path / "e.npz", *words)
    assert completed("info", tmp_path / "b.tif").output.count("...") == 4  # x, y, two layers
    page = completed("view", tmp_path / "b.tif", "--out", tmp_path / "b.html")
    assert "13 x 5 cells" in page.output
    assert b'"slope"' in (tmp_path / "b.html").read_bytes()


def test_convert_starts_without_the_heavy_packages() -> None:
    code = "import sys, ogm.cli; print(*{name.split('.')[0] for name in sys.modules})"
    loaded = set(subprocess.check_output([sys.executable, "-c", code], text=True).split())
    assert not loaded & {"rasterio", "xarray", "netCDF4", "zarr", "rosbags", "mcap", "foxglove", "PIL", "yaml", "scipy"}


def test_costs_are_written_as_each_format_holds_them(tmp_path: Path) -> None:
    write_grid(tmp_path / "m.npz", grid())
    numbers = ("--inflation-radius", 1.0, "--inscribed-radius", 0.25, "--cost-scaling", 3)
    costs = costmap(grid(), 0.25, 1.0, 3.0)
    messages = {"o.mcap": "occupancy-grid", "g.mcap": "grid-map"}
    for name in ("c.yaml", "o.mcap", "g.mcap", "c.db3", "c.npz"):
        words = ("--message", messages[name]) if name in messages else ()
        result = completed("costmap", tmp_path / "m.npz", tmp_path / name, *numbers, *words)
        assert f"obstacle {100 * (costs == 254).mean():.1f} %" in result.output
    percent = occupancy_values(occupancy_from_costs(LayeredGrid(SPEC, {"cost": costs})))
    assert 99 in percent
    for name in ("c.yaml", "o.mcap"):
        np.testing.assert_array_equal(occupancy_values(read_grid(tmp_path / name)), percent)
    with open_log(tmp_path / "c.db3") as log:
        (message,) = log.messages(["/costmap_raw"])
        np.testing.assert_array_equal(np.reshape(message.decode().data, SPEC.shape[::-1]).T, costs)
    for name in ("g.mcap", "c.npz"):
        placed = read_placed_grid(tmp_path / name)
        assert placed.grid == grid()
        np.testing.assert_array_equal(placed.layers["cost"], costs)
    completed("costmap", tmp_path / "c.npz", tmp_path / "d.npz", *numbers[:2], "--unknown", "free")
    assert read_placed_grid(tmp_path / "d.npz").layers["cost"].max() == 254
    given = ("costmap", tmp_path / "m.npz", tmp_path / "x.npz", *numbers)
    refused_command("unknown must be one of", *given, "--unknown", "x")
    refused_command("would overwrite", "costmap", tmp_path / "m.npz", tmp_path / "m.npz", *numbers)
    log_words = (tmp_path / "x.db3", "--message", "costmap")
    refused_command("wanted a layer cost, got free", "convert", tmp_path / "m.npz", *log_words)
    refused_command("--message costmap is for costs", "fuse", tmp_path, "--out", *log_words)
