"""Layers and corners by which files and messages hold a grid; ``nav_msgs/OccupancyGrid`` from a grid, and back."""

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

AnyGrid = EvidentialGrid | DynamicGrid
_MASSES = ("free", "occupied")
_VELOCITY = ("x", "y", "covariance_xx", "covariance_xy", "covariance_yy")
_MOVING = ("static", "dynamic", *(f"velocity_{name}" for name in _VELOCITY))


def check_grid(grid: AnyGrid) -> None:
    """Raise unless a grid can be written: TypeError for what holds no masses, ValueError for what are none."""
    if not isinstance(grid, AnyGrid):
        way_out = "LayeredGrid.save writes it" if isinstance(grid, LayeredGrid) else "make an EvidentialGrid of it"
        raise TypeError(f"wanted an EvidentialGrid or a DynamicGrid to write, got {type(grid).__name__}: {way_out}")
    grid.check()


def evidential(grid: AnyGrid) -> EvidentialGrid:
    """Return the masses of free and occupied of a grid; errors as those of `check_grid`."""
    check_grid(grid)
    return grid.to_evidential() if isinstance(grid, DynamicGrid) else grid


def layers_of(grid: AnyGrid) -> dict[str, NDArray[np.float32]]:
    """Return free, occupied and unknown, and of a `DynamicGrid` also what else `DynamicGrid.to_layers` has.

    Errors as those of `check_grid`.
    """
    check_grid(grid)
    layers = {"free": grid.free, "occupied": grid.occupied, "unknown": grid.unknown}
    return layers | (dict(grid.to_layers().layers) if isinstance(grid, DynamicGrid) else {})


def needed_layers(names: Collection[str]) -> tuple[str, ...]:
    """Return the layers to read of those that there are: of a `DynamicGrid` if all are there, else the masses.

    Raises
    ------
    KeyError
        If free or occupied is missing, with the names of those.
    """
    if missing := [name for name in _MASSES if name not in names]:
        raise KeyError(" and ".join(missing))
    return _MASSES + (_MOVING if set(_MOVING) <= set(names) else ())


def check_layers(names: Collection[str], where: str, word: str, way_out: str = "") -> tuple[str, ...]:
    """Return the `needed_layers` of a message, or raise OgmError where it lacks one."""
    try:
        return needed_layers(names)
    except KeyError as error:
        lack = f"{where} has no {word} {error.args[0]}, only {', '.join(names) or 'none'}"
        raise OgmError(f"{lack}: it holds no masses of free and occupied{way_out}") from error


def grid_from_layers(layers: LayeredGrid, *, nan_is_unknown: bool = False) -> AnyGrid:
    """Return the grid of the `needed_layers`.

    Parameters
    ----------
    layers : LayeredGrid
    nan_is_unknown : bool
        Whether nothing is known where a mass has no value (NaN); else it is an error.

    Raises
    ------
    ValueError
        If the numbers are no masses.
    """
    names = needed_layers(layers.layers)
    masses = [name for name in names if not name.startswith("velocity")]
    unknown = np.zeros(layers.spec.shape, np.bool_)
    for name in masses if nan_is_unknown else ():
        unknown |= np.isnan(layers[name])
    if len(names) > len(_MASSES):
        taken = {name: layers[name] for name in names}
        if unknown.any():
            taken |= {name: np.where(unknown, np.float32(0), taken[name]) for name in masses}
        return DynamicGrid.from_layers(LayeredGrid(layers.spec, taken))
    mass = np.stack([layers[name] for name in _MASSES], axis=-1)
    mass[unknown] = 0
    return EvidentialGrid(layers.spec, mass)


def occupancy_values(grid: EvidentialGrid) -> NDArray[np.int8]:
    """Return what an occupancy grid of ROS holds: -1 for unknown, else 0 (free) to 100 (occupied).

    Returns
    -------
    (nx, ny) int8
        -1 where `ogm.state.predict_state` is unknown; else the probability of occupied, `EvidentialGrid.probability`,
        in whole percent.

    Raises
    ------
    TypeError, ValueError
        See `check_grid`.
    """
    check_grid(grid)
    percent = np.rint(100 * np.asarray(grid.probability, np.float64)).astype(np.int8)
    return np.where(predict_state(grid.mass) == CellState.UNKNOWN, np.int8(-1), percent)


