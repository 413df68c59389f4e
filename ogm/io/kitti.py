"""KITTI: boxes of the object and tracking recordings, calibrations, and times of scans.

>>> from ogm.io.kitti import read_calibration, read_kitti_objects
>>> T_camera_lidar = read_calibration("calib/000007.txt")                   # doctest: +SKIP
>>> boxes = read_kitti_objects("label_2/000007.txt", T_camera_lidar)        # doctest: +SKIP
"""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.io.labels import BoxRow, boxes_of
from ogm.io.reading import numbers, read_lines, rigid
from ogm.pose import MAX_STAMP, check_pose, inverse
from ogm.scan import Boxes
from ogm.storage.files import FilePath, OgmError

__all__ = ["read_calibration", "read_kitti_objects", "read_kitti_stamps", "read_kitti_tracks"]

_OBJECT = "type, truncated, occluded, alpha, 4 of the image box, height, width, length, x, y, z, rotation_y"
_DATE, _ZONE = re.compile(r"[0-9-]+"), re.compile(r"[^0-9:.]")  # a day; a time zone in the time of day
_TO_CAMERA, _RECTIFY = "calib_velo_to_cam.txt", "calib_cam_to_cam.txt"


def read_kitti_objects(path: FilePath, T_camera_sensor: ArrayLike) -> Boxes:
    """Read the boxes of a scan of the object recordings (``label_2/000000.txt``).

    KITTI labels only objects in view of its front camera. ``DontCare`` has no box and is left out.

    Parameters
    ----------
    path : path
        Text file with lines of 15 columns, or 16 with a score.
    T_camera_sensor : (4, 4) array
        From `read_calibration`.

    Returns
    -------
    Boxes
        Boxes without tracks, as these scans are no sequence. Empty for an empty file.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If a line has another number of columns, or invalid numbers. The error names the line.
    """
    path = Path(path)
    rows = [(n, words, "") for n, words in _lines(path, 15, _OBJECT)]
    return _objects(path, rows, inverse(check_pose(T_camera_sensor, "T_camera_sensor")))


def read_kitti_tracks(path: FilePath, T_camera_sensor: ArrayLike) -> dict[int, Boxes]:
    """Read the boxes of all scans of a drive (``label_02/0000.txt`` of the tracking recordings).

    Parameters
    ----------
    path : path
        Text file with lines of 17 columns, or 18 with a score: scan number, track number, and the columns of
        `read_kitti_objects`.
    T_camera_sensor : (4, 4) array
        From `read_calibration`.

    Returns
    -------
    dict of int to Boxes
        Boxes by scan number. Scans without lines, which have no objects or no labels, are missing.

    Raises
    ------
    FileNotFoundError, OgmError
        See `read_kitti_objects`; or if a track has two boxes in one scan.
    """
    path = Path(path)
    T = inverse(check_pose(T_camera_sensor, "T_camera_sensor"))
    scans: dict[int, list[tuple[int, list[str], str]]] = {}
    known: set[tuple[int, int]] = set()
    for n, words in _lines(path, 17, f"scan, track, {_OBJECT}"):
        try:
            scan, track = map(int, words[:2])
        except ValueError as error:
            raise OgmError(f"line {n} of {path} must begin with two integers, got {words[:2]}") from error
        rows = scans.setdefault(scan, [])
        if track >= 0 and (scan, track) in known:
            raise OgmError(f"line {n} of {path} has a second box of track {track} in scan {scan}: drop one")
        known.add((scan, track))
        rows.append((n, words[2:], str(track) if track >= 0 else ""))
    return {scan: _objects(path, rows, T) for scan, rows in scans.items()}


