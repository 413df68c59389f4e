"""Server of map, scan and poses over the Foxglove WebSocket, for viewers such as Foxglove and Lichtblick."""

import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.fusion import EvidentialMapper, FusionStep, Mapper
from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid
from ogm.io.messages import foxglove_grid
from ogm.io.messages.costs import COST
from ogm.io.messages.foxglove_cells import warm_up_cells
from ogm.io.messages.plain import pose_message, ros_stamp
from ogm.io.reading import optional
from ogm.plot.colours import CAUSE_COLOURS
from ogm.plot.panels import cause_codes, cause_colours
from ogm.pose import inverse, pose
from ogm.scan import Frame
from ogm.unknown_cause import UnknownCause

MAP, VEHICLE, SENSOR = "map", "vehicle", "sensor"  # coordinate frames
BACKLOG = 12  # queued messages per viewer, about 40 MB; with more, the oldest is dropped
Costs = Callable[[EvidentialGrid], NDArray[np.uint8]]
CLOSING_TIME = 2.0  # [s] to wait for viewers to disconnect and for the port to be free


class FoxglovePublisher:
    """A server that sends each step of `ogm.fusion.fuse` and the current map to viewers.

    Topics are ``/map`` (foxglove.Grid, on the ground below the sensor), ``/layers`` (foxglove.Grid of the conflict, if
    the map stores it), ``/points`` (foxglove.PointCloud, in the sensor's frame) and ``/tf``
    (foxglove.FrameTransforms: map, vehicle, sensor). Maps with causes of unknown cells also have ``/cause``, in the
    colours of the causes (field ``cause``, `ogm.UnknownCause`), and its legend ``/cause_legend``
    (foxglove.SceneUpdate). Topics without subscribers are not computed. A slow viewer misses messages and delays
    nothing.

    Parameters
    ----------
    host : str
        Address to listen on. There is no password: addresses other than loopback expose the map to everybody who can
        reach them.
    port : int
        0 takes any free port.
    name : str
        Name of the server, for viewers.
    costs : function, optional
        Returns the costs of a map, (nx, ny) uint8, for the field ``cost`` of ``/map``, such as
        ``functools.partial(ogm.planning.costmap, ...)``.

    Raises
    ------
    OSError
        If the server cannot listen at the address.
    ImportError
        If foxglove-sdk is not installed.

    Examples
    --------
    >>> with FoxglovePublisher(port=0) as publisher:                           # doctest: +SKIP
    ...     for step in fuse(frames, ism, mapper):
    ...         publisher(step, mapper)
    """

    def __init__(
        self, host: str = "127.0.0.1", port: int = 8765, *, name: str = "ogm", costs: Costs | None = None
    ) -> None:
        modules = "foxglove", "foxglove.channels"
        foxglove, channels = (optional(name, Path("a map"), "live", "served") for name in modules)
        if not 0 <= port < 2**16:
            raise ValueError(f"port must be from 0 (any free port) to 65535, got {port}")
        context = self._context = foxglove.Context()  # kept, as the server has no reference to it
        try:
            self._server = foxglove.start_server(
                name=name, host=host, port=port, context=context, message_backlog_size=BACKLOG
            )
        except RuntimeError as error:
            raise OSError(f"cannot serve at {host}:{port}: {error}; give another port, 0 for any free port") from error
        warm_up_cells()
        self.costs = costs
        self.host, self.port = host, int(self._server.port)
        self._map = channels.GridChannel("/map", context=context)
        self._layers = channels.GridChannel("/layers", context=context)
        self._points = channels.PointCloudChannel("/points", context=context)
        self._tf = channels.FrameTransformsChannel("/tf", context=context)
        self._causes: tuple[Any, ...] = ()  # channels of grid and legend, made for the first map with causes

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        self._close(0.0 if kind is KeyboardInterrupt else CLOSING_TIME)

    @property
    def url(self) -> str:
        """Address for viewers."""
        return f"ws://{self.host}:{self.port}"

    def close(self) -> None:
        """End all connections and free the port, within 2 s.

        Silent connections (port scans) are closed by a thread that does not delay the end of the process.
        An interrupted ``with`` block does not wait.
        """
        self._close(CLOSING_TIME)

    def _close(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        for channel in (self._map, self._layers, self._points, self._tf, *self._causes):
            channel.close()
        stopping = threading.Thread(target=self._server.stop, name="ogm-closing", daemon=True)
        stopping.start()  # waits for clients that never finish their handshake
        stopping.join(seconds)  # ends before the port is free
        while not _is_free(self.host, self.port) and time.monotonic() < until:
            time.sleep(0.002)

    def __call__(self, step: FusionStep, mapper: Mapper) -> None:
        """Send a fused frame and the map to all viewers.

        Parameters
        ----------
        step : FusionStep
            Step with a grid, just fused into `mapper`.
        mapper : EvidentialMapper or BinaryBayesMapper
        """
        frame = step.frame
        stamp = time.time() if frame.stamp is None else frame.stamp
        when = round(stamp * 1e9)  # [ns]
        sensor = frame.scan.sensor or SENSOR
        if self._tf.has_sinks():
            self._tf.log(_transforms(frame, sensor, stamp), log_time=when)
        if self._points.has_sinks():
            self._points.log(_cloud(frame, sensor, stamp), log_time=when)
        T = pose(z=_ground_height(frame))
        if self._map.has_sinks():
            grid = mapper.grid
            costs = None if self.costs is None else LayeredGrid(grid.spec, {COST: self.costs(grid).astype(np.float32)})
            message = foxglove_grid(grid, frame_id=MAP, stamp=stamp, T_frame_grid=T, layers=costs)
            self._map.log(message, log_time=when)
        if self._layers.has_sinks() and (layers := getattr(mapper, "conflict", None)) is not None:
            self._layers.log(foxglove_grid(layers, frame_id=MAP, stamp=stamp, T_frame_grid=T), log_time=when)
        if isinstance(mapper, EvidentialMapper) and mapper.has_causes:
            self._send_causes(mapper, stamp, T)

    def _send_causes(self, mapper: EvidentialMapper, stamp: float, T: ArrayLike) -> None:  # noqa: N803
        """Send the causes of unknown cells and their legend."""
        from foxglove import channels

        if not self._causes:
            self._causes = (
                channels.GridChannel("/cause", context=self._context),
                channels.SceneUpdateChannel("/cause_legend", context=self._context),
            )
        cells, legend = self._causes
        if cells.has_sinks():
            layers = mapper.cause
            colour = cause_colours(cause_codes(layers["cause"]))
            message = foxglove_grid(layers, frame_id=MAP, stamp=stamp, T_frame_grid=T, colour=colour)
            cells.log(message, log_time=round(stamp * 1e9))
        if legend.has_sinks():
            height = float(np.asarray(T)[2, 3])
            legend.log(_cause_legend(mapper.spec, height, stamp), log_time=round(stamp * 1e9))


def _cause_legend(spec: GridSpec, height: float, stamp: float) -> Any:
    """Return the label of each cause of unknown cells in its colour, at the left edge of a map."""
    from foxglove.messages import Color, Pose, Quaternion, SceneEntity, SceneUpdate, TextPrimitive, Vector3

    size = max(spec.length / 40, spec.resolution)
    texts = []
    for row, cause in enumerate(UnknownCause):
        red, green, blue = CAUSE_COLOURS[cause]
        position = Vector3(x=spec.extent[1] - 2 * size * (row + 1), y=spec.extent[3] + 8 * size, z=height)
        at = Pose(position=position, orientation=Quaternion(x=0, y=0, z=0, w=1))
        colour = Color(r=red, g=green, b=blue, a=1)
        texts.append(TextPrimitive(pose=at, billboard=True, font_size=size, color=colour, text=cause.label))
    entity = SceneEntity(timestamp=_timestamp(stamp), frame_id=MAP, id="cause", texts=texts)
    return SceneUpdate(entities=[entity])


def _is_free(host: str, port: int) -> bool:
    """Return whether a server can listen at an address."""
    try:
        socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
    except OSError:
        return False
    return True


def _ground_height(frame: Frame) -> float:
    """Return the height of the ground below the sensor in map coordinates [m]."""
    below = inverse(frame.mount.T_vehicle_sensor) @ np.append(frame.mount.ground_point, 1.0)
    return float((frame.T_map_sensor @ below)[2])


def _transforms(frame: Frame, sensor: str, stamp: float) -> Any:
    """Return the poses of vehicle and sensor."""
    from foxglove.messages import FrameTransforms

    T_vehicle_sensor = frame.mount.T_vehicle_sensor
    T_map_vehicle = frame.T_map_sensor @ inverse(T_vehicle_sensor)  # type: ignore[operator]
    placed = ((MAP, VEHICLE, T_map_vehicle), (VEHICLE, sensor, T_vehicle_sensor))
    return FrameTransforms(transforms=[_transform(*names_and_pose, stamp) for names_and_pose in placed])


def _transform(parent: str, child: str, T: ArrayLike, stamp: float) -> Any:
    from foxglove.messages import FrameTransform, Quaternion, Vector3

    placed = pose_message(T)
    return FrameTransform(
        timestamp=_timestamp(stamp),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=Vector3(**vars(placed.position)),
        rotation=Quaternion(**vars(placed.orientation)),
    )


def _cloud(frame: Frame, sensor: str, stamp: float) -> Any:
    """Return the points of a frame, in their own coordinate frame."""
    from foxglove.messages import (
        PackedElementField,
        PackedElementFieldNumericType,
        PointCloud,
        Pose,
        Quaternion,
        Vector3,
    )

    names = ("x", "y", "z", "intensity")
    kind = PackedElementFieldNumericType.Float32
    return PointCloud(
        timestamp=_timestamp(stamp),
        frame_id=VEHICLE if frame.mount.points_in == "vehicle" else sensor,
        pose=Pose(position=Vector3(x=0, y=0, z=0), orientation=Quaternion(x=0, y=0, z=0, w=1)),
        point_stride=16,
        fields=[PackedElementField(name=name, offset=4 * k, type=kind) for k, name in enumerate(names)],
        data=np.ascontiguousarray(frame.scan.points, "<f4").tobytes(),
    )


def _timestamp(stamp: float) -> Any:
    from foxglove.messages import Timestamp

    when = ros_stamp(stamp)
    return Timestamp(when.sec, when.nanosec)
