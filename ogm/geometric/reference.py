"""Slow references: what the kernels compute, in plain Python.

They follow the definitions (one ray after the other, one cell after the other, float64) and take none of the
kernels' short cuts. Tests compare the two, and `benchmarks/speed.py` times one against the other.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.height_band import HeightBandISM
from ogm.geometric.kernels import profile
from ogm.geometric.kernels.arguments import RayNumbers
from ogm.geometric.ray import RayISM
from ogm.grid import GridSpec

__all__ = ["Beam", "classify", "ground_map", "height_band_mass", "line_cells", "lower_envelope", "ray_grid_mass"]

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


def height_band_mass(xyz: NDArray, ism: HeightBandISM) -> NDArray[np.float32]:
    """Return the masses of `HeightBandISM`, without supersampling, by one line per return.

    Parameters
    ----------
    xyz : (N, 3) float array
        Points in the frame of the grid [m].
    ism : HeightBandISM

    Returns
    -------
    (nx, ny, 2) float32
    """
    spec, (x0, y0, ground) = ism.spec, ism.mount.ground_point
    origin = (x0, y0, float(ism.mount.origin[2]))
    low, high = ground + ism.z_min, ground + ism.z_max
    occupied, free = np.zeros(spec.shape, bool), np.zeros(spec.shape, bool)
    ends = []
    for x, y, z in xyz.tolist():
        if not low < z < high or math.dist((x, y, z), origin) <= ism.min_range:
            continue
        if spec.contains(x, y):
            ends.append(_cell(spec, x, y))
            occupied[ends[-1]] = True
        else:
            ends.append(_leave(spec, origin, x, y))
    for end in ends:
        for cell in line_cells(_cell(spec, x0, y0), end):
            if occupied[cell]:
                break
            free[cell] = True
    mass = np.zeros((*spec.shape, 2), np.float32)
    mass[free, 0] = mass[occupied, 1] = ism.evidence / (ism.evidence + 2)
    return mass


def _cell(spec: GridSpec, x: float, y: float) -> tuple[int, int]:
    i, j = spec.index(x, y)
    return int(i), int(j)


def _leave(spec: GridSpec, origin: Point, x: float, y: float) -> tuple[int, int]:
    """Return the cell in which the ray to a point beyond the grid leaves it."""
    x0, x1, y0, y1 = spec.extent
    share = 1.0
    for start, end, low, high in ((origin[0], x, x0, x1), (origin[1], y, y0, y1)):
        if end < low:
            share = min(share, (start - low) / (start - end))
        elif end >= high:
            share = min(share, (high - start) / (end - start))
    i, j = _cell(spec, origin[0] + share * (x - origin[0]), origin[1] + share * (y - origin[1]))
    return min(max(i, 0), spec.shape[0] - 1), min(max(j, 0), spec.shape[1] - 1)


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
    ground_point : (x, y, z)
        The ground under the sensor [m].
    spec : GridSpec
    max_slope, max_descent : float
        Rise over run: from cell to cell, and on average down from the ground point.
    low_tolerance, band : float
        [m]

    Returns
    -------
    (nx, ny) float64
        Heights [m].
    """
    home = _cell(spec, ground_point[0], ground_point[1])
    cells: dict[tuple[int, int], list[float]] = {}
    lowest = np.full(spec.shape, np.inf)
    for x, y, z in xyz.tolist():
        if spec.contains(x, y):
            cell = _cell(spec, x, y)
            cells.setdefault(cell, []).append(z)
            if ground_point[2] - low_tolerance - z <= max_descent * math.dist((x, y), ground_point[:2]):
                lowest[cell] = min(lowest[cell], z)

    # Strays: from ring to ring of cells, away from the ground point
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
    limit = lower_envelope(np.where(weight > 0, height, np.inf), max_slope * spec.resolution)
    return np.where(weight > 0, height, np.minimum(_pull_push(height, weight, ground_point[2]), limit))


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


