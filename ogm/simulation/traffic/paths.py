"""Places on routes and walkways, compiled."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.jit import kernel
from ogm.simulation.arrays import Floats


class Lines(NamedTuple):
    """Polygonal lines, one after the other: points (P, 3), way along each line (P,), first point of each (L + 1,)."""

    points: Floats
    along: Floats
    first: NDArray[np.int64]

    @property
    def length(self) -> Floats:
        """Length of each line [m]."""
        return self.along[self.first[1:] - 1]


def lines(parts: Sequence[Floats]) -> Lines:
    """Put lines (M, 3) together; points that repeat the one before are left out."""
    kept = []
    for part in parts:
        points = np.asarray(part, np.float64)
        step = np.linalg.norm(np.diff(points, axis=0), axis=1)
        kept.append(points[np.concatenate([[True], step > 1e-9])])
    along = [np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))]) for p in kept]
    first = np.concatenate([[0], np.cumsum([len(p) for p in kept])]).astype(np.int64)
    return Lines(np.concatenate([np.zeros((0, 3)), *kept]), np.concatenate([np.zeros(0), *along]), first)


@kernel
def _add(table: Lines, first: int, last: int, s: float, weight: float, out: Floats) -> None:
    """Add the point at way `s` on a line, times a weight, to `out`."""
    points, along = table.points, table.along
    low, high = first, last - 1
    while high - low > 1:
        middle = (low + high) // 2
        if along[middle] <= s:
            low = middle
        else:
            high = middle
    share = (s - along[low]) / (along[low + 1] - along[low])
    for k in range(3):
        out[k] += weight * ((1 - share) * points[low, k] + share * points[low + 1, k])


@kernel
def along_routes(
    table: Lines,
    route: NDArray[np.int64],
    start: Floats,
    driver: NDArray[np.int64],
    way: Floats,
    reach: Floats,
    out: Floats,
) -> None:
    """Write the places (U, 3) at `way` on the routes of drivers, corners rounded off over `reach` [m]."""
    first = table.first
    for u in range(len(way)):
        n = driver[u]
        out[u] = 0.0
        for k in range(3):
            s = way[u] + (k - 1) * reach[u]
            place = max(np.searchsorted(start[n], s, side="right") - 1, 0)
            lane = route[n, place]
            weight = 0.5 if k == 1 else 0.25
            _add(table, first[lane], first[lane + 1], s - start[n, place], weight, out[u])


@kernel
def along_lines(table: Lines, line: NDArray[np.int64], way: Floats, out: Floats) -> None:
    """Write the places (N, 3) at `way` on lines, whose ends are not passed."""
    for n in range(len(way)):
        low, high = table.first[line[n]], table.first[line[n] + 1]
        out[n] = 0.0
        _add(table, low, high, min(max(way[n], 0.0), table.along[high - 1]), 1.0, out[n])
