"""Odometry: poses of scans from the scans alone, by packages for lidar registration."""

import itertools
import logging
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.extras import import_extra
from ogm.fusion.ego.deskewing import deskew, extrapolate
from ogm.pose import Trajectory, inverse

log: logging.Logger = logging.getLogger(__name__)

_MIN_POINTS = 100  # points within range that a registered scan needs
_LEAF = 0.25  # [m] spacing of the points that small-gicp registers
_VOXEL = 1.0  # [m] side of the voxels of small-gicp's map
_NEIGHBOURS = 10  # points from which small-gicp estimates a surface
_HORIZON = 100  # scans for which small-gicp keeps an unobserved voxel

_NAMES = ("scans", "stamps", "times")
_ENDED: Any = object()

_Register = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


def odometry(
    scans: Iterable[NDArray[Any]],
    stamps: Iterable[float],
    method: str = "kiss-icp",
    times: Iterable[ArrayLike | None] | None = None,
    *,
    range_min: float = 2.5,
    range_max: float = 100.0,
) -> Trajectory:
    """Return the trajectory of a lidar, estimated from its scans alone.

    Each scan is registered to a map of the previous scans, with constant velocity as first guess.

    Parameters
    ----------
    scans : iterable of (N, 3 or more) float
        x, y, z [m] in the sensor's frame; read once, one by one. Non-finite points are ignored.
    stamps : iterable of float
        Times of the scans [s], increasing; one per scan.
    method : {"kiss-icp", "small-gicp"}
        ``kiss-icp``: point to point, with a threshold that adapts (Vizzo et al., RA-L 2023). ``small-gicp``:
        distribution to distribution, on a map of voxels (Koide, JOSS 2024).
    times : iterable of (N,) float or None, optional
        Time of each point relative to the scan's stamp [s], as `ogm.Scan.time`; scans are then de-skewed by the last
        motion. Give None, also for single scans, if the points are de-skewed already (KITTI) or have no times.
    range_min, range_max : float
        Points nearer or farther than this [m] are ignored. Most near points belong to the ego vehicle: they do not move
        relative to the sensor and would bias the estimate.

    Returns
    -------
    Trajectory
        ``T_map_sensor`` at each stamp; the map frame is the sensor's frame at the first stamp.

    Raises
    ------
    ValueError
        If there is no scan, a scan has too few points, stamps do not increase, or the numbers of scans, stamps and
        `times` differ.
    ImportError
        If the package is not installed.
    """
    if method not in METHODS:
        raise ValueError(f"method must be {' or '.join(METHODS)}, got {method!r}")
    if not 0 <= range_min < range_max:
        raise ValueError(f"range_min must be 0 m or more and below range_max, got {range_min}, {range_max}")
    register, within = METHODS[method](range_max), (range_min, range_max)
    known: list[float] = []
    poses: list[NDArray[np.float64]] = []
    step, duration = np.eye(4), 0.0  # last motion, T_before_last, and its duration [s]
    for k, (points, stamp, given) in enumerate(_together(scans, stamps, times)):
        points, time = _checked(points, given, k)
        if k == 0:
            first = points, time
            found = _nearest(register(_cloud(points, time, step, duration, within, k), np.eye(4)))
        else:
            if not stamp > known[-1]:
                raise ValueError(f"stamps must increase, but stamps[{k - 1}]={known[-1]} is followed by {stamp}")
            # Predict: the last motion continues, longer if scans are missing.
            guess = poses[-1] @ _times(step, (stamp - known[-1]) / duration) if duration else poses[-1]
            found = _nearest(register(_cloud(points, time, step, duration, within, k), guess))
            if k == 1 and (first[1].any() or time.any()):
                # The first two scans were registered without de-skewing: repeat with the motion between them.
                register, step, duration = METHODS[method](range_max), found, stamp - known[-1]
                register(_cloud(*first, step, duration, within, 0), poses[-1])
                found = _nearest(register(_cloud(points, time, step, duration, within, 1), found))
            step, duration = inverse(poses[-1]) @ found, stamp - known[-1]
        known.append(stamp)
        poses.append(found)
    if not poses:
        raise ValueError("there are no scans to register: got 0, wanted at least 1")
    return Trajectory(np.array(known), np.array(poses))


