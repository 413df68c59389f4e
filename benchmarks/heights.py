"""How good are heights of the ground, by slope and distance? Errors, steps that are found, and times.

    python benchmarks/heights.py [--moments N] [--rounds N]

Scans of simulated moments without weather, in towns (hills of at most 7 %, kerbs of 0.1 to 0.15 m) and in country
(banks and ditches), by three lidars on the same vehicle. The truth is the ground of the scene at each cell's centre.
A kerb is found where the layer `step` shows two thirds of it. A real sweep of Argoverse 2 is compared with the ground
of its map, where it is there (benchmarks/README.md). Writes benchmarks/results/heights.json.
"""

import _run as run  # first: it sets the number of threads

# isort: split
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from _timing import Contender, measure
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from ogm import GridSpec, LayeredGrid, Mount, Scan, read_scan
from ogm.datasets import open_dataset
from ogm.fusion import ElevationMapper
from ogm.geometric import RayISM, height_layers, traversability
from ogm.pose import inverse, pose
from ogm.simulation.cells import measure_ground
from ogm.simulation.lidar import scan, to_points
from ogm.simulation.moments import set_up, traffic_of
from ogm.simulation.mounts import single_sensor
from ogm.simulation.plan import SEQUENCE, DatasetPlan, moment
from ogm.simulation.sensors import LIDARS
from ogm.state import CellState, predict_state

SPEC = GridSpec.centered()
LIDAR_NAMES = "vlp-32c", "hdl-64e", "os1-128"
MOMENTS = 12  # of each place
SEED = 71
DISTANCES, SLOPES = (0, 10, 20, 40), (0.0, 0.1, 0.3)  # [m], rise over run
KERB, FOUND, NEAR = (0.12, 0.2), 2 / 3, 10.0  # [m] heights; share of a kerb that the layer shows; [m]
FLAT, FALSE = 0.02, 0.1  # [m] rise of a cell without a step, and step from which on one is shown
MAP_SCANS, DRIFT = 30, 0.02  # scans of a drive; drift of the heights of its poses [m / sqrt(m)]


class Place(NamedTuple):
    """Scan of a moment in the vehicle frame, and the truth around it."""

    trace: Any  # RayTrace
    ground: NDArray[np.float32]
    rise: NDArray[np.float32]
    T_map_vehicle: NDArray[np.float64]
    stamp: float


def plan(place: str) -> tuple[DatasetPlan, str]:
    """Return the plan of the moments of a place, and their split."""
    if place == "country":
        return DatasetPlan.of_recipe("gen2", samples=1000, seed=SEED), "training"
    if place == "drive":
        return DatasetPlan(
            seed=SEED, samples=0, validation=0, test=0, sequences=9, mounts=single_sensor("os1-128")
        ), "sequences"
    towns = {"test_towns": 2, "drives": 10, "spacing": 8.0, "mounts": single_sensor("vlp-32c")}
    return DatasetPlan(seed=SEED, samples=0, validation=0, test=100, **towns), "test"


def places(place: str, indices: range, lidars: tuple[str, ...]) -> Iterator[tuple[str, Place]]:
    """Simulate moments of a place, each scanned by some lidars."""
    of, split = plan(place)
    for index in indices:
        here = set_up(of, split, index, threads=1)
        below = measure_ground(here.world.ground, here.state.ego, SPEC)
        for name in lidars:
            spec = LIDARS[name]
            mounted = pose(z=spec.height)
            image = scan(here.world.scene, spec, here.state.ego @ mounted, np.random.default_rng([SEED, index]))
            model = RayISM(SPEC, Mount(spec.height, mounted))
            taken = model.trace(Scan(to_points(image, spec)[0]))
            yield name, Place(taken, below.z, below.rise, here.state.ego, moment(of, split, index).time)


class Sums:
    """Squared errors, their ratios to the variance, and counts, by any names."""

    def __init__(self) -> None:
        self.of: dict[str, NDArray[np.float64]] = {}

    def add(self, name: str, layers: LayeredGrid, truth: NDArray[np.float32], cells: NDArray[np.bool_]) -> None:
        """Add the errors of some cells."""
        error = (layers["ground_height"] - truth)[cells].astype(np.float64)
        numbers = len(error), (error**2).sum(), (error**2 / layers["ground_variance"][cells]).sum(), np.abs(error).sum()
        self.of[name] = self.of.get(name, np.zeros(4)) + numbers

    def table(self) -> dict[str, dict[str, float]]:
        """Return the figures of each name."""
        names = "cells", "rmse [m]", "squared error / variance", "mean absolute error [m]"
        return {
            name: dict(zip(names, (int(n), *(round(float(v), 4) for v in (np.sqrt(s / n), r / n, a / n))), strict=True))
            for name, (n, s, r, a) in self.of.items()
            if n
        }


