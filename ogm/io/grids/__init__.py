"""Grids in files, both ways: map_server, GeoTIFF, NetCDF, Zarr, logs, pictures, arrays. Only here do maps flip."""

from ogm.io.grids.files import (
    GRID_ENDINGS,
    MAP_ENDINGS,
    check_grid_output,
    read_any_grid,
    read_grid,
    read_placed_grid,
    write_grid,
)
from ogm.io.grids.logged import GridLog, GridMessage
from ogm.io.grids.placed import PlacedGrid
from ogm.io.grids.scientific import from_xarray, to_xarray

__all__ = [
    "GRID_ENDINGS",
    "MAP_ENDINGS",
    "GridLog",
    "GridMessage",
    "PlacedGrid",
    "check_grid_output",
    "from_xarray",
    "read_any_grid",
    "read_grid",
    "read_placed_grid",
    "to_xarray",
    "write_grid",
]
