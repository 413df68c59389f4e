"""A hall with two pillars and what a planar laser measures in it, to try maps of buildings without any data.

from hall import drive, write_log, write_robot_log
"""

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from ogm.pose import inverse, pose

WALLS = np.array(  # from, to: a hall with two pillars and an alcove [m]
    [
        [[0, 0], [12, 0]], [[12, 0], [12, 8]], [[12, 8], [7, 8]], [[7, 8], [7, 9.5]], [[7, 9.5], [4, 9.5]],
        [[4, 9.5], [4, 8]], [[4, 8], [0, 8]], [[0, 8], [0, 0]],
        *([[x, y], [x + a, y + b]] for x, y in ((3, 3), (8.5, 4.5)) for a, b in ((0.6, 0), (0, 0.6))),
    ]
)  # fmt: skip
AZIMUTH = np.radians(np.arange(-90, 91, 1.0))  # of the beams


def distances(T: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the ranges of a planar laser at a pose, (181,) [m], with noise of 10 mm."""
    yaw = math.atan2(T[1, 0], T[0, 0])
    d = np.stack([np.cos(AZIMUTH + yaw), np.sin(AZIMUTH + yaw)], axis=1)[:, None]
    start, along = WALLS[:, 0] - T[:2, 3], WALLS[:, 1] - WALLS[:, 0]
    cross = d[..., 0] * along[:, 1] - d[..., 1] * along[:, 0]
    reach = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / cross
    at = (start[:, 0] * d[..., 1] - start[:, 1] * d[..., 0]) / cross
    reach = np.where((reach > 0) & (at >= 0) & (at <= 1), reach, np.inf).min(axis=1)
    return np.asarray(reach + rng.normal(0, 0.01, len(reach)))


def cast(T: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float32]:
    """Return the echoes of the laser at a pose, (N, 3), in its frame."""
    reach = distances(T, rng)
    return np.stack([reach * np.cos(AZIMUTH), reach * np.sin(AZIMUTH), 0 * reach], axis=1).astype(np.float32)


def drive(count: int) -> NDArray[np.float64]:
    """Return poses on an ellipse around the pillars, (K, 4, 4), at a height of 0.3 m."""
    a = np.linspace(0, 1.8 * np.pi, count)
    heading = np.arctan2(2.2 * np.cos(a), -4.2 * np.sin(a))
    return np.array(
        [pose(6 + 4.2 * np.cos(t), 4 + 2.2 * np.sin(t), 0.3, yaw=h) for t, h in zip(a, heading, strict=True)]
    )


def noisy(poses: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the poses of an odometry whose noise is 5 % of the distance and 2 degrees per metre."""
    found = [poses[0]]
    for before, after in zip(poses[:-1], poses[1:], strict=True):
        step = inverse(before) @ after
        d = math.hypot(step[0, 3], step[1, 3])
        x, y, yaw = rng.normal(0, (0.05 * d, 0.05 * d, math.radians(2) * d))
        found.append(found[-1] @ step @ pose(x, y, yaw=yaw))
    return np.array(found)


def write_log(path: Path, poses: NDArray[np.float64], seed: int = 0) -> Path:
    """Write the scans at some poses as a CARMEN log, 0.5 s apart."""
    rng, lines = np.random.default_rng(seed), []
    for k, T in enumerate(poses):
        ranges = distances(T, rng)
        place = f"{T[0, 3]:.6f} {T[1, 3]:.6f} {math.atan2(T[1, 0], T[0, 0]):.6f}"
        beams = " ".join(f"{r:.3f}" for r in ranges)
        lines.append(f"FLASER {len(ranges)} {beams} {place} {place} {0.5 * k + 100:.3f} host {0.5 * k:.3f}")
    path.write_text("\n".join(lines) + "\n")
    return path


def write_robot_log(path: str, count: int = 200) -> None:
    """Write the log of a robot, .mcap, .db3 or .bag: LaserScans at 10 Hz, and odometry with noise."""
    from ogm.io.logs import LogWriter  # only now: the hall needs no packages of logs
    from ogm.io.messages import StampedTransform, tf_message

    TF, LASER = "tf2_msgs/msg/TFMessage", "sensor_msgs/msg/LaserScan"
    T_base_laser, rng = pose(z=0.3), np.random.default_rng(1)
    poses = drive(count)
    with LogWriter(path) as log:
        mount = StampedTransform("base_link", "laser", 100.0, T_base_laser)
        log.write("/tf_static", TF, tf_message([mount]), 100.0)
        for k, (T, T_odom_laser) in enumerate(zip(poses, noisy(poses, rng), strict=True)):
            stamp = 100.0 + 0.1 * k
            moved = StampedTransform("odom", "base_link", stamp, T_odom_laser @ inverse(T_base_laser))
            log.write("/tf", TF, tf_message([moved]), stamp)
            time = SimpleNamespace(sec=int(stamp), nanosec=round(stamp % 1 * 1e9))
            scan = SimpleNamespace(
                header=SimpleNamespace(stamp=time, frame_id="laser"), ranges=distances(T, rng).astype(np.float32),
                angle_min=AZIMUTH[0], angle_max=AZIMUTH[-1], angle_increment=AZIMUTH[1] - AZIMUTH[0],
                time_increment=0.0, scan_time=0.1, range_min=0.1, range_max=30.0, intensities=np.empty(0, np.float32),
            )  # fmt: skip
            log.write("/scan", LASER, scan, stamp)
