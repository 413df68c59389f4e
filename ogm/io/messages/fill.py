"""Plain messages into those of rclpy and rospy."""

import array
import importlib
from types import SimpleNamespace
from typing import Any

import numpy as np


def fill_message(message: Any, plain: SimpleNamespace) -> Any:
    """Copy a plain message into one of rclpy or rospy.

    Parameters
    ----------
    message : object
        A new instance of the message's class: ``PointCloud2()``.
    plain : SimpleNamespace
        What a function of this package returned. Fields that `message` has not are left out, such as ``seq`` of a
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
    """Return a value in the type that a field has."""
    now = getattr(message, name)
    if isinstance(value, SimpleNamespace):
        return fill_message(now, value)
    if isinstance(value, np.ndarray):
        if isinstance(now, bytes):  # uint8[] of ROS 1
            return value.tobytes()
        if isinstance(now, array.array):  # a sequence of numbers in ROS 2, which checks each one of a list
            return array.array(now.typecode, value.astype(np.dtype(now.typecode), copy=False).tobytes())
        return value if isinstance(now, np.ndarray) else value.tolist()
    if isinstance(value, list) and value and isinstance(value[0], SimpleNamespace):
        kind = _element(message, name)
        return [fill_message(kind(), one) for one in value]
    return value


def _element(message: Any, name: str) -> type:
    """Return the class of the elements of a field, from what the message's class tells about it."""
    if hasattr(message, "get_fields_and_field_types"):  # ROS 2: sequence<sensor_msgs/PointField>
        described = message.get_fields_and_field_types()[name].removeprefix("sequence<").split(">")[0].split(",")[0]
    else:  # ROS 1: sensor_msgs/PointField[]
        described = message._slot_types[message.__slots__.index(name)].split("[")[0]
    package, _, kind = described.partition("/")
    found: type = getattr(importlib.import_module(f"{package}.msg"), kind.rpartition("/")[2])
    return found
