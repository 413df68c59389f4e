"""A planner's loop at 10 Hz: map each scan, then choose the straightest arc that the vehicle can drive.

python examples/planner_loop.py
"""

import time
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from yard import MOUNT, frames

from ogm import Frame, GridSpec
from ogm.fusion import EvidentialMapper, fuse, rolling_window
from ogm.geometric import RayISM
from ogm.planning import collision

FOOTPRINT = (-1.0, 3.5, -0.9, 0.9)  # [m]
START, LENGTH, STEP = 5.2, 10.0, 0.4  # [m] first and last pose of an arc, and between them: the lidar sees none before
CURVATURES = np.array([0.0, 0.05, -0.05, 0.1, -0.1, 0.15, -0.15])  # [1/m], the straightest first


class Choice(NamedTuple):
    """Choice after a scan: curvature [1/m], free length of the arc [m], and the time that it took [s]."""

    curvature: float
    free: float
    seconds: float


def arcs() -> np.ndarray:
    """Return poses x, y, yaw along each arc, (A, P, 3), from the vehicle on."""
    s, k = np.arange(START, LENGTH, STEP), CURVATURES[:, None] + 1e-9
    return np.stack([np.sin(k * s) / k, (1 - np.cos(k * s)) / k, k * s], axis=-1)


def loop(drive: Iterable[Frame]) -> Iterator[Choice]:
    """Yield the choice after each scan."""
    ism = RayISM(GridSpec.centered(40.0, 40.0, 0.2), MOUNT)
    mapper, paths = EvidentialMapper(rolling_window(ism.spec)), arcs()
    start = time.perf_counter()
    for _ in fuse(drive, ism, mapper):
        view = mapper.view()  # in the vehicle's axes
        doubtful = collision(view, FOOTPRINT, paths.reshape(-1, 3)).plausibility.reshape(paths.shape[:2]) > 0.5
        free = np.where(doubtful.any(axis=1), doubtful.argmax(axis=1), doubtful.shape[1])
        best = int(free.argmax())  # of arcs that are free as far, the straightest
        yield Choice(float(CURVATURES[best]), float(START + STEP * free[best]), time.perf_counter() - start)
        start = time.perf_counter()


if __name__ == "__main__":
    choices = list(loop(frames()))
    print(*choices[:3], sep="\n")
    print(f"worst time after the first scan: {1e3 * max(one.seconds for one in choices[1:]):.0f} ms")
