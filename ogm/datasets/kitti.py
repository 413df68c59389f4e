"""KITTI: object, tracking and raw recordings, and odometry with or without SemanticKITTI's classes."""

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ogm import io
from ogm.datasets.layout import KITTI_EGO, FrameRef, Layout, RawFrame, kinds_of
from ogm.datasets.paths import pose_files, poses_of, scan_name, scan_paths, sequence_of
from ogm.io.kitti import read_kitti_objects, read_kitti_stamps, read_kitti_tracks
from ogm.io.semantic_kitti import SEMANTIC_KITTI_MOVING, read_semantic_kitti
from ogm.scan import Boxes, Scan
from ogm.storage.files import OgmError

__all__ = ["kitti_object", "kitti_odometry", "kitti_raw", "kitti_tracking"]

FRONT = "boxes only in the view of the front camera"
_ANGLE = np.radians(37.0)  # of that view, to either side: a little less than the picture shows
_BOXES = "boxes of the object recordings (label_2/*.txt beside velodyne/ and calib/)"
_TRACKS = "boxes of the tracking recordings (label_02*.txt), or poses (poses.txt, derived/poses*.txt)"
_CLASSES = "classes of SemanticKITTI (labels/*.label), or poses (poses.txt)"


def kitti_object(path: Path) -> Layout | None:
    """Find ``velodyne/``, ``label_2/`` and ``calib/``: unrelated single scans."""
    scans = scan_paths(path / "velodyne")
    if not scans or not (path / "calib").is_dir() or (path / "label_02").is_dir():
        return None
    labelled = (path / "label_2").is_dir()
    labels = [_beside(one, path / "label_2", "label") for one in scans if labelled]
    calibrations = [_beside(one, path / "calib", "calibration") for one in scans if labelled]
    return Layout(
        "KITTI object recordings",
        tuple(FrameRef(scan_name(one)) for one in scans),
        lambda n: RawFrame(io.read_scan(scans[n])),
        _BOXES,
        (lambda n: read_kitti_objects(labels[n], io.read_calibration(calibrations[n]))) if labelled else None,
        ego_footprint=KITTI_EGO,
        view=FRONT,
    )


def _beside(scan: Path, folder: Path, what: str, ending: str = ".txt") -> Path:
    """Return the file of a folder that has the name of a scan."""
    path = folder / f"{scan_name(scan)}{ending}"
    if not path.is_file():
        raise OgmError(f"scan {scan.name} has no {what} {path}: add it, or move the scan elsewhere")
    return path


def kitti_tracking(path: Path) -> Layout | None:
    """Find ``velodyne/0000/``, ``label_02/0000.txt`` and ``calib/0000.txt``: one drive per number."""
    labels = sorted((path / "label_02").glob("*.txt")) if (path / "velodyne").is_dir() else []
    frames: list[FrameRef] = []
    files: list[tuple[Path, Path]] = []
    for label in labels:
        scans = scan_paths(path / "velodyne" / label.stem)
        names = [scan_name(one) for one in scans]
        frames += sequence_of(label.stem, names, poses_of([path / "poses" / label.name], names))
        files += [(label, scan) for scan in scans]
    if not files:
        return None

    @lru_cache(8)
    def tracks(label: Path) -> dict[int, Boxes]:
        return read_kitti_tracks(label, io.read_calibration(path / "calib" / label.name))

    return Layout(
        "KITTI tracking recordings",
        tuple(frames),
        lambda n: RawFrame(io.read_scan(files[n][1])),
        _TRACKS,
        lambda n: tracks(files[n][0]).get(int(scan_name(files[n][1])), Boxes.empty()),
        ego_footprint=KITTI_EGO,
        view=FRONT,
        view_angle=_ANGLE,
    )


