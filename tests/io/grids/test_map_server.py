"""Maps of map_server, read by an independent loader and written by other hands."""

import math
import os
from pathlib import Path

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given, settings
from hypothesis import strategies as st
from nav2_loader import load_map
from PIL import Image

from ogm.grid import EvidentialGrid, GridSpec
from ogm.io.grids.files import read_grid, read_placed_grid, write_grid
from ogm.io.grids.placed import PlacedGrid
from ogm.io.messages.grids import occupancy_values
from ogm.pose import pose
from ogm.state import CellState, predict_state
from ogm.storage.files import OgmError

MODES = ("trinary", "scale", "raw")
SPEC = GridSpec(0.0625, (9, 5), (-1.23456789, 7.1))  # neither survives three decimals


def l_shape() -> EvidentialGrid:
    """An L of occupied cells, long along x, its foot along +y at its far end; free around it, unknown at the back."""
    mass = np.zeros((*SPEC.shape, 2), np.float32)
    mass[1:] = 0.7, 0.1
    mass[2:8, 1] = 0.05, 0.9
    mass[7, 1:4] = 0.05, 0.9
    return EvidentialGrid(SPEC, mass)


@each("mode", MODES)
def test_the_loader_of_nav2_finds_every_cell_where_it_is(tmp_path: Path, mode: str) -> None:
    grid = l_shape()
    write_grid(tmp_path / "map.yaml", grid, mode=mode)
    loaded = load_map(tmp_path / "map.yaml")
    assert (loaded.resolution, loaded.origin) == (SPEC.resolution, (*SPEC.origin, 0.0))
    assert (loaded.width, loaded.height) == SPEC.shape
    xs, ys = (one.ravel() for one in SPEC.cell_centers)
    for x in xs:
        for y in ys:
            cell = grid.at(x, y)
            value = max((cell.free, 0), (cell.occupied, 100), (cell.unknown, -1))[1]
            if mode != "trinary" and value >= 0:
                value = round(100 * (cell.occupied + cell.unknown / 2))
            assert loaded.at(x, y) == value


@each("mode", MODES)
def test_a_turned_map_lies_where_its_pose_has_it(tmp_path: Path, mode: str) -> None:
    T = pose(12.3, -4.5, 0.8, yaw=2.1)
    placed = PlacedGrid(l_shape(), T)
    write_grid(tmp_path / "map.yaml", placed, mode=mode)
    loaded, again = load_map(tmp_path / "map.yaml"), read_placed_grid(tmp_path / "map.yaml")
    assert again.corner == pytest.approx(placed.corner, abs=1e-12)
    xs, ys = SPEC.cell_centers
    for ix, iy in np.ndindex(SPEC.shape):
        x, y, *_ = T @ (xs[ix, 0], ys[0, iy], 0, 1)
        wanted = occupancy_values(again.grid)[ix, iy]
        assert loaded.at(x, y) == wanted


@each("mode", ["scale", "raw"])
def test_all_values_come_back(tmp_path: Path, mode: str) -> None:
    occupied = np.arange(101, dtype=np.float32) / 100
    mass = np.stack([np.append(1 - occupied, 0), np.append(occupied, 0)], axis=-1)[:, None]
    grid = EvidentialGrid(GridSpec(1.0, (102, 1), (0, 0)), mass)
    write_grid(tmp_path / "map.yaml", grid, mode=mode)
    assert load_map(tmp_path / "map.yaml").data == [*range(101), -1]
    again = read_grid(tmp_path / "map.yaml")
    assert again.spec == grid.spec
    np.testing.assert_allclose(again.mass, mass, atol=1e-7)


def test_unknown_stays_unknown_as_the_default(tmp_path: Path) -> None:
    grid = EvidentialGrid.vacuous(GridSpec(0.1, (3, 4), (0, 0)))
    write_grid(tmp_path / "map.yaml", grid)
    assert set(load_map(tmp_path / "map.yaml").data) == {-1}
    text = (tmp_path / "map.yaml").read_text()
    assert "free_thresh: 0.196" in text
    assert "mode: trinary" in text
    assert set((tmp_path / "map.pgm").read_bytes()[-12:]) == {205}


