"""What a scan costs a dynamic map, by particle and against numpy, and whether a long drive stays as cheap.

    python benchmarks/dynamic_speed.py [--rounds N] [--scans N] [--quick]

One core, 512 x 352 cells, walls and 40 vehicles in free space; then the same with two threads on two cores, if there
are two. Writes benchmarks/results/dynamic_speed.json and docs/pictures/dynamic_speed.png.
"""

import _run as run  # first: it sets the number of threads

# isort: split
import argparse
import itertools
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ogm import EvidentialGrid, GridSpec
from ogm.datasets import open_dataset
from ogm.fusion import DynamicMapper, DynamicSettings
from ogm.fusion.dynamic.hashed_noise import scan_key
from ogm.fusion.dynamic.reference import NumpyFilter
from ogm.geometric import RayISM
from ogm.pose import pose

SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
PERIOD, LOOP, VEHICLES = 0.1, 100, 40  # [s] from scan to scan, scans after which the scene repeats, vehicles
FEW, MANY = 200_000, 1_000_000
LAST = 100  # scans at either end of a long drive that are compared
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


def updating(scans: list[EvidentialGrid], particles: int, **options: Any) -> run.Contender:
    mapper, numbers = DynamicMapper(SPEC, particles, **{"matching": False, **options}), itertools.count()

    def step(k: int) -> None:
        mapper.update(scans[k % LOOP], np.eye(4), stamp=k * PERIOD)

    for _ in range(20):  # until the particles are where things move
        step(next(numbers))
    return run.Contender(step, lambda: next(numbers))


def in_numpy(scans: list[EvidentialGrid], particles: int) -> run.Contender:
    plain = NumpyFilter(SPEC.shape, SPEC.resolution, particles, DynamicSettings())
    numbers = itertools.count()

    def step(k: int) -> None:
        plain.update(scans[k % LOOP].mass, PERIOD, scan_key(0, k))

    for _ in range(5):
        step(next(numbers))
    return run.Contender(step, lambda: next(numbers))


def copying(particles: int) -> run.Contender:
    source, target = np.ones((4, particles), np.float32), np.empty((4, particles), np.float32)
    return run.Contender(lambda _: np.copyto(target, source))


def contenders(scans: list[EvidentialGrid]) -> dict[str, run.Contender]:
    found = {}
    for name, particles in (("200k", FEW), ("1M", MANY)):
        found[f"copy, {name}"] = copying(particles)
        found[f"update, {name}"] = updating(scans, particles)
        found[f"update, {name}, Nuss"] = updating(scans, particles, filter="nuss")
        found[f"numpy, {name}"] = in_numpy(scans, particles)
    found |= {"update, 200k, matching": updating(scans, FEW, matching=True), "predicted, 200k": predicting(scans)}
    return found | whole_chain()


def predicting(scans: list[EvidentialGrid]) -> run.Contender:
    """Predict half a second ahead, with objects that are followed."""
    mapper = DynamicMapper(SPEC, FEW)
    mapper.objects()
    for k in range(20):
        mapper.update(scans[k % LOOP], np.eye(4), stamp=k * PERIOD)
    return run.Contender(lambda _: mapper.predicted(0.5))


def whole_chain() -> dict[str, run.Contender]:
    """Return from points to the map, on the scans of KITTI 0005 again and again, if they are there."""
    folder = run.DATA / "kitti_raw_0005"
    if not folder.is_dir():
        return {}
    frames = list(open_dataset(folder))
    ism, mapper = RayISM(SPEC, frames[0].mount), DynamicMapper(SPEC, FEW)
    numbers = itertools.count()
    for frame in frames:
        frame.scan  # noqa: B018  reading is not the chain's time

    def step(k: int) -> None:
        frame = frames[k % len(frames)]
        if k % len(frames) == 0:
            mapper.reset()
        mapper.update(ism(frame.scan), frame.T_map_sensor, stamp=frame.stamp)

    for _ in frames:
        step(next(numbers))
    return {"update, RayISM and matching, KITTI": run.Contender(step, lambda: next(numbers))}


def threaded(scans: list[EvidentialGrid], rounds: int) -> dict[str, float]:
    """Return the milliseconds of updates with one and two threads, in one process that has two cores."""
    names = {(n, t): f"{label}, {t}" for n, label in ((FEW, "200k"), (MANY, "1M")) for t in (1, 2)}
    times = run.measure({name: updating(scans, n, threads=t) for (n, t), name in names.items()}, rounds)
    return {name: one.low for name, one in times.items()}


