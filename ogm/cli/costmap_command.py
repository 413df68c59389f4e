"""``ogm costmap``: write the costs of a map, for nav2 and other planners."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from ogm.cli import options
from ogm.cli.console import print_facts, report_errors

MapFile = Annotated[Path, Argument(help="Map: .npz, .yaml, .tif, .nc, .zarr, .mcap, .db3, .bag.", metavar="MAP")]
OutFile = Annotated[Path, Argument(help="Output file; its ending selects the format, its folder is created.")]
InflationRadius = Annotated[float, Option(help="Distance from obstacles beyond which cells cost nothing [m].")]
Unknown = Annotated[str, Option(help="Treat unknown cells as unknown, inflated, obstacle or free.", metavar="STATE")]
Message = Annotated[
    str | None, Option(help="In logs: costmap (nav2_msgs), occupancy-grid, grid-map, foxglove-grid. [default: costmap]")
]
Mode = Annotated[str | None, Option(help="Mode of .yaml: scale, raw or trinary. [default: scale]")]


@report_errors
def costmap(
    grid: MapFile,
    out: OutFile,
    inflation_radius: InflationRadius,
    inscribed_radius: options.InscribedRadius = 0.0,
    cost_scaling: options.CostScaling = 10.0,
    unknown: Unknown = "unknown",
    message: Message = None,
    mode: Mode = None,
) -> None:
    """Write the costs of a map, computed as in nav2's inflation layer.

    Logs store a nav2_msgs/Costmap, .yaml (map_server) and occupancy-grid the values 0 to 100 published by nav2.
    Formats with several layers store the masses and the layer cost.
    """
    from ogm.io.grids.files import read_placed_grid
    from ogm.planning import costmap as costs_of
    from ogm.workflows import write_costmap

    placed = read_placed_grid(grid)
    costs = costs_of(placed.evidential, inscribed_radius, inflation_radius, cost_scaling, unknown)  # type: ignore[arg-type]
    if out.resolve() == grid.resolve():
        raise ValueError(f"{out} would overwrite {grid}; give another name")
    out.parent.mkdir(parents=True, exist_ok=True)
    write_costmap(out, placed, costs, mode=mode, message=message)  # type: ignore[arg-type]
    names = {"free": costs == 0, "costly": (costs > 0) & (costs < 253), "inscribed": costs == 253}
    names |= {"obstacle": costs == 254, "unknown": costs == 255}
    spec, shares = placed.grid.spec, (f"{name} {100 * cells.mean():.1f} %" for name, cells in names.items())
    print_facts({"costs": str(out), "cells": str(spec), "shares": ", ".join(shares)})
