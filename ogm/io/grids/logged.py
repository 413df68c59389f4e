"""Grids in logs (``.mcap``, ``.db3``, ``.bag``): one map, or the maps of a drive with poses, for viewers."""

import logging
import struct
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, Self, get_args

from ogm.grid import EvidentialGrid
from ogm.io.grids.placed import PlacedGrid
from ogm.io.logs import LogMessage, LogReader, LogWriter, open_log
from ogm.io.messages.costs import layers_from_nav2_costmap, nav2_costmap
from ogm.io.messages.grids import cells_from_update, grid_from_occupancy_grid, occupancy_grid
from ogm.io.messages.layers import foxglove_grid, grid_map, layers_from_foxglove_grid, layers_from_grid_map
from ogm.io.messages.plain import stamp_seconds, tf_message
from ogm.io.reading import optional
from ogm.io.transforms import StampedTransform, frame_name
from ogm.storage.files import FilePath, OgmError, error_context

_log = logging.getLogger(__name__)

GridMessage = Literal["occupancy-grid", "grid-map", "foxglove-grid", "costmap"]
# Type of each message, and the function that builds it.
_MESSAGES: dict[str, tuple[str, Callable[..., Any]]] = {
    "occupancy-grid": ("nav_msgs/msg/OccupancyGrid", occupancy_grid),
    "grid-map": ("grid_map_msgs/msg/GridMap", grid_map),
    "foxglove-grid": ("foxglove.Grid", foxglove_grid),
    "costmap": ("nav2_msgs/msg/Costmap", nav2_costmap),
}
_READERS: dict[str, Callable[[Any], Any]] = {
    "nav_msgs/msg/OccupancyGrid": grid_from_occupancy_grid,
    "grid_map_msgs/msg/GridMap": layers_from_grid_map,
    "nav2_msgs/msg/Costmap": layers_from_nav2_costmap,
    "foxglove.Grid": layers_from_foxglove_grid,
    "foxglove_msgs/msg/Grid": layers_from_foxglove_grid,
}
_UPDATE, _UPDATES = "map_msgs/msg/OccupancyGridUpdate", "_updates"  # type, and ending of the topic


class GridLog:
    """Writer of grids and their poses to a log. A context manager.

    The file appears under its name at the end of the ``with`` block.

    Parameters
    ----------
    path : path
        ``.mcap``, ``.db3`` or ``.bag``. Its folder must exist.
    message : {"occupancy-grid", "grid-map", "foxglove-grid", "costmap"}
        ``nav_msgs/OccupancyGrid`` is read by every viewer and planner, but has one number per cell.
        ``grid_map_msgs/GridMap`` has all bands, for RViz with grid_map's plug-in. ``foxglove.Grid`` has all bands and
        colours, only in MCAP. ``nav2_msgs/Costmap`` has the layer ``cost``, see `ogm.planning.costmap`.
    topic : str
        Topic of the grids; transforms go to ``/tf``.

    Raises
    ------
    ValueError
        If there is no such message, or the log cannot hold it.
    ImportError
        If a package is missing.

    Examples
    --------
    >>> with GridLog("maps.mcap") as log:                                                     # doctest: +SKIP
    ...     for step in fuse(dataset, ism, mapper):
    ...         log.write(PlacedGrid(mapper.grid, stamp=mapper.stamp))
    """

    def __init__(self, path: FilePath, message: GridMessage = "occupancy-grid", topic: str = "/map"):
        path = Path(path)
        check_logged(path, message)
        self.message, self.topic = message, topic
        self._log = LogWriter(path, "zstd" if path.suffix.lower() == ".mcap" else "")

    def __enter__(self) -> Self:
        self._log.__enter__()
        return self

    def __exit__(self, *error: Any) -> bool | None:
        return self._log.__exit__(*error)

    def write(self, placed: PlacedGrid, transforms: Iterable[StampedTransform] = ()) -> None:
        """Write a grid at its stamp (at 0 s without a stamp), preceded by transforms.

        Parameters
        ----------
        placed : PlacedGrid
        transforms : iterable of StampedTransform
            For example the pose of the vehicle.
        """
        transforms, stamp = list(transforms), placed.stamp or 0.0
        if transforms:
            self._log.write("/tf", "tf2_msgs/msg/TFMessage", tf_message(transforms), stamp)
        kind, make = _MESSAGES[self.message]
        place = {"frame_id": placed.frame_id, "stamp": stamp, "T_frame_grid": placed.T_frame_grid}
        one_value = self.message == "occupancy-grid"
        made = make(placed.evidential, **place) if one_value else make(placed.grid, **place, layers=placed.layers)
        self._log.write(self.topic, kind, made, stamp)


