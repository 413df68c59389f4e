"""Errors of de-skewing, on simulated drives with exact poses.

    python benchmarks/deskewing.py [--frames N]

A VLP-32C (10 Hz) drives through a simulated town; every scan is cast twice, distorted by the ego motion and
as if all of it were measured at once. Distances are those of static points above the ground from the planes of
the map of undistorted scans. Writes benchmarks/results/deskewing.json.
"""

import _run as run  # first: it sets the number of threads

# isort: split
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ogm.fusion import deskew
from ogm.fusion.ego.deskewing import extrapolate
from ogm.pose import Trajectory, transform_points

SEED, DRIVES = 61, (1, 3)  # of the town; sequences in it: through a bend, and straight on
ABOVE = -1.2  # [m] below the sensor; lower points are ground, on which all scans are alike
NEAR, FLAT = 1.0, 0.03  # [m] a plane's point is this close, its neighbours this flat


def scans(sequence: int, frames: int) -> tuple[Trajectory, list[tuple[NDArray, NDArray]], list[NDArray]]:
    """Cast a drive twice: poses; points and times of distorted scans; points of undistorted ones. Static points."""
    from ogm.simulation.dataset import set_up
    from ogm.simulation.lidar import scan, to_points
    from ogm.simulation.mounts import single_sensor
    from ogm.simulation.plan import SEQUENCE, DatasetPlan, moment

    plan = DatasetPlan(seed=SEED, samples=0, validation=0, test=0, sequences=4, mounts=single_sensor("vlp-32c"))
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


def main() -> None:
    parser = run.Parser(__doc__)
    parser.add_argument("--frames", type=int, default=30, help="scans per simulated sequence")
    given = parser.parse_args()
    record = {
        "environment": run.environment(),
        "de-skewing": {f"sequence {n}": straightened(n, given.frames) for n in DRIVES},
    }
    run.write_record(given.out, record)


if __name__ == "__main__":
    main()
