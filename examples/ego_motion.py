"""Poses from wheel speed, yaw rate and GNSS: an unscented Kalman filter and its smoother, on simulated drives.

    pip install "ogm-toolkit[track]"  # filterpy
    python examples/ego_motion.py [DRIVES]

A log without poses but with such topics becomes a map after this: `EgoMotion.smoothed` returns an
`ogm.pose.Trajectory`, whose poses go with the scans into `ogm.fusion.EvidentialMapper`. Printed are the errors of the
fixes alone, of dead reckoning, of the filter and of the smoother.
"""

import math
import sys
from typing import Any, NamedTuple

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

from ogm.pose import Trajectory, pose

STATE = ("x", "y", "yaw", "speed", "yaw_rate")  # [m], [m], [rad], [m/s], [rad/s]
ROWS = {"speed": [3], "yaw_rate": [4], "position": [0, 1], "pose": [0, 1, 2]}  # of the state that each kind measures
MAX_STEP = 0.25  # [s] of one prediction; longer gaps are split, because the noise turns with the vehicle
GNSS, WHEELS, GYRO = 1.0, 0.2, 0.02  # deviations of the simulated sensors [m], [m/s], [rad/s]
SECONDS, STEP = 20.0, 0.01  # [s] of a simulated drive
START = np.array([0.5, 0.5, 0.05, 0.5, 0.05])  # deviations of its first state


class Step(NamedTuple):
    """One step of the filter, which the smoother goes back over."""

    stamp: float
    x: NDArray[np.float64]  # (5,) after all measurements of that stamp
    P: NDArray[np.float64]
    x_predicted: NDArray[np.float64]  # before them, from the previous step
    P_predicted: NDArray[np.float64]
    C: NDArray[np.float64]  # (5, 5) covariance of the previous state with the predicted one


