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

AnyGrid = EvidentialGrid | DynamicGrid | LayeredGrid
MASSES = ("free", "occupied", "unknown")
_VELOCITY = ("x", "y", "covariance_xx", "covariance_xy", "covariance_yy")
_MOVING = ("static", "dynamic", *(f"velocity_{name}" for name in _VELOCITY))


def check_grid(grid: AnyGrid) -> None:
    """Raise unless a grid can be written: TypeError for other objects, ValueError for numbers that are no masses."""
    if not isinstance(grid, AnyGrid):
        raise TypeError(
            f"wanted an EvidentialGrid, DynamicGrid or LayeredGrid, got {type(grid).__name__}: make one of them"
        )
    if not isinstance(grid, LayeredGrid):
        grid.check()


def evidential(grid: AnyGrid) -> EvidentialGrid:
    """Return the masses of free and occupied of a grid; errors as those of `check_grid`, ValueError without masses."""
    if isinstance(grid, LayeredGrid):
        grid = grid_from_bands(grid)[0]
        if isinstance(grid, LayeredGrid):
            raise ValueError(
                f"wanted masses of free and occupied, got layers ({', '.join(grid.layers) or 'none'}): "
                "grid_from_layer, `--layer NAME`, makes occupancy of one; read_any_grid reads them"
            )
    check_grid(grid)
    return grid.to_evidential() if isinstance(grid, DynamicGrid) else grid


def band_names(grid: AnyGrid) -> tuple[str, ...]:
    """Return the names of the bands of a grid."""
    if isinstance(grid, LayeredGrid):
        return tuple(grid.layers)
    return MASSES + (_MOVING if isinstance(grid, DynamicGrid) else ())


def check_names(grid: AnyGrid, layers: LayeredGrid | None, taken: Collection[str] = ()) -> None:
    """Raise ValueError unless further layers have the cells of a grid, and names that neither it nor `taken` has."""
    if layers is None:
        return
    if layers.spec != grid.spec:
        raise ValueError(f"layers must have the cells of the grid, {grid.spec}, got {layers.spec}")
    if twice := {*band_names(grid), *taken} & layers.layers.keys():
        raise ValueError(f"{', '.join(map(repr, sorted(twice)))} is the grid's own: give the layer another name")


def bands_of(grid: AnyGrid, layers: LayeredGrid | None = None) -> LayeredGrid:
    """Return a grid and further layers as named bands, as all files and messages of several bands hold them.

    Parameters
    ----------
    grid : EvidentialGrid, DynamicGrid or LayeredGrid
        Its masses of free, occupied and unknown, also what else `DynamicGrid.to_layers` has, or its layers.
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
    """Return the grid that named bands hold, and the layers that are beside it.

    Parameters
    ----------
    bands : LayeredGrid
        Masses that have no value (NaN) are unknown.

    Returns
    -------
    grid : DynamicGrid, EvidentialGrid or LayeredGrid
        The first if all of its bands are there, the second if free and occupied are, else `bands`.
    layers : LayeredGrid or None
        Bands that are not in `grid`.

    Raises
    ------
    ValueError
        If the numbers of masses are none.
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
    """Return whether a band need not be read: unknown, where the masses that it is made of are there."""
    return name == "unknown" and set(MASSES) <= set(names)


def masses_of_bands(bands: LayeredGrid, where: str, word: str) -> AnyGrid:
    """Return the grid of a message's bands, or raise OgmError where it has no masses."""
    if missing := [name for name in MASSES[:2] if name not in bands.layers]:
        lack = f"{where} has no {word} {' and '.join(missing)}, only {', '.join(bands.layers) or 'none'}"
        reader = {"layer": "layers_from_grid_map", "field": "layers_from_foxglove_grid"}[word]
        raise OgmError(f"{lack}: it holds no masses of free and occupied; {reader} returns what it holds")
    with error_context(f"{where} has {word}s that are no masses"):
        return grid_from_bands(bands)[0]


def grid_from_layer(layers: LayeredGrid, name: str, values: tuple[float, float] = (0.0, 100.0)) -> EvidentialGrid:
    """Return one layer as occupancy, for formats that hold one value per cell (map_server, OccupancyGrid, .png).

    Parameters
    ----------
    layers : LayeredGrid
    name : str
        The layer.
    values : (float, float)
        The value of free cells and that of occupied ones, as (1, 0) of a traversability; values between give
        probabilities in proportion, values beyond count as the nearer one.

    Returns
    -------
    EvidentialGrid
        With all mass on free and occupied, none on unknown, but where the layer has no value (NaN). Mode ``scale``
        of map_server keeps its values in steps of a hundredth.

    Raises
    ------
    ValueError
        If there is no such layer, or both values are the same or not finite.
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
    grid = evidential(grid)
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
    grid: EvidentialGrid, *, frame_id: str = "map", stamp: float | None = None, T_frame_grid: ArrayLike | None = None
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
