"""What a scan costs a dynamic map, by particle and against numpy, and whether a long drive stays as cheap.

    python benchmarks/dynamic_speed.py [--rounds N] [--scans N] [--quick]

One core, 512 x 352 cells, walls and 40 vehicles in free space; then the same with two threads on two cores, if there
are two. Writes benchmarks/results/dynamic_speed.json and docs/pictures/dynamic_speed.png.
"""

import _run as run  # first: it sets the number of threads

# isort: split
import itertools
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from _charts import FLOOR, TWIN, draw_speed
from _dynamic_reference import NumpyFilter
from _timing import Contender, Times, long_run, measure

from ogm import EvidentialGrid, GridSpec
from ogm.datasets import open_dataset
from ogm.fusion import DynamicMapper
from ogm.fusion.dynamic.hashed_noise import scan_key
from ogm.fusion.dynamic.settings import DynamicSettings
from ogm.geometric import RayISM
from ogm.pose import pose

SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
PERIOD, LOOP, VEHICLES = 0.1, 100, 40  # [s] from scan to scan, scans after which the scene repeats, vehicles
FEW, MANY = 200_000, 1_000_000
WARM_UP = 100  # scans before a long drive is measured: memory and caches are then as they will be
NOTE = (
    "'copy' copies the four float32 numbers of every particle once. 'numpy' is the same filter in numpy: argsort, "
    "bincount, cumsum and searchsorted. Updates are without matching, except where it is named."
)


def scene() -> list[EvidentialGrid]:
    """Return the scans of walls and of vehicles at 8 or 16 m/s, which go round and round."""
    rng = np.random.default_rng(0)
    speed = rng.choice([-2, -1, 1, 2], VEHICLES) * SPEC.length / (LOOP * PERIOD)
    x0, y0 = rng.uniform(0, SPEC.length, VEHICLES), rng.uniform(-20, 20, VEHICLES)
    x, y = (SPEC.origin[k] + (np.arange(SPEC.shape[k]) + 0.5) * SPEC.resolution for k in (0, 1))
    scans = []
    for k in range(LOOP):
        mass = np.full((*SPEC.shape, 2), (0.6, 0.0), np.float32)
        mass[:, np.abs(np.abs(y) - 24) < 0.3] = (0.05, 0.8)
        for u, v, w in zip(x0, y0, speed, strict=True):
            at = (u + w * k * PERIOD) % SPEC.length + SPEC.origin[0]
            mass[np.ix_(np.abs(x - at) < 2.2, np.abs(y - v) < 0.9)] = (0.05, 0.8)
        scans.append(EvidentialGrid(SPEC, mass))
    return scans


def counted(step: Callable[[int], None], warm_up: int) -> Contender:
    """Return a step with numbers that count on, called some times beforehand."""
    numbers = itertools.count()
    for _ in range(warm_up):
        step(next(numbers))
    return Contender(step, lambda: next(numbers))


def updating(scans: list[EvidentialGrid], particles: int, **options: Any) -> Contender:
    mapper = DynamicMapper(SPEC, particles, **{"matching": False, **options})

    def step(k: int) -> None:
        mapper.update(scans[k % LOOP], np.eye(4), stamp=k * PERIOD)

    return counted(step, 20)  # until the particles are where things move


def in_numpy(scans: list[EvidentialGrid], particles: int) -> Contender:
    plain = NumpyFilter(SPEC.shape, SPEC.resolution, particles, DynamicSettings())

    def step(k: int) -> None:
        plain.update(scans[k % LOOP].mass, PERIOD, scan_key(0, k))

    return counted(step, 5)


def copying(particles: int) -> Contender:
    source, target = np.ones((4, particles), np.float32), np.empty((4, particles), np.float32)
    return Contender(lambda _: np.copyto(target, source))


def contenders(scans: list[EvidentialGrid]) -> dict[str, Contender]:
    found = {}
    for name, particles in (("200k", FEW), ("1M", MANY)):
        found[f"copy, {name}"] = copying(particles)
        found[f"update, {name}"] = updating(scans, particles)
        found[f"update, {name}, Nuss"] = updating(scans, particles, filter="nuss")
        found[f"numpy, {name}"] = in_numpy(scans, particles)
    found |= {"update, 200k, matching": updating(scans, FEW, matching=True), "predicted, 200k": predicting(scans)}
    return found | whole_chain()


def predicting(scans: list[EvidentialGrid]) -> Contender:
    """Predict half a second ahead, with objects that are followed."""
    mapper = DynamicMapper(SPEC, FEW)
    mapper.objects()
    for k in range(20):
        mapper.update(scans[k % LOOP], np.eye(4), stamp=k * PERIOD)
    return Contender(lambda _: mapper.predicted(0.5))


