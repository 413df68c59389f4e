"""Maps of one real drive by ogm and by every mapper that can be installed: time, memory, and what is left in the map.

    python benchmarks/peers.py [--drive FOLDER] [--only NAME ...] [--quick]

The drive is KITTI raw 0005, 24 scans, two moving objects. All get the same points and poses, one core, cells or voxels
of 0.16 m and a range limit of 49.7 m, and run one after the other, each in a process of its own. At the end the map is
read at the centres of the cells of the last frame's truth; of a 3D map a cell is occupied if a voxel 0.3 to 2 m above
the ground is, and free if none of them is and one is free.

* static kept: share of the occupied cells of the aggregated truth that are occupied, and free;
* movers removed: cells that an object faster than 1 m/s covered in an earlier scan, where nothing stands any more:
  share that is still occupied;
* ms per scan: processor time of an update, median; memory: growth of the process from before the first scan.

Writes benchmarks/results/peers.json.
"""

import _run as run  # first: it sets the number of threads
from _contenders import numpy_height_band
from _timing import peak_memory

# isort: split
import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm import Frame, GridSpec, open_dataset
from ogm.fusion import BinaryBayesMapper, DynamicMapper, EvidentialMapper, Mapper, rolling_window, update_map
from ogm.fusion.pipeline import grid_pose
from ogm.geometric import HeightBandISM, ground_height, local_ground
from ogm.models import load_model
from ogm.pose import transform_points
from ogm.state import CellState
from ogm.truth import cells_in_boxes

CELL = 0.16  # [m]
SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=CELL)
MAX_RANGE = math.hypot(SPEC.length, SPEC.width) / 2  # [m]
LOW, HIGH = 0.3, 2.0  # [m] above ground: heights of the truth's obstacles
MOVING = 1.0  # [m/s]
MARGIN = 0.3  # [m] around objects that stand at the end, whose cells are left out
States = NDArray[np.uint8]
Step = Callable[[Frame], None]
Read = Callable[[NDArray[np.float64], Callable[[NDArray[np.float64]], NDArray[np.float64]]], States]


def of_ogm(model: str, mapper: Mapper) -> tuple[Step, Read]:
    """Return a step and a reader of a map of ogm."""
    ism = load_model(model, SPEC)

    def step(frame: Frame) -> None:
        update_map(mapper, ism(frame.scan), frame)

    def read(points: NDArray[np.float64], _: Any) -> States:
        free, occupied, _unknown = np.asarray(mapper.opinion_at(points[:, :2])).T
        return _predicted(free, occupied)

    return step, read


def ogm_default() -> tuple[Step, Read]:
    return of_ogm("combined", EvidentialMapper(rolling_window(SPEC)))


def ogm_ray() -> tuple[Step, Read]:
    return of_ogm("ray", EvidentialMapper(rolling_window(SPEC)))


def ogm_bayes() -> tuple[Step, Read]:
    return of_ogm("ray", BinaryBayesMapper(rolling_window(SPEC)))


def ogm_dynamic() -> tuple[Step, Read]:
    return of_ogm("ray", DynamicMapper(rolling_window(SPEC)))


def numpy_bayes() -> tuple[Step, Read]:
    """Return a log-odds grid in numpy: the paper's height band, drawn and added up, cells of the map nearest."""
    window = GridSpec.centered(200.0, 200.0, CELL)
    log_odds = np.zeros(window.shape, np.float32)
    x, y = np.broadcast_arrays(*SPEC.cell_centers)
    cells = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)

    def step(frame: Frame) -> None:
        mass = numpy_height_band(np.ascontiguousarray(frame.scan.points[:, :3]), HeightBandISM(SPEC, frame.mount))
        known = (mass > 0).any(axis=-1).ravel()
        change = np.where(mass[..., 1] > 0, 0.85, -0.4).ravel()[known]  # OctoMap's numbers
        moved = transform_points(frame.T_map_sensor, cells[known])
        index = np.stack(window.index(moved[:, 0], moved[:, 1], unbounded=True), axis=1)
        inside = ((index >= 0) & (index < window.shape)).all(axis=1)
        at = tuple(index[inside].T)
        log_odds[at] = np.clip(log_odds[at] + change[inside], -2.0, 3.5)

    def read(points: NDArray[np.float64], _: Any) -> States:
        value = log_odds[window.index(points[:, 0], points[:, 1])]
        return _predicted(value < 0, value > 0)

    return step, read


