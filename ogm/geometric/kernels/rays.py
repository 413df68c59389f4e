"""From returns and beams without echo to rays, sorted by sector and slope."""

import math

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import Points, PolarGrid, RayNumbers, Rays, Surface, WorkSpace
from ogm.geometric.kernels.evidence import raise_unshown
from ogm.geometric.kernels.polar import azimuth, polar_coordinates
from ogm.geometric.kernels.surface import sample
from ogm.jit import kernel, vector

__all__ = ["sort_rays"]

CLASSES = 1024  # of slopes, in the first pass of the sort
LEVEL = np.float32(0.2)  # slope below which the classes are fine


@kernel
def sort_rays(
    points: Points,
    directions: NDArray[np.float32],
    origin: NDArray[np.float32],
    ground: Surface,
    polar: PolarGrid,
    numbers: RayNumbers,
    shown: NDArray[np.uint8],
    work: WorkSpace,
) -> Rays:
    """Turn every return and every beam without echo into a ray, sorted by sector and in a sector by slope.

    Rays of one sector do not cross, so that their order by slope is their order by height in every bin. The order
    of the points has no effect: rays of equal slope are sorted by run.

    Parameters
    ----------
    points : Points
        N returns.
    directions : (M, 3) float32
        Unit vectors of beams without echo, in the frame of the grid; those that are no directions have no effect.
    origin : (3,) float32
        The sensor [m].
    ground : Surface
    polar : PolarGrid
    numbers : RayNumbers
    shown : (N,) or (0,) uint8
        Returns that show the ground, from `ground_evidence`.
    work : WorkSpace
        For N + M rays.

    Returns
    -------
    Rays
        The run of a beam without echo is that of `max_range`.
    """
    polar_coordinates(points, origin, polar.sectors, work)
    _heights(points, ground, work.above)
    raise_unshown(work.above, shown, numbers)
    _aim(directions, points.x.shape[0], polar.sectors, numbers.max_range, work)
    _sort_by_slope_class(work.slope, work.order)
    starts = _sort_by_sector(points.x.shape[0], polar.sectors, work)
    _finish_sort(work.table, work.point, starts)
    return Rays(work.table, work.point, starts)


@vector
def _heights(points: Points, ground: Surface, above: NDArray[np.float32]) -> None:
    """Fill in the height of each point above the ground."""
    x, y, z = points
    for n in range(x.shape[0]):
        above[n] = z[n] - sample(ground, x[n], y[n])


@kernel
def _aim(directions: NDArray[np.float32], count: int, sectors: int, max_range: float, work: WorkSpace) -> None:
    """Append beams without echo behind `count` returns."""
    to_sector = np.float32(sectors / (2 * math.pi))
    for m in range(directions.shape[0]):
        dx, dy, dz = directions[m, 0], directions[m, 1], directions[m, 2]
        across = math.sqrt(dx * dx + dy * dy)
        n = count + m
        work.sector[n], work.slope[n], work.run[n], work.above[n] = 0, 0, 0, 0
        if across > 1e-3 and across < 2 and abs(dz) < 2:
            work.sector[n] = min(int(azimuth(dx, dy) * to_sector), sectors - 1)
            work.slope[n], work.run[n] = dz / across, max_range * across


@kernel
def _sort_by_slope_class(slope: NDArray[np.float32], order: NDArray[np.int32]) -> None:
    """Fill in an order of the rays by classes of slope (a counting sort)."""
    starts = np.zeros(CLASSES + 1, np.int32)
    half, one = np.float32(CLASSES // 2), np.float32(1.0)
    for n in range(slope.shape[0]):
        starts[(int((slope[n] / (abs(slope[n]) + LEVEL) + one) * half) & (CLASSES - 1)) + 1] += 1
    for c in range(CLASSES):
        starts[c + 1] += starts[c]
    for n in range(slope.shape[0]):
        c = int((slope[n] / (abs(slope[n]) + LEVEL) + one) * half) & (CLASSES - 1)
        order[starts[c] & 0x7FFFFFFF] = n
        starts[c] += 1


@kernel
def _sort_by_sector(count: int, sectors: int, work: WorkSpace) -> NDArray[np.int32]:
    """Fill table and index, sorted by sector and in each as `order` is; return where each sector begins."""
    starts = np.zeros(sectors + 2, np.int32)
    for n in range(work.sector.shape[0]):
        starts[(work.sector[n] & 0x7FFF) + 2] += 1
    for s in range(sectors + 1):
        starts[s + 1] += starts[s]
    for place in range(work.order.shape[0]):
        n = work.order[place] & 0x7FFFFFFF
        s = (work.sector[n] & 0x7FFF) + 1
        to = starts[s] & 0x7FFFFFFF
        starts[s] += 1
        work.table[to, 0], work.table[to, 1], work.table[to, 2] = work.slope[n], work.run[n], work.above[n]
        work.point[to] = n if n < count else -1
    return starts[: sectors + 1]


@kernel
def _finish_sort(table: NDArray[np.float32], index: NDArray[np.int32], starts: NDArray[np.int32]) -> None:
    """Sort the rays of each sector, which are nearly sorted, by slope and then by run (insertion sort)."""
    for s in range(starts.shape[0] - 1):
        for n in range(starts[s] + 1, starts[s + 1]):
            slope, run, above, which = table[n, 0], table[n, 1], table[n, 2], index[n]
            to = n
            while to > starts[s] and (
                table[to - 1, 0] > slope or (table[to - 1, 0] == slope and table[to - 1, 1] > run)
            ):
                table[to, 0], table[to, 1], table[to, 2] = table[to - 1, 0], table[to - 1, 1], table[to - 1, 2]
                index[to] = index[to - 1]
                to -= 1
            table[to, 0], table[to, 1], table[to, 2], index[to] = slope, run, above, which
