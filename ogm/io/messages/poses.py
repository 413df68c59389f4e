"""Poses: ``tf2_msgs/TFMessage``, odometry, poses and IMU to transforms, and transforms to ``TFMessage``."""

from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.io.messages.plain import describe_message, frame_of, header, reads_message, stamp_seconds
from ogm.io.reading import from_quaternions
from ogm.io.transforms import StampedTransform
from ogm.pose import check_pose, matrix_to_quaternion


@reads_message
def transforms_from_tf(message: Any) -> list[StampedTransform]:
    """Return the transforms of a ``tf2_msgs/TFMessage`` (``/tf``, ``/tf_static``), or of one ``TransformStamped``.

    Raises
    ------
    OgmError
        If a position is not finite, or a quaternion has not length 1.
    """
    several = message.transforms if hasattr(message, "transforms") else [message]
    result = []
    for one in several:
        where = describe_message(one, "TransformStamped")
        child = str(one.child_frame_id).lstrip("/")
        T = _rigid(one.transform.translation, one.transform.rotation, f"{where}, of {child}")
        result.append(StampedTransform(frame_of(one), child, stamp_seconds(one.header.stamp), T))
    return result


@reads_message
def transform_from_odometry(message: Any) -> StampedTransform:
    """Return the pose of a ``nav_msgs/Odometry``: of its ``child_frame_id`` in the frame of its header.

    Raises
    ------
    OgmError
        If a position is not finite, or a quaternion has not length 1.
    """
    placed = message.pose.pose
    T = _rigid(placed.position, placed.orientation, describe_message(message, "Odometry"))
    child = str(message.child_frame_id).lstrip("/")
    return StampedTransform(frame_of(message), child, stamp_seconds(message.header.stamp), T)


def tf_message(transforms: Iterable[StampedTransform]) -> SimpleNamespace:
    """Return transforms as a ``tf2_msgs/TFMessage``, for ``/tf`` or ``/tf_static``."""
    several = []
    for one in transforms:
        placed = pose_message(one.T_parent_child)
        moved = SimpleNamespace(translation=placed.position, rotation=placed.orientation)
        several.append(SimpleNamespace(header=header(one.stamp, one.parent), child_frame_id=one.child, transform=moved))
    return SimpleNamespace(transforms=several)


def pose_message(T: ArrayLike) -> SimpleNamespace:
    """Return a transform (4, 4) as a ``geometry_msgs/Pose``; w of its quaternion is not negative."""
    array = check_pose(T)
    x, y, z = array[:3, 3].tolist()
    quaternion = matrix_to_quaternion(array[:3, :3])
    return SimpleNamespace(
        position=SimpleNamespace(x=x, y=y, z=z),
        orientation=SimpleNamespace(**dict(zip("xyzw", quaternion.tolist(), strict=True))),
    )


def transform_of_pose(placed: Any, where: str) -> NDArray[np.float64]:
    """Return a ``geometry_msgs/Pose`` as a transform (4, 4); a quaternion that was not set, of zeros, turns nothing."""
    q = placed.orientation
    if not any((q.x, q.y, q.z, q.w)):
        q = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    return _rigid(placed.position, q, where)


def _rigid(position: Any, q: Any, where: str) -> NDArray[np.float64]:
    """Return the transform (4, 4) of a position and a quaternion."""
    placed = np.array([[position.x, position.y, position.z]], np.float64)
    return np.asarray(from_quaternions(placed, np.array([[q.x, q.y, q.z, q.w]], np.float64), lambda _: where)[0])
