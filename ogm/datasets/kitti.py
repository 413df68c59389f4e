"""KITTI: object, tracking and raw recordings, and odometry with or without SemanticKITTI classes."""

from abc import abstractmethod
from collections.abc import Callable
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ogm import io
from ogm.datasets.frames import KITTI_EGO, FrameRef, RawFrame, kinds_of
from ogm.datasets.recording import ScanFiles
from ogm.datasets.scans import drive_of, pose_files, scan_name, scan_paths
from ogm.io.kitti import read_kitti_objects, read_kitti_stamps, read_kitti_tracks
from ogm.io.semantic_kitti import SEMANTIC_KITTI_MOVING, read_semantic_kitti
from ogm.scan import Boxes, Scan
from ogm.storage.files import OgmError

_FRONT = "boxes only in the view of the front camera"
_FRONT_ANGLE = float(np.radians(37.0))  # [rad] half angle of that view, slightly below the image's field of view


class KittiObjectRecording(ScanFiles):
    """Folder with ``velodyne/``, ``label_2/`` and ``calib/``: unrelated single scans."""

    format = "KITTI object recordings"
    wanted_labels = "boxes of the object recordings (label_2/*.txt next to velodyne/ and calib/)"
    ego_footprint = KITTI_EGO
    view = _FRONT

    @classmethod
    def find(cls, path: Path) -> "KittiObjectRecording | None":
        """Return the scans; if there are labels, each scan must have labels and a calibration."""
        scans = scan_paths(path / "velodyne")
        if not scans or not (path / "calib").is_dir() or (path / "label_02").is_dir():
            return None
        recording = cls(path, [(FrameRef(scan_name(scan)), scan) for scan in scans])
        if (path / "label_2").is_dir():
            recording.labelled = ("boxes",)
            for n in range(len(scans)):
                recording._files(n)
        return recording

    def read_boxes(self, n: int) -> Boxes:
        """Read the boxes around a scan."""
        label, calibration = self._files(n)
        return read_kitti_objects(label, io.read_calibration(calibration))

    def _files(self, n: int) -> tuple[Path, Path]:
        """Return the label file and the calibration file of a scan."""
        scan = self.scans[n]
        return _beside(scan, self.path / "label_2", "label"), _beside(scan, self.path / "calib", "calibration")


class _KittiDrives(ScanFiles):
    """Drives with one folder of scans each, and optional tracked boxes by scan number."""

    wanted_labels = "boxes of the tracking recordings (label_02*.txt), or poses (poses.txt, derived/poses*.txt)"
    ego_footprint = KITTI_EGO

    @abstractmethod
    def read_tracks(self, drive: str) -> dict[int, Boxes]:
        """Read the boxes of a drive by scan number; `drive` is the name of its folder of scans."""

    @cached_property
    def _tracks(self) -> Callable[[str], dict[int, Boxes]]:
        return lru_cache(8)(self.read_tracks)

    def read_boxes(self, n: int) -> Boxes:
        """Return the boxes around a scan."""
        return self._tracks(self.scans[n].parent.name).get(int(scan_name(self.scans[n])), Boxes.empty())


class KittiTrackingRecording(_KittiDrives):
    """Folder with ``velodyne/0000/``, ``label_02/0000.txt`` and ``calib/0000.txt``, one drive per number."""

    format = "KITTI tracking recordings"
    labelled = ("boxes",)
    view = _FRONT
    view_angle = _FRONT_ANGLE

    @classmethod
    def find(cls, path: Path) -> "KittiTrackingRecording | None":
        """Return the scans of all drives that have labels."""
        labels = sorted((path / "label_02").glob("*.txt")) if (path / "velodyne").is_dir() else []
        scans = {label: scan_paths(path / "velodyne" / label.stem) for label in labels}
        drives = [drive_of(label.stem, scans[label], [path / "poses" / label.name]) for label in labels]
        return cls(path, sum(drives, [])) if any(drives) else None

    def read_tracks(self, drive: str) -> dict[int, Boxes]:
        """Read the labels and the calibration of a drive."""
        labels, calibration = (self.path / folder / f"{drive}.txt" for folder in ("label_02", "calib"))
        return read_kitti_tracks(labels, io.read_calibration(calibration))