def read_calibration(path: FilePath) -> NDArray[np.float64]:
    """Read the transform from the lidar to camera 0, the frame of KITTI's labels and poses.

    The entry ``Tr`` is used if present, else ``Tr_velo_to_cam`` or ``Tr_velo_cam``, rotated by ``R0_rect`` or
    ``R_rect`` if present (labels are given in the rectified camera), else ``R`` and ``T``, a rotation and a shift.

    Parameters
    ----------
    path : path
        ``calib.txt`` of an odometry sequence, a calibration of the object or tracking recordings, or
        ``calib_velo_to_cam.txt`` of the raw recordings: lines with a name, an optional colon, and numbers. Or the
        folder of a day of the raw recordings with this file and ``calib_cam_to_cam.txt``, the source of ``R_rect_00``.

    Returns
    -------
    (4, 4) float64
        ``T_camera_sensor``.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If it is no text, has no such entry, or the entry is no rigid transform.
    """
    path = Path(path)
    if path.is_dir():
        rectify = _transform(path / _RECTIFY, _entries(path / _RECTIFY), "R_rect_00", 9)
        return rectify @ read_calibration(path / _TO_CAMERA)
    entries = _entries(path)
    for key in ("Tr", "Tr_velo_to_cam", "Tr_velo_cam"):  # odometry; raw and object recordings; tracking
        if key in entries:
            T = _transform(path, entries, key, 12)
            turns = [name for name in ("R0_rect", "R_rect", "R_rect_00") if name in entries and key != "Tr"]
            return _transform(path, entries, turns[0], 9) @ T if turns else T
    if "R" in entries and "T" in entries:
        T = _transform(path, entries, "R", 9)
        T[:3, 3] = _entry(path, entries, "T", 3)
        return T
    raise OgmError(
        f"{path} has no entry Tr, Tr_velo_to_cam, Tr_velo_cam, or R and T, only {', '.join(entries)[:200] or 'none'}: "
        "give the calibration from the lidar to the camera"
    )


def _entries(path: Path) -> dict[str, list[str]]:
    return {words[0].rstrip(":"): words[1:] for _, words in read_lines(path)}


def _entry(path: Path, entries: dict[str, list[str]], name: str, count: int) -> NDArray[np.float64]:
    if name not in entries:
        raise OgmError(f"{path} has no entry {name}, only {', '.join(entries)[:200] or 'none'}")
    return numbers(entries[name], count, f"entry {name} of {path}")


def _transform(path: Path, entries: dict[str, list[str]], name: str, count: int) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3, : count // 3] = _entry(path, entries, name, count).reshape(3, -1)
    return rigid(T, f"{name} of {path}")


def read_kitti_stamps(path: FilePath) -> NDArray[np.float64]:
    """Read the times of the scans of a drive: ``timestamps.txt`` (raw) or ``times.txt`` (odometry).

    Returns
    -------
    (K,) float64
        [s] since 1970, or since the first scan.

    Raises
    ------
    FileNotFoundError, OgmError
        If there is no such file, a line is no time, or an empty line precedes others: line k belongs to scan k.
    """
    path = Path(path)
    stamps: list[float] = []
    for n, words in read_lines(path):
        if n != len(stamps) + 1:
            raise OgmError(f"line {len(stamps) + 1} of {path} is empty, but line k must be the time of scan k: add it")
        try:
            if len(words) == 1:
                stamp = float(words[0])
            elif _ZONE.search(words[-1]) or not _DATE.fullmatch(words[0]):  # numpy warns and drops the zone
                raise ValueError("a time zone")
            else:
                stamp = np.datetime64("T".join(words), "ns").astype(np.int64) * 1e-9
            if not abs(stamp) <= MAX_STAMP:
                raise ValueError("not finite, or not in seconds")
        except ValueError as error:
            wanted = "a time without a zone, such as 2011-09-26 13:02:25.964389445, or seconds"
            raise OgmError(f"line {n} of {path} must be {wanted}, got {' '.join(words)[:60]!r}") from error
        stamps.append(stamp)
    return np.array(stamps, np.float64)


def _lines(path: Path, columns: int, meaning: str) -> Iterator[tuple[int, list[str]]]:
    for n, words in read_lines(path):
        if len(words) not in (columns, columns + 1):
            wanted = f"wanted {columns} ({meaning}), or {columns + 1} with a score"
            raise OgmError(f"line {n} of {path} has {len(words)} columns, {wanted}: cut short, or of other labels")
        yield n, words


def _objects(path: Path, rows: list[tuple[int, list[str], str]], T: NDArray[np.float64]) -> Boxes:
    """Convert boxes from the camera's frame, x right, y down, z forward, to the lidar's."""
    boxes = []
    for n, words, track in rows:
        if words[0] == "DontCare":
            continue
        height, width, length, x, y, z, turn = numbers(words[8:15], 7, f"the box in line {n} of {path}")
        if min(height, width, length) <= 0:
            got = f"{height:g}, {width:g}, {length:g}: drop the line, or rename it DontCare"
            raise OgmError(f"the {words[0]} in line {n} of {path} must have height, width, length above 0 m, got {got}")
        center = T[:3, :3] @ [x, y, z] + T[:3, 3] + [0, 0, height / 2]  # the file gives the centre of the bottom
        ahead = T[:3, :3] @ [np.cos(turn), 0.0, -np.sin(turn)]
        yaw = np.arctan2(ahead[1], ahead[0])
        boxes.append(BoxRow(center, [length, width, height], yaw, words[0], track))
    return boxes_of(boxes, path)
