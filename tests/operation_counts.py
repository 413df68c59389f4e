"""Count what parts of ogm do at growing sizes: executed lines of its modules, and the peak of allocated bytes.

Started by test_growth.py with NUMBA_DISABLE_JIT, so that kernels are lines, too; prints JSON. The counts are the same
on every machine.
"""

import json
import math
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray

import ogm
from ogm import EvidentialGrid, Frame, GridSpec, Mount, Scan
from ogm.fusion import EvidentialMapper, fuse
from ogm.geometric import RayISM, flat_ground, local_ground
from ogm.geometric.ground import GroundEstimate
from ogm.pose import pose

PACKAGE = str(Path(ogm.__file__).parent)
MOUNT = Mount(1.9, ego_footprint=(-1, 1, -1, 1))
SPEC = GridSpec.centered(24.0, 16.0, 1.0)
SECTOR = 2 * math.pi / 64  # few sectors: their fixed cost is small beside that of points
Call = Callable[[], object]


def street(count: int) -> NDArray[np.float32]:
    """Return about so many points of a road between two walls, in 16 layers."""
    azimuth, elevation = np.meshgrid(
        np.linspace(-math.pi, math.pi, count // 16, endpoint=False) + 0.01, np.radians(np.linspace(-25, 2, 16))
    )
    wall = np.minimum(7 / np.abs(np.sin(azimuth)), 11 / np.abs(np.cos(azimuth)))
    reach = np.minimum(wall, 1.9 / np.tan(np.maximum(-elevation, 1e-9)))
    xyz = reach * np.cos(azimuth), reach * np.sin(azimuth), reach * np.tan(elevation)
    return np.stack([*map(np.ravel, xyz), np.full(reach.size, 0.5)], axis=1).astype(np.float32)


def counted(call: Call) -> tuple[int, int]:
    """Return the lines of ogm that a call executes, and then the peak of bytes that a further call allocates."""
    lines = 0

    def count(frame: FrameType, event: str, _: Any) -> Any:
        nonlocal lines
        lines += event == "line"
        return count

    def begin(frame: FrameType, event: str, arg: Any) -> Any:
        return count if frame.f_code.co_filename.startswith(PACKAGE) else None

    sys.settrace(begin)
    call()
    sys.settrace(None)
    tracemalloc.start()
    call()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return lines, peak


def scan(spec: GridSpec, size: int, ground: GroundEstimate = flat_ground) -> Call:
    """Return the mapping of a scan; the plane as ground leaves out tables of slopes, whose size is fixed."""
    ism, points = RayISM(spec, MOUNT, ground, azimuth_step=SECTOR), street(size)
    ism(points)  # fills the caches
    return lambda: ism(points)


def finer(cells: int) -> GridSpec:
    """Return about as many cells over the area of `SPEC`."""
    side = math.sqrt(SPEC.length * SPEC.width / cells)
    return GridSpec(side, (round(SPEC.length / side), round(SPEC.width / side)), SPEC.origin)


def update(spec: GridSpec, scans: int) -> Call:
    """Return the update of a map that has so many scans, of a vehicle that drives on."""
    mass = np.zeros((*spec.shape, 2), np.float32)
    mass[::2], mass[::3, ::4] = (0.6, 0.0), (0.0, 0.7)
    mapper, grid, moments = EvidentialMapper(spec), EvidentialGrid(spec, mass), iter(range(10**6))

    def step() -> None:
        moment = next(moments)
        mapper.update(grid, pose(2.0 * moment, yaw=0.3), stamp=0.1 * moment)

    for _ in range(scans):
        step()
    return step


def moment_of_sensors(size: int) -> Call:
    mounts = {f"lidar {k}": Mount(1.9, pose(yaw=k), (-1, 1, -1, 1)) for k in range(size)}
    models = {name: RayISM(SPEC, mount, flat_ground, azimuth_step=SECTOR) for name, mount in mounts.items()}
    mapper, points, moments = EvidentialMapper(SPEC), street(320), iter(range(10**6))

    def moment() -> None:
        stamp = 0.1 * next(moments)
        frames = [
            Frame(Scan(points, sensor=name), mount, T_map_sensor=mount.T_vehicle_sensor, stamp=stamp)
            for name, mount in mounts.items()
        ]
        assert not [step.error for step in fuse(frames, models, mapper) if step.error]

    moment()
    return moment


PARTS: dict[str, tuple[Callable[[int], Call], tuple[int, ...]]] = {
    "points": (lambda size: scan(SPEC, size), (320, 960, 2880)),
    "points, local ground": (lambda size: scan(SPEC, size, local_ground), (320, 2880)),
    "cells": (lambda size: scan(finer(size), 320), (1_200, 4_800, 19_200)),
    "cells, map": (lambda size: update(finer(size), 2), (600, 2_400, 9_600)),
    "scans": (lambda scans: update(SPEC, scans), (1, 10, 30)),
    "sensors": (moment_of_sensors, (1, 2, 4)),
}


if __name__ == "__main__":
    print(json.dumps({name: [[size, *counted(make(size))] for size in sizes] for name, (make, sizes) in PARTS.items()}))