class KittiRawRecording(_KittiDrives):
    """Raw drive: scans in the folder or in ``velodyne_points/data/``, with optional labels and poses."""

    format = "KITTI raw drive"
    labels: Path

    @classmethod
    def find(cls, path: Path) -> "KittiRawRecording | None":
        """Return the scans of a drive."""
        scans = scan_paths(path / "velodyne_points" / "data") or scan_paths(path)
        labels = sorted([*path.glob("label_02*.txt"), *path.glob("label_02/*.txt")])
        if not scans or not (scans[0].parent != path or labels or sorted(path.glob("calib*.txt"))):
            return None
        if len(labels) > 1:
            examples = ", ".join(label.name for label in labels[:2])
            raise OgmError(f"{path} has {len(labels)} label files ({examples} ...), wanted one: keep this drive's")
        names = [scan_name(scan) for scan in scans]
        if labels and not all(name.isdigit() for name in names):
            raise OgmError(f"scans of {path} must be named by number to match the labels, got {names[0]}: rename them")
        stamps = _raw_stamps(path / "velodyne_points" / "timestamps.txt", names)
        recording = cls(path, drive_of(path.name, scans, pose_files(path), stamps))
        recording.stamped = stamps is not None
        if labels:
            recording.labels, recording.labelled = labels[0], ("boxes",)
            recording.view, recording.view_angle = _FRONT, _FRONT_ANGLE
        return recording

    def read_tracks(self, drive: str) -> dict[int, Boxes]:
        """Read the labels and the calibration of the drive."""
        return read_kitti_tracks(self.labels, _calibration(self.path))


class KittiOdometryRecording(ScanFiles):
    """KITTI odometry: one sequence or all of ``sequences/``, with SemanticKITTI classes or only poses."""

    format = "KITTI odometry"
    wanted_labels = "classes of SemanticKITTI (labels/*.label), or poses (poses.txt)"
    ego_footprint = KITTI_EGO

    @classmethod
    def find(cls, path: Path) -> "KittiOdometryRecording | None":
        """Return the scans of the sequences with classes, or of all sequences if none has classes."""
        inside = sorted(path.glob("sequences/*/velodyne")) or sorted(path.glob("[0-9][0-9]/velodyne"))
        folders = [velodyne.parent for velodyne in inside or sorted(path.glob("velodyne/"))]
        labelled = [folder for folder in folders if (folder / "labels").is_dir()]
        folders = labelled or folders
        if not (scans := [scan for folder in folders for scan in _odometry_drive(folder)]):
            return None
        recording = cls(path, scans)
        recording.stamped = all((folder / "times.txt").is_file() for folder in folders)
        if labelled:
            recording.format, recording.labelled = "SemanticKITTI", ("classes",)
            for _, file in scans:
                _classes(file)
        return recording

    def read(self, n: int) -> RawFrame:
        """Read a scan, and its classes if the sequence is labelled."""
        if not self.labelled:
            return super().read(n)
        found = read_semantic_kitti(self.scans[n], _classes(self.scans[n]))
        moving = np.isin(found.classes, list(SEMANTIC_KITTI_MOVING))
        return RawFrame(Scan(found.points), kinds_of(found), moving)


def _beside(scan: Path, folder: Path, kind: str, ending: str = ".txt") -> Path:
    """Return the file in a folder with the same name as a scan."""
    path = folder / f"{scan_name(scan)}{ending}"
    if not path.is_file():
        raise OgmError(f"scan {scan.name} has no {kind} {path}: add it, or move the scan elsewhere")
    return path


def _classes(scan: Path) -> Path:
    return _beside(scan, scan.parents[1] / "labels", "label", ".label")


def _raw_stamps(path: Path, names: list[str]) -> NDArray[np.float64] | None:
    """Return the times of the scans of a raw drive [s], or None if the file does not exist."""
    if not path.is_file():
        return None
    times = read_kitti_stamps(path)
    if beyond := [name for name in names if not name.isdigit() or int(name) >= len(times)]:
        raise OgmError(f"{path} has {len(times)} times, but no time for scan {beyond[-1]}: wanted a line per scan")
    return times[[int(name) for name in names]]


def _odometry_drive(folder: Path) -> list[tuple[FrameRef, Path]]:
    """Return the scans of an odometry sequence, with poses converted from camera poses."""
    scans = scan_paths(folder / "velodyne")
    calib, more = folder / "calib.txt", folder.parents[1] / "poses" / f"{folder.name}.txt"
    T = io.read_calibration(calib) if calib.is_file() else None
    times = read_kitti_stamps(folder / "times.txt") if (folder / "times.txt").is_file() else None
    if times is not None and len(times) != len(scans):
        raise OgmError(
            f"{folder}/times.txt has {len(times)} times for {len(scans)} scans, wanted one per scan: remove the file "
            "to count the scans at 10 Hz"
        )
    return drive_of(folder.name, scans, [*pose_files(folder), more], times, T_camera_sensor=T)


def _calibration(path: Path) -> NDArray[np.float64]:
    """Read the calibration in the folder of a drive or of its day."""
    for folder in (path, path.parent):
        if (folder / "calib_velo_to_cam.txt").is_file():
            return io.read_calibration(folder)
        files = sorted(folder.glob("calib*.txt"))
        if len(files) == 1:
            return io.read_calibration(files[0])
    raise OgmError(
        f"{path} has boxes but no calibration to place them: wanted one calib*.txt with Tr_velo_to_cam and R0_rect, or "
        "calib_velo_to_cam.txt and calib_cam_to_cam.txt, in the folder or the folder above"
    )
