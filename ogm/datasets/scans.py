"""Files of scans: single ones, several, or a folder of them, with or without poses."""

import logging
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.layout import KITTI_EGO, FrameRef, Layout, RawFrame
from ogm.datasets.paths import clock_stamps, ending_of, in_order, pose_files, poses_of, scan_name, sequence_of
from ogm.io import Axes, read_scan
from ogm.io.axes import rotation_to_flu
from ogm.storage.files import OgmError

__all__ = ["scans"]

log: logging.Logger = logging.getLogger(__name__)

_POSES = "poses of the scans (poses.txt, poses.csv, derived/poses*.txt)"


def scans(
    paths: Sequence[Path], axes: Axes = "flu", intensity_max: float | None = None, time_unit: float | None = None
) -> Layout | None:
    """Line up scans: files, or one folder of them, which may hold poses; None where it holds no scans.

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
        If there is a folder beside files, or it holds several formats.
    """
    rotation_to_flu(axes)  # refuses what are none, before any scan is read
    folder = next((path for path in paths if path.is_dir()), None)
    if folder is not None and len(paths) > 1:
        raise ValueError(f"{folder} is a folder; give one folder alone, or files")
    files = in_order(paths if folder is None else _files_in(folder))
    if not files:
        return None
    if not any(path.exists() for path in files):
        raise FileNotFoundError(f"there is no file or folder {files[0]}")
    names = [scan_name(path) for path in files]
    if len(set(names)) < len(names):
        if folder is not None:
            double = next(name for name in names if names.count(name) > 1)
            raise OgmError(f"{folder} holds {double} twice; give the files one by one")
        files, names = list(paths), [str(path) for path in paths]
    place = files[0].resolve().parent if folder is None else folder.resolve()
    poses: Sequence[NDArray[np.float64] | None] = [None] * len(files)
    labels = _POSES
    if folder is not None:
        try:
            poses = poses_of(pose_files(folder), names, axes=axes)
        except ValueError as error:  # of no interest where poses are given otherwise, or not needed
            log.warning("the poses beside the scans of %s are not used: %s", folder, error)
            labels = f"{_POSES}, which are not used: {error}"
    posed = any(T is not None for T in poses)
    if posed:
        frames = sequence_of(place.name, names, poses)
    else:
        sequence = place.name if folder is not None or _one_drive(files) else ""
        stamps: Sequence[float | None] = clock_stamps(names) or [None] * len(names)
        frames = tuple(FrameRef(name, sequence, t) for name, t in zip(names, stamps, strict=True))
    return Layout(
        "scans with poses" if posed else "scans",
        frames,
        lambda n: RawFrame(read_scan(files[n], axes, intensity_max=intensity_max, time_unit=time_unit)),
        labels,
        ego_footprint=KITTI_EGO if posed else None,
        axes=axes,
        known_axes=False,
        name=place.name if len(paths) > 1 else "",
        files=() if folder is not None else tuple(files),
    )


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
    if len(formats) > 1:
        raise OgmError(f"{folder} holds scans of several formats ({', '.join(formats)}); give the files of one")
    return next(iter(formats.values()), [])
