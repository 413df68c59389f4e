"""Writing costs of a map in any file format."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ogm.grid import LayeredGrid
from ogm.io.grids.files import write_grid
from ogm.io.grids.logged import GridMessage
from ogm.io.grids.map_server import MapMode
from ogm.io.grids.placed import PlacedGrid
from ogm.io.logs import LOG_ENDINGS
from ogm.io.messages.costs import COST, occupancy_from_costs
from ogm.storage.files import FilePath


def write_costmap(
    path: FilePath,
    placed: PlacedGrid,
    costs: NDArray[np.uint8],
    *,
    mode: MapMode | None = None,
    message: GridMessage | None = None,
) -> None:
    """Write the costs of a map in the format of a path.

    Parameters
    ----------
    path : path
        ``.mcap``, ``.db3`` and ``.bag`` store a ``nav2_msgs/Costmap`` on ``/costmap_raw``, or the `message`; ``.yaml``,
        ``.png`` and occupancy-grid messages store `ogm.io.occupancy_from_costs`; other formats store the map with the
        layer ``cost``.
    placed : PlacedGrid
        The map.
    costs : (nx, ny) uint8
        Cost of each cell, see `ogm.planning.costmap`.
    mode : {"trinary", "scale", "raw"}, optional
        Mode of map_server; by default "scale".
    message : {"costmap", "occupancy-grid", "grid-map", "foxglove-grid"}, optional
        Message of logs; by default "costmap".

    Raises
    ------
    ValueError, ImportError, OSError
        See `ogm.io.write_grid`.
    """
    ending, layers = Path(path).suffix.lower(), LayeredGrid(placed.grid.spec, {COST: costs.astype(np.float32)})
    if ending in LOG_ENDINGS:
        message = message or "costmap"
    elif ending in (".yaml", ".yml"):
        mode = mode or "scale"
    if ending in (".yaml", ".yml", ".png") or message == "occupancy-grid":
        written = replace(placed, grid=occupancy_from_costs(layers), layers=None)
    elif message == "costmap":
        written = replace(placed, grid=layers, layers=None)
    else:
        others = {} if placed.layers is None else placed.layers.layers
        written = replace(placed, layers=LayeredGrid(layers.spec, {**others, **layers.layers}))
    write_grid(path, written, mode=mode, message=message)
