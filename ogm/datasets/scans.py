"""Files of scans as a recording, with names, numbers, times and poses."""

import logging
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.frames import KITTI_EGO, Footprint, FrameRef
from ogm.datasets.recording import OpenOptions, ScanFiles
from ogm.io import Axes, read_poses
from ogm.io.scan_table import rotation_to_flu
from ogm.storage.files import OgmError

_log = logging.getLogger(__name__)

SCAN_ENDINGS = (".pcd.bin", ".bin", ".pcd", ".ply", ".las", ".laz", ".npy", ".feather")
_PACKED = (".xz", ".gz")
_LIDAR_ENDINGS = (".bin", ".pcd", ".ply", ".las", ".laz")  # endings of scans in public datasets
_UNITS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))  # smallest number of a time since 1970, and its unit [s]


def ending_of(path: Path) -> str:
    """Return the ending that gives the format of a scan; "" if the file is no scan."""
    name = path.name.lower()
    for packed in _PACKED:
        name = name.removesuffix(packed)
    return next((ending for ending in SCAN_ENDINGS if name.endswith(ending)), "")


def scan_name(path: Path) -> str:
    """Return the name of a file without the endings of its format and compression."""
    name = path.name
    for ending in (*_PACKED, *SCAN_ENDINGS):
        name = name.removesuffix(ending) or name
    return name


