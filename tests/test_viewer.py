"""The page of a grid: complete, exact to its steps, and in a real browser oriented, quick and quiet."""

import json
import re
import zlib
from base64 import b64decode
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import each, refused
from chromium import Page, open_chromium
from moving import street
from typer.testing import CliRunner

from ogm import EvidentialGrid, GridSpec, LayeredGrid, UnknownCause, plot
from ogm.cli import app
from ogm.plot.moving import moving_arrows
from ogm.plot.overview import halve_mass, mass_to_bytes
from ogm.plot.panels import CONFLICT_LAYERS, VELOCITY_LAYERS
from ogm.plot.viewer import TILE, write_view
from ogm.pose import pose
from ogm.state import CellState, predict_state

SPEC = GridSpec(0.5, (14, 10), (-2.0, -2.0))
HOSTILE = '</script><b id="no">&amp; "\' \N{GREEK SMALL LETTER ALPHA}'


def drawn_grid(spec: GridSpec = SPEC, seed: int = 4) -> EvidentialGrid:
    """Make cells of all kinds: vacuous, sure, and between."""
    rng = np.random.default_rng(seed)
    mass = rng.dirichlet([0.4, 0.4, 0.6], size=spec.shape)[..., :2]
    mass[rng.random(spec.shape) < 0.3] = 0
    return EvidentialGrid(spec, mass.astype(np.float32))


def drawn_layers(spec: GridSpec = SPEC) -> LayeredGrid:
    rng = np.random.default_rng(5)
    layers = {name: rng.uniform(0, 1, spec.shape) for name in CONFLICT_LAYERS}
    layers |= {name: rng.uniform(-9, 6, spec.shape) for name in VELOCITY_LAYERS}
    layers["height"] = np.where(rng.random(spec.shape) < 0.5, np.nan, rng.uniform(-1, 4, spec.shape))
    return LayeredGrid(spec, layers)


@pytest.fixture(scope="module")
def grid() -> EvidentialGrid:
    """A wall of three cells ahead, with two cells to the left at its far end, among cells of all kinds."""
    mass = 0.5 * drawn_grid().mass
    for x, y in ((2, 0), (3, 0), (4, 0), (4, 1)):
        for part in ((0, 0), (0, 1), (1, 0), (1, 1)):
            mass[SPEC.index(x + 0.25 + 0.5 * part[0], y + 0.25 + 0.5 * part[1])] = 0, 1
    return EvidentialGrid(SPEC, mass)


# ---------- what stands in the page


