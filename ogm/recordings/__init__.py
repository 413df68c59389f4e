"""Real recordings with truth: any known data set's folder in, frames of points and truth grids out.

>>> from ogm.recordings import open_recording
>>> recording = open_recording("2011_09_26_drive_0005")         # doctest: +SKIP
>>> frame = recording[3]                                        # doctest: +SKIP
>>> frame.points, frame.truth                                   # doctest: +SKIP
"""

import os
from collections.abc import Callable, Iterable
from pathlib import Path

from ogm.recordings.around import truth_from_others
from ogm.recordings.kitti import kitti_drive, kitti_object, kitti_tracking, odometry
from ogm.recordings.layout import Layout
from ogm.recordings.others import argoverse2, mmdet3d, nuscenes, range_images, scans_and_poses, sustech
from ogm.recordings.recording import SOURCES, Frame, Recording

__all__ = ["SOURCES", "Frame", "Recording", "is_recording", "open_recording", "truth_from_others"]

# The first that knows a path reads it: the more a layout asks for, the earlier it is asked.
_LAYOUTS: tuple[Callable[[Path], Layout | None], ...] = (
    *(nuscenes, mmdet3d, argoverse2, sustech),
    *(kitti_object, kitti_tracking, odometry, kitti_drive, range_images, scans_and_poses),
)
_KNOWN = (
    "KITTI object (velodyne/ label_2/ calib/), tracking (velodyne/0000/ label_02/ calib/), raw drives "
    "(velodyne_points/data/ or scans, label_02*.txt, calib*.txt) and odometry (velodyne/ poses.txt calib.txt); "
    "SemanticKITTI (velodyne/ labels/, or sequences/*/); nuScenes (v1.0-*/ samples/) and mmdetection3d's info as JSON; "
    "Argoverse 2 logs (sensors/lidar/ annotations.feather map/); SUSTechPOINTS (lidar/ label/); labelled range images "
    "(*.npy in semantic_kitti/ or nuscenes/); scans with poses (derived/poses*.txt)"
)


def open_recording(
    path: str | os.PathLike[str], *, truth: Iterable[str] = (), others: str = "all"
) -> Recording:
    """Open a real recording whose truth is known, as a sequence of frames.

    No scan is read: a frame reads its points, and makes its truth, when it is first asked for them.

    Parameters
    ----------
    path : path
        Folder of a recording, or a file that names one. What it is, is told by what lies in it: KITTI object,
        tracking, raw and odometry recordings, SemanticKITTI, nuScenes, mmdetection3d's info (as JSON), an
        Argoverse 2 log, SUSTechPOINTS, labelled range images, or scans with poses.
    truth : iterable of str
        What to make the truth of; by default all that is there.

        * ``"boxes"``: cells of boxes with 50 returns or more are occupied; those with fewer are never free;
        * ``"classes"``: cells in which the scan hit ground are free, those with obstacles are occupied;
        * ``"map"``: drivable area that is in sight is free;
        * ``"aggregated"``: what other scans agree on, brought to the frame by the poses, without what moves.

        Where they contradict each other, a cell is to be ignored, but boxes win. What nobody labelled is
        ignored too: nothing is unknown in a real truth.
    others : {"all", "later"}
        Which scans aggregated truth takes: all near in space and time but the one judged, or only those after
        it. "later" is for maps that are fused over time, which must not be judged by the scans they are made
        of; the last frames then know little.

    Returns
    -------
    Recording

    Raises
    ------
    FileNotFoundError
        If there is nothing at the path.
    ValueError
        If it is no recording that is known, if nothing is labelled in it, or if it lacks what `truth` asks
        for; if a part of it is damaged or missing.
    """
    place = Path(path)
    if not place.exists():
        raise FileNotFoundError(f"there is no {place}: check the name and the folder")
    layout = _layout(place)
    if layout is not None:
        return Recording(layout, place, truth, others)
    raise ValueError(f"{place} is no recording that is known, or holds no scan. Known are: {_KNOWN}")


def is_recording(path: str | os.PathLike[str]) -> bool:
    """Tell whether a path holds a recording of a known layout; whether it is labelled, `open_recording` tells.

    Raises
    ------
    ValueError
        If it is one, but damaged.
    """
    return _layout(Path(path)) is not None


def _layout(place: Path) -> Layout | None:
    """Return what the first layout that knows a path makes of it."""
    return next((layout for find in _LAYOUTS if (layout := find(place)) is not None), None)