def of_voxels(
    points: NDArray[np.float64], voxels: NDArray[np.float64], occupied: NDArray[np.bool_], above: Any
) -> States:
    """Return the states of cells in which voxels, by their centres, are occupied or free."""
    height = above(voxels)
    band = (height > LOW) & (height < HIGH)
    low = points[:, :2].min(axis=0) - 1.0
    keys = np.floor((voxels[band, :2] - low) / CELL).astype(int)
    shape = np.floor((points[:, :2].max(axis=0) + 2.0 - low) / CELL).astype(int)
    inside = ((keys >= 0) & (keys < shape)).all(axis=1)
    found = np.zeros((2, *shape), bool)
    for state, chosen in enumerate((~occupied[band], occupied[band])):
        found[state][tuple(keys[inside & chosen].T)] = True
    at = tuple(np.floor((points[:, :2] - low) / CELL).astype(int).T)
    return _predicted(found[0][at] & ~found[1][at], found[1][at])


def octomap() -> tuple[Step, Read]:
    """Return OctoMap by octomap-python, lazy and discretised."""
    import octomap as package

    tree = package.OcTree(CELL)

    def step(frame: Frame) -> None:
        points = transform_points(frame.T_map_sensor, frame.scan.points[:, :3]).astype(np.float64)
        origin = np.asarray(frame.T_map_sensor[:3, 3], np.float64)
        tree.insertPointCloud(points, origin, maxrange=MAX_RANGE, lazy_eval=True, discretize=True)
        tree.updateInnerOccupancy()

    def read(points: NDArray[np.float64], above: Any) -> States:
        leaves = [(node.getCoordinate(), tree.isNodeOccupied(node), node.getSize()) for node in tree.begin_leafs()]
        centres, occupied = _split_leaves(leaves)
        return of_voxels(points, centres, occupied, above)

    return step, read