class Parsed(HTMLParser):
    """Elements of a page, with the text of scripts by their id."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: dict[str, str] = {}
        self.titles: list[str] = []
        self.feed(path.read_text("utf-8"))
        self.close()
        self.data = json.loads(self.scripts["data"])

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attributes)))

    def handle_data(self, data: str) -> None:
        tag, attributes = self.elements[-1] if self.elements else ("", {})
        if tag == "script":
            self.scripts.setdefault(attributes.get("id") or "code", data)
        if tag in ("title", "h1") and data.strip():
            self.titles.append(data.strip())

    def level(self, stored: int, level: int) -> np.ndarray:
        """Return the bytes of a level, the front first, from its tiles."""
        facts = self.data
        shape = tuple(-(-count // 2**level) for count in facts["shape"])
        cells = np.zeros((*shape, len(facts["stored"][stored]["names"])), np.uint8)
        for name, text in self.scripts.items():
            if name.startswith(f"{stored}/{level}/"):
                row, column = (int(one) * facts["tile"] for one in name.split("/")[2:])
                place = cells[row : row + facts["tile"], column : column + facts["tile"]]
                packed = np.frombuffer(zlib.decompress(b64decode(text)), np.uint8)
                place[:] = np.moveaxis(packed.reshape(place.shape[2], *place.shape[:2]), 0, -1)
        return cells


def written(path: Path, *items: Any, **words: Any) -> Parsed:
    write_view(path / "page.html", *items, **words)
    assert [file.name for file in path.iterdir()] == ["page.html"]
    return Parsed(path / "page.html")


def test_the_page_shows_where_the_vehicle_is_and_was(tmp_path: Path) -> None:
    track = np.stack([np.arange(5000.0), np.zeros(5000)], axis=-1)
    page = written(tmp_path, drawn_grid(), T_grid_vehicle=pose(1.0, 2.0, 1.8, yaw=0.5), track=track)
    assert page.data["vehicle"] == pytest.approx([1.0, 2.0, 0.5])
    assert page.data["track"][0] == [0, 0]
    assert page.data["track"][-1] == [4999, 0]
    assert len(page.data["track"]) <= 2001
    text = (tmp_path / "page.html").read_text()
    assert "vehicle at the last scan, with its path" in text
    page = written(tmp_path, drawn_grid())
    assert not {"vehicle", "track"} & page.data.keys()
    assert "vehicle at the last scan" not in (tmp_path / "page.html").read_text()


def test_the_page_holds_all_cells_and_their_overviews(tmp_path: Path) -> None:
    grid = drawn_grid(GridSpec(0.1, (2 * TILE + 3, TILE + 1), (0.0, 0.0)))
    grid.mass[:, :2] = 0  # the last column of tiles is empty
    grid.mass[5, 0] = 0, 1
    page = written(tmp_path, grid)
    cells = mass_to_bytes(grid.mass[::-1, ::-1])
    for level in range(6):
        assert np.array_equal(page.level(0, level), cells)
        cells = halve_mass(cells)
    names = [name for name in page.scripts if name[0].isdigit()]
    assert {name[:4] for name in names} == {f"0/{level}/" for level in range(6)}
    assert sorted(name for name in names if name.startswith("0/0/")) == ["0/0/0/0", "0/0/1/0", "0/0/1/1", "0/0/2/0"]
    assert np.allclose(page.data["stored"][0]["means"], grid.mass.mean(axis=(0, 1)), atol=2e-4)


def test_layers_are_stored_to_half_a_step(tmp_path: Path) -> None:
    layers = drawn_layers()
    page = written(tmp_path, drawn_grid(), layers)
    found = {}
    for k, one in enumerate(page.data["stored"][1:], 1):
        cells = page.level(k, 0)[::-1, ::-1].astype(float)
        for part, name in enumerate(one["names"]):
            numbers = one["low"] + (cells[..., part] - one["first"]) * one["step"]
            found[name] = np.where(cells[..., part] < one["first"], np.nan, numbers)
            assert np.array_equal(np.isnan(found[name]), np.isnan(layers[name]))
            assert np.nanmax(np.abs(found[name] - layers[name])) <= 0.501 * one["step"]
    assert set(found) == set(layers.layers)
    names = ["belief", "free", "occupied", "unknown", "probability", "state", "velocity", "conflict", "height"]
    assert [one["name"] for one in page.data["layers"]] == names


def test_the_page_needs_nothing_but_itself(tmp_path: Path) -> None:
    page = written(tmp_path, drawn_grid(), drawn_layers())
    for _, attributes in page.elements:
        assert not {"src", "srcset", "action"} & set(attributes)
        assert attributes.get("href", "data:,") == "data:,"
    text = (tmp_path / "page.html").read_text("utf-8")
    words = ("fetch(", "XMLHttpRequest", "import(", "@import", "url(", "localStorage", "innerHTML", "eval(", "http:")
    for word in words:
        assert word not in text
    (policy,) = (one["content"] for tag, one in page.elements if tag == "meta" and "http-equiv" in one)
    assert "default-src 'none'" in (policy or "")
    ids = [one["id"] for _, one in page.elements if "id" in one]
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'\$\("([a-z-]+)"\)', page.scripts["code"])) <= set(ids)


def test_names_cannot_be_markup(tmp_path: Path) -> None:
    layers = LayeredGrid(SPEC, {HOSTILE: np.ones(SPEC.shape)})
    page = written(tmp_path, layers, title=HOSTILE)
    assert page.titles == [HOSTILE, HOSTILE]
    assert page.data["stored"][0]["names"] == [HOSTILE]
    assert "no" not in [attributes.get("id") for _, attributes in page.elements]


def test_what_cannot_be_shown_is_refused(tmp_path: Path) -> None:
    refused(r"must end in \.html", write_view, tmp_path / "a.png", drawn_grid())
    with pytest.raises(ValueError, match="layers must have the cells of the grid"):
        write_view(tmp_path / "a.html", drawn_grid(), drawn_layers(SPEC.refined(2)))
    refused("no layers", write_view, tmp_path / "a.html", LayeredGrid(SPEC, {}))
    refused("no folder", write_view, tmp_path / "none" / "a.html", drawn_grid(), error=FileNotFoundError)
    assert list(tmp_path.iterdir()) == []


def test_view_is_one_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    drawn_grid().save(tmp_path / "yard.npz")
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda address: opened.append(address) or True)
    done = CliRunner().invoke(app, ["view", "yard.npz", "--open"])
    assert done.exit_code == 0, done.output
    assert opened == [(tmp_path / "yard.html").as_uri()]
    assert Parsed(tmp_path / "yard.html").titles == ["yard.npz", "yard.npz"]
    done = CliRunner().invoke(app, ["view", "yard.npz", "--out", "pages/a.html", "--title", "A yard"])
    assert Parsed(tmp_path / "pages" / "a.html").titles == ["A yard", "A yard"]
    assert "14 x 10 cells" in done.output
    for words in (["none.npz"], ["yard.npz", "--out", "a.png"], ["yard.npz", "--length", "5"]):
        assert CliRunner().invoke(app, ["view", *words]).exit_code == 2


# ---------- in a browser


@pytest.fixture(scope="module")
def browse() -> Iterator[Callable[..., Page]]:
    """Give the function that opens a page in a real browser."""
    with open_chromium() as browse:
        yield browse


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("pages")


@pytest.fixture
def shown(browse: Callable[..., Page], folder: Path, grid: EvidentialGrid) -> Iterator[Page]:
    """Open the page of the small grid with all layers at 40 pixels per cell, its middle in the middle."""
    path = folder / "small.html"
    if not path.exists():
        write_view(path, grid, drawn_layers(), title="Small")
    x, y = 1.5, 0.5  # the middle
    page = browse(f"{path.as_uri()}#x={x}&y={y}&metre=80&layer=belief")
    page.settle()
    yield page
    assert page.errors == []
    assert page.requests == [f"{path.as_uri()}"]


PIXELS = 40  # along a cell
MIDDLE = (450, 400)  # of the map on the screen


def pixel(ix: int, iy: int) -> tuple[int, int]:
    """Return where the middle of a cell is on the screen."""
    nx, ny = SPEC.shape
    return round(MIDDLE[0] + (ny / 2 - iy - 0.5) * PIXELS), round(MIDDLE[1] + (nx / 2 - ix - 0.5) * PIXELS)


def values(page: Page) -> dict[str, str]:
    """Return what stands beside the map."""
    rows = "[...document.querySelectorAll('#values tr')].map(row => [...row.cells].map(cell => cell.innerText))"
    return dict(page.run(rows))


def cells_of(page: Page, dx: int = 15, dy: int = 15) -> np.ndarray:
    """Return the colour of every cell on the screen, [ix, iy], beside its middle, where the origin may be marked."""
    page.mouse("mouseMoved", MIDDLE[0], 5)  # no cell is marked
    page.settle()
    picture = page.picture()
    nx, ny = SPEC.shape
    places = np.array([[pixel(ix, iy) for iy in range(ny)] for ix in range(nx)])
    return picture[places[..., 1] + dy, places[..., 0] + dx]


def test_front_is_up_and_left_is_left(shown: Page, grid: EvidentialGrid) -> None:
    orange = np.array([[one[0] > 200 and one[2] < 60 for one in row] for row in cells_of(shown)])
    expected = np.zeros(SPEC.shape, bool)
    for x in (2.25, 2.75, 3.25, 3.75, 4.25, 4.75):
        for y in (0.25, 0.75):
            expected[SPEC.index(x, y)] = True
    for x, y in ((4.25, 1.25), (4.25, 1.75), (4.75, 1.25), (4.75, 1.75)):
        expected[SPEC.index(x, y)] = True
    assert np.array_equal(orange, expected)
    for dx, dy in ((16, 0), (-16, 0), (0, 16), (0, -16)):  # to their borders
        assert np.array_equal(cells_of(shown, dx, dy), cells_of(shown))
    picture = shown.picture()
    # On the screen: the far end of the wall is above its near end, its arm is on its left.
    (x0, y0), (x1, y1), (x2, y2) = (
        pixel(*map(int, SPEC.index(*at))) for at in ((2.25, 0.25), (4.75, 0.25), (4.75, 1.75))
    )
    assert y1 < y0
    assert x2 < x1
    assert all(picture[y + 15, x + 15, 0] > 200 for x, y in ((x0, y0), (x1, y1), (x2, y2)))
    assert picture[y0 + 15, x2 + 15, 0] < 200


def test_every_layer_has_the_colours_of_its_panel(shown: Page, grid: EvidentialGrid) -> None:
    layers = drawn_layers()
    state = predict_state(mass_to_bytes(grid.mass) / 255)
    sure = np.stack([state == CellState.FREE, state == CellState.OCCUPIED], axis=-1).astype(np.float32)
    panels = {
        "belief": plot.mass_panel(grid),
        "free": plot.mass_panel(EvidentialGrid(SPEC, grid.mass * np.float32([1, 0]))),
        "occupied": plot.mass_panel(EvidentialGrid(SPEC, grid.mass * np.float32([0, 1]))),
        "unknown": plot.unknown_panel(grid),
        "probability": plot.probability_panel(grid),
        "state": plot.mass_panel(EvidentialGrid(SPEC, sure)),
        "velocity": plot.velocity_panel(layers, max_speed=max(float(np.abs(layers[n]).max()) for n in VELOCITY_LAYERS)),
        "conflict": plot.conflict_panel(layers),
        "height": plot.layer_panel(layers, "height"),
    }
    for number, (name, panel) in enumerate(panels.items(), 1):
        shown.key(str(number))
        assert shown.run("document.querySelector('#layers :checked').parentElement.innerText").split()[0] == name
        difference = np.abs(cells_of(shown).astype(int) - panel.image[::-1, ::-1])
        assert difference.max() <= (16 if name == "velocity" else 6), name  # the steps: of a slow cell, the direction
        legend = shown.run("document.getElementById('legend').innerText")
        keys = panel.legend if name in ("belief", "state", "velocity", "conflict", "height") else ("0", "0.5", "1")
        assert all(key in legend for key in keys)


def test_causes_of_unknown_stand_as_texts_under_the_pointer_and_in_the_legend(browse: Any, folder: Path) -> None:
    cause = np.arange(SPEC.shape[0] * SPEC.shape[1], dtype=np.float32).reshape(SPEC.shape) % len(UnknownCause)
    layers, path = LayeredGrid(SPEC, {"cause": cause}), folder / "cause.html"
    write_view(path, layers)
    page = browse(f"{path.as_uri()}#x=1.5&y=0.5&metre=80")
    page.settle()
    assert np.array_equal(cells_of(page), plot.layer_panel(layers, "cause").image[::-1, ::-1])
    legend = page.run("document.getElementById('legend').innerText")
    for number, one in enumerate(UnknownCause):
        assert one.label in legend
        page.mouse("mouseMoved", *pixel(*np.unravel_index(number, SPEC.shape)))
        page.settle()
        assert values(page)["cause"] == one.label
    assert page.errors == []


def test_values_under_the_pointer_are_those_of_the_cell(shown: Page, grid: EvidentialGrid) -> None:
    layers = drawn_layers()
    for ix, iy in ((0, 0), (13, 9), (13, 0), (0, 9), (8, 4), (12, 7), (5, 2)):
        left, top = pixel(ix, iy)
        shown.mouse("mouseMoved", left - 12, top + 16)
        shown.settle()
        found = values(shown)
        x, y = (float(found[axis].removesuffix(" m")) for axis in ("x", "y"))
        assert found["cell"] == f"({ix}, {iy})"
        assert SPEC.index(x, y) == (ix, iy)
        assert x == pytest.approx(SPEC.cell_centers[0][ix, 0] - 0.5 * 16 / PIXELS, abs=0.02)
        assert y == pytest.approx(SPEC.cell_centers[1][0, iy] + 0.5 * 12 / PIXELS, abs=0.02)
        mass = mass_to_bytes(grid.mass[ix, iy]) / 255
        assert float(found["free"]) == pytest.approx(grid.free[ix, iy], abs=0.0025)
        assert float(found["occupied"]) == pytest.approx(grid.occupied[ix, iy], abs=0.0025)
        assert float(found["unknown"]) == pytest.approx(grid.unknown[ix, iy], abs=0.0045)
        assert float(found["probability"]) == pytest.approx(grid.probability[ix, iy], abs=0.0025)
        assert found["state"] == CellState(int(predict_state(mass))).name.lower()
        for name, layer in layers.layers.items():
            number = float(layer[ix, iy])
            step = float(np.abs(layer[~np.isnan(layer)]).max()) / 127
            if np.isnan(number):
                assert found[name] == "no value"
            else:
                assert float(found[name]) == pytest.approx(number, abs=step)
    shown.mouse("mouseMoved", 20, 20)  # beside the grid
    shown.settle()
    assert set(values(shown).values()) == {"–"}


def view_of(page: Page) -> tuple[float, float, float]:
    """Return x, y [m] of the middle of the screen and pixels per metre, from the address that the page keeps."""
    page.settle()
    page.run("new Promise(done => setTimeout(() => done(1), 320))")
    found = dict(one.split("=") for one in page.run("location.hash")[1:].split("&"))
    return float(found["x"]), float(found["y"]), float(found["metre"])


def test_wheel_zooms_about_the_pointer_and_drag_moves(shown: Page) -> None:
    left, top = pixel(9, 7)
    shown.mouse("mouseMoved", left, top)
    for _ in range(3):
        shown.mouse("mouseWheel", left, top, deltaX=0, deltaY=-100)
    shown.settle()
    assert values(shown)["cell"] == "(9, 7)"
    x, y, metre = view_of(shown)
    assert metre == pytest.approx(80 * np.exp(3 * 100 * 0.0022), rel=0.01)
    shown.mouse("mousePressed", left, top)
    shown.mouse("mouseMoved", left + 30, top + 50, buttons=1, button="left")
    shown.mouse("mouseReleased", left + 30, top + 50)
    shown.settle()
    assert values(shown)["cell"] == "(9, 7)"  # goes with the pointer
    moved = view_of(shown)
    assert (moved[0] - x, moved[1] - y) == (pytest.approx(50 / metre, abs=0.03), pytest.approx(30 / metre, abs=0.03))
    shown.mouse("mouseWheel", left, top, deltaX=0, deltaY=240)
    assert view_of(shown)[2] < metre
    width = shown.run("document.getElementById('scale-bar').getBoundingClientRect().width")
    number, unit = shown.run("document.getElementById('scale-text').textContent").split()
    assert float(number) * {"m": 1, "cm": 0.01, "km": 1000}[unit] == pytest.approx(width / view_of(shown)[2], rel=0.01)


def test_two_fingers_zoom_and_one_moves(shown: Page) -> None:
    shown.resize(1200, 800, touch=True)
    x, y, metre = view_of(shown)
    shown.touch("touchStart", (MIDDLE[0] - 50, MIDDLE[1]), (MIDDLE[0] + 50, MIDDLE[1]))
    for k in range(1, 6):
        shown.touch("touchMove", (MIDDLE[0] - 50 - 10 * k, MIDDLE[1]), (MIDDLE[0] + 50 + 10 * k, MIDDLE[1]))
    shown.touch("touchEnd")
    zoomed = view_of(shown)
    assert zoomed[2] == pytest.approx(2 * metre, rel=0.02)
    assert zoomed[:2] == (pytest.approx(x, abs=0.1), pytest.approx(y, abs=0.1))
    shown.touch("touchStart", MIDDLE)
    shown.touch("touchMove", (MIDDLE[0], MIDDLE[1] + 20))
    shown.touch("touchMove", (MIDDLE[0], MIDDLE[1] + 40))
    shown.touch("touchEnd")
    assert view_of(shown)[0] > zoomed[0] + 20 / zoomed[2]


def test_keys_move_zoom_and_pick_layers(shown: Page) -> None:
    shown.key("Tab")
    assert shown.run("document.activeElement.id") == "map"
    start = view_of(shown)
    shown.key("ArrowUp")
    shown.key("ArrowLeft")
    x, y, metre = view_of(shown)
    assert x > start[0]
    assert y > start[1]
    assert metre == start[2]
    ix, iy = SPEC.index(x, y)
    assert values(shown)["cell"] == f"({ix}, {iy})"  # of the cell at the cross
    shown.key("ArrowDown", shift=True)
    assert view_of(shown)[0] == pytest.approx(x - SPEC.resolution, abs=0.011)
    shown.key("+")
    assert view_of(shown)[2] == pytest.approx(1.25 * metre, rel=0.01)
    shown.key("-")
    shown.key("3")
    assert "layer=occupied" in (view_of(shown) and shown.run("location.hash"))
    shown.wait("document.getElementById('spoken').textContent.includes('occupied 0.')")
    shown.key("0")
    shown.settle()
    shown.wait("location.hash === '#layer=occupied'")
    bar = "document.getElementById('scale').innerHTML"
    for button in ("in", "out"):
        before = shown.run(bar)
        shown.run(f"document.getElementById('{button}').click()")
        shown.settle()
        assert shown.run(bar) != before
    box = "document.querySelectorAll('#layers label')[4].getBoundingClientRect()"
    at = shown.run(f"[{box}.x + 20, {box}.y + 8]")
    shown.mouse("mousePressed", *at)
    shown.mouse("mouseReleased", *at)
    assert shown.run("document.querySelector('#layers :checked').value") == "4"
    shown.key("ArrowDown")  # the arrows step through the layers while one has the focus
    assert shown.run("document.querySelector('#layers :checked').value") == "5"


def test_the_address_brings_a_view_back(shown: Page) -> None:
    shown.run("location.hash = '#x=2.5&y=-1&metre=120&layer=height'")
    assert view_of(shown) == (2.5, -1.0, 120.0)
    assert shown.run("document.querySelector('#layers :checked').parentElement.innerText").split()[0] == "height"
    shown.mouse("mouseMoved", *MIDDLE)
    shown.settle()
    ix, iy = SPEC.index(2.5 - 1e-6, -1 - 1e-6)
    assert values(shown)["cell"] == f"({ix}, {iy})"


@pytest.fixture(scope="module")
def large(folder: Path) -> tuple[Path, EvidentialGrid]:
    """A free field of 2600 x 3100 cells without a cell of unknown, with three occupied ones."""
    mass = np.zeros((2600, 3100, 2), np.float32)
    mass[..., 0] = 0.9
    for cell in ((100, 200), (2599, 3099), (1400, 1501)):
        mass[cell] = 0, 1
    grid = EvidentialGrid(GridSpec(0.2, mass.shape[:2], (-50.0, 30.0)), mass)
    write_view(folder / "large.html", grid)
    return folder / "large.html", grid


def test_single_occupied_cells_are_visible_from_afar(large: tuple[Path, EvidentialGrid], browse: Any) -> None:
    path, grid = large
    page = browse(path.as_uri(), (700, 500))
    page.settle()
    assert page.run("document.body.dataset.level") == "4"
    assert "16 × 16 cells" in page.run("document.getElementById('level').textContent")
    picture = page.picture()[:, :400].astype(int)
    orange = np.argwhere((picture[..., 0] > 180) & (picture[..., 2] < 90))
    assert 3 <= len(orange) <= 12
    assert np.count_nonzero((picture[..., 2] > 150) & (picture[..., 0] < 60)) > 50_000
    # the values are those of one cell, also from afar
    top, left = orange[np.argsort(np.abs(orange - orange.mean(axis=0)).sum(axis=1))[0]]
    page.mouse("mouseMoved", int(left), int(top))
    page.settle()
    found = values(page)
    ix, iy = map(int, re.findall(r"\d+", found["cell"]))
    assert float(found["occupied"]) == float(grid.occupied[ix, iy])
    assert (page.errors, page.requests) == ([], [path.as_uri()])


def test_a_long_way_over_many_tiles_is_drawn_in_bounded_memory(large: tuple[Path, EvidentialGrid], browse: Any) -> None:
    path, grid = large
    page = browse(path.as_uri(), (900, 600))
    x0, x1, y0, y1 = grid.spec.extent
    way = [(1.2, 0.5, 0.5), (5, 0.2, 0.2), (5, 0.8, 0.2), (40, 0.5, 0.5), (5, 0.8, 0.8), (5, 0.2, 0.8)]
    for metre, ahead, left in way:
        x, y = x0 + ahead * (x1 - x0), y0 + left * (y1 - y0)
        page.run(f"location.hash = '#x={x}&y={y}&metre={metre}'")
        for layer in "23456":  # the pictures of each are kept, too
            page.key(layer)
            page.settle()
        kept = [int(one) for one in page.run("document.body.dataset.tiles").split()]
        assert max(kept) <= 96
    assert kept[1] == 96
    x, y = float(grid.spec.cell_centers[0][1400, 0]), float(grid.spec.cell_centers[1][0, 1501])
    page.run(f"location.hash = '#x={x}&y={y}&metre=150&layer=belief'")
    page.settle()
    page.mouse("mouseMoved", 300, 300)
    page.settle()
    assert values(page)["cell"] == "(1400, 1501)"
    assert values(page)["occupied"] == "1.000"
    assert page.picture()[310, 310].tolist() == pytest.approx([255, 166, 31], abs=2)
    assert (page.errors, page.requests) == ([], [path.as_uri()])


def test_a_damaged_tile_and_an_old_browser_are_stated(folder: Path, grid: EvidentialGrid, browse: Any) -> None:
    path = folder / "damaged.html"
    write_view(path, grid)
    text = path.read_text("utf-8")
    start = text.index('id="0/0/0/0">') + 40
    path.write_text(text[:start] + "AAAAAAAA" + text[start + 8 :], "utf-8")
    page = browse(path.as_uri())
    page.wait("document.getElementById('failed')?.textContent.includes('damaged') === true")
    old = browse("about:blank")
    old.send("Page.addScriptToEvaluateOnNewDocument", source="delete window.DecompressionStream")
    old.send("Page.navigate", url=path.as_uri())
    old.wait("document.getElementById('failed')?.textContent.includes('cannot unpack') === true")


# ---------- dynamic grids


def test_the_page_of_a_dynamic_grid_holds_what_moves(tmp_path: Path) -> None:
    grid = street()
    page = written(tmp_path, grid)
    names = [one["name"] for one in page.data["layers"]]
    assert names[0] == "motion"
    assert {"belief", "state", "velocity", "speed", "static", "dynamic", "velocity_covariance_xy"} < set(names)
    assert np.allclose(page.data["layers"][0]["arrows"], moving_arrows(grid), atol=1e-3)
    number = next(k for k, one in enumerate(page.data["stored"]) if one["names"] == ["velocity_x", "velocity_y"])
    one, cells = page.data["stored"][number], page.level(number, 0)[::-1, ::-1].astype(float)
    shown = np.where(cells < 1, np.nan, one["low"] + (cells - 1) * one["step"])
    assert np.array_equal(np.isnan(shown), np.isnan(grid.velocity))
    assert np.nanmax(np.abs(shown - grid.velocity)) <= 0.501 * one["step"]


@each("kind", ["dynamic", "layered"])
def test_ogm_view_shows_every_kind_of_grid(tmp_path: Path, kind: str) -> None:
    grid = street() if kind == "dynamic" else drawn_layers()
    grid.save(tmp_path / "g.npz")
    result = CliRunner().invoke(app, ["view", str(tmp_path / "g.npz"), "--out", str(tmp_path / "p.html")])
    assert result.exit_code == 0, result.output
    names = {one["name"] for one in Parsed(tmp_path / "p.html").data["layers"]}
    assert names >= ({"motion", "belief", "speed"} if kind == "dynamic" else {"velocity", "conflict", "height"})


def test_the_browser_paints_motion_as_the_panel_does(browse: Callable[..., Page], tmp_path: Path) -> None:
    grid = street()
    write_view(tmp_path / "m.html", grid)
    page = browse(f"file://{tmp_path}/m.html#x=0&y=0&metre=20&layer=motion", (1000, 700))
    page.settle()
    picture, panel = page.picture().astype(int), plot.dynamic_panel(grid)
    cells = panel.image[::-1, ::-1].astype(int)
    middle = page.run("[map.getBoundingClientRect().width / 2, map.getBoundingClientRect().height / 2]")
    for x, y in ((0.25, 11.25), (3.25, -3.25), (-3.75, 7.75), (7.25, 0.25), (7.25, 3.75), (-10.75, -0.75)):
        row, column = round(middle[1] - 20 * x), round(middle[0] - 20 * y)
        assert np.abs(picture[row, column] - cells[grid.spec.index(x, y)]).max() <= 4, (x, y)
    tip = round(middle[1] - 20 * 3.3), round(middle[0] - 20 * 3.0)  # of the arrow of what comes
    assert picture[tip].max() < 60
    assert page.errors == []
