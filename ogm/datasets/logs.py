"""Logs: the lidar scans of ROS bags and MCAPs, with the poses that transforms or odometry in them give."""

import logging
from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.layout import Layout, RawFrame
from ogm.datasets.log_scans import CLOUD, LIDAR_TYPES, LogScans
from ogm.datasets.log_transforms import LogTransforms
from ogm.datasets.paths import ending_of
from ogm.io import Axes
from ogm.io.axes import rotation_to_flu
from ogm.io.logs import LOG_ENDINGS, LogMessage, open_log
from ogm.io.logs.opening import log_files
from ogm.io.messages import scan_from_livox, scan_from_point_cloud2, scan_from_velodyne_scan
from ogm.pose import pose, rotate
from ogm.scan import Scan
from ogm.storage.files import OgmError

__all__ = ["describe_log", "is_log", "logs", "turn_scan"]

_log = logging.getLogger(__name__)

_LABELS = "poses of the scans (transforms or odometry in the log)"


def is_log(paths: Sequence[Path]) -> bool:
    """Tell whether paths are logs by their names: files, or one folder of such, without scans and other folders."""
    if len(paths) == 1 and paths[0].is_dir():
        other = any(one.is_dir() or ending_of(one) for one in paths[0].iterdir())
        return not other and bool(log_files(paths[0]))
    return bool(paths) and all(path.suffix.lower() in LOG_ENDINGS for path in paths)


def logs(
    paths: Sequence[Path],
    topic: str | Iterable[str] = (),
    frame: str | None = None,
    sensor_position: tuple[float, float, float] | None = None,
    axes: Axes = "flu",
    intensity_max: float | None = None,
    time_unit: float | None = None,
) -> Layout:
    """Line up the scans of a log by the stamps of their headers.

    Points are turned to the axes of the vehicle (base_link) where transforms state them. Several lidars give frames
    in the vehicle's frame, each with its place in it.

    Parameters
    ----------
    paths : sequence of Path
        One log: a file, its parts, or their folder.
    topic : str or iterable of str
        Of lidars; by default the only one.
    frame : str, optional
        See `LogTransforms.fixed_frame`.
    sensor_position : (x, y, z), optional
        Of the sensor in the frame of the points [m], where that is the vehicle's.
    axes, intensity_max, time_unit
        As for `ogm.io.read_scan`.

    Raises
    ------
    OgmError
        If a topic or frame is not there, several topics have scans and none is chosen, or the file is no log.
    """
    log = open_log(paths)
    scans = LogScans(log, topic)
    for warning in scans.warnings:
        _log.warning("%s", warning)
    several = len(scans.topics) > 1
    if scans.types != {CLOUD} and (intensity_max is not None or time_unit is not None):
        raise ValueError(f"{log.paths[0]} has scans of known units; leave out intensity_max and time_unit")
    if several and sensor_position is not None:
        raise ValueError("sensor_position (--sensor-position) is for the points of one lidar; choose one topic")
    poses, facts = scans.poses(frame)
    if sensor_position is None:
        turns, places = _turns(scans, axes), scans.places()
        poses[:, :3, :3] = poses[:, :3, :3] @ np.swapaxes(turns, 1, 2)
    else:
        turns, places = np.tile(rotation_to_flu(axes), (len(scans), 1, 1)), None
        poses[:, :3, :3] = poses[:, :3, :3] @ np.swapaxes(turns, 1, 2)
        poses = poses @ pose(*sensor_position)

    def read(n: int) -> RawFrame:
        message = log.message(scans[n].ref)
        try:
            scan = _scan(message, intensity_max, time_unit)
        except OgmError as error:
            raise OgmError(f"{log.paths[scans[n].ref.file]}: {error}") from error
        return RawFrame(turn_scan(replace(scan, sensor=scans[n].frame), turns[n]))

    stated = places is not None and places[0].height is not None
    return Layout(
        f"log, {log.format}",
        scans.frame_refs(poses),
        read,
        _LABELS,
        sensor_height=(lambda n: places[n].height or 0.0) if places and stated else None,
        place=None if places is None else places.__getitem__,
        truth=_refuse_truth if several else None,
        ego_footprint=None,
        stamped=not np.isnan(scans.stamps).any(),
        axes=axes,
        known_axes=False,
        motion_distorted=not several,
        name=scans.name,
        files=log.paths,
        facts={"format": log.format, "frames": len(scans), "topics": list(scans.topics), **facts},
    )


