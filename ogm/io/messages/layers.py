"""Grids with all bands as ``grid_map_msgs/GridMap`` and ``foxglove.Grid``, and back."""

import logging
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.grid import EvidentialGrid, LayeredGrid
from ogm.io.messages.grids import (
    MASSES,
    AnyGrid,
    bands_of,
    check_grid,
    check_names,
    corner_pose,
    masses_of_bands,
    spec_of,
    split_corner,
)
from ogm.io.messages.plain import as_bytes, describe_message, header, pose_message, reads_message, transform_of_pose
from ogm.io.reading import optional
from ogm.plot.colours import colours
from ogm.pose import pose
from ogm.storage.files import OgmError

log: logging.Logger = logging.getLogger(__name__)

_LABELS = ("column_index", "row_index")  # dimensions of an Eigen matrix, which is stored column by column


def grid_map(
    grid: AnyGrid,
    *,
    frame_id: str = "map",
    stamp: float | None = None,
    T_frame_grid: ArrayLike | None = None,
    layers: LayeredGrid | None = None,
) -> SimpleNamespace:
    """Return a grid as a ``grid_map_msgs/GridMap`` with the layers free, occupied and unknown, or its own layers.

    Parameters
    ----------
    grid : EvidentialGrid, DynamicGrid or LayeredGrid
        All layers of the latter two are included; velocities are along the grid's axes.
    frame_id, stamp, T_frame_grid
        See `ogm.io.messages.occupancy_grid`.
    layers : LayeredGrid, optional
        Further layers on the same cells, such as `ogm.fusion.EvidentialMapper.conflict`. NaN means no value.

    Returns
    -------
    SimpleNamespace
        Object with the fields of the message of ROS 2, and the header of ROS 1 in ``info``.

    Notes
    -----
    Conventions of grid_map's code (GridMapMath.cpp, GridMapRosConverter.cpp): the pose is the middle of the map; cell
    (0, 0) has the largest x and y, rows go towards -x and columns towards -y; a layer is written column by column.
    grid_map has no rotation: its converter drops the rotation of ``info.pose``, which other readers may use. Give a
    grid that is rotated in `frame_id` its own frame, connected by tf.
    """
    (nx, ny), named = grid.spec.shape, bands_of(grid, layers).layers
    middle = corner_pose(grid.spec, T_frame_grid) @ pose(grid.spec.length / 2, grid.spec.width / 2)
    if not np.allclose(middle[:3, :3], np.eye(3), atol=1e-9):
        log.warning("grid_map's own code drops the rotation of a map: give the grid its own frame, connected by tf")
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
        basic_layers=[name for name in MASSES[:2] if name in named],
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
    """Return the grid of a ``grid_map_msgs/GridMap`` with the layers free and occupied, and its pose.

    Returns
    -------
    grid : EvidentialGrid, or DynamicGrid if all of its layers exist
        Cells without a value (NaN) are unknown.
    T_frame_grid : (4, 4) float64
        Rotates and lifts the grid; identity if the message does neither.

    Raises
    ------
    OgmError
        If a layer is missing, sizes are inconsistent, or numbers are no masses.
    """
    bands, T = layers_from_grid_map(message)
    return masses_of_bands(bands, _describe(message), "layer"), T


@reads_message
def layers_from_grid_map(message: Any) -> tuple[LayeredGrid, NDArray[np.float64]]:
    """Return all layers of a ``grid_map_msgs/GridMap``, and their pose in the frame of the message.

    Returns
    -------
    layers : LayeredGrid
        Layers with x forward, y left, starting from the corner in ``spec.origin``.
    T_frame_grid : (4, 4) float64
        Rotates and lifts the grid; identity if the message does neither.

    Raises
    ------
    OgmError
        If sizes are inconsistent.
    """
    where, info = _describe(message), message.info
    side = float(info.resolution)
    cells = (float(info.length_x) / side, float(info.length_y) / side) if side > 0 else (0.0, 0.0)
    if not np.isfinite(cells).all() or min(cells) < 0.5 or len(message.layers) != len(message.data):
        got = f"{len(message.layers)} names for {len(message.data)} layers, {info.length_x:g} x {info.length_y:g} m"
        raise OgmError(f"{where} has {got} in cells of {side:g} m: it is damaged")
    shape = (round(cells[0]), round(cells[1]))
    corner = transform_of_pose(info.pose, where) @ pose(-shape[0] * side / 2, -shape[1] * side / 2)
    origin, T = split_corner(corner)
    start = int(message.outer_start_index), int(message.inner_start_index)
    layers = {
        str(name): _matrix(layer, shape, f"layer {name} of {where}", start)
        for name, layer in zip(message.layers, message.data, strict=True)
    }
    return LayeredGrid(spec_of(side, shape, origin, where), layers), T


