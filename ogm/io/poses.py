"""Poses, read and written: KITTI, KITTI-360, TUM, g2o and a self-describing format of this library."""

import logging
import math
import re
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.io.g2o import read_g2o
from ogm.io.reading import from_quaternions, numbers, read_text, rigid, text_lines
from ogm.pose import MAX_STAMP, Trajectory, check_pose, inverse, matrix_to_quaternion
from ogm.storage.files import FilePath, OgmError, atomic_write, update_hint

log: logging.Logger = logging.getLogger(__name__)

_OURS = "ogm.poses/1"
_EXPLAINED = f"""# {_OURS}: T_map_sensor, the sensor's pose in the map at each stamp [s]; position x y z [m] and
# rotation as a unit quaternion take sensor coordinates (x forward, y left, z up) to the map's
"""
_NAMES = ("stamp", "x", "y", "z", "qx", "qy", "qz", "qw")
_KINDS = {8: "TUM", 12: "KITTI", 13: "KITTI-360", 16: "4x4", 17: "KITTI-360 4x4"}
_WANTED = (
    "8 (TUM: stamp x y z qx qy qz qw), 12 (KITTI: the upper three rows of T_map_sensor), 13 (KITTI-360: frame "
    "number and those 12), 16 or 17 (all four rows)"
)
_ROUNDED = 2e-3  # departure of R'R from the identity by rounding to three decimals
_CAMERA_SHARE = 0.9  # share of the path along the frame's own z axis: only camera frames move so
_CAMERA_PATH = 1.0  # [m] least path for this check
_LARGEST_NUMBER = 10**9  # a larger number in a file name is a time, not a frame number


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of a file, with stamps or frame numbers.

    Parameters
    ----------
    poses : (K, 4, 4) float64
        ``T_map_sensor``.
    stamps : (K,) float64 or None
        Times of the poses [s], increasing; None if the file has no times.
    numbers : (K,) int64 or None
        Frame numbers of the scans, increasing; None if the file has no numbers: pose k then belongs to the k-th scan.
    format : str
        Name of the file format.
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
            Rate of the scans [1/s]. Only used for files without stamps: times become frame number / rate, or
            k / rate without frame numbers.

        Raises
        ------
        ValueError
            If there are neither stamps nor a rate, or the rate is not above 0.
        """
        if self.stamps is not None:
            return Trajectory(self.stamps, self.poses)
        if rate is None:
            raise ValueError(f"these poses ({self.format}) have no stamps: give the scan rate, usually 10 [1/s]")
        if not 0 < rate < np.inf:
            raise ValueError(f"rate must be above 0 [1/s], got {rate}")
        counted = np.arange(len(self)) if self.numbers is None else self.numbers
        return Trajectory(counted / rate, self.poses)


def frame_numbers(names: Sequence[str]) -> NDArray[np.int64] | None:
    """Return the last number of each name, (K,), or None unless it increases and is the only difference."""
    found = [re.fullmatch(r"(.*?)(\d+)\D*", name) for name in names]
    if not all(found) or len({match[1] for match in found if match}) > 1:
        return None
    numbers = [int(match[2]) for match in found if match]
    if max(numbers, default=0) >= _LARGEST_NUMBER or any(b <= a for a, b in zip(numbers, numbers[1:], strict=False)):
        return None
    return np.array(numbers, np.int64)


def read_poses(path: FilePath, *, T_camera_sensor: ArrayLike | None = None) -> Poses:
    """Read the poses of a drive.

    The number of columns gives the format: 12 is KITTI odometry (the upper three rows of a 4x4 pose, row by row), 13 is
    KITTI-360 (with a leading frame number), 16 and 17 add the fourth row, 8 is TUM (stamp, position, quaternion with w
    last). Columns are separated by blanks; text after ``#`` is a comment. A ``.csv`` has the header
    ``stamp,x,y,z,qx,qy,qz,qw``, in any order, and an optional column ``number``. A ``.g2o`` is a pose graph; vertex
    identifiers are the frame numbers. All of these may be packed as ``.xz`` or ``.gz``. A ``.log`` is a trajectory of
    Open3D: blocks of three indices, the first being the frame number, and the four rows of a camera's pose.

    Rounded rotations, to three decimals at least, become the nearest exact rotations.

    Parameters
    ----------
    path : path
    T_camera_sensor : (4, 4) array, optional
        Transform from the lidar to the vehicle part that the file's poses belong to, such as camera 0 of KITTI, see
        `read_calibration`. The map is then the lidar's frame at the file's origin: x forward, y left, z up. The
        identity for poses of the lidar itself.

    Returns
    -------
    Poses

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If the file is empty or no text; if a row is ragged, not numeric, not finite or not rigid; if stamps or frame
        numbers repeat or decrease; or if the poses clearly belong to a camera (they move along their own z axis)
        and `T_camera_sensor` is missing. The error names the line.
    """
    path = Path(path)
    if path.suffix.lower() == ".log":
        frames, poses = _open3d(path)
        return Poses(_of_sensor(path, poses, T_camera_sensor), None, frames, "Open3D")
    if path.name.lower().removesuffix(".xz").removesuffix(".gz").endswith(".g2o"):
        vertices, poses, kind = read_g2o(path)
        return Poses(_of_sensor(path, poses, T_camera_sensor), None, vertices, kind)
    table, where, header, ours = _rows(path)
    columns = table.shape[1]
    stamps, counted = None, None
    if header:
        table = table[:, [header.index(name) for name in (*_NAMES, "number") if name in header]]
        counted = _frame_numbers(where, table[:, 8]) if "number" in header else None
    if header or columns == 8:
        stamps = _stamps(where, table[:, 0])
        poses = from_quaternions(table[:, 1:4], table[:, 4:8], where)
    else:
        if columns in (13, 17):
            counted, table = _frame_numbers(where, table[:, 0]), table[:, 1:]
        poses = _from_matrices(path, where, table)
    if ours and T_camera_sensor is not None:
        raise OgmError(f"{path} has the sensor's own poses ({_OURS}): leave T_camera_sensor out")
    if not ours:
        poses = _of_sensor(path, poses, T_camera_sensor)
    return Poses(poses, stamps, counted, _OURS if ours else "csv" if header else _KINDS[columns])


def write_poses(path: FilePath, trajectory: Trajectory, numbers: ArrayLike | None = None) -> None:
    """Write poses with their stamps, in full precision and in one step.

    Parameters
    ----------
    path : path
        ``.csv``: the library's format, with an explaining comment and a header. ``.txt`` or ``.tum``: TUM.
    trajectory : Trajectory
        ``T_map_sensor`` and stamps.
    numbers : (K,) integers, optional
        Frame numbers of the scans, increasing; only for ``.csv``.

    Raises
    ------
    ValueError
        If the ending is not supported, or the numbers do not fit.
    OSError
        If the file cannot be written.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in (".csv", ".txt", ".tum"):
        raise ValueError(f"cannot write poses to {path}: name it .csv (ogm), .txt or .tum (TUM)")
    quaternions = matrix_to_quaternion(trajectory.poses[:, :3, :3])
    rows = np.column_stack([trajectory.stamps, trajectory.poses[:, :3, 3], quaternions]).tolist()
    names = list(_NAMES)
    if numbers is not None:
        counted = np.asarray(numbers)
        if ending != ".csv":
            raise ValueError(f"TUM files hold no frame numbers, got numbers for {path}: name it .csv")
        whole = counted.shape == (len(trajectory),) and counted.dtype.kind in "iu"
        if not whole or not (np.diff(counted.astype(np.int64)) > 0).all():
            raise ValueError(f"numbers must be {len(trajectory)} increasing integers, got {counted.tolist()}")
        names.append("number")
        rows = [[*row, number] for row, number in zip(rows, counted.tolist(), strict=True)]
    separator, comment = (",", _EXPLAINED) if ending == ".csv" else (" ", "# ")
    with atomic_write(path, "w") as file:
        file.write(comment + separator.join(names) + "\n")
        file.writelines(separator.join(map(repr, row)) + "\n" for row in rows)