def whole_chain() -> dict[str, Contender]:
    """Return from points to the map, on the scans of KITTI 0005 again and again, if they are there."""
    folder = run.DATA / "kitti_raw_0005"
    if not folder.is_dir():
        return {}
    frames = list(open_dataset(folder))
    ism, mapper = RayISM(SPEC, frames[0].mount), DynamicMapper(SPEC, FEW)
    for frame in frames:
        frame.scan  # noqa: B018  reading is not the chain's time

    def step(k: int) -> None:
        frame = frames[k % len(frames)]
        if k % len(frames) == 0:
            mapper.reset()
        mapper.update(ism(frame.scan), frame.T_map_sensor, stamp=frame.stamp)

    return {"update, RayISM and matching, KITTI": counted(step, len(frames))}


def threaded(scans: list[EvidentialGrid], rounds: int) -> dict[str, float]:
    """Return the milliseconds of updates with one and two threads, in one process that has two cores."""
    names = {(n, t): f"{label}, {t}" for n, label in ((FEW, "200k"), (MANY, "1M")) for t in (1, 2)}
    times = measure({name: updating(scans, n, threads=t) for (n, t), name in names.items()}, rounds)
    return {name: one.low for name, one in times.items()}


def on_two_cores(rounds: int) -> dict[str, float] | None:
    """Return the result of `threaded` in another process, which is not pinned to a core."""
    if (os.cpu_count() or 1) < 2:
        return None
    script = f"import json, dynamic_speed as own; print(json.dumps(own.threaded(own.scene(), {rounds})))"
    out = run.in_new_process(script, cwd=Path(__file__).parent, env=os.environ | {"OGM_CORES": "2"})
    found: dict[str, float] = json.loads(out.splitlines()[-1])
    return found


def long_drive(scans: list[EvidentialGrid], count: int) -> dict[str, Any]:
    """Return whether scans of a long drive stay as cheap, memory as small, and masses masses."""
    mapper = DynamicMapper(SPEC, FEW)

    def step(k: int) -> None:
        mapper.update(scans[k % LOOP], pose(0.8 * k), stamp=PERIOD * k)

    found = long_run(counted(step, WARM_UP), count)
    mass = mapper.dynamic_grid.mass.astype(np.float64)
    return found | {"least mass": mass.min(), "most free + static + dynamic": mass.sum(axis=-1).max()}


def verdicts(
    times: Mapping[str, Times], threads: Mapping[str, float] | None, drive: Mapping[str, Any]
) -> list[dict[str, Any]]:
    few, many = times["update, 200k"].median, times["update, 1M"].median
    rows = [
        ("update, 200k", few, "<=", 12.0, "ms"),
        ("update, 1M", many, "<=", 28.0, "ms"),
        ("per particle, 1M", many, "<=", 25.0, "ns"),
        ("update / copy, 1M", many / times["copy, 1M"].median, "<=", 8.0, "x"),
        ("predicted, 200k", times["predicted, 200k"].median, "<=", 3.0, "ms"),
        ("numpy / update, 1M", times["numpy, 1M"].median / many, ">=", 10.0, "x"),
        ("matching", times["update, 200k, matching"].median - few, "<=", 7.0, "ms"),
        ("last hundred / first hundred of a long drive", drive["last / first"], "<=", 1.1, "x"),
        ("memory grown", drive["memory grown [MB]"], "<=", 1.0, "MB"),
        ("most free + static + dynamic", drive["most free + static + dynamic"], "<=", 0.98 + 1e-6, ""),
    ]
    chain = times.get("update, RayISM and matching, KITTI")
    if chain:
        rows += [("RayISM and update with matching, KITTI", 1e3 / chain.median, ">=", 40.0, "Hz")]
    if threads:
        rows += [(f"two threads, {n}", threads[f"{n}, 1"] / threads[f"{n}, 2"], ">=", 1.6, "x") for n in ("200k", "1M")]
    return run.verdicts(rows)


def main() -> None:
    parser = run.Parser(__doc__, picture=True, quick=True, rounds=20)
    parser.add_argument("--scans", type=int, default=10_000, help="of the long drive")
    given = parser.parse_args()
    rounds, count = (2, 300) if given.quick else (given.rounds, given.scans)
    scans = scene()
    found = run.environment("ray", "dynamic")
    times = measure(contenders(scans), rounds)
    threads, far = on_two_cores(rounds), long_drive(scans, count)
    record = {
        "environment": found,
        "note": NOTE,
        "cells": list(SPEC.shape),
        "times [ms]": times,
        "two cores, lower quartiles [ms]": threads,
        "long drive": far,
        "verdicts": verdicts(times, threads, far),
    }
    run.write_record(given.out, record)
    colours = {"copy": FLOOR, "numpy": TWIN}
    draw_speed(given.picture, record, colours, f"{count} scans, 200k particles, matching")


if __name__ == "__main__":
    main()
