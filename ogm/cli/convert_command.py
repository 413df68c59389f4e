"""``ogm convert``: a map from one format of files to another."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from ogm.cli.console import print_facts, report_errors
from ogm.evidence.map_rules import RULES

if TYPE_CHECKING:
    from ogm.grid import GridSpec

GridFile = Annotated[Path, Argument(help="Map or grid: .npz, .yaml, .tif, .nc, .zarr, .mcap, .db3, .bag, .png, .npy.")]
OutFile = Annotated[Path, Argument(help="File to write, by its ending; its folder is made if need be.")]
Mode = Annotated[str | None, Option(help="Of .yaml: trinary, scale or raw (0 to 100). [default: trinary]")]
Crs = Annotated[str | None, Option(help="Coordinate reference system of OUT, in metres, such as EPSG:25832.")]
Pose = Annotated[
    tuple[float, float, float] | None,
    Option(help="Where GRID's frame lies in that of OUT: x y [m] and yaw [rad].", metavar="X Y YAW"),
]
Merge = Annotated[Path | None, Option(help="Another map that is merged with GRID, by --rule, its layers too.")]
MergePose = Annotated[
    tuple[float, float, float] | None,
    Option(help="Where the frame of --merge lies in that of GRID: x y [m] and yaw [rad].", metavar="X Y YAW"),
]
Rule = Annotated[str | None, Option(help=f"Combine both maps by: {', '.join(RULES)}. [default: cautious]")]
Extent = Annotated[
    tuple[float, float, float, float] | None, Option(help="Cut: x_min x_max y_min y_max [m], in the frame of GRID.")
]
Side = Annotated[float | None, Option(help="Cells of another side [m]; free is never enlarged.")]
Layer = Annotated[str | None, Option(help="Write one layer of GRID as occupancy, such as for map_server.")]
LayerValues = Annotated[
    tuple[float, float] | None, Option(help="Of --layer: the values of free and of occupied cells. [default: 0 100]")
]
Message = Annotated[
    str | None,
    Option(
        help="Of .mcap, .db3, .bag: occupancy-grid, grid-map or foxglove-grid, with all layers, or costmap. "
        "[default: the first]"
    ),
]
Topic = Annotated[str | None, Option(help="Of a GRID in a log. [default: the one with grids, or /map]")]
FreeThresh = Annotated[
    float | None,
    Option(help="Of a GRID as .yaml: replaces its free_thresh; 0.196 where unknown cells are read as free."),
]
Length = Annotated[float | None, Option(help="Extent along x of a .png or .npy, which do not hold it [m].")]
Width = Annotated[float | None, Option(help="The same along y [m]. The middle of the extent is the origin.")]
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
    """Write a map in another format, merged with another one, cut, or on other cells.

    Formats that hold bands (.npz, .tif, .nc, .zarr, grid-map and foxglove-grid in logs) are exact and have all layers;
    map_server and occupancy-grid hold a state or a value per cell, a .png the masses in steps of 1/255. All but .npz
    and .png can hold a turn of the map. Of a log with several maps, the last is taken.
    """
    from dataclasses import replace

    from ogm.io import grid_from_layer
    from ogm.io.grids.files import check_grid_output, read_placed_grid, write_grid
    from ogm.pose import pose as pose_of

    check_grid_output(out, mode=mode, message=message, crs=crs)  # type: ignore[arg-type]
    same = (grid.with_suffix(".png") if grid.suffix.lower() in (".yaml", ".yml") else grid).resolve()
    if out.resolve() in (grid.resolve(), same, merge and merge.resolve()):
        raise ValueError(f"{out} would take the place of {grid} or of its image; give another name")
    if (merge is None and (merge_pose, rule) != (None, None)) or (layer is None and layer_values is not None):
        raise ValueError("--merge-pose and --rule belong to --merge, --layer-values to --layer, which is missing")
    placed = read_placed_grid(grid, _area(length, width, resolution), topic=topic, free_thresh=free_thresh)
    if merge is not None or extent is not None or side is not None:
        from ogm import fusion  # takes long

        if rule not in (None, *RULES):
            raise ValueError(f"there is no rule {rule!r}; there are {', '.join(RULES)}")
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
        "corner": f"x {x:.10g} m, y {y:.10g} m" + (f", turned by {yaw:.6g} rad" if yaw else ""),
    }
    layers = placed.layers if hasattr(placed.grid, "mass") else placed.grid
    if hasattr(placed.grid, "mass"):
        shares = (f"{name} {100 * getattr(placed.grid, name).mean():.1f} %" for name in ("free", "occupied", "unknown"))
        facts["masses"] = ", ".join(shares)
    facts |= {"layers": ", ".join(layers.layers)} if layers else {}
    print_facts(facts | ({"crs": placed.crs} if placed.crs else {}))


def _area(length: float | None, width: float | None, resolution: float) -> "GridSpec | None":
    """Return the area of a file that does not hold it; none where none is given."""
    from ogm.grid import GridSpec

    if length is None and width is None:
        return None
    if length is None or width is None:
        raise ValueError("give both --length and --width [m], or none of them")
    return GridSpec.centered(length, width, resolution)
