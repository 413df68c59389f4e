"""The command line, as a person uses it."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cases import each
from commands import completed, ogm, refused_command
from moving import street
from PIL import Image
from typer.main import get_command

from ogm import EvidentialGrid, GridSpec, LayeredGrid, UnknownCause
from ogm.cli import app
from ogm.cli.console import distinct, with_options
from ogm.io import write_grid, write_poses
from ogm.models import Calibration
from ogm.plot.viewer import write_view
from ogm.pose import Trajectory, pose
from ogm.world import WorldMap


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    """A KITTI file with a plane and a wall."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-20, -20, 0, 0), (20, 20, 1, 1), (20_000, 4)).astype(np.float32)
    points[:, 2] = -1.7
    points[:300, :3] = np.stack([np.full(300, 8.0), rng.uniform(-3, 3, 300), rng.uniform(-1.5, 0.5, 300)], 1)
    points.tofile(tmp_path / "wall.bin")
    return tmp_path / "wall.bin"


SMALL = ("--length", 32, "--width", 32, "--resolution", 0.5)


def test_demo_writes_pictures_and_a_table(tmp_path: Path) -> None:
    result = completed("demo", "--out", tmp_path)
    assert "208680" in result.output
    assert "10198" in result.output
    assert result.output.count("combined") == 2
    assert (tmp_path / "ogm-demo.png").stat().st_size > 50_000
    assert (tmp_path / "ogm-demo-sector.png").stat().st_size > 20_000
    grid = EvidentialGrid.load(tmp_path / "ogm-demo.npz")
    assert grid.spec.shape == (512, 352)
    assert grid.at(20, 5).free > 0.9  # the lane ahead
    assert grid.at(10, 9.2).occupied > 0.5  # its left border


@each("model", ["ray", "height-band", "height-band-released"])
def test_map_writes_the_grid_and_its_picture(scan: Path, tmp_path: Path, model: str) -> None:
    out, picture = tmp_path / "o.npz", tmp_path / "o.png"
    result = completed("map", scan, "--ism", model, "--out", out, "--picture", picture, *SMALL)
    assert ("sensor height 1.70 m, estimated" in result.output) == (model != "height-band-released")
    assert EvidentialGrid.load(out).at(8.1, 0.1).occupied > 0.15
    assert picture.exists()


UNKNOWN = {  # change of the points, and what is told
    (1000, (0, 0, 0)): "probably millimetres: divide them by 1000",
    (1, (1500, -800, 115)): "probably map coordinates, around (1500, -800, 115) m: give --sensor-position, or points",
    (1, (0, 0, 15)): "the ground is expected at z 0.00 m: check --sensor-height and --axes",
    (3, (0, 0, 0)): "",
}


@each("change", UNKNOWN)
def test_a_scan_that_shows_nothing_is_an_error_that_tells_where_its_points_lie(
    scan: Path, tmp_path: Path, change: tuple[int, tuple[int, int, int]]
) -> None:
    points = np.fromfile(scan, np.float32).reshape(-1, 4)
    points[:, :3] = points[:, :3] * change[0] + np.float32(change[1])
    other = scan.with_name("other.bin")
    points.tofile(other)
    words = ("--ism", "ray", "--sensor-height", 1.7, "--out", tmp_path / "o.npz", *SMALL)
    if UNKNOWN[change]:
        for options in (words, ("--ism", "ray", *words[4:])):  # a height that nothing states is estimated
            result = ogm("map", other, *options)
            told = UNKNOWN[change] if options is words or change[1] != (0, 0, 15) else "shows the ground"
            assert (result.exit_code, told.split(",")[0] in result.output) == (2, True), result.output
        assert not (tmp_path / "o.npz").exists()
    else:  # the ground is seen too high, but some of it is on the grid
        assert "written" in completed("map", other, *words).output