def on_two_cores(rounds: int) -> dict[str, float] | None:
    """Return what `threaded` measures in another process, which is not pinned to a core."""
    if (os.cpu_count() or 1) < 2:
        return None
    command = [sys.executable, __file__, "--rounds", str(rounds), "--threaded"]
    done = subprocess.run(command, env={**os.environ, "OGM_CORES": "2"}, capture_output=True, text=True, check=True)
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def long_drive(scans: list[EvidentialGrid], count: int) -> dict[str, Any]:
    """Drive on and on, and see whether scans stay as cheap, memory as small, and masses masses."""
    mapper = DynamicMapper(SPEC, FEW)
    for k in range(-LAST, 0):  # memory and caches as they will be
        mapper.update(scans[k % LOOP], pose(0.8 * k), stamp=PERIOD * k)
    seconds, memory = np.empty(count), []
    for k in range(count):
        start = time.perf_counter()
        mapper.update(scans[k % LOOP], pose(0.8 * k), stamp=PERIOD * k)
        seconds[k] = time.perf_counter() - start
        if k % max(count // 100, 1) == 0 or k == count - 1:
            memory.append(resident())
    mass = mapper.dynamic_grid.mass.astype(np.float64)
    blocks = np.median(seconds[: count // LAST * LAST].reshape(-1, LAST), axis=1) * 1e3
    return {
        "scans": count,
        "last / first": float(blocks[-1] / blocks[0]),
        "medians of hundreds [ms]": [round(value, 4) for value in blocks.tolist()],
        "memory [MB]": [round(value, 2) for value in memory],
        "memory grown [MB]": round(memory[-1] - memory[1], 3),
        "least mass": float(mass.min()),
        "most free + static + dynamic": float(mass.sum(axis=-1).max()),
    }


def resident() -> float:
    """Return the memory that the process holds now [MB] (Linux)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


def verdicts(
    times: Mapping[str, run.Times], threads: Mapping[str, float] | None, drive: Mapping[str, Any]
) -> list[dict[str, Any]]:
    few, many = times["update, 200k"].median, times["update, 1M"].median
    rows = [
        ("update, 200k", few, 12.0, "ms", False),
        ("update, 1M", many, 28.0, "ms", False),
        ("per particle, 1M", many, 25.0, "ns", False),
        ("update / copy, 1M", many / times["copy, 1M"].median, 8.0, "x", False),
        ("predicted, 200k", times["predicted, 200k"].median, 3.0, "ms", False),
        ("numpy / update, 1M", times["numpy, 1M"].median / many, 10.0, "x", True),
        ("matching", times["update, 200k, matching"].median - few, 7.0, "ms", False),
        ("last hundred / first hundred of a long drive", drive["last / first"], 1.1, "x", False),
        ("memory grown", drive["memory grown [MB]"], 1.0, "MB", False),
        ("most free + static + dynamic", drive["most free + static + dynamic"], 0.98 + 1e-6, "", False),
    ]
    chain = times.get("update, RayISM and matching, KITTI")
    if chain:
        rows += [("RayISM and update with matching, KITTI", 1e3 / chain.median, 40.0, "Hz", True)]
    if threads:
        rows += [(f"two threads, {n}", threads[f"{n}, 1"] / threads[f"{n}, 2"], 1.6, "x", True) for n in ("200k", "1M")]
    return [
        {"what": w, "got": g, "wanted": t, "unit": u, "met": bool(g >= t if least else g <= t)}
        for w, g, t, u, least in rows
    ]


def report(record: Mapping[str, Any], times: Mapping[str, run.Times]) -> None:
    for name, one in times.items():
        print(f"{name:28} {one!s:>34}   on core {one.on_core:.2f}")
    for row in record["verdicts"]:
        line = f"{row['what']}: {row['got']:.4g} {row['unit']} (wanted {row['wanted']:g})"
        print(f"{'ok    ' if row['met'] else 'MISSED'} {line}")


def picture(record: Mapping[str, Any], times: Mapping[str, run.Times], path: Path) -> None:
    figure = Figure(figsize=(12.5, 4.6), layout="constrained")
    bars, line = figure.subplots(1, 2, width_ratios=(1.35, 1))
    names = list(times)[::-1]
    kinds = {"copy": run.FLOOR, "numpy": run.TWIN, "update": run.OURS, "predicted": run.OURS}
    values = [times[name].median for name in names]
    bars.barh(names, values, color=[kinds[name.split(",")[0]] for name in names])
    for y, value in enumerate(values):
        bars.text(value * 1.06, y, f"{value:.2f} ms" if value < 10 else f"{value:.0f} ms", va="center", fontsize=9)
    bars.set(xscale="log", xlabel="time per call [ms], median", title="one scan, 512 x 352 cells")
    bars.set_xlim(min(values) / 1.6, max(values) * 4)
    medians: NDArray[np.floating] = np.array(record["long drive"]["medians of hundreds [ms]"])
    line.plot((np.arange(len(medians)) + 0.5) * LAST, medians, color=run.OURS, lw=1.2)
    line.set(xlabel="scans", ylabel="median of a hundred updates [ms]", ylim=(0, None))
    line.set_title(f"{record['long drive']['scans']} scans, 200k particles, matching")
    run.save_picture(figure, path, run.caption(record["environment"]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--scans", type=int, default=10_000, help="of the long drive")
    parser.add_argument("--quick", action="store_true", help="see that everything runs; figures are worth nothing")
    parser.add_argument(
        "--threaded", action="store_true", help=argparse.SUPPRESS
    )  # on two cores, for the program itself
    given = parser.parse_args()
    rounds, count = (2, 300) if given.quick else (given.rounds, given.scans)
    scans = scene()
    if given.threaded:
        print(json.dumps(threaded(scans, rounds)))
        return
    found = run.environment()
    times = run.measure(contenders(scans), rounds)
    threads, far = on_two_cores(rounds), long_drive(scans, count)
    record = {
        "environment": found,
        "note": NOTE,
        "cells": list(SPEC.shape),
        "times [ms]": {name: one._asdict() for name, one in times.items()},
        "two cores, lower quartiles [ms]": threads,
        "long drive": far,
        "verdicts": verdicts(times, threads, far),
    }
    report(record, times)
    if not given.quick:
        run.write_json(run.RESULTS / "dynamic_speed.json", record)
        picture(record, times, run.PICTURES / "dynamic_speed.png")


if __name__ == "__main__":
    main()
