"""Poses of a dataset: read from a file, estimated by odometry, or refined by scan matching."""

import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import tee
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.dataset import Dataset
from ogm.io import Axes, Poses, read_calibration, read_poses
from ogm.io.poses import frame_numbers
from ogm.io.scan_table import rotation_to_flu
from ogm.pose import Trajectory, pose
from ogm.storage.files import FilePath

_OWN_FORMAT = "ogm.poses/1"  # format of --save-poses, always x forward, y left
_MAX_GAP = 2.0  # [s] between two poses, up to which poses are interpolated
_RANGE = 2.5, 100.0  # [m] range of the points that odometry uses; nearer points are of the ego vehicle
_MIN_POINTS = 200  # points in that range that a scan must have
_UNREADABLE = (ValueError, TypeError, OSError)

Progress = Callable[[Iterable[int]], Iterable[int]]


def with_poses(
    dataset: Dataset, path: FilePath, calibration: FilePath | None = None, rate: float = 10.0, progress: Progress = iter
) -> Dataset:
    """Return a dataset with poses from a file, matched by frame number, stamp or order.

    The first possible way of matching is used and recorded in ``facts["poses"]``. The frames are one sequence. A frame
    without a matching pose has the pose and stamp None.

    Parameters
    ----------
    dataset : Dataset
    path : path
        Poses in KITTI, KITTI-360, TUM or ogm format, see `ogm.io.read_poses`, in the axes of the scans on disk.
    calibration : path, optional
        KITTI's calib.txt, for poses of its camera.
    rate : float
        Rate of the scans [1/s] if neither scans nor poses have stamps.
    progress : function
        Wraps an iterable of numbers and may show the progress of reading stamps, see ``rich.progress.track``.

    Raises
    ------
    ValueError
        If the poses cannot be matched with the scans, or the dataset states its poses itself.
    """
    _check_one_sensor(dataset)
    if dataset.recording.known_mount:
        raise ValueError(f"{dataset.name} states its poses: leave out `poses`, or estimate poses with `odometry`")
    T_camera_sensor = None if calibration is None else read_calibration(calibration)
    try:
        poses = read_poses(path, T_camera_sensor=T_camera_sensor)
    except ValueError as error:
        if calibration is None and "T_camera_sensor" in str(error):
            raise ValueError(f"{str(error).partition('. Give')[0]}: give `calibration=calib.txt`") from error
        raise
    return _matched(dataset, _to_flu(poses, dataset.recording.axes), os.path.basename(path), rate, progress)


def with_odometry(dataset: Dataset, method: str = "kiss-icp", rate: float = 10.0, progress: Progress = iter) -> Dataset:
    """Return a dataset with poses estimated from its scans by lidar odometry, as a single sequence.

    A scan that cannot be read, or has fewer than 200 points between 2.5 and 100 m, gets no pose.

    Parameters
    ----------
    dataset : Dataset
    method : {"kiss-icp", "small-gicp"}
        Package that estimates the poses.
    rate : float
        Rate of the scans [1/s] if the scans have no stamps.
    progress : function
        Wraps an iterable of frame numbers and may show the progress, see ``rich.progress.track``.

    Raises
    ------
    ImportError
        If the package is missing.
    ValueError
        If there is no such method, or no scan can be read.
    """
    from ogm.fusion import odometry

    _check_one_sensor(dataset)
    numbers: list[int] = []
    rows = tee(_usable(dataset, _clock(dataset, rate), progress, numbers), 3)
    points, stamps, times = (map(itemgetter(k), column) for k, column in enumerate(rows))
    known = odometry(points, stamps, method, times, range_min=_RANGE[0], range_max=_RANGE[1])
    placed, found = np.full((len(dataset), 4, 4), np.nan), np.full(len(dataset), np.nan)
    placed[numbers], found[numbers] = known.poses, known.stamps
    how = f"{len(numbers)} of {len(dataset)} scans, estimated by {method}"
    return _placed(dataset, found, placed, how, known)


