"""Where the lidar sits beside the camera: KITTI's calibration files."""

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ogm.io.source import read_bytes
from ogm.pose import check_pose

__all__ = ["read_calibration"]

_TO_CAMERA = ("Tr_velo_to_cam", "Tr_velo_cam")  # raw and object recordings; tracking
_RECTIFIES = ("R0_rect", "R_rect", "R_rect_00")


def read_calibration(path: str | os.PathLike[str], name: str = "Tr") -> NDArray[np.float64]:
    """Read the transform from the lidar to camera 0 of a KITTI calibration file.

    Parameters
    ----------
    path : path
        ``calib.txt`` of an odometry sequence, a calibration of the object or tracking recordings, or
        ``calib_velo_to_cam.txt`` of the raw ones: lines of a name, perhaps a colon, and numbers.
    name : str
        The entry to take: 12 numbers, the upper three rows of a transform. Where the default, ``Tr``, is not
        there: ``Tr_velo_to_cam`` or ``Tr_velo_cam``, turned by ``R0_rect`` or ``R_rect`` if the file has it
        (the poses are those of the rectified camera); else ``R`` and ``T``, a rotation and a shift.

    Returns
    -------
    (4, 4) float64
        ``T_camera_sensor``.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is no text, has no such entry, or the entry is no rigid transform.
    """
    path = Path(path)
    entries = _entries(path)
    if name in entries:
        return _transform(path, name, entries[name])
    if name != "Tr":
        raise ValueError(f"{path} has no entry {name}, only {', '.join(entries)[:200] or 'none'}")
    for key in _TO_CAMERA:
        if key in entries:
            T = _transform(path, key, entries[key])
            rectify = np.eye(4)
            for rotation in _RECTIFIES:
                if rotation in entries:
                    rectify[:3, :3] = _shaped(path, rotation, entries[rotation], 9).reshape(3, 3)
                    break
            return check_pose(rectify, f"the rotation of {path}") @ T
    if "R" in entries and "T" in entries:
        R, shift = _shaped(path, "R", entries["R"], 9), _shaped(path, "T", entries["T"], 3)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R.reshape(3, 3), shift
        return check_pose(T, f"R and T of {path}")
    raise ValueError(
        f"{path} has no entry Tr, Tr_velo_to_cam, Tr_velo_cam, or R and T, only {', '.join(entries)[:200] or 'none'}: "
        "give the calibration of the lidar to the camera"
    )


def _entries(path: Path) -> dict[str, list[str]]:
    try:
        text = read_bytes(path)[0].decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is no text, wanted a calibration: lines of a name and numbers") from error
    rows = [line.split() for line in text.splitlines() if line.strip()]
    return {row[0].rstrip(":"): row[1:] for row in rows}


def _shaped(path: Path, name: str, fields: list[str], count: int) -> NDArray[np.float64]:
    try:
        numbers = np.array([float(field) for field in fields])
    except ValueError as error:
        raise ValueError(f"entry {name} of {path} is no row of numbers: {' '.join(fields)[:80]!r}") from error
    if len(numbers) != count:
        raise ValueError(f"entry {name} of {path} must have {count} numbers, got {len(numbers)}")
    return numbers


def _transform(path: Path, name: str, fields: list[str]) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3] = _shaped(path, name, fields, 12).reshape(3, 4)
    return check_pose(T, f"entry {name} of {path}")
