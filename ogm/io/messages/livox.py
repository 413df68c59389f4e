"""Livox: ``CustomMsg`` of livox_ros_driver and livox_ros_driver2 to a scan."""

import struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.io.formats.table import Table
from ogm.io.messages.plain import describe_message, reads_message, stamp_seconds
from ogm.io.scan_table import scan_from_table
from ogm.scan import Scan
from ogm.storage.files import OgmError

_SAME_CLOCK = 10.0  # [s] largest difference of the header's stamp and the time base of one clock
_POINT = [("offset_time", "u4"), *((axis, "f4") for axis in "xyz")]
_POINT += [(name, "u1") for name in ("reflectivity", "tag", "line")]
_SIZE = 19  # [byte] of a point; CDR pads points to 20


class _CustomMsg(NamedTuple):
    stamp: float
    timebase: int  # [ns]
    points: NDArray[np.void]
    where: str


@reads_message
def scan_from_livox(message: Any) -> Scan:
    """Return the scan of a Livox ``CustomMsg``.

    Parameters
    ----------
    message : bytes or object
        Raw message of a log, CDR (ROS 2) or ROS 1, which is viewed without a copy; or an object with its fields and one
        object per point, which takes about 50 times as long.

    Returns
    -------
    Scan
        `Scan.stamp` is the header's stamp (or if that is 0, the time base), `Scan.time` counts from it, `Scan.ring` is
        the line. Points tagged as doubtful by the sensor are kept; points at (0, 0, 0) are dropped.

    Raises
    ------
    OgmError
        If the bytes are no CustomMsg, or cut short.
    """
    raw = isinstance(message, bytes | bytearray | memoryview | np.ndarray)
    stamp, timebase, points, where = _from_bytes(memoryview(message).cast("B")) if raw else _from_object(message)
    base = timebase * 1e-9
    stamp = stamp or base
    late = base - stamp if abs(base - stamp) <= _SAME_CLOCK else 0.0
    columns = {name: points[name] for name in ("x", "y", "z", "reflectivity", "line")}
    columns["time"] = points["offset_time"] * 1e-9 + late
    table = Table("Livox CustomMsg", columns, fields=tuple(name for name, _ in _POINT))
    return scan_from_table(table, where, stamp=stamp, time_unit=1.0)[0]


def _from_object(message: Any) -> _CustomMsg:
    where = describe_message(message, "CustomMsg")
    rows = [tuple(getattr(point, name) for name, _ in _POINT) for point in message.points]
    return _CustomMsg(stamp_seconds(message.header.stamp), int(message.timebase), np.array(rows, _POINT), where)


def _from_bytes(data: memoryview) -> _CustomMsg:
    """View a message as CDR or as ROS 1: its lengths fit only one, and only CDR ends a text with a zero."""
    for read in (_from_cdr, _from_ros1):
        try:
            return read(data)
        except (struct.error, IndexError):
            continue
    raise OgmError(f"{len(data)} bytes are no Livox CustomMsg of ROS 1 or ROS 2 (CDR): cut short or of another type")


def _from_cdr(data: memoryview) -> _CustomMsg:
    """View a message of ROS 2: numbers are aligned to their size, counted from byte 4."""
    if data[0] != 0 or data[1] > 1:
        raise IndexError
    order, body = "><"[data[1]], data[4:]
    sec, nanosec, length = struct.unpack_from(f"{order}iII", body)
    frame, end = bytes(body[12 : 11 + length]), body[11 + length]
    at = -(-(12 + length) // 8) * 8
    timebase, number, count = struct.unpack_from(f"{order}QI4xI", body, at)
    first = at + 20
    if (length and end) or number > count or not 0 <= len(body) - (first + 20 * count - (count > 0)) < 4:
        raise IndexError
    return _message(body[first:], (sec, nanosec, frame, timebase, count), order, 20)


def _from_ros1(data: memoryview) -> _CustomMsg:
    """View a message of ROS 1: little-endian without gaps."""
    _, sec, nanosec, length = struct.unpack_from("<4I", data)
    frame = bytes(data[16 : 16 + length])
    timebase, number, count = struct.unpack_from("<QI4xI", data, 16 + length)
    first = 36 + length
    if b"\0" in frame or number > count or len(data) != first + _SIZE * count:
        raise IndexError
    return _message(data[first:], (sec, nanosec, frame, timebase, count), "<", _SIZE)


def _message(body: memoryview, head: tuple[int, int, bytes, int, int], order: str, step: int) -> _CustomMsg:
    sec, nanosec, frame, timebase, count = head
    stamp = sec + nanosec * 1e-9
    where = f"CustomMsg of {frame.decode('utf-8', 'replace') or 'no frame'} at {stamp:.6f} s"
    kind = np.dtype([(name, order + code) for name, code in _POINT])
    points = np.ndarray((count,), kind, body, 0, (step,)) if count else np.empty(0, kind)
    return _CustomMsg(stamp, timebase, points, where)
