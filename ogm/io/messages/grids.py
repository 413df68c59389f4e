"""Bands and corners of grids in files and messages; ``nav_msgs/OccupancyGrid`` from a grid, and back."""

from collections.abc import Collection
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid
from ogm.io.messages.plain import (
    describe_message,
    header,
    pose_message,
    reads_message,
    ros_stamp,
    stamp_seconds,
    transform_of_pose,
)
from ogm.pose import check_pose, inverse, pose
from ogm.state import CellState, predict_state
from ogm.storage.files import OgmError, error_context

AnyGrid = EvidentialGrid | DynamicGrid | LayeredGrid
MASSES = ("free", "occupied", "unknown")
_VELOCITY = ("x", "y", "covariance_xx", "covariance_xy", "covariance_yy")
_MOVING = ("static", "dynamic", *(f"velocity_{name}" for name in _VELOCITY))


def check_grid(grid: AnyGrid) -> None:
    """Raise unless a grid can be written: TypeError for other objects, ValueError for invalid masses."""
    if not isinstance(grid, AnyGrid):
        raise TypeError(f"wanted an EvidentialGrid, DynamicGrid or LayeredGrid, got {type(grid).__name__}: convert it")
    if not isinstance(grid, LayeredGrid):
        grid.check()


def evidential(grid: AnyGrid) -> EvidentialGrid:
    """Return the masses of free and occupied of a grid; ValueError without masses, else errors of `check_grid`."""
    if isinstance(grid, LayeredGrid):
        grid = grid_from_bands(grid)[0]
        if isinstance(grid, LayeredGrid):
            raise ValueError(
                f"wanted masses of free and occupied, got layers ({', '.join(grid.layers) or 'none'}): convert one by "
                "grid_from_layer (`--layer NAME`), or read all by read_any_grid"
            )
    check_grid(grid)
    return grid.to_evidential() if isinstance(grid, DynamicGrid) else grid


def band_names(grid: AnyGrid) -> tuple[str, ...]:
    """Return the names of the bands of a grid."""
    if isinstance(grid, LayeredGrid):
        return tuple(grid.layers)
    return MASSES + (_MOVING if isinstance(grid, DynamicGrid) else ())


def check_names(grid: AnyGrid, layers: LayeredGrid | None, taken: Collection[str] = ()) -> None:
    """Raise ValueError unless further layers have the cells of a grid, and names unused by it and `taken`."""
    if layers is None:
        return
    if layers.spec != grid.spec:
        raise ValueError(f"layers must have the cells of the grid, {grid.spec}, got {layers.spec}")
    if twice := {*band_names(grid), *taken} & layers.layers.keys():
        raise ValueError(f"{', '.join(map(repr, sorted(twice)))} is the grid's own: give the layer another name")


def bands_of(grid: AnyGrid, layers: LayeredGrid | None = None) -> LayeredGrid:
    """Return a grid and further layers as named bands, as stored by files and messages with several bands.

    Parameters
    ----------
    grid : EvidentialGrid, DynamicGrid or LayeredGrid
        Source of the masses of free, occupied and unknown, of the bands of `DynamicGrid.to_layers`, or of the layers.
    layers : LayeredGrid, optional
        Further layers on the same cells, such as conflict.

    Raises
    ------
    TypeError, ValueError
        See `check_grid` and `check_names`.
    """
    check_grid(grid)
    check_names(grid, layers)
    own = grid.to_layers().layers if isinstance(grid, DynamicGrid) else getattr(grid, "layers", {})
    masses = {} if isinstance(grid, LayeredGrid) else {name: getattr(grid, name) for name in MASSES}
    return LayeredGrid(grid.spec, {**masses, **own, **(layers.layers if layers else {})})


def grid_from_bands(bands: LayeredGrid) -> tuple[AnyGrid, LayeredGrid | None]:
    """Return the grid of named bands, and the remaining layers.

    Parameters
    ----------
    bands : LayeredGrid
        Cells with NaN masses become unknown.

    Returns
    -------
    grid : DynamicGrid, EvidentialGrid or LayeredGrid
        DynamicGrid if all of its bands exist, EvidentialGrid if free and occupied exist, else `bands`.
    layers : LayeredGrid or None
        Bands that are not in `grid`.

    Raises
    ------
    ValueError
        If masses are invalid.
    """
    names = bands.layers.keys()
    if not set(MASSES[:2]) <= names:
        return bands, None
    moving = set(_MOVING) <= names
    taken = {name: bands[name] for name in MASSES[:2] + (_MOVING if moving else ())}
    masses = [name for name in taken if not name.startswith("velocity")]
    unknown = np.any([np.isnan(taken[name]) for name in masses], axis=0)
    if unknown.any():
        taken |= {name: np.where(unknown, np.float32(0), taken[name]) for name in masses}
    rest = {name: layer for name, layer in bands.layers.items() if name not in {*taken, "unknown"}}
    grid: AnyGrid = EvidentialGrid(bands.spec, np.stack([taken[name] for name in MASSES[:2]], axis=-1))
    if moving:
        grid = DynamicGrid.from_layers(LayeredGrid(bands.spec, taken))
    return grid, LayeredGrid(bands.spec, rest) if rest else None


