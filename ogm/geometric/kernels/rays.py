"""Rays of returns and of beams without echo, sorted by sector and slope."""

import math

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import Cells, Points, PolarGrid, RayNumbers, Rays, Surface, WorkSpace
from ogm.geometric.kernels.evidence import raise_unshown
from ogm.geometric.kernels.polar import azimuth, polar_coordinates
from ogm.geometric.kernels.surface import corner_heights, sample_corners
from ogm.jit import kernel

__all__ = ["aim_rays", "place_rays", "sort_sectors"]

CLASSES = 256  # classes of slopes in the first pass of the sort of a sector
LEVEL = np.float32(0.2)  # slope below which the classes are fine
MIN_SPREAD = 0.1  # [m] smallest limit of growing noise for returns that mark


@kernel
def aim_rays(
    points: Points,
    directions: NDArray[np.float32],
    origin: NDArray[np.float32],
    polar: PolarGrid,
    max_range: float,
    part: tuple[int, int, int],
    work: WorkSpace,
) -> None:
    """Fill in sector, slope and run of a part of the rays, and count its rays in each sector.

    Parameters
    ----------
    points : Points
        N returns.
    directions : (M, 3) float32
        Unit vectors of beams without echo, in the frame of the grid, which belong to the last part. Vectors of another
        length have no effect.
    origin : (3,) float32
        The sensor [m].
    polar : PolarGrid
    max_range : float
        Run of a beam without echo [m].
    part : (first, last, k)
        Part k: returns from `first` to ``last - 1``.
    work : WorkSpace
        For N + M rays; `counts[k]` is filled, too.
    """
    first, last, k = part
    polar_coordinates(points, origin, polar.sectors, first, last, work)
    if k == work.counts.shape[0] - 1:
        _aim_beams(directions, last, polar.sectors, max_range, work)
        last += directions.shape[0]
    for s in range(polar.sectors):
        work.counts[k, s] = 0
    counts = work.counts[k]
    for n in range(first & 0x7FFFFFFF, last & 0x7FFFFFFF):
        counts[work.sector[n] & 0x7FFF] += 1


@kernel
def _aim_beams(directions: NDArray[np.float32], count: int, sectors: int, max_range: float, work: WorkSpace) -> None:
    """Append the beams without echo after `count` returns."""
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
def place_rays(
    points: Points,
    origin: NDArray[np.float32],
    ground: Surface,
    cells: Cells,
    numbers: RayNumbers,
    shown: NDArray[np.uint8],
    part: tuple[int, int, int],
    work: WorkSpace,
) -> None:
    """Fill in the heights above the ground of a part of the returns, mark cells, and group the part's rays by sector.

    Returns of obstacles mark, unless the growing part of the noise exceeds both a cell and `MIN_SPREAD`.

    Parameters
    ----------
    points : Points
    origin : (3,) float32
        The sensor [m].
    ground : Surface
    cells : Cells
    numbers : RayNumbers
    shown : (N,) or (0,) uint8
        Returns that show the ground, from `ground_evidence`.
    part : (first, last, k)
        See `aim_rays`.
    work : WorkSpace
        Filled by `aim_rays` for all parts. The call fills `above`, `hits[k]` and the entries of the part in `records`.
    """
    first, last, k = part
    ends, total, parts = np.empty(work.counts.shape[1], np.int32), 0, work.counts.shape[0]
    for s in range(ends.shape[0]):
        for j in range(parts):
            ends[s] = total if j == k else ends[s]
            total += work.counts[j, s]
    (x, y, z), corners, marked = points, corner_heights(ground), first
    low, high, near = np.float32(numbers.obstacle_height), np.float32(numbers.clearance), np.float32(cells.resolution)
    growth, spread = np.float32(numbers.noise_growth), np.float32(max(cells.resolution, MIN_SPREAD))
    for n in range(first & 0x7FFFFFFF, last & 0x7FFFFFFF):
        run, above = work.run[n], z[n] - sample_corners(corners, ground, x[n], y[n])
        if shown.shape[0] > 0 and not shown[n]:
            above = raise_unshown(above, numbers)
        work.above[n] = above
        _place_ray(n, above, ends, work)
        # No branches, because obstacles and ground may alternate
        work.point[marked & 0x7FFFFFFF] = n
        marked += int((above > low) & (above < high) & (run >= near) & (growth * run * run <= spread))
    for n in range(last & 0x7FFFFFFF, (work.sector.shape[0] if k == parts - 1 else last) & 0x7FFFFFFF):
        _place_ray(n, np.float32(0.0), ends, work)
    _mark_obstacles(points, origin, cells, numbers, work.point[first:marked], work.run, work.hits[k])


@kernel
def _place_ray(n: int, above: np.float32, ends: NDArray[np.int32], work: WorkSpace) -> None:
    """Append a ray to the records of its sector."""
    s = work.sector[n] & 0x7FFF
    to = (ends[s] & 0x7FFFFFF) << 2
    ends[s] += 1
    work.records[to], work.records[to + 1], work.records[to + 2] = work.slope[n], work.run[n], above
    work.indices[to + 3] = n