@each("thresh, greys, share", [
        (0.25, [205, 205, 254, 0], 50.0), (0.25, [254, 0, 254, 0], None), (0.196, [205, 205, 254, 0], None),
        (0.3, [205, 254, 254, 254], 25.0),
    ])  # fmt: skip
def test_unknown_cells_that_the_thresholds_make_free_are_named(
    tmp_path: Path, thresh: float, greys: list[int], share: float | None, caplog: pytest.LogCaptureFixture
) -> None:
    Image.fromarray(np.array([greys], np.uint8)).save(tmp_path / "a.pgm")
    text = f"image: a.pgm\nmode: trinary\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\nfree_thresh: {thresh}\n"
    (tmp_path / "a.yaml").write_text(f"{text}occupied_thresh: 0.65\n")
    values = occupancy_values(read_grid(tmp_path / "a.yaml"))[:, 0]
    assert values.tolist() == list(load_map(tmp_path / "a.yaml").data)
    assert (share is not None) == ("the grey of unknown cells" in caplog.text)
    if share is not None:
        assert f"makes {share:g} % of the cells free," in caplog.text
    unknown = occupancy_values(read_grid(tmp_path / "a.yaml", free_thresh=0.196))[:, 0]
    assert unknown.tolist() == [{205: -1, 254: 0, 0: 100}[grey] for grey in greys]
    refused("free_thresh must be from 0 to", read_grid, tmp_path / "a.yaml", free_thresh=0.7)
    refused("free_thresh.* is only for .yaml files", read_grid, tmp_path / "a.npz", free_thresh=0.1)


@settings(max_examples=30)
@given(
    st.integers(1, 7), st.integers(1, 7), st.integers(0, 2**32 - 1), st.sampled_from(MODES),
    st.floats(1e-3, 1e3), st.floats(-1e6, 1e6), st.floats(-3.1, 3.1),
)  # fmt: skip
def test_what_is_read_is_what_the_loader_has(
    tmp_path_factory: pytest.TempPathFactory, nx: int, ny: int, seed: int, mode: str, size: float, x: float, yaw: float
) -> None:
    path = tmp_path_factory.mktemp("map") / "map.yml"
    mass = np.random.default_rng(seed).dirichlet((0.5, 0.5, 0.5), (nx, ny))[..., :2].astype(np.float32)
    mass /= np.maximum(mass.sum(axis=-1, keepdims=True), 1)
    grid = EvidentialGrid(GridSpec(size, (nx, ny), (x, -2.0)), mass)
    placed = PlacedGrid(grid, pose(0.1, 0.2, yaw=yaw))
    write_grid(path, placed, mode=mode)
    loaded, again = load_map(path), read_placed_grid(path)
    assert loaded.resolution == again.grid.spec.resolution == size
    assert again.corner == pytest.approx(placed.corner, rel=1e-12, abs=1e-9)
    assert np.array_equal(np.reshape(loaded.data, (ny, nx)).T, occupancy_values(again.grid))
    assert np.array_equal(predict_state(again.grid.mass), predict_state(mass)) or mode != "trinary"


def by_hand(folder: Path, image: Image.Image, name: str = "m.png", **changes: object) -> Path:
    values = {
        "image": name, "mode": "trinary", "resolution": 0.5, "origin": "[1.0, 2.0, 0.0]", "negate": 0,
        "occupied_thresh": 0.65, "free_thresh": 0.25,
    } | changes  # fmt: skip
    image.save(folder / name)
    text = "".join(f"{key}: {value}\n" for key, value in values.items() if value is not None)
    (folder / "m.yaml").write_text(text)
    return folder / "m.yaml"


