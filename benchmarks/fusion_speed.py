"""What does a scan cost a map, against a copy of the bytes it touches? Is a long drive cheap to its end? Measured.

    python benchmarks/fusion_speed.py [--rounds N] [--scans N] [--quick]

One core, 512 x 352 cells, the pose turned and moved in every scan. Writes benchmarks/results/fusion_speed.json and
docs/pictures/fusion_speed.png.
"""

import _run as run  # first: it sets the number of threads
from _contenders import street

# isort: split
import argparse
import itertools
import math
import resource
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import ndimage

from ogm import EvidentialGrid, GridSpec, Mount
from ogm.evidence import cumulative, dempster, discount, normalized_cautious, yager
from ogm.fusion import BinaryBayesMapper, EvidentialMapper, warp
from ogm.geometric import RayISM
from ogm.pose import inverse, pose

SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
HEIGHT, POINTS = 1.9, 120_000
STEP, TURN, PERIOD = 0.8, 0.01, 0.1  # [m], [rad], [s] from scan to scan: 8 m/s at 10 Hz
LAST = 100  # scans at either end of a long drive that are compared
NOTE = (
    "'copy' copies the map, the conflict layers and the scan once each: the bytes that an update reads, and more than "
    "it writes. 'scipy' is the common way with a grid that turns with the vehicle: interpolate the whole map into the "
    "new pose (scipy.ndimage.affine_transform, order 1), discount it and combine it in numpy."
)


def drive() -> Callable[[], tuple[NDArray[np.float64], float]]:
    """Return what gives the next pose and stamp: an endless bend."""
    numbers = itertools.count()

    def next_pose() -> tuple[NDArray[np.float64], float]:
        k = next(numbers)
        yaw, radius = TURN * k, STEP / TURN
        return pose(radius * math.sin(yaw), radius * (1 - math.cos(yaw)), yaw=yaw), PERIOD * k

    return next_pose


def updating(mapper: Any, grid: EvidentialGrid) -> run.Contender:
    def step(at: tuple[NDArray[np.float64], float]) -> None:
        mapper.update(grid, at[0], stamp=at[1])

    return run.Contender(step, drive())


def by_scipy(grid: EvidentialGrid) -> run.Contender:
    """Return the common way: a map in the vehicle's frame, interpolated from scan to scan."""
    ahead = drive()
    T_last, stamp_last = ahead()
    mass = grid.mass.copy()
    middle = np.array([SPEC.shape[0] / 2, SPEC.shape[1] / 2])

    def step(at: tuple[NDArray[np.float64], float]) -> None:
        nonlocal mass, T_last, stamp_last
        T, stamp = at
        back = inverse(T_last) @ T
        shift = middle + back[:2, 3] / SPEC.resolution - back[:2, :2] @ middle
        warped = [ndimage.affine_transform(mass[..., k], back[:2, :2], shift, order=1) for k in (0, 1)]
        mass = dempster(discount(np.stack(warped, axis=-1), 0.5 ** ((stamp - stamp_last) / 2.0)), grid.mass)
        T_last, stamp_last = T, stamp

    return run.Contender(step, ahead)


def contenders(points: NDArray[np.float32]) -> dict[str, run.Contender]:
    ism = RayISM(SPEC, Mount(HEIGHT))
    grid = ism(points)
    arrays = [(np.zeros_like(grid.mass), np.empty_like(grid.mass)) for _ in range(3)]

    def copy(_: None) -> None:
        for source, target in arrays:
            np.copyto(target, source)

    mapper, whole = EvidentialMapper(SPEC), EvidentialMapper(SPEC)

    def stream(at: tuple[NDArray[np.float64], float]) -> None:
        whole.update(ism(points), at[0], stamp=at[1])

    mapper.update(grid, pose(yaw=0.3), stamp=0.0)
    fixed = mapper.grid
    return {
        "copy": run.Contender(copy),
        "update, default": updating(EvidentialMapper(SPEC), grid),
        "update, dempster": updating(EvidentialMapper(SPEC, dempster), grid),
        "update, yager": updating(EvidentialMapper(SPEC, yager), grid),
        "update, cumulative": updating(EvidentialMapper(SPEC, cumulative), grid),
        "update, forget observed": updating(EvidentialMapper(SPEC, forget="observed"), grid),
        "update, BinaryBayesMapper": updating(BinaryBayesMapper(SPEC), grid),
        "update, numpy reference": updating(EvidentialMapper(SPEC, lambda a, b: normalized_cautious(a, b)), grid),
        "scipy": by_scipy(grid),
        "view, nearest": run.Contender(lambda _: mapper.view(SPEC)),
        "view, area": run.Contender(lambda _: mapper.view(SPEC, method="area")),
        "warp of the map, nearest": run.Contender(lambda _: warp(fixed, SPEC, pose(1, 2, yaw=0.4), "nearest")),
        "RayISM": run.Contender(lambda _: ism(points)),
        "RayISM + update": run.Contender(stream, drive()),
    }