class EgoMotion:
    """Position and motion of a vehicle on the plane, from measurements in the order of their stamps.

    Constant turn rate and velocity between measurements (CTRV; Schubert et al., FUSION 2008), by filterpy's unscented
    filter (Wan and van der Merwe 2000). A measurement that is less likely than `gate` is refused; the `patience`-th of
    one kind in a row is accepted with a widened covariance, since then the filter is wrong.
    """

    def __init__(
        self,
        stamp: float,
        state: ArrayLike,
        deviation: ArrayLike,
        acceleration: float = 1.5,
        yaw_acceleration: float = 0.5,
    ) -> None:
        # alpha 1 and kappa 0: no negative weight, so each covariance stays positive, however uncertain the yaw
        self.points = MerweScaledSigmaPoints(5, 1.0, 2.0, 0.0)
        self.filter = UnscentedKalmanFilter(5, 1, 1.0, hx=None, fx=move, points=self.points)
        self.filter.x, self.filter.P = np.array(state, np.float64), np.diag(np.square(deviation))
        self.stamp, self.noise = stamp, (acceleration**2, yaw_acceleration**2)
        self.gate, self.patience = 0.999, 5
        self.in_a_row = dict.fromkeys(ROWS, 0)
        self.steps: list[Step] = []
        self.keep(np.zeros((5, 5)))

    def measure(self, kind: str, stamp: float, value: ArrayLike, deviation: ArrayLike) -> bool:
        """Predict up to `stamp` and correct by a measurement; return whether it was accepted."""
        rows = ROWS[kind]
        z = np.atleast_1d(np.array(value, np.float64))
        R = np.diag(np.broadcast_to(np.square(deviation), z.shape))
        self.predict(stamp)
        if kind == "pose":  # the equivalent yaw that is nearest
            z[2] -= 2 * math.pi * round((z[2] - self.filter.x[2]) / (2 * math.pi))
        limit = float(chi2.ppf(self.gate, len(rows)))
        if self.distance(z, R, rows) > limit:
            self.in_a_row[kind] += 1
            if self.in_a_row[kind] < self.patience:
                return False
            before = self.filter.P.copy()
            wider = np.zeros((5, 5))  # what is measured alone: a jump of the position does not concern the yaw
            wider[rows, rows] = np.maximum(np.diag(R), np.diag(before)[rows])
            while self.distance(z, R, rows) > limit:
                self.filter.P = self.filter.P + wider
                wider *= 2
            self.keep(before)
        self.in_a_row[kind] = 0
        self.filter.sigmas_f = self.points.sigma_points(self.filter.x, self.filter.P)
        self.filter.update(z, R, hx=lambda x: x[rows])
        self.filter.P = symmetric(self.filter.P)
        self.steps[-1] = self.steps[-1]._replace(x=self.filter.x.copy(), P=self.filter.P.copy())
        return True

    def predict(self, stamp: float) -> None:
        """Move the state on to a stamp, in steps that are short enough."""
        begin, gap = self.stamp, max(stamp - self.stamp, 0.0)
        count = math.ceil(gap / MAX_STEP)
        for k in range(1, count + 1):
            dt = begin + gap * k / count - self.stamp
            yaw = self.filter.x[2] + 0.5 * dt * self.filter.x[4]
            before = self.filter.x.copy()
            sigmas = self.points.sigma_points(before, self.filter.P)
            self.filter.Q = process_noise(dt, yaw, *self.noise)
            self.filter.predict(dt)
            self.filter.P = symmetric(self.filter.P)
            self.stamp += dt
            moved = np.array([move(sigma, dt) for sigma in sigmas]) - self.filter.x
            self.keep((self.points.Wc * (sigmas - before).T) @ moved)

    def distance(self, z: NDArray[np.float64], R: NDArray[np.float64], rows: list[int]) -> float:
        """Return the squared Mahalanobis distance of a measurement from the prediction."""
        away = z - self.filter.x[rows]
        return float(away @ np.linalg.solve(self.filter.P[np.ix_(rows, rows)] + R, away))

    def keep(self, C: NDArray[np.float64]) -> None:
        x, P = self.filter.x.copy(), self.filter.P.copy()
        self.steps.append(Step(self.stamp, x, P, x, P, C))

    def filtered(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return stamps (K,) and states (K, 5), each from the measurements up to it."""
        return self.states([step.x for step in self.steps])

    def smoothed(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return stamps (K,) and states (K, 5) from all measurements, by Rauch, Tung and Striebel (Sarkka 2008)."""
        x = [self.steps[-1].x]
        for step, after in zip(self.steps[-2::-1], self.steps[:0:-1], strict=True):
            x.append(step.x + np.linalg.solve(after.P_predicted, after.C.T).T @ (x[-1] - after.x_predicted))
        return self.states(x[::-1])

    def states(self, x: list[NDArray[np.float64]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        stamps = np.array([step.stamp for step in self.steps])
        last = np.append(np.diff(stamps) > 0, True)  # of several steps at one stamp
        return stamps[last], np.array(x)[last]


def trajectory(stamps: NDArray[np.float64], states: NDArray[np.float64]) -> Trajectory:
    """Return ``T_map_vehicle`` at each stamp, on the plane."""
    return Trajectory(stamps, np.array([pose(x, y, yaw=yaw) for x, y, yaw, _, _ in states]))


def move(state: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
    """Return the state `dt` [s] later at constant speed and yaw rate: on an arc, of which this is the chord."""
    x, y, yaw, speed, yaw_rate = state
    half = 0.5 * yaw_rate * dt
    chord = speed * dt * np.sinc(half / math.pi)
    return np.array(
        [x + chord * math.cos(yaw + half), y + chord * math.sin(yaw + half), yaw + 2 * half, speed, yaw_rate]
    )


def process_noise(dt: float, yaw: float, speed: float, turn: float) -> NDArray[np.float64]:
    """Return the covariance (5, 5) that white accelerations add (Bar-Shalom, Li, Kirubarajan 2001, eq. 6.2.2-12).

    `speed` and `turn` are the growth of the variance of speed [m^2/s^3] and of yaw rate [rad^2/s^3].
    """
    grown = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    along, around = np.zeros((5, 2)), np.zeros((5, 2))
    along[0, 0], along[1, 0], along[3, 1] = math.cos(yaw), math.sin(yaw), 1
    around[2, 0] = around[4, 1] = 1
    noise: NDArray[np.float64] = speed * along @ grown @ along.T + turn * around @ grown @ around.T
    return noise


def symmetric(P: NDArray[np.float64]) -> NDArray[np.float64]:
    return 0.5 * (P + P.T)


def simulate(rng: np.random.Generator) -> tuple[NDArray[np.float64], list[tuple[str, float, Any, float]]]:
    """Return the true states, one per `STEP`, and what the sensors measure: kind, stamp, value, deviation."""
    states = [np.array([0, 0, rng.uniform(-math.pi, math.pi), 8, 0])]
    for _ in range(round(SECONDS / STEP)):
        noise = rng.normal(size=2) * math.sqrt(STEP)
        states.append(move(states[-1], STEP) + [0, 0, 0, noise[0], 0.2 * noise[1]])
    measured: list[tuple[str, float, Any, float]] = []
    for k in range(5, len(states), 5):
        stamp, state = k * STEP, states[k]
        measured.append(("yaw_rate", stamp, state[4] + rng.normal(0, GYRO), GYRO))
        if k % 10 == 0:
            measured.append(("speed", stamp, state[3] + rng.normal(0, WHEELS), WHEELS))
        if k % 50 == 0:
            measured.append(("position", stamp, state[:2] + rng.normal(0, GNSS, 2), GNSS))
    return np.array(states), measured


def compare(drives: int) -> dict[str, float]:
    """Return the mean error of the position [m] of each way to get poses, over some drives."""
    errors: dict[str, list[float]] = {name: [] for name in ("fixes", "dead reckoning", "filter", "smoother")}
    for seed in range(drives):
        rng = np.random.default_rng(seed)
        states, measured = simulate(rng)
        start = states[0] + rng.normal(size=5) * START
        ego, blind = (EgoMotion(0.0, start, START, acceleration=1.0, yaw_acceleration=0.2) for _ in range(2))
        for measurement in measured:
            ego.measure(*measurement)
            if measurement[0] != "position":
                blind.measure(*measurement)
        fixes = [(stamp, value) for kind, stamp, value, _ in measured if kind == "position"]
        found = {"dead reckoning": blind.filtered(), "filter": ego.filtered(), "smoother": ego.smoothed()}
        found["fixes"] = np.array([stamp for stamp, _ in fixes]), np.array([value for _, value in fixes])
        for name, (stamps, positions) in found.items():
            off = positions[:, :2] - states[np.rint(stamps / STEP).astype(int), :2]
            errors[name].append(float(np.sqrt(np.mean(np.sum(off**2, axis=1)))))
    return {name: float(np.mean(values)) for name, values in errors.items()}


if __name__ == "__main__":
    drives = int(sys.argv[1]) if len(sys.argv) > 1 else 30
    for name, error in compare(drives).items():
        print(f"{name:15s} {error:.2f} m")
