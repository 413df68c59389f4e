"""Transforms between pairs of frames over time, chained and interpolated."""

import logging
import math
from bisect import bisect_left, bisect_right
from collections import deque
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.io.reading import rigid
from ogm.pose import Trajectory, inverse
from ogm.storage.files import OgmError

__all__ = [
    "ExtrapolationError", "NotConnectedError", "StampedTransform", "TransformBuffer", "TransformError",
    "UnknownFrameError", "frame_name",
]  # fmt: skip

log: logging.Logger = logging.getLogger(__name__)


_CHANGE = 0.01  # [m], and for the numbers of a rotation


def frame_name(name: object) -> str:
    """Return a frame name without surrounding slashes, blanks and zeros, which some drivers add."""
    return str(name).strip("/ \t\0")


class TransformError(OgmError):
    """A transform between two frames is unknown at a time."""


class UnknownFrameError(TransformError):
    """There is no transform from or to a frame."""


class NotConnectedError(TransformError):
    """There is no chain of transforms between two frames."""


class ExtrapolationError(TransformError):
    """A chain of transforms is known, but not at the requested time.

    Attributes
    ----------
    seconds : float
        Distance from the known times [s]: above 0 for a later time, so that waiting may help; below 0 for an earlier
        time; 0 in a gap.
    """

    def __init__(self, message: str, seconds: float) -> None:
        super().__init__(message)
        self.seconds = seconds


class StampedTransform(NamedTuple):
    """Pose of a frame in its parent frame at a time.

    Attributes
    ----------
    parent, child : str
    stamp : float
        [s]
    T_parent_child : (4, 4) float64
    """

    parent: str
    child: str
    stamp: float
    T_parent_child: NDArray[np.float64]


class _Edge:
    """Transforms of one pair of frames: a static one, or several in the order of their stamps."""

    def __init__(self) -> None:
        self.static: NDArray[np.float64] | None = None
        self.stamps: list[float] = []
        self.poses: list[NDArray[np.float64]] = []

    @property
    def span(self) -> tuple[float, float]:
        """First and last stamp [s]."""
        return (-math.inf, math.inf) if self.static is not None else (self.stamps[0], self.stamps[-1])


