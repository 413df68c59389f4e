"""Slow twins: what the kernels of `core` say, once more in plain Python.

They follow the definitions (one ray after the other, one cell after the other, float64) and none of the
kernels' short cuts. Tests compare the two, and `benchmarks/speed.py` times one against the other.
"""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ogm.grid import GridSpec

__all__ = [
    "clear_from_rays",
    "height_band_mass",
    "ground_map",
    "line_cells",
    "lower_envelope",
    "ray_grid_mass",
]

Point = tuple[float, float, float]


def line_cells(start: tuple[int, int], end: tuple[int, int]) -> Iterator[tuple[int, int]]:
    """Yield the cells of Bresenham's line from `start` to `end`, both included.

    The shorter axis is rounded to the nearest cell, halves away from the start.
    """
    (i0, j0), (i1, j1) = start, end
    di, dj = i1 - i0, j1 - j0
    steps = max(abs(di), abs(dj))
    for n in range(steps + 1):
        if steps == 0:
            yield start
            continue
        a, b = (2 * n * abs(di) + steps) // (2 * steps), (2 * n * abs(dj) + steps) // (2 * steps)
        yield i0 + (a if di >= 0 else -a), j0 + (b if dj >= 0 else -b)


def height_band_mass(
    xyz: NDArray,
    origin: Point,
    z_low: float,
    z_high: float,
    min_range: float,
    spec: GridSpec,
    evidence: float,
) -> NDArray[np.float32]:
    """Return the masses of the paper's geometric ISM, one line per return (see `HeightBandISM`).

    Parameters
    ----------
    xyz : (N, 3) float array
        Points in the frame of the grid [m].
    origin : (x, y, z)
        The sensor, inside the grid [m].
    z_low, z_high : float
        Open interval of obstacle heights in that frame [m].
    min_range : float
        Nearer returns are ignored [m].
    spec : GridSpec
    evidence : float
        Dirichlet evidence of an observed cell.

    Returns
    -------
    (nx, ny, 2) float32
    """
    nx, ny = spec.shape
    occupied, free = np.zeros(spec.shape, bool), np.zeros(spec.shape, bool)
    band = [p for p in xyz.tolist() if z_low < p[2] < z_high and math.dist(p, origin) > min_range]

    def to_cell(x: float, y: float) -> tuple[int, int]:
        return (
            math.floor((x - spec.origin[0]) / spec.resolution),
            math.floor((y - spec.origin[1]) / spec.resolution),
        )

    start = to_cell(origin[0], origin[1])
    ends = []
    for x, y, _ in band:
        i, j = to_cell(x, y)
        if 0 <= i < nx and 0 <= j < ny:
            occupied[i, j] = True
            ends.append((i, j))
        else:
            ends.append(_leave(spec, origin, x, y))
    for end in ends:
        for cell in line_cells(start, end):
            if occupied[cell]:
                break
            free[cell] = True
    mass = np.zeros((nx, ny, 2), np.float32)
    mass[free, 0] = evidence / (evidence + 2)
    mass[occupied] = 0, evidence / (evidence + 2)
    return mass


def _leave(spec: GridSpec, origin: Point, x: float, y: float) -> tuple[int, int]:
    """Return the cell in which the ray to a point beyond the grid leaves it."""
    x0, x1, y0, y1 = spec.extent
    share = 1.0
    for start, end, low, high in ((origin[0], x, x0, x1), (origin[1], y, y0, y1)):
        if end < low:
            share = min(share, (start - low) / (start - end))
        elif end >= high:
            share = min(share, (high - start) / (end - start))
    i, j = spec.index(origin[0] + share * (x - origin[0]), origin[1] + share * (y - origin[1]))
    return min(max(int(i), 0), spec.shape[0] - 1), min(max(int(j), 0), spec.shape[1] - 1)


def lower_envelope(height: NDArray, rise: float) -> NDArray:
    """Return the lowest, over all cells, of a cell's height plus `rise` times its chamfer distance.

    Chamfer distance: sqrt(2) per diagonal step, 1 per straight step.
    """
    result = np.full(height.shape, np.inf)
    cells = [(i, j, height[i, j]) for i, j in np.ndindex(*height.shape) if np.isfinite(height[i, j])]
    for i, j in np.ndindex(*height.shape):
        for k, l, h in cells:  # noqa: E741
            a, b = sorted((abs(i - k), abs(j - l)))
            result[i, j] = min(result[i, j], h + rise * (b - a + math.sqrt(2) * a))
    return result


