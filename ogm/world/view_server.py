"""Browser page of a world map; tiles are read from disk or from the object store when they are shown."""

import re
import sys
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.plot.overview import FULL_MASS, halve_mass, mass_to_bytes
from ogm.plot.panels import upright
from ogm.plot.view_layers import mass_layers
from ogm.plot.viewer import COARSEST_SIDE, page_of_tiles
from ogm.storage.files import OgmError
from ogm.world.world_map import WorldMap

_MAX_CELLS = 2**25  # of the coarsest level, which is read at once
_TIMEOUT = 15.0  # [s] after which an idle connection is closed
_TILE = re.compile(r"/tiles/0/(\d{1,2})/(\d{1,8})/(\d{1,8})")


class WorldPage:
    """Page of a map and its tiles, as in `ogm.plot.viewer`: rows from the front, columns from the left.

    Parameters
    ----------
    world : WorldMap
    title : str
        Title of the page; by default the map's URL.

    Raises
    ------
    ValueError
        If the map is empty, or too large to show without overviews.
    """

    def __init__(self, world: WorldMap, title: str = "") -> None:
        tiles = world.tiles()
        if not tiles:
            raise ValueError(f"{world.url} is empty: integrate grids or build drives into it")
        self.world, self.title = world, title or world.url
        n, unit = world.layout.tile, 2 ** (world.levels - 1)
        low, high = np.min(tiles, axis=0) * n // unit, -(-(np.max(tiles, axis=0) + 1) * n // unit)  # coarsest cells
        self.low, self.high = low.tolist(), high.tolist()
        self.shape = tuple(int(size) * unit for size in high - low)
        if np.prod(high - low) > _MAX_CELLS:
            raise ValueError(f"{world.url} is too large without overviews: make them by WorldMap.build_overviews")

    @cached_property
    def html(self) -> bytes:
        """The page without tiles."""
        side = self.world.layout.resolution
        unit = 2 ** (self.world.levels - 1)
        means = self._rough[0].mean(axis=(0, 1)) / FULL_MASS
        stored = {"names": ["free", "occupied"], "first": 0, "low": 0.0, "step": 1 / FULL_MASS, "means": means.tolist()}
        return page_of_tiles(
            title=self.title,
            tile=self.world.layout.tile,
            layers=mass_layers(0),
            resolution=side,
            shape=self.shape,
            origin=tuple(corner * unit * side for corner in self.low),
            stored=[stored],
        )

    def tile(self, level: int, row: int, column: int) -> bytes:
        """Return a tile of the page: all free, then all occupied, in steps of 1/255, row by row; empty if all is 0.

        Raises
        ------
        ValueError
            If the page has no such tile.
        OgmError
            If the tile cannot be read.
        """
        n = self.world.layout.tile
        shape = [-(-size // 2**level) for size in self.shape]
        last = self.world.levels - 1 + len(self._rough) - 1
        if level > last or row * n >= shape[0] or column * n >= shape[1]:
            raise ValueError(f"tile {row}, {column} of level {level} does not exist")
        a, b, c, d = row * n, min((row + 1) * n, shape[0]), column * n, min((column + 1) * n, shape[1])
        if level >= self.world.levels:
            cells = self._rough[level - self.world.levels + 1][a:b, c:d]
        else:
            i, j = (corner << self.world.levels - 1 - level for corner in self.high)
            spec = self.world.layout.spec((i - b, i - a, j - d, j - c), level)
            cells = mass_to_bytes(upright(self.world.window(spec, level=level).mass))
        return np.moveaxis(cells, -1, 0).tobytes() if cells.any() else b""

    @cached_property
    def _rough(self) -> list[NDArray[np.uint8]]:
        """All cells of the coarsest level of the map, and of further levels of half the resolution each."""
        (i, j), (k, m), level = self.low, self.high, self.world.levels - 1
        grid = self.world.window(self.world.layout.spec((i, k, j, m), level), level=level)
        levels = [mass_to_bytes(upright(grid.mass))]
        while max(self.shape) > COARSEST_SIDE * 2 ** (level + len(levels) - 1):
            levels.append(halve_mass(levels[-1]))
        return levels


class _Server(ThreadingHTTPServer):
    """Server with a thread for each connection; connections broken by the browser end without an error."""

    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print the traceback of an error, unless the connection is broken."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


@contextmanager
def serve_world(world: WorldMap, title: str = "", port: int = 0) -> Iterator[str]:
    """Serve the page of a map to browsers on this machine during a ``with`` block; yield its address.

    The page scrolls and zooms through a map of any size. It requests the tiles on the screen, which are then read from
    the map. Later changes of the map are shown when the page is loaded again.

    Parameters
    ----------
    world : WorldMap
        Map with overviews, unless it is small.
    title : str
    port : int
        Port number; 0 selects a free one.

    Raises
    ------
    ValueError
        See `WorldPage`.
    OSError
        If the port is in use.
    """
    page = WorldPage(world, title)

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        timeout = _TIMEOUT

        def do_GET(self) -> None:
            host = self.headers.get("Host", "").rpartition(":")[0]
            if host not in ("127.0.0.1", "localhost"):  # a request of another site whose name points to this machine
                return self._answer(403, b"only for this machine")
            try:
                if self.path == "/":
                    self._answer(200, page.html, "text/html; charset=utf-8")
                elif found := _TILE.fullmatch(self.path):
                    self._answer(200, zlib.compress(page.tile(*map(int, found.groups())), 1), packed=True)
                else:
                    self._answer(404, b"this page does not exist")
            except OgmError as error:
                self._answer(500, str(error).encode())
            except ValueError as error:
                self._answer(404, str(error).encode())

        def _answer(self, status: int, body: bytes, kind: str = "", packed: bool = False) -> None:
            self.send_response(status)
            kind = kind or ("application/octet-stream" if packed else "text/plain; charset=utf-8")
            headers = {"Content-Type": kind, "Content-Length": str(len(body)), "Cache-Control": "no-store"}
            headers |= {"X-Content-Type-Options": "nosniff"} | ({"Content-Encoding": "deflate"} if packed else {})
            for name, value in headers.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *given: Any) -> None:
            """Print nothing."""

    with _Server(("127.0.0.1", port), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/"
        finally:
            server.shutdown()
            thread.join()
