"""Grids as ``foxglove.Grid``, with all their masses and a colour, and back."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.grid import LayeredGrid
from ogm.io.layers import AnyGrid, grid_from_layers, layers_of, needed_layers
from ogm.io.messages.occupancy import corner_pose, spec_of, split_corner
from ogm.io.messages.plain import as_bytes, reads_message, ros_stamp
from ogm.io.messages.poses import pose_message, transform_of_pose
from ogm.io.reading import optional
from ogm.plot.colours import colours
from ogm.storage.files import OgmError, error_context

_COLOURS = ("red", "green", "blue", "alpha")
_TYPES = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}  # foxglove.PackedElementField


def foxglove_grid(
    grid: AnyGrid,
    *,
    frame_id: str,
    stamp: float | None = None,
    T_frame_grid: ArrayLike | None = None,
    layers: Mapping[str, NDArray[Any]] | None = None,
) -> Any:
    """Return a grid as a ``foxglove.Grid``, with fields free, occupied and unknown, and a colour.

    The colours are those of `ogm.plot.colours`, mixed by the masses; unknown is transparent.

    Parameters
    ----------
    grid : EvidentialGrid or DynamicGrid
        The latter with all its layers; velocities are along the grid's axes.
    frame_id : str
    stamp : float, optional
        [s]; 0 by default.
    T_frame_grid : (4, 4) array, optional
        Takes the grid's coordinates to that frame; identity by default.
    layers : mapping of str to (nx, ny) array, optional
        Further fields, such as conflict; those of a `LayeredGrid` are its ``layers``.

    Returns
    -------
    foxglove.messages.Grid
        ``encode()`` gives the bytes of its protobuf message. Its pose is the outer corner of cell (0, 0), its data
        begin there and go along x first.

    Raises
    ------
    ImportError
        If foxglove-sdk is missing.
    """
    library = optional("foxglove.messages", Path("foxglove.Grid"), "live", "made")
    nx, ny = grid.spec.shape
    named: dict[str, NDArray[Any]] = {**layers_of(grid)}
    for name, layer in LayeredGrid(grid.spec, layers or {}).layers.items():
        if name in named or name in _COLOURS:
            raise ValueError(f"the field {name!r} is the grid's own: give another name")
        named[name] = layer
    shown = (*np.moveaxis(colours().mix(np.stack([grid.free, grid.occupied], axis=-1)), -1, 0), 1 - grid.unknown)
    named |= {name: np.rint(255 * one).astype(np.uint8) for name, one in zip(_COLOURS, shown, strict=True)}
    kind = np.dtype([(name, layer.dtype.newbyteorder("<")) for name, layer in named.items()])
    cells = np.empty((ny, nx), kind)
    for name, layer in named.items():
        cells[name] = layer.T
    offsets: Any = kind.fields
    numeric = library.PackedElementFieldNumericType
    fields = [
        library.PackedElementField(
            name=name, offset=offsets[name][1], type=numeric.Uint8 if name in _COLOURS else numeric.Float32
        )
        for name in named
    ]
    placed, when = pose_message(corner_pose(grid.spec, T_frame_grid)), ros_stamp(0.0 if stamp is None else stamp)
    return library.Grid(
        timestamp=library.Timestamp(when.sec, when.nanosec),
        frame_id=frame_id,
        pose=library.Pose(
            position=library.Vector3(**vars(placed.position)),
            orientation=library.Quaternion(**vars(placed.orientation)),
        ),
        column_count=nx,
        cell_size=library.Vector2(x=grid.spec.resolution, y=grid.spec.resolution),
        row_stride=nx * kind.itemsize,
        cell_stride=kind.itemsize,
        fields=fields,
        data=cells.tobytes(),
    )


@reads_message
def grid_from_foxglove_grid(message: Any) -> tuple[AnyGrid, NDArray[np.float64]]:
    """Return the grid of a decoded ``foxglove.Grid`` with the fields free and occupied, and where it lies.

    Parameters
    ----------
    message : object
        Message with the fields that protobuf decodes.

    Returns
    -------
    grid, T_frame_grid
        See `ogm.io.messages.grid_from_grid_map`.

    Raises
    ------
    OgmError
        If a field is missing, sizes contradict each other, cells are no squares or numbers are no masses.
    """
    where = f"Grid of {message.frame_id or 'no frame'}"
    fields = {field.name: field for field in message.fields}
    try:
        names = needed_layers(fields)
    except KeyError as error:
        raise OgmError(
            f"{where} has no field {error.args[0]}, only {', '.join(fields) or 'none'}: it holds no masses of free and "
            "occupied"
        ) from error
    data, side = as_bytes(message.data, where), message.cell_size.x
    nx, row, cell = int(message.column_count), int(message.row_stride), int(message.cell_stride)
    if side != message.cell_size.y:
        raise OgmError(f"{where} has cells of {side:g} x {message.cell_size.y:g} m, wanted squares")
    ny = len(data) // row if row > 0 else 0
    if min(nx, ny, cell) < 1 or nx * cell > row or ny * row != len(data):
        raise OgmError(f"{where} has {len(data)} bytes, wanted rows of {row} bytes with {nx} cells of {cell}")
    layers = {}
    for name in names:
        try:
            kind, offset = np.dtype("<" + _TYPES[int(fields[name].type)]), int(fields[name].offset)
        except (KeyError, ValueError, TypeError) as error:
            raise OgmError(f"{where} has a field {name} of no type that is known: it is damaged") from error
        if kind.kind != "f" or not 0 <= offset <= cell - kind.itemsize:
            raise OgmError(f"{where} has a field {name} that is no float of its cells: it is damaged")
        layers[name] = np.ndarray((ny, nx), kind, data, offset, (row, cell)).T
    origin, T = split_corner(transform_of_pose(message.pose, where))
    with error_context(f"{where} has fields that are no masses"):
        return grid_from_layers(LayeredGrid(spec_of(side, (nx, ny), origin, where), layers)), T