_Where = Callable[[int], str]  # the place of row k in the file, for errors


def _rows(path: Path) -> tuple[NDArray[np.float64], _Where, list[str], bool]:
    """Return the rows (K, C), their places, the header's names ([] if none), and whether it is the own format."""
    if not (text := read_text(path, f"poses in lines of numbers: {_WANTED}")):
        raise OgmError(f"{path} is empty, wanted poses: the file is incomplete")
    csv = path.name.lower().removesuffix(".xz").removesuffix(".gz").endswith(".csv")
    table, lines = array("d"), array("q")
    header: list[str] = []
    columns, ours = 0, False
    for n, raw in text_lines(text):
        content, _, comment = raw.partition("#")
        if not columns and comment.strip().startswith("ogm.poses/"):
            version = comment.split()[0].rstrip(":")
            if version != _OURS:
                raise OgmError(f"{path} has the format {version}, wanted {_OURS}{update_hint(version, _OURS)}")
            ours = True
        words = [word.strip() for word in content.split(",")] if csv and content.strip() else content.split()
        if words and csv and not header:
            _check_header(words, path)
            header, columns = words, len(words)
        elif words:
            columns = columns or len(words)
            if columns not in _KINDS and not header:
                raise OgmError(f"line {n} of {path} has {columns} columns, wanted {_WANTED}")
            _add(table, words, columns, f"line {n} of {path}")
            lines.append(n)
    if not lines:
        raise OgmError(f"{path} holds no pose, only comments or a header: the file is incomplete")
    rows = np.frombuffer(table, np.float64).reshape(-1, columns)
    return rows, lambda k: f"line {lines[k]} of {path}", header, ours


