"""Rigid transforms: float64 4x4 arrays named ``T_to_from``; rotations as matrices, quaternions and vectors.

``T_map_sensor @ (x, y, z, 1)`` takes sensor coordinates to map coordinates, so a chain reads like its names:
``T_map_vehicle @ T_vehicle_sensor = T_map_sensor``.

>>> import numpy as np
>>> from ogm.pose import inverse, pose, transform_points
>>> T_map_vehicle = pose(x=10.0, yaw=np.pi / 2)
>>> transform_points(T_map_vehicle, np.array([[1.0, 0.0, 0.0]])).round(6)
array([[10.,  1.,  0.]])
>>> np.allclose(T_map_vehicle @ inverse(T_map_vehicle), np.eye(4))
True
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "MAX_STAMP", "Trajectory", "check_pose", "check_stamp", "inverse", "levelling", "matrix_to_quaternion",
    "matrix_to_vector", "pose", "quaternion_to_matrix", "rotate", "tilt_of", "transform_points", "vector_to_matrix",
]  # fmt: skip

MAX_STAMP = 1e11  # [s], year 5138: larger stamps are in a smaller unit, and float64 does not resolve microseconds there
_MAX_STEP = 1e-3  # [s] between two stamps of a type; with larger steps maps do not age and speeds are unknown
_LAST_ROW, _IDENTITY = np.array([0.0, 0.0, 0.0, 1.0]), np.eye(3)
_TOLERANCE = 1e-4  # departure of R'R from the identity, met by a text file with four decimals


def pose(
    x: float = 0.0, y: float = 0.0, z: float = 0.0, *, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0
) -> NDArray[np.float64]:
    """Build a transform from a position and three angles.

    Parameters
    ----------
    x, y, z : float
        Position of the "from" frame's origin in the "to" frame [m].
    roll, pitch, yaw : float
        Rotations about the fixed x, y and z axes, applied in this order [rad] (REP 103: yaw counts to the
        left, positive pitch looks down).

    Returns
    -------
    (4, 4) float64
    """
    T = np.eye(4)
    for turn in ((0, 0, yaw), (0, pitch, 0), (roll, 0, 0)):
        if any(turn):
            T[:3, :3] = T[:3, :3] @ vector_to_matrix(turn)
    T[:3, 3] = x, y, z
    return check_pose(T)


def check_pose(T: ArrayLike, name: str = "pose") -> NDArray[np.float64]:
    """Return `T` as a float64 array, or raise an error if it is no rigid transform.

    Parameters
    ----------
    T : (4, 4) array
    name : str
        Name of `T` in the error.

    Raises
    ------
    ValueError
        If the numbers are not real or not finite, the shape is not (4, 4), the last row is not (0, 0, 0, 1), or the
        upper left 3x3 block is not a rotation (scaled, sheared or mirrored).
    """
    given = np.asarray(T)
    if given.dtype.kind not in "fiu":
        raise ValueError(f"{name} must be a 4x4 array of real numbers, got {given.dtype} of shape {given.shape}")
    array = given.astype(np.float64, copy=False)
    if array.shape != (4, 4):
        raise ValueError(f"{name} must be a 4x4 transform, got shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got NaN or inf: {array.tolist()}")
    if not (np.abs(array[3] - _LAST_ROW) <= 1e-9).all():
        raise ValueError(f"the last row of {name} must be (0, 0, 0, 1), got {array[3].tolist()}")
    R = array[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # refused below
        error, handed = float(np.abs(R.T @ R - _IDENTITY).max()), float(np.linalg.det(R))
    if not error <= _TOLERANCE or handed < 0:
        raise ValueError(
            f"{name} must be rigid (a rotation and a shift): R'R departs from the identity by {error:.2g} and "
            f"det R = {handed:.3g}, allowed are {_TOLERANCE:g} and +1; remove scale, shear and mirror"
        )
    return array


def check_stamp(stamp: float, name: str = "stamp") -> float:
    """Return a stamp as a float, or raise an error if it is no time in seconds.

    Parameters
    ----------
    stamp : float
        Time [s].
    name : str
        Name of `stamp` in the error.

    Raises
    ------
    ValueError
        If it is no real number, not finite, or beyond `MAX_STAMP` (milliseconds or nanoseconds), or if its type
        (float32, float16) does not resolve a millisecond at this value.
    """
    if isinstance(stamp, bool | np.bool_) or not isinstance(stamp, int | float | np.integer | np.floating):
        raise ValueError(f"{name} must be a number of seconds, got {stamp!r} ({type(stamp).__name__})")
    if isinstance(stamp, np.floating) and np.isfinite(stamp) and np.spacing(abs(stamp)) > _MAX_STEP:
        raise ValueError(
            f"{name} must resolve a millisecond, got {stamp} s as {stamp.dtype}, in steps of "
            f"{float(np.spacing(abs(stamp))):g} s: give a float64"
        )
    if not abs(stamp) <= MAX_STAMP:
        way = "divide nanoseconds by 1e9" if stamp == stamp and abs(stamp) < 10**30 else "give a finite time"
        raise ValueError(f"{name} must be finite, a time in seconds up to {MAX_STAMP:g}, got {_short(stamp)}: {way}")
    return float(stamp)


def _short(number: float) -> str:
    """Return a number for an error text; integers of Python can have thousands of digits."""
    return str(number) if abs(number) < 10**30 or number != number else ("-" if number < 0 else "") + "more than 1e30"


def inverse(T: ArrayLike) -> NDArray[np.float64]:
    """Invert a rigid transform: ``inverse(T_map_sensor)`` is ``T_sensor_map``."""
    array = check_pose(T)
    result = np.eye(4)
    result[:3, :3] = array[:3, :3].T
    result[:3, 3] = -array[:3, :3].T @ array[:3, 3]
    return result


def tilt_of(T: NDArray[np.float64]) -> float:
    """Return the angle between the z axes of both frames of a transform, 0 to pi [rad]."""
    return float(np.arccos(np.clip(T[2, 2], -1, 1)))


def levelling(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation from sensor axes to axes with z along the map's z.

    Parameters
    ----------
    T : (4, 4) float64
        ``T_map_sensor``.

    Returns
    -------
    (3, 3) float64
        The smallest rotation; for tilts above 120 degrees the rotation that keeps the heading of the x axis.
    """
    R = T[:3, :3]
    if R[2, 2] < -0.5:
        yaw = np.arctan2(R[1, 0], R[0, 0])
        turned: NDArray[np.float64] = vector_to_matrix((0.0, 0.0, -yaw)) @ R
        return turned
    axis = np.cross(R[2], (0.0, 0.0, 1.0))  # from the map's z axis in the sensor frame to z
    sine = float(np.linalg.norm(axis))
    return vector_to_matrix(axis / sine * tilt_of(T)) if sine > 1e-12 else np.eye(3)


