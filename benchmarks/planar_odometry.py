"""How much of the drift of odometry is left after scan matching in the plane? ogm beside KISS-ICP and small-gicp.

    python benchmarks/planar_odometry.py [--logs FOLDER] [--seeds N] [--quick]

FOLDER holds CARMEN logs of planar lasers with corrected poses (*.log.gz), by default carmen_2d in the folder of
recordings. Their raw odometry is not recorded, so odometry is made of the corrected poses: from scan to scan, position
errors of 5 % of the distance along and across, heading errors of 2 degrees per metre, normal and independent. All
methods begin each scan at the motion of this odometry. Drift is the mean over all pieces of 10 m of the error of the
relative position over the length of the piece; the corrected poses have errors of their own. KISS-ICP has voxels of
0.2 m; small-gicp registers each scan to the last 20, with points repeated at three heights, as surfaces of points in
one plane have no normals. Writes benchmarks/results/planar_odometry.json.
"""

import _run as run  # first: it sets the number of threads

# isort: split
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.datasets import open_dataset
from ogm.fusion import match_scans
from ogm.pose import inverse, pose

Poses = NDArray[np.float64]
PIECE = 10.0  # [m]
REACH = 30.0  # [m] of echoes that KISS-ICP and small-gicp get
LAYERS = (-0.05, 0.0, 0.05)  # [m]
OURS = "match_scans"


def noisy(poses: Poses, seed: int) -> Poses:
    """Return poses of an odometry whose errors grow with the distance."""
    rng, found = np.random.default_rng(seed), [poses[0]]
    for before, after in zip(poses[:-1], poses[1:], strict=True):
        step = inverse(before) @ after
        d = math.hypot(step[0, 3], step[1, 3])
        x, y, yaw = rng.normal(0, (0.05 * d, 0.05 * d, math.radians(2) * d))
        found.append(found[-1] @ pose(step[0, 3] + x, step[1, 3] + y, yaw=math.atan2(step[1, 0], step[0, 0]) + yaw))
    return np.array(found)


def drift(found: Poses, true: Poses) -> float:
    """Return the mean error of position per metre over pieces of the path."""
    path = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(true[:, :2, 3], axis=0).T))])
    ends = np.searchsorted(path, path + PIECE)
    errors = [
        np.hypot(*(inverse(inverse(true[i]) @ true[j]) @ inverse(found[i]) @ found[j])[:2, 3]) / (path[j] - path[i])
        for i, j in enumerate(ends.tolist())
        if j < len(path)
    ]
    return float(np.mean(errors))


def guesses(odometry: Poses, register: Callable[[int, Poses], Poses]) -> Iterator[Poses]:
    """Yield poses by a registration that begins at the motion of the odometry."""
    last = odometry[0]
    for k, T in enumerate(odometry):
        found = register(k, last @ inverse(odometry[k - 1]) @ T if k else T)
        last = pose(found[0, 3], found[1, 3], yaw=math.atan2(found[1, 0], found[0, 0]))
        yield last


def kiss_icp(scans: Sequence[NDArray[np.float32]], odometry: Poses) -> Iterator[Poses]:
    """Yield the poses of KISS-ICP."""
    from kiss_icp.config.parser import load_config
    from kiss_icp.kiss_icp import KissICP

    config = load_config(None)
    config.data.deskew, config.data.min_range, config.data.max_range = False, 0.1, REACH
    config.mapping.voxel_size, config.registration.max_num_threads = 0.2, 1
    config.adaptive_threshold.initial_threshold, config.adaptive_threshold.min_motion_th = 0.5, 0.02
    pipeline = KissICP(config)
    pipeline.last_pose = odometry[0]

    def register(k: int, guess: Poses) -> Poses:
        pipeline.last_delta = np.linalg.inv(pipeline.last_pose) @ guess
        pipeline.register_frame(scans[k][:, :3].astype(np.float64), np.zeros(0))
        return np.array(pipeline.last_pose)

    return guesses(odometry, register)


def small_gicp(scans: Sequence[NDArray[np.float32]], odometry: Poses) -> Iterator[Poses]:
    """Yield the poses of small-gicp against the last scans."""
    import small_gicp as package

    kept: list[NDArray[np.float64]] = []

    def layered(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([points + [0, 0, z] for z in LAYERS])

    def register(k: int, guess: Poses) -> Poses:
        points = scans[k][:, :3].astype(np.float64)
        points, T = points[np.hypot(*points[:, :2].T) < REACH], guess
        if kept and len(points) > 20:
            target, tree = package.preprocess_points(layered(np.concatenate(kept[-20:])), 0.05, 12)
            source, _ = package.preprocess_points(layered(points), 0.05, 12)
            T = np.array(package.align(target, source, tree, guess, max_correspondence_distance=0.5).T_target_source)
        kept.append(points @ T[:3, :3].T + T[:3, 3])
        return T

    return guesses(odometry, register)


def ours(scans: Sequence[NDArray[np.float32]], odometry: Poses) -> Iterator[Poses]:
    """Yield the poses of `match_scans`."""
    return (T for T, _ in match_scans(scans, odometry))


METHODS = {OURS: ours, "KISS-ICP": kiss_icp, "small-gicp": small_gicp}


def measure(path: Path, seeds: int) -> dict[str, Any]:
    """Return the drift of the odometry and of all methods on a log, by seed, and the time per scan."""
    frames = [frame for frame in open_dataset(path) if frame.T_map_sensor is not None]
    true, scans = np.array([frame.T_map_sensor for frame in frames]), [frame.scan.points for frame in frames]
    odometries = [noisy(true, seed) for seed in range(seeds)]
    before = [drift(odometry, true) for odometry in odometries]
    record: dict[str, Any] = {"scans": len(frames), "odometry [m/m]": before}
    for name, method in METHODS.items():
        list(method(scans[:3], true[:3]))  # compiles
        start = time.process_time()
        found = [np.array(list(method(scans, odometry))) for odometry in odometries]
        seconds = (time.process_time() - start) / seeds / len(frames)
        after = [drift(poses, true) for poses in found]
        ratio = float(np.mean(after) / np.mean(before))
        record[name] = {"drift [m/m]": after, "ratio of means": ratio, "time [ms]": 1e3 * seconds}
        print(
            f"{path.name} {name}: {np.mean(before):.4f} to {np.mean(after):.4f} m/m, {1e3 * seconds:.1f} ms", flush=True
        )
    return record


def main() -> None:
    parser = run.Parser(__doc__, quick=True)
    parser.add_argument("--logs", type=Path, default=run.DATA / "carmen_2d", help="folder of CARMEN logs")
    parser.add_argument("--seeds", type=int, default=10)
    options = parser.parse_args()
    paths = sorted(options.logs.glob("*.log.gz"))
    if not paths:
        raise SystemExit(f"no *.log.gz in {options.logs}: give --logs FOLDER")
    record = run.environment()
    seeds = 1 if options.quick else options.seeds
    record["logs"] = {path.name.split(".")[0]: measure(path, seeds) for path in paths}
    ratios = {name: found[OURS]["ratio of means"] for name, found in record["logs"].items()}
    rows = [(f"{name}: drift after matching, of the odometry's", one, "<=", 0.2, "x") for name, one in ratios.items()]
    record["verdicts"] = run.verdicts(rows)
    run.write_record(options.out, record)


if __name__ == "__main__":
    main()