def _split_leaves(leaves: Iterable[tuple[Any, bool, float]]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the centres of voxels of one size, large leaves being split, and which are occupied."""
    centres, states = [], []
    for centre, occupied, size in leaves:
        n = round(size / CELL)
        offsets = (np.arange(n) - (n - 1) / 2) * CELL
        part = np.stack(np.meshgrid(offsets, offsets, offsets, indexing="ij"), axis=-1).reshape(-1, 3) + centre
        centres.append(part)
        states.append(np.full(len(part), occupied))
    return np.concatenate(centres), np.concatenate(states)


def kiss_slam() -> tuple[Step, Read]:
    """Return the occupancy mapper of KISS-SLAM."""
    from kiss_slam.kiss_slam_pybind import kiss_slam_pybind as kiss

    mapper = kiss._OccupancyMapper(CELL, MAX_RANGE)

    def step(frame: Frame) -> None:
        points = np.ascontiguousarray(frame.scan.points[:, :3])
        mapper._integrate_frame(kiss._Vector3fVector(points), frame.T_map_sensor)

    def read(points: NDArray[np.float64], above: Any) -> States:
        voxels, occupancy = mapper._get_active_voxels()
        centres = (np.asarray(voxels, np.float64) + 0.5) * CELL
        return of_voxels(points, centres, np.asarray(occupancy) > 0.5, above)

    return step, read


def dufomap() -> tuple[Step, Read]:
    """Return DUFOMap, which removes moving points: its map is the static points of all scans, without free space."""
    from dufomap import dufomap as make

    mapper, frames = make(CELL, 0.2, 2, num_threads=1), []

    def step(frame: Frame) -> None:
        mapper.run(frame.scan.points[:, :3].astype(np.float32), frame.T_map_sensor, cloud_transform=True)
        frames.append(frame)

    def read(points: NDArray[np.float64], above: Any) -> States:
        static = []
        for frame in frames:
            moving = mapper.segment(
                frame.scan.points[:, :3].astype(np.float32), frame.T_map_sensor, cloud_transform=True
            )
            static.append(transform_points(frame.T_map_sensor, frame.scan.points[:, :3])[np.asarray(moving) == 0])
        found = np.concatenate(static)
        return of_voxels(points, found, np.ones(len(found), bool), above)

    return step, read


def wavemap() -> tuple[Step, Read]:
    """Return wavemap by pywavemap, from range images of the 64 lasers, with the numbers of its own files for lidars."""
    import pywavemap as package

    octree = package.Map.create({"type": "hashed_chunked_wavelet_octree", "min_cell_width": {"meters": CELL}})
    pipeline = package.Pipeline(octree)
    pipeline.add_operation({"type": "threshold_map", "once_every": {"seconds": 2.0}})
    elevation = {"num_cells": 64, "min_angle": {"degrees": -24.9}, "max_angle": {"degrees": 2.0}}
    azimuth = {"num_cells": 2048, "min_angle": {"degrees": -180.0}, "max_angle": {"degrees": 180.0}}
    integrator = {
        "projection_model": {"type": "spherical_projector", "elevation": elevation, "azimuth": azimuth},
        "measurement_model": {
            "type": "continuous_beam",
            "angle_sigma": {"degrees": 0.035},
            "range_sigma": {"meters": CELL / 2},  # as its documentation recommends
            "scaling_free": 0.2,
            "scaling_occupied": 0.4,
        },
        "integration_method": {
            "type": "hashed_chunked_wavelet_integrator",
            "min_range": {"meters": 1.0},
            "max_range": {"meters": MAX_RANGE},
        },
    }
    if not pipeline.add_integrator("lidar", integrator):
        raise ValueError("wavemap refuses the integrator")

    def step(frame: Frame) -> None:
        points = package.Pointcloud(np.asfortranarray(frame.scan.points[:, :3].T, np.float32))
        pose = package.Pose(np.asfortranarray(frame.T_map_sensor, np.float32))
        pipeline.run_pipeline(["lidar"], package.PosedPointcloud(pose, points))

    def read(points: NDArray[np.float64], above: Any) -> States:
        ground = points.copy()
        ground[:, 2] = -above(np.column_stack([points[:, :2], np.zeros(len(points))]))
        levels = np.arange(LOW, HIGH, CELL / 2)
        columns = np.repeat(ground, len(levels), axis=0)
        columns[:, 2] += np.tile(levels, len(points))
        keys = np.unique(np.floor(columns / CELL).astype(np.int32), axis=0)
        value = np.asarray(octree.get_cell_values(keys)).ravel()
        known = value != 0.0
        return of_voxels(points, (keys[known] + 0.5) * CELL, value[known] > 0, above)

    return step, read


MAPPERS: dict[str, tuple[Callable[[], tuple[Step, Read]], str]] = {
    "ogm, default": (ogm_default, "combined, two maps; 2D masses of free, occupied, unknown"),
    "ogm, ray": (ogm_ray, "RayISM, one map; 2D masses"),
    "ogm, ray, bayes": (ogm_bayes, "RayISM, log-odds; 2D probabilities"),
    "ogm, ray, dynamic": (ogm_dynamic, "RayISM, static and dynamic masses, velocities"),
    "numpy log-odds": (numpy_bayes, "height band in numpy, log-odds; 2D probabilities"),
    "OctoMap": (octomap, "octree of log-odds, 3D (octomap-python, lazy, discretised)"),
    "KISS-SLAM mapper": (kiss_slam, "hashed voxels of log-odds, 3D"),
    "wavemap": (wavemap, "multi-resolution octree of log-odds, 3D (pywavemap, range images)"),
    "DUFOMap": (dufomap, "3D; moving points removed afterwards, no free space"),
}


def measure_one(name: str, folder: Path, count: int | None) -> dict[str, Any]:
    """Map a drive by one mapper; return its times, memory and scores."""
    dataset = open_dataset(folder)
    frames = list(dataset)[:count]
    step, read = MAPPERS[name][0]()
    step(frames[0])  # compiles
    step, read = MAPPERS[name][0]()
    Path("/proc/self/clear_refs").write_text("5")  # peak memory from here on
    before, seconds = peak_memory(), []
    for frame in frames:
        _ = frame.scan  # read and kept
        start = time.process_time()
        step(frame)
        seconds.append(time.process_time() - start)
    memory = peak_memory() - before
    return {
        "computes": MAPPERS[name][1],
        "ms per scan": 1e3 * float(np.median(seconds)),
        "scans": len(frames),
        "memory [MB]": memory,
    } | scores(frames, read)


def scores(frames: list[Frame], read: Read) -> dict[str, float]:
    """Return what a map holds of static obstacles, and of objects that have left."""
    last = frames[-1]
    T = grid_pose(last)
    assert last.truth is not None
    truth = last.truth.crop(SPEC)
    spec = truth.spec
    x, y = np.broadcast_arrays(*spec.cell_centers)
    cells = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    coarse = GridSpec.centered(84.0, 58.0, 1.0)
    xyz = np.ascontiguousarray(last.scan.points[:, :3])
    ground = local_ground(xyz, coarse, last.mount.ground_point)

    def above(points: NDArray[np.float64]) -> NDArray[np.float64]:
        local = transform_points(np.linalg.inv(T), points)
        return local[:, 2] - ground_height(ground, coarse, local)

    state = read(transform_points(T, cells), above).reshape(spec.shape)
    static = truth.state == CellState.OCCUPIED
    swept = np.zeros(spec.shape, bool)
    for frame in frames[:-1]:
        boxes = frame.boxes
        if boxes is not None and boxes.velocity is not None and frame.T_map_sensor is not None:
            fast = boxes.select(np.linalg.norm(boxes.velocity, axis=1) > MOVING)
            swept |= cells_in_boxes(fast.moved(np.linalg.inv(T) @ frame.T_map_sensor), spec)
    here = cells_in_boxes(last.boxes.widened(MARGIN), spec) if last.boxes is not None else np.zeros(spec.shape, bool)
    left = swept & ~here & ~static
    return {
        "static cells": int(static.sum()),
        "static occupied": float((state[static] == CellState.OCCUPIED).mean()),
        "static free": float((state[static] == CellState.FREE).mean()),
        "left cells": int(left.sum()),
        "left occupied": float((state[left] == CellState.OCCUPIED).mean()),
        "known": float((state != CellState.UNKNOWN).mean()),
    }


def _predicted(free: NDArray[Any], occupied: NDArray[Any]) -> States:
    """Return the states of cells by masses, or by answers, above one half."""
    return np.where(occupied > 0.5, CellState.OCCUPIED, np.where(free > 0.5, CellState.FREE, 0)).astype(np.uint8)


def rows(names: Iterable[str], given: argparse.Namespace) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the results of mappers, each of a process of its own; print why one is left out."""
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "one.json"
            words = ["--one", name, "--drive", given.drive, "--out", out, *["--quick"] * given.quick]
            try:
                subprocess.run(
                    [sys.executable, __file__, *map(str, words)], check=True, stderr=subprocess.PIPE, text=True
                )
            except subprocess.CalledProcessError as error:
                print(f"left out: {name}: {error.stderr.strip().splitlines()[-1]}")
                continue
            found = json.loads(out.read_text())
        print(f"{name:20} {found['ms per scan']:8.1f} ms, {found['memory [MB]']:6.0f} MB, {found}")
        yield name, found


def main() -> None:
    parser = run.Parser(__doc__, quick=True)
    parser.add_argument("--drive", type=Path, default=run.DATA / "kitti_raw_0005", help="KITTI raw drive 0005")
    parser.add_argument("--only", nargs="+", choices=MAPPERS, default=[*MAPPERS])
    parser.add_argument("--one", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        given.out.write_text(json.dumps(measure_one(given.one, given.drive, 4 if given.quick else None)))
        return
    record = {"environment": run.environment("ray", "combined", "revise"), "drive": "KITTI raw 0005, 24 scans"}
    record["mappers"] = dict(rows(given.only, given))
    run.write_record(given.out, record)


if __name__ == "__main__":
    main()