def describe_log(path: Path, frame: str | None = None) -> dict[str, str]:
    """Return what a log holds, and what lacks for maps of its scans, as names and values to print.

    Parameters
    ----------
    path : Path
    frame : str, optional
        See `LogTransforms.fixed_frame`.
    """
    log = open_log(path)
    stamps = [t for facts in log.topics.values() for t in (facts.first, facts.last) if facts.count]
    found = {"format": log.format, "files": ", ".join(one.name for one in log.paths)}
    if stamps:
        found["recorded"] = f"{max(stamps) - min(stamps):.1f} s, {_date(min(stamps))} to {_date(max(stamps))}"
    for name, facts in log.topics.items():
        rate = "" if np.isnan(facts.rate) else f", {facts.rate:.1f} Hz"
        found[name] = f"{facts.type}, {facts.count} message{'s' * (facts.count != 1)}{rate}"
    lidars = [name for name, facts in log.topics.items() if facts.type in LIDAR_TYPES and facts.count]
    scans = {name: LogScans(log, name) for name in lidars}
    transforms = next((one.transforms for one in scans.values()), None) or LogTransforms(log)
    pairs = transforms.buffer.pairs.items()
    found["transforms"] = ", ".join(f"{a} <- {b}{' (static)' * static}" for (a, b), static in pairs) or "none"
    for name, one in scans.items():
        try:
            poses = one.poses(frame)[1]["poses"]
        except OgmError as error:
            poses = str(error)
        found[f"poses of {name}"] = f"{poses} (see `ogm fuse --odometry`)" if poses.startswith("none") else poses
    damage = [warning for one in scans.values() for warning in one.warnings] or log.warnings
    if damage:
        found["damage"] = "; ".join(dict.fromkeys(damage))
    return found


def _date(stamp: float) -> str:
    """Return a time as a date, or in seconds where it is no time since 1970."""
    try:
        return f"{datetime.fromtimestamp(stamp, UTC):%Y-%m-%d %H:%M:%S} UTC" if stamp > 1e8 else f"{stamp:.3f} s"
    except (ValueError, OverflowError, OSError):
        return f"{stamp:.3f} s"


def _scan(message: LogMessage, intensity_max: float | None, time_unit: float | None) -> Scan:
    """Return the scan of a message of any of `LIDAR_TYPES`."""
    if message.type == CLOUD:
        return scan_from_point_cloud2(message.decode(), intensity_max=intensity_max, time_unit=time_unit)
    if message.type.endswith("/CustomMsg"):
        return scan_from_livox(message.raw)
    return scan_from_velodyne_scan(message.decode())


def _turns(scans: LogScans, axes: Axes) -> NDArray[np.float64]:
    """Return the rotation of each scan's points to x forward, y left, z up, (K, 3, 3)."""
    turn, T = rotation_to_flu(axes), scans.T_vehicle_sensor
    if T is None:
        return np.tile(turn, (len(scans), 1, 1))
    if not np.array_equal(turn, np.eye(3)):
        raise ValueError(f"the transforms of {scans.path} state the axes of its points; leave out axes (--axes)")
    return T[:, :3, :3]


def turn_scan(scan: Scan, R: NDArray[np.float64]) -> Scan:
    """Return a scan in other axes.

    Parameters
    ----------
    scan : Scan
    R : (3, 3) float64
        Takes its coordinates to the other axes.
    """
    if np.array_equal(R, np.eye(3)):
        return scan
    points = scan.points.copy()
    points[:, :3] = rotate(R, points[:, :3].T).T
    no_returns = None if scan.no_returns is None else rotate(R, scan.no_returns.T).T.astype(np.float32)
    return replace(scan, points=points, no_returns=no_returns)


def _refuse_truth(n: int) -> Any:
    raise OgmError("truth is not made of the scans of several lidars: choose one topic (--topic)")
