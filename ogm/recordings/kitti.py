"""KITTI and its kin: object, tracking and raw recordings, odometry with and without SemanticKITTI's classes."""

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ogm.io import (
    SEMANTIC_KITTI_MOVING,
    read_calibration,
    read_kitti_objects,
    read_kitti_stamps,
    read_kitti_tracks,
    read_points,
    read_semantic_kitti,
)
from ogm.recordings.layout import (
    KITTI_CAR,
    Layout,
    Seen,
    Shot,
    drive,
    kinds_of,
    pose_files,
    poses_of,
    scans_in,
    stem,
)
from ogm.scan import Boxes

__all__ = ["kitti_drive", "kitti_object", "kitti_tracking", "odometry"]

FRONT = "boxes only where the front camera looks"
_NONE = Boxes.empty()
_BOXES = "boxes of the object recordings (label_2/*.txt beside velodyne/ and calib/)"
_TRACKS = "boxes of the tracking recordings (label_02*.txt), or poses (poses.txt, derived/poses*.txt)"
_CLASSES = "classes of SemanticKITTI (labels/*.label), or poses (poses.txt)"


def kitti_object(path: Path) -> Layout | None:
    """Find ``velodyne/``, ``label_2/`` and ``calib/``: unrelated single scans."""
    scans = scans_in(path / "velodyne")
    if not scans or not (path / "calib").is_dir() or (path / "label_02").is_dir():
        return None
    folders = [(path / "label_2", "label"), (path / "calib", "calibration")]
    labelled = folders[0][0].is_dir()
    for folder, what in folders if labelled else []:
        for one in scans:
            if not (folder / f"{stem(one)}.txt").is_file():
                raise ValueError(
                    f"scan {one.name} has no {what} {folder / stem(one)}.txt: add it, or move the scan elsewhere"
                )

    def objects(n: int) -> Boxes:
        name = f"{stem(scans[n])}.txt"
        return read_kitti_objects(path / "label_2" / name, read_calibration(path / "calib" / name))

    shots = tuple(Shot(stem(one), stem(one), float("nan"), None) for one in scans)
    return Layout(
        "KITTI object recordings",
        shots,
        lambda n: Seen(read_points(scans[n])),
        _BOXES,
        objects if labelled else None,
        own=KITTI_CAR,
        view=FRONT,
    )


def kitti_tracking(path: Path) -> Layout | None:
    """Find ``velodyne/0000/``, ``label_02/0000.txt`` and ``calib/0000.txt``: one drive per number."""
    labels = sorted((path / "label_02").glob("*.txt")) if (path / "velodyne").is_dir() else []
    drives = [(one, scans_in(path / "velodyne" / one.stem)) for one in labels]
    drives = [(one, scans) for one, scans in drives if scans]
    if not drives:
        return None

    @lru_cache(8)
    def tracks(label: Path) -> dict[int, Boxes]:
        return read_kitti_tracks(label, read_calibration(path / "calib" / label.name))

    shots: list[Shot] = []
    files: list[tuple[Path, Path]] = []
    for label, scans in drives:
        names = [stem(one) for one in scans]
        poses = poses_of([path / "poses" / label.name], names)
        shots += drive(label.stem, scans, poses)
        files += [(label, scan) for scan in scans]
    return Layout(
        "KITTI tracking recordings",
        tuple(shots),
        lambda n: Seen(read_points(files[n][1])),
        _TRACKS,
        lambda n: tracks(files[n][0]).get(int(stem(files[n][1])), _NONE),
        own=KITTI_CAR,
        view=FRONT,
    )


