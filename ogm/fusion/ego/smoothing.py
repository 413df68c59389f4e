"""The vehicle's own motion on the plane, from wheels, gyro and fixes: an unscented filter and its smoother."""

import logging
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.extras import import_extra
from ogm.pose import Trajectory, check_pose

__all__ = ["EgoMotion", "EgoStates"]

log: logging.Logger = logging.getLogger(__name__)

_X, _Y, _YAW, _SPEED, _YAW_RATE = range(5)
_TOLERANCE = 1e-3  # [s] by which a stamp may lie before the last one; it then counts as equal
_LONGEST_GAP = 60.0  # [s] between two measurements, above which a stamp is an error
_MAX_STEP = 0.25  # [s] of one prediction; longer ones are split, because the noise turns with the vehicle


class EgoStates(NamedTuple):
    """States of the vehicle over time.

    Attributes
    ----------
    stamps : (K,) float64
        [s], increasing.
    states : (K, 5) float64
        x, y [m] and yaw [rad] in the map, speed along the vehicle's x axis [m/s], yaw rate [rad/s]. The yaw goes on
        beyond pi: it does not jump.
    covariances : (K, 5, 5) float64
        Of those, in the same units.
    """

    stamps: NDArray[np.float64]
    states: NDArray[np.float64]
    covariances: NDArray[np.float64]

    def trajectory(self) -> Trajectory:
        """Return ``T_map_vehicle`` at each stamp, on the plane: z, roll and pitch are 0."""
        poses = np.broadcast_to(np.eye(4), (len(self.stamps), 4, 4)).copy()
        cosine, sine = np.cos(self.states[:, _YAW]), np.sin(self.states[:, _YAW])
        poses[:, 0, 0] = poses[:, 1, 1] = cosine
        poses[:, 0, 1], poses[:, 1, 0] = -sine, sine
        poses[:, :2, 3] = self.states[:, :2]
        return Trajectory(self.stamps, poses)


class _Node(NamedTuple):
    """One step of the filter, as the smoother needs it."""

    stamp: float
    x: NDArray[np.float64]  # after all measurements of that stamp
    P: NDArray[np.float64]
    predicted: NDArray[np.float64]  # before them, from the node before
    P_predicted: NDArray[np.float64]
    C: NDArray[np.float64]  # (5, 5) covariance of the node before with the prediction from it


