"""Files of scans: single ones, several, or a folder of them, with or without poses."""

import logging
import re
from collections.abc import Sequence
from pathlib import Path

from ogm.datasets.frames import KITTI_EGO, Footprint, FrameRef
from ogm.datasets.paths import clock_stamps, drive_of, ending_of, in_order, pose_files, scan_name
from ogm.datasets.recording import OpenOptions, ScanFiles
from ogm.io import Axes
from ogm.io.axes import rotation_to_flu
from ogm.storage.files import OgmError

__all__ = ["ScansRecording"]

log: logging.Logger = logging.getLogger(__name__)

_POSES = "poses of the scans (poses.txt, poses.csv, derived/poses*.txt)"


class ScansRecording(ScanFiles):
    """Files of scans in the order of their names, with 2 before 10, or one folder of them, which may hold poses."""

    format = "scans"
    wanted_labels = _POSES
    ego_footprint: Footprint | None = None
    known_axes = False

    @classmethod
    def open(cls, paths: Sequence[Path], options: OpenOptions) -> "ScansRecording | None":
        """Return the scans of files or of a folder; None if it holds no scans.

        Raises
        ------
        FileNotFoundError
            If none of the files exists.
        ValueError
            If a folder is not the only path, or it holds several formats.
        """
        rotation_to_flu(options.axes)  # refuses wrong axes, before any scan is read
        folder = next((path for path in paths if path.is_dir()), None)
        if folder is not None and len(paths) > 1:
            raise ValueError(f"{folder} is a folder; give one folder alone, or files")
        files = in_order(paths if folder is None else _files_in(folder))
        if not files:
            return None
        recording = cls._of_files(paths, files) if folder is None else cls._of_folder(folder, files, options.axes)
        recording.axes, recording.units = options.axes, options.units
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
            raise OgmError(f"{folder} holds {double} twice; give the files one by one")
        recording = cls(folder, _without_poses(files, names, sequence))
        try:
            placed = drive_of(sequence, files, pose_files(folder), axes=axes)
        except ValueError as error:  # the poses may be given otherwise, or not be needed
            log.warning("the poses beside the scans of %s are not used: %s", folder, error)
            recording.wanted_labels += f", which are not used: {error}"
            return recording
        if any(ref.T_map_sensor is not None for ref, _ in placed):
            recording = cls(folder, placed)
            recording.format, recording.ego_footprint = "scans with poses", KITTI_EGO
        return recording


def _without_poses(files: list[Path], names: list[str], sequence: str) -> list[tuple[FrameRef, Path]]:
    """Return scans as frames, stamped by their names if these are a clock's."""
    stamps: Sequence[float | None] = clock_stamps(names) or [None] * len(names)
    return [(FrameRef(name, sequence, stamp), file) for file, name, stamp in zip(files, names, stamps, strict=True)]


def _is_one_drive(files: Sequence[Path]) -> bool:
    """Tell whether files lie in one folder and their names differ in numbers alone."""
    alike = {(path.parent, re.sub(r"\d+", "0", scan_name(path))) for path in files}
    return len(files) > 1 and len(alike) == 1


def _files_in(folder: Path) -> list[Path]:
    formats: dict[str, list[Path]] = {}
    for place in (folder, folder / "velodyne"):
        for path in place.iterdir() if place.is_dir() and not formats else ():
            if path.is_file() and not path.name.startswith(".") and (ending := ending_of(path)):
                formats.setdefault(ending, []).append(path)
    if len(formats) > 1:
        raise OgmError(f"{folder} holds scans of several formats ({', '.join(formats)}); give the files of one")
    return next(iter(formats.values()), [])