def ray_grid_mass(xyz: NDArray, no_returns: NDArray, ground: float, ism: RayISM, sectors: int) -> NDArray[np.float32]:
    """Return the masses of `RayISM` over flat ground, by a loop over cells and rays.

    Parameters
    ----------
    xyz : (N, 3) float array
        Points in the frame of the grid, without returns from the ego vehicle [m].
        Without steps and holes: the ground returns of a sector lie on the ground, and returns more than
        `below_ground` under it lie behind such.
    no_returns : (M, 3) float array
        Unit directions of beams without echo, in the frame of the grid.
    ground : float
        Height of the ground [m].
    ism : RayISM
        Its `ground` and `azimuth_step` are not used.
    sectors : int

    Returns
    -------
    (nx, ny, 2) float32
    """
    hits = np.zeros(ism.spec.shape)
    rays = _returned_rays(xyz, ground, ism, hits) + _no_return_rays(no_returns, ground, ism)
    free = _polar_free(rays, ground, ism, sectors)
    spec, (x0, y0, _) = ism.spec, ism.mount.origin.tolist()
    x_min, x_max, y_min, y_max = ism.mount.ego_footprint
    mass = np.zeros((*spec.shape, 2), np.float32)
    for (i, x), (j, y) in itertools.product(*(enumerate(c.ravel().tolist()) for c in spec.cell_centers)):
        if x_min < x < x_max and y_min < y < y_max:
            continue
        r = math.hypot(x - x0, y - y0)
        ring = min(int(r / spec.resolution), free.shape[1] - 1)
        width = min(spec.resolution / max(r, spec.resolution / 8) / (2 * math.pi), 1) * sectors
        span = max(round(width), 1)
        begin = round(math.atan2(y - y0, x - x0) * sectors / (2 * math.pi) - span / 2)
        cleared = np.mean([free[(begin + n) % sectors, ring] for n in range(span)])
        alarm = ism.p_false_alarm ** (hits[i, j] / 2)
        if hits[i, j]:
            cleared *= ism.free_reliability_at_hits
        mass[i, j] = min(cleared * alarm, ism.max_mass), min((1 - alarm) * (1 - cleared), ism.max_mass)
    return mass


class Ray(NamedTuple):
    """One ray over flat ground."""

    azimuth: float  # [rad]
    slope: float  # rise over run
    end: int  # first bin that it does not reach
    is_silent: bool  # without echo
    is_stopped: bool  # by an obstacle


def _returned_rays(xyz: NDArray, ground: float, ism: RayISM, hits: NDArray) -> list[Ray]:
    """Return the ray to each return, and count the half hits of obstacles."""
    spec, (x0, y0, z0) = ism.spec, ism.mount.origin.tolist()
    rays = []
    for x, y, z in xyz.tolist():
        dx, dy, above = x - x0, y - y0, z - ground
        r = math.hypot(dx, dy)
        if above < -ism.below_ground or r < spec.resolution:
            continue
        is_obstacle = ism.obstacle_height < above < ism.clearance
        end = r / spec.resolution
        if above <= ism.obstacle_height:
            end += 1
        elif is_obstacle:
            end = max(r - 2 * ism.range_noise, 0) / spec.resolution
            for side in (-ism.range_noise, ism.range_noise):
                u, v = x + dx / r * side, y + dy / r * side
                if spec.contains(u, v):
                    hits[spec.index(u, v)] += 1
        rays.append(Ray(math.atan2(dy, dx), (z - z0) / r, int(end), False, is_obstacle))
    return rays


def _no_return_rays(no_returns: NDArray, ground: float, ism: RayISM) -> list[Ray]:
    """Return the rays of beams without echo, up to the ground or to `max_range`."""
    step, height = ism.spec.resolution, float(ism.mount.origin[2]) - ground
    rays = []
    for dx, dy, dz in no_returns.tolist():
        run = math.hypot(dx, dy)
        end = int(ism.max_range * run / step)
        end = next((k for k in range(end) if height + dz / run * (k + 0.5) * step < 0), end)
        rays.append(Ray(math.atan2(dy, dx), dz / run, end, True, False))
    return rays


def chance_unnoticed(heights: NDArray, clearance: float, chance: float) -> float:
    """Return E_H[chance ** N(H)] for H uniform up to `clearance` and N(H) the number of `heights` below H."""
    heights = np.sort(np.clip(heights, 0, clearance))
    edges = np.unique([0, *heights, clearance])
    passed = np.searchsorted(heights, (edges[1:] + edges[:-1]) / 2)  # N(H) is constant between two edges
    return float(np.diff(edges) @ chance**passed) / clearance