def _open3d(path: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return frame numbers (K,) and poses (K, 4, 4) of an Open3D trajectory."""
    wanted = "blocks of a line with three indices and four lines with a pose (Open3D)"
    lines = [(n, line.split()) for n, line in text_lines(read_text(path, wanted)) if line.strip()]
    if not lines or len(lines) % 5:
        raise OgmError(f"{path} has {len(lines)} lines, wanted {wanted}: the file is incomplete")
    counted = np.array([numbers(words, 3, f"line {n} of {path}")[0] for n, words in lines[::5]])
    rows = [numbers(words, 4, f"line {n} of {path}") for k, (n, words) in enumerate(lines) if k % 5]

    def where(k: int) -> str:
        return f"line {lines[5 * k][0]} of {path}"

    return _frame_numbers(where, counted), _from_matrices(path, where, np.array(rows).reshape(-1, 16))


def _check_header(names: Sequence[str], path: Path) -> None:
    if len(set(names)) != len(names) or set(names) - {"number"} != set(_NAMES):
        wanted = f"{','.join(_NAMES)} and optionally number"
        raise OgmError(f"the header of {path} must be {wanted}, got {','.join(names)[:200]}")


def _add(table: "array[float]", words: Sequence[str], columns: int, where: str) -> None:
    """Add a row of finite numbers to a table."""
    try:
        row = [float(word) for word in words]
    except ValueError:
        row = []
    if len(row) != columns or not all(map(math.isfinite, row)):
        numbers(words, columns, where)  # raises a specific error
    table.extend(row)


def _frame_numbers(where: _Where, column: NDArray[np.float64]) -> NDArray[np.int64]:
    bad = (column != np.floor(column)) | (np.abs(column) > 2**53)
    if bad.any():
        k = int(np.argmax(bad))
        raise OgmError(f"{where(k)} must have an integer frame number, got {column[k]:g}")
    _check_increasing(where, column.astype(np.int64), "frame numbers")
    return column.astype(np.int64)


def _stamps(where: _Where, stamps: NDArray[np.float64]) -> NDArray[np.float64]:
    k = int(np.argmax(np.abs(stamps)))
    if np.abs(stamps[k]) > MAX_STAMP:
        raise OgmError(f"stamps must be seconds, got {stamps[k]:g} in {where(k)}: divide nanoseconds by 1e9")
    _check_increasing(where, stamps, "stamps")
    return stamps


def _check_increasing(where: _Where, column: NDArray[Any], quantity: str) -> None:
    stuck = np.diff(column) <= 0
    if stuck.any():
        k = int(np.argmax(stuck))
        got = f"{where(k)} has {column[k].item()!r} and the next has {column[k + 1].item()!r}"
        raise OgmError(f"{quantity} must increase, but {got}: sort the rows, or drop duplicates")


def _from_matrices(path: Path, where: _Where, table: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert rows of 12 or 16 numbers to poses, with the exact rotations nearest to the rounded ones."""
    poses = np.broadcast_to(np.eye(4), (len(table), 4, 4)).copy()
    poses.reshape(len(table), 16)[:, : table.shape[1]] = table
    R = poses[:, :3, :3]
    error = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    bad = (error > _ROUNDED) | (np.linalg.det(R) < 0) | (np.abs(poses[:, 3] - [0, 0, 0, 1]).max(axis=1) > 1e-9)
    if bad.any():
        k = int(np.argmax(bad))
        rigid(poses[k], f"the pose in {where(k)}")
    left, _, right = np.linalg.svd(R)
    poses[:, :3, :3] = left @ right
    poses[:, 3] = 0, 0, 0, 1
    if (error > 1e-4).any():
        log.info("%s: rotations are rounded (R'R departs from the identity by %.1g)", path, error.max())
    return poses


def _of_sensor(path: Path, poses: NDArray[np.float64], T_camera_sensor: ArrayLike | None) -> NDArray[np.float64]:
    """Return the poses of the lidar."""
    if T_camera_sensor is None:
        _refuse_camera(path, poses)
        return poses
    T = check_pose(T_camera_sensor, "T_camera_sensor")
    return inverse(T) @ poses @ T


def _refuse_camera(path: Path, poses: NDArray[np.float64]) -> None:
    """Raise if the frame moves along its own z axis, which points forward for cameras and up for other frames."""
    steps = np.einsum("kji,kj->ki", poses[:-1, :3, :3], np.diff(poses[:, :3, 3], axis=0))
    length = np.linalg.norm(steps, axis=1).sum()
    along = np.abs(steps).sum(axis=0)
    if length > _CAMERA_PATH and along[2] > _CAMERA_SHARE * length:
        raise OgmError(
            f"the poses in {path} move along their own z axis ({along[2]:.1f} of {length:.1f} m) like a camera, wanted "
            "poses of the lidar: give T_camera_sensor=read_calibration('calib.txt'), or the identity for poses of the "
            "lidar"
        )
