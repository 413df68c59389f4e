"""Viewer of a grid of any size, as one HTML page without external files or network access.

The page contains the numbers of the cells as bytes, in tiles of 512 x 512 cells: at full resolution, and at levels of
half the resolution each (`ogm.plot.overview`). Tiles are deflated and encoded as base64; the browser unpacks visible
tiles. Tiles without numbers are left out.

>>> from ogm import EvidentialGrid, GridSpec
>>> from ogm.plot.viewer import write_view
>>> _ = write_view("map.html", EvidentialGrid.vacuous(GridSpec.centered(resolution=0.5)), title="nothing yet")
"""

import json
import math
import os
import zlib
from base64 import b64encode
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from datetime import datetime
from functools import partial
from importlib import resources
from typing import IO, Any, NamedTuple

import numpy as np
from jinja2 import Environment, StrictUndefined, Template
from markupsafe import Markup
from numpy.typing import ArrayLike, NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.grid import EvidentialGrid, LayeredGrid
from ogm.plot.overview import FULL_MASS, Steps, halve_codes, halve_mass, halve_numbers, mass_to_bytes
from ogm.plot.panels import CAUSE_LAYER, CONFLICT_LAYERS, VELOCITY_LAYERS, upright
from ogm.plot.view_layers import (
    CAUSE_STEPS,
    Layer,
    cause_layer,
    conflict_layer,
    mass_layers,
    motion_layer,
    number_layer,
    velocity_layer,
)
from ogm.pose import check_pose
from ogm.storage.files import atomic_write
from ogm.unknown_cause import UnknownCause

__all__ = ["COARSEST_SIDE", "TILE", "page_of_tiles", "write_view"]

TILE = 512  # [cells] along a side; even, so that blocks of 2 x 2 cells lie within a tile
COARSEST_SIDE = 64  # [cells] along the longer side of the last level, whose cells are wider than a pixel on any screen
MAX_TRACK = 2000  # positions of a path
_TILES = "<!-- tiles -->"  # position of the tiles in the page


class _Stored(NamedTuple):
    """Numbers that are stored together, K per cell."""

    names: Sequence[str]
    rows: Callable[[slice], NDArray[np.uint8]]  # (rows, columns, K) for a slice of rows from the front
    halve: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]
    first: int  # byte of `low`; smaller bytes are no value
    low: float
    step: float
    labels: Sequence[str] = ()  # texts of the numbers 0, 1, ...


