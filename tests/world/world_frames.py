"""Drives without a simulator, for tests of building: frames whose scan is a number, a model that makes grids of it."""

import os
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ogm.grid import EvidentialGrid, GridSpec
from ogm.pose import pose
from ogm.scan import Boxes, LazyFrame, Mount, Scan

SPEC = GridSpec.centered(24.0, 16.0, 0.5)


@dataclass(frozen=True)
class StraightDrive(Sequence):
    """A drive of some frames, 2 m apart."""

    count: int = 30
    start: tuple[float, float, float] = (0.0, 0.0, 0.2)  # x, y [m], yaw [rad]
    seed: int = 0
    damaged: tuple[int, ...] = ()
    lost: tuple[int, ...] = ()  # frames without a pose
    first: int = 0

    def pose(self, n: int) -> np.ndarray:
        x, y, yaw = self.start
        return pose(x, y, yaw=yaw) @ pose(2.0 * n, 0.5 * np.sin(n), yaw=0.05 * np.sin(0.3 * n))

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, n: Any) -> Any:
        if isinstance(n, slice):
            start, stop, _ = n.indices(self.count)
            return StraightDrive(stop - start, self.start, self.seed, self.damaged, self.lost, self.first + start)
        if n >= self.count:
            raise IndexError(n)
        k = self.first + n

        def read() -> Scan:
            if k in self.damaged:
                raise ValueError("the scan is damaged")
            return Scan(np.full((1, 4), self.seed * 1000 + k, np.float32))

        T = None if k in self.lost else self.pose(k)
        parts: Any = (read, lambda: Mount(1.9), Boxes.empty, lambda: None)
        return LazyFrame(*parts, T_map_sensor=T, stamp=100.0 * self.seed + 0.5 * k, name=f"frame {k}")


@dataclass(frozen=True)
class RandomGrids:
    """A model that returns a random grid for each scan; it ends its process once, if that is wanted."""

    dies_at: int = -1
    marker: str = ""
    spec: GridSpec = SPEC

    def __call__(self, scan: Scan) -> EvidentialGrid:
        number = int(scan.points[0, 0])
        if number == self.dies_at and not Path(self.marker).exists():
            Path(self.marker).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return grid_of(number)


@lru_cache
def grid_of(number: int) -> EvidentialGrid:
    """Return the grid of a scan."""
    rng = np.random.default_rng(number)
    mass = rng.dirichlet((1, 1, 1), SPEC.shape)[..., :2].astype(np.float32) * np.float32(0.25)
    mass[rng.random(SPEC.shape) < 0.4] = 0
    return EvidentialGrid(SPEC, mass)