class EgoMotion:
    """Where the vehicle is and how it moves, from measurements in the order of their stamps.

    The state is x, y, yaw, speed and yaw rate, at constant turn rate and velocity between measurements (CTRV; Schubert
    et al., FUSION 2008). The filter is the unscented one (Wan and van der Merwe 2000, by filterpy). Measurements have
    their own stamps, and any number may share one; each is accepted, or refused where it is less likely than `gate`
    allows. Every stamp is kept for `smoothed`: about 1 kB each.

    A filter that diverged refuses right measurements. So the `patience`-th measurement of one kind that would be
    refused in a row is accepted: the covariance of what it measures is doubled until it passes the gate. `smoothed`
    does not reach back across such a step.

    Parameters
    ----------
    stamp : float
        When it begins [s].
    T_map_vehicle : (4, 4) array, optional
        Where; by default the map begins there. Only x, y and yaw are taken.
    speed, yaw_rate : float
        [m/s], [rad/s], then.
    deviation : 5 float
        How well x, y [m], yaw [rad], speed [m/s] and yaw rate [rad/s] are known then, 1 sigma each, above 0.
        An unknown heading has pi / 2; fixes much more precise than their distance then need a gyro, or a heading
        taken from the first two of them: the filter is local, and may converge to a wrong heading.
    acceleration : float
        By how much the speed changes within a second, 1 sigma [m/s^2]; the change grows with the root of time.
    yaw_acceleration : float
        The same of the yaw rate [rad/s^2].
    gate : float
        Share of right measurements that are accepted, below 1; 1 accepts all there are.
    patience : int
        See above; at least 1.

    Attributes
    ----------
    stamp : float
        Time of the state [s].
    refused : dict of str to int
        Number of refused measurements of each kind.

    Raises
    ------
    ValueError
        If a number is not finite or out of its range, or `T_map_vehicle` is no rigid transform.
    ImportError
        If filterpy is not there.
    """

    stamp: float

    def __init__(
        self,
        stamp: float,
        T_map_vehicle: ArrayLike | None = None,
        *,
        speed: float = 0.0,
        yaw_rate: float = 0.0,
        deviation: Sequence[float] = (0.01, 0.01, 0.001, 10.0, 0.5),
        acceleration: float = 1.5,
        yaw_acceleration: float = 0.5,
        gate: float = 0.999,
        patience: int = 5,
    ) -> None:
        kalman = import_extra("filterpy.kalman", "track")
        T = check_pose(np.eye(4) if T_map_vehicle is None else T_map_vehicle, "T_map_vehicle")
        start = [T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0]), speed, yaw_rate]
        sigmas = _deviations(deviation, 5)
        for name, value in {"stamp": stamp, "speed": speed, "yaw_rate": yaw_rate}.items():
            if not math.isfinite(value):
                raise ValueError(f"{name} must be finite, got {value!r}")
        for name, value in {"acceleration": acceleration, "yaw_acceleration": yaw_acceleration}.items():
            if not 0 < value < math.inf:
                raise ValueError(f"{name} must be above 0 and finite, got {value}")
        if not 0 < gate <= 1:
            raise ValueError(f"gate must lie in (0, 1], the share of right measurements to accept, got {gate}")
        if patience < 1:
            raise ValueError(f"patience must be 1 or more, got {patience}")
        # alpha 1 and kappa 0: no negative weight, so every covariance is one, however uncertain the yaw
        self._points = kalman.MerweScaledSigmaPoints(5, 1.0, 2.0, 0.0)
        self._filter = kalman.UnscentedKalmanFilter(5, 1, 1.0, hx=None, fx=_move, points=self._points)
        self._filter.x, self._filter.P = np.array(start, np.float64), np.diag(sigmas**2)
        self._noise = acceleration**2, yaw_acceleration**2
        # Quantiles of chi-square for 1, 2 and 3 measured numbers; scipy.stats would be a slow import.
        quantile = import_extra("scipy.special", "track").gammaincinv  # filterpy brings it
        self._limits = {count: 2 * float(quantile(count / 2, gate)) for count in (1, 2, 3)}
        self._patience = patience
        self._in_a_row = dict.fromkeys(("speed", "yaw_rate", "position", "pose"), 0)
        self.refused: dict[str, int] = dict.fromkeys(self._in_a_row, 0)
        self.stamp = float(stamp)
        self._nodes: list[_Node] = []
        self._note(np.zeros((5, 5)))

    @property
    def state(self) -> NDArray[np.float64]:
        """x, y [m], yaw [rad], speed [m/s], yaw rate [rad/s], (5,)."""
        state: NDArray[np.float64] = self._filter.x.copy()
        return state

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Of the state, (5, 5)."""
        covariance: NDArray[np.float64] = self._filter.P.copy()
        return covariance

    def speed(self, stamp: float, value: float, deviation: float) -> bool:
        """Take in a speed along the vehicle's x axis, of the wheels [m/s]; negative is backwards.

        `stamp` is in seconds, `deviation` 1 sigma, above 0.

        Returns
        -------
        bool
            Whether it was accepted; `refused` counts those that were not. The state moves on to `stamp` either way.

        Raises
        ------
        ValueError
            If a number is not finite or out of its range, or `stamp` lies before the last one by more than a
            millisecond or after it by more than a minute. Then nothing has changed.
        """
        return self._measure("speed", stamp, [value], deviation, [_SPEED])

    def yaw_rate(self, stamp: float, value: float, deviation: float) -> bool:
        """Take in a yaw rate, of a gyro [rad/s], to the left; all else as `speed`."""
        return self._measure("yaw_rate", stamp, [value], deviation, [_YAW_RATE])

    def position(self, stamp: float, xy: ArrayLike, deviation: ArrayLike) -> bool:
        """Take in a position in the map, of GNSS: x, y [m]; `deviation` is one number or one each; else as `speed`."""
        return self._measure("position", stamp, xy, deviation, [_X, _Y])

    def pose(self, stamp: float, pose: ArrayLike, deviation: ArrayLike) -> bool:
        """Take in a pose in the map, of a registration.

        `pose` is x, y [m] and yaw [rad], or ``T_map_vehicle`` (4, 4); `deviation` is of x, y and yaw; else as `speed`.
        """
        value = np.asarray(pose, np.float64)
        if value.shape == (4, 4):
            T = check_pose(value)
            value = np.array([T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])])
        return self._measure("pose", stamp, value, deviation, [_X, _Y, _YAW])

    def filtered(self) -> EgoStates:
        """Return the states at each stamp, from the measurements up to it."""
        return self._motion([node.x for node in self._nodes], [node.P for node in self._nodes])

    def smoothed(self) -> EgoStates:
        """Return the states from all measurements, by the smoother of Rauch, Tung and Striebel (Sarkka 2008)."""
        x, P = [self._nodes[-1].x], [self._nodes[-1].P]
        for node, after in zip(self._nodes[-2::-1], self._nodes[:0:-1], strict=True):
            gain = np.linalg.solve(after.P_predicted, after.C.T).T
            x.append(node.x + gain @ (x[-1] - after.predicted))
            P.append(_symmetric(node.P + gain @ (P[-1] - after.P_predicted) @ gain.T))
        return self._motion(x[::-1], P[::-1])

    def _motion(self, states: list[NDArray[np.float64]], covariances: list[NDArray[np.float64]]) -> EgoStates:
        stamps = np.array([node.stamp for node in self._nodes])
        last = np.append(np.diff(stamps) > 0, True)  # of several nodes at one stamp
        return EgoStates(stamps[last], np.array(states)[last], np.array(covariances)[last])

    def _measure(self, kind: str, stamp: float, value: ArrayLike, deviation: ArrayLike, rows: list[int]) -> bool:
        sigmas, z = _deviations(deviation, len(rows)), np.array(value, np.float64)
        if z.shape != (len(rows),) or not np.isfinite(z).all():
            raise ValueError(f"a {kind} must be {len(rows)} finite numbers, got {value!r}")
        stamp = float(stamp)
        gap = stamp - self.stamp
        if not -_TOLERANCE <= gap <= _LONGEST_GAP:
            raise ValueError(
                f"this {kind} has the stamp {stamp!r} s, {gap:+.6g} s from the last one; wanted between "
                f"{-_TOLERANCE:+g} and {_LONGEST_GAP:+g} s: sort the measurements by stamp, or start a new "
                "filter after a gap"
            )
        self._advance(stamp)
        if _YAW in rows:  # of all equivalent yaws, the nearest
            k = rows.index(_YAW)
            z[k] -= 2 * math.pi * round((z[k] - self._filter.x[_YAW]) / (2 * math.pi))
        return self._update(kind, z, np.diag(sigmas**2), rows)

    def _advance(self, stamp: float) -> None:
        """Predict up to `stamp`, in steps that are short enough."""
        gap = max(stamp - self.stamp, 0.0)
        begin, count = self.stamp, math.ceil(gap / _MAX_STEP)
        for step in range(1, count + 1):
            until = stamp if step == count else begin + gap * step / count
            dt = until - self.stamp
            before, yaw = self._filter.x.copy(), self._filter.x[_YAW] + 0.5 * dt * self._filter.x[_YAW_RATE]
            sigmas = self._points.sigma_points(before, self._filter.P)
            self._filter.Q = _noise(dt, yaw, *self._noise)
            self._filter.predict(dt)
            self._filter.P = _symmetric(self._filter.P)
            moved = np.array([_move(one, dt) for one in sigmas]) - self._filter.x
            self.stamp = until
            self._note((self._points.Wc * (sigmas - before).T) @ moved)

    def _update(self, kind: str, z: NDArray[np.float64], R: NDArray[np.float64], rows: list[int]) -> bool:
        limit = self._limits[len(rows)]
        if self._distance(z, R, rows) > limit:
            if self._in_a_row[kind] + 1 < self._patience:
                self._in_a_row[kind] += 1
                self.refused[kind] += 1
                return False
            log.warning("%s at %.3f s: %d in a row did not fit; the state is widened", kind, self.stamp, self._patience)
            before = self._filter.P.copy()
            wider = np.zeros_like(before)  # of what is measured: a jump of the position does not concern the yaw
            wider[rows, rows] = np.maximum(np.diag(R), np.diag(before)[rows])
            while self._distance(z, R, rows) > limit:
                self._filter.P = self._filter.P + wider
                wider *= 2
            self._note(before)
        self._in_a_row[kind] = 0
        self._filter.sigmas_f = self._points.sigma_points(self._filter.x, self._filter.P)
        self._filter.update(z, R, hx=lambda x: x[rows])
        self._filter.P = _symmetric(self._filter.P)
        self._nodes[-1] = self._nodes[-1]._replace(x=self._filter.x.copy(), P=self._filter.P.copy())
        return True

    def _distance(self, z: NDArray[np.float64], R: NDArray[np.float64], rows: list[int]) -> float:
        """Return the squared Mahalanobis distance of a measurement from the prediction."""
        away = z - self._filter.x[rows]
        return float(away @ np.linalg.solve(self._filter.P[np.ix_(rows, rows)] + R, away))

    def _note(self, C: NDArray[np.float64]) -> None:
        x, P = self._filter.x.copy(), self._filter.P.copy()
        self._nodes.append(_Node(self.stamp, x, P, x, P, C))


def _move(state: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
    """Return the state `dt` [s] later at constant speed and yaw rate: an arc, or a straight line.

    The chord of an arc of length l and turn a is ``l sin(a / 2) / (a / 2)``, in the direction half-way.
    """
    x, y, yaw, speed, yaw_rate = state
    half = 0.5 * yaw_rate * dt
    chord = speed * dt * np.sinc(half / math.pi)
    middle = yaw + half
    return np.array([x + chord * math.cos(middle), y + chord * math.sin(middle), yaw + 2 * half, speed, yaw_rate])


def _noise(dt: float, yaw: float, speed: float, turn: float) -> NDArray[np.float64]:
    """Return the covariance, (5, 5), that white accelerations add within `dt` [s] at a mean yaw [rad].

    `speed` and `turn` are the growth of the variance of speed [m^2/s^3] and of yaw rate [rad^2/s^3].
    """
    # Of one integrated twice and once (Bar-Shalom, Li, Kirubarajan 2001, eq. 6.2.2-12).
    grown = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    along, around = np.zeros((5, 2)), np.zeros((5, 2))
    along[_X, 0], along[_Y, 0], along[_SPEED, 1] = math.cos(yaw), math.sin(yaw), 1
    around[_YAW, 0] = around[_YAW_RATE, 1] = 1
    noise: NDArray[np.float64] = speed * along @ grown @ along.T + turn * around @ grown @ around.T
    return noise


def _symmetric(P: NDArray[np.float64]) -> NDArray[np.float64]:
    return 0.5 * (P + P.T)


def _deviations(value: ArrayLike, count: int) -> NDArray[np.float64]:
    sigmas = np.asarray(value, np.float64)
    if sigmas.shape != (count,) and (sigmas.shape != () or count > 2):
        raise ValueError(f"deviation must be {count} numbers, got {value!r}")
    if not ((sigmas > 0) & (sigmas < math.inf)).all():
        raise ValueError(f"deviation must be above 0 and finite, 1 sigma, got {value!r}")
    return np.broadcast_to(sigmas, (count,))
