"""Time from the first sight of a moving object to its detection by a dynamic grid."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.metrics.motion import MOVING, STILL
from ogm.state import Motion

SHARE = 0.5  # of an object's occupied cells predicted moving, for a detection
MIN_SCANS = 5  # with an undetected object in sight and moving; with fewer it is left out


class ObjectCells(NamedTuple):
    """Objects in one frame with at least one cell occupied in the scan.

    Attributes
    ----------
    track : (n,) str
        Names of the objects.
    speed : (n,) float64
        True speed, mean over cells [m/s].
    cells, predicted : (n,) int64
        Number of cells occupied in the scan, and of these cells predicted moving.
    """

    track: NDArray[np.str_]
    speed: NDArray[np.float64]
    cells: NDArray[np.int64]
    predicted: NDArray[np.int64]


class Detection(NamedTuple):
    """Detection of an object.

    Attributes
    ----------
    track : str
    stamp : float
        Time at which it was first in sight and faster than 1 m/s [s].
    seconds, scans : float
        Time [s] and number of scans from `stamp` until half of its occupied cells are predicted moving; infinite if
        this never happens.
    from_rest : bool
        Whether it was in sight and static before.
    """

    track: str
    stamp: float
    seconds: float
    scans: float
    from_rest: bool


def object_cells(
    motion: Motion, occupied: NDArray[np.bool_], predicted: NDArray[np.bool_], track: Sequence[str]
) -> ObjectCells:
    """Count the cells of every object in a scan.

    Parameters
    ----------
    motion : Motion
    occupied, predicted : (nx, ny) bool
        Cells occupied in the scan, and cells predicted moving by the grid.
    track : sequence of str
        Names of the objects in `motion.box`; objects without a name are left out.
    """
    named = np.array([bool(name) for name in track] + [False])
    speed = np.hypot(motion.velocity[..., 0], motion.velocity[..., 1])
    shown = occupied & named[motion.box] & np.isfinite(speed)
    box = motion.box[shown]
    count = np.bincount(box, minlength=len(track))
    at = np.flatnonzero(count)
    right = np.bincount(box, predicted[shown], minlength=len(track))[at].astype(np.int64)
    mean = np.bincount(box, speed[shown], minlength=len(track))[at] / count[at]
    return ObjectCells(np.array(list(track), np.str_)[at], mean, count[at], right)


def detection_times(frames: Iterable[tuple[float, ObjectCells]]) -> list[Detection]:
    """Return the detection of each moving object of a sequence.

    Parameters
    ----------
    frames : iterable of (float, ObjectCells)
        Stamp [s] and objects of every frame, in order.

    Returns
    -------
    list of Detection
        One per object that is in sight and faster than 1 m/s at any time. Undetected objects are left out if this
        holds in fewer than five scans.
    """
    first: dict[str, tuple[float, int]] = {}
    rested: set[str] = set()
    scans: dict[str, int] = {}
    found: dict[str, Detection] = {}
    for k, (stamp, objects) in enumerate(frames):
        for track, speed, cells, predicted in zip(*(column.tolist() for column in objects), strict=True):
            if speed < STILL and track not in first:
                rested.add(track)
            if speed <= MOVING or track in found:
                continue
            start, first_scan = first.setdefault(track, (stamp, k))
            scans[track] = scans.get(track, 0) + 1
            if predicted >= SHARE * cells:
                found[track] = Detection(track, start, stamp - start, k - first_scan, track in rested)
    never = float("inf")
    lost = (track for track in first if track not in found and scans[track] >= MIN_SCANS)
    return [*found.values(), *(Detection(name, first[name][0], never, never, name in rested) for name in lost)]
