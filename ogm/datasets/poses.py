"""Where and when each frame was taken: poses of a file matched with scans, or estimated from them."""

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

_SAVED = "ogm.poses/1"  # the format of what --save-poses writes: always x forward, y left
_GAP = 2.0  # [s] between two poses, beyond which nothing is known of what lies between them
_RANGE = 2.5, 100.0  # [m] of points that odometry uses: the near ones are the ego vehicle's
_FEWEST = 200  # of them, below which a scan is left out
_UNREADABLE = (ValueError, TypeError, OSError)

Progress = Callable[[Iterable[int]], Iterable[int]]


def with_poses(
    dataset: Dataset, path: FilePath, calibration: FilePath | None = None, rate: float = 10.0, progress: Progress = iter
) -> Dataset:
    """Return a dataset with the poses of a file: by frame number, by stamp, or by order, in this order.

    Its frames are one sequence. Where a frame gets no pose, its pose and stamp are None. How poses were matched
    stands in ``facts["poses"]``.

    Parameters
    ----------
    dataset : Dataset
    path : path
        KITTI, KITTI-360, TUM or our own format, see `ogm.io.read_poses`; in the files' own axes, as the points are.
    calibration : path, optional
        KITTI's calib.txt, where the poses are those of its camera.
    rate : float
        Rate of the scans [1/s], where neither scans nor poses have stamps.
    progress : function
        Iterates over numbers, and may draw how far the reading of stamps is, as ``rich.progress.track`` does.

    Raises
    ------
    ValueError
        If nothing tells which pose belongs to which scan, or the dataset states its poses itself.
    """
    _check_one_sensor(dataset)
    if dataset.recording.known_mount:
        raise ValueError(f"{dataset.name} knows its poses; leave out `poses` (or estimate some with `odometry`)")
    T_camera_sensor = None if calibration is None else read_calibration(calibration)
    try:
        poses = read_poses(path, T_camera_sensor=T_camera_sensor)
    except ValueError as error:
        if calibration is None and "T_camera_sensor" in str(error):
            raise ValueError(f"{str(error).partition('. Give')[0]}: give `calibration=calib.txt`") from error
        raise
    return _matched(dataset, _to_flu(poses, dataset.recording.axes), os.path.basename(path), rate, progress)


def with_odometry(dataset: Dataset, method: str = "kiss-icp", rate: float = 10.0, progress: Progress = iter) -> Dataset:
    """Return a dataset with poses that are estimated from its scans alone; its frames are one sequence.

    A scan that cannot be read, or has too few points between 2.5 and 100 m, gets no pose.

    Parameters
    ----------
    dataset : Dataset
    method : {"kiss-icp", "small-gicp"}
    rate : float
        Rate of the scans [1/s], where the scans have no stamps.
    progress : function
        Iterates over the numbers of the frames, and may draw how far it is, as ``rich.progress.track`` does.

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
    """Return a dataset of a planar laser whose poses are taken for odometry, and refined by scan matching.

    See `ogm.fusion.match_scans`. A frame without pose, or with a scan that cannot be read, gets no pose.

    Parameters
    ----------
    dataset : Dataset
    progress : function
        Iterates over the numbers of the frames, and may draw how far it is, as ``rich.progress.track`` does.
    rate : float
        Rate of the scans [1/s], where the scans have no stamps.

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
        raise ValueError("the scans have no poses that matching could refine: give `poses`, or a log with odometry")
    stamps = _stamps(dataset, rate, iter)
    t, first = np.unique(stamps[numbers], return_index=True)
    if not np.isfinite(t).all():
        raise ValueError(f"{dataset.name} has scans without stamps: leave out `match`")
    how = f"{len(numbers)} of {len(dataset)} scans, {matched} refined by scan matching"
    return dataset.placed(stamps, placed, {"poses": how}, Trajectory(t, placed[numbers][first]))


def _planar_scans(
    dataset: Dataset, progress: Progress, numbers: list[int]
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float64]]]:
    """Yield points and pose of each planar scan that has one, and append its number."""
    for k in progress(range(len(dataset))):
        frame = dataset[k]
        try:
            scan = frame.scan
        except _UNREADABLE:
            continue  # the mapping reports it
        if scan.kind != "planar":
            raise ValueError(f"{frame.name} is not of a planar laser, whose scans `match` matches: leave it out")
        if frame.T_map_sensor is not None:
            numbers.append(k)
            yield scan.points, frame.T_map_sensor


def _usable(
    dataset: Dataset, clock: NDArray[np.float64] | None, progress: Progress, numbers: list[int]
) -> Iterator[tuple[Any, ...]]:
    """Yield points, stamp and times of each scan that can be registered, and append its number."""
    last = -np.inf
    for k in progress(range(len(dataset))):
        try:
            scan = dataset[k].scan
        except _UNREADABLE:
            continue  # the mapping reports it
        stamp = scan.stamp if clock is None else float(clock[k])
        distance = np.linalg.norm(scan.points[:, :3], axis=1)
        enough = np.count_nonzero((distance > _RANGE[0]) & (distance < _RANGE[1])) >= _FEWEST
        if enough and stamp is not None and stamp > last:
            last = stamp
            numbers.append(k)
            yield scan.points, stamp, scan.time if dataset.motion_distorted else None