def check_logged(path: Path, message: str) -> None:
    """Raise if a log cannot hold a message, or a package is missing."""
    if message not in get_args(GridMessage):
        raise ValueError(f"message must be one of {', '.join(get_args(GridMessage))}, got {message!r}")
    if message == "foxglove-grid":
        if path.suffix.lower() != ".mcap":
            raise ValueError(f"foxglove-grid is only for .mcap files, got {path}; grid-map has the masses too")
        optional("foxglove", path, "live", "written")
    for package in ("rosbags", "mcap"):
        optional(package, path, "ros", "written")


def read_logged(path: Path, topic: str | None = None) -> PlacedGrid:
    """Read the last grid of a log; an OccupancyGrid on ``/map`` includes later updates on ``/map_updates``.

    Parameters
    ----------
    path : Path
    topic : str, optional
        By default the only topic with grids, or ``/map`` if there are several.
    """
    try:
        with open_log(path) as log:
            topic = topic or _topic(log, path)
            if not (refs := log.refs([topic])):
                raise OgmError(f"{path} has no message of {topic}: the log is incomplete, or the topic is wrong")
            message = log.message(refs[-1])
            for warning in log.warnings:
                _log.warning("%s", warning)
            if message.type not in _READERS:
                raise OgmError(f"{topic} of {path} has messages of {message.type}, wanted {', '.join(_READERS)}")
            placed = _placed(message)
            return _updated(placed, log, f"{topic}{_UPDATES}", refs[-1].log_time * 1e-9, path)
    except (OgmError, AttributeError, TypeError, SyntaxError) as error:  # logs define their own types
        if isinstance(error, OgmError) and str(path) in str(error):
            raise
        raise OgmError(f"{path}: the last message of {topic} is damaged: {error}") from error


def _updated(placed: PlacedGrid, log: LogReader, topic: str, start: float, path: Path) -> PlacedGrid:
    """Return a grid with the later updates of a topic, each of which replaces some cells."""
    if topic not in log.topics or log.topics[topic].type != _UPDATE or not isinstance(placed.grid, EvidentialGrid):
        return placed
    grid, stamp, lost, applied = placed.grid, placed.stamp, list[str](), 0
    mass = grid.mass.copy()
    for ref in log.iter_refs([topic], start):
        try:
            x, y, part, stamp = cells_from_update(log.message(ref).decode(), grid.spec.shape, stamp)
        except OgmError as error:
            lost.append(str(error))
            continue
        mass[x : x + part.shape[0], y : y + part.shape[1]] = part
        applied += 1
    if lost:
        _log.warning("%s: %d updates of %s are left out: %s", path, len(lost), topic, lost[0])
    if not applied:
        return placed
    _log.info("%s: %d updates of %s are applied", path, applied, topic)
    return replace(placed, grid=EvidentialGrid(grid.spec, mass), stamp=stamp)


def _topic(log: LogReader, path: Path) -> str:
    """Return the topic with grids."""
    found = [name for name, facts in log.topics.items() if facts.type in _READERS and facts.count]
    if len(found) == 1:
        return found[0]
    if "/map" in found:
        return "/map"
    if found:
        raise OgmError(f"{path} has grids of {', '.join(found)}: give one as `topic`")
    there = ", ".join(f"{name} ({facts.type})" for name, facts in log.topics.items())
    if any(facts.type == _UPDATE and facts.count for facts in log.topics.values()):
        way_out = "start recording before the map is published, or publish it again"
        raise OgmError(f"{path} has updates of a map, but no complete map, only {there}: {way_out}")
    raise OgmError(f"{path} has no grids ({', '.join(_READERS)}), only {there or 'nothing'}: make them by ogm fuse")


