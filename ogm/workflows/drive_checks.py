"""Checks of a drive without reading points: topics, stamps, rates, poses, frames, damage."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ogm.datasets import Dataset
from ogm.datasets.log_scans import PACKET_TYPES, scan_topics
from ogm.io.logs import LogReader
from ogm.io.scan_table import axes_text, rotation_to_flu
from ogm.pose import pose, tilt_of
from ogm.workflows.findings import Finding, counted, listed

_UNREAD = ("sensor_msgs/msg/PointCloud", *PACKET_TYPES)  # types of range measurements that are not read
_GAP = 1.5  # usual intervals; scans are missing in longer intervals
_LONG_GAP = 2.0  # [s] longest gap in which transforms are interpolated
_MAX_SPEED = 70.0  # [m/s] of a vehicle, as in mappers
_MIN_PATH = 5.0  # [m] to determine the direction of a drive
_MIN_STEP = 0.3  # [m] between two scans; a shorter step back can be noise
_JUMP = 5.0  # usual steps; a longer step is no motion
_MIN_DELAY = 1e-3  # [s] of transforms after their scan in a log
_LEVEL = math.radians(2)
_MAX_SLOPE = math.radians(15)  # beyond the slope of any road


def check_frames(dataset: Dataset) -> Iterator[Finding]:
    """Yield findings about stamps, poses and damage of a drive, without reading scans.

    Parameters
    ----------
    dataset : Dataset
        One drive.
    """
    refs, recording = dataset.refs, dataset.recording
    if recording.warnings:
        yield Finding("lost data", "damage", listed([str(warning) for warning in recording.warnings]))
    for fault in recording.clock_findings:
        severity = "wrong map" if fault.kind == "clock offset" else "lost data"
        yield Finding(severity, "clock", f"{fault.where}: {fault.fault}", fault.way_out)
    for text, way in recording.frame_notes:
        yield Finding("wrong map" if way else "note", "frames", text, way)
    posed = [ref for ref in refs if ref.T_map_sensor is not None]
    if len(posed) < len(refs):
        how = dataset.facts.get("poses") or "the dataset has none"
        way = "--odometry kiss-icp estimates them, --poses FILE gives them" if not posed else ""
        yield Finding("lost data", "poses", f"{counted(len(refs) - len(posed), len(refs))} without a pose: {how}", way)
    parts: dict[str, list[float]] = {}
    for ref in refs:
        if ref.stamp is not None:
            parts.setdefault(ref.sequence, []).append(ref.stamp)
    yield from _check_rate(list(parts.values()))
    yield from _check_jumps(dataset)
    if recording.transform_delays is not None and len(refs):
        yield from _check_delays(recording.transform_delays[list(dataset.numbers)])


def _check_delays(delays: NDArray[np.float64]) -> Iterator[Finding]:
    """Yield a finding about transforms recorded after their scans."""
    late = delays[delays > _MIN_DELAY]
    if len(late):
        text = f"for {counted(len(late), len(delays))}, recorded {np.median(late):.3g} s after the scan (median)"
        way = f"`ogm fuse` reads all first; a live node must wait {late.max():.3g} s for them"
        yield Finding("note", "late transforms", f"{text}, {late.max():.3g} s at most", way)


def _check_rate(parts: list[list[float]]) -> Iterator[Finding]:
    """Yield findings about the stamps of each part of a drive."""
    number = sum(map(len, parts))
    if many := number - sum(len({*stamps}) for stamps in parts):
        yield Finding("lost data", "duplicates", f"{counted(many, number)} with the stamp of another scan")
    steps = np.concatenate([np.diff(np.unique(stamps)) for stamps in parts] or [np.empty(0)])
    if len(steps) < 2:
        return
    usual = float(np.median(steps))
    gaps = steps[steps > _GAP * usual]
    missing = int(np.round(gaps / usual - 1).sum())
    if missing:
        text = f"about {missing} scans are missing in {len(gaps)} gaps, the longest of {gaps.max():.3g} s"
        yield Finding("lost data", "gaps", text, "record with a larger buffer" if gaps.max() < _LONG_GAP else "")
    yield Finding("note", "rate", f"{1 / usual:.1f} Hz, {number} scans in {sum(map(np.ptp, parts)):.1f} s")


def _check_jumps(dataset: Dataset) -> Iterator[Finding]:
    rows = [(ref.stamp, ref.T_map_sensor[:3, 3]) for ref in dataset.refs if ref.stamp and ref.T_map_sensor is not None]
    if len(rows) < 2:
        return
    seconds = np.abs(np.diff([stamp for stamp, _ in rows]))
    steps = np.diff([position for _, position in rows], axis=0)
    metres = np.linalg.norm(steps, axis=1)
    back = (steps[1:] * steps[:-1]).sum(axis=1) < -0.5 * metres[1:] * metres[:-1]
    back &= (metres[1:] > _MIN_STEP) & (metres[:-1] > _MIN_STEP)
    if np.count_nonzero(back) > max(2, 0.1 * len(back)):
        count = counted(int(np.count_nonzero(back)), len(back), "step")
        text = f"they alternate back and forth by {np.median(metres[1:][back]):.3g} m in {count}"
        way = "if two nodes send the transform, record only one of them; or --odometry kiss-icp"
        yield Finding("wrong map", "poses", text, way)
    jumps = np.flatnonzero(metres > _MAX_SPEED * seconds + 1.0)
    if len(jumps):
        text = f"{len(jumps)} jumps of the pose, the longest of {metres[jumps].max():.3g} m: scans there are skipped"
        yield Finding("lost data", "poses", text, "--frame odom, if only map has jumps")


def check_tilt_of_poses(dataset: Dataset, numbers: list[int]) -> Iterator[Finding]:
    """Yield findings about levelled scans, and about poses that still tilt the vehicle more than any road.

    Parameters
    ----------
    dataset : Dataset
    numbers : list of int
        Readable frames.
    """
    tilts, used = [], []
    for n in numbers:
        frame = dataset[n]
        if frame.T_map_sensor is not None:
            T = np.eye(4)
            T[:3, :3] = frame.T_map_sensor[:3, :3] @ frame.mount.T_vehicle_sensor[:3, :3].T
            tilts.append(tilt_of(T))
            used.append(tilt_of(frame.mount.T_vehicle_sensor))
    if used and (tilt := float(np.median(used))) > _LEVEL:
        yield Finding("note", "tilt", f"scans are levelled by {np.degrees(tilt):.0f} degrees, by their poses or mount")
    if tilts and (tilt := float(np.median(tilts))) > _MAX_SLOPE:
        text = f"the poses tilt the vehicle by {np.degrees(tilt):.0f} degrees, but the ground in its scans is level"
        yield Finding("wrong map", "tilt", text, "give poses in a frame with z up: --frame, or --axes for files")


def check_direction(dataset: Dataset) -> Iterator[Finding]:
    """Yield a finding if the poses move the vehicle sideways instead of along its x axis.

    Parameters
    ----------
    dataset : Dataset
        One drive. Driving backwards is allowed.
    """
    recording, turns = dataset.recording, dict[str, NDArray[np.float64]]()
    last: dict[tuple[str, str], NDArray[np.float64]] = {}
    steps = [np.zeros(2)]  # [m] along the axes of the vehicle
    for ref, n in zip(dataset.refs, dataset.numbers, strict=True):
        if (T := ref.T_map_sensor) is None:
            continue
        mount = recording.place(n)
        if mount.name not in turns:
            turns[mount.name] = pose(yaw=mount.yaw)[:3, :3] @ recording.levelling(n)
        key = ref.sequence, mount.name
        if key in last:
            steps.append((turns[mount.name] @ T[:3, :3].T @ (T[:3, 3] - last[key]))[:2])
        last[key] = T[:3, 3]
    metres = np.linalg.norm(steps, axis=1)
    usual = float(np.median(metres[metres > 0])) if metres.any() else 0.0
    x, y = np.sum(np.array(steps)[metres <= _JUMP * usual], axis=0).tolist()
    if math.hypot(x, y) < _MIN_PATH or abs(y) <= abs(x):
        return
    side = math.copysign(1.0, y)
    R = np.array([[0, side, 0], [-side, 0, 0], [0, 0, 1]]) @ rotation_to_flu(recording.axes)
    text = f"the vehicle moves {math.hypot(x, y):.0f} m by its poses to its {'left' if y > 0 else 'right'}, not along x"
    yield Finding("wrong map", "axes", text, f"--axes={axes_text(R)}, or the yaw of the sensor's mount by --sensors")


def check_topics(log: LogReader, used: tuple[str, ...]) -> Iterator[Finding]:
    """Yield findings about unused topics of a log.

    Parameters
    ----------
    log : LogReader
    used : tuple of str
        Checked topics.
    """
    filled = {name: facts.type for name, facts in log.topics.items() if facts.count}
    if others := [name for name in scan_topics(log) if name not in used]:
        yield Finding("note", "topics", f"scans of {listed(others)} are left out", f"--topic {others[0]}")
    if unread := [f"{name} ({kind})" for name, kind in filled.items() if kind in _UNREAD]:
        yield Finding("note", "topics", f"{listed(unread)} cannot be read")