class TransformBuffer:
    """Transforms between frames, from ``/tf``, ``/tf_static``, odometry or calibration.

    Positions are interpolated linearly, rotations on the shortest arc. Nothing is extrapolated. A frame may have
    several parents; the chain with the fewest transforms is used.

    Parameters
    ----------
    max_gap : float
        Longest time between two transforms of a pair that is interpolated [s].
    keep : float, optional
        Time for which transforms are kept, counted back from the latest of their pair [s], for live use. Default: all.

    Examples
    --------
    >>> from ogm.pose import pose
    >>> buffer = TransformBuffer()
    >>> buffer.add(StampedTransform("base", "lidar", 0.0, pose(z=1.8)), static=True)
    >>> buffer.add(StampedTransform("map", "base", 10.0, pose(x=4.0)))
    >>> buffer.add(StampedTransform("map", "base", 11.0, pose(x=6.0)))
    >>> buffer.lookup("map", "lidar", 10.5)[:3, 3]
    array([5. , 0. , 1.8])
    """

    def __init__(self, max_gap: float = 2.0, keep: float | None = None) -> None:
        self.max_gap, self.keep = max_gap, keep
        self._edges: dict[tuple[str, str], _Edge] = {}
        self._neighbours: dict[str, list[str]] = {}
        self._chains: dict[tuple[str, str], list[str]] = {}

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of all frames, in the order of their first transforms."""
        return tuple(self._neighbours)

    @property
    def pairs(self) -> dict[tuple[str, str], bool]:
        """(parent, child) of all transforms, and whether they are static."""
        return {pair: edge.static is not None for pair, edge in self._edges.items()}

    def add(self, transform: StampedTransform, static: bool = False) -> None:
        """Add a transform.

        Of several with the same stamp, the first is used, as in tf2; of several static ones of a pair, the last. A
        static transform holds at all times and replaces the others of its pair.

        Raises
        ------
        OgmError
            If a name is empty, the names are equal, the stamp is not finite or the transform not rigid.
        """
        parent, child, stamp = transform.parent, transform.child, float(transform.stamp)
        where = f"the transform from {child!r} to {parent!r} at {stamp:.6f} s"
        if not parent or not child or parent == child or not math.isfinite(stamp):
            raise OgmError(f"{where} must have two different frames and a finite stamp")
        T = rigid(transform.T_parent_child, where)
        if (parent, child) not in self._edges:
            self._connect(parent, child)
        edge, T = self._edges[parent, child], T.copy()
        if static:
            edge.static = T
            return
        at = bisect_left(edge.stamps, stamp)
        if at < len(edge.stamps) and edge.stamps[at] == stamp:
            return
        edge.stamps.insert(at, stamp)
        edge.poses.insert(at, T)
        if self.keep is not None:
            old = bisect_left(edge.stamps, edge.stamps[-1] - self.keep)
            del edge.stamps[:old], edge.poses[:old]

    def lookup(self, target: str, source: str, stamp: ArrayLike) -> NDArray[np.float64]:
        """Return the transform between two frames at some times.

        Parameters
        ----------
        target, source : str
            Names of frames.
        stamp : float or (M,) float
            Times [s].

        Returns
        -------
        T_target_source : (4, 4) or (M, 4, 4) float64
            Transform of coordinates in `source` to `target`.

        Raises
        ------
        UnknownFrameError
            If there is no such frame.
        NotConnectedError
            If no chain of transforms joins the two.
        ExtrapolationError
            If a transform of the chain is unknown at a time: before its first, after its last, or in a gap longer than
            `max_gap`.
        ValueError
            If a stamp is not finite.
        """
        times = np.asarray(stamp, np.float64)
        if not np.isfinite(times).all():
            raise ValueError(f"stamps must be finite [s], got {times}")
        T = np.broadcast_to(np.eye(4), (*times.shape, 4, 4))
        for outer, inner in pairwise(self.chain(target, source)):
            T = T @ self._step(outer, inner, times)
        return T.copy()

    def covers(self, target: str, source: str) -> tuple[float, float]:
        """Return the first and last time [s] at which `lookup` may succeed; infinite for static chains.

        Raises
        ------
        UnknownFrameError, NotConnectedError
            See `lookup`.
        """
        spans = [self._edges[self._pair(*pair)].span for pair in pairwise(self.chain(target, source))]
        return max((first for first, _ in spans), default=-math.inf), min((last for _, last in spans), default=math.inf)

    def changes(self, target: str, source: str, by: float = _CHANGE) -> bool:
        """Return whether a transform between two frames changes.

        Parameters
        ----------
        target, source : str
        by : float
            Largest change that is ignored [m], also for the numbers of a rotation.

        Raises
        ------
        UnknownFrameError, NotConnectedError
            See `lookup`.
        """
        edges = [self._edges[self._pair(*pair)] for pair in pairwise(self.chain(target, source))]
        several = [np.array(edge.poses)[:, :3] for edge in edges if edge.static is None and len(edge.poses) > 1]
        return any(bool((np.ptp(rows, axis=0) > by).any()) for rows in several)

    def _connect(self, parent: str, child: str) -> None:
        if others := [other for other, frame in self._edges if frame == child]:
            log.warning("frame %s has several parents, %s: the shortest chain counts", child, [*others, parent])
        self._edges[parent, child] = _Edge()
        for frame, neighbour in ((parent, child), (child, parent)):
            self._neighbours.setdefault(frame, []).append(neighbour)
        self._chains.clear()

    def chain(self, target: str, source: str) -> list[str]:
        """Return the shortest chain of frames from `target` to `source`, both included.

        Raises
        ------
        UnknownFrameError, NotConnectedError
            See `lookup`.
        """
        for name in (target, source):
            if name not in self._neighbours:
                known = ", ".join(self._neighbours) or "none: no transform was added"
                raise UnknownFrameError(f"there is no frame {name!r}; known frames are {known}")
        if (target, source) not in self._chains:
            before, queue = {target: target}, deque([target])
            while queue and source not in before:
                frame = queue.popleft()
                for neighbour in self._neighbours[frame]:
                    if neighbour not in before:
                        before[neighbour] = frame
                        queue.append(neighbour)
            if source not in before:
                raise NotConnectedError(
                    f"{target} and {source} are not connected: {target} is connected to "
                    f"{', '.join(sorted(before.keys() - {target}))}, but no transform leads from there to {source}"
                )
            chain = [source]
            while chain[-1] != target:
                chain.append(before[chain[-1]])
            self._chains[target, source] = chain[::-1]
        return self._chains[target, source]

    def _pair(self, frame: str, neighbour: str) -> tuple[str, str]:
        """Return two neighbours as (parent, child)."""
        return (frame, neighbour) if (frame, neighbour) in self._edges else (neighbour, frame)

    def _step(self, outer: str, inner: str, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return T_outer_inner of two neighbours."""
        parent, child = self._pair(outer, inner)
        edge, up = self._edges[parent, child], child == outer
        if edge.static is not None:
            return inverse(edge.static) if up else edge.static
        if not times.size:
            return np.empty((*times.shape, 4, 4))
        earliest, latest = float(times.min()), float(times.max())
        t, (first, last) = edge.stamps, edge.span
        if earliest < first or latest > last:
            seconds, asked = (latest - last, latest) if latest > last else (earliest - first, earliest)
            raise ExtrapolationError(
                f"the transform from {child} to {parent} needs extrapolation by {abs(seconds):.3g} s: requested at "
                f"{asked:.6f} s, known from {first:.6f} to {last:.6f} s",
                seconds,
            )
        rows = slice(bisect_right(t, earliest) - 1, bisect_left(t, latest) + 1)
        known = Trajectory(np.array(t[rows]), np.array(edge.poses[rows]))
        self._check_gaps(known.stamps, times, f"the transform from {child} to {parent}")
        T = known.at(times)
        if not up:
            return T
        R = np.swapaxes(T[..., :3, :3], -1, -2)
        T[..., :3, 3] = -(R @ T[..., :3, 3, None])[..., 0]
        T[..., :3, :3] = R
        return T

    def _check_gaps(self, t: NDArray[np.float64], times: NDArray[np.float64], where: str) -> None:
        after = np.clip(np.searchsorted(t, times), 1, max(len(t) - 1, 1))
        bad = len(t) > 1 and (t[after] - t[after - 1] > self.max_gap) & ~np.isin(times, t)
        if np.any(bad):
            k = after[bad].flat[0] if after.ndim else after
            raise ExtrapolationError(
                f"{where} has a gap of {t[k] - t[k - 1]:.3g} s, from {t[k - 1]:.6f} to {t[k]:.6f} s, allowed are "
                f"{self.max_gap:g} s",
                0.0,
            )
