"""Where and when each scan of a drive was taken: poses matched with scans, or estimated from them."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.cli.drive import UNREADABLE, Drive
from ogm.io import Poses
from ogm.io.axes import rotation_to_flu
from ogm.pose import Trajectory

if TYPE_CHECKING:
    from ogm.io import Axes

__all__ = ["Route", "to_flu", "matched", "estimate_trajectory"]

OURS = "ogm.poses/1"  # the format of what --save-poses writes: always x forward, y left
GAP = 2.0  # [s] between two poses, beyond which nothing is said about what lies between them
RANGE = 2.5, 100.0  # [m] of points that odometry uses: the near ones are the own vehicle's
FEWEST = 200  # of them, below which a scan is left out

Tick = Callable[[Iterable[int], str], Iterable[int]]


class Route(NamedTuple):
    """Where and when each scan of a drive was taken.

    Attributes
    ----------
    stamps : (K,) float64
        [s]; NaN where nothing is known.
    poses : (K, 4, 4) float64
        ``T_map_sensor``; NaN where nothing is known.
    trajectory : Trajectory
        All that is known, for moments between the scans.
    how : str
        What was matched with what, for a person.
    """

    stamps: NDArray[np.float64]
    poses: NDArray[np.float64]
    trajectory: Trajectory
    how: str

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which scans have a pose, (K,)."""
        return np.isfinite(self.stamps) & np.isfinite(self.poses).all(axis=(1, 2))

    def first(self, count: int | None) -> "Route":
        """Return what is known of the first so many scans; of all for None."""
        return self._replace(stamps=self.stamps[:count], poses=self.poses[:count])


def to_flu(poses: Poses, axes: "Axes") -> Poses:
    """Return the poses of a sensor whose x points forward and y left, as its points are read.

    A file of poses knows the axes that the scans have on disk; the map keeps its own. What ``--save-poses`` wrote
    is left as it is.
    """
    if poses.format == OURS:
        return poses
    T_flu_file = np.eye(4)
    T_flu_file[:3, :3] = rotation_to_flu(axes)
    return replace(poses, poses=poses.poses @ T_flu_file.T)


def matched(drive: Drive, poses: Poses, source: str, rate: float, tick: Tick) -> Route:
    """Find the pose and the time of every scan: by frame number, by stamp, or by order, in this order.

    Parameters
    ----------
    drive : Drive
    poses : Poses
    source : str
        Where they come from, for messages.
    rate : float
        Scans per second [1/s], where neither scans nor poses have stamps.
    tick : function
        Shows how far the reading of stamps is.

    Raises
    ------
    ValueError
        If nothing tells which pose belongs to which scan.
    """
    count, total = len(drive), len(poses)
    rows = np.full(count, -1)
    if drive.numbers is not None and poses.numbers is not None:
        how = "by frame number"
        rows = _rows(drive.numbers, poses.numbers)
        if (rows < 0).all():
            raise ValueError(
                f"no scan has a pose in {source}: its frame numbers are {_span(poses.numbers)}, those of the scans "
                f"{_span(drive.numbers)}"
            )
    elif poses.stamps is not None and _have_stamps(drive):
        return _by_stamp(drive, poses, source, tick)
    elif total == count:
        how, rows = "in their order", np.arange(count)
    elif drive.numbers is not None and poses.stamps is None and drive.numbers[-1] < total:
        how, rows = "row by frame number, counted from 0", drive.numbers
    else:
        raise ValueError(
            f"{source} has {total} poses for {count} scans, and nothing tells which belongs to which: give as many, "
            "poses with frame numbers (KITTI-360) or stamps (TUM) that the scans have too, or --odometry"
        )
    has = rows >= 0
    placed = np.full((count, 4, 4), np.nan)
    placed[has] = poses.poses[rows[has]]
    if poses.stamps is None:
        stamps = _stamps(drive, rate, tick)
    else:
        stamps = np.full(count, np.nan)
        stamps[has] = poses.stamps[rows[has]]
    return _route(stamps, placed, f"{_counted(has)}, {total} poses of {source} ({poses.format}), {how}")