def _placed(message: LogMessage) -> PlacedGrid:
    """Return the grid of a message."""
    made = decode_foxglove_grid(bytes(message.raw)) if message.type == "foxglove.Grid" else message.decode()
    grid, T = _READERS[message.type](made)
    if hasattr(made, "timestamp"):
        frame, stamp = str(made.frame_id), stamp_seconds(made.timestamp)
    else:
        header = made.header if hasattr(made, "header") else made.info.header
        frame, stamp = str(header.frame_id), stamp_seconds(header.stamp)
    place = T, frame_name(frame), stamp or None
    if isinstance(grid, EvidentialGrid):
        return PlacedGrid(grid, *place)
    with error_context(f"{message.type} of {frame} has invalid masses"):
        return PlacedGrid.of_bands(grid, *place)


_SIZES = {1: 8, 5: 4}  # [byte] of wire types of fixed length


def decode_foxglove_grid(data: bytes) -> SimpleNamespace:
    """Return a ``foxglove.Grid`` with the names of its fields.

    Raises
    ------
    OgmError
        If the bytes are no such message.
    """
    with error_context(
        "it is no complete foxglove.Grid", ValueError, IndexError, TypeError, AttributeError, struct.error
    ):
        top = _fields(data)
        pose, time = _fields(_last(top, 3, b"")), _fields(_last(top, 1, b""))
        fields = []
        for part in top.get(8, []):
            field = _fields(part)
            name, kind = _last(field, 1, b"").decode(), _last(field, 3, 0)
            fields.append(SimpleNamespace(name=name, offset=_whole(field, 2), type=kind))
        return SimpleNamespace(
            timestamp=SimpleNamespace(sec=_last(time, 1, 0), nanosec=_last(time, 2, 0)),
            frame_id=_last(top, 2, b"").decode(),
            pose=SimpleNamespace(position=_vector(pose, 1, "xyz"), orientation=_vector(pose, 2, "xyzw")),
            column_count=_whole(top, 4),
            cell_size=_vector(top, 5, "xy"),
            row_stride=_whole(top, 6),
            cell_stride=_whole(top, 7),
            fields=fields,
            data=_last(top, 9, b""),
        )


def _fields(data: bytes) -> dict[int, list[Any]]:
    """Return the values of a protobuf message by field number."""
    found: dict[int, list[Any]] = {}
    position = 0
    while position < len(data):
        key, position = _varint(data, position)
        number, wire = key >> 3, key & 7
        if wire == 0:
            value: Any
            value, position = _varint(data, position)
        else:
            if wire == 2:
                length, position = _varint(data, position)
            elif wire in _SIZES:
                length = _SIZES[wire]
            else:
                raise ValueError(f"wire type {wire}")
            value = data[position : position + length]
            position += length
            if position > len(data):
                raise ValueError("it is cut short")
        found.setdefault(number, []).append(value)
    return found


def _varint(data: bytes, position: int) -> tuple[int, int]:
    value = shift = 0
    while shift < 70:
        byte = data[position]
        value |= (byte & 0x7F) << shift
        position, shift = position + 1, shift + 7
        if byte < 0x80:
            return value, position
    raise ValueError("a number of more than 10 bytes")


def _last(fields: dict[int, list[Any]], number: int, default: Any) -> Any:
    """Return the value of a field, or the default of proto3 if it is missing."""
    return fields.get(number, [default])[-1]


def _whole(fields: dict[int, list[Any]], number: int) -> int:
    return int(struct.unpack("<I", _last(fields, number, bytes(4)))[0])


def _vector(fields: dict[int, list[Any]], number: int, names: str) -> SimpleNamespace:
    """Return a message of doubles."""
    inner = _fields(_last(fields, number, b""))
    numbers = (struct.unpack("<d", _last(inner, k, bytes(8)))[0] for k in range(1, len(names) + 1))
    return SimpleNamespace(**dict(zip(names, numbers, strict=True)))
