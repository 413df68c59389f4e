"""Grids in ``.npz`` files with pose, stamp and further layers, compatible with `EvidentialGrid.save`."""

from pathlib import Path
from typing import Any

from ogm.dynamic_grid import DynamicGrid
from ogm.grid import EvidentialGrid, LayeredGrid
from ogm.io.grids.placed import PlacedGrid
from ogm.pose import pose
from ogm.storage.archive import open_archive, stated_format, write_archive


def write_archived(path: Path, placed: PlacedGrid) -> None:
    """Write a grid in the axes of its frame."""
    placed = placed.upright
    facts: dict[str, Any] = {"frame_id": placed.frame_id, "height": float(placed.T_frame_grid[2, 3])}
    facts |= {name: fact for name in ("stamp", "crs") if (fact := getattr(placed, name)) is not None}
    layers = {} if placed.layers is None else placed.layers.arrays()
    write_archive(path, placed.grid.FORMAT, **{**layers, **placed.grid.arrays(), **facts})


def read_archived(path: Path) -> PlacedGrid:
    """Read a grid of any kind; older files have no pose, stamp or layers."""
    stated = stated_format(path)
    kind: Any = next((known for known in (DynamicGrid, LayeredGrid) if stated == known.FORMAT), EvidentialGrid)
    with open_archive(path, kind.FORMAT) as arrays:
        has_layers = kind is not LayeredGrid and "layers" in arrays
        return PlacedGrid(
            kind.of_arrays(arrays),
            pose(z=float(arrays.get("height", 0.0))),
            str(arrays.get("frame_id", "map"))[:256],
            float(arrays["stamp"]) if "stamp" in arrays else None,
            str(arrays["crs"]) if "crs" in arrays else None,
            LayeredGrid.of_arrays(arrays) if has_layers else None,
        )