@each("mode", MODES)
@each("negate", [0, 1])
@each("colours", ["L", "LA", "RGB", "RGBA", "P", "1"])
def test_maps_of_others_are_read_as_the_loader_reads_them(tmp_path: Path, mode: str, negate: int, colours: str) -> None:
    rng = np.random.default_rng(5)
    pixels = rng.integers(0, 256, (8, 5, 4), np.uint8)
    pixels[::2, :, 3] = 255
    pixels[:4, :, :3] = pixels[:4, :, :1]
    image = Image.fromarray(pixels).convert(colours)
    path = by_hand(tmp_path, image, mode=mode, negate=negate)
    loaded, values = load_map(path), occupancy_values(read_grid(path))
    assert np.array_equal(np.reshape(loaded.data, (8, 5)).T, values)
    assert (values >= 0).any()


@each("name", ["m.pgm", "m.png", "m.bmp"])
def test_images_of_all_formats(tmp_path: Path, name: str) -> None:
    path = by_hand(tmp_path, Image.fromarray(np.array([[0, 205, 254]], np.uint8)), name)
    state = predict_state(read_grid(path).mass)[:, 0]
    assert state.tolist() == [CellState.OCCUPIED, CellState.FREE, CellState.FREE]  # 205 with map_saver's 0.25: free


def test_images_of_16_bit(tmp_path: Path) -> None:
    image = Image.fromarray(np.array([[0, 205 * 257, 65535]], np.uint16))
    path = by_hand(tmp_path, image, free_thresh=0.196)
    state = predict_state(read_grid(path).mass)[:, 0]
    assert state.tolist() == [CellState.OCCUPIED, CellState.UNKNOWN, CellState.FREE]


def test_numbers_as_map_server_takes_them(tmp_path: Path) -> None:
    """YAML 1.1 has 5e-2 as a text; modes and negate may be missing, or words."""
    image = Image.fromarray(np.array([[0, 255]], np.uint8))
    changes = {"resolution": "5e-2", "origin": "[-1, 2e0, 0]", "negate": "false", "mode": None}
    assert read_grid(by_hand(tmp_path, image, **changes)).spec == GridSpec(0.05, (2, 1), (-1.0, 2.0))
    (tmp_path / "m.yaml").write_text((tmp_path / "m.yaml").read_text().replace("m.png", str(tmp_path / "m.png")))
    assert read_grid(tmp_path / "m.yaml").spec.shape == (2, 1)


@each("changes, message", [
        ({"resolution": -0.1}, "resolution must be above 0"), ({"resolution": "0"}, "resolution must be above 0"),
        ({"resolution": ".nan"}, "resolution must be a finite number"),
        ({"resolution": "1e999"}, "resolution must be a finite number"),
        ({"resolution": "[1]"}, "resolution must be a finite number, got list"),
        ({"resolution": None}, "resolution must be a finite number, got None"),
        ({"origin": "[.nan, 0, 0]"}, "origin must be a finite number"),
        ({"origin": "[1, 2]"}, "origin must be three numbers"), ({"origin": "5"}, "origin must be three numbers"),
        ({"mode": "binary"}, "mode must be one of trinary, scale, raw"), ({"mode": "[a]"}, "mode must be one of"),
        ({"negate": "2"}, "negate must be 0 or 1"), ({"mode": "scale", "free_thresh": 0.65}, "above free_thresh"),
        ({"image": "../m.png"}, "outside of the file"), ({"image": "/etc/passwd"}, "outside of the file"),
        ({"image": "sub/../../../etc/passwd"}, "outside of the file"),
        ({"image": "none.png"}, "no image 'none.png' beside it"),
        ({"image": "m.yaml"}, "m.yaml is damaged or no image"), ({"image": "."}, "no image"),
        ({"image": '""'}, "image must be the name"),
        ({"image": "{a: b}"}, "image must be the name of a file, got dict"),
        ({"image": '"a\\0b"'}, "image must be the name"),
    ])  # fmt: skip
def test_what_is_no_map_is_refused(tmp_path: Path, changes: dict, message: str) -> None:
    folder = tmp_path / "maps"
    folder.mkdir()
    Image.new("L", (2, 2)).save(tmp_path / "m.png")
    path = by_hand(folder, Image.new("L", (2, 2)), **{k: v for k, v in changes.items() if k != "image"})
    path.write_text(path.read_text().replace("image: m.png", f"image: {changes.get('image', 'm.png')}"))
    with pytest.raises(OgmError, match=message) as caught:
        read_grid(path)
    assert str(caught.value).count("m.yaml") == 1


