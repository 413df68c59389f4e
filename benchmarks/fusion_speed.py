"""What does a scan cost a map, against a copy of the bytes it touches? Is a long drive cheap to its end? Measured.

    python benchmarks/fusion_speed.py [--rounds N] [--scans N] [--quick]

One core, 512 x 352 cells, the pose turned and moved in every scan. Writes benchmarks/results/fusion_speed.json and
docs/pictures/fusion_speed.png.
"""

import _run as run  # first: it sets the number of threads
from _contenders import street

# isort: split
import itertools
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from _charts import FLOOR, PEER, TWIN, draw_speed
from _timing import Contender, Times, long_run, measure
from numpy.typing import NDArray
from scipy import ndimage

from ogm import EvidentialGrid, GridSpec, Mount
from ogm.evidence import cautious, cumulative, dempster, discount, yager
from ogm.fusion import BinaryBayesMapper, EvidentialMapper, warp
from ogm.geometric import RayISM
from ogm.models import load_model
from ogm.pose import inverse, pose
from ogm.scan import InverseSensorModel

SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
HEIGHT, POINTS = 1.9, 120_000
MODELS = ("ray", "combined")
STEP, TURN, PERIOD = 0.8, 0.01, 0.1  # [m], [rad], [s] from scan to scan: 8 m/s at 10 Hz
NOTE = (
    "'copy' copies the map, the conflict layers and the scan once each: the bytes that an update reads, and more than "
    "it writes. 'scipy' is the common way with a grid that turns with the vehicle: interpolate the whole map into the "
    "new pose (scipy.ndimage.affine_transform, order 1), discount it and combine it in numpy."
)


def drive() -> Callable[[], tuple[NDArray[np.float64], float]]:
    """Return a function that gives the next pose and stamp of an endless bend."""
    numbers = itertools.count()

    def next_pose() -> tuple[NDArray[np.float64], float]:
        k = next(numbers)
        yaw, radius = TURN * k, STEP / TURN
        return pose(radius * math.sin(yaw), radius * (1 - math.cos(yaw)), yaw=yaw), PERIOD * k

    return next_pose


def updating(mapper: Any, grid: EvidentialGrid) -> Contender:
    def step(at: tuple[NDArray[np.float64], float]) -> None:
        mapper.update(grid, at[0], stamp=at[1])

    return Contender(step, drive())


def mapping(ism: InverseSensorModel, points: NDArray[np.float32]) -> Contender:
    mapper = EvidentialMapper(SPEC)

    def step(at: tuple[NDArray[np.float64], float]) -> None:
        mapper.update(ism(points), at[0], stamp=at[1])

    return Contender(step, drive())


def by_scipy(grid: EvidentialGrid) -> Contender:
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

    return Contender(step, ahead)


def contenders(points: NDArray[np.float32]) -> dict[str, Contender]:
    ray, combined = (load_model(name, SPEC, Mount(HEIGHT)) for name in MODELS)
    grid = ray(points)
    arrays = [(np.zeros_like(grid.mass), np.empty_like(grid.mass)) for _ in range(3)]

    def copy(_: None) -> None:
        for source, target in arrays:
            np.copyto(target, source)

    mapper = EvidentialMapper(SPEC)
    mapper.update(grid, pose(yaw=0.3), stamp=0.0)
    fixed = mapper.grid
    return {
        "copy": Contender(copy),
        "update, default": updating(EvidentialMapper(SPEC), grid),
        "update, dempster": updating(EvidentialMapper(SPEC, dempster), grid),
        "update, yager": updating(EvidentialMapper(SPEC, yager), grid),
        "update, cumulative": updating(EvidentialMapper(SPEC, cumulative), grid),
        "update, forget observed": updating(EvidentialMapper(SPEC, forget="observed"), grid),
        "update, BinaryBayesMapper": updating(BinaryBayesMapper(SPEC), grid),
        "update, numpy reference": updating(EvidentialMapper(SPEC, lambda a, b: cautious(a, b)), grid),
        "scipy": by_scipy(grid),
        "view, nearest": Contender(lambda _: mapper.view(SPEC)),
        "view, area": Contender(lambda _: mapper.view(SPEC, method="area")),
        "warp of the map, nearest": Contender(lambda _: warp(fixed, SPEC, pose(1, 2, yaw=0.4), "nearest")),
        "RayISM": Contender(lambda _: ray(points)),
        "RayISM + update": mapping(ray, points),
        "combined + update": mapping(combined, points),
    }


def long_drive(points: NDArray[np.float32], scans: int) -> dict[str, Any]:
    """Return whether scans of a long drive stay as cheap, memory as small, and masses masses."""
    rng, ism, mapper = np.random.default_rng(0), RayISM(SPEC, Mount(HEIGHT)), EvidentialMapper(SPEC)
    grids = itertools.cycle([ism(points[rng.random(len(points)) < share]) for share in (1.0, 0.7, 0.4)])
    ahead = drive()

    def step(given: tuple[EvidentialGrid, tuple[NDArray[np.float64], float]]) -> None:
        grid, (T, stamp) = given
        mapper.update(grid, T, stamp=stamp)

    moving = Contender(step, lambda: (next(grids), ahead()))
    long_run(moving, 100)  # memory and caches as they will be
    found = long_run(moving, scans)
    mass = mapper.grid.mass.astype(np.float64)
    return found | {"km": scans * STEP / 1e3, "least mass": mass.min(), "most free + occupied": mass.sum(axis=-1).max()}


def verdicts(times: Mapping[str, Times], drive: Mapping[str, Any]) -> list[dict[str, Any]]:
    update, copy = times["update, default"].median, times["copy"].median
    rows = [
        ("update / copy", update / copy, "<=", 6.0, "x"),
        ("update", update, "<=", 2.0, "ms"),
        ("RayISM + update, 64 layers", 1e3 / times["RayISM + update"].median, ">=", 60.0, "scans/s"),
        ("last hundred / first hundred of a long drive", drive["last / first"], "<=", 1.1, "x"),
        ("most free + occupied", drive["most free + occupied"], "<=", 0.98 + 1e-6, ""),
    ]
    return run.verdicts(rows)


def main() -> None:
    parser = run.Parser(__doc__, picture=True, quick=True, rounds=30)
    parser.add_argument("--scans", type=int, default=10_000, help="of the long drive")
    given = parser.parse_args()
    rounds, scans = (2, 400) if given.quick else (given.rounds, given.scans)
    found = run.environment(*MODELS, "cautious", "bayes")
    points = street(POINTS)
    rivals = contenders(points)
    alone = measure({name: rivals[name] for name in ("copy", "update, default")}, rounds)  # with warm caches
    times = measure(rivals, rounds)
    far = long_drive(points, scans)
    record = {
        "environment": found,
        "note": NOTE,
        "points": len(points),
        "cells": list(SPEC.shape),
        "times [ms]": times,
        "alone [ms]": alone,
        "long drive": far,
        "verdicts": verdicts(times, far),
    }
    run.write_record(given.out, record)
    colours = {"copy": FLOOR, "update, numpy reference": TWIN, "scipy": PEER, "update, BinaryBayesMapper": PEER}
    draw_speed(given.picture, record, colours, f"a drive of {scans} scans, {far['km']:.0f} km")


if __name__ == "__main__":
    main()