def ground_map(
    xyz: NDArray,
    ground_point: Point,
    spec: GridSpec,
    max_slope: float,
    max_descent: float,
    low_tolerance: float,
    band: float,
) -> NDArray:
    """Return the heights of `local_ground`, cell by cell and in its four steps.

    Parameters
    ----------
    xyz : (N, 3) float array
        Points [m].
    foot : (x, y, z)
        The ground under the sensor [m].
    spec : GridSpec
    max_slope, max_descent : float
        Rise over run: from cell to cell, and on average down from the foot.
    low_tolerance, band : float
        [m]

    Returns
    -------
    (nx, ny) float64
        Heights [m].
    """
    home = tuple(int(k) for k in spec.index(ground_point[0], ground_point[1]))
    cells: dict[tuple[int, ...], list[float]] = {}
    lowest = np.full(spec.shape, np.inf)
    for x, y, z in xyz.tolist():
        if spec.contains(x, y):
            cell = tuple(int(k) for k in spec.index(x, y))
            cells.setdefault(cell, []).append(z)
            if ground_point[2] - low_tolerance - z <= max_descent * math.dist((x, y), ground_point[:2]):
                lowest[cell] = min(lowest[cell], z)

    # Strays: from ring to ring of cells, away from the foot
    ring_of = lambda cell: max(abs(cell[0] - home[0]), abs(cell[1] - home[1]))  # noqa: E731
    ground, steps = {home: ground_point[2]}, {home: 0}
    for cell in sorted(np.ndindex(*spec.shape), key=ring_of):
        if cell == home:
            continue
        inner = [c for c in ground if ring_of(c) == ring_of(cell) - 1 and math.dist(c, cell) < 1.5]
        weights = [1 / (1 + steps[c]) for c in inner]
        expected = sum(w * ground[c] for w, c in zip(weights, inner, strict=True)) / sum(weights)
        since = min(steps[c] for c in inner) + 1
        above, allowed = lowest[cell] - expected, low_tolerance + max_descent * spec.resolution * since
        ground[cell], steps[cell] = (lowest[cell], 0) if abs(above) <= allowed else (expected, since)
        if above < -allowed:
            lowest[cell] = np.inf

    # What touches the envelope is ground, at the mean of its lowest layer, or of a thin dense one above that
    lowest[home] = min(lowest[home], ground_point[2])
    envelope = lower_envelope(lowest, max_slope * spec.resolution)
    height, weight = np.zeros(spec.shape), np.zeros(spec.shape)
    for cell, low in np.ndenumerate(lowest):
        if low > envelope[cell] + 1e-6 or not np.isfinite(low):
            continue
        above = np.array(cells.get(cell, [])) - low
        layers = [above[(above >= k * band) & (above < (k + 1) * band)] for k in range(3)]
        dense = len(layers[1]) >= 10 * len(layers[0]) and len(layers[1]) >= 10 * len(layers[2])
        layer = layers[1] if dense else layers[0]
        if len(layer):
            height[cell], weight[cell] = low + layer.mean(), min(len(layer), 8)
        elif cell == home:
            height[cell], weight[cell] = ground_point[2], 1
    return _pull_push(height, weight, ground_point[2])


