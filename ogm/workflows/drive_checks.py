"""Checks of a drive that read no points: topics, stamps, rates, poses, frames, damage."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ogm.datasets import Dataset
from ogm.datasets.log_scans import PACKET_TYPES, scan_topics
from ogm.io.logs import LogReader
from ogm.io.scan_table import rotation_to_flu
from ogm.pose import pose, tilt_of
from ogm.workflows.findings import Finding, counted, listed

_UNREAD = (  # types of range measurements that are not read
    "sensor_msgs/msg/PointCloud", *PACKET_TYPES,
)  # fmt: skip
_GAP = 1.5  # intervals between two scans, above which some are missing
_LONG = 2.0  # [s] gap that transforms are not interpolated over
_SPEED = 70.0  # [m/s] that no vehicle exceeds, as mappers have it
_WAY = 5.0  # [m] from which on the direction of a drive is known
_BACK = 0.3  # [m] between two scans, from which on a way back is no noise
_JUMP = 5.0  # usual steps, above which one is no motion
_LATE = 1e-3  # [s] between a scan and its transforms in a log
_LEVEL = math.radians(2)
_STEEP = math.radians(15)  # beyond the slope of any road


def check_frames(dataset: Dataset) -> Iterator[Finding]:
    """Yield findings about stamps, poses and damage of a drive; no scan is read.

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
        how = dataset.facts.get("poses") or "the scans have none"
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
    """Yield a finding about transforms that were recorded after the scans that need them."""
    late = delays[delays > _LATE]
    if len(late):
        text = (
            f"those of {counted(len(late), len(delays))} are recorded after them, by {np.median(late):.3g} s (median)"
        )
        way = f"`ogm fuse` reads all first; a live node must wait {late.max():.3g} s for them"
        yield Finding("note", "late transforms", f"{text}, {late.max():.3g} s at most", way)


def _check_rate(parts: list[list[float]]) -> Iterator[Finding]:
    """Yield findings about the stamps of each part of a drive."""
    number = sum(map(len, parts))
    if many := number - sum(len({*stamps}) for stamps in parts):
        yield Finding("lost data", "duplicates", f"{counted(many, number)} with the stamp of another")
    steps = np.concatenate([np.diff(np.unique(stamps)) for stamps in parts] or [np.empty(0)])
    if len(steps) < 2:
        return
    usual = float(np.median(steps))
    gaps = steps[steps > _GAP * usual]
    missing = int(np.round(gaps / usual - 1).sum())
    if missing:
        text = f"about {missing} scans are missing in {len(gaps)} gaps, the longest of {gaps.max():.3g} s"
        yield Finding("lost data", "gaps", text, "record with a larger buffer" if gaps.max() < _LONG else "")
    yield Finding(
        "note", "rate", f"{1 / usual:.1f} Hz, {number} scans in {sum(np.ptp(stamps) for stamps in parts):.1f} s"
    )


def _check_jumps(dataset: Dataset) -> Iterator[Finding]:
    rows = [(ref.stamp, ref.T_map_sensor[:3, 3]) for ref in dataset.refs if ref.stamp and ref.T_map_sensor is not None]
    if len(rows) < 2:
        return
    seconds = np.abs(np.diff([stamp for stamp, _ in rows]))
    metres = np.linalg.norm(np.diff([place for _, place in rows], axis=0), axis=1)
    steps = np.diff([place for _, place in rows], axis=0)
    back = (steps[1:] * steps[:-1]).sum(axis=1) < -0.5 * metres[1:] * metres[:-1]
    back &= (metres[1:] > _BACK) & (metres[:-1] > _BACK)
    if np.count_nonzero(back) > max(2, 0.1 * len(back)):
        often = counted(int(np.count_nonzero(back)), len(back), "step")
        text = f"they go back and forth by {np.median(metres[1:][back]):.3g} m in {often}"
        yield Finding("wrong map", "poses", text, "two senders of one transform? record one, or --odometry kiss-icp")
    jumps = np.flatnonzero(metres > _SPEED * seconds + 1.0)
    if len(jumps):
        text = f"{len(jumps)} jumps of the pose, the farthest of {metres[jumps].max():.3g} m: scans there are skipped"
        yield Finding("lost data", "poses", text, "--frame odom is free of jumps where map has them")


def check_tilt_of_poses(dataset: Dataset, numbers: list[int]) -> Iterator[Finding]:
    """Yield findings about scans that are levelled, and about poses that tilt more than any road afterwards.

    Parameters
    ----------
    dataset : Dataset
    numbers : list of int
        Frames that can be read.
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
    if tilts and (tilt := float(np.median(tilts))) > _STEEP:
        text = f"the poses tilt the vehicle by {np.degrees(tilt):.0f} degrees, but the ground in its scans is level"
        yield Finding("wrong map", "tilt", text, "poses need a frame with z up: --frame, or --axes for files")


def check_direction(dataset: Dataset) -> Iterator[Finding]:
    """Yield a finding where the poses move the vehicle across its x axis, which points forward.

    Parameters
    ----------
    dataset : Dataset
        One drive. Driving backwards is no finding.
    """
    recording, turns = dataset.recording, dict[str, NDArray[np.float64]]()
    last: dict[tuple[str, str], NDArray[np.float64]] = {}
    steps = [np.zeros(2)]  # [m] along the axes of the vehicle
    for ref, n in zip(dataset.refs, dataset.numbers, strict=True):
        if (T := ref.T_map_sensor) is None:
            continue
        place = recording.place(n)
        if place.name not in turns:
            turns[place.name] = pose(yaw=place.yaw)[:3, :3] @ recording.levelling(n)
        key = ref.sequence, place.name
        if key in last:
            steps.append((turns[place.name] @ T[:3, :3].T @ (T[:3, 3] - last[key]))[:2])
        last[key] = T[:3, 3]
    metres = np.linalg.norm(steps, axis=1)
    usual = float(np.median(metres[metres > 0])) if metres.any() else 0.0
    x, y = np.sum(np.array(steps)[metres <= _JUMP * usual], axis=0).tolist()
    if math.hypot(x, y) < _WAY or abs(y) <= abs(x):
        return
    side = math.copysign(1.0, y)
    R = np.array([[0, side, 0], [-side, 0, 0], [0, 0, 1]]) @ rotation_to_flu(recording.axes)
    axes = ",".join(("-" if row.sum() < 0 else "+") + "xyz"[np.abs(row).argmax()] for row in R)
    text = f"the vehicle moves {math.hypot(x, y):.0f} m by its poses to its {'left' if y > 0 else 'right'}, not along x"
    yield Finding("wrong map", "axes", text, f"--axes={axes}, or the yaw of the sensor's mount by --sensors")


def check_topics(log: LogReader, used: tuple[str, ...]) -> Iterator[Finding]:
    """Yield findings about topics of a log that are left out.

    Parameters
    ----------
    log : LogReader
    used : tuple of str
        Topics whose scans are checked.
    """
    filled = {name: facts.type for name, facts in log.topics.items() if facts.count}
    if others := [name for name in scan_topics(log) if name not in used]:
        yield Finding("note", "topics", f"scans of {listed(others)} are left out", f"--topic {others[0]}")
    if unread := [f"{name} ({kind})" for name, kind in filled.items() if kind in _UNREAD]:
        yield Finding("note", "topics", f"{listed(unread)} cannot be read")
