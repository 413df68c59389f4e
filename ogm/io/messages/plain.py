"""Common parts of messages: stamps, headers, poses and transforms, as plain objects or objects of rclpy and rospy."""

import array
import functools
import importlib
import logging
import math
from collections.abc import Callable, Iterable
from types import SimpleNamespace
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.io.notices import notice
from ogm.io.reading import from_quaternions
from ogm.io.transforms import StampedTransform, frame_name
from ogm.pose import check_pose, check_stamp, matrix_to_quaternion
from ogm.storage.files import OgmError, error_context

log: logging.Logger = logging.getLogger(__name__)

P = ParamSpec("P")
R = TypeVar("R")

_LATEST = 2**31  # [s] end of the seconds in ROS 2


def stamp_seconds(stamp: Any) -> float:
    """Return a stamp of ROS 1 or ROS 2 in seconds.

    Parameters
    ----------
    stamp : object
        Object with ``sec`` and ``nanosec`` (ROS 2, and both in rosbags) or ``secs`` and ``nsecs`` (ROS 1).

    Returns
    -------
    float
        [s], with a precision of 2.4e-7 s for present times.

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
                raise OgmError(f"{sec} and {nanosec} of a stamp must be integers of a time: {error}") from error
    raise OgmError(f"a stamp must have sec and nanosec, or secs and nsecs, got {type(stamp).__name__}")


def ros_stamp(seconds: float) -> SimpleNamespace:
    """Return a stamp with ``sec`` and ``nanosec``, rounded to nanoseconds.

    `stamp_seconds` restores the same number above 2**22 s, and below it to half a nanosecond.

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
    """Return a header, with stamp 0 by default; ``seq`` exists only in ROS 1 and is dropped for ROS 2."""
    return SimpleNamespace(seq=0, stamp=ros_stamp(0.0 if stamp is None else stamp), frame_id=frame_id)


def frame_of(message: Any) -> str:
    """Return the frame of a message, see `ogm.io.transforms.frame_name`."""
    return frame_name(message.header.frame_id)


def reads_message(convert: Callable[P, R]) -> Callable[P, R]:
    """Make a function raise OgmError for missing message fields, as logs bring their own definitions of messages."""

    @functools.wraps(convert)
    def checked(*args: P.args, **kwargs: P.kwargs) -> R:
        with error_context("a message lacks a field of its type", AttributeError):
            return convert(*args, **kwargs)

    return checked


def describe_message(message: Any, kind: str) -> str:
    """Return the name of a message with a header, for errors; raise if it has none.

    Parameters
    ----------
    message : object
    kind : str
        Expected type, such as ``PointCloud2``.
    """
    stamped = getattr(message, "header", None)
    if stamped is None or not hasattr(stamped, "stamp") or not hasattr(stamped, "frame_id"):
        raise OgmError(f"a {kind} must have a header with stamp and frame_id, got {type(message).__name__}")
    return f"{kind} of {frame_of(message) or 'no frame'} at {stamp_seconds(stamped.stamp):.6f} s"


def as_bytes(data: Any, where: str) -> NDArray[np.uint8]:
    """View the bytes of a message, (N,), from numpy, ``bytes``, ``array.array`` or a list."""
    try:
        if isinstance(data, list | tuple):
            return np.array(data, np.uint8)
        return np.frombuffer(memoryview(data).cast("B"), np.uint8)
    except (TypeError, ValueError, OverflowError) as error:
        raise OgmError(f"{where} has data that are no bytes, but {type(data).__name__}: {error}") from error


@reads_message
def transforms_from_tf(message: Any) -> list[StampedTransform]:
    """Return the transforms of a ``tf2_msgs/TFMessage`` (``/tf``, ``/tf_static``), or of one ``TransformStamped``.

    Damaged transforms are left out, with a warning in the log.

    Raises
    ------
    OgmError
        If all are damaged: a position is not finite, or a quaternion does not have length 1.
    """
    several = message.transforms if hasattr(message, "transforms") else [message]
    result, errors = [], list[OgmError]()
    for stamped in several:
        try:
            where = describe_message(stamped, "TransformStamped")
            child = frame_name(stamped.child_frame_id)
            T = _rigid(stamped.transform.translation, stamped.transform.rotation, f"{where}, of {child}")
            result.append(StampedTransform(frame_of(stamped), child, stamp_seconds(stamped.header.stamp), T))
        except OgmError as error:
            errors.append(error)
            if len(errors) == len(several):
                raise
    for damage in errors:
        notice(log, "damaged transform", "%s: the transform is left out", damage)
    return result