def true_slope(z: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the rise over run of the true ground over 1 m."""
    reach, squares = 3, np.zeros_like(z)
    for axis in (0, 1):
        squares += ((np.roll(z, -reach, axis) - np.roll(z, reach, axis)) / (2 * reach * SPEC.resolution)) ** 2
    return np.sqrt(squares)


def add_place(sums: Sums, steps: NDArray[np.float64], one: Place) -> None:
    """Add a scan to the sums of its lidar, and kerbs and cells without a step to the counts."""
    layers, truth = height_layers(one.trace), one.ground
    away, slope = np.hypot(*SPEC.cell_centers), true_slope(truth)
    given = np.isfinite(layers["ground_height"]) & np.isfinite(truth) & np.isfinite(slope)
    seen = given & np.isfinite(layers["step"])
    for low, high in zip(DISTANCES[:-1], DISTANCES[1:], strict=True):
        band = (away >= low) & (away < high)
        for gentle, steep in zip(SLOPES[:-1], SLOPES[1:], strict=True):
            at = band & (slope >= gentle) & (slope < steep)
            sums.add(f"{low} to {high} m, slope {gentle:.0%} to {steep:.0%}", layers, truth, given & at)
        sums.add(f"{low} to {high} m", layers, truth, given & band & (slope < SLOPES[-1]))
    sums.add("within 20 m", layers, truth, given & (away < 20) & (slope < SLOPES[-1]))
    sums.add("within 20 m, next to returns", layers, truth, seen & (away < 20) & (slope < SLOPES[-1]))
    state = predict_state(one.trace.grid.mass)
    kerb = (one.rise > KERB[0]) & (one.rise < KERB[1]) & (away < NEAR) & (state != CellState.UNKNOWN)
    held = np.zeros(SPEC.shape, bool)
    points = one.trace.points
    inside = SPEC.contains(points.x, points.y)
    held[SPEC.index(points.x[inside], points.y[inside])] = True
    edges = [extreme(np.where(held, truth, empty), 5) for extreme, empty in ((maximum_filter, -9), (minimum_filter, 9))]
    shown = kerb & (edges[0] - edges[1] > FOUND * one.rise) & (edges[0] - edges[1] < 5)
    flat = (maximum_filter(np.nan_to_num(one.rise), 7) < FLAT) & (away < NEAR) & (state == CellState.FREE)
    flat &= np.isfinite(layers["step"])
    found = layers["step"] > FOUND * one.rise
    steps += [kerb.sum(), shown.sum(), (shown & found).sum(), flat.sum(), (flat & (layers["step"] > FALSE)).sum()]


def fused(count: int) -> dict[str, Any]:
    """Return errors of single scans and of maps of a drive, whose poses drift in height."""
    rng, sums = np.random.default_rng(SEED), Sums()
    mappers = {"map, drift estimated": True, "map, drift stated": False}
    maps = {name: ElevationMapper(SPEC, drift=DRIFT, estimate_drift=flag) for name, flag in mappers.items()}
    error, before, offsets = 0.0, None, []
    of, split = plan("drive")
    ego = [[traffic_of(of, at).at(at.time).ego for at in (moment(of, split, SEQUENCE * k + n) for n in (0, count))]
           for k in range(of.sequences)]  # fmt: skip
    first = SEQUENCE * int(np.argmax([np.linalg.norm(b[:2, 3] - a[:2, 3]) for a, b in ego]))
    for _, one in places("drive", range(first, first + count), ("os1-128",)):
        layers, T = height_layers(one.trace), one.T_map_vehicle.copy()
        if before is not None:
            error += DRIFT * np.sqrt(np.linalg.norm(T[:3, 3] - before)) * rng.standard_normal()
        before = one.T_map_vehicle[:3, 3]
        T[2, 3] += error
        for mapper in maps.values():
            mapper.update(layers, T, one.stamp)
        offsets.append(error - maps["map, drift estimated"].height_offset[0])
    near = np.hypot(*SPEC.cell_centers) < 20
    truth, T = one.ground, one.T_map_vehicle
    sums.add("scan", layers, truth, near & np.isfinite(layers["ground_height"]) & np.isfinite(truth))
    x, y = np.broadcast_arrays(*SPEC.cell_centers)
    z = T[2, 0] * x + T[2, 1] * y + T[2, 2] * truth + T[2, 3]
    place = T[:2, :2] @ np.stack([x, y]).reshape(2, -1) + T[:2, 3:]
    for name, mapper in maps.items():
        found = mapper.layers
        inside = found.spec.contains(*place)
        index = found.spec.index(*place[:, inside])
        for key, shift in ((name, 0.0), (f"{name}, seen from the last pose", error)):
            at = {k: np.full(SPEC.shape, np.nan, np.float32) for k in ("ground_height", "ground_variance")}
            for k, layer in at.items():
                layer.ravel()[inside] = found[k][index]
            cells = near & np.isfinite(at["ground_height"]) & np.isfinite(z)
            sums.add(key, LayeredGrid(SPEC, at), (z + shift).astype(np.float32), cells)
    rms = float(np.sqrt(np.mean(np.square(offsets))))
    return {"scans": count, "drift at the end [m]": error, "error of the estimated drift, rms [m]": rms} | sums.table()


def mapped_ground(folder: Path) -> dict[str, Any]:
    """Return errors against the ground of the map of a real sweep, 0.3 m cells, where the map has one."""
    if not (folder / "map").is_dir():
        print("Argoverse 2 is left out: there is no argoverse2_adcf")
        return {}
    frame, sums = open_dataset(folder)[0], Sums()
    layers = height_layers(RayISM(SPEC).trace(frame.scan))
    raster = np.load(next(folder.glob("map/*ground_height_surface*.npy")))
    placed = json.loads(next(folder.glob("map/*Sim2_city.json")).read_text())
    R, shift = np.array(placed["R"]).reshape(2, 2), np.array(placed["t"])
    T, (x, y) = frame.T_map_sensor @ inverse(frame.mount.T_vehicle_sensor), np.broadcast_arrays(*SPEC.cell_centers)
    city = T[:2, :2] @ np.stack([x, y]).reshape(2, -1) + T[:2, 3:]
    column, row = np.floor(placed["s"] * (R @ city + shift[:, None])).astype(int)
    inside = (column >= 0) & (row >= 0) & (column < raster.shape[1]) & (row < raster.shape[0])
    z = np.full(x.size, np.nan)
    z[inside] = raster[row[inside], column[inside]]
    truth = (z.reshape(SPEC.shape) - T[2, 0] * x - T[2, 1] * y - T[2, 3]) / T[2, 2]
    away = np.hypot(x, y)
    for low, high in zip(DISTANCES[:-1], DISTANCES[1:], strict=True):
        cells = np.isfinite(layers["ground_height"]) & np.isfinite(truth) & (away >= low) & (away < high)
        sums.add(f"{low} to {high} m", layers, truth.astype(np.float32), cells)
    return sums.table()


def times(rounds: int) -> dict[str, Any]:
    """Return times of the layers beside RayISM and a copy of them, on the shipped scan of a road [ms]."""
    taken = read_scan(run.ROOT / "ogm/data/vls128_road.pcd.xz", axes=("+y", "-x", "+z"))
    result: dict[str, Any] = {}
    for points in (57_600, 120_000):
        some = np.sort(np.random.default_rng(0).choice(len(taken), points, replace=False))
        part = taken.select(some)
        model = RayISM(SPEC, Mount(1.98))
        trace = model.trace(part)
        layers = height_layers(trace)
        copy = np.stack([*layers.layers.values()])
        contenders = {
            "RayISM": Contender(lambda _, m=model, s=part: m(s)),
            "RayISM and layers of heights": Contender(lambda _, m=model, s=part: height_layers(m.trace(s))),
            "layers of heights": Contender(lambda _, t=trace: height_layers(t)),
            "traversability": Contender(lambda _, t=trace, found=layers: traversability(found, t.grid)),
            "copy of the layers": Contender(lambda _, c=copy: c.copy()),
        }
        measured = measure(contenders, rounds)
        result[f"{len(part)} points"] = {name: found.median for name, found in measured.items()}
    return result


def main() -> None:
    parser = run.Parser(__doc__, rounds=30, real=True)
    parser.add_argument("--moments", type=int, default=MOMENTS, help="of each place")
    given = parser.parse_args()
    record: dict[str, Any] = run.environment("ray") | {"moments of each place": given.moments}
    for place, stride in (("town", 3), ("country", 3)):
        sums = {name: Sums() for name in LIDAR_NAMES}
        steps = {name: np.zeros(5) for name in LIDAR_NAMES}
        for name, one in places(place, range(0, stride * given.moments, stride), LIDAR_NAMES):
            add_place(sums[name], steps[name], one)
        record[place] = {name: {"ground": sums[name].table()} for name in LIDAR_NAMES}
        if place == "town":
            for name, (kerbs, shown, found, flat, false) in steps.items():
                record[place][name]["kerbs within 10 m"] = {
                    "cells": int(kerbs),
                    "with returns on both sides": shown / kerbs,
                    "found of these": found / shown,
                    "steps shown on flat ground": false / flat,
                }
    record["map"] = fused(min(MAP_SCANS, SEQUENCE))
    record["Argoverse 2, ground of the map"] = mapped_ground(given.real / "argoverse2_adcf")
    record["times [ms]"] = times(given.rounds)
    cost = record["times [ms]"]["120000 points"]
    rows = []
    for place, limit in (("town", 0.05), ("country", 0.1)):
        for name in LIDAR_NAMES:
            got = record[place][name]["ground"]["within 20 m"]["rmse [m]"]
            rows.append((f"{place}, {name}: RMSE within 20 m", got, "<=", limit, "m"))
    for name in LIDAR_NAMES:
        kerbs = record["town"][name]["kerbs within 10 m"]
        rows.append(
            (f"kerbs with returns on both sides that are found, {name}", kerbs["found of these"], ">=", 0.9, "")
        )
    rows.append(
        ("layers of heights over RayISM", cost["RayISM and layers of heights"] - cost["RayISM"], "<=", 4.0, "ms")
    )
    run.write_record(given.out, record | {"verdicts": run.verdicts(rows)})


if __name__ == "__main__":
    main()
