"""What notebooks show of grids, scans and data sets: small, quick, right way up, and without reading anything."""

import io
import re
import subprocess
import sys
from base64 import b64decode
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import each
from moving import street
from PIL import Image

from ogm import DynamicGrid, EvidentialGrid, GridSpec, LayeredGrid, Scan, open_dataset, plot
from ogm.plot.panels import APPEARED, CONFLICT_LAYERS, NO_VALUE, colour_bytes, heading_colours

SPEC = GridSpec(1.0, (7, 5), (-2.0, -2.0))


def ell(spec: GridSpec = SPEC) -> EvidentialGrid:
    """Make a wall three cells long ahead, with two cells to the left at its far end."""
    mass = np.zeros((*spec.shape, 2), np.float32)
    for x, y in ((2, 0), (3, 0), (4, 0), (4, 1)):
        mass[spec.index(x + 0.5, y + 0.5)] = 0, 1
    return EvidentialGrid(spec, mass)


def pixels(png: bytes) -> np.ndarray:
    with Image.open(io.BytesIO(png)) as image:
        assert image.format == "PNG"
        return np.asarray(image.convert("RGB"))


class Checked(HTMLParser):
    """HTML whose elements are closed as they were opened; its texts and its picture."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.texts: list[str] = []
        self.picture = b""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        if tag == "img":
            source = dict(attributes)["src"] or ""
            self.picture = b64decode(source.removeprefix("data:image/png;base64,"))
        else:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def scan_of(count: int = 500, **columns: Any) -> Scan:
    points = np.random.default_rng(1).uniform((-9, -9, -2, 0), (9, 9, 1, 1), (count, 4)).astype(np.float32)
    return Scan(points, stamp=12.5, sensor="VLP-16", **columns)


def test_a_grid_is_shown_front_up_and_left_left() -> None:
    image = pixels(ell()._repr_png_())
    side = image.shape[0] // 7
    assert image.shape == (7 * side, 5 * side, 3)
    assert side > 20  # few cells are drawn large
    orange = image[side // 2 :: side, side // 2 :: side, 0] > 200
    assert np.argwhere(orange).tolist() == [[0, 1], [0, 2], [1, 2], [2, 2]]


def test_a_large_grid_becomes_a_small_picture_that_keeps_what_is_occupied() -> None:
    spec = GridSpec(0.1, (2300, 1501), (-115.0, -75.0))
    mass = np.zeros((*spec.shape, 2), np.float32)
    mass[..., 0] = 0.9
    mass[2000, 1400] = 0, 1  # ahead, left
    grid = EvidentialGrid(spec, mass)
    image = pixels(grid._repr_png_()).astype(int)
    assert max(image.shape) <= 520
    orange = np.argwhere((image[..., 0] > 200) & (image[..., 2] < 80))
    assert len(orange) == 1
    assert orange[0, 0] < 0.2 * image.shape[0]
    assert orange[0, 1] < 0.2 * image.shape[1]
    assert len(grid._repr_html_()) < 50_000


def test_the_table_of_a_grid_states_its_cells_and_shares() -> None:
    found = Checked(ell()._repr_html_())
    assert found.picture == ell()._repr_png_()
    text = " ".join(found.texts)
    for part in ("EvidentialGrid", "7 x 5 of 1 m", "-2 … 5 m", "-2 … 3 m", "free, mean 0.0 %", "occupied, mean 11.4 %"):
        assert part in text
    assert "unknown, mean 88.6 %" in text


def test_layers_are_shown_side_by_side_and_conflict_as_one() -> None:
    spec = GridSpec(1.0, (300, 300), (0.0, 0.0))
    names = ("height", "count", "age", "more", "and_more")
    layers = {name: np.full(spec.shape, k, np.float32) for k, name in enumerate(names)}
    layers["height"][:150] = np.nan
    image = pixels(LayeredGrid(spec, layers)._repr_png_())
    assert image.shape == (300, 4 * 300 + 3 * 6, 3)
    assert image[299, 0].tolist() == colour_bytes(np.array(NO_VALUE)).tolist()  # behind is below
    assert image[0, 0].tolist() != image[299, 0].tolist()
    text = " ".join(Checked(LayeredGrid(spec, layers)._repr_html_()).texts)
    assert "0 … 0, 50.0 % of the cells" in text
    assert "and_more 4 … 4" in text
    conflict = {name: np.zeros(spec.shape) for name in CONFLICT_LAYERS}
    conflict["free_to_occupied"][299, 299] = 1
    image = pixels(LayeredGrid(spec, conflict)._repr_png_())
    assert image.shape == (300, 300, 3)
    assert np.abs(image[0, 0] - 255 * np.array(APPEARED)).max() <= 1
    empty = LayeredGrid(spec, {})
    assert empty._repr_png_() is None
    assert "300 x 300" in " ".join(Checked(empty._repr_html_()).texts)


def test_a_scan_is_shown_around_the_sensor() -> None:
    points = np.zeros((4, 4), np.float32)
    points[:, :2] = (8, 0), (8, 0.2), (0, 7), (np.nan, 0)  # ahead, and to the left
    points[:, 2] = 1
    image = pixels(Scan(points)._repr_png_())
    lit = np.argwhere(image.max(axis=-1) > 100)
    middle = image.shape[0] / 2
    assert ((lit[:, 0] < 0.3 * middle) | (lit[:, 1] < 0.3 * middle)).all()
    assert {bool(row < middle / 2) for row, _ in lit} == {True, False}
    text = " ".join(Checked(scan_of(ring=np.zeros(500), no_returns=np.zeros((7, 3)))._repr_html_()).texts)
    parts = ("VLP-16", "points 500", "12.500 s", "x, y, z, intensity, ring", "beams without echo 7", "z -2.0 … 1.0 m")
    for part in parts:
        assert part in text
    assert pixels(Scan(points[:0])._repr_png_()).shape == image.shape
    assert "points 0" in " ".join(Checked(Scan(points[:0])._repr_html_()).texts)


def test_the_table_of_a_data_set_reads_no_scan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "a <b> drive"
    folder.mkdir()
    for k in range(3):
        scan_of().points.tofile(folder / f"{k:06d}.bin")
    dataset = open_dataset(folder)
    for file in folder.iterdir():
        file.write_bytes(b"")
    text = Checked(dataset._repr_html_()).texts
    assert "Dataset a <b> drive" in text
    for name, value in dataset.describe().items():
        assert name in text
        assert value in text


def test_a_notebook_gets_both_kinds() -> None:
    formatters = pytest.importorskip("IPython.core.formatters", reason="IPython asks for the pictures")
    for shown in (ell(), LayeredGrid(SPEC, {"height": np.ones(SPEC.shape)}), scan_of()):
        found, _ = formatters.DisplayFormatter().format(shown)
        assert {"text/plain", "text/html", "image/png"} <= set(found)


@each("make", ["EvidentialGrid.vacuous(GridSpec.centered())", "LayeredGrid(GridSpec.centered(), {})"])
def test_drawing_is_loaded_when_a_notebook_asks(make: str) -> None:
    code = f"import sys; from ogm import EvidentialGrid, GridSpec, LayeredGrid; grid = {make}; "
    code += "before = set(sys.modules); grid._repr_html_(); "
    code += (
        "print(*sorted({m.split('.')[0] for m in before} & {'PIL', 'matplotlib'}), '|', 'matplotlib' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["|", "False"]  # masses are drawn without matplotlib


@each("scan", ["nebula_apache2/vlp16/*.pcd", "kitti_odometry_00/000000.bin"])
def test_real_scans_fill_their_picture(scan: str, real: Callable[[str], Path]) -> None:
    from ogm import read_scan

    image = pixels(read_scan(real(scan))._repr_png_())
    lit = image.max(axis=-1) > 100
    assert lit.mean() > 0.02
    rows, columns = np.nonzero(lit)
    assert min(np.ptp(rows), np.ptp(columns)) > 0.4 * len(image)
    assert not re.search(r"nan|inf", read_scan(real(scan))._repr_html_().split("base64")[-1].split(">", 1)[1])


def test_a_dynamic_grid_is_shown_with_its_headings() -> None:
    grid = street()
    image = pixels(grid._repr_png_())
    side = image.shape[0] // 64
    shown = image[side // 2 :: side, side // 2 :: side]
    assert np.array_equal(shown, plot.dynamic_panel(grid).image)
    text = " ".join(Checked(grid._repr_html_()).texts)
    for part in ("DynamicGrid", "64 x 48 of 0.5 m", "dynamic, mean 2.6 %", "moving cells 96, median"):
        assert part in text
    nothing = DynamicGrid(grid.spec, grid.mass * 0, grid.velocity, grid.covariance)
    assert "moving cells 0" in " ".join(Checked(nothing._repr_html_()).texts)


def test_a_large_dynamic_grid_becomes_a_small_picture_that_keeps_what_moves() -> None:
    spec = GridSpec(0.1, (1300, 901), (-65.0, -45.0))
    mass, velocity = np.zeros((*spec.shape, 3), np.float32), np.full((*spec.shape, 2), np.nan, np.float32)
    mass[..., 0] = 0.9
    mass[1299, 900], velocity[1299, 900] = (0, 0, 1), (0, 5)  # front left
    grid = DynamicGrid(spec, mass, velocity, np.zeros((*spec.shape, 2, 2), np.float32))
    image = pixels(grid._repr_png_())
    assert max(image.shape) <= 520
    assert np.abs(image[0, 0] - 255 * heading_colours(np.array(np.pi / 2))).max() <= 1
    assert (image.reshape(-1, 3)[1:] == image[-1, -1]).all()