def chance_hidden(heights: NDArray, fades: NDArray, ism: RayISM) -> float:
    """Return the chance that something hangs between the rays that pass a bin, where an obstacle stopped others.

    `heights` are those of all rays in the bin, also where a ray would be if nothing had stopped it, from the lowest
    up; `fades` is NaN for a ray that passes, else how much of the obstacle is left (0: nothing, 1: all).
    """
    passing = np.flatnonzero(np.isnan(fades))
    levels = np.clip([0, *heights[passing], ism.clearance], 0, ism.clearance)
    worst = 0.0
    for n, stopped in enumerate(np.split(fades, passing)):  # the stopped rays under each level; first a passing ray
        thickness = (levels[n + 1] - levels[n]) / ism.hidden_height * (2 if n == len(passing) else 1)
        worst = max(worst, thickness * np.nan_to_num(stopped).max(initial=0))
    return min(worst, 1.0)


def _polar_free(rays: list[Ray], ground: float, ism: RayISM, sectors: int) -> NDArray[np.float64]:
    """Return the belief in free of every polar bin, (sectors, bins)."""
    spec, (x, y, _) = ism.spec, ism.mount.origin.tolist()
    x0, x1, y0, y1 = spec.extent
    bins = math.ceil(math.hypot(max(x1 - x, x - x0), max(y1 - y, y - y0)) / spec.resolution) + 1
    by_sector: list[list[Ray]] = [[] for _ in range(sectors)]
    for ray in sorted(rays, key=lambda ray: ray.slope):
        by_sector[min(int(ray.azimuth % (2 * math.pi) * sectors / (2 * math.pi)), sectors - 1)].append(ray)
    free = np.zeros((sectors, bins))
    for s, k in np.ndindex(sectors, bins):
        chance = ism.p_miss ** (sectors / (2 * math.pi) / (k + 0.5))  # a cell sees some of the sector's rays
        alone = _bin_free([ray for ray in by_sector[s] if not ray.is_silent], k, chance, ground, ism)
        together = _bin_free(by_sector[s], k, chance, ground, ism)
        free[s, k] = alone + ism.no_return_weight * max(together - alone, 0)
    return free


def _bin_free(rays: list[Ray], k: int, chance: float, ground: float, ism: RayISM) -> float:
    """Return the belief in free of bin `k` from the rays of its sector, sorted by slope, missing with `chance`."""
    step, heights, fades = ism.spec.resolution, [], []
    for ray in rays:
        height = float(ism.mount.origin[2]) - ground + ray.slope * (k + 0.5) * step
        passes = k < ray.end
        if passes and height < ism.clearance:
            heights.append(height)
            fades.append(math.nan)
        elif not passes and ray.is_stopped:
            heights.append(height)
            fades.append(max(1 - (k - ray.end) * step / ism.hidden_depth, 0))
    at, fade = np.array(heights), np.array(fades)
    missed = chance_unnoticed(at[np.isnan(fade)], ism.clearance, chance)
    return (1 - missed) * (1 - chance_hidden(at, fade, ism))


class Beam(NamedTuple):
    """What `classify` needs of a ray of one sector."""

    slope: float  # rise over run
    run: float  # of its return [m]
    above: float  # height of that above the ground map [m]
    is_return: bool


