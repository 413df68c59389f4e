"""Scans and poses over a TCP connection, as fixed binary messages that a driver in any language can write.

A message is a header of 112 bytes and the points, all little-endian:

=======  ===========  =============================================================================
bytes    type         content
=======  ===========  =============================================================================
0-3      4 bytes      ``OGM1``
4-7      uint32       N, the number of points, at most 4,194,304
8-15     float64      stamp [s], from 0 to 2**31
16-111   12 float64   T_map_sensor, its first three rows, row by row [m]
112-     4 N float32  x, y, z [m] in the sensor's frame, intensity [0, 1], point by point
=======  ===========  =============================================================================

Messages contain no code, names or paths, and the header gives their length, so that a receiver needs no parser.
"""

import logging
import math
import select
import socket
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from threading import Event

import numpy as np
from numpy.typing import ArrayLike

from ogm.io.formats.table import Table
from ogm.io.notices import one_notice_per_kind
from ogm.io.scan_table import scan_from_table
from ogm.pose import check_pose
from ogm.scan import Frame, Mount, Scan
from ogm.storage.files import OgmError, error_context

MAGIC = b"OGM1"
HEADER = struct.Struct("<4sI13d")
MAX_POINTS = 2**22
MAX_STAMP = 2**31  # [s] limit of stamps in ROS and Foxglove
POLL = 0.1  # [s] between checks of `stop`
MAX_SILENT = 16  # open connections without a header; with more, the oldest is closed
_COLUMNS = ("x", "y", "z", "intensity")

_log = logging.getLogger(__name__)


def frame_bytes(scan: Scan, T_map_sensor: ArrayLike) -> bytes:  # noqa: N803
    """Return a scan and its pose as a message for `receive_frames`; only points and stamp are kept.

    Raises
    ------
    ValueError
        If the scan has too many points or no valid stamp, or the pose is not rigid.
    """
    if scan.stamp is None or not 0 <= scan.stamp < MAX_STAMP or len(scan) > MAX_POINTS:
        raise ValueError(f"a message needs a stamp from 0 to 2**31 s and at most {MAX_POINTS} points, got {scan!r}")
    rows = check_pose(T_map_sensor, "T_map_sensor")[:3].ravel()
    return HEADER.pack(MAGIC, len(scan), scan.stamp, *rows) + scan.points.astype("<f4").tobytes()


def receive_frames(
    listener: socket.socket, mount: Mount, *, stop: Event | None = None, on_end: Callable[[str], object] = _log.warning
) -> Iterator[Frame]:
    """Yield frames received over TCP, from one connection at a time.

    The first valid header of a connection replaces the previous connection, so that a restarted driver need not wait
    and silent health checks have no effect. A wrong message ends only its connection. Every client that can connect is
    trusted to send points: listen on the loopback address, or on a private network.

    Parameters
    ----------
    listener : socket
        Socket of ``socket.create_server(("127.0.0.1", 9000))``; stays open.
    mount : Mount
        Mount of the sensor.
    stop : Event, optional
        Event that ends the iteration within 0.1 s.
    on_end : function
        Called with a line of text when a connection ends that has sent data; by default the line is logged. Connections
        without a valid header give one line for each address and reason.

    Yields
    ------
    Frame
        Scan, stamp and pose; rows without a point (0, 0, 0 or not finite) are dropped. A connection starts a new
        sequence if its first stamp is not after the last stamp, for example after a restart of the driver.
    """
    stop, count, sequence, last = stop or Event(), 0, 1, -math.inf
    listener.setblocking(False)
    connections: list[_Connection] = []
    sender: _Connection | None = None  # current source of scans; the other connections have sent no header
    reported: set[tuple[str, str]] = set()
    try:
        while not stop.is_set():
            waiting: list[socket.socket | _Connection] = [listener, *connections]
            ready = select.select(waiting, [], [], POLL)[0]
            if listener in ready and (accepted := _accept(listener)) is not None:
                connections.append(accepted)
                if len(connections) > MAX_SILENT + 1:
                    oldest = next(connection for connection in connections if connection is not sender)
                    connections.remove(oldest)
                    oldest.end("")
            for connection in [candidate for candidate in connections if candidate in ready]:
                if connection not in connections:
                    continue  # replaced by the previous connection
                try:
                    message = connection.receive()
                except (OgmError, OSError) as error:
                    connections.remove(connection)
                    line, key = connection.end(str(error)), (connection.host, str(error))
                    if connection is sender or (connection.begun and key not in reported):
                        reported.add(key)
                        on_end(line)
                    continue
                if connection.sends and connection is not sender:
                    if sender is not None and sender in connections:
                        connections.remove(sender)
                        on_end(sender.end("replaced by a new connection"))
                    sender = connection
                if message is not None:
                    scan, T = message
                    count += 1
                    stamp = float(scan.stamp or 0.0)
                    sequence += connection.scans == 1 and stamp <= last
                    last = stamp
                    drive = "live" if sequence == 1 else f"live {sequence}"
                    yield Frame(
                        scan, mount, None, None, T_map_sensor=T, stamp=stamp, name=f"scan {count}", sequence=drive
                    )
    finally:
        for connection in connections:
            connection.end("")


