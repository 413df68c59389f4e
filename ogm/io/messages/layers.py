"""Grids as ``grid_map_msgs/GridMap``, with all their masses, and back."""

import logging
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.grid import LayeredGrid
from ogm.io.layers import AnyGrid, grid_from_layers, layers_of, needed_layers
from ogm.io.messages.occupancy import corner_pose, spec_of, split_corner
from ogm.io.messages.plain import describe_message, header, reads_message
from ogm.io.messages.poses import pose_message, transform_of_pose
from ogm.pose import pose
from ogm.storage.files import OgmError, error_context

log: logging.Logger = logging.getLogger(__name__)

_LABELS = ("column_index", "row_index")  # of an Eigen matrix in the order of its memory: column by column


def grid_map(
    grid: AnyGrid,
    *,
    frame_id: str,
    stamp: float | None = None,
    T_frame_grid: ArrayLike | None = None,
    layers: Mapping[str, NDArray[Any]] | None = None,
) -> SimpleNamespace:
    """Return a grid as a ``grid_map_msgs/GridMap`` with the layers free, occupied and unknown.

    Parameters
    ----------
    grid : EvidentialGrid or DynamicGrid
        The latter with all its layers; velocities are along the grid's axes.
    frame_id, stamp, T_frame_grid
        See `ogm.io.messages.occupancy_grid`.
    layers : mapping of str to (nx, ny) array, optional
        Further layers, such as conflict; those of a `LayeredGrid` are its ``layers``. NaN where there is no value.

    Returns
    -------
    SimpleNamespace
        With the fields of the message of ROS 2, and the header of ROS 1 in ``info``.

    Notes
    -----
    As grid_map's code has it (GridMapMath.cpp, GridMapRosConverter.cpp): the pose is the middle of the map; cell (0, 0)
    is the one of the largest x and y, rows go towards -x and columns towards -y; a layer is written column by column.
    grid_map has no rotation: its converter drops that of ``info.pose``, which other readers may use. Where the grid is
    turned in `frame_id`, give it a frame of its own, joined by tf.
    """
    (nx, ny), named = grid.spec.shape, layers_of(grid)
    for name, layer in LayeredGrid(grid.spec, layers or {}).layers.items():
        if name in named:
            raise ValueError(f"the layer {name!r} is the grid's own: give another name")
        named[name] = layer
    middle = corner_pose(grid.spec, T_frame_grid) @ pose(grid.spec.length / 2, grid.spec.width / 2)
    if not np.allclose(middle[:3, :3], np.eye(3), atol=1e-9):
        log.warning("grid_map's own code drops the rotation of a map: give the grid a frame of its own, joined by tf")
    dimensions = [
        SimpleNamespace(label=label, size=size, stride=stride)
        for label, size, stride in zip(_LABELS, (ny, nx), (nx * ny, nx), strict=True)
    ]
    top = header(stamp, frame_id)
    return SimpleNamespace(
        header=top,
        info=SimpleNamespace(
            header=top,
            resolution=grid.spec.resolution,
            length_x=grid.spec.length,
            length_y=grid.spec.width,
            pose=pose_message(middle),
        ),
        layers=list(named),
        basic_layers=["free", "occupied"],
        data=[
            SimpleNamespace(
                layout=SimpleNamespace(dim=dimensions, data_offset=0),
                data=np.asarray(layer[::-1, ::-1], np.float32).reshape(-1, order="F"),
            )
            for layer in named.values()
        ],
        outer_start_index=0,
        inner_start_index=0,
    )


@reads_message
def grid_from_grid_map(message: Any) -> tuple[AnyGrid, NDArray[np.float64]]:
    """Return the grid of a ``grid_map_msgs/GridMap`` that has the layers free and occupied, and where it lies.

    Returns
    -------
    grid : EvidentialGrid, or DynamicGrid where there are all of its layers
        Cells that have no value (NaN) are unknown.
    T_frame_grid : (4, 4) float64
        Turns and lifts the grid; identity if the message does neither.

    Raises
    ------
    OgmError
        If a layer is missing, sizes contradict each other, or numbers are no masses.
    """
    where = _describe(message)
    try:
        needed_layers(message.layers)
    except KeyError as error:
        raise OgmError(
            f"{where} has no layer {error.args[0]}, only {', '.join(message.layers) or 'none'}: it holds no masses of "
            "free and occupied; layers_from_grid_map returns what it holds"
        ) from error
    layered, T = layers_from_grid_map(message)
    with error_context(f"{where} has layers that are no masses"):
        return grid_from_layers(layered, nan_is_unknown=True), T


@reads_message
def layers_from_grid_map(message: Any) -> tuple[LayeredGrid, NDArray[np.float64]]:
    """Return all layers of a ``grid_map_msgs/GridMap``, and where they lie in the frame of the message.

    Returns
    -------
    layers : LayeredGrid
        x forward, y left, from the corner in ``spec.origin`` on.
    T_frame_grid : (4, 4) float64
        Turns and lifts the grid; identity if the message does neither.

    Raises
    ------
    OgmError
        If sizes contradict each other.
    """
    where, info = _describe(message), message.info
    side = float(info.resolution)
    cells = (float(info.length_x) / side, float(info.length_y) / side) if side > 0 else (0.0, 0.0)
    if not np.isfinite(cells).all() or min(cells) < 0.5 or len(message.layers) != len(message.data):
        raise OgmError(
            f"{where} has {len(message.layers)} names for {len(message.data)} layers, and {info.length_x:g} x "
            f"{info.length_y:g} m in cells of {side:g} m: it is damaged"
        )
    shape = (round(cells[0]), round(cells[1]))
    middle = transform_of_pose(info.pose, where)
    corner = middle @ pose(-shape[0] * side / 2, -shape[1] * side / 2)
    origin, T = split_corner(corner)
    start = int(message.outer_start_index), int(message.inner_start_index)
    layers = {
        str(name): _matrix(layer, shape, f"layer {name} of {where}", start)
        for name, layer in zip(message.layers, message.data, strict=True)
    }
    return LayeredGrid(spec_of(side, shape, origin, where), layers), T


def _matrix(layer: Any, shape: tuple[int, int], where: str, start: tuple[int, int]) -> NDArray[np.float32]:
    """Return a layer as [ix, iy]; its memory is a ring whose first row and column are `start`."""
    data = np.asarray(layer.data, np.float32)[int(layer.layout.data_offset) :]
    if data.size != shape[0] * shape[1]:
        raise OgmError(f"{where} has {data.size} values, wanted {shape[0]} x {shape[1]}: it is damaged")
    by_rows = bool(layer.layout.dim) and layer.layout.dim[0].label == "row_index"
    matrix = data.reshape(shape, order="C" if by_rows else "F")
    return np.roll(matrix, (-start[0], -start[1]), axis=(0, 1))[::-1, ::-1]


def _describe(message: Any) -> str:
    """Return a name of the message for errors; its header is in ``info`` in ROS 1."""
    return describe_message(message if hasattr(message, "header") else message.info, "GridMap")
