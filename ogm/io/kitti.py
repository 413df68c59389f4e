"""KITTI's labels: boxes of the object and the tracking recordings, in the lidar's frame."""

import os
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.io.calibration import read_calibration
from ogm.io.documents import numbers, read_lines
from ogm.io.objects import BoxRow, boxes_of
from ogm.pose import check_pose, inverse
from ogm.scan import Boxes

__all__ = ["read_kitti_calibration", "read_kitti_objects", "read_kitti_stamps", "read_kitti_tracks"]

_OBJECT = (
    "type, truncated, occluded, alpha, 4 of the picture's box, height, width, length, x, y, z, rotation_y"
)
_TO_CAMERA, _RECTIFY = "calib_velo_to_cam.txt", "calib_cam_to_cam.txt"


def read_kitti_objects(path: str | os.PathLike[str], T_camera_sensor: ArrayLike) -> Boxes:
    """Read the boxes of one scan of the object recordings (``label_2/000000.txt``).

    KITTI labels what its front camera sees, and nothing else. ``DontCare`` has no box and is left out.

    Parameters
    ----------
    path : path
        Lines of 15 columns, or 16 with a score.
    T_camera_sensor : (4, 4) array
        From `read_kitti_calibration`.

    Returns
    -------
    Boxes
        Without tracks: these scans have nothing to do with each other. No objects if the file is empty.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If a line has another number of columns, or what should be a number is none. The line is named.
    """
    path = Path(path)
    rows = [(n, words, "") for n, words in _lines(path, 15, _OBJECT)]
    return _objects(path, rows, inverse(check_pose(T_camera_sensor, "T_camera_sensor")))


def read_kitti_tracks(path: str | os.PathLike[str], T_camera_sensor: ArrayLike) -> dict[int, Boxes]:
    """Read the boxes of all scans of a drive (``label_02/0000.txt`` of the tracking recordings).

    Parameters
    ----------
    path : path
        Lines of 17 columns, or 18 with a score: the scan's number, the track's, and what `read_kitti_objects`
        reads.
    T_camera_sensor : (4, 4) array
        From `read_kitti_calibration`.

    Returns
    -------
    dict of int to Boxes
        By the number of the scan. Scans without a line are not in it: nothing was seen there, or nobody looked.

    Raises
    ------
    FileNotFoundError, ValueError
        As `read_kitti_objects`; or if a track has two boxes in one scan.
    """
    path = Path(path)
    T = inverse(check_pose(T_camera_sensor, "T_camera_sensor"))
    scans: dict[int, list[tuple[int, list[str], str]]] = {}
    for n, words in _lines(path, 17, f"scan, track, {_OBJECT}"):
        scan, track = (_whole(word, n, path) for word in words[:2])
        rows = scans.setdefault(scan, [])
        if track >= 0 and any(one == str(track) for _, _, one in rows):
            raise ValueError(f"line {n} of {path} has a second box of track {track} in scan {scan}: drop one")
        rows.append((n, words[2:], str(track) if track >= 0 else ""))
    return {scan: _objects(path, rows, T) for scan, rows in scans.items()}


def read_kitti_calibration(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """Read how the lidar sits beside the rectified camera that KITTI's labels are told in.

    Parameters
    ----------
    path : path
        A file of the object, tracking or odometry recordings; or the folder of a day of the raw ones, with
        ``calib_velo_to_cam.txt`` and ``calib_cam_to_cam.txt`` (whose ``R_rect_00`` is used).

    Returns
    -------
    (4, 4) float64
        ``T_camera_sensor``.

    Raises
    ------
    FileNotFoundError, ValueError
        If a file is not there, or has no such entry.
    """
    path = Path(path)
    if not path.is_dir():
        return read_calibration(path)
    T, rectify = read_calibration(path / _TO_CAMERA), np.eye(4)
    entries = {words[0].rstrip(":"): words[1:] for _, words in read_lines(path / _RECTIFY)}
    if "R_rect_00" not in entries:
        raise ValueError(f"{path / _RECTIFY} has no entry R_rect_00, only {', '.join(entries)[:200]}")
    where = f"R_rect_00 of {path / _RECTIFY}"
    rectify[:3, :3] = numbers(entries["R_rect_00"], 9, where).reshape(3, 3)
    return check_pose(rectify, where) @ T


def read_kitti_stamps(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """Read when the scans of a drive were taken: ``timestamps.txt`` (raw) or ``times.txt`` (odometry).

    Returns
    -------
    (K,) float64
        [s] since 1970, or since the first scan.

    Raises
    ------
    FileNotFoundError, ValueError
        If there is no such file, a line is no time, or lines between others are empty: scans are counted by lines.
    """
    path = Path(path)
    stamps: list[float] = []
    for n, words in read_lines(path):
        if n != len(stamps) + 1:
            raise ValueError(
                f"line {len(stamps) + 1} of {path} is empty, but lines follow, wanted a time for every scan from the "
                "first on: which belongs to which cannot be told"
            )
        try:
            if len(words) == 1:
                stamp = float(words[0])
            else:
                stamp = np.datetime64("T".join(words), "ns").astype(np.int64) * 1e-9
            if not np.isfinite(stamp):
                raise ValueError("not finite")
        except ValueError as error:
            raise ValueError(
                f"line {n} of {path} must be a time, such as 2011-09-26 13:02:25.964389445 or seconds, got "
                f"{' '.join(words)[:60]!r}"
            ) from error
        stamps.append(stamp)
    return np.array(stamps, np.float64)


def _lines(path: Path, columns: int, meaning: str) -> list[tuple[int, list[str]]]:
    rows = read_lines(path)
    for n, words in rows:
        if len(words) not in (columns, columns + 1):
            raise ValueError(
                f"line {n} of {path} has {len(words)} columns, wanted {columns} ({meaning}), or {columns + 1} with a "
                "score: it is cut short, or of another kind of label"
            )
    return rows


def _whole(word: str, n: int, path: Path) -> int:
    try:
        return int(word)
    except ValueError as error:
        raise ValueError(f"line {n} of {path} must begin with two whole numbers, got {word!r}") from error


def _objects(path: Path, rows: list[tuple[int, list[str], str]], T: NDArray[np.float64]) -> Boxes:
    """Bring boxes from the camera's frame, x right, y down, z forward, to the lidar's."""
    boxes = []
    for n, words, track in rows:
        if words[0] == "DontCare":
            continue
        height, width, length, x, y, z, turn = numbers(words[8:15], 7, f"the box in line {n} of {path}")
        if min(height, width, length) <= 0:
            raise ValueError(
                f"the {words[0]} in line {n} of {path} must have height, width and length above 0 m, got {height:g}, "
                f"{width:g}, {length:g}: drop the line, or call it DontCare"
            )
        center = (
            T[:3, :3] @ [x, y, z] + T[:3, 3] + [0, 0, height / 2]
        )  # the file has the middle of the bottom
        ahead = T[:3, :3] @ [np.cos(turn), 0.0, -np.sin(turn)]
        yaw = np.arctan2(ahead[1], ahead[0])
        boxes.append(BoxRow(center, [length, width, height], yaw, words[0], track))
    return boxes_of(boxes, path)
