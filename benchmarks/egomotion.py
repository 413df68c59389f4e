"""Errors of de-skewing and of the ego motion filter, on simulated drives with exact poses.

    python benchmarks/egomotion.py [--frames N] [--drives N]

De-skewing: a VLP-32C (10 Hz) drives through a simulated town; every scan is cast twice, distorted by the ego motion and
as if all of it were measured at once. Distances are those of static points above the ground from the planes of
the map of undistorted scans. Filtering: drives of 20 s by the filter's own model (white accelerations of
1 m/s^2 and 0.2 rad/s^2), wheels 0.2 m/s at 10 Hz, gyro 0.02 rad/s at 20 Hz, fixes 1 m at 2 Hz. Writes
benchmarks/results/egomotion.json.
"""

import _run as run  # first: it sets the number of threads

# isort: split
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import chi2

from ogm.fusion import EgoMotion, deskew, extrapolate
from ogm.pose import Trajectory, pose, transform_points

SEED, DRIVES = 61, (1, 3)  # of the town; sequences in it: through a bend, and straight on
GNSS, WHEELS, GYRO = 1.0, 0.2, 0.02  # [m], [m/s], [rad/s]
SECONDS, STEP = 20.0, 0.01  # [s]
ABOVE = -1.2  # [m] below the sensor; lower points are ground, on which all scans are alike
NEAR, FLAT = 1.0, 0.03  # [m] a plane's point is this close, its neighbours this flat


def scans(sequence: int, frames: int) -> tuple[Trajectory, list[tuple[NDArray, NDArray]], list[NDArray]]:
    """Cast a drive twice: poses; points and times of distorted scans; points of undistorted ones. Static points."""
    from ogm.simulation.dataset import set_up
    from ogm.simulation.lidar import scan, to_points
    from ogm.simulation.plan import SEQUENCE, DatasetPlan, moment, only

    plan = DatasetPlan(seed=SEED, samples=0, validation=0, test=0, sequences=4, mounts=only("vlp-32c"))
    stamps, poses, distorted, still = [], [], [], []
    for k in range(frames):
        i = SEQUENCE * sequence + k
        here = set_up(plan, "sequences", i)
        stamps.append(moment(plan, "sequences", i).time)
        poses.append(here.T_world_sensor)
        for moves in (1.0, 0.0):
            rng, motion = np.random.default_rng(i), moves * np.asarray(here.state.ego_velocity, float)
            turn = moves * float(here.state.ego_yaw_rate)
            cast = scan(here.world.scene, here.spec, here.T_world_sensor, rng, velocity=motion, yaw_rate=turn)
            points, layer, column = to_points(cast, here.spec)
            static = cast.object[layer, column] == -1
            points = points[static, :3]
            if moves:
                distorted.append((points, here.spec.times[column][static]))
            else:
                still.append(points)
    return Trajectory(np.array(stamps), np.array(poses)), distorted, still


def straightened(sequence: int, frames: int) -> dict[str, Any]:
    """Measure how far points lie from the planes of the undistorted map: as measured, de-skewed, never distorted."""
    trajectory, distorted, still = scans(sequence, frames)
    longer = extrapolate(trajectory, 0.06)
    kinds: dict[str, list[NDArray]] = {"as measured": [], "de-skewed": [], "never distorted": []}
    for k, (points, time) in enumerate(distorted):
        straight = deskew(points, time, longer, float(trajectory.stamps[k]))
        for name, cloud in zip(kinds, (points, straight, still[k]), strict=True):
            kinds[name].append(transform_points(trajectory.poses[k], cloud[cloud[:, 2] > ABOVE].astype(float)))
    world = np.concatenate(kinds["never distorted"])[::4]
    tree = cKDTree(world)
    around = world[tree.query(world, k=15)[1]]
    middle = around.mean(axis=1)
    around = around - middle[:, None]
    spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around) / 15)
    flat = (spread[:, 0] < FLAT**2) & (spread[:, 1] > 25 * spread[:, 0])
    steps = np.diff(trajectory.poses[:, :3, 3], axis=0)
    result: dict[str, Any] = {"path [m]": round(float(np.linalg.norm(steps, axis=1).sum()), 2)}
    for name, clouds in kinds.items():
        points = np.concatenate(clouds[::2])
        distance, at = tree.query(points)
        good = flat[at] & (distance < NEAR)
        off = np.abs(np.einsum("ni,ni->n", points[good] - middle[at[good]], axes[at[good], :, 0]))
        result[name] = {
            "median [cm]": round(100 * float(np.median(off)), 2),
            "90 % [cm]": round(100 * float(np.quantile(off, 0.9)), 2),
            "points": int(good.sum()),
        }
    return result