LAUGHS = "a0: &a0 {x: 1}\n" + "".join(f"a{k}: &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 10)}]}}\n" for k in range(1, 40))


@each("text", [
        "", "- 1", "image", "image: [", "\x00", "a: &a [*a]", "[" * 9000, "x: !!python/object/apply:os.system [ls]",
        "image: m.png\n" * 9000, LAUGHS, "? [a]\n: b", "mode: &a [*a, *a]", "image: &b {? *b : 1}",
    ])  # fmt: skip
def test_yaml_that_is_no_header_is_refused_quickly(tmp_path: Path, text: str) -> None:
    (tmp_path / "m.yaml").write_text(text)
    refused(r"m\.yaml", read_grid, tmp_path / "m.yaml", error=OgmError)


def test_an_image_that_promises_more_than_a_grid_has_is_not_unpacked(tmp_path: Path) -> None:
    path = by_hand(tmp_path, Image.new("L", (2, 2)), "m.pgm")
    (tmp_path / "m.pgm").write_bytes(b"P5\n100000 100000\n255\n")
    refused(r"m\.pgm is damaged or no image", read_grid, path, error=OgmError)
    (tmp_path / "m.pgm").write_bytes(b"P5\n3000 3000\n255\n")
    refused(r"m\.pgm is damaged or no image", read_grid, path, error=OgmError)


@each("stage", [1, 2])
def test_what_a_crash_leaves_is_the_old_map_or_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stage: int
) -> None:
    """A crash at the first or second of the two renamings: no YAML file names an image that is not its own."""
    old, new = l_shape(), EvidentialGrid.vacuous(GridSpec(1.0, (2, 2), (5, 5)))
    path = tmp_path / "map.yaml"
    write_grid(path, old)
    real, calls = os.replace, []

    def crash(source: Path, target: Path) -> None:
        calls.append(target)
        if len(calls) == stage:
            raise KeyboardInterrupt
        real(source, target)

    monkeypatch.setattr(os, "replace", crash)
    with pytest.raises(KeyboardInterrupt):
        write_grid(path, new)
    monkeypatch.undo()
    assert [one.name for one in calls] == ["map.pgm", "map.yaml"][:stage]
    assert not path.exists()
    assert sorted(one.name for one in tmp_path.iterdir()) == ["map.pgm"]


@each("mode, image", [("trinary", "map.pgm"), ("raw", "map.pgm"), ("scale", "map-scale.png")])
def test_an_image_of_something_else_is_not_replaced(tmp_path: Path, mode: str, image: str) -> None:
    path, image_path = tmp_path / "map.yaml", tmp_path / image
    for photo in (Image.effect_noise((8, 8), 40), Image.new("L", (3, 3))):
        photo.save(image_path)
        before = image_path.read_bytes()
        refused(
            rf"map\.yaml would replace .*{image}, which is no image of that map", write_grid, path, l_shape(), mode=mode
        )
        assert image_path.read_bytes() == before
    by_hand(tmp_path, Image.new("L", (3, 3)), image).rename(path)  # a map of somebody else, which is replaced whole
    for _ in range(2):
        write_grid(path, l_shape(), mode=mode)
    path.unlink()  # as a crash leaves it
    write_grid(path, l_shape(), mode=mode)
    assert np.array_equal(read_grid(path).occupied > 0.5, l_shape().occupied > 0.5)


def test_a_tilted_grid_is_refused(tmp_path: Path) -> None:
    refused("tilted by 5.73 degrees", write_grid, tmp_path / "map.yaml", PlacedGrid(l_shape(), pose(pitch=0.1)))
    write_grid(tmp_path / "map.yaml", PlacedGrid(l_shape(), pose(pitch=1e-4, z=3)))
    assert math.isclose(read_placed_grid(tmp_path / "map.yaml").corner.x, SPEC.origin[0], rel_tol=1e-6)
