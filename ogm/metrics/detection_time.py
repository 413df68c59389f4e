"""How long a dynamic grid takes to predict that an object moves, once it is in sight."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.metrics.motion import MOVING, STILL
from ogm.state import Motion

SHARE = 0.5  # of an object's occupied cells: from there on it is detected
LEAST_SCANS = 5  # in which an undetected object is in sight and moves: with fewer it is left out


class ObjectCells(NamedTuple):
    """Objects of one frame of which the scan shows a cell or more.

    Attributes
    ----------
    track : (n,) str
        Names of the objects.
    speed : (n,) float64
        True speed, the mean over cells [m/s].
    cells, predicted : (n,) int64
        Cells that the scan shows as occupied, and those of them that are predicted moving.
    """

    track: NDArray[np.str_]
    speed: NDArray[np.float64]
    cells: NDArray[np.int64]
    predicted: NDArray[np.int64]


class Detection(NamedTuple):
    """When one object was detected.

    Attributes
    ----------
    track : str
    stamp : float
        When it was first in sight and faster than 1 m/s [s].
    seconds, scans : float
        From then until half of its occupied cells are predicted moving; 0 at once, infinite if they never were.
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
    """Count the cells of every object that a scan shows.

    Parameters
    ----------
    motion : Motion
    occupied, predicted : (nx, ny) bool
        Cells that the scan shows as occupied, and cells that the grid predicts moving.
    track : sequence of str
        Names of the objects that `motion.box` counts; those without a name are left out.
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
    """Return how long each moving object of a sequence took to be detected.

    Parameters
    ----------
    frames : iterable of (float, ObjectCells)
        Stamp [s] and objects of every frame, in order.

    Returns
    -------
    list of Detection
        One per object that is ever in sight and faster than 1 m/s. Objects that were not detected are left out if they
        are so in fewer than five scans.
    """
    first: dict[str, tuple[float, int]] = {}
    rested: set[str] = set()
    scans: dict[str, int] = {}
    found: dict[str, Detection] = {}
    for k, (stamp, objects) in enumerate(frames):
        for track, speed, cells, predicted in zip(*(one.tolist() for one in objects), strict=True):
            if speed < STILL and track not in first:
                rested.add(track)
            if speed <= MOVING or track in found:
                continue
            start, place = first.setdefault(track, (stamp, k))
            scans[track] = scans.get(track, 0) + 1
            if predicted >= SHARE * cells:
                found[track] = Detection(track, start, stamp - start, k - place, track in rested)
    never = float("inf")
    lost = (track for track in first if track not in found and scans[track] >= LEAST_SCANS)
    return [*found.values(), *(Detection(name, first[name][0], never, never, name in rested) for name in lost)]
