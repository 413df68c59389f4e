"""Files of scans: single ones, several, or a folder of them, with or without poses."""

import logging
import re
from collections.abc import Sequence
from pathlib import Path

from ogm.datasets.layout import KITTI_EGO, FrameRef, Layout, RawFrame
from ogm.datasets.paths import (
    SCAN_ENDINGS,
    clock_stamps,
    ending_of,
    in_order,
    pose_files,
    poses_of,
    scan_name,
    sequence_of,
)
from ogm.io import Axes, read_scan
from ogm.io.axes import rotation_to_flu

__all__ = ["scans"]

log = logging.getLogger(__name__)

_POSES = "poses of the scans (poses.txt, poses.csv, derived/poses*.txt)"


def scans(
    paths: Sequence[Path],
    axes: Axes = "flu",
    intensity_max: float | None = None,
    time_unit: float | None = None,
) -> Layout:
    """Line up scans: files, or one folder of them, which may hold poses.

    Parameters
    ----------
    paths : sequence of Path
        Files, or one folder. They are sorted by their names, with 2 before 10, if those differ.
    axes, intensity_max, time_unit
        As for `ogm.io.read_scan`.

    Raises
    ------
    FileNotFoundError
        If none of the files exists.
    ValueError
        If there is a folder beside files, it holds no scans, or several formats.
    """
    rotation_to_flu(axes)  # refuses what are none, before any scan is read
    folder = next((path for path in paths if path.is_dir()), None)
    if folder is not None and len(paths) > 1:
        raise ValueError(f"{folder} is a folder; give one folder alone, or files")
    files = list(paths) if folder is None else _files_in(folder)
    if not any(path.exists() for path in files):
        raise FileNotFoundError(f"there is no file or folder {files[0]}")
    names = [scan_name(path) for path in files]
    if len(set(names)) == len(names):
        files = in_order(files)
        names = [scan_name(path) for path in files]
    elif folder is not None:
        double = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{folder} holds {double} twice; give the files one by one")
    else:
        names = [str(path) for path in files]
    frames, labels = _frames(folder, files, names, axes)
    posed = any(one.T_map_sensor is not None for one in frames)

    def read(n: int) -> RawFrame:
        return RawFrame(read_scan(files[n], axes=axes, intensity_max=intensity_max, time_unit=time_unit))

    return Layout(
        "scans with poses" if posed else "scans",
        frames,
        read,
        labels,
        ego_footprint=KITTI_EGO if posed else None,
        axes=axes,
        known_axes=False,
        files=() if folder is not None else tuple(files),
    )


def _frames(
    folder: Path | None, files: list[Path], names: list[str], axes: Axes
) -> tuple[tuple[FrameRef, ...], str]:
    """Return the frames, and which labels were looked for."""
    stamps: Sequence[float | None] = clock_stamps(names) or [None] * len(names)
    if folder is None:
        sequence = files[0].parent.name or "scans" if _one_drive(files) else ""
        return tuple(FrameRef(name, sequence, t) for name, t in zip(names, stamps, strict=True)), _POSES
    sequence = folder.resolve().name
    try:
        poses = poses_of(pose_files(folder), names, axes=axes)
    except ValueError as error:  # of no interest where poses are given otherwise, or not needed
        log.warning("the poses beside the scans of %s are not used: %s", folder, error)
        return _frames_of(names, sequence, stamps), f"{_POSES}, which are not used: {error}"
    if any(T is not None for T in poses):
        return sequence_of(sequence, names, poses), _POSES
    return _frames_of(names, sequence, stamps), _POSES


def _frames_of(
    names: Sequence[str], sequence: str, stamps: Sequence[float | None]
) -> tuple[FrameRef, ...]:
    return tuple(FrameRef(name, sequence, t) for name, t in zip(names, stamps, strict=True))


def _one_drive(files: Sequence[Path]) -> bool:
    """Tell whether files lie in one folder and their names differ in numbers alone."""
    alike = {(path.parent, re.sub(r"\d+", "0", scan_name(path))) for path in files}
    return len(files) > 1 and len(alike) == 1


def _files_in(folder: Path) -> list[Path]:
    formats: dict[str, list[Path]] = {}
    for place in (folder, folder / "velodyne"):
        for path in place.iterdir() if place.is_dir() and not formats else ():
            if path.is_file() and not path.name.startswith(".") and (ending := ending_of(path)):
                formats.setdefault(ending, []).append(path)
    if not formats:
        raise ValueError(
            f"{folder} holds no scans ({' '.join(SCAN_ENDINGS)}, .xz, .gz); give the folder that does"
        )
    if len(formats) > 1:
        raise ValueError(
            f"{folder} holds scans of several formats ({', '.join(formats)}); give the files of one"
        )
    return next(iter(formats.values()))