def _to_flu(poses: Poses, axes: Axes) -> Poses:
    """Return the poses of a sensor with x forward and y left, as its points are read.

    A file of poses has the axes of the scans on disk; the map keeps its own. A file that ``--save-poses`` wrote is left
    as it is.
    """
    if poses.format == _SAVED:
        return poses
    T_flu_file = np.eye(4)
    T_flu_file[:3, :3] = rotation_to_flu(axes)
    return replace(poses, poses=poses.poses @ T_flu_file.T)


def _check_one_sensor(dataset: Dataset) -> None:
    recording = dataset.recording
    if len({recording.place(n).name for n in range(len(recording.frames))}) > 1:
        raise ValueError(f"{dataset.name} has scans of several sensors, poses are of one: choose one `topic`")


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
                f"no scan has a pose in {source}: its frame numbers are {_span(poses.numbers)}, those of the scans "
                f"{_span(numbers)}"
            )
    elif poses.stamps is not None and (dataset.recording.stamped or _clock(dataset, rate) is None):
        return _by_stamp(dataset, poses, source, _stamps(dataset, rate, progress))
    elif total == count:
        how, rows = "in their order", np.arange(count)
    elif numbers is not None and poses.stamps is None and numbers[-1] < total:
        how, rows = "row by frame number, counted from 0", numbers
    else:
        raise ValueError(
            f"{source} has {total} poses for {count} scans, and nothing tells which belongs to which: give as many, "
            "poses with frame numbers (KITTI-360) or stamps (TUM) that the scans have too, or `odometry`"
        )
    has = rows >= 0
    placed = np.where(has[:, None, None], poses.poses[rows], np.nan)
    given = poses.stamps
    stamps = _stamps(dataset, rate, progress) if given is None else np.where(has, given[rows], np.nan)
    known = np.isfinite(stamps) & has
    t, first = np.unique(stamps[known], return_index=True)
    if not len(t):
        raise ValueError("no scan has both a pose and a time")
    how = f"{_counted(has)}, {total} poses of {source} ({poses.format}), {how}"
    return _placed(dataset, stamps, placed, how, Trajectory(t, placed[known][first]))


def _by_stamp(dataset: Dataset, poses: Poses, source: str, stamps: NDArray[np.float64]) -> Dataset:
    known = poses.trajectory()
    t = known.stamps
    with np.errstate(invalid="ignore"):
        inside = (stamps >= t[0]) & (stamps <= t[-1])
    after = np.clip(np.searchsorted(t, stamps), 1, max(len(t) - 1, 1))
    if len(t) > 1:
        inside &= (t[after] - t[after - 1] <= _GAP) | np.isin(stamps, t)
    if not inside.any():
        raise ValueError(
            f"no scan lies between two poses of {source} that are at most {_GAP:g} s apart: its stamps are {_span(t)} "
            f"s, those of the scans {_span(stamps[np.isfinite(stamps)])} s; are they of one clock?"
        )
    placed = np.full((len(dataset), 4, 4), np.nan)
    placed[inside] = known.at(stamps[inside])
    how = f"{_counted(inside)}, {len(poses)} poses of {source} ({poses.format}), by stamp"
    return _placed(dataset, stamps, placed, how, known)


def _placed(
    dataset: Dataset, stamps: NDArray[np.float64], poses: NDArray[np.float64], how: str, known: Trajectory
) -> Dataset:
    """Return the dataset with poses of the frame of its points, which is the sensor's or the vehicle's."""
    position = dataset.recording.sensor_position
    T_points_sensor = np.eye(4) if position is None else pose(*position)
    trajectory = Trajectory(known.stamps, known.poses @ T_points_sensor)
    return dataset.placed(stamps, poses @ T_points_sensor, {"poses": how}, trajectory)


def _clock(dataset: Dataset, rate: float) -> NDArray[np.float64] | None:
    """Return when the scans were taken [s]: stated, or counted by a rate; None if the scans state them."""
    if not 0 < rate < np.inf:
        raise ValueError(f"`rate` must be above 0 [Hz], got {rate}")
    refs = dataset.refs
    if dataset.recording.stamped:
        return np.array([ref.stamp for ref in refs], np.float64)
    for frame in dataset:
        try:
            if frame.scan.stamp is not None:
                return None
            break  # the first that can be read decides
        except _UNREADABLE:
            continue
    numbers = frame_numbers([ref.name for ref in refs])
    return (np.arange(len(refs)) if numbers is None else numbers) / rate


def _stamps(dataset: Dataset, rate: float, progress: Progress) -> NDArray[np.float64]:
    """Return when the scans were taken [s], NaN where one cannot be read, or has no stamp."""
    if (clock := _clock(dataset, rate)) is not None:
        return clock
    stamps = np.full(len(dataset), np.nan)
    for k in progress(range(len(dataset))):
        try:
            stamps[k] = dataset[k].scan.stamp
        except _UNREADABLE:
            continue  # the mapping reports it
    return stamps


def _counted(has: NDArray[np.bool_]) -> str:
    if has.all():
        return f"{len(has)} scans"
    return f"{np.count_nonzero(has)} of {len(has)} scans have a pose"


def _span(values: NDArray[Any]) -> str:
    return f"{values.min():.15g} ... {values.max():.15g}" if len(values) else "none"