def with_matching(dataset: Dataset, progress: Progress = iter, rate: float = 10.0) -> Dataset:
    """Return a dataset of a planar laser with its poses, used as odometry, refined by scan matching.

    See `ogm.fusion.match_scans`. A frame without pose, or with an unreadable scan, gets no pose.

    Parameters
    ----------
    dataset : Dataset
    progress : function
        Wraps an iterable of frame numbers and may show the progress, see ``rich.progress.track``.
    rate : float
        Rate of the scans [1/s] if the scans have no stamps.

    Raises
    ------
    ValueError
        If no frame has a pose, a scan is not of a planar laser, or there are several sensors.
    """
    from ogm.fusion import match_scans

    _check_one_sensor(dataset)
    numbers: list[int] = []
    rows = tee(_planar_scans(dataset, progress, numbers), 2)
    placed, matched = np.full((len(dataset), 4, 4), np.nan), 0
    for k, (T, found) in enumerate(match_scans((points for points, _ in rows[0]), (T for _, T in rows[1]))):
        placed[numbers[k]] = T
        matched += found
    if not numbers:
        raise ValueError(f"{dataset.name} has no poses, which `match` refines: give `poses`, or a log with odometry")
    stamps = _stamps(dataset, rate, iter)
    t, first = np.unique(stamps[numbers], return_index=True)
    if not np.isfinite(t).all():
        raise ValueError(f"{dataset.name} has scans without stamps: leave out `match`")
    how = f"{len(numbers)} of {len(dataset)} scans, {matched} refined by scan matching"
    return dataset.placed(stamps, placed, {"poses": how}, Trajectory(t, placed[numbers][first]))


def _planar_scans(
    dataset: Dataset, progress: Progress, numbers: list[int]
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float64]]]:
    """Yield points and pose of each planar scan with a pose, and append its number to `numbers`."""
    for k in progress(range(len(dataset))):
        frame = dataset[k]
        try:
            scan = frame.scan
        except _UNREADABLE:
            continue  # reported by the mapping
        if scan.kind != "planar":
            raise ValueError(f"`match` is for planar lasers, {frame.name} is of another sensor: leave out `match`")
        if frame.T_map_sensor is not None:
            numbers.append(k)
            yield scan.points, frame.T_map_sensor


def _usable(
    dataset: Dataset, clock: NDArray[np.float64] | None, progress: Progress, numbers: list[int]
) -> Iterator[tuple[Any, ...]]:
    """Yield points, stamp and times of each scan that odometry can use, and append its number to `numbers`."""
    last = -np.inf
    for k in progress(range(len(dataset))):
        try:
            scan = dataset[k].scan
        except _UNREADABLE:
            continue  # reported by the mapping
        stamp = scan.stamp if clock is None else float(clock[k])
        distance = np.linalg.norm(scan.points[:, :3], axis=1)
        enough = np.count_nonzero((distance > _RANGE[0]) & (distance < _RANGE[1])) >= _MIN_POINTS
        if enough and stamp is not None and stamp > last:
            last = stamp
            numbers.append(k)
            yield scan.points, stamp, scan.time if dataset.motion_distorted else None


def _to_flu(poses: Poses, axes: Axes) -> Poses:
    """Return sensor poses in the axes of the points in memory, x forward and y left.

    A file of poses has the axes of the scans on disk, except a file of ``--save-poses``. The axes of the map are kept.
    """
    if poses.format == _OWN_FORMAT:
        return poses
    T_flu_file = np.eye(4)
    T_flu_file[:3, :3] = rotation_to_flu(axes)
    return replace(poses, poses=poses.poses @ T_flu_file.T)


def _check_one_sensor(dataset: Dataset) -> None:
    recording = dataset.recording
    if len({recording.place(n).name for n in range(len(recording.frames))}) > 1:
        raise ValueError(f"{dataset.name} has scans of several sensors, wanted one for these poses: choose one `topic`")


