"""Slow references of world maps, cell by cell in float64, which share no code with the kernels."""

import math
from dataclasses import dataclass, field

import numpy as np

from ogm.grid import EvidentialGrid

Cell = tuple[int, int]


def combine(rule: str, a: tuple[float, float], b: tuple[float, float], min_unknown: float) -> tuple[float, float]:
    """Combine two pairs of masses by a rule, from its definition, and bound the result."""
    f, o, g, p = *a, *b
    u, v = 1 - f - o, 1 - g - p
    if rule == "dempster":
        conflict = f * p + o * g
        free, occupied = (f * g + f * v + u * g) / (1 - conflict), (o * p + o * v + u * p) / (1 - conflict)
    elif rule == "cumulative":  # evidence adds up
        r, s, q, t = 2 * f / u, 2 * o / u, 2 * g / v, 2 * p / v
        total = r + q + s + t + 2
        free, occupied = (r + q) / total, (s + t) / total
    else:  # the greater evidence for each state, normalised
        u, v = max(u, 1e-6), max(v, 1e-6)
        r, s = max(f / u, g / v), max(o / u, p / v)
        free, occupied = r / (1 + r + s), s / (1 + r + s)
    scale = min(1.0, (1 - min_unknown) / max(free + occupied, 1e-12))
    return free * scale, occupied * scale


@dataclass
class SlowMap:
    """A world map as a dictionary of cells."""

    resolution: float
    rule: str
    min_unknown: float = 0.02
    mass: dict[Cell, tuple[float, float]] = field(default_factory=dict)
    conflict: dict[Cell, tuple[float, float]] = field(default_factory=dict)
    count: dict[Cell, int] = field(default_factory=dict)
    seen: dict[Cell, float] = field(default_factory=dict)

    def integrate(self, grid: EvidentialGrid, T: np.ndarray, stamp: float) -> None:
        """Take into each cell the masses at its centre."""
        inverse = np.linalg.inv(T[:2, :2])
        x0, x1, y0, y1 = grid.spec.extent
        reach = math.hypot(max(-x0, x1), max(-y0, y1)) / self.resolution + 2
        middle = T[:2, 3] / self.resolution
        for i in range(math.floor(middle[0] - reach), math.ceil(middle[0] + reach)):
            for j in range(math.floor(middle[1] - reach), math.ceil(middle[1] + reach)):
                at = np.array([(i + 0.5) * self.resolution, (j + 0.5) * self.resolution])
                x, y = inverse @ (at - T[:2, 3])
                if not grid.spec.contains(x, y):
                    continue
                ix, iy = grid.spec.index(x, y)
                self.add((i, j), (float(grid.mass[ix, iy, 0]), float(grid.mass[ix, iy, 1])), stamp)

    def add(self, cell: Cell, b: tuple[float, float], stamp: float) -> None:
        """Combine masses with a cell."""
        if sum(b) == 0:
            return
        a = self.mass.get(cell, (0.0, 0.0))
        c = self.conflict.get(cell, (0.0, 0.0))
        self.conflict[cell] = max(c[0], a[0] * b[1]), max(c[1], a[1] * b[0])
        self.mass[cell] = combine(self.rule, a, b, self.min_unknown)
        self.count[cell] = self.count.get(cell, 0) + 1
        self.seen[cell] = max(self.seen.get(cell, -1.0), math.floor(stamp))