def transform_points(T: ArrayLike, points: NDArray[Any]) -> NDArray[Any]:
    """Transform points; columns after x, y, z (intensity, ...) are kept.

    Parameters
    ----------
    T : (4, 4) array
        ``T_to_from``.
    points : (N, 3 or more) float array
        x, y, z [m] in the "from" frame.

    Returns
    -------
    array of the shape and dtype of `points`
        x, y, z [m] in the "to" frame.
    """
    array = check_pose(T)
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"points must have shape (N, 3 or more), got {points.shape}")
    result = points.copy()
    result[:, :3] = (rotate(array[:3, :3], points[:, :3].T) + array[:3, 3:]).T
    return result


def rotate(R: NDArray[np.float64], xyz: NDArray[Any]) -> NDArray[np.float64]:
    """Return ``R @ xyz``, computed by one core.

    BLAS spreads products of this shape over threads; waiting for them takes ten times as long as the product.

    Parameters
    ----------
    R : (3, 3) array
    xyz : (3, N) float array
        Points or directions as rows x, y and z.

    Returns
    -------
    (3, N) float64
    """
    turned: NDArray[np.float64] = np.einsum("ij,jn->in", R, np.ascontiguousarray(xyz, np.float64))
    return turned


def _interpolate(t: NDArray[np.float64], T: NDArray[np.float64], at: ArrayLike) -> NDArray[np.float64]:
    """Interpolate between two or more poses; see `Trajectory.at`."""
    times = np.asarray(at, np.float64)
    if times.size and not (times.min() >= t[0] and times.max() <= t[-1]):
        raise ValueError(
            f"times must lie in [{t[0]}, {t[-1]}] s, got [{times.min()}, {times.max()}]; poses are not extrapolated"
        )
    result = np.broadcast_to(np.eye(4), (*times.shape, 4, 4)).copy()
    before = np.clip(np.searchsorted(t, times, "right") - 1, 0, len(t) - 2)
    share = (times - t[before]) / (t[before + 1] - t[before])
    used, place = np.unique(before, return_inverse=True)
    R, after = (quaternion_to_matrix(matrix_to_quaternion(T[at, :3, :3])) for at in (used, used + 1))  # exact rotations
    turns = matrix_to_vector(np.swapaxes(R, 1, 2) @ after)[place.reshape(times.shape)]
    result[..., :3, :3] = R[place.reshape(times.shape)] @ vector_to_matrix(share[..., None] * turns)
    for axis in range(3):
        result[..., axis, 3] = np.interp(times, t, T[:, axis, 3])
    return result


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses and their times.

    Parameters
    ----------
    stamps : (K,) float
        Times [s], strictly increasing; K is at least 1.
    poses : (K, 4, 4) float
        ``T_map_sensor`` (or ``T_map_vehicle``) at those times.

    Raises
    ------
    ValueError
        If the counts differ, a stamp is not finite, the stamps do not increase, or a pose is not rigid.
    """

    stamps: NDArray[np.float64]
    poses: NDArray[np.float64]

    def __post_init__(self) -> None:
        for name in ("stamps", "poses"):
            if (given := np.asarray(getattr(self, name))).size and given.dtype.kind not in "fiu":
                raise ValueError(f"{name} must be real numbers, got {given.dtype}")
        t, T = np.array(self.stamps, np.float64), np.array(self.poses, np.float64)
        if t.ndim != 1 or not len(t) or T.shape != (len(t), 4, 4):
            raise ValueError(
                f"stamps (K,) and poses (K, 4, 4) must agree and K be at least 1, got {t.shape} and {T.shape}"
            )
        if not np.isfinite(t).all():
            raise ValueError(f"stamps must be finite [s], stamps[{int(np.argmin(np.isfinite(t)))}] is not")
        check_stamp(float(t[np.argmax(np.abs(t))]), "the greatest of stamps")
        if not (np.diff(t) > 0).all():
            k = int(np.argmin(np.diff(t)))
            raise ValueError(f"stamps must increase, but stamps[{k}]={t[k]} is followed by {t[k + 1]}")
        for k, matrix in enumerate(T):
            check_pose(matrix, name=f"poses[{k}]")
        self.__dict__.update(stamps=t, poses=T)

    def __len__(self) -> int:
        return len(self.stamps)

    def at(self, stamps: ArrayLike) -> NDArray[np.float64]:
        """Return the poses at given times [s]: (4, 4) for one time, (M, 4, 4) for M.

        Positions are interpolated on a straight line, rotations on the shortest arc (slerp).

        Raises
        ------
        ValueError
            If a time lies outside the trajectory: poses are never extrapolated.
        """
        if len(self) == 1:
            times = np.asarray(stamps, np.float64)
            if not (times == self.stamps[0]).all():
                raise ValueError(f"the trajectory has the one time {self.stamps[0]} s, got {times.tolist()} s")
            return np.broadcast_to(self.poses[0], (*times.shape, 4, 4)).copy()
        return _interpolate(self.stamps, self.poses, stamps)


def matrix_to_quaternion(R: ArrayLike) -> NDArray[np.float64]:
    """Return unit quaternions x, y, z, w of rotations, (..., 3, 3) to (..., 4), with w of 0 or more.

    Computed by the greatest of the four, so that no digits are lost (Shepperd 1978).
    """
    R = np.asarray(R, np.float64)
    trace = np.trace(R, axis1=-2, axis2=-1)
    # Rows: the quaternion times 4 x, 4 y, 4 z, 4 w.
    K = np.empty((*R.shape[:-2], 4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        K[..., i, i] = 1 + 2 * R[..., i, i] - trace
        K[..., i, j] = K[..., j, i] = R[..., i, j] + R[..., j, i]
        K[..., i, 3] = K[..., 3, i] = R[..., k, j] - R[..., j, k]
    K[..., 3, 3] = 1 + trace
    greatest = np.diagonal(K, axis1=-2, axis2=-1).argmax(axis=-1)
    q = np.take_along_axis(K, greatest[..., None, None], axis=-2)[..., 0, :]
    q *= np.where(q[..., 3:] < 0, -1, 1) / np.linalg.norm(q, axis=-1, keepdims=True)
    return q + 0.0  # no -0


def quaternion_to_matrix(quaternions: ArrayLike) -> NDArray[np.float64]:
    """Return the rotations of quaternions x, y, z, w of any length above 0, (..., 4) to (..., 3, 3)."""
    q = np.asarray(quaternions, np.float64)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_to_vector(R: ArrayLike) -> NDArray[np.float64]:
    """Return axis times angle [rad] of rotations by at most pi, (..., 3, 3) to (..., 3)."""
    q = matrix_to_quaternion(R)
    half_sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(half_sine, q[..., 3:])
    return q[..., :3] * np.where(half_sine > 1e-12, angle / np.maximum(half_sine, 1e-12), 2.0)


def vector_to_matrix(vectors: ArrayLike) -> NDArray[np.float64]:
    """Return the rotations of axis times angle [rad], (..., 3) to (..., 3, 3)."""
    v = np.asarray(vectors, np.float64)
    half = np.linalg.norm(v, axis=-1, keepdims=True) / 2
    return quaternion_to_matrix(np.concatenate([v / 2 * np.sinc(half / np.pi), np.cos(half)], axis=-1))