def _matrix(layer: Any, shape: tuple[int, int], where: str, start: tuple[int, int]) -> NDArray[np.float32]:
    """Return a layer as [ix, iy], from a circular buffer with `start` as its first row and column."""
    data = np.asarray(layer.data, np.float32)[int(layer.layout.data_offset) :]
    if data.size != shape[0] * shape[1]:
        raise OgmError(f"{where} has {data.size} values, wanted {shape[0]} x {shape[1]}: it is damaged")
    by_rows = bool(layer.layout.dim) and layer.layout.dim[0].label == "row_index"
    matrix = data.reshape(shape, order="C" if by_rows else "F")
    return np.roll(matrix, (-start[0], -start[1]), axis=(0, 1))[::-1, ::-1]


def _describe(message: Any) -> str:
    """Return the name of the message for errors; in ROS 1 its header is in ``info``."""
    return describe_message(message if hasattr(message, "header") else message.info, "GridMap")


_COLOURS = ("red", "green", "blue", "alpha")
_TYPES = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}  # foxglove.PackedElementField


def foxglove_grid(
    grid: AnyGrid,
    *,
    frame_id: str = "map",
    stamp: float | None = None,
    T_frame_grid: ArrayLike | None = None,
    layers: LayeredGrid | None = None,
    colour: NDArray[np.floating] | None = None,
) -> Any:
    """Return a grid as a ``foxglove.Grid`` with fields free, occupied, unknown and a colour, or its own layers.

    Cells have the colours of `ogm.plot.colours`, mixed by the masses; unknown is transparent. Layers without masses
    have no colour, so the viewer chooses one.

    Parameters
    ----------
    grid : EvidentialGrid, DynamicGrid or LayeredGrid
        All layers of the latter two are included; velocities are along the grid's axes.
    frame_id : str
    stamp : float, optional
        [s]; 0 by default.
    T_frame_grid : (4, 4) array, optional
        Transform from the grid's coordinates to the frame; identity by default.
    layers : LayeredGrid, optional
        Further fields on the same cells, such as `ogm.fusion.EvidentialMapper.conflict`.
    colour : (nx, ny, 3) float array, optional
        Red, green, blue [0, 1] of cells, which are then opaque.

    Returns
    -------
    foxglove.messages.Grid
        ``encode()`` gives the bytes of its protobuf message. Its pose is the outer corner of cell (0, 0); its data
        begin there, x first.

    Raises
    ------
    ImportError
        If foxglove-sdk is missing.
    """
    library = optional("foxglove.messages", Path("foxglove.Grid"), "live", "made")
    from ogm.io.messages.foxglove_cells import fill_masses  # only now: reading needs no kernels

    check_grid(grid)
    masses = () if isinstance(grid, LayeredGrid) else MASSES
    is_coloured = bool(masses) or colour is not None
    check_names(grid, layers, _COLOURS if is_coloured else ())
    own = grid.to_layers().layers if isinstance(grid, DynamicGrid) else getattr(grid, "layers", {})
    others = {**own, **(layers.layers if layers else {})}
    names = dict.fromkeys((*masses, *others))
    nx, ny = grid.spec.shape
    cells = np.empty((ny, nx, len(names) + is_coloured), "<f4")  # x first
    octets = cells.view(np.uint8)
    if not isinstance(grid, LayeredGrid):
        mass = grid.mass if isinstance(grid, EvidentialGrid) else np.stack([grid.free, grid.occupied], axis=-1)
        palette = np.array([colours().free, colours().occupied], np.float32)
        fill_masses(np.ascontiguousarray(mass), palette, cells, octets)
    for k, name in enumerate(names):
        if name not in masses:
            cells[..., k] = others[name].T
    if colour is not None:
        octets[..., -4:-1] = np.rint(255 * colour).astype(np.uint8).swapaxes(0, 1)
        octets[..., -1] = 255
    fields = [(name, 4 * k, "Float32") for k, name in enumerate(names)]
    if is_coloured:
        fields += [(name, 4 * len(names) + k, "Uint8") for k, name in enumerate(_COLOURS)]
    kinds = library.PackedElementFieldNumericType
    placed, when = pose_message(corner_pose(grid.spec, T_frame_grid)), header(stamp, frame_id).stamp
    return library.Grid(
        timestamp=library.Timestamp(when.sec, when.nanosec),
        frame_id=frame_id,
        pose=library.Pose(
            position=library.Vector3(**vars(placed.position)),
            orientation=library.Quaternion(**vars(placed.orientation)),
        ),
        column_count=nx,
        cell_size=library.Vector2(x=grid.spec.resolution, y=grid.spec.resolution),
        row_stride=octets.strides[0],
        cell_stride=octets.strides[1],
        fields=[library.PackedElementField(name=name, offset=k, type=getattr(kinds, kind)) for name, k, kind in fields],
        data=octets.tobytes(),
    )