def _checked(points: NDArray[Any], given: ArrayLike | None, k: int) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """Return the points of scan `k` and their times; times are 0 if not given."""
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"scan {k} must have shape (N, 3 or more), got {points.shape}")
    time = np.zeros(len(points)) if given is None else np.asarray(given, np.float64)
    if time.shape != points.shape[:1]:
        raise ValueError(f"times of scan {k} must have shape ({len(points)},), one per point, got {time.shape}")
    if not np.isfinite(time).all():
        raise ValueError(f"times of scan {k} must be finite [s]: give None if they are unknown")
    return points, time


def _cloud(
    points: NDArray[Any],
    time: NDArray[np.float64],
    step: NDArray[np.float64],
    duration: float,
    within: tuple[float, float],
    k: int,
) -> NDArray[np.float64]:
    """Return the points of scan `k` for registration: de-skewed by the last motion, within the range limits."""
    cloud = points[:, :3]
    if duration and time.any():
        reach = float(np.abs(time).max())
        cloud = deskew(cloud, time, extrapolate(_last(step, duration), reach), 0.0)
    distance = np.linalg.norm(cloud, axis=1)
    cloud = cloud[(distance >= within[0]) & (distance <= within[1])]  # false for NaN
    if len(cloud) < _MIN_POINTS:
        raise ValueError(
            f"scan {k} has {len(cloud)} points between {within[0]:g} and {within[1]:g} m, wanted at least "
            f"{_MIN_POINTS}: leave it out"
        )
    kept: NDArray[np.float64] = cloud.astype(np.float64)
    return kept


def _kiss_icp(range_max: float) -> _Register:
    """Return the registration of KISS-ICP, without its own de-skewing, which refers to the end of a scan."""
    load_config = import_extra("kiss_icp.config.parser", "track").load_config
    config = load_config(None)
    config.data.deskew = False
    config.data.max_range = range_max
    config.mapping.voxel_size = range_max / 100
    config.registration.max_num_threads = 1  # more threads vary the order of sums, and so the rounding
    pipeline = import_extra("kiss_icp.kiss_icp", "track").KissICP(config)

    def register(cloud: NDArray[np.float64], guess: NDArray[np.float64]) -> NDArray[np.float64]:
        pipeline.last_delta = np.linalg.inv(pipeline.last_pose) @ guess
        pipeline.register_frame(cloud, np.zeros(0))
        return np.array(pipeline.last_pose, np.float64)

    return register


def _small_gicp(_range_max: float) -> _Register:
    """Return a registration of each scan to a map of Gaussian voxels."""
    small_gicp = import_extra("small_gicp", "track")
    voxels = small_gicp.GaussianVoxelMap(_VOXEL)
    voxels.set_lru(horizon=_HORIZON, clear_cycle=10)

    def register(cloud: NDArray[np.float64], guess: NDArray[np.float64]) -> NDArray[np.float64]:
        scan, _ = small_gicp.preprocess_points(cloud, _LEAF, _NEIGHBOURS)
        T = guess
        if len(voxels):
            found = small_gicp.align(voxels, scan, guess)
            T = np.array(found.T_target_source)
            if not found.converged:
                log.warning("small-gicp did not converge in %d steps: a pose may be wrong", found.iterations)
        voxels.insert(scan, T)
        return T

    return register


METHODS: dict[str, Callable[[float], _Register]] = {"kiss-icp": _kiss_icp, "small-gicp": _small_gicp}


def _times(step: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """Return the motion of `share` steps, at constant velocity and turn."""
    if share == 1.0:
        return step
    T: NDArray[np.float64] = extrapolate(_last(step, 1.0), share).poses[-1]
    return T


def _last(step: NDArray[np.float64], duration: float) -> Trajectory:
    return Trajectory(np.array([-duration, 0.0]), np.array([inverse(step), np.eye(4)]))


def _nearest(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rigid pose nearest to a pose with rounding errors."""
    left, _, right = np.linalg.svd(T[:3, :3])
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = left @ right, T[:3, 3]
    return result


def _together(
    scans: Iterable[NDArray[Any]], stamps: Iterable[float], times: Iterable[ArrayLike | None] | None
) -> Iterator[tuple[NDArray[Any], float, ArrayLike | None]]:
    """Yield scan, stamp and times; raise ValueError if their numbers differ."""
    streams = (scans, stamps) if times is None else (scans, stamps, times)
    for count, row in enumerate(itertools.zip_longest(*streams, fillvalue=_ENDED)):
        ended = [name for name, item in zip(_NAMES, row, strict=False) if item is _ENDED]
        if ended:
            raise ValueError(f"scans, stamps and times must be equal in number, but {ended[0]} ended after {count}")
        yield row[0], float(row[1]), None if times is None else row[2]
