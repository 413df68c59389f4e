"""A drive on flat ground towards a wall across the way, as files of scans and poses."""

from pathlib import Path

import numpy as np

from ogm.io import write_poses
from ogm.pose import Trajectory, inverse, transform_points

HEIGHT, WALL = 1.7, 10.0  # [m] of the lidar, and to the wall


def world() -> np.ndarray:
    """Return points of the ground, and of the wall, with intensities."""
    rng = np.random.default_rng(0)
    ground, wall = rng.uniform(-20, 20, (20_000, 4)), rng.uniform(-12, 12, (4000, 4))
    ground[:, 0], ground[:, 2] = np.minimum(ground[:, 0], WALL), -HEIGHT
    wall[:, 0], wall[:, 2] = WALL + 0.25, rng.uniform(-HEIGHT, 0.5, len(wall))
    points = np.concatenate([ground, wall])
    points[:, 3] = 0.5
    return points


def write_scans(folder: Path, points: np.ndarray, poses: np.ndarray, name: str = "{}.bin", first: int = 0) -> Path:
    """Write what a lidar at each pose scans of points of a map; return the folder."""
    for k, T in enumerate(poses, first):
        transform_points(inverse(T), points).astype(np.float32).tofile(folder / name.format(k))
    return folder


def write_drive(folder: Path, poses: np.ndarray, stamps: np.ndarray) -> Path:
    """Write a scan for each pose, ``0.bin`` and so on, and ``poses.csv``; return the folder."""
    write_scans(folder, world(), poses)
    write_poses(folder / "poses.csv", Trajectory(stamps, poses), np.arange(len(poses)))
    return folder


def write_kitti(path: Path, poses: np.ndarray, first: int | None = 5) -> Path:
    """Write poses as a file of KITTI, each after the number of its frame unless `first` is None."""
    rows = [" ".join(map(repr, T[:3].ravel().tolist())) for T in poses]
    lines = rows if first is None else [f"{k + first} {row}" for k, row in enumerate(rows)]
    path.write_text("\n".join(lines) + "\n")
    return path
