"""De-skewing of points that are measured while the sensor moves, and extrapolation of trajectories."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.jit import kernel
from ogm.pose import Trajectory, inverse, matrix_to_vector, vector_to_matrix

_MAX_KNOTS = 100  # poses added to a trajectory at each end
_SLACK = 1e-6  # [s] by which rounded stamps may lie outside the trajectory; the nearest pose is used


def deskew(points: NDArray[Any], time: ArrayLike, trajectory: Trajectory, stamp: float) -> NDArray[np.float32]:
    """Return points as the sensor would have measured them all at `stamp`.

    A point measured at time t becomes ``inverse(T_map_sensor(stamp)) @ T_map_sensor(t) @ point``. Between its poses the
    trajectory follows a straight line and turns on the shortest arc, as in `ogm.pose.Trajectory` (to 1e-5 m). This is
    correct for static objects; moving objects stay distorted by their own motion.

    Parameters
    ----------
    points : (N, 3 or more) float
        x, y, z [m] in the sensor's frame at the time of each point; further columns are kept.
    time : (N,) float
        Time of each point relative to `stamp` [s], as `ogm.Scan.time`.
    trajectory : Trajectory
        Poses of the sensor, ``T_map_sensor``, from the first to the last point's time. `extrapolate` extends it.
    stamp : float
        Time of the result [s], inside the trajectory.

    Returns
    -------
    (N, 3 or more) float32
        Points in the sensor's frame at `stamp`. Non-finite points stay non-finite.

    Raises
    ------
    ValueError
        If shapes disagree, a time is not finite, or a time lies outside the trajectory, which is not extrapolated here.
    """
    cloud, times = np.asarray(points), np.asarray(time, np.float64)
    if cloud.ndim != 2 or cloud.shape[1] < 3:
        raise ValueError(f"points must have shape (N, 3 or more), got {cloud.shape}")
    if times.shape != (len(cloud),):
        raise ValueError(f"time must have shape ({len(cloud)},), one per point, got {times.shape}")
    if not np.isfinite(times).all():
        raise ValueError(f"time must be finite [s], time[{int(np.argmin(np.isfinite(times)))}] is not")
    knots = trajectory.stamps - stamp  # counted from the stamp: no digits are lost to a clock's 1.7e9 s
    first, last = min(times.min(initial=0.0), 0.0), max(times.max(initial=0.0), 0.0)
    if not (first >= knots[0] - _SLACK and last <= knots[-1] + _SLACK):
        raise ValueError(
            f"the points were measured {first:+.4f} ... {last:+.4f} s relative to their stamp, {float(stamp)!r} s, but "
            f"the trajectory covers {knots[0]:+.4f} ... {knots[-1]:+.4f} s: give a longer one, or "
            "ogm.fusion.ego.deskewing.extrapolate(trajectory, seconds)"
        )
    result = cloud.astype(np.float32)
    if len(knots) > 1:
        # The trajectory around the points' times, in the sensor's frame at `stamp`
        low = max(int(np.searchsorted(knots, first, "right")) - 1, 0)
        high = min(max(int(np.searchsorted(knots, last, "left")) + 1, 2), len(knots))
        low = min(low, high - 2)
        part = Trajectory(trajectory.stamps[low:high], trajectory.poses[low:high])
        relative = inverse(part.at(np.clip(stamp, part.stamps[0], part.stamps[-1]))) @ part.poses
        turns = matrix_to_vector(np.swapaxes(relative[:-1, :3, :3], 1, 2) @ relative[1:, :3, :3])
        _deskew(cloud[:, :3].astype(np.float64), times, knots[low:high], relative, turns, result)
    return result


@kernel
def _deskew(
    xyz: NDArray[Any],
    time: NDArray[Any],
    knots: NDArray[Any],
    poses: NDArray[Any],
    turns: NDArray[Any],
    result: NDArray[Any],
) -> None:
    """Write ``T(time[n]) @ xyz[n]`` to ``result[n, :3]``.

    Between knots k and k + 1, at the share s of the time between them, ``T = (R_k exp(s w_k), t_k + s (t_k+1 - t_k))``
    where w_k is ``turns[k]``, the rotation vector between them [rad]. The exponential is Rodrigues' formula:
    ``exp(s w) p = p + sin(a) u x p + (1 - cos(a)) u x (u x p)`` with the angle ``a = s |w|`` and ``u = w / |w|``.

    Parameters
    ----------
    xyz : (N, 3) float64
    time, knots : (N,), (K,) float64
        Times [s] on one clock; K is at least 2.
    poses : (K, 4, 4) float64
    turns : (K - 1, 3) float64
    result : (N, 3 or more) float32
    """
    k = 0
    for n in range(len(time)):
        t = min(max(time[n], knots[0]), knots[-1])
        # Successive points have similar times: the search starts at the last knot.
        while k > 0 and t < knots[k]:
            k -= 1
        while k < len(knots) - 2 and t > knots[k + 1]:
            k += 1
        share = (t - knots[k]) / (knots[k + 1] - knots[k])
        x, y, z = xyz[n, 0], xyz[n, 1], xyz[n, 2]
        wx, wy, wz = turns[k, 0], turns[k, 1], turns[k, 2]
        angle = np.sqrt(wx * wx + wy * wy + wz * wz)
        if angle > 0:
            ux, uy, uz = wx / angle, wy / angle, wz / angle
            sine, versine = np.sin(share * angle), 2 * np.sin(0.5 * share * angle) ** 2
            cx, cy, cz = uy * z - uz * y, uz * x - ux * z, ux * y - uy * x
            x += sine * cx + versine * (uy * cz - uz * cy)
            y += sine * cy + versine * (uz * cx - ux * cz)
            z += sine * cz + versine * (ux * cy - uy * cx)
        T, U = poses[k], poses[k + 1]
        for i in range(3):
            shift = T[i, 3] + share * (U[i, 3] - T[i, 3])
            result[n, i] = T[i, 0] * x + T[i, 1] * y + T[i, 2] * z + shift


def extrapolate(trajectory: Trajectory, seconds: float) -> Trajectory:
    """Return a trajectory extended at both ends with its first and last motion.

    The sensor keeps the velocity and turn rate, in its own frame, between the first two and between the last two poses:
    on a circle it stays on the circle. Needed for the first and the last scan of a drive, some of whose points are
    measured before the first or after the last stamp.

    Parameters
    ----------
    trajectory : Trajectory
        At least two poses.
    seconds : float
        Extension at each end [s]; a scan's duration.

    Returns
    -------
    Trajectory
        The trajectory with one more pose at each end, or up to 100 if `seconds` exceeds the time between two poses.

    Raises
    ------
    ValueError
        If the trajectory has only one pose, or `seconds` is negative or not finite.
    """
    if len(trajectory) < 2:
        raise ValueError("the trajectory has only one pose, which defines no motion: give two poses or more")
    if not 0 <= seconds < np.inf:
        raise ValueError(f"seconds must be 0 or more, got {seconds}")
    t, T = trajectory.stamps, trajectory.poses
    before_t, before_T = _continued(t[1], t[0], T[1], T[0], -seconds)
    after_t, after_T = _continued(t[-2], t[-1], T[-2], T[-1], seconds)
    return Trajectory(np.concatenate([before_t[::-1], t, after_t]), np.concatenate([before_T[::-1], T, after_T]))


def _continued(
    t0: float, t1: float, T0: NDArray[np.float64], T1: NDArray[np.float64], seconds: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return stamps and poses after (t1, T1) up to `seconds` [s], at most as far apart as t0 and t1."""
    count = min(int(np.ceil(round(min(seconds / (t1 - t0), 1e6), 9))), _MAX_KNOTS)
    stamps = t1 + seconds * np.arange(1, count + 1) / max(count, 1)
    step = _twist(inverse(T0) @ T1)
    poses = [T1 @ _rigid(step * ((t - t1) / (t1 - t0))) for t in stamps]
    return stamps, np.array(poses).reshape(-1, 4, 4)


def _twist(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the constant motion (shift (3,), turn (3,)) that reaches a pose in one unit of time."""
    turn = matrix_to_vector(T[:3, :3])
    return np.concatenate([np.linalg.solve(_mean_rotation(turn), T[:3, 3]), turn])


def _rigid(twist: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pose that a constant motion (shift, turn) reaches in one unit of time."""
    T = np.eye(4)
    T[:3, :3] = vector_to_matrix(twist[3:])
    T[:3, 3] = _mean_rotation(twist[3:]) @ twist[:3]
    return T


def _mean_rotation(turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return V, the mean of ``exp(s w)`` over s from 0 to 1 (Sola et al. 2018, arXiv 1812.01537, SE(3))."""
    angle = float(np.linalg.norm(turn))
    x, y, z = turn
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    first, second = 1 / 2, 1 / 6  # next terms: angle**3 / 24 and angle**4 / 120, below rounding
    if angle >= 1e-4:
        first, second = 2 * np.sin(angle / 2) ** 2 / angle**2, (angle - np.sin(angle)) / angle**3
    mean: NDArray[np.float64] = np.eye(3) + first * cross + second * (cross @ cross)
    return mean
