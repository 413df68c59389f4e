"""Parts that messages share: stamps and headers, as plain objects with the field names of the messages."""

import functools
import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from ogm.pose import check_stamp
from ogm.storage.files import OgmError, error_context

P = ParamSpec("P")
R = TypeVar("R")

_LATEST = 2**31  # [s] at which the seconds of ROS 2 end


def stamp_seconds(stamp: Any) -> float:
    """Return a stamp of ROS 1 or ROS 2 in seconds.

    Parameters
    ----------
    stamp : object
        With ``sec`` and ``nanosec`` (ROS 2, and both in rosbags) or ``secs`` and ``nsecs`` (ROS 1).

    Returns
    -------
    float
        [s], to 2.4e-7 s for times of today: more digits do not fit.

    Raises
    ------
    OgmError
        If it is no stamp.
    """
    for sec, nanosec in (("sec", "nanosec"), ("secs", "nsecs")):
        if hasattr(stamp, sec) and hasattr(stamp, nanosec):
            try:
                return check_stamp(int(getattr(stamp, sec)) + int(getattr(stamp, nanosec)) * 1e-9)
            except (TypeError, ValueError, OverflowError) as error:
                raise OgmError(f"{sec} and {nanosec} of a stamp must be whole numbers of a time: {error}") from error
    raise OgmError(f"a stamp must have sec and nanosec, or secs and nsecs, got {type(stamp).__name__}")


def ros_stamp(seconds: float) -> SimpleNamespace:
    """Return a stamp with ``sec`` and ``nanosec``, rounded to nanoseconds.

    `stamp_seconds` gives the same number back if it was above 2**22 s, and to half a nanosecond below.

    Raises
    ------
    ValueError
        If `seconds` is not in [0, 2**31).
    """
    if not 0 <= seconds < _LATEST:
        raise ValueError(f"a stamp must be from 0 to 2**31 s, got {seconds}: divide nanoseconds by 1e9")
    sec = math.floor(seconds)
    nanosec = round((seconds - sec) * 1e9)
    if nanosec == 1_000_000_000:
        sec, nanosec = sec + 1, 0
    return SimpleNamespace(sec=sec, nanosec=nanosec)


def header(stamp: float | None, frame_id: str) -> SimpleNamespace:
    """Return a header; its ``seq`` is that of ROS 1, which ROS 2 leaves out. Without a stamp it has 0."""
    return SimpleNamespace(seq=0, stamp=ros_stamp(0.0 if stamp is None else stamp), frame_id=frame_id)


def frame_of(message: Any) -> str:
    """Return the frame of a message, without the slash in front that old ROS 1 drivers write."""
    return str(message.header.frame_id).lstrip("/")


def reads_message(convert: Callable[P, R]) -> Callable[P, R]:
    """Let a function raise an OgmError where a message lacks a field: logs bring their own definitions of messages."""

    @functools.wraps(convert)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        with error_context("a message is not as its type wants it", AttributeError):
            return convert(*args, **kwargs)

    return checked


def describe_message(message: Any, kind: str) -> str:
    """Return a name of a message with a header, for errors; raise if it has none.

    Parameters
    ----------
    message : object
    kind : str
        What it should be, such as ``PointCloud2``.
    """
    stamped = getattr(message, "header", None)
    if stamped is None or not hasattr(stamped, "stamp") or not hasattr(stamped, "frame_id"):
        raise OgmError(f"a {kind} must have a header with stamp and frame_id, got {type(message).__name__}")
    return f"{kind} of {frame_of(message) or 'no frame'} at {stamp_seconds(stamped.stamp):.6f} s"


def as_bytes(data: Any, where: str) -> NDArray[np.uint8]:
    """View the bytes of a message, (N,), whether numpy, ``bytes``, ``array.array`` or a list of them."""
    try:
        if isinstance(data, list | tuple):
            return np.array(data, np.uint8)
        return np.frombuffer(memoryview(data).cast("B"), np.uint8)
    except (TypeError, ValueError, OverflowError) as error:
        raise OgmError(f"{where} has data that are no bytes, but {type(data).__name__}: {error}") from error