def kitti_drive(path: Path) -> Layout | None:
    """Find one raw drive: scans in the folder itself or in ``velodyne_points/data/``, perhaps labels and poses."""
    raw = path / "velodyne_points"
    scans = scans_in(raw / "data") or scans_in(path)
    labels = sorted([*path.glob("label_02*.txt"), *path.glob("label_02/*.txt")])
    if not scans or not (scans[0].parent != path or labels or sorted(path.glob("calib*.txt"))):
        return None
    if len(labels) > 1:
        raise ValueError(
            f"{path} has {len(labels)} files of labels ({labels[0].name}, {labels[1].name} ...), wanted one drive's"
        )
    names = [stem(one) for one in scans]
    if labels and not all(name.isdigit() for name in names):
        raise ValueError(
            f"scans of {path} must be named by their numbers, as their labels are; got {names[0]}"
        )
    stamps = None
    if (raw / "timestamps.txt").is_file():
        times = read_kitti_stamps(raw / "timestamps.txt")
        strange = [name for name in names if not name.isdigit() or int(name) >= len(times)]
        if strange:
            raise ValueError(
                f"{raw / 'timestamps.txt'} has {len(times)} times, too few for scan {strange[-1]}: wanted a line for "
                "every scan from 0 on"
            )
        stamps = times[[int(name) for name in names]]

    @lru_cache(1)
    def tracks() -> dict[int, Boxes]:
        return read_kitti_tracks(labels[0], _calibration(path))

    return Layout(
        "KITTI raw drive",
        drive(path.name, scans, poses_of(pose_files(path), names), stamps),
        lambda n: Seen(read_points(scans[n])),
        _TRACKS,
        (lambda n: tracks().get(int(names[n]), _NONE)) if labels else None,
        own=KITTI_CAR,
        view=FRONT if labels else "",
    )


def _calibration(path: Path) -> NDArray[np.float64]:
    """Look for a calibration in the folder of a drive, and in that of its day."""
    for folder in (path, path.parent):
        if (folder / "calib_velo_to_cam.txt").is_file():
            return read_calibration(folder)
        files = sorted(folder.glob("calib*.txt"))
        if len(files) == 1:
            return read_calibration(files[0])
    raise ValueError(
        f"{path} has boxes but no calibration, without which nobody knows where they are: wanted one calib*.txt with "
        "Tr_velo_to_cam and R0_rect, or calib_velo_to_cam.txt and calib_cam_to_cam.txt, in the folder or above it"
    )


def odometry(path: Path) -> Layout | None:
    """Find KITTI odometry: one sequence or all under ``sequences/``, with SemanticKITTI's classes or poses alone."""
    inside = sorted(path.glob("sequences/*/velodyne")) or sorted(path.glob("[0-9][0-9]/velodyne"))
    folders = [one.parent for one in inside] or ([path] if (path / "velodyne").is_dir() else [])
    labelled = [one for one in folders if (one / "labels").is_dir()]
    folders = labelled or folders
    shots: list[Shot] = []
    files: list[tuple[Path, Path | None]] = []
    for folder in folders:
        scans = scans_in(folder / "velodyne")
        names = [stem(one) for one in scans]
        calib, more = folder / "calib.txt", folder.parents[1] / "poses" / f"{folder.name}.txt"
        T = read_calibration(calib) if calib.is_file() else None
        times = read_kitti_stamps(folder / "times.txt") if (folder / "times.txt").is_file() else None
        if times is not None and len(times) != len(scans):
            raise ValueError(f"{folder}/times.txt has {len(times)} times, but there are {len(scans)} scans")
        shots += drive(
            folder.name, scans, poses_of([*pose_files(folder), more], names, T_camera_sensor=T), times
        )
        for one in scans:
            label = folder / "labels" / f"{stem(one)}.label" if labelled else None
            if label is not None and not label.is_file():
                raise ValueError(f"scan {one} has no labels {label}: add them, or move the scan elsewhere")
            files.append((one, label))
    if not files:
        return None

    def read(n: int) -> Seen:
        scan, label = files[n]
        if label is None:
            return Seen(read_points(scan))
        found = read_semantic_kitti(scan, label)
        return Seen(found.points, kinds_of(found), np.isin(found.classes, list(SEMANTIC_KITTI_MOVING)))

    name = "SemanticKITTI" if labelled else "KITTI odometry"
    return Layout(name, tuple(shots), read, _CLASSES, classes=bool(labelled), own=KITTI_CAR)