def kitti_raw(path: Path) -> Layout | None:
    """Find one raw drive: scans in the folder itself or in ``velodyne_points/data/``, perhaps labels and poses."""
    raw = path / "velodyne_points"
    scans = scan_paths(raw / "data") or scan_paths(path)
    labels = sorted([*path.glob("label_02*.txt"), *path.glob("label_02/*.txt")])
    if not scans or not (scans[0].parent != path or labels or sorted(path.glob("calib*.txt"))):
        return None
    if len(labels) > 1:
        raise OgmError(
            f"{path} has {len(labels)} files of labels ({labels[0].name}, {labels[1].name} ...), wanted one drive's"
        )
    names = [scan_name(one) for one in scans]
    if labels and not all(name.isdigit() for name in names):
        raise OgmError(f"scans of {path} must be named by their numbers, as their labels are; got {names[0]}")
    stamps = None
    if (raw / "timestamps.txt").is_file():
        times = read_kitti_stamps(raw / "timestamps.txt")
        beyond = [name for name in names if not name.isdigit() or int(name) >= len(times)]
        if beyond:
            raise OgmError(
                f"{raw / 'timestamps.txt'} has {len(times)} times, too few for scan {beyond[-1]}: wanted a line for "
                "every scan from 0 on"
            )
        stamps = times[[int(name) for name in names]]

    @lru_cache(1)
    def tracks() -> dict[int, Boxes]:
        return read_kitti_tracks(labels[0], _calibration(path))

    return Layout(
        "KITTI raw drive",
        sequence_of(path.name, names, poses_of(pose_files(path), names), stamps),
        lambda n: RawFrame(io.read_scan(scans[n])),
        _TRACKS,
        (lambda n: tracks().get(int(names[n]), Boxes.empty())) if labels else None,
        ego_footprint=KITTI_EGO,
        view=FRONT if labels else "",
        view_angle=_ANGLE if labels else None,
        stamped=stamps is not None,
    )


def _calibration(path: Path) -> NDArray[np.float64]:
    """Find a calibration in the folder of a drive, or in that of its day."""
    for folder in (path, path.parent):
        if (folder / "calib_velo_to_cam.txt").is_file():
            return io.read_calibration(folder)
        files = sorted(folder.glob("calib*.txt"))
        if len(files) == 1:
            return io.read_calibration(files[0])
    raise OgmError(
        f"{path} has boxes but no calibration, without which their places are unknown: wanted one calib*.txt with "
        "Tr_velo_to_cam and R0_rect, or calib_velo_to_cam.txt and calib_cam_to_cam.txt, in the folder or above it"
    )


def kitti_odometry(path: Path) -> Layout | None:
    """Find KITTI odometry: one sequence or all under ``sequences/``, with SemanticKITTI's classes or poses alone."""
    inside = sorted(path.glob("sequences/*/velodyne")) or sorted(path.glob("[0-9][0-9]/velodyne"))
    folders = [one.parent for one in inside or sorted(path.glob("velodyne/"))]
    labelled = [one for one in folders if (one / "labels").is_dir()]
    folders = labelled or folders
    frames: list[FrameRef] = []
    files: list[tuple[Path, Path | None]] = []
    for folder in folders:
        scans = scan_paths(folder / "velodyne")
        names = [scan_name(one) for one in scans]
        calib, more = folder / "calib.txt", folder.parents[1] / "poses" / f"{folder.name}.txt"
        T = io.read_calibration(calib) if calib.is_file() else None
        times = read_kitti_stamps(folder / "times.txt") if (folder / "times.txt").is_file() else None
        if times is not None and len(times) != len(scans):
            raise OgmError(f"{folder}/times.txt has {len(times)} times, but there are {len(scans)} scans")
        poses = poses_of([*pose_files(folder), more], names, T_camera_sensor=T)
        frames += sequence_of(folder.name, names, poses, times)
        files += [(one, _beside(one, folder / "labels", "label", ".label") if labelled else None) for one in scans]
    if not files:
        return None

    def read(n: int) -> RawFrame:
        scan, label = files[n]
        if label is None:
            return RawFrame(io.read_scan(scan))
        found = read_semantic_kitti(scan, label)
        moving = np.isin(found.classes, list(SEMANTIC_KITTI_MOVING))
        return RawFrame(Scan(found.points), kinds_of(found), moving)

    name = "SemanticKITTI" if labelled else "KITTI odometry"
    stamped = all((folder / "times.txt").is_file() for folder in folders)
    return Layout(name, tuple(frames), read, _CLASSES, classes=bool(labelled), ego_footprint=KITTI_EGO, stamped=stamped)