def is_derived(name: str, names: Collection[str]) -> bool:
    """Return whether a band need not be read: unknown, if free and occupied exist."""
    return name == "unknown" and set(MASSES) <= set(names)


def masses_of_bands(bands: LayeredGrid, where: str, word: str) -> AnyGrid:
    """Return the grid of a message's bands; raise OgmError without masses."""
    if missing := [name for name in MASSES[:2] if name not in bands.layers]:
        lack = f"{where} has no {word} {' and '.join(missing)}, only {', '.join(bands.layers) or 'none'}"
        reader = {"layer": "layers_from_grid_map", "field": "layers_from_foxglove_grid"}[word]
        raise OgmError(f"{lack}, wanted masses of free and occupied: read it by {reader}")
    with error_context(f"{where} has {word}s that are no masses"):
        return grid_from_bands(bands)[0]


def grid_from_layer(layers: LayeredGrid, name: str, values: tuple[float, float] = (0.0, 100.0)) -> EvidentialGrid:
    """Return a layer as occupancy, for formats with one value per cell (map_server, OccupancyGrid, .png).

    Parameters
    ----------
    layers : LayeredGrid
    name : str
        Name of the layer.
    values : (float, float)
        Values of free and of occupied cells, such as (1, 0) for a traversability. Values between them become
        probabilities by linear interpolation, values beyond are clipped.

    Returns
    -------
    EvidentialGrid
        All mass is on free and occupied, except for unknown cells without a value (NaN). Mode ``scale`` of map_server
        keeps the values in steps of a hundredth.

    Raises
    ------
    ValueError
        If there is no such layer, or both values are equal or not finite.
    """
    low, high = values
    if name not in layers.layers:
        raise ValueError(f"there is no layer {name!r}, only {', '.join(layers.layers) or 'none'}")
    if not (np.isfinite([low, high]).all() and low != high):
        raise ValueError(f"values must be two different numbers, of free and of occupied cells, got {low:g}, {high:g}")
    share = np.clip((layers[name] - np.float32(low)) / np.float32(high - low), 0, 1)
    mass = np.stack([1 - share, share], axis=-1)
    return EvidentialGrid(layers.spec, np.where(np.isnan(share)[..., None], np.float32(0), mass))


def occupancy_values(grid: EvidentialGrid) -> NDArray[np.int8]:
    """Return the values of an occupancy grid of ROS: -1 for unknown, else 0 (free) to 100 (occupied).

    Returns
    -------
    (nx, ny) int8
        -1 if `ogm.state.predict_state` is unknown; else the probability of occupied, `EvidentialGrid.probability`,
        in whole percent.

    Raises
    ------
    TypeError, ValueError
        See `check_grid`.
    """
    grid = evidential(grid)
    percent = np.rint(100 * np.asarray(grid.probability, np.float64)).astype(np.int8)
    return np.where(predict_state(grid.mass) == CellState.UNKNOWN, np.int8(-1), percent)


def mass_from_occupancy(values: NDArray[Any]) -> NDArray[np.float32]:
    """Return masses (..., 2) of free and occupied with the probability of an occupancy grid's values.

    All mass is on free and occupied; values that are not from 0 to 100 become unknown. `occupancy_values` restores the
    values.
    """
    if values.dtype == np.int8:  # as in messages and images
        table = mass_from_occupancy(np.arange(256, dtype=np.uint8).view(np.int8).astype(np.int16))
        return table[values.view(np.uint8)]
    percent = values.astype(np.float64)
    known = (percent >= 0) & (percent <= 100)
    mass = np.stack([1 - percent / 100, percent / 100], axis=-1)
    return np.where(known[..., None], mass, 0.0).astype(np.float32)