def classify(beams: list[Beam], height: float, step: float, numbers: RayNumbers) -> list[tuple[int, int]]:
    """Return what the rays of one sector hit, as `kernels.profile.classify_rays` has it: kind and `begin` of each.

    Parameters
    ----------
    beams : list of Beam
        Sorted by slope. The run of ground returns rises with it.
    height : float
        Of the ground under the sensor, relative to the sensor [m].
    step : float
        Depth of a bin [m].
    numbers : RayNumbers
    """
    result = [(profile.NONE, -1)] * len(beams)
    known = [(0.0, height)]  # run and height of ground returns
    trend: Trend | None = None
    for n, (slope, run, above, is_return) in enumerate(beams):
        if run < step:
            continue
        if not is_return or above >= numbers.clearance:
            result[n] = (profile.OVERHEAD if is_return else profile.NO_RETURN, -1)
            continue
        if above > numbers.obstacle_height:
            result[n] = (profile.OBSTACLE, -1)
            continue
        z = slope * run
        near, level, incline, rough = _continued(known, run)
        gap, rise = run - near, z - level
        slack = profile.BEND * gap + profile.ROUGH * rough
        is_sunk = rise < -profile.SINK - slack

        if trend and run > trend.last[0] + profile.SUPPORT_GAP:
            rest, before = trend.rest(run, z), trend.rest(*trend.last)
            since = (run - trend.last[0]) / (trend.last[0] - trend.start[0])
            if trend.sign * rest > trend.sign * before * (1 + since / 2):  # it goes on
                trend.last = (run, z)
                if run - trend.start[0] > profile.LONGEST or rest > profile.HIGHEST:
                    _make_ground(result, trend.since, n)
                    if trend.sign < 0:
                        known.append((run, z))
                    trend = None
            else:
                if trend.sign > 0 and rest < before / 2 and run - trend.last[0] < profile.BUMP:
                    _make_ground(result, trend.since, n)
                trend = None

        if trend is None and near > 0:
            steeper = [b.run for b in beams[n + 1 :] if b.is_return and abs(b.above) <= numbers.obstacle_height]
            rises = gap < profile.SUPPORT_REACH and rise > profile.RISE + slack
            falls = is_sunk and min(steeper, default=math.inf) > run - profile.SAME
            if rises or falls:
                edge = max([r for r, _ in known if r <= run - profile.EDGE], default=0.0)
                begin = max(int(edge / step) - 1, 0)
                trend = Trend(
                    1 if rises else -1, n, begin, (near, float(level - incline * gap)), incline, run, (run, z)
                )

        if trend and trend.sign < 0 and is_sunk:
            fall = float(profile.FALL) * max(run - trend.start[0] - float(profile.FALL_GAP), 0.0)
            allowed = numbers.below_ground + fall + slack
            is_deep = bool(trend.rest(run, z) < -allowed)
        else:
            is_deep = False
        if is_deep and trend:
            result[n] = (profile.DEEP, trend.begin)
        elif above < -numbers.below_ground:
            continue
        elif trend and trend.sign > 0:
            is_step = trend.rest(run, z) > profile.STEP_HEIGHT + profile.ROUGH * rough
            is_step = is_step and run < trend.first + profile.EDGE
            result[n] = (profile.STEP if is_step else profile.RAISED, trend.begin)
        elif trend and is_sunk:
            result[n] = (profile.SUNK, trend.begin)
        else:
            result[n] = (profile.GROUND, -1)
        if not is_sunk:
            known.append((run, z))
    return result


@dataclass
class Trend:
    """A rise or fall of the ground that `classify` follows."""

    sign: int  # 1 for a rise
    since: int  # number of its first ray
    begin: int  # bin of the ground before it
    start: tuple[float, float]  # run and height of that [m]
    incline: float  # of the ground before it
    first: float  # run of the first return in it [m]
    last: tuple[float, float]  # run and height of the last [m]

    def rest(self, run: float, z: float) -> float:
        """Return the height above the ground continued from before the rise or fall [m]."""
        return z - self.start[1] - self.incline * (run - self.start[0])


def _continued(known: list[tuple[float, float]], run: float) -> tuple[float, float, float, float]:
    """Return the run of the last ground return before `run`, and height, incline and roughness from there on."""
    at: int = max((k for k, (r, _) in enumerate(known) if r <= run - profile.SUPPORT_GAP), default=0)
    base: int = max((k for k, (r, _) in enumerate(known[: at + 1]) if r <= known[at][0] - profile.BASELINE), default=0)
    r, z = np.array(known[max(min(base + 1, at - 1), 0) : at + 1]).T
    incline = 0.0
    if ((r - r.mean()) ** 2).sum() > 0.5:
        incline = min(max(float(np.polyfit(r, z, 1)[0]), -profile.STEEPEST), profile.STEEPEST)
    level = float(z.mean() + incline * (run - r.mean()))
    residual = ((z - z.mean()) ** 2).sum() - incline * ((r - r.mean()) * (z - z.mean())).sum()
    rough = math.sqrt(max(residual, 0) / (len(r) - 2)) if len(r) >= profile.MANY else 0.0
    return known[at][0], level, incline, rough


def _make_ground(result: list[tuple[int, int]], since: int, until: int) -> None:
    """Take the returns of a rise or fall for ground, in place."""
    for k in range(since, until):
        if result[k][1] >= 0:
            result[k] = (profile.GROUND, -1)