def test_default_names_replace_no_other_grid(scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    words = ("map", scan, "--ism", "ray", "--sensor-height", 1.7)
    for _ in range(2):
        assert "written wall.npz, wall.png" in completed(*words, *SMALL).output
    before = [Path(name).read_bytes() for name in ("wall.npz", "wall.png")]
    refused_command("wall.npz exists and is no result of this command: give --out and --picture", *words)
    Path("wall.npz").unlink()
    refused_command("wall.png exists and is no result", *words, *SMALL)
    assert Path("wall.png").read_bytes() == before[1]


def test_messages_have_the_words_of_the_command_line(scan: Path, tmp_path: Path) -> None:
    assert with_options("give `sensor_height` [m], `window=rolling`, or `ogm fuse`; see `Scan.time`, `topic`") == (
        "give --sensor-height [m], --window rolling, or `ogm fuse`; see `Scan.time`, --topic"
    )
    for words, message in (
        (("map", scan, "--topic", "/a"), "--topic and --frame are for logs"),
        (("map", scan, "--sensor", "radar"), "--sensor is for datasets"),
        (("fuse", scan, "--out", tmp_path / "m.npz"), "give --poses (KITTI, KITTI-360, TUM), or --odometry kiss-icp"),
    ):
        refused_command(message, *words)


def test_map_many_goes_on_after_a_bad_file(scan: Path, tmp_path: Path) -> None:
    again = scan.with_name("more.bin")
    again.write_bytes(scan.read_bytes())
    bad = scan.with_name("bad.bin")
    bad.write_bytes(b"xyz")
    refused_command("bad.bin", "map", scan, bad, again, "--out", tmp_path / "grids", "--sensor-height", 1.7, *SMALL)
    assert sorted(path.name for path in (tmp_path / "grids").iterdir()) == ["more.npz", "wall.npz"]


def test_points_in_the_vehicle_frame(scan: Path, tmp_path: Path) -> None:
    points = np.fromfile(scan, np.float32).reshape(-1, 4) + np.float32([1.5, 0, 1.4, 0])
    points.tofile(tmp_path / "vehicle.bin")
    result = ogm("map", tmp_path / "vehicle.bin", "--sensor-position", 1.5, 0, 1.4, "--out", tmp_path / "v.npz", *SMALL)
    assert "sensor height 1.70 m" in result.output
    assert EvidentialGrid.load(tmp_path / "v.npz").at(9.6, 0.1).occupied > 0.5


def test_beams_without_a_return_reach_the_model(tmp_path: Path) -> None:
    """An organised scan whose front came back empty: the ground there is cleared all the same."""
    elevation, azimuth = np.radians(np.linspace(-20, -3, 16)), np.radians(np.arange(0, 360, 1.0))
    run = 1.7 / np.tan(-elevation)[:, None] + 0 * azimuth
    raster = np.stack([run * np.cos(azimuth), run * np.sin(azimuth), 0 * run - 1.7, 0 * run + 0.5], axis=-1).astype(
        np.float32
    )
    raster[8:, 20:60] = 0
    np.save(tmp_path / "organised.npy", raster)
    completed("map", tmp_path / "organised.npy", "--sensor-height", 1.7, "--out", tmp_path / "o.npz", *SMALL)
    assert EvidentialGrid.load(tmp_path / "o.npz").at(8.0, 6.5).free > 0.02


def test_a_folder_is_mapped_scan_by_scan(scan: Path, tmp_path: Path) -> None:
    drive = tmp_path / "drive"
    drive.mkdir()
    for name in ("a_0.bin", "a_1.bin"):
        (drive / name).write_bytes(scan.read_bytes())
    out = tmp_path / "new" / "grids"
    completed("map", drive, "--out", out, "--first", 1, *SMALL)
    assert [path.name for path in out.iterdir()] == ["a_0.npz"]
    for command in ("map", "fuse", "serve", "calibrate", "evaluate"):
        refused_command("--first must be at least 1, got 0", command, drive, "--first", 0)
    refused_command("--first must be at least 1", "world", "build", drive, "--out", tmp_path / "w", "--first", 0)
    completed("map", drive, "--out", out, *SMALL)
    assert sorted(path.name for path in out.iterdir()) == ["a_0.npz", "a_1.npz"]
    ogm("map", scan, "--out", tmp_path / "one.npz", *SMALL)
    one, of_folder = EvidentialGrid.load(tmp_path / "one.npz"), EvidentialGrid.load(out / "a_0.npz")
    assert one == of_folder


@each("resolution, shape", [(0.1, (819, 563)), (0.2, (410, 282))])
def test_the_default_extent_follows_the_resolution(
    scan: Path, tmp_path: Path, resolution: float, shape: tuple[int, int]
) -> None:
    path = tmp_path / "new" / "folder" / "x.npz"
    result = completed("map", scan, "--resolution", resolution, "--out", path)
    assert EvidentialGrid.load(path).spec.shape == shape
    assert "sensor model ray: the learned model needs cells of 0.16 m" in result.output.replace("\n", " ")


def test_without_the_network_the_model_is_ray(scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ("map", scan, "--length", 20.48, "--width", 20.48, "--sensor-height", 1.7, "--out")
    whole = ogm(*words, tmp_path / "whole.npz")
    assert "cells of 0.16 m, combined" in whole.output
    assert "sensor model" not in whole.output
    monkeypatch.setattr("ogm.models.named.find_spec", lambda name: None)
    alone = ogm(*words, tmp_path / "alone.npz")
    assert "sensor model ray: without the learned model, which `" in alone.output
    assert "cells of 0.16 m, ray" in alone.output


def test_folders_of_outputs_are_made_before_the_work(scan: Path, tmp_path: Path) -> None:
    scan.write_bytes(b"xyz")
    assert ogm("map", scan, "--out", tmp_path / "new" / "x.npz").exit_code == 2
    assert (tmp_path / "new").is_dir()


@each("names, short", [
        (["a", "b"], ["a", "b"]),
        ([f"{'n' * 60}_{k}" for k in "12"], ["…nnn_1", "…nnn_2"]),
        (["x" * 60], [f"{'x' * 17}…{'x' * 17}"]),
        ([], []),
    ])  # fmt: skip
def test_short_names_keep_the_part_that_differs(names: list[str], short: list[str]) -> None:
    assert distinct(names) == short


def test_info_on_scans_and_grids(scan: Path, tmp_path: Path) -> None:
    result = ogm("info", scan)
    assert "20000" in result.output
    assert "1.70 m below" in result.output
    ogm("map", scan, "--out", tmp_path / "o.npz", *SMALL)
    result = ogm("info", tmp_path / "o.npz")
    assert "64 x 64 of 0.5 m" in result.output
    assert "unknown" in result.output


def test_info_reads_what_ogm_writes(tmp_path: Path) -> None:
    spec = GridSpec(0.5, (20, 16), (-5.0, -4.0))
    grid, poses = EvidentialGrid.vacuous(spec), np.array([pose(k) for k in range(4)])
    wanted = dict.fromkeys(("m.yaml", "m.tif", "m.nc", "m.zarr", "m.npz"), "20 x 16 of 0.5 m")
    for name in (*wanted, "m.mcap", "m.db3", "m.png"):
        write_grid(tmp_path / name, grid)
    write_poses(tmp_path / "p.csv", Trajectory(range(4), poses))
    write_view(tmp_path / "m.html", grid)
    Image.new("RGB", (6, 4)).save(tmp_path / "photo.jpg")
    Calibration("ray", {"p_miss": 0.6}).save(tmp_path / "ray.json")
    with WorldMap.create(tmp_path / "world", 0.5, 16) as world:
        world.integrate(EvidentialGrid(spec, np.full_like(grid.mass, 0.3)), np.eye(4))
        world.copy_to(tmp_path / "world.zip")
    (tmp_path / "report").mkdir()
    (tmp_path / "report" / "report.json").write_text(
        '{"format": "ogm.evaluation/4", "data": {"name": "town"}, "extent": "9 frames", "methods": {"ray": {}}}'
    )
    wanted |= {"m.mcap": "/map", "m.db3": "/map", "m.png": "picture", "m.html": "page", "photo.jpg": "6 x 4 pixels"}
    wanted |= {
        "p.csv": "3.0 m",
        "ray.json": "p_miss 0.6",
        "world": "world map",
        "world.zip": "world map",
        "report": "town",
    }
    for name, text in wanted.items():
        assert text in completed("info", tmp_path / name).output, name
    for name in ("report/report.json", "m.zarr/zarr.json"):
        assert completed("info", tmp_path / name).output
    (tmp_path / "report" / "report.json").write_text("[]")
    (tmp_path / "world" / "zarr.json").write_text("{")
    for name, text in {"report": "wanted a JSON object", "world": "zarr.json", "none": "there is no"}.items():
        refused_command(text, "info", tmp_path / name)


def test_info_on_dynamic_and_layered_grids(tmp_path: Path) -> None:
    street().save(tmp_path / "d.npz")
    street().to_layers().save(tmp_path / "l.npz")
    found = [" ".join(ogm("info", tmp_path / name).output.split()) for name in ("d.npz", "l.npz")]
    assert "format dynamic grid" in found[0]
    assert "dynamic 2.6 %" in found[0]
    assert "format layered grid" in found[1]
    assert "velocity_x -6 ... 8" in found[1]


@each("words, text", [
        (("map", "none.pcd"), "none.pcd"),
        (("info", "none.npz"), "none.npz"),
        (("map", "{scan}", "--length", "10.0"), "use 9.92 m or 10.08 m"),
        (("map", "{scan}", "--axes", "upside-down"), "upside-down"),
        (("map", "{scan}", "--out", "{folder}/x.txt"), "end in .npz"),
        (("map", "{scan}", "--out", "{folder}/x.npz", "--picture", "{folder}/x.jpg"), "end in .png"),
        (("map", "{scan}", "{empty}", "--out", "{folder}/x.npz"), "give a folder"),
        (("map", "{scan}", "--ism", "height-band-released", "--sensor-height", "2"), "fixed sensor height"),
        (("map", "{scan}", "--sensor-height", "-1"), "sensor_height"),
        (("map", "{scan}", "{scan}"), "share a name"),
        (("map", "{empty}"), "empty.bin"),
        (("map", "{nothing}"), "--sensor-height"),
        (("demo", "--out", "{scan}"), "wall.bin"),
    ])  # fmt: skip
def test_errors_are_one_line_and_exit_code_2(scan: Path, words: tuple, text: str) -> None:
    empty, nothing = scan.with_name("empty.bin"), scan.with_name("nothing.bin")
    empty.write_bytes(b"")
    np.full((10, 4), 0.5, np.float32).tofile(nothing)
    names = {"scan": scan, "folder": scan.parent, "empty": empty, "nothing": nothing}
    result = refused_command(text, *(word.format(**names) for word in words))
    assert "Traceback" not in result.output
    assert sum(line.startswith("ogm: ") for line in result.output.splitlines()) == 1


@each("name", ["m$\\frac$.bin", "tag[red].bin", "with space.bin", "日本.bin", "x" * 120 + ".bin"])
def test_odd_file_names(scan: Path, tmp_path: Path, name: str) -> None:
    odd = tmp_path / name
    odd.write_bytes(scan.read_bytes())
    result = completed("map", odd, "--out", tmp_path, "--picture", tmp_path, "--sensor-height", 1.7, *SMALL)
    assert (tmp_path / f"{name[:-4]}.png").exists()
    assert name[:8].split(".")[0] in result.output


def test_a_failure_leaves_the_old_output_whole(scan: Path, tmp_path: Path) -> None:
    ogm("map", scan, "--out", tmp_path / "o.npz", *SMALL)
    before = (tmp_path / "o.npz").read_bytes()
    scan.write_bytes(scan.read_bytes()[:-3])
    assert ogm("map", scan, "--out", tmp_path / "o.npz", *SMALL).exit_code == 2
    assert (tmp_path / "o.npz").read_bytes() == before


def test_every_command_has_help_with_an_example() -> None:
    commands = get_command(app).commands
    assert len(commands) > 10
    for command in {*commands} - {"world"}:
        result = completed(command, "--help")
        assert f"Example:  ogm {command}" in result.output, command


def test_the_installed_script_runs() -> None:
    run = subprocess.run([sys.executable, "-m", "ogm.cli", "--version"], capture_output=True, text=True, check=True)
    assert run.stdout.startswith("ogm 0.")


def test_layers_are_written_beside_the_masses(scan: Path, tmp_path: Path) -> None:
    words = ("map", scan, "--ism", "ray", "--sensor-height", 1.7, "--out", tmp_path / "o.npz", *SMALL)
    completed(*words, "--layers", "ground_height,distance,cost,cause", "--picture", tmp_path / "o.png")
    layers = LayeredGrid.load(tmp_path / "o_layers.npz")
    assert layers.spec == EvidentialGrid.load(tmp_path / "o.npz").spec
    assert abs(layers["ground_height"][layers.spec.index(5.0, 0.1)]) < 0.05
    assert layers["cause"][layers.spec.index(0.1, 0.1)] == UnknownCause.NEAR_VEHICLE
    wall = layers.spec.index(8.1, 0.1)
    assert (layers["distance"][wall], layers["cost"][wall]) == (0, 254)
    refused_command("got 'height'", *words, "--layers", "height")
