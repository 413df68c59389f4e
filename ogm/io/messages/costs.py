"""Costs of cells from `ogm.planning.costmap`, as ``nav2_msgs/Costmap`` and as occupancy, and back."""

from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.grid import EvidentialGrid, LayeredGrid
from ogm.io.messages.grids import AnyGrid, bands_of, corner_pose, mass_from_occupancy, spec_of, split_corner
from ogm.io.messages.plain import as_bytes, describe_message, header, pose_message, reads_message, transform_of_pose
from ogm.storage.files import OgmError

COST = "cost"
_UNKNOWN = 255


def costs_of(bands: LayeredGrid) -> NDArray[np.uint8]:
    """Return the layer cost as bytes, (nx, ny): 0 free to 254 obstacle, 255 unknown or no value (NaN).

    Raises
    ------
    ValueError
        If there is no such layer, or its numbers are no integers from 0 to 255.
    """
    if COST not in bands.layers:
        got = ", ".join(bands.layers) or "none"
        raise ValueError(f"wanted a layer {COST}, got {got}: ogm.planning.costmap computes it from masses")
    costs = np.where(np.isnan(bands[COST]), np.float32(_UNKNOWN), bands[COST])
    whole = (costs >= 0) & (costs <= 255) & (costs == np.floor(costs))
    if not whole.all():
        raise ValueError(f"costs must be integers from 0 to 255, got {costs[~whole][0]:g}")
    return costs.astype(np.uint8)


def occupancy_from_costs(layers: LayeredGrid) -> EvidentialGrid:
    """Return the layer cost as occupancy, for formats with one value per cell: OccupancyGrid, map_server.

    Values match nav2's publisher (``Costmap2DPublisher``): 0 for cost 0, 1 to 98 for 1 to 252, 99 for 253, 100 for 254,
    unknown for 255. Mode ``scale`` of map_server keeps them.

    Parameters
    ----------
    layers : LayeredGrid
        Layers that include ``cost``.

    Raises
    ------
    ValueError
        See `costs_of`.
    """
    cost = np.arange(256)
    values = np.where(cost == 0, 0, 1 + 97 * (cost - 1) // 251)
    values[253:] = 99, 100, -1
    return EvidentialGrid.trusted(layers.spec, mass_from_occupancy(values)[costs_of(layers)])


def nav2_costmap(
    grid: AnyGrid,
    *,
    frame_id: str = "map",
    stamp: float | None = None,
    T_frame_grid: ArrayLike | None = None,
    layers: LayeredGrid | None = None,
) -> SimpleNamespace:
    """Return the layer cost as a ``nav2_msgs/Costmap``, as published by nav2 on ``global_costmap/costmap_raw``.

    Parameters
    ----------
    grid : LayeredGrid, or any grid with `layers`
        Grid with the layer ``cost``; other layers are ignored.
    frame_id, stamp, T_frame_grid
        See `ogm.io.messages.occupancy_grid`.
    layers : LayeredGrid, optional
        Further layers of the same cells.

    Returns
    -------
    SimpleNamespace
        Object with the fields of the message. Its origin is the outer corner of cell (0, 0); ``data`` begins there, x
        first.

    Raises
    ------
    ValueError
        See `costs_of`.
    """
    costs, top = costs_of(bands_of(grid, layers)), header(stamp, frame_id)
    metadata = SimpleNamespace(
        map_load_time=top.stamp,
        update_time=top.stamp,
        layer="master",
        resolution=grid.spec.resolution,
        size_x=grid.spec.shape[0],
        size_y=grid.spec.shape[1],
        origin=pose_message(corner_pose(grid.spec, T_frame_grid)),
    )
    return SimpleNamespace(header=top, metadata=metadata, data=costs.T.reshape(-1))


@reads_message
def layers_from_nav2_costmap(message: Any) -> tuple[LayeredGrid, NDArray[np.float64]]:
    """Return the costs of a ``nav2_msgs/Costmap``, and their pose in the frame of the message.

    Returns
    -------
    layers : LayeredGrid
        The layer ``cost``, NaN if unknown.
    T_frame_grid : (4, 4) float64
        Rotates and lifts the grid; identity if the message does neither.

    Raises
    ------
    OgmError
        If sizes are inconsistent, or the pose is not rigid.
    """
    where, facts = describe_message(message, "Costmap"), message.metadata
    shape, data = (int(facts.size_x), int(facts.size_y)), as_bytes(message.data, describe_message(message, "Costmap"))
    if data.size != shape[0] * shape[1] or min(shape) < 1:
        raise OgmError(f"{where} has {data.size} values, wanted {shape[0]} x {shape[1]}: it is damaged")
    origin, T = split_corner(transform_of_pose(facts.origin, where))
    cost = np.where(data == _UNKNOWN, np.float32(np.nan), data).reshape(shape[::-1]).T
    return LayeredGrid(spec_of(facts.resolution, shape, origin, where), {COST: cost}), T