def scan_paths(folder: Path) -> list[Path]:
    """Return the scans in a folder of a public dataset, in the order of their names."""
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    return in_order([path for path in files if ending_of(path) in _LIDAR_ENDINGS and path.is_file()])


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Sort files by name, with 2 before 10."""

    def key(path: Path) -> list[tuple[int, str]]:
        parts = re.split(r"(\d+)", scan_name(path))
        return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]

    return sorted(paths, key=key)


def clock_stamps(names: Sequence[str]) -> list[float] | None:
    """Return times [s] if all names are milli-, micro- or nanoseconds since 1970, else None."""
    if not names or not all(_is_number(name) for name in names):
        return None
    unit = next((unit for least, unit in _UNITS if max(map(int, names)) >= least), None)
    return None if unit is None else [unit * int(name) for name in names]


def drive_of(
    name: str,
    scans: Sequence[Path],
    files: Iterable[Path] = (),
    stamps: Sequence[float] | NDArray[np.float64] | None = None,
    *,
    axes: Axes = "flu",
    T_camera_sensor: NDArray[np.float64] | None = None,
) -> list[tuple[FrameRef, Path]]:
    """Return the scans of a drive as frames, each with its file.

    Parameters
    ----------
    name : str
        Name of the sequence.
    scans : sequence of Path
        Scan files.
    files : iterable of Path
        Possible files of poses, see `pose_files`.
    stamps : sequence of float, optional
        Times of the scans [s]. By default the file names are times since 1970, or else count tenths of a second.
    axes, T_camera_sensor
        See `poses_of`.
    """
    names = [scan_name(scan) for scan in scans]
    poses = poses_of(files, names, axes=axes, T_camera_sensor=T_camera_sensor)
    if stamps is None:
        counts = [int(number) for number in names] if all(map(_is_number, names)) else range(len(names))
        stamps = clock_stamps(names) or [0.1 * count for count in counts]
    rows = zip(names, stamps, poses, scans, strict=True)
    return [(FrameRef(title, name, float(stamp), T), scan) for title, stamp, T, scan in rows]


def pose_files(folder: Path) -> list[Path]:
    """Return the possible files of poses of a drive: ``derived/poses*``, ``poses.txt``, ``poses.csv``."""
    return [*sorted(folder.glob("derived/poses*")), folder / "poses.txt", folder / "poses.csv"]


def poses_of(
    files: Iterable[Path],
    names: Sequence[str],
    *,
    axes: Axes = "flu",
    T_camera_sensor: NDArray[np.float64] | None = None,
) -> list[NDArray[np.float64] | None]:
    """Read the poses of scans from the first existing file.

    Parameters
    ----------
    files : iterable of Path
        Possible files of poses, see `pose_files`.
    names : sequence of str
        Names of the scans; if the file has frame numbers, each scan gets the pose with the number in its name.
    axes : Axes
        Axes of the poses, the same as the axes of the scans.
    T_camera_sensor : (4, 4) array, optional
        Transform from the lidar to the camera, for camera poses such as KITTI odometry's. Poses in ``derived/`` and
        CSV files are always lidar poses.

    Returns
    -------
    list of (4, 4) float64 array or None
        ``T_map_sensor`` of each scan; None without a pose, or without a file.
    """
    if (path := next((file for file in files if file.is_file()), None)) is None:
        return [None] * len(names)
    camera = None if path.parent.name == "derived" or path.suffix == ".csv" else T_camera_sensor
    found = read_poses(path, T_camera_sensor=camera)
    turn = np.eye(4)
    turn[:3, :3] = rotation_to_flu(axes)
    poses = turn @ found.poses @ turn.T
    if found.numbers is None:
        if len(poses) != len(names):
            raise OgmError(
                f"{path} has {len(poses)} poses for {len(names)} scans: wanted one pose per scan, or the number of the "
                "scan at the beginning of each line"
            )
        return list(poses)
    of = {int(number): T for number, T in zip(found.numbers, poses, strict=True)}
    return [of.get(int(name)) if _is_number(name) else None for name in names]


def _is_number(name: str) -> bool:
    return name.isascii() and name.isdigit() and len(name) < 20


class ScansRecording(ScanFiles):
    """Files of scans in the order of their names, or one folder of scans with optional poses."""

    format = "scans"
    wanted_labels = "poses of the scans (poses.txt, poses.csv, derived/poses*.txt)"
    ego_footprint: Footprint | None = None
    known_axes = False

    @classmethod
    def open(cls, paths: Sequence[Path], options: OpenOptions) -> "ScansRecording | None":
        """Return the scans of files or of a folder, or None if the folder holds no scans.

        Raises
        ------
        FileNotFoundError
            If no file exists.
        ValueError
            If a folder is not the only path, or holds several formats.
        """
        folder = next((path for path in paths if path.is_dir()), None)
        if folder is not None and len(paths) > 1:
            raise ValueError(f"{folder} is a folder, got {len(paths)} paths: give one folder alone, or files")
        if not (files := in_order(paths if folder is None else _files_in(folder))):
            return None
        axes = options.axes
        if isinstance(axes, str) and axes == "flu" and all(ending_of(file).startswith(".pcd.bin") for file in files):
            axes = "nuscenes"  # see `ogm.io.read_scan`
        recording = cls._of_files(paths, files) if folder is None else cls._of_folder(folder, files, axes)
        recording.axes, recording.units = axes, options.units
        return recording

    @classmethod
    def _of_files(cls, paths: Sequence[Path], files: list[Path]) -> "ScansRecording":
        if not any(path.exists() for path in files):
            raise FileNotFoundError(f"there is no file or folder {files[0]}")
        names = [scan_name(path) for path in files]
        if len(set(names)) < len(names):
            files, names = list(paths), [str(path) for path in paths]
        place = files[0].resolve().parent.name
        frames = _without_poses(files, names, place if _is_one_drive(files) else "")
        recording = cls(paths[0], frames, place if len(paths) > 1 else "")
        recording.files = files
        return recording

    @classmethod
    def _of_folder(cls, folder: Path, files: list[Path], axes: Axes) -> "ScansRecording":
        names, sequence = [scan_name(path) for path in files], folder.resolve().name
        if len(set(names)) < len(names):
            double = next(name for name in names if names.count(name) > 1)
            raise OgmError(f"{folder} holds {double} twice: give the files one by one")
        recording = cls(folder, _without_poses(files, names, sequence))
        try:
            placed = drive_of(sequence, files, pose_files(folder), axes=axes)
        except ValueError as error:  # poses may come from another file, or not be needed
            _log.warning("the poses next to the scans of %s are not used: %s", folder, error)
            recording.wanted_labels += f", which are not used: {error}"
            return recording
        if any(ref.T_map_sensor is not None for ref, _ in placed):
            recording = cls(folder, placed)
            recording.format, recording.ego_footprint = "scans with poses", KITTI_EGO
        return recording


def _without_poses(files: list[Path], names: list[str], sequence: str) -> list[tuple[FrameRef, Path]]:
    """Return scans as frames without poses; stamps are taken from file names that are times since 1970."""
    stamps: Sequence[float | None] = clock_stamps(names) or [None] * len(names)
    return [(FrameRef(name, sequence, stamp), file) for file, name, stamp in zip(files, names, stamps, strict=True)]


def _is_one_drive(files: Sequence[Path]) -> bool:
    """Return whether files lie in one folder and their names differ only in numbers."""
    alike = {(path.parent, re.sub(r"\d+", "0", scan_name(path))) for path in files}
    return len(files) > 1 and len(alike) == 1


def _files_in(folder: Path) -> list[Path]:
    formats: dict[str, list[Path]] = {}
    for place in (folder, folder / "velodyne"):
        for path in place.iterdir() if place.is_dir() and not formats else ():
            if path.is_file() and not path.name.startswith(".") and (ending := ending_of(path)):
                formats.setdefault(ending, []).append(path)
    if len(formats) > 1:
        raise OgmError(f"{folder} holds scans of several formats ({', '.join(formats)}): give the files of one format")
    return next(iter(formats.values()), [])