def driven(rng: np.random.Generator) -> tuple[NDArray[np.float64], list[tuple[float, str, Any, float]]]:
    """Drive: the states x, y, yaw, speed, yaw rate every 10 ms, and the measurements, in order."""
    count = round(SECONDS / STEP)
    states = np.empty((count + 1, 5))
    states[0] = 0, 0, rng.uniform(-math.pi, math.pi), 8, 0
    for k in range(count):
        x, y, yaw, speed, rate = states[k]
        middle = yaw + 0.5 * STEP * rate
        noise = rng.normal(size=2) * math.sqrt(STEP)
        ahead = x + speed * STEP * math.cos(middle), y + speed * STEP * math.sin(middle)
        states[k + 1] = *ahead, yaw + rate * STEP, speed + noise[0], rate + 0.2 * noise[1]
    measured: list[tuple[float, str, Any, float]] = []
    for k in range(5, count + 1, 5):
        t = k * STEP
        measured.append((t, "yaw_rate", states[k, 4] + rng.normal(0, GYRO), GYRO))
        if k % 10 == 0:
            measured.append((t, "speed", states[k, 3] + rng.normal(0, WHEELS), WHEELS))
        if k % 50 == 0:
            measured.append((t, "position", states[k, :2] + rng.normal(0, GNSS, 2), GNSS))
    return states, measured


def filtered(drives: int) -> dict[str, Any]:
    """Compare the fixes, dead reckoning, the filter and the smoother over some drives."""
    rows: dict[str, list[float]] = {name: [] for name in ("fixes", "dead reckoning", "filter", "smoother")}
    refused, nees = [], []
    for seed in range(drives):
        rng = np.random.default_rng(seed)
        states, measured = driven(rng)
        deviation = np.array([0.5, 0.5, 0.05, 0.5, 0.05])
        start = states[0] + rng.normal(size=5) * deviation
        for name in ("filter", "dead reckoning"):
            noise = {"deviation": tuple(deviation), "acceleration": 1.0, "yaw_acceleration": 0.2}
            ego = EgoMotion(0.0, pose(*start[:2], yaw=start[2]), speed=start[3], yaw_rate=start[4], **noise)
            used = measured if name == "filter" else [one for one in measured if one[1] != "position"]
            taken = [getattr(ego, kind)(t, value, sigma) for t, kind, value, sigma in used]
            rows[name].append(rmse(ego.filtered(), states))
            if name == "filter":
                rows["smoother"].append(rmse(ego.smoothed(), states))
                refused.append(1 - np.mean(taken))
                error = ego.state[:2] - states[round(ego.stamp / STEP), :2]
                nees.append(float(error @ np.linalg.solve(ego.covariance[:2, :2], error)))
        fixes = [v - states[round(t / STEP), :2] for t, kind, v, _ in measured if kind == "position"]
        rows["fixes"].append(float(np.sqrt(np.mean(np.sum(np.square(fixes), axis=1)))))
    low, high = chi2.ppf([0.025, 0.975], 2 * drives) / drives
    return {
        "drives": drives,
        "RMSE of the position [m]": {name: round(float(np.mean(values)), 3) for name, values in rows.items()},
        "measurements refused": round(float(np.mean(refused)), 5),
        "NEES of the last position": round(float(np.mean(nees)), 2),
        "95 % of it, if consistent": [round(float(low), 2), round(float(high), 2)],
    }


def rmse(motion: Any, states: NDArray[np.float64]) -> float:
    """Return the root mean square error of positions [m]."""
    at = np.rint(np.asarray(motion.stamps) / STEP).astype(int)
    return float(np.sqrt(np.mean(np.sum((motion.states[:, :2] - states[at, :2]) ** 2, axis=1))))


def main() -> None:
    parser = run.Parser(__doc__)
    parser.add_argument("--frames", type=int, default=30, help="scans per simulated sequence")
    parser.add_argument("--drives", type=int, default=30, help="drives of the filter")
    given = parser.parse_args()
    record = {
        "environment": run.environment(),
        "filter": filtered(given.drives),
        "de-skewing": {f"sequence {n}": straightened(n, given.frames) for n in DRIVES},
    }
    run.write_record(given.out, record)


if __name__ == "__main__":
    main()