def mass_from_occupancy(values: NDArray[Any]) -> NDArray[np.float32]:
    """Return masses (..., 2) of free and occupied that have the probability of an occupancy grid's values.

    All of the mass is on free and occupied, none on unknown; values that are not from 0 to 100 are unknown. Taken back
    by `occupancy_values`, they are the same.
    """
    if values.dtype == np.int8:  # those of messages and images
        table = mass_from_occupancy(np.arange(256, dtype=np.uint8).view(np.int8).astype(np.int16))
        return table[values.view(np.uint8)]
    percent = values.astype(np.float64)
    known = (percent >= 0) & (percent <= 100)
    mass = np.stack([1 - percent / 100, percent / 100], axis=-1)
    return np.where(known[..., None], mass, 0.0).astype(np.float32)


def occupancy_grid(
    grid: EvidentialGrid, *, frame_id: str, stamp: float | None = None, T_frame_grid: ArrayLike | None = None
) -> SimpleNamespace:
    """Return a grid as a ``nav_msgs/OccupancyGrid``.

    Only one number per cell fits: `occupancy_values`. `grid_map` and `foxglove_grid` keep the masses.

    Parameters
    ----------
    grid : EvidentialGrid
    frame_id : str
        Frame of the header.
    stamp : float, optional
        [s]; 0 by default.
    T_frame_grid : (4, 4) array, optional
        Takes the grid's coordinates to that frame; identity by default.

    Returns
    -------
    SimpleNamespace
        With the fields of the message. Its origin is the outer corner of cell (0, 0), its ``data`` begins there and
        goes along x first.

    Notes
    -----
    The message holds the resolution as float32: 0.1 m becomes 0.100000001490 m for those who do not round.
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
    """Return the grid of a ``nav_msgs/OccupancyGrid``, and where it lies in the frame of the message.

    Returns
    -------
    grid : EvidentialGrid
        Its masses have the message's probabilities, see `mass_from_occupancy`. The corner is in ``spec.origin``.
    T_frame_grid : (4, 4) float64
        Turns and lifts the grid; identity if the message does neither.

    Raises
    ------
    OgmError
        If sizes contradict each other, or the pose is none.
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
    """Return the cells that a ``map_msgs/OccupancyGridUpdate`` replaces in a map.

    Parameters
    ----------
    message : object
        With the fields of the message.
    shape : (int, int)
        Cells of the map.
    stamp : float or None
        Time of the map [s].

    Returns
    -------
    x, y : int
        Index of the first cell.
    mass : (width, height, 2) float32
        See `mass_from_occupancy`.
    stamp : float or None
        Time of the updated map [s]: that of the message, unless it has none.

    Raises
    ------
    OgmError
        If sizes contradict each other, or cells lie outside of the map.
    """
    where = describe_message(message, "OccupancyGridUpdate")
    x, y, width, height = (int(getattr(message, name)) for name in ("x", "y", "width", "height"))
    data = np.asarray(message.data)
    if data.dtype.kind not in "iu" or data.size != width * height:
        raise OgmError(f"{where} has {data.size} values of {data.dtype}, wanted int8 for {width} x {height} cells")
    if min(x, y) < 0 or x + width > shape[0] or y + height > shape[1]:
        raise OgmError(
            f"{where} has {width} x {height} cells from ({x}, {y}) on, wanted them inside of the map's {shape[0]} x "
            f"{shape[1]}"
        )
    mass = mass_from_occupancy(data.reshape(height, width).T)
    return x, y, mass, stamp_seconds(message.header.stamp) or stamp


def corner_pose(spec: GridSpec, T_frame_grid: ArrayLike | None = None) -> NDArray[np.float64]:
    """Return the pose (4, 4) of the outer corner of cell (0, 0) in a frame: the origin of ROS and Foxglove."""
    T = np.eye(4) if T_frame_grid is None else check_pose(T_frame_grid, "T_frame_grid")
    return T @ pose(*spec.origin)


def split_corner(T_frame_corner: NDArray[np.float64]) -> tuple[tuple[float, float], NDArray[np.float64]]:
    """Return the corner (x, y) as the grid has it, and T_frame_grid, which turns and lifts but does not shift."""
    turn = T_frame_corner.copy()
    turn[:3, 3] = 0.0
    x, y, z = (inverse(turn) @ T_frame_corner)[:3, 3]
    return (float(x), float(y)), turn @ pose(z=float(z))


def spec_of(resolution: float, shape: tuple[int, int], origin: tuple[float, float], where: str) -> GridSpec:
    """Return the spec of a message's grid; a resolution in float32 becomes the shortest number that it stands for."""
    short = np.float32(resolution)
    with error_context(f"{where} has no cells"):
        return GridSpec(float(str(short)) if short == resolution else float(resolution), shape, origin)
