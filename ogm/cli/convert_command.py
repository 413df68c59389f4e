"""``ogm convert``: write a map in another file format."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from ogm.cli.console import print_facts, report_errors
from ogm.evidence.map_rules import RULES

if TYPE_CHECKING:
    from ogm.grid import GridSpec

GridFile = Annotated[Path, Argument(help="Map or grid: .npz, .yaml, .tif, .nc, .zarr, .mcap, .db3, .bag, .png, .npy.")]
OutFile = Annotated[Path, Argument(help="Output file; its ending selects the format, its folder is created.")]
Mode = Annotated[str | None, Option(help="Mode of .yaml: trinary, scale or raw (0 to 100). [default: trinary]")]
Crs = Annotated[str | None, Option(help="Coordinate reference system of OUT, in metres, such as EPSG:25832.")]
Pose = Annotated[
    tuple[float, float, float] | None,
    Option(help="Pose of GRID's frame in the frame of OUT: x y [m] and yaw [rad].", metavar="X Y YAW"),
]
Merge = Annotated[Path | None, Option(help="Another map to merge with GRID by --rule, with its layers.")]
MergePose = Annotated[
    tuple[float, float, float] | None,
    Option(help="Pose of --merge's frame in the frame of GRID: x y [m] and yaw [rad].", metavar="X Y YAW"),
]
Rule = Annotated[str | None, Option(help=f"Rule for --merge: {', '.join(RULES)}. [default: cautious]")]
Extent = Annotated[
    tuple[float, float, float, float] | None, Option(help="Crop to x_min x_max y_min y_max [m], in the frame of GRID.")
]
Side = Annotated[float | None, Option(help="Resample to cells of this side [m]; free areas never grow.")]
Layer = Annotated[str | None, Option(help="Write one layer of GRID as occupancy, such as for map_server.")]
LayerValues = Annotated[
    tuple[float, float] | None, Option(help="Values of free and occupied in --layer. [default: 0 100]")
]
Message = Annotated[
    str | None,
    Option(
        help="Message of logs: occupancy-grid, costmap; with all layers grid-map, foxglove-grid. [default: the first]"
    ),
]
Topic = Annotated[str | None, Option(help="Topic of a GRID in a log. [default: the only topic with grids, or /map]")]
FreeThresh = Annotated[
    float | None, Option(help="Replaces free_thresh of a .yaml GRID; use 0.196 if unknown cells are read as free.")
]
Length = Annotated[float | None, Option(help="Extent along x of a .png or .npy, which lack it [m].")]
Width = Annotated[float | None, Option(help="Extent along y [m]. The origin is the middle of the extent.")]
Resolution = Annotated[float, Option(help="Side of a cell of a .png or .npy [m].")]


@report_errors
def convert(
    grid: GridFile,
    out: OutFile,
    mode: Mode = None,
    crs: Crs = None,
    pose: Pose = None,
    merge: Merge = None,
    merge_pose: MergePose = None,
    rule: Rule = None,
    extent: Extent = None,
    side: Side = None,
    layer: Layer = None,
    layer_values: LayerValues = None,
    message: Message = None,
    topic: Topic = None,
    free_thresh: FreeThresh = None,
    length: Length = None,
    width: Width = None,
    resolution: Resolution = 0.16,
) -> None:
    """Write a map in another format; optionally merge, crop or resample it.

    Formats with bands (.npz, .tif, .nc, .zarr, grid-map and foxglove-grid in logs) are exact and keep all layers.
    map_server and occupancy-grid store a state or a value per cell, .png the masses in steps of 1/255. All formats
    except .npz and .png can store a rotation of the map. Of a log with several maps, the last is read.
    """
    from dataclasses import replace

    from ogm.io import grid_from_layer
    from ogm.io.grids.files import check_grid_output, read_placed_grid, write_grid
    from ogm.pose import pose as pose_of

    check_grid_output(out, mode=mode, message=message, crs=crs)  # type: ignore[arg-type]
    same = (grid.with_suffix(".png") if grid.suffix.lower() in (".yaml", ".yml") else grid).resolve()
    if out.resolve() in (grid.resolve(), same, merge and merge.resolve()):
        raise ValueError(f"{out} would overwrite {grid}, its image or --merge; give another name")
    if (merge is None and (merge_pose, rule) != (None, None)) or (layer is None and layer_values is not None):
        raise ValueError("--merge-pose and --rule need --merge, and --layer-values needs --layer: give them, too")
    placed = read_placed_grid(grid, _area(length, width, resolution), topic=topic, free_thresh=free_thresh)
    if merge is not None or extent is not None or side is not None:
        from ogm import fusion  # takes long

        if rule not in (None, *RULES):
            raise ValueError(f"--rule must be one of {', '.join(RULES)}, got {rule!r}")
        if merge is not None:
            x, y, yaw = merge_pose or (0.0, 0.0, 0.0)
            rule_of = RULES[rule or "cautious"]
            placed = fusion.merge(placed, read_placed_grid(merge), pose_of(x, y, yaw=yaw), rule=rule_of)
        placed = placed if extent is None else fusion.crop(placed.upright, extent)
        placed = placed if side is None else fusion.resampled(placed, side)
    if layer is not None:
        placed = replace(placed, grid=grid_from_layer(placed.bands, layer, layer_values or (0.0, 100.0)), layers=None)
        mode = mode or ("scale" if out.suffix.lower() in (".yaml", ".yml") else None)
    if pose is not None:
        placed = replace(placed, T_frame_grid=pose_of(*pose[:2], yaw=pose[2]) @ placed.T_frame_grid)
    if crs is not None:
        placed = replace(placed, crs=crs)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_grid(out, placed, mode=mode, message=message)  # type: ignore[arg-type]
    spec, (x, y, yaw) = placed.grid.spec, placed.corner
    facts = {
        "map": str(out),
        "cells": f"{spec.shape[0]} x {spec.shape[1]} of {spec.resolution:g} m",
        "corner": f"x {x:.10g} m, y {y:.10g} m" + (f", yaw {yaw:.6g} rad" if yaw else ""),
    }
    layers = placed.layers if hasattr(placed.grid, "mass") else placed.grid
    if hasattr(placed.grid, "mass"):
        shares = (f"{name} {100 * getattr(placed.grid, name).mean():.1f} %" for name in ("free", "occupied", "unknown"))
        facts["masses"] = ", ".join(shares)
    facts |= {"layers": ", ".join(layers.layers)} if layers else {}
    print_facts(facts | ({"crs": placed.crs} if placed.crs else {}))


def _area(length: float | None, width: float | None, resolution: float) -> "GridSpec | None":
    """Return the cells of a file without geometry, by the options; None if they are not given."""
    from ogm.grid import GridSpec

    if length is None and width is None:
        return None
    if length is None or width is None:
        raise ValueError("give both --length and --width [m], or neither")
    return GridSpec.centered(length, width, resolution)
