"""World maps in the browser: the page's tiles are the map's cells, and it scrolls and zooms through them."""

import socket
import struct
import sys
import urllib.error
import urllib.request
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from cases import refused

from ogm.grid import EvidentialGrid, GridSpec
from ogm.plot.overview import halve_mass, mass_to_bytes
from ogm.plot.viewer import COARSEST_SIDE
from ogm.world import WorldMap
from ogm.world.view_server import WorldPage, serve_world

sys.path.insert(0, str(Path(__file__).parents[1]))
from chromium import Page, open_chromium


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WorldMap]:
    """Give a map of 100 m x 60 m whose cells are known: a wall along x at y = 5 m, a post at (42, -10)."""
    spec = GridSpec(0.5, (200, 120), (-20.0, -30.0))
    mass = np.zeros((*spec.shape, 2), np.float32)
    mass[..., 0] = 0.6
    mass[:, spec.index(0.0, 5.0)[1]] = 0, 0.9
    mass[spec.index(42.0, -10.0)] = 0, 0.9
    url = tmp_path_factory.mktemp("view") / "town"
    with WorldMap.create(url, 0.5, 16) as world:
        world.integrate(EvidentialGrid(spec, mass), np.eye(4))
        world.build_overviews()
    with WorldMap.open(url) as opened:
        yield opened


def level_of(page: WorldPage, level: int) -> np.ndarray:
    """Return all cells of a level of the page, put together from its tiles."""
    n = page.world.layout.tile
    rows, columns = (-(-size // 2**level) for size in page.shape)
    cells = np.zeros((rows, columns, 2), np.uint8)
    for row in range(-(-rows // n)):
        for column in range(-(-columns // n)):
            part = cells[row * n : (row + 1) * n, column * n : (column + 1) * n]
            if packed := page.tile(level, row, column):
                part[:] = np.moveaxis(np.frombuffer(packed, np.uint8).reshape(2, *part.shape[:2]), 0, -1)
    return cells


def test_tiles_of_the_page_are_the_cells_of_the_map(town: WorldMap) -> None:
    page = WorldPage(town)
    levels = town.levels
    assert levels >= 3
    for level in range(levels):
        unit = 2 ** (levels - 1 - level)
        (i, j), (k, m) = ([one * unit for one in corner] for corner in (page.low, page.high))
        window = town.window(town.layout.spec((i, k, j, m), level), level=level)
        np.testing.assert_array_equal(level_of(page, level), mass_to_bytes(window.mass)[::-1, ::-1])
    cells = level_of(page, levels - 1)
    while max(cells.shape) > COARSEST_SIDE:
        cells, levels = halve_mass(cells), levels + 1
        np.testing.assert_array_equal(level_of(page, levels - 1), cells)
    for place in ((levels, 0, 0), (0, 1000, 0), (0, 0, 1000)):
        refused("does not exist", page.tile, *place)
    with WorldMap.create(Path(town.url).parent / "empty", 0.5, 16) as empty:
        refused("empty", WorldPage, empty)


def get(address: str, **headers: str) -> tuple[int, bytes]:
    try:
        with urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=60) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def test_the_server_gives_the_page_its_tiles_and_nothing_else(town: WorldMap) -> None:
    page = WorldPage(town)
    with serve_world(town, "A <town>") as address:
        status, text = get(address)
        assert (status, b"A &lt;town&gt;" in text, b"connect-src 'self'" in text) == (200, True, True)
        status, packed = get(f"{address}tiles/0/0/1/2")
        assert (status, zlib.decompress(packed)) == (200, page.tile(0, 1, 2))
        for path in (
            "tiles/0/0/999/0",
            "tiles/0/99/0/0",
            "tiles/1/0/0/0",
            "zarr.json",
            "../zarr.json",
            "tiles/0/0/-1/0",
        ):
            assert get(address + path)[0] == 404
        assert get(address, Host="elsewhere.example:80")[0] == 403
    with pytest.raises(urllib.error.URLError):
        get(address)


def test_broken_and_silent_connections_end_without_a_word(
    town: WorldMap, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ogm.world.view_server._TIMEOUT", 0.2)
    reset = struct.pack("ii", 1, 0)  # close sends a reset
    with serve_world(town) as address:
        place = ("127.0.0.1", int(address.rstrip("/").rpartition(":")[2]))
        for begun in (b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: localhost:1\r\n\r\n"):
            with socket.create_connection(place) as tab:
                tab.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, reset)
                tab.sendall(begun)
        with socket.create_connection(place, timeout=5) as silent:
            assert silent.recv(1) == b""  # closed
        assert get(address)[0] == 200
    assert capfd.readouterr().err == ""


def test_a_damaged_tile_is_an_answer(town: WorldMap, tmp_path: Path) -> None:
    town.copy_to(tmp_path / "map.zip")
    with WorldMap.open(tmp_path / "map.zip") as world, pytest.MonkeyPatch.context() as patch:
        with serve_world(world) as address:
            raw = (tmp_path / "map.zip").read_bytes()
            at = raw.index(b"0/c/0/") + 60
            patch.setattr(world.store, "read", _damaged)
            status, text = get(f"{address}tiles/0/0/0/0")
        assert (status, b"is damaged" in text, at > 0) == (500, True, True)


def _damaged(*given: object) -> None:
    from ogm.storage.files import OgmError

    raise OgmError("tile (0, 0) is damaged")


# ---------- in a browser


@pytest.fixture(scope="module")
def browse() -> Iterator[Callable[..., Page]]:
    with open_chromium() as browse:
        yield browse


@pytest.mark.slow
def test_the_page_scrolls_and_zooms_through_the_map(town: WorldMap, browse: Callable[..., Page]) -> None:
    with serve_world(town, "Town") as address:
        page = browse(f"{address}#x=42.25&y=-9.75&metre=40&layer=belief")
        page.settle()
        middle = (450, 400)

        def at(dx: float, dy: float) -> np.ndarray:
            page.mouse("mouseMoved", middle[0], 5)
            page.settle()
            return page.picture()[round(middle[1] + dy), round(middle[0] + dx)].astype(int)

        def tiles() -> list[str]:
            return [one.partition("/tiles/")[2] for one in page.requests if "/tiles/" in one]

        first = set(tiles())
        assert first  # those on the screen
        assert len(first) < 40
        post, free = at(4, 4), at(60, 60)
        assert post[0] > free[0] + 40  # orange, and blue beside it
        assert free[2] > post[2] + 40
        page.mouse("mouseMoved", *middle)
        page.settle()
        shown = dict(
            page.run("[...document.querySelectorAll('#values tr')].map(r => [...r.cells].map(c => c.innerText))")
        )
        assert float(shown["occupied"]) == pytest.approx(0.9, abs=0.003)
        assert float(shown["x"].split()[0]) == pytest.approx(42.25, abs=0.3)
        for _ in range(3):  # to the left by keys: other tiles
            page.key("ArrowLeft")
        page.settle()
        moved = set(tiles()) - first
        assert moved
        page.key("0")  # all of it, at a rougher level
        page.settle()
        assert int(page.run("document.body.dataset.level")) == 0
        page.resize(420, 300)
        page.wait("innerWidth === 420")
        page.settle()  # the canvas follows one frame later, and how far keys zoom out depends on it
        for _ in range(6):
            page.key("-")
        page.settle()
        rough = int(page.run("document.body.dataset.level"))
        assert rough >= 1
        assert any(one.startswith(f"0/{rough}/") for one in tiles())
        assert len(tiles()) == len(set(tiles()))  # each is loaded once
        assert page.errors == []