@reads_message
def transform_from_odometry(message: Any) -> StampedTransform:
    """Return the pose of a ``nav_msgs/Odometry``: ``child_frame_id`` in the frame of its header.

    Raises
    ------
    OgmError
        If a position is not finite, or a quaternion does not have length 1.
    """
    placed = message.pose.pose
    T = _rigid(placed.position, placed.orientation, describe_message(message, "Odometry"))
    child = frame_name(message.child_frame_id)
    return StampedTransform(frame_of(message), child, stamp_seconds(message.header.stamp), T)


def tf_message(transforms: Iterable[StampedTransform]) -> SimpleNamespace:
    """Return transforms as a ``tf2_msgs/TFMessage``, for ``/tf`` or ``/tf_static``."""
    several = []
    for stamped in transforms:
        placed = pose_message(stamped.T_parent_child)
        moved = SimpleNamespace(translation=placed.position, rotation=placed.orientation)
        top = header(stamped.stamp, stamped.parent)
        several.append(SimpleNamespace(header=top, child_frame_id=stamped.child, transform=moved))
    return SimpleNamespace(transforms=several)


def pose_message(T: ArrayLike) -> SimpleNamespace:
    """Return a transform (4, 4) as a ``geometry_msgs/Pose`` with non-negative w."""
    array = check_pose(T)
    x, y, z = array[:3, 3].tolist()
    quaternion = matrix_to_quaternion(array[:3, :3])
    return SimpleNamespace(
        position=SimpleNamespace(x=x, y=y, z=z),
        orientation=SimpleNamespace(**dict(zip("xyzw", quaternion.tolist(), strict=True))),
    )


def transform_of_pose(placed: Any, where: str) -> NDArray[np.float64]:
    """Return a ``geometry_msgs/Pose`` as a transform (4, 4); an unset quaternion of zeros becomes the identity."""
    q = placed.orientation
    if not any((q.x, q.y, q.z, q.w)):
        q = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    return _rigid(placed.position, q, where)


def _rigid(position: Any, q: Any, where: str) -> NDArray[np.float64]:
    """Return the transform (4, 4) of a position and a quaternion."""
    placed = np.array([[position.x, position.y, position.z]], np.float64)
    return np.asarray(from_quaternions(placed, np.array([[q.x, q.y, q.z, q.w]], np.float64), lambda _: where)[0])


def fill_message(message: Any, plain: SimpleNamespace) -> Any:
    """Copy a plain message into a message of rclpy or rospy.

    Parameters
    ----------
    message : object
        New instance of the message's class: ``PointCloud2()``.
    plain : SimpleNamespace
        Message returned by a function of this package. Fields missing in `message` are left out, such as ``seq`` of a
        ROS 1 header in ROS 2.

    Returns
    -------
    object
        `message`.
    """
    if hasattr(message, "secs"):  # a time of ROS 1
        message.secs, message.nsecs = plain.sec, plain.nanosec
        return message
    for name, value in vars(plain).items():
        if hasattr(message, name):
            setattr(message, name, _filled(message, name, value))
    return message


def _filled(message: Any, name: str, value: Any) -> Any:
    """Return a value converted to the type of a field."""
    now = getattr(message, name)
    if isinstance(value, SimpleNamespace):
        return fill_message(now, value)
    if isinstance(value, np.ndarray):
        if isinstance(now, bytes):  # uint8[] of ROS 1
            return value.tobytes()
        if isinstance(now, array.array):  # a sequence of numbers in ROS 2, which checks each element of a list
            return array.array(now.typecode, value.astype(np.dtype(now.typecode), copy=False).tobytes())
        return value if isinstance(now, np.ndarray) else value.tolist()
    if isinstance(value, list) and value and isinstance(value[0], SimpleNamespace):
        kind = _element(message, name)
        return [fill_message(kind(), element) for element in value]
    return value


def _element(message: Any, name: str) -> type:
    """Return the class of the elements of a field, from the description in the message's class."""
    if hasattr(message, "get_fields_and_field_types"):  # ROS 2: sequence<sensor_msgs/PointField>
        described = message.get_fields_and_field_types()[name].removeprefix("sequence<").split(">")[0].split(",")[0]
    else:  # ROS 1: sensor_msgs/PointField[]
        described = message._slot_types[message.__slots__.index(name)].split("[")[0]
    package, _, kind = described.partition("/")
    found: type = getattr(importlib.import_module(f"{package}.msg"), kind.rpartition("/")[2])
    return found