def write_view(
    path: str | os.PathLike[str],
    grid: EvidentialGrid | DynamicGrid | LayeredGrid,
    layers: LayeredGrid | None = None,
    *,
    title: str = "",
    T_grid_vehicle: ArrayLike | None = None,  # noqa: N803
    track: ArrayLike | None = None,
) -> None:
    """Write a page that shows a grid from above: zoom, layers, and the values under the pointer.

    Parameters
    ----------
    path : path
        Page (.html). Its folder must exist.
    grid : EvidentialGrid, DynamicGrid or LayeredGrid
        Of an evidential grid, the page shows belief, free, occupied, unknown, probability and state; of a dynamic grid
        also motion (`ogm.plot.dynamic_panel`), velocity, speed, static, dynamic and covariances. Of a layered grid,
        it shows every layer: ``free_to_occupied`` and ``occupied_to_free`` combined as conflict, ``velocity_x`` and
        ``velocity_y`` combined as velocity, ``cause`` with the texts of `ogm.UnknownCause`.
    layers : LayeredGrid, optional
        Further layers on the same cells.
    title : str
    T_grid_vehicle : (4, 4) array, optional
        Pose of the vehicle in the frame of the grid, shown as a triangle that points forward.
    track : (N, 2) array, optional
        Path of the vehicle in the frame of the grid [m], shown as a line.

    Raises
    ------
    ValueError
        If the path does not end in ``.html``, the numbers of the grid are no masses, `layers` has other cells than
        `grid`, or there is no layer.

    Notes
    -----
    Masses are stored in steps of 1/255, with errors of at most 0.002 for free and occupied, 0.004 for unknown. Other
    layers are stored in 254 steps from the lowest to the highest number. At every zoom, the values under the pointer
    are of the full-resolution cell; the page states the steps.
    """
    if not str(path).lower().endswith(".html"):
        raise ValueError(f"a page must end in .html, got {path}")
    if layers is not None and layers.spec != grid.spec:
        raise ValueError(f"layers must have the cells of the grid, {grid.spec}, got {layers.spec}")
    stored: list[_Stored] = []
    shown: list[Layer] = []
    if isinstance(grid, LayeredGrid):
        layers = grid
    else:
        grid.check()
        masses = grid.to_evidential() if isinstance(grid, DynamicGrid) else grid
        stored.append(_Stored(("free", "occupied"), partial(_mass_rows, masses), halve_mass, 0, 0.0, 1 / FULL_MASS))
        shown += mass_layers(0)
    if isinstance(grid, DynamicGrid):
        layers = _moving_layers(grid, layers)
    if layers is not None:
        _add_layers(layers, stored, shown)
    if isinstance(grid, DynamicGrid):
        index = {name: k for k, numbers in enumerate(stored) for name in numbers.names}
        shown.insert(0, motion_layer(0, index["dynamic"], index["velocity_x"], grid))
    if not shown:
        raise ValueError("the grid has no layers to show, wanted at least one")
    title = "; ".join([title or "grid", *(grid.meta.values() if isinstance(grid, EvidentialGrid) else ())])
    facts = {"title": title, "made": f"{datetime.now():%Y-%m-%d %H:%M}", "tile": TILE, "layers": shown}
    spec = grid.spec
    facts |= {"roughest": COARSEST_SIDE, "resolution": spec.resolution, "shape": spec.shape, "origin": spec.origin}
    if T_grid_vehicle is not None:
        T = check_pose(T_grid_vehicle, "T_grid_vehicle")
        facts["vehicle"] = [float(T[0, 3]), float(T[1, 3]), math.atan2(T[1, 0], T[0, 0])]
    if track is not None:
        xy = np.asarray(track, np.float64).reshape(-1, 2)
        facts["track"] = xy[:: len(xy) // MAX_TRACK + 1].round(3).tolist() + xy[-1:].round(3).tolist()
    with atomic_write(path) as file, ThreadPoolExecutor(os.cpu_count()) as pool:
        _write_page(file, facts, stored, pool)


def _moving_layers(grid: DynamicGrid, more: LayeredGrid | None) -> LayeredGrid:
    """Return the layers of a dynamic grid except free and unknown, its speed, and further layers."""
    layers = {name: layer for name, layer in grid.to_layers().layers.items() if name not in ("free", "unknown")}
    return LayeredGrid(grid.spec, {"speed": grid.speed} | layers | dict(more.layers if more else {}))


def _add_layers(layers: LayeredGrid, stored: list[_Stored], shown: list[Layer]) -> None:
    """Add layers to the stored numbers and the shown layers; velocity and conflict are combined."""
    names = list(layers.layers)
    if set(VELOCITY_LAYERS) <= set(names):
        names = [name for name in names if name not in VELOCITY_LAYERS]
        steps = Steps.of(*(layers[name] for name in VELOCITY_LAYERS), symmetric=True)
        shown.append(velocity_layer(len(stored), steps))
        stored.append(_numbers(layers, VELOCITY_LAYERS, steps))
    if CAUSE_LAYER in names:
        names.remove(CAUSE_LAYER)
        shown.append(cause_layer(len(stored)))
        labels = [cause.label for cause in UnknownCause]
        codes = _numbers(layers, (CAUSE_LAYER,), CAUSE_STEPS)
        stored.append(codes._replace(labels=labels, halve=halve_codes))
    found = {name: (len(stored) + k, Steps.of(layers[name])) for k, name in enumerate(names)}
    stored += [_numbers(layers, (name,), steps) for name, (_, steps) in found.items()]
    if set(CONFLICT_LAYERS) <= set(names):
        shown.append(conflict_layer([found.pop(name) for name in CONFLICT_LAYERS]))
    shown += [number_layer(place, name, steps) for name, (place, steps) in found.items()]


def _numbers(layers: LayeredGrid, names: Sequence[str], steps: Steps) -> _Stored:
    def rows(of: slice) -> NDArray[np.uint8]:
        return np.stack([steps.to_bytes(upright(layers[name])[of]) for name in names], axis=-1)

    return _Stored(names, rows, partial(halve_numbers, steps=steps), 1, steps.low, steps.step)


def _mass_rows(grid: EvidentialGrid, of: slice) -> NDArray[np.uint8]:
    return mass_to_bytes(upright(grid.mass)[of])


def page_of_tiles(**facts: Any) -> bytes:
    """Return a page that loads its tiles from its own server, ``tiles/STORED/LEVEL/ROW/COLUMN``.

    Parameters
    ----------
    **facts
        ``title, tile, layers, resolution, shape, origin, stored``, see `write_view`.
    """
    facts |= {"made": f"{datetime.now():%Y-%m-%d %H:%M}", "roughest": COARSEST_SIDE}
    parts = _parts()
    streamed = Markup((resources.files("ogm") / "data" / "view_streamed.js").read_text("utf-8"))  # noqa: S704
    return b"".join(render(facts, streamed) for render in parts)


def _parts() -> tuple[Callable[..., bytes], Callable[..., bytes]]:
    """Return functions that render the page before and after its tiles."""
    folder = resources.files("ogm") / "data"
    code = {name: Markup((folder / f"view.{name}").read_text("utf-8")) for name in ("css", "js")}  # noqa: S704
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    head, tail = map(environment.from_string, (folder / "view.html").read_text("utf-8").split(_TILES))

    def render(template: Template, facts: dict[str, Any], streamed: Markup | None = None) -> bytes:
        text = json.dumps(facts, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
        shown = template.render(**code, **facts, streamed=streamed, data=Markup(text))  # noqa: S704
        return shown.encode("utf-8", "replace")

    return partial(render, head), partial(render, tail)


def _write_page(file: IO[bytes], facts: dict[str, Any], stored: Sequence[_Stored], pool: Executor) -> None:
    """Write the page from top to bottom, tile by tile."""
    head, tail = _parts()
    file.write(head(facts))
    facts["stored"] = [
        {name: getattr(numbers, name) for name in ("names", "first", "low", "step", "labels")} for numbers in stored
    ]
    for number, numbers in enumerate(stored):
        totals = np.zeros(len(numbers.names))
        for level, row, tiles in _strips(numbers, facts["shape"]):
            if level == 0:
                totals += sum(tile.sum(axis=(0, 1), dtype=np.float64) for tile in tiles)
            for column, packed in enumerate(pool.map(_packed, tiles)):
                if packed:
                    file.write(b'<script type="text/plain" id="%d/%d/%d/%d">' % (number, level, row, column))
                    file.write(packed + b"</script>\n")
        facts["stored"][number]["means"] = list(totals / (np.prod(facts["shape"]) * FULL_MASS))
    file.write(tail(facts))


def _strips(stored: _Stored, shape: tuple[int, int]) -> Iterator[tuple[int, int, list[NDArray[np.uint8]]]]:
    """Yield level, row and tiles of every row of tiles, from full resolution to the last level."""
    strips, level, size = (stored.rows(slice(start, start + TILE)) for start in range(0, shape[0], TILE)), 0, max(shape)
    while True:
        smaller = []
        for row, strip in enumerate(strips):
            yield level, row, [strip[:, start : start + TILE] for start in range(0, strip.shape[1], TILE)]
            smaller.append(stored.halve(strip))
        if size <= COARSEST_SIDE:
            return
        cells, level, size = np.concatenate(smaller), level + 1, -(-size // 2)
        strips = (cells[start : start + TILE] for start in range(0, len(cells), TILE))


def _packed(tile: NDArray[np.uint8]) -> bytes:
    """Return a tile, with its K numbers in sequence, deflated, as base64; empty for a tile of zeros."""
    return b64encode(zlib.compress(np.moveaxis(tile, -1, 0).tobytes())) if tile.any() else b""
