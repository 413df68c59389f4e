"""Object tracking: stable numbers, velocities and turn rates over time, by one Kalman filter per object."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.extras import import_extra
from ogm.fusion.dynamic.objects import Objects

_TOLERANCE = 1e-3  # [s] by which a stamp may precede the last one; both then count as equal
_MAX_TRACKS = 1000  # beyond this, the new objects with least mass get no track


class TrackerSettings(NamedTuple):
    """Parameters for the association and filtering of objects in successive scans.

    Attributes
    ----------
    position_deviation, relative_deviation : float
        Standard deviation of the centre of an object's visible cells [m]: the first plus the second times the length of
        its box.
    correlation : float
        Factor on the standard deviation of measured velocities, since velocities of successive scans are correlated.
    acceleration : float
        Standard deviation of the change of velocity within one second, along each axis [m/s²]; it grows with the root
        of time.
    turn_deviation, turn_acceleration : float
        Standard deviation of turn rates before a measurement [rad/s], and of their change within one second [rad/s²].
    max_turn : float
        Bound of turn rates [rad/s].
    gate : float
        Greatest squared Mahalanobis distance of position and velocity from the prediction.
    confirm : (int, int)
        M and N: a track is confirmed when it was found in M of its last N scans.
    min_speed, min_significance : float
        Least filtered speed of an object for confirmation [m/s], and least Mahalanobis distance of its velocity from 0.
    max_missed : int
        Greatest number of successive scans that miss a track before it ends.
    """

    position_deviation: float = 0.3
    relative_deviation: float = 0.1
    correlation: float = 1.5
    acceleration: float = 1.0
    turn_deviation: float = 0.3
    turn_acceleration: float = 0.3
    max_turn: float = 1.5
    gate: float = 20.0
    confirm: tuple[int, int] = (3, 5)
    min_speed: float = 0.5
    min_significance: float = 2.0
    max_missed: int = 5


class ObjectTracker:
    """Tracker of moving objects from scan to scan.

    The velocity of an object is constant, or turns at a constant rate. Position and velocity share one filter; the
    direction of the velocity and its rate have a second filter (filterpy). Objects are associated with tracks by the
    least sum of Mahalanobis distances. The result is deterministic.

    Parameters
    ----------
    settings : TrackerSettings, optional

    Raises
    ------
    ImportError
        If filterpy is missing.
    """

    settings: TrackerSettings

    def __init__(self, settings: TrackerSettings | None = None) -> None:
        self.settings = TrackerSettings() if settings is None else settings
        self._kalman = import_extra("filterpy.kalman", "track")
        self._assignment = import_extra("scipy.optimize", "track").linear_sum_assignment
        self.reset()

    def __repr__(self) -> str:
        confirmed = sum(bool(track.number) for track in self._tracks)
        return f"ObjectTracker({confirmed} confirmed of {len(self._tracks)} tracks)"

    def reset(self) -> None:
        """End all tracks; numbers start again at 1."""
        self._tracks: list[_Track] = []
        self._next = 1
        self.stamp: float | None = None

    def update(self, objects: Objects, stamp: float) -> Objects:
        """Update the tracks by the objects of a scan; return these with track numbers, turn rates, filtered velocities.

        Parameters
        ----------
        objects : Objects
            In map coordinates.
        stamp : float
            Time of the scan [s], not before the last stamp.

        Returns
        -------
        Objects
            The same objects in the same order. `boxes.track` is the number of a confirmed track, else "". Velocity,
            covariance and turn rate are filtered. Tracks without an object in this scan are left out.

        Raises
        ------
        ValueError
            If the stamp is not finite, or before the last stamp.
        """
        elapsed = 0.0 if self.stamp is None else stamp - self.stamp
        if not -_TOLERANCE <= elapsed < math.inf:
            raise ValueError(f"stamp must be finite and not before the last stamp, {self.stamp} s, got {stamp} s")
        elapsed, self.stamp = max(elapsed, 0.0), stamp
        for track in self._tracks:
            track.predict(elapsed)
        z, R = self._measured(objects)
        of_object = self._associated(z, R)
        for t, track in enumerate(self._tracks):
            track.found.append(t in of_object)
        found: list[_Track | None] = [self._tracks[t] if t >= 0 else None for t in of_object]
        for k, t in enumerate(of_object):
            if t >= 0:
                self._tracks[t].update(z[k], R[k])
        self._tracks = [track for track in self._tracks if track.missed <= self.settings.max_missed]
        for k in np.argsort(-objects.mass, kind="stable"):
            if found[k] is None and len(self._tracks) < _MAX_TRACKS:
                found[k] = _Track(self._kalman, z[k], R[k], self.settings)
                self._tracks.append(found[k])
        for new_track in found:
            if new_track is not None and new_track.confirms():
                new_track.number, self._next = str(self._next), self._next + 1
        return _with_tracks(objects, found)

    def _measured(self, objects: Objects) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return position and velocity of each object (B, 4), and their covariances (B, 4, 4)."""
        boxes = objects.boxes
        deviation = self.settings.position_deviation + self.settings.relative_deviation * boxes.size[:, 0]
        R = np.zeros((len(boxes), 4, 4))
        R[:, [0, 1], [0, 1]] = deviation[:, None] ** 2
        R[:, 2:, 2:] = self.settings.correlation**2 * objects.covariance
        return np.concatenate([boxes.center[:, :2], objects.velocity], axis=1), R

    def _associated(self, z: NDArray[np.float64], R: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the index of the track of each object, (B,); -1 if no track is inside the gate.

        The cost of a pair is twice its negative log-likelihood, without constants.
        """
        of_object = np.full(len(z), -1)
        if not self._tracks or not len(z):
            return of_object
        x, P = (np.stack([getattr(track.motion, name) for track in self._tracks]) for name in ("x", "P"))
        away = z - x[:, None]  # (T, B, 4)
        S = P[:, None] + R
        distance = np.sum(away * np.linalg.solve(S, away[..., None])[..., 0], axis=-1)
        inside = distance <= self.settings.gate
        size = np.linalg.slogdet(S)[1]
        size -= size.min()
        no_pair = self.settings.gate + size.max()  # cost that no pair inside the gate exceeds
        tracks, objects = self._assignment(np.where(inside, distance + size, no_pair))
        good = inside[tracks, objects]
        of_object[objects[good]] = tracks[good]
        return of_object


class _Track:
    """Track of one object over time."""

    def __init__(self, kalman: Any, z: NDArray[np.float64], R: NDArray[np.float64], settings: TrackerSettings) -> None:
        self.settings = settings
        self.number = ""
        self.found = deque([True], maxlen=max(settings.confirm[1], settings.max_missed + 1))
        self.motion = kalman.KalmanFilter(4, 4)  # x, y, and their velocities
        self.motion.x, self.motion.P, self.motion.H = z.copy(), R.copy(), np.eye(4)
        self.turn = kalman.KalmanFilter(2, 1)  # direction of the velocity, not wrapped at pi, and its rate
        heading, variance = _heading(z[2:], R[2:, 2:])
        self.turn.x, self.turn.H = np.array([heading, 0.0]), np.array([[1.0, 0.0]])
        self.turn.P = np.diag([variance, settings.turn_deviation**2])

    @property
    def missed(self) -> int:
        """Number of scans since the object was found."""
        return next((k for k, found in enumerate(reversed(self.found)) if found), len(self.found))

    @property
    def turn_rate(self) -> float:
        """Turn rate of the velocity's direction [rad/s]."""
        return float(np.clip(self.turn.x[1], -self.settings.max_turn, self.settings.max_turn))

    def confirms(self) -> bool:
        """Return whether the object gets a number now."""
        if self.number or sum(list(self.found)[-self.settings.confirm[1] :]) < self.settings.confirm[0]:
            return False
        v, P = self.motion.x[2:], self.motion.P[2:, 2:]
        far = float(v @ np.linalg.solve(P, v)) >= self.settings.min_significance**2
        return far and math.hypot(*v) >= self.settings.min_speed

    def predict(self, dt: float) -> None:
        """Predict the track by `dt` [s], along an arc at the present turn rate."""
        settings, turn = self.settings, self.turn_rate
        F = np.eye(4)
        F[:2, 2:], F[2:, 2:] = arc(turn, dt)
        self.motion.predict(F=F, Q=settings.acceleration**2 * np.kron(integrated_noise(dt), np.eye(2)))
        F = np.array([[1.0, dt], [0.0, 1.0]])
        self.turn.predict(F=F, Q=settings.turn_acceleration**2 * integrated_noise(dt))

    def update(self, z: NDArray[np.float64], R: NDArray[np.float64]) -> None:
        """Update the track by a measured position and velocity."""
        self.motion.update(z, R)
        heading, variance = _heading(z[2:], R[2:, 2:])
        heading -= 2 * math.pi * round((heading - self.turn.x[0]) / (2 * math.pi))  # the nearest equivalent angle
        self.turn.update(heading, variance)


def _heading(velocity: NDArray[np.float64], covariance: NDArray[np.float64]) -> tuple[float, float]:
    """Return the direction of a velocity [rad] and its variance to first order: across / squared speed."""
    vx, vy = velocity
    squared = max(vx * vx + vy * vy, 1e-6)
    across = np.array([-vy, vx]) / math.sqrt(squared)
    return math.atan2(vy, vx), float(across @ covariance @ across) / squared


def _with_tracks(objects: Objects, tracks: Sequence[_Track | None]) -> Objects:
    """Return objects with the numbers, velocities and turn rates of their tracks."""
    names, velocity = [track.number if track else "" for track in tracks], objects.velocity.copy()
    covariance, turn_rate = objects.covariance.copy(), objects.turn_rate.copy()
    for k, track in enumerate(tracks):
        if track is not None:
            velocity[k], covariance[k], turn_rate[k] = track.motion.x[2:], track.motion.P[2:, 2:], track.turn_rate
    boxes = replace(objects.boxes, velocity=velocity, track=names)
    return replace(objects, boxes=boxes, covariance=covariance, turn_rate=turn_rate)


def arc(turn_rate: float, dt: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return matrices (2, 2) from a velocity to the shift within `dt` [s] at a turn rate [rad/s], and to its end value.

    The chord of an arc of length l and turn a is ``l sin(a / 2) / (a / 2)``, in the direction half-way.
    """
    half = 0.5 * turn_rate * dt
    chord = math.sin(half) / half if half else 1.0  # numpy's sinc takes ten times as long for one number
    return dt * chord * _rotation(half), _rotation(2 * half)


def _rotation(angle: float) -> NDArray[np.float64]:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def integrated_noise(dt: float) -> NDArray[np.float64]:
    """Return the covariance (2, 2) of white noise integrated twice and once (Bar-Shalom et al. 2001, 6.2.2-12)."""
    return np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
