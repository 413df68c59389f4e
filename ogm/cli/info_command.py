"""``ogm info``: what a file holds."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from ogm.cli.console import print_facts, report_errors
from ogm.cli.options import FixedFrame, IntensityMax, TimeUnit, parsed_axes

if TYPE_CHECKING:
    from ogm import DynamicGrid, EvidentialGrid, LayeredGrid


@report_errors
def info(
    scan: Annotated[Path, Argument(help="A scan, a grid (.npz), a folder of scans, a data set or a log.")],
    axes: Annotated[str, Option(help="Axes of the file: flu, kitti, nuscenes, ..., or +y,-x,+z.")] = "flu",
    intensity_max: IntensityMax = None,
    time_unit: TimeUnit = None,
    fixed_frame: FixedFrame = None,
) -> None:
    """Show what a file or a data set holds: of a log also what its scans lack for `ogm fuse`."""
    from ogm.datasets.logs import CAPTURE_ENDINGS, describe_log, is_log
    from ogm.datasets.simulated import is_simulated
    from ogm.io import describe, read_any_grid, read_scan_file

    if scan.exists() and is_log([scan]):
        facts = describe_log(scan, fixed_frame)
    elif scan.is_dir() and is_simulated(scan):
        from ogm.simulation.store import Store

        facts = Store.open(scan).describe()
    elif scan.is_dir() or scan.suffix.lower() in CAPTURE_ENDINGS:
        from ogm.datasets import open_dataset

        options = {"intensity_max": intensity_max, "time_unit": time_unit}
        facts = open_dataset(scan, axes=parsed_axes(axes), **options).describe()  # type: ignore[arg-type]
    elif scan.suffix == ".npz":
        facts = _grid_facts(read_any_grid(scan))
    else:
        facts = describe(
            *read_scan_file(scan, axes=parsed_axes(axes), intensity_max=intensity_max, time_unit=time_unit)
        )
    print_facts(facts)


def _grid_facts(grid: "EvidentialGrid | DynamicGrid | LayeredGrid") -> dict[str, str]:
    """Return kind, cells and mean masses of a grid, or the range of its layers."""
    from ogm.grid import LayeredGrid
    from ogm.plot.overview import Steps

    kind = type(grid).__name__.removesuffix("Grid").lower()
    x0, x1, y0, y1 = grid.spec.extent
    facts = {
        "format": f"{kind} grid",
        "cells": f"{grid.spec.shape[0]} x {grid.spec.shape[1]} of {grid.spec.resolution:g} m",
        "x": f"{x0:g} ... {x1:g} m",
        "y": f"{y0:g} ... {y1:g} m",
    }
    if isinstance(grid, LayeredGrid):
        ranges = {name: Steps.of(layer) for name, layer in grid.layers.items()}
        return facts | {name: f"{low:.4g} ... {high:.4g}" for name, (low, high) in ranges.items()}
    names = ("free", "static", "dynamic", "unknown") if kind == "dynamic" else ("free", "occupied", "unknown")
    return facts | {name: f"{100 * getattr(grid, name).mean():.1f} %" for name in names}
