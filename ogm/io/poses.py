"""Poses in and out: KITTI, KITTI-360, TUM and a format of our own that explains itself."""

import logging
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.files import atomic_write
from ogm.io.rows import NAMES, OURS, WANTED, check_stamps, numbers_of, read_rows, whole_numbers
from ogm.pose import Trajectory, check_pose, inverse

__all__ = ["Poses", "read_poses", "write_poses"]

log = logging.getLogger(__name__)

_KINDS = {8: "TUM", 12: "KITTI", 13: "KITTI-360", 16: "4x4", 17: "KITTI-360 4x4"}
_ROUNDED = 2e-3  # departure of R'R from the identity that rounding to three decimals can make
_UNIT = 1e-2  # departure of a quaternion from length 1 that rounding can make
_CAMERA_SHARE = 0.9  # of the path goes along the frame's own z axis: nothing but a camera drives so
_CAMERA_PATH = 1.0  # [m] of path before that is said


@dataclass(frozen=True, eq=False)
class Poses:
    """What a file of poses holds.

    Parameters
    ----------
    poses : (K, 4, 4) float64
        ``T_map_sensor``.
    stamps : (K,) float64 or None
        Their times [s], increasing; None where the file has none.
    numbers : (K,) int64 or None
        The frame numbers of the scans they belong to, increasing; None where the file has none: then pose k
        belongs to the k-th scan.
    format : str
        What the file is, in words.
    """

    poses: NDArray[np.float64]
    stamps: NDArray[np.float64] | None = None
    numbers: NDArray[np.int64] | None = None
    format: str = ""

    def __len__(self) -> int:
        return len(self.poses)

    def trajectory(self, rate: float | None = None) -> Trajectory:
        """Return the poses with times.

        Parameters
        ----------
        rate : float, optional
            Scans per second [1/s]. Only for files without stamps, whose times become frame number / rate, or
            k / rate where there are no frame numbers; stamps of a file are never overruled.

        Raises
        ------
        ValueError
            If there are neither stamps nor a rate, or the rate is not above 0.
        """
        if self.stamps is not None:
            return Trajectory(self.stamps, self.poses)
        if rate is None:
            raise ValueError(
                f"these poses ({self.format}) have no stamps: give the rate of the scans [1/s], for most lidars 10"
            )
        if not 0 < rate < np.inf:
            raise ValueError(f"rate must be above 0 [1/s], got {rate}")
        counted = np.arange(len(self)) if self.numbers is None else self.numbers
        return Trajectory(counted / rate, self.poses)


def read_poses(path: str | os.PathLike[str], *, T_camera_sensor: ArrayLike | None = None) -> Poses:
    """Read the poses of a drive.

    The number of columns tells the kind: 12 is KITTI odometry (the upper three rows of a 4x4 pose, row by
    row), 13 KITTI-360 (the frame number before them), 16 and 17 the same with the fourth row, 8 TUM (stamp,
    position, quaternion with w last). Columns stand apart by blanks; what follows ``#`` is a comment. A
    ``.csv`` has the header ``stamp,x,y,z,qx,qy,qz,qw``, in any order, and perhaps a column ``number``. Each
    may be packed as ``.xz`` or ``.gz``.

    Rotations that are rounded, to three decimals at least, become the nearest true ones.

    Parameters
    ----------
    path : path
        The file.
    T_camera_sensor : (4, 4) array, optional
        Where the file tells the poses of another part of the vehicle than the lidar, as KITTI does of its
        camera 0: takes the lidar's coordinates to that part's, see `read_calibration`. The map is then the
        lidar's frame where the file has its origin: x forward, y left, z up. The identity says that the poses
        are the lidar's.

    Returns
    -------
    Poses

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is empty or no text; if a row is ragged, no numbers, not finite or not rigid; if stamps or
        frame numbers repeat or go backwards; if the poses are plainly those of a camera (they move along
        their own z axis) and `T_camera_sensor` is not given. The line is named.
    """
    path = Path(path)
    lines, header, ours = read_rows(path)
    columns = len(header) if header else len(lines[0][1])
    if not header and columns not in _KINDS:
        raise ValueError(f"line {lines[0][0]} of {path} has {columns} columns, wanted {WANTED}")
    where = np.array([line for line, _ in lines])
    table = numbers_of(path, lines, columns)
    stamps, numbers = None, None
    if header:
        order = [header.index(name) for name in NAMES]
        stamps, poses = table[:, order[0]], _from_quaternions(path, where, table[:, order[1:]])
        if "number" in header:
            numbers = whole_numbers(path, where, table[:, header.index("number")])
    elif columns == 8:
        stamps, poses = table[:, 0], _from_quaternions(path, where, table[:, 1:])
    else:
        if columns in (13, 17):
            numbers, table = whole_numbers(path, where, table[:, 0]), table[:, 1:]
        poses = _from_rows(path, where, table)
    kind = OURS if ours else "csv" if header else _KINDS[columns]
    if stamps is not None:
        check_stamps(path, where, stamps)
    if T_camera_sensor is not None:
        if ours:
            raise ValueError(f"{path} tells the sensor's own poses ({OURS}): leave T_camera_sensor out")
        T = check_pose(T_camera_sensor, "T_camera_sensor")
        poses = inverse(T) @ poses @ T
    elif not ours:
        _refuse_camera(path, poses)
    return Poses(poses, stamps, numbers, kind)