def _matched(dataset: Dataset, poses: Poses, source: str, rate: float, progress: Progress) -> Dataset:
    count, total = len(dataset), len(poses)
    numbers = frame_numbers([ref.name for ref in dataset.refs])
    rows = np.full(count, -1)
    if numbers is not None and poses.numbers is not None:
        how = "by frame number"
        row = {int(number): k for k, number in enumerate(poses.numbers)}
        rows = np.array([row.get(int(number), -1) for number in numbers])
        if (rows < 0).all():
            raise ValueError(
                f"no scan has a pose in {source}, which has the frame numbers {_span(poses.numbers)}; the scans have "
                f"{_span(numbers)}: give the poses of this drive"
            )
    elif poses.stamps is not None and (dataset.recording.stamped or _clock(dataset, rate) is None):
        return _by_stamp(dataset, poses, source, _stamps(dataset, rate, progress))
    elif total == count:
        how, rows = "in their order", np.arange(count)
    elif numbers is not None and poses.stamps is None and numbers[-1] < total:
        how, rows = "row by frame number, counted from 0", numbers
    else:
        raise ValueError(
            f"{source} has {total} poses for {count} scans, without common frame numbers or stamps: give one pose per "
            "scan, poses with frame numbers (KITTI-360) or stamps (TUM), or `odometry`"
        )
    has = rows >= 0
    placed = np.where(has[:, None, None], poses.poses[rows], np.nan)
    given = poses.stamps
    stamps = _stamps(dataset, rate, progress) if given is None else np.where(has, given[rows], np.nan)
    known = np.isfinite(stamps) & has
    t, first = np.unique(stamps[known], return_index=True)
    if not len(t):
        raise ValueError(f"no scan of {dataset.name} has both a pose in {source} and a time: give poses with stamps")
    how = f"{_counted(has)}, {total} poses of {source} ({poses.format}), {how}"
    return _placed(dataset, stamps, placed, how, Trajectory(t, placed[known][first]))


def _by_stamp(dataset: Dataset, poses: Poses, source: str, stamps: NDArray[np.float64]) -> Dataset:
    known = poses.trajectory()
    t = known.stamps
    with np.errstate(invalid="ignore"):
        inside = (stamps >= t[0]) & (stamps <= t[-1])
    after = np.clip(np.searchsorted(t, stamps), 1, max(len(t) - 1, 1))
    if len(t) > 1:
        inside &= (t[after] - t[after - 1] <= _MAX_GAP) | np.isin(stamps, t)
    if not inside.any():
        raise ValueError(
            f"no scan lies between two poses of {source} that are at most {_MAX_GAP:g} s apart: it has the stamps "
            f"{_span(t)} s, the scans have {_span(stamps[np.isfinite(stamps)])} s; give poses of the same clock"
        )
    placed = np.full((len(dataset), 4, 4), np.nan)
    placed[inside] = known.at(stamps[inside])
    how = f"{_counted(inside)}, {len(poses)} poses of {source} ({poses.format}), by stamp"
    return _placed(dataset, stamps, placed, how, known)


def _placed(
    dataset: Dataset, stamps: NDArray[np.float64], poses: NDArray[np.float64], how: str, known: Trajectory
) -> Dataset:
    """Return the dataset with poses of the frame of its points, the sensor frame or the vehicle frame."""
    position = dataset.recording.sensor_position
    T_points_sensor = np.eye(4) if position is None else pose(*position)
    trajectory = Trajectory(known.stamps, known.poses @ T_points_sensor)
    return dataset.placed(stamps, poses @ T_points_sensor, {"poses": how}, trajectory)


def _clock(dataset: Dataset, rate: float) -> NDArray[np.float64] | None:
    """Return the times of the scans [s], stated or counted at a rate; None if the scans hold stamps."""
    if not 0 < rate < np.inf:
        raise ValueError(f"`rate` must be above 0 [Hz], got {rate}")
    refs = dataset.refs
    if dataset.recording.stamped:
        return np.array([ref.stamp for ref in refs], np.float64)
    for frame in dataset:
        try:
            if frame.scan.stamp is not None:
                return None
            break  # the first readable scan decides
        except _UNREADABLE:
            continue
    numbers = frame_numbers([ref.name for ref in refs])
    return (np.arange(len(refs)) if numbers is None else numbers) / rate


def _stamps(dataset: Dataset, rate: float, progress: Progress) -> NDArray[np.float64]:
    """Return the times of the scans [s]; NaN for a scan that is unreadable or has no stamp."""
    if (clock := _clock(dataset, rate)) is not None:
        return clock
    stamps = np.full(len(dataset), np.nan)
    for k in progress(range(len(dataset))):
        try:
            stamps[k] = dataset[k].scan.stamp
        except _UNREADABLE:
            continue  # reported by the mapping
    return stamps


def _counted(has: NDArray[np.bool_]) -> str:
    if has.all():
        return f"{len(has)} scans"
    return f"{np.count_nonzero(has)} of {len(has)} scans have a pose"


def _span(values: NDArray[Any]) -> str:
    return f"{values.min():.15g} ... {values.max():.15g}" if len(values) else "none"
