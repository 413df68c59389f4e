"""``ogm view``: show a grid or a map as a page in the browser."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from ogm.cli.console import print_facts, report_errors

if TYPE_CHECKING:
    from ogm.grid import EvidentialGrid

_MAX_CELLS = 2**25  # cells of a world map on a page

GridFile = Annotated[
    str,
    Argument(help="Grid or map, of `ogm` or another program; or a world map: folder, .zip, s3://...", metavar="GRID"),
]
Out = Annotated[Path | None, Option("--out", help="Page (.html). [default: ./NAME.html; world maps are served]")]
Port = Annotated[int, Option(help="Port to serve a world map at. [default: a free port]", min=0, max=65535)]
Open = Annotated[bool, Option("--open", help="Open the page in the browser.")]
Title = Annotated[str | None, Option(help="Title of the page. [default: the name of the file]")]
Length = Annotated[float | None, Option(help="Extent along x of a .png or .npy, which lack it [m].")]
Width = Annotated[float | None, Option(help="Extent along y [m]. The origin is the middle of the extent.")]
Level = Annotated[int | None, Option(help="Level of a world map: cells of 2**LEVEL times the side.")]
Resolution = Annotated[float, Option(help="Side of a cell of a .png or .npy [m].")]


@report_errors
def view(
    grid: GridFile,
    out_path: Out = None,
    open_it: Open = False,
    title: Title = None,
    length: Length = None,
    width: Width = None,
    resolution: Resolution = 0.16,
    level: Level = None,
    port: Port = 0,
) -> None:
    """Write one HTML page that shows a grid, with zoom, layers, values under the pointer and a scale.

    The page needs no other file and no network, and works with 100 million cells and more. Its layers are belief, free,
    occupied, unknown, probability and state, for a dynamic map also motion and velocity, and all layers of the file.

    A world map of any size is served to the browsers of this machine until Ctrl-C: its page loads the visible tiles.
    With --out, it is written as a page instead, at a level that fits.
    """
    import webbrowser

    from ogm.grid import GridSpec
    from ogm.io import PlacedGrid, read_placed_grid
    from ogm.plot.viewer import write_view

    if (length is None) != (width is None):
        raise ValueError("give both --length and --width [m], or neither")
    area = None if length is None else GridSpec.centered(length, width, resolution)
    local = Path(grid)
    is_world = "://" in grid or local.suffix == ".zip" or (local / "0" / "zarr.json").is_file()
    if is_world and out_path is None and level is None:
        _serve(grid, title or local.name, port, open_it)
        return
    path = Path(f"{local.stem}.html") if out_path is None else out_path
    placed = PlacedGrid(_world_grid(grid, level)) if is_world else read_placed_grid(local, area).upright
    path.parent.mkdir(parents=True, exist_ok=True)
    write_view(path, placed.grid, placed.layers, title=title or local.name)
    print_facts({"page": str(path), "cells": str(placed.grid.spec), "size": f"{path.stat().st_size / 1e6:.1f} MB"})
    if open_it and not webbrowser.open(path.resolve().as_uri()):
        raise OSError(f"no browser could be started; open {path} yourself")


def _serve(url: str, title: str, port: int, open_it: bool) -> None:
    """Serve a world map until the command is interrupted."""
    import threading
    import webbrowser

    from ogm.world import WorldMap
    from ogm.world.view_server import serve_world

    with WorldMap.open(url) as world, serve_world(world, title, port) as address:
        print_facts({"page": address, "map": world.url, "levels": str(world.levels), "ends by": "Ctrl-C"})
        if open_it and not webbrowser.open(address):
            raise OSError(f"no browser could be started; open {address} yourself")
        threading.Event().wait()


def _world_grid(path: str, level: int | None) -> "EvidentialGrid":
    """Return a whole world map at a level, by default the finest with at most `_MAX_CELLS` cells."""
    from ogm.world import WorldMap

    with WorldMap.open(path) as world:
        if level is None:
            counts = [n * m for n, m in (world.cells(level=k).shape for k in range(world.levels))]
            level = next((k for k, count in enumerate(counts) if count <= _MAX_CELLS), world.levels - 1)
        return world.window(world.cells(level=level), level=level)