def occupancy_grid(
    grid: EvidentialGrid, *, frame_id: str = "map", stamp: float | None = None, T_frame_grid: ArrayLike | None = None
) -> SimpleNamespace:
    """Return a grid as a ``nav_msgs/OccupancyGrid``.

    The message holds only one number per cell, see `occupancy_values`. `grid_map` and `foxglove_grid` keep the masses.

    Parameters
    ----------
    grid : EvidentialGrid
    frame_id : str
        Frame of the header.
    stamp : float, optional
        [s]; 0 by default.
    T_frame_grid : (4, 4) array, optional
        Transform from the grid's coordinates to the frame; identity by default.

    Returns
    -------
    SimpleNamespace
        Object with the fields of the message. Its origin is the outer corner of cell (0, 0); ``data`` begins there, x
        first.

    Notes
    -----
    The message holds the resolution as float32: 0.1 m becomes 0.100000001490 m for readers that do not round.
    """
    values = occupancy_values(grid)
    info = SimpleNamespace(
        map_load_time=ros_stamp(0.0 if stamp is None else stamp),
        resolution=grid.spec.resolution,
        width=grid.spec.shape[0],
        height=grid.spec.shape[1],
        origin=pose_message(corner_pose(grid.spec, T_frame_grid)),
    )
    return SimpleNamespace(header=header(stamp, frame_id), info=info, data=values.T.reshape(-1))


@reads_message
def grid_from_occupancy_grid(message: Any) -> tuple[EvidentialGrid, NDArray[np.float64]]:
    """Return the grid of a ``nav_msgs/OccupancyGrid``, and its pose in the frame of the message.

    Returns
    -------
    grid : EvidentialGrid
        Its masses have the message's probabilities, see `mass_from_occupancy`. The corner is in ``spec.origin``.
    T_frame_grid : (4, 4) float64
        Rotates and lifts the grid; identity if the message does neither.

    Raises
    ------
    OgmError
        If sizes are inconsistent, or the pose is invalid.
    """
    where = describe_message(message, "OccupancyGrid")
    info, data = message.info, np.asarray(message.data)
    width, height = int(info.width), int(info.height)
    if data.dtype.kind not in "iu" or data.size != width * height or min(width, height) < 1:
        raise OgmError(f"{where} has {data.size} values of {data.dtype}, wanted int8 for {width} x {height} cells")
    origin, T = split_corner(transform_of_pose(info.origin, where))
    mass = mass_from_occupancy(data.reshape(height, width).T)
    return EvidentialGrid(spec_of(info.resolution, (width, height), origin, where), mass), T


@reads_message
def cells_from_update(
    message: Any, shape: tuple[int, int], stamp: float | None
) -> tuple[int, int, NDArray[np.float32], float | None]:
    """Return the cells replaced by a ``map_msgs/OccupancyGridUpdate`` in a map.

    Parameters
    ----------
    message : object
        Object with the fields of the message.
    shape : (int, int)
        Shape of the map.
    stamp : float or None
        Time of the map [s].

    Returns
    -------
    x, y : int
        Index of the first cell.
    mass : (width, height, 2) float32
        See `mass_from_occupancy`.
    stamp : float or None
        Time of the updated map [s]: the message's stamp, or without one the given stamp.

    Raises
    ------
    OgmError
        If sizes are inconsistent, or cells lie outside of the map.
    """
    where = describe_message(message, "OccupancyGridUpdate")
    x, y, width, height = (int(getattr(message, name)) for name in ("x", "y", "width", "height"))
    data = np.asarray(message.data)
    if data.dtype.kind not in "iu" or data.size != width * height:
        raise OgmError(f"{where} has {data.size} values of {data.dtype}, wanted int8 for {width} x {height} cells")
    if min(x, y) < 0 or x + width > shape[0] or y + height > shape[1]:
        raise OgmError(f"{where} has {width} x {height} cells from ({x}, {y}) on, wanted cells of the map, {shape}")
    mass = mass_from_occupancy(data.reshape(height, width).T)
    return x, y, mass, stamp_seconds(message.header.stamp) or stamp


def corner_pose(spec: GridSpec, T_frame_grid: ArrayLike | None = None) -> NDArray[np.float64]:
    """Return the pose (4, 4) of the outer corner of cell (0, 0) in a frame: the origin of ROS and Foxglove."""
    T = np.eye(4) if T_frame_grid is None else check_pose(T_frame_grid, "T_frame_grid")
    return T @ pose(*spec.origin)


def split_corner(T_frame_corner: NDArray[np.float64]) -> tuple[tuple[float, float], NDArray[np.float64]]:
    """Return the corner (x, y) in grid coordinates, and T_frame_grid, which rotates and lifts without shift."""
    turn = T_frame_corner.copy()
    turn[:3, 3] = 0.0
    x, y, z = (inverse(turn) @ T_frame_corner)[:3, 3]
    return (float(x), float(y)), turn @ pose(z=float(z))


def spec_of(resolution: float, shape: tuple[int, int], origin: tuple[float, float], where: str) -> GridSpec:
    """Return the spec of a message's grid; a float32 resolution becomes its shortest decimal number."""
    short = np.float32(resolution)
    with error_context(f"{where} has no cells"):
        return GridSpec(float(str(short)) if short == resolution else float(resolution), shape, origin)