@kernel
def _mark_obstacles(
    points: Points,
    origin: NDArray[np.float32],
    cells: Cells,
    numbers: RayNumbers,
    marked: NDArray[np.int32],
    runs: NDArray[np.float32],
    hits: NDArray[np.int32],
) -> None:
    """Add the hits of the obstacle returns with the indices `marked` to their cells.

    A return adds half a hit at each of two points, a standard deviation before and behind it (two-point Gauss-Hermite
    rule).
    """
    hits[:] = 0
    noise, growth = np.float32(numbers.range_noise), np.float32(numbers.noise_growth)
    for m in range(marked.shape[0]):
        n = marked[m] & 0x7FFFFFFF
        x, y, run = points.x[n], points.y[n], runs[n]
        share = (noise + growth * run * run) / run
        du, dv = (x - origin[0]) * share, (y - origin[1]) * share
        hit_cell(hits, cells, x - du, y - dv)
        hit_cell(hits, cells, x + du, y + dv)


@kernel
def hit_cell(hits: NDArray[np.int32], cells: Cells, x: np.float32, y: np.float32) -> None:
    """Add half a hit to the cell at (x, y), if the point lies in the grid."""
    inverse = np.float32(1.0 / cells.resolution)
    u, v = (x - np.float32(cells.x0)) * inverse, (y - np.float32(cells.y0)) * inverse
    if u >= 0 and u < hits.shape[0] and v >= 0 and v < hits.shape[1]:
        hits[int(u) & 0x7FFFFFFF, int(v) & 0x7FFFFFFF] += 1


@kernel
def sort_sectors(rays: Rays, first: int, last: int, count: int, work: WorkSpace) -> None:
    """Sort the rays of sectors by slope, and rays of equal slope by run.

    Rays of a sector do not cross. Their order by slope is therefore their order by height in every bin. The order of
    the points has no effect, unless slope and run are equal.

    Parameters
    ----------
    rays : Rays
        Needs `starts`; the entries of the sectors are filled.
    first, last : int
        Sectors from `first` to ``last - 1``.
    count : int
        Number of returns.
    work : WorkSpace
        Filled by `place_rays` for all parts.
    """
    largest = 0
    for s in range(first, last):
        largest = max(largest, rays.starts[s + 1] - rays.starts[s])
    classes, ends = np.empty(largest, np.int32), np.empty(CLASSES + 1, np.int32)
    for s in range(first, last):
        begin, end = rays.starts[s] & 0x7FFFFFFF, rays.starts[s + 1] & 0x7FFFFFFF
        _sort_by_class(work, begin, end, count, classes, ends, rays)
        _finish_sort(rays, begin, end)


@kernel
def _sort_by_class(
    work: WorkSpace, begin: int, end: int, count: int, classes: NDArray[np.int32], ends: NDArray[np.int32], rays: Rays
) -> None:
    """Fill in the rays of a sector, sorted by class of slope (counting sort)."""
    begin, half, one = begin & 0x7FFFFFFF, np.float32(CLASSES // 2), np.float32(1.0)
    for n in range(end - begin):
        slope = work.records[(begin + n) << 2]
        classes[n] = np.int32((slope / (abs(slope) + LEVEL) + one) * half)
    for c in range(CLASSES + 1):
        ends[c] = 0
    for n in range(end - begin):
        ends[(classes[n] & (CLASSES - 1)) + 1] += 1
    place = begin
    for c in range(CLASSES):
        place += ends[c]
        ends[c] = place
    for n in range(end - begin):
        c, record = classes[n] & (CLASSES - 1), (begin + n) << 2
        to = ends[c] & 0x7FFFFFFF
        ends[c] += 1
        rays.slope[to], rays.run[to] = work.records[record], work.records[record + 1]
        rays.above[to], point = work.records[record + 2], work.indices[record + 3]
        rays.point[to] = point if point < count else -1


@kernel
def _finish_sort(rays: Rays, begin: int, end: int) -> None:
    """Sort the nearly sorted rays of a sector by slope, then by run (insertion sort)."""
    begin, (slopes, runs, heights, points, _) = begin & 0x7FFFFFFF, rays
    for n in range(begin + 1, end):
        slope, run = slopes[n], runs[n]
        if slope > slopes[n - 1] or (slope == slopes[n - 1] and run >= runs[n - 1]):
            continue
        above, point, to = heights[n], points[n], n
        while to > begin and (slopes[to - 1] > slope or (slopes[to - 1] == slope and runs[to - 1] > run)):
            slopes[to], runs[to], heights[to], points[to] = (
                slopes[to - 1],
                runs[to - 1],
                heights[to - 1],
                points[to - 1],
            )
            to -= 1
        slopes[to], runs[to], heights[to], points[to] = slope, run, above, point