def write_poses(
    path: str | os.PathLike[str], trajectory: Trajectory, numbers: ArrayLike | None = None
) -> None:
    """Write poses with their stamps, in full precision; the file appears when it is whole.

    Parameters
    ----------
    path : path
        ``.csv``: our own format, with a comment and a header that explain it. ``.txt`` or ``.tum``: TUM.
    trajectory : Trajectory
        ``T_map_sensor`` and their times.
    numbers : (K,) integers, optional
        The frame numbers of the scans, increasing; only for ``.csv``.

    Raises
    ------
    ValueError
        If the ending is another one, or the numbers do not fit.
    OSError
        If the file cannot be written.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in (".csv", ".txt", ".tum"):
        raise ValueError(f"cannot write poses to {path}: name it .csv (ours), .txt or .tum (TUM)")
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(trajectory.poses[:, :3, :3]).as_quat()
    rows = np.column_stack([trajectory.stamps, trajectory.poses[:, :3, 3], quaternions]).tolist()
    names = list(NAMES)
    if numbers is not None:
        counted = np.asarray(numbers)
        if ending != ".csv":
            raise ValueError(f"TUM files have no frame numbers, got some for {path}: name it .csv")
        if counted.shape != (len(trajectory),) or counted.dtype.kind not in "iu":
            raise ValueError(
                f"numbers must be {len(trajectory)} integers, got {counted.dtype} of shape {counted.shape}"
            )
        if not (np.diff(counted.astype(np.int64)) > 0).all():
            raise ValueError("frame numbers must increase")
        names.append("number")
        rows = [[*row, number] for row, number in zip(rows, counted.tolist(), strict=True)]
    comma = ending == ".csv"
    with atomic_write(path, "w") as file:
        if comma:
            file.write(
                f"# {OURS}: T_map_sensor, the sensor's pose in the map at each stamp [s]; position x y z [m] and\n"
                "# rotation as a unit quaternion take sensor coordinates (x forward, y left, z up) to the map's\n"
            )
            file.write(",".join(names) + "\n")
        else:
            file.write("# " + " ".join(names) + "\n")
        for row in rows:
            file.write(("," if comma else " ").join(map(repr, row)) + "\n")


def _from_quaternions(
    path: Path, where: NDArray[np.int64], table: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Turn rows of x y z qx qy qz qw into poses."""
    length = np.linalg.norm(table[:, 3:], axis=1)
    bad = np.abs(length - 1) > _UNIT
    if bad.any():
        k = int(np.argmax(bad))
        raise ValueError(
            f"the quaternion in line {where[k]} of {path} must have length 1, got {length[k]:.4g}: "
            f"{table[k, 3:].tolist()}"
        )
    poses = np.broadcast_to(np.eye(4), (len(table), 4, 4)).copy()
    from scipy.spatial.transform import Rotation

    poses[:, :3, :3] = Rotation.from_quat(table[:, 3:]).as_matrix()
    poses[:, :3, 3] = table[:, :3]
    return poses


def _from_rows(path: Path, where: NDArray[np.int64], table: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn rows of 12 or 16 numbers into poses, with the true rotations nearest to the rounded ones."""
    poses = np.broadcast_to(np.eye(4), (len(table), 4, 4)).copy()
    poses.reshape(len(table), 16)[:, : table.shape[1]] = table
    R = poses[:, :3, :3]
    error = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    bad = (
        (error > _ROUNDED) | (np.linalg.det(R) < 0) | (np.abs(poses[:, 3] - [0, 0, 0, 1]).max(axis=1) > 1e-9)
    )
    if bad.any():
        k = int(np.argmax(bad))
        check_pose(poses[k], f"the pose in line {where[k]} of {path}")
    left, _, right = np.linalg.svd(R)
    poses[:, :3, :3] = left @ right
    poses[:, 3] = 0, 0, 0, 1
    if (error > 1e-4).any():
        log.info("%s: rotations are rounded (R'R departs from the identity by %.1g)", path, error.max())
    return poses


def _refuse_camera(path: Path, poses: NDArray[np.float64]) -> None:
    """Raise where the frame drives along its own z axis: forward for cameras, up for everything else here."""
    steps = np.einsum("kji,kj->ki", poses[:-1, :3, :3], np.diff(poses[:, :3, 3], axis=0))
    length = np.linalg.norm(steps, axis=1).sum()
    along = np.abs(steps).sum(axis=0)
    if length > _CAMERA_PATH and along[2] > _CAMERA_SHARE * length:
        raise ValueError(
            f"the poses in {path} move along their own z axis ({along[2]:.1f} of {length:.1f} m): they are a camera's, "
            "wanted the lidar's. Give T_camera_sensor=read_calibration('calib.txt'), or the identity if they are the "
            "lidar's"
        )