@reads_message
def grid_from_foxglove_grid(message: Any) -> tuple[AnyGrid, NDArray[np.float64]]:
    """Return the grid of a decoded ``foxglove.Grid`` with the fields free and occupied, and its pose.

    Parameters
    ----------
    message : object
        Object with the field names of the protobuf message.

    Returns
    -------
    grid, T_frame_grid
        See `ogm.io.messages.grid_from_grid_map`.

    Raises
    ------
    OgmError
        If a field is missing, sizes are inconsistent, cells are not square or numbers are no masses.
    """
    bands, T = layers_from_foxglove_grid(message)
    return masses_of_bands(bands, _describe_foxglove(message), "field"), T


@reads_message
def layers_from_foxglove_grid(message: Any) -> tuple[LayeredGrid, NDArray[np.float64]]:
    """Return all fields of a decoded ``foxglove.Grid`` except colours, and their pose in the frame of the message.

    Parameters, results and errors: see `grid_from_foxglove_grid` and `layers_from_grid_map`.
    """
    where = _describe_foxglove(message)
    fields = {field.name: field for field in message.fields}
    data, side = as_bytes(message.data, where), message.cell_size.x
    nx, row, cell = int(message.column_count), int(message.row_stride), int(message.cell_stride)
    if side != message.cell_size.y:
        raise OgmError(f"{where} has cells of {side:g} x {message.cell_size.y:g} m, wanted squares")
    ny = len(data) // row if row > 0 else 0
    if min(nx, ny, cell) < 1 or nx * cell > row or ny * row != len(data):
        raise OgmError(f"{where} has {len(data)} bytes, wanted rows of {row} bytes with {nx} cells of {cell}")
    layers = {}
    for name, field in fields.items():
        try:
            kind, offset = np.dtype("<" + _TYPES[int(field.type)]), int(field.offset)
        except (KeyError, ValueError, TypeError) as error:
            raise OgmError(f"{where} has a field {name} of unknown type: it is damaged") from error
        if not 0 <= offset <= cell - kind.itemsize or (kind.kind != "f" and name in MASSES):
            raise OgmError(f"{where} has a field {name} that is no float inside of its cells: it is damaged")
        if name not in _COLOURS:
            layers[name] = np.ndarray((ny, nx), kind, data, offset, (row, cell)).T
    origin, T = split_corner(transform_of_pose(message.pose, where))
    return LayeredGrid(spec_of(side, (nx, ny), origin, where), layers), T


def _describe_foxglove(message: Any) -> str:
    return f"Grid of {message.frame_id or 'no frame'}"
