"""``ogm fuse --dynamic``: a block that crosses in front of the vehicle, a wall that stands."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cases import each
from commands import completed, ogm
from PIL import Image
from wall_drive import HEIGHT, WALL, world, write_kitti

from ogm import Boxes, DynamicGrid, EvidentialGrid, plot
from ogm.fusion import DynamicMapper
from ogm.io import read_any_grid, read_grid
from ogm.plot.moving import moving_arrows, moving_groups
from ogm.plot.panels import heading_colours
from ogm.pose import inverse, pose, transform_points

FRAMES, SPEED = 14, 4.0  # m/s to the left
SMALL = ("--length", 24, "--width", 16, "--resolution", 0.25)
POSES = np.array([pose(0.2 * k, yaw=0.02 * k) for k in range(FRAMES)])


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[object, ...]:
    """Return the words that name the drive: scans, poses, size of the grids."""
    folder, rng = tmp_path_factory.mktemp("dynamic"), np.random.default_rng(1)
    (folder / "scans").mkdir()
    for k, T in enumerate(POSES):
        block = rng.uniform((6, -1, -HEIGHT + 0.3, 0.5), (7.5, 1, 0, 0.5), (1500, 4))
        block[:, 1] += SPEED * (0.1 * k - 0.9)
        points = transform_points(inverse(T), np.concatenate([world(), block])).astype(np.float32)
        points.tofile(folder / "scans" / f"{k:03d}.bin")
    words = (folder / "scans", "--poses", write_kitti(folder / "p.txt", POSES, 0), "--sensor-height", HEIGHT)
    return (*words, *SMALL, "--dynamic", "--particles", 30_000)


def block_of(grid: DynamicGrid, k: int = FRAMES - 1) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells where the block is, in map coordinates."""
    y = SPEED * (0.1 * k - 0.9)
    return grid.spec.index(*(one.ravel() for one in np.meshgrid([6.1, 6.4], np.linspace(y - 0.7, y + 0.7, 6))))


def test_what_moves_has_its_velocity_and_what_stands_has_none(drive: tuple[object, ...], tmp_path: Path) -> None:
    result = completed("fuse", *drive, "--out", tmp_path / "m.npz")
    assert f"{FRAMES} mapped, 0 skipped" in result.output
    assert "by 30000 particles" in result.output
    grid = DynamicGrid.load(tmp_path / "m.npz")
    cells = block_of(grid)
    assert grid.dynamic[cells].mean() > 0.5
    assert np.nanmedian(grid.velocity[cells], axis=0) == pytest.approx([0, SPEED], abs=0.8)
    wall = grid.spec.index(WALL + 0.1, np.arange(-6.0, -3, 0.25))
    assert grid.static[wall].mean() > 0.8
    arrows = moving_arrows(grid)
    assert np.hypot(*(arrows[:, 2:] - (0, SPEED)).T).min() < 1
    moving = moving_groups(grid)
    assert f"{np.count_nonzero(moving)} cells in {moving.max()} groups" in result.output


def test_film_picture_and_page_show_it(drive: tuple[object, ...], tmp_path: Path) -> None:
    film, picture, page = (tmp_path / f"m.{ending}" for ending in ("gif", "png", "html"))
    completed("fuse", *drive, "--movie", film, "--picture", picture, "--page", page)
    with Image.open(film) as read:
        assert read.n_frames == FRAMES
        read.seek(FRAMES - 1)
        last = np.asarray(read.convert("RGB")).astype(int)
    width = last.shape[1]
    third = last[60:-40, width // 2 + 4 : 3 * width // 4 - 60]
    left = 255 * heading_colours(np.array(np.pi / 2 - 0.02 * FRAMES))
    assert np.count_nonzero(np.abs(third - left).max(axis=-1) < 60) > 100
    text = page.read_text()
    assert all(f'"name":"{name}"' in text for name in ("motion", "velocity", "static", "dynamic", "conflict"))
    assert '"arrows":[[' in text


@pytest.mark.slow
@each("ending, message, whole", [("mcap", "grid-map", True), ("mcap", None, False), ("nc", None, True)])
def test_layers_are_kept_where_the_format_holds_them(
    drive: tuple[object, ...], tmp_path: Path, ending: str, message: str | None, whole: bool
) -> None:
    out = tmp_path / f"m.{ending}"
    words = ("--message", message) if message else ()
    completed("fuse", *drive, "--first", 4, "--out", out, *words)
    assert isinstance(read_any_grid(out), DynamicGrid if whole else EvidentialGrid)
    assert read_grid(out).occupied.max() > 0.9
    completed("convert", out, tmp_path / "again.npz")
    assert (read_any_grid(tmp_path / "again.npz") == read_any_grid(out)) is True


def test_nuss_is_a_rule_of_dynamic_maps(drive: tuple[object, ...], tmp_path: Path) -> None:
    completed("fuse", *drive, "--rule", "nuss", "--first", 4, "--out", tmp_path / "m.npz")
    assert not DynamicGrid.load(tmp_path / "m.npz").static.any()


@each("words, message", [
        (("--dynamic", "--rule", "yager"), "needs the rule dynamic or nuss: leave out --rule yager"),
        (("--particles", "100"), "--particles needs --dynamic: give both, or leave out --particles"),
        (("--dynamic", "--particles", "0"), "particles must be a whole number from 1"),
        (("--dynamic", "--half-life", "0"), "half_life"),
    ])  # fmt: skip
def test_options_that_make_no_sense_are_refused(
    drive: tuple[object, ...], tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    result = ogm("fuse", *drive[:3], *SMALL, *words, "--out", tmp_path / "m.npz")
    assert result.exit_code == 2
    assert message in " ".join(result.output.split())
    assert not list(tmp_path.iterdir())


def test_objects_that_the_map_follows_are_drawn_in_the_vehicles_axes(
    drive: tuple[object, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    boxes = Boxes([[6.75, 1.6, 0.0]], [[2.0, 1.5, 1.5]], [np.pi / 2], [[0.0, SPEED]], track=["1"])
    found = SimpleNamespace(confirmed=SimpleNamespace(boxes=boxes))
    monkeypatch.setattr(DynamicMapper, "objects", lambda _: found, raising=False)
    drawn: list[plot.Panel] = []
    monkeypatch.setattr(plot, "save_picture", lambda path, *panels: drawn.extend(panels))
    completed("fuse", *drive, "--picture", tmp_path / "m.png")
    T = inverse(POSES[-1])
    np.testing.assert_allclose(drawn[2].arrows[0, :2], (T @ (6.75, 1.6, 0, 1))[:2], atol=1e-5)
    np.testing.assert_allclose(drawn[2].arrows[0, 2:], T[:2, :2] @ (0, SPEED), atol=1e-5)
    np.testing.assert_allclose(drawn[2].outlines[0].mean(axis=0), drawn[2].arrows[0, :2], atol=1e-9)
    assert "1 objects confirmed" in drawn[2].title
    assert drawn[2].legend["unknown"] == drawn[1].legend["unknown"] != drawn[3].legend["no conflict"]