def long_drive(points: NDArray[np.float32], scans: int) -> dict[str, Any]:
    """Drive on and on, and see whether scans stay as cheap, memory as small, and masses masses."""
    rng = np.random.default_rng(0)
    ism = RayISM(SPEC, Mount(HEIGHT))
    grids = [ism(points[rng.random(len(points)) < share]) for share in (1.0, 0.7, 0.4)]
    mapper, ahead = EvidentialMapper(SPEC), drive()
    for _ in range(20):  # memory and caches as they will be
        T, stamp = ahead()
        mapper.update(grids[0], T, stamp=stamp)
    seconds = np.empty(scans)
    memory = []
    for k in range(scans):
        T, stamp = ahead()
        start = time.perf_counter()
        mapper.update(grids[k % 3], T, stamp=stamp)
        seconds[k] = time.perf_counter() - start
        if k % max(scans // 100, 1) == 0 or k == scans - 1:
            memory.append(resident())
    mass = mapper.grid.mass.astype(np.float64)
    blocks = np.median(seconds[: scans // LAST * LAST].reshape(-1, LAST), axis=1) * 1e3
    first, last = float(blocks[0]), float(blocks[-1])
    return {
        "scans": scans,
        "km": scans * STEP / 1e3,
        "first hundred [ms]": first,
        "last hundred [ms]": last,
        "last / first": last / first,
        "medians of hundreds [ms]": [round(value, 4) for value in blocks.tolist()],
        "memory [MB]": [round(value, 2) for value in memory],
        "memory grown [MB]": round(memory[-1] - memory[1], 3),
        "least mass": float(mass.min()),
        "most free + occupied": float(mass.sum(axis=-1).max()),
    }


def resident() -> float:
    """Return the memory that the process holds now [MB] (Linux)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


def verdicts(times: Mapping[str, run.Times], drive: Mapping[str, Any]) -> list[dict[str, Any]]:
    update, copy = times["update, default"].median, times["copy"].median
    rate = 1e3 / times["RayISM + update"].median
    rows = [
        ("update / copy", update / copy, 6.0, "x", False),
        ("update", update, 2.0, "ms", False),
        ("RayISM + update, 64 layers", rate, 60.0, "scans/s", True),
        ("last hundred / first hundred of a long drive", drive["last / first"], 1.1, "x", False),
        ("most free + occupied", drive["most free + occupied"], 0.98 + 1e-6, "", False),
    ]
    return [
        {"what": w, "got": g, "wanted": t, "unit": u, "met": bool(g >= t if least else g <= t)}
        for w, g, t, u, least in rows
    ]


def report(record: Mapping[str, Any], times: Mapping[str, run.Times]) -> None:
    copy = times["copy"].median
    for name, one in times.items():
        print(f"{name:36} {one!s:>34}   {one.median / copy:7.2f} x copy   on core {one.on_core:.2f}")
    drive = record["long drive"]
    print(
        f"{drive['scans']} scans, {drive['km']:.1f} km: first hundred {drive['first hundred [ms]']:.3f} ms, last "
        f"{drive['last hundred [ms]']:.3f} ms, memory grown by {drive['memory grown [MB]']:.2f} MB"
    )
    for row in record["verdicts"]:
        line = f"{row['what']}: {row['got']:.4g} {row['unit']} (wanted {row['wanted']:g})"
        print(f"{'ok    ' if row['met'] else 'MISSED'} {line}")


def picture(record: Mapping[str, Any], times: Mapping[str, run.Times], path: Path) -> None:
    figure = Figure(figsize=(12.5, 5.4), layout="constrained")
    bars, line = figure.subplots(1, 2, width_ratios=(1.35, 1))
    names = list(times)[::-1]
    others = {"copy": run.FLOOR, "update, numpy reference": run.TWIN}
    colours = others | dict.fromkeys(("scipy", "update, BinaryBayesMapper"), run.PEER)
    values = [times[name].median for name in names]
    bars.barh(names, values, color=[colours.get(name, run.OURS) for name in names])
    for y, value in enumerate(values):
        bars.text(value * 1.06, y, f"{value:.2f} ms" if value < 10 else f"{value:.0f} ms", va="center", fontsize=9)
    bars.set(xscale="log", xlabel="time per call [ms], median", title="one scan, 512 x 352 cells")
    bars.set_xlim(min(values) / 1.6, max(values) * 4)
    bars.axvline(2.0, color="0.4", lw=0.8, ls=":")
    bars.text(2.0, len(names) - 0.35, "2 ms", ha="center", fontsize=8, color="0.4")
    drive = record["long drive"]
    medians = drive["medians of hundreds [ms]"]
    line.plot((np.arange(len(medians)) + 0.5) * LAST, medians, color=run.OURS, lw=1.2)
    line.set(xlabel="scans", ylabel="median of a hundred updates [ms]", ylim=(0, None))
    line.set_title(f"a drive of {drive['scans']} scans, {drive['km']:.0f} km")
    memory = line.twinx()
    memory.plot(np.linspace(0, drive["scans"], len(drive["memory [MB]"])), drive["memory [MB]"], color=run.PEER, lw=1.2)
    memory.set_ylim(0, None)
    memory.set_ylabel("memory of the process [MB]", color=run.PEER)
    memory.tick_params(axis="y", colors=run.PEER)
    run.save_picture(figure, path, run.caption(record["environment"]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--scans", type=int, default=10_000, help="of the long drive")
    parser.add_argument("--quick", action="store_true", help="see that everything runs; figures are worth nothing")
    given = parser.parse_args()
    rounds, scans = (2, 400) if given.quick else (given.rounds, given.scans)
    found = run.environment()
    points = street(POINTS)
    rivals = contenders(points)
    alone = run.measure({name: rivals[name] for name in ("copy", "update, default")}, rounds)
    times = run.measure(rivals, rounds)
    far = long_drive(points, scans)
    record = {
        "environment": found,
        "note": NOTE,
        "points": len(points),
        "cells": list(SPEC.shape),
        "times [ms]": {name: one._asdict() for name, one in times.items()},
        "alone [ms]": {name: one._asdict() for name, one in alone.items()},
        "long drive": far,
        "verdicts": verdicts(times, far),
    }
    print(f"alone, with warm caches: copy {alone['copy']}, update {alone['update, default']}")
    report(record, times)
    if not given.quick:
        run.write_json(run.RESULTS / "fusion_speed.json", record)
        picture(record, times, run.PICTURES / "fusion_speed.png")


if __name__ == "__main__":
    main()