def _by_stamp(drive: Drive, poses: Poses, source: str, tick: Tick) -> Route:
    known = poses.trajectory()
    t, stamps = known.stamps, _stamps(drive, 1.0, tick)
    with np.errstate(invalid="ignore"):
        inside = (stamps >= t[0]) & (stamps <= t[-1])
    after = np.clip(np.searchsorted(t, stamps), 1, max(len(t) - 1, 1))
    if len(t) > 1:
        inside &= (t[after] - t[after - 1] <= GAP) | np.isin(stamps, t)
    if not inside.any():
        spans = f"{_span(t)} s, those of the scans {_span(stamps[np.isfinite(stamps)])} s"
        raise ValueError(
            f"no scan lies between two poses of {source} that are at most {GAP:g} s apart: its stamps are {spans}; are "
            "they of one clock?"
        )
    placed = np.full((len(drive), 4, 4), np.nan)
    placed[inside] = known.at(stamps[inside])
    how = f"{_counted(inside)}, {len(poses)} poses of {source} ({poses.format}), by stamp"
    return Route(stamps, placed, known, how)


def estimate_trajectory(drive: Drive, method: str, rate: float, tick: Tick) -> Route:
    """Estimate where each scan was taken, from the scans alone.

    Parameters
    ----------
    drive, rate, tick
        As for `matched`.
    method : {"kiss-icp", "small-gicp"}

    Raises
    ------
    ImportError
        If the package is missing.
    ValueError
        If there is no such method, or no scan can be read.
    """
    from ogm.fusion.odometry import odometry

    clock = None if _have_stamps(drive) else _stamps(drive, rate, tick)
    stamps = np.full(len(drive), np.nan)
    taken: list[int] = []
    waiting: deque[NDArray[np.float64] | None] = deque()

    def clouds() -> Iterator[NDArray[np.float32]]:
        """Yield what can be registered; the mapping will complain of the rest."""
        for k in tick(range(len(drive)), f"odometry ({method})"):
            try:
                scan = drive.read(k)
            except UNREADABLE:
                continue
            stamp = scan.stamp if clock is None else clock[k]
            distance = np.linalg.norm(scan.points[:, :3], axis=1)
            enough = np.count_nonzero((distance > RANGE[0]) & (distance < RANGE[1])) >= FEWEST
            if not enough or stamp is None or (taken and not stamp > stamps[taken[-1]]):
                continue
            stamps[k] = stamp
            taken.append(k)
            waiting.append(scan.time if drive.bent else None)
            yield scan.points

    def times() -> Iterator[NDArray[np.float64] | None]:
        while waiting:
            yield waiting.popleft()

    known = odometry(
        clouds(),
        (stamps[k] for k in taken),  # grows as the scans are read
        method,
        times(),
        range_min=RANGE[0],
        range_max=RANGE[1],
    )
    placed = np.full((len(drive), 4, 4), np.nan)
    placed[taken] = known.poses
    return Route(stamps, placed, known, f"{len(taken)} of {len(drive)} scans, estimated by {method}")


def _route(stamps: NDArray[np.float64], poses: NDArray[np.float64], how: str) -> Route:
    known = np.isfinite(stamps) & np.isfinite(poses).all(axis=(1, 2))
    t, first = np.unique(stamps[known], return_index=True)
    if not len(t):
        raise ValueError("no scan has both a pose and a time")
    return Route(stamps, poses, Trajectory(t, poses[known][first]), how)


def _rows(wanted: NDArray[np.int64], given: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return where each number stands among others, -1 where it does not."""
    order = np.argsort(given, kind="stable")
    place = np.clip(np.searchsorted(given[order], wanted), 0, len(given) - 1)
    return np.where(given[order][place] == wanted, order[place], -1)


def _have_stamps(drive: Drive) -> bool:
    """Tell whether the scans say when they were taken: the first that can be read does."""
    for k in range(len(drive)):
        try:
            return drive.read(k).stamp is not None
        except UNREADABLE:
            continue
    return False


def _stamps(drive: Drive, rate: float, tick: Tick) -> NDArray[np.float64]:
    """Return when the scans were taken [s]: as they say, NaN where one cannot be read; else counted by a rate."""
    if not 0 < rate < np.inf:
        raise ValueError(f"--rate must be above 0 [Hz], got {rate}")
    if drive.poses is not None and drive.poses.stamps is not None:
        return drive.poses.stamps
    if not _have_stamps(drive):
        return (np.arange(len(drive)) if drive.numbers is None else drive.numbers) / rate
    stamps = np.full(len(drive), np.nan)
    for k in tick(range(len(drive)), "reading stamps"):
        try:
            stamp = drive.read(k).stamp
        except UNREADABLE:
            continue  # the mapping will complain of it
        stamps[k] = np.nan if stamp is None else stamp
    return stamps


def _counted(has: NDArray[np.bool_]) -> str:
    if has.all():
        return f"{len(has)} scans"
    return f"{np.count_nonzero(has)} of {len(has)} scans have a pose"


def _span(values: NDArray) -> str:
    return f"{values.min():.15g} ... {values.max():.15g}" if len(values) else "none"