class _Connection:
    """A connection, and the received part of its message."""

    def __init__(self, connection: socket.socket, address: tuple[str, int]) -> None:
        connection.setblocking(False)
        self.socket, self.host, self.name, self.scans = connection, address[0], f"{address[0]}:{address[1]}", 0
        self.begun = self.sends = False  # received any data; received a valid header
        self._notices = Counter[str]()
        self._begin()

    def fileno(self) -> int:
        """Return the descriptor of the socket, for `select`."""
        return self.socket.fileno()

    def _begin(self) -> None:
        """Wait for a header."""
        self._header, self._points = bytearray(HEADER.size), np.empty(0, "<f4")
        self._target, self._filled = memoryview(self._header), 0

    def receive(self) -> tuple[Scan, np.ndarray] | None:
        """Receive available data; return scan and pose of a complete message.

        Raises
        ------
        OgmError
            If the message is wrong, or the connection has ended.
        OSError
            If the connection is broken.
        """
        try:
            size = self.socket.recv_into(self._target[self._filled :])
        except BlockingIOError:
            return None
        if not size:
            cut = self._filled or self._points.size
            raise OgmError("closed in the middle of a message" if cut else "closed by the sender")
        self.begun = True
        self._filled += size
        if self._filled < len(self._target):
            return None
        if not self._points.size:
            self._check_header()
            if self._points.size:
                return None
        return self._message()

    def _check_header(self) -> None:
        magic, count, *numbers = HEADER.unpack(self._header)
        if magic != MAGIC:
            raise OgmError(f"a message must begin with {MAGIC!r}, got {magic!r}: see ogm.live.stream for the format")
        if count > MAX_POINTS:
            raise OgmError(f"a message must have at most {MAX_POINTS} points, got {count}")
        if not (0 <= numbers[0] < MAX_STAMP and all(map(math.isfinite, numbers))):
            raise OgmError(f"a message must have a finite pose and a stamp from 0 to 2**31 s, got {numbers[0]} s")
        self.sends = True
        self._points = np.empty(4 * count, "<f4")
        if count:
            self._target, self._filled = memoryview(self._points.data).cast("B"), 0

    def _message(self) -> tuple[Scan, np.ndarray]:
        """Return scan and pose, and prepare for the next header."""
        _, _, stamp, *rows = HEADER.unpack(self._header)
        name = f"scan {self.scans + 1} of {self.name}"
        with error_context(name):
            T = check_pose(np.append(np.reshape(rows, (3, 4)), [[0, 0, 0, 1]], axis=0), "T_map_sensor")
        columns = dict(zip(_COLUMNS, self._points.reshape(-1, 4).T, strict=True))
        with one_notice_per_kind(self._notices):
            scan = scan_from_table(Table("message", columns), name, stamp=stamp, intensity_max=1.0)[0]
        self.scans += 1
        self._begin()
        return scan, T

    def end(self, reason: str) -> str:
        """Close the connection; return a line of text about it."""
        self.socket.close()
        return f"connection from {self.name} ended after {self.scans} scans: {reason}"


def _accept(listener: socket.socket) -> _Connection | None:
    """Return a new connection; None if the client has closed it already."""
    try:
        return _Connection(*listener.accept())
    except (BlockingIOError, ConnectionError):
        return None