def _pull_push(height: NDArray, weight: NDArray, otherwise: float) -> NDArray:
    """Fill cells of weight 0 from means over blocks of 2 x 2, 4 x 4, ... cells, interpolated (recursive)."""
    if max(height.shape) <= 2:
        mean = (weight * height).sum() / weight.sum() if weight.sum() else otherwise
        return np.where(weight > 0, height, mean)
    half = tuple(max((n + 1) // 2, 2) for n in height.shape)
    pad = [(0, 2 * h - n) for h, n in zip(half, height.shape, strict=True)]
    blocks = (half[0], 2, half[1], 2)
    total = np.pad(weight, pad).reshape(blocks).sum((1, 3))
    known = np.pad(weight * height, pad).reshape(blocks).sum((1, 3)) / np.maximum(total, 1e-9)
    coarse = _pull_push(known, np.minimum(total, 8), otherwise)
    result = height.copy()
    for i, j in np.argwhere(weight == 0):
        u, v = (min(max((k + 0.5) / 2 - 0.5, 0), n - 1) for k, n in zip((i, j), half, strict=True))
        a, b = min(int(u), half[0] - 2), min(int(v), half[1] - 2)
        p, q = u - a, v - b
        corners = coarse[a : a + 2, b : b + 2]
        result[i, j] = np.array([1 - p, p]) @ corners @ np.array([1 - q, q])
    return result


def clear_from_rays(
    slopes: NDArray, level: float, reach: float, per_cell: float, p_miss: float, weights: NDArray
) -> float:
    """Return the belief in free of one polar bin from the rays that pass it, one by one.

    Parameters
    ----------
    slopes : (R,) float array
        Rise over run of each ray.
    level : float
        Say of a level ray, 1 - (sensor's height above the ground there) / clearance.
    reach : float
        Distance of the bin's middle over clearance.
    per_cell : float
        How much of the sector a cell covers there.
    p_pass : float
        Chance that a ray passes what it reaches.
    weights : (R,) float array
        1, or less for beams that came back empty.
    """
    if len(slopes) == 0:
        return 0.0
    says = np.maximum(level - slopes * reach, 0)  # above clearance a ray says nothing
    first = min(says.max(), 1.0)
    if first == 0:
        return 0.0
    count = min(max(float((says * weights).sum()) / first, 0.0), float(weights[says > 0].sum()))
    return first * (1 - p_miss ** (count * per_cell))


def ray_grid_mass(
    xyz: NDArray,
    origin: Point,
    ground: float,
    spec: GridSpec,
    ego_footprint: tuple[float, float, float, float],
    sectors: int,
    missing: NDArray,
    obstacle_height: float,
    clearance: float,
    below_ground: float,
    range_noise: float,
    p_miss: float,
    p_false_alarm: float,
    free_reliability_at_hits: float,
    max_mass: float,
    max_range: float,
    no_return_weight: float,
) -> NDArray[np.float32]:
    """Return the masses of `RayISM` over flat ground at height `ground`, by a loop over cells and rays.

    Parameters as in `RayISM`; `xyz` (N, 3) and unit vectors `missing` (M, 3) in the frame of the grid,
    returns from the own vehicle already removed.
    """
    step = spec.resolution
    height, level = origin[2] - ground, 1 - (origin[2] - ground) / clearance
    x0, x1, y0, y1 = spec.extent
    far = math.hypot(max(x1 - origin[0], origin[0] - x0), max(y1 - origin[1], origin[1] - y0))
    bins = math.ceil(far / step) + 1
    hits = np.zeros(spec.shape)
    rays: list[list[tuple[float, float, float]]] = [[] for _ in range(sectors)]  # slope, end bin, weight

    def add(x: float, y: float, slope: float, end: float, weight: float) -> None:
        sector = int((math.atan2(y, x) % (2 * math.pi)) * sectors / (2 * math.pi))
        rays[min(sector, sectors - 1)].append((slope, int(min(end, bins)), weight))

    for x, y, z in xyz.tolist():
        dx, dy, above = x - origin[0], y - origin[1], z - ground
        r = math.hypot(dx, dy)
        if above < -below_ground or r < step:
            continue
        end = r / step
        if above <= obstacle_height:
            end += 1
        elif above < clearance:
            end = (r - 2 * range_noise) / step
            for side in (-range_noise, range_noise):
                u, v = x + dx / r * side, y + dy / r * side
                if spec.contains(u, v):
                    hits[spec.index(u, v)] += 1
        add(dx, dy, (z - origin[2]) / r, end, 1.0)
    for dx, dy, dz in missing.tolist():
        across = math.hypot(dx, dy)
        end = int(min(max_range * across / step, bins))
        ground_hit = next((k for k in range(end) if height + dz / across * (k + 0.5) * step < 0), end)
        add(dx, dy, dz / across, ground_hit, no_return_weight)

    table = [np.array(sector).reshape(-1, 3) for sector in rays]
    free = np.zeros((sectors, bins))
    for s in range(sectors):
        for k in range(bins):
            through = table[s][table[s][:, 1] > k]
            per_cell = sectors / (2 * math.pi) / (k + 0.5)
            free[s, k] = clear_from_rays(
                through[:, 0], level, (k + 0.5) * step / clearance, per_cell, p_miss, through[:, 2]
            )

    mass = np.zeros((*spec.shape, 2), np.float32)
    for i, j in np.ndindex(*spec.shape):
        x, y = spec.origin[0] + (i + 0.5) * step, spec.origin[1] + (j + 0.5) * step
        if ego_footprint[0] < x < ego_footprint[1] and ego_footprint[2] < y < ego_footprint[3]:
            continue
        dx, dy = x - origin[0], y - origin[1]
        r = math.hypot(dx, dy)
        width = min(step / max(r, step / 8) / (2 * math.pi), 1) * sectors
        span = max(round(width), 1)
        begin = round(math.atan2(dy, dx) * sectors / (2 * math.pi) - span / 2)
        cleared = np.mean([free[(begin + n) % sectors, min(int(r / step), bins - 1)] for n in range(span)])
        if hits[i, j]:
            doubt = p_false_alarm ** (hits[i, j] / 2)
            cleared *= free_reliability_at_hits
            mass[i, j] = min(cleared * doubt, max_mass), min((1 - doubt) * (1 - cleared), max_mass)
        else:
            mass[i, j, 0] = min(cleared, max_mass)
    return mass
