"""Reference of `RayISM` over flat ground, by loops over cells and rays."""

import itertools
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.ray import RayISM

__all__ = ["ray_grid_mass", "silence_reliability"]


def ray_grid_mass(
    xyz: NDArray[Any], no_returns: NDArray[Any], ground: float, ism: RayISM, sectors: int
) -> NDArray[np.float32]:
    """Return the masses of `RayISM` over flat ground.

    Parameters
    ----------
    xyz : (N, 3) float array
        Points in the frame of the grid [m], without returns from the ego vehicle, steps and holes: the ground returns
        of a sector lie on the ground, and returns more than `below_ground` under the ground lie behind ground returns.
    no_returns : (M, 3) float array
        Unit directions of beams without echo, in the frame of the grid.
    ground : float
        Height of the ground [m].
    ism : RayISM
        Model with a mount. Its `ground` and `azimuth_step` are not used.
    sectors : int
        Number of polar sectors.

    Returns
    -------
    (nx, ny, 2) float32
    """
    hits = np.zeros(ism.spec.shape)
    rays = returned_rays(xyz, ground, ism, hits) + no_return_rays(no_returns, ground, ism)
    free = _polar_free(rays, silence_reliability(xyz, no_returns, ground, ism), ism, ground, sectors)
    spec, (x0, y0, _) = ism.spec, _origin(ism)
    assert ism.mount is not None
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


def _origin(ism: RayISM) -> list[float]:
    """Return the position of the sensor of a model with a mount, x, y, z [m]."""
    assert ism.mount is not None
    return list(map(float, ism.mount.origin))


class Ray(NamedTuple):
    """One ray over flat ground."""

    azimuth: float  # [rad]
    slope: float  # rise over run
    end: int  # first bin that the ray does not reach
    is_silent: bool  # without echo
    is_stopped: bool  # by an obstacle


def returned_rays(xyz: NDArray[Any], ground: float, ism: RayISM, hits: NDArray[Any]) -> list[Ray]:
    """Return the ray of each return, and count half hits of obstacles in `hits`."""
    spec, (x0, y0, z0) = ism.spec, _origin(ism)
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
            wide = ism.noise_growth * r**2
            noise = ism.range_noise + wide
            end = max(r - 2 * noise, 0) / spec.resolution
            for side in (-noise, noise) if wide <= max(spec.resolution, 0.1) else ():
                u, v = x + dx / r * side, y + dy / r * side
                if spec.contains(u, v):
                    hits[spec.index(u, v)] += 1
        rays.append(Ray(math.atan2(dy, dx), (z - z0) / r, int(end), False, is_obstacle))
    return rays


def no_return_rays(no_returns: NDArray[Any], ground: float, ism: RayISM) -> list[Ray]:
    """Return the rays of beams without echo, up to the ground or to `max_range`."""
    step, height = ism.spec.resolution, _origin(ism)[2] - ground
    rays = []
    for dx, dy, dz in no_returns.tolist():
        run = math.hypot(dx, dy)
        end = int(ism.max_range * run / step)
        end = next((k for k in range(end) if height + dz / run * (k + 0.5) * step < 0), end)
        rays.append(Ray(math.atan2(dy, dx), dz / run, end, True, False))
    return rays


def chance_unnoticed(heights: NDArray[Any], clearance: float, chance: float) -> float:
    """Return E_H[chance ** N(H)] for H uniform up to `clearance` and N(H) the number of `heights` below H."""
    heights = np.sort(np.clip(heights, 0, clearance))
    edges = np.unique([0, *heights, clearance])
    passed = np.searchsorted(heights, (edges[1:] + edges[:-1]) / 2)  # N(H) is constant between two edges
    return float(np.diff(edges) @ chance**passed) / clearance


def chance_hidden(heights: NDArray[Any], fades: NDArray[Any], ism: RayISM) -> float:
    """Return the probability of a hidden object between the rays that pass a bin behind an obstacle.

    `heights` are sorted and include stopped rays, extended to the bin. `fades` is NaN for a ray that passes, else the
    influence of the obstacle that stopped it, from 1 at the obstacle to 0 at `hidden_depth` behind it.
    """
    passing = np.flatnonzero(np.isnan(fades))
    levels = np.clip([0, *heights[passing], ism.clearance], 0, ism.clearance)
    worst, last = 0.0, len(passing)
    for n, stopped in enumerate(np.split(fades, passing)):  # a passing ray, then the stopped rays below the next one
        thickness = (levels[n + 1] - levels[n]) / ism.hidden_height * (2 if n == last else 1)
        worst = max(worst, thickness * np.nan_to_num(stopped).max(initial=0 if n == last else ism.p_hidden))
    above = ism.p_hidden * (levels[-1] - levels[-2]) / ism.clearance
    return float(1 - (1 - min(worst, 1.0)) * (1 - above))


def _bins(ism: RayISM) -> int:
    """Return the number of polar bins from the sensor to the farthest corner of the grid."""
    spec, (x, y, _) = ism.spec, _origin(ism)
    x0, x1, y0, y1 = spec.extent
    return math.ceil(math.hypot(max(x1 - x, x - x0), max(y1 - y, y - y0)) / spec.resolution) + 1


def silence_reliability(xyz: NDArray[Any], no_returns: NDArray[Any], ground: float, ism: RayISM) -> NDArray[np.float64]:
    """Return the reliability of beams without echo in each polar bin over flat ground, (bins,).

    By the max-min formula of monotone regression, the probability that a surface in bin k gives no echo is the maximum
    over i <= k of the minimum over j >= k of the share of lost echoes in bins i to j.
    """
    (x0, y0, z0), step, bins = _origin(ism), ism.spec.resolution, _bins(ism)
    seen, lost = np.zeros(bins), np.zeros(bins)
    for x, y in xyz[:, :2].tolist():
        if (r := math.hypot(x - x0, y - y0)) >= step:
            seen[min(int(r / step), bins - 1)] += 1
    for dx, dy, dz in no_returns.tolist():
        run = math.hypot(dx, dy)
        meets = (k for k in range(bins) if z0 - ground + dz / run * (k + 0.5) * step < 0)
        if (k := next(meets, bins)) < min(bins, int(ism.max_range * run / step)):
            lost[k] += 1
    known = np.flatnonzero(seen + lost)
    reliability = np.ones(bins)
    for k in range(bins):
        here = known[known >= k][0] if (known >= k).any() else known[-1] if len(known) else None
        if here is not None:
            before, after = known[known <= here], known[known >= here]
            share = max(min(lost[i : j + 1].sum() / (seen + lost)[i : j + 1].sum() for j in after) for i in before)
            reliability[k] = max(1 - 2 * share, 0)
    return reliability


def _polar_free(
    rays: list[Ray], silence: NDArray[np.float64], ism: RayISM, ground: float, sectors: int
) -> NDArray[np.float64]:
    """Return the mass of free of each polar bin, (sectors, bins)."""
    bins = len(silence)
    by_sector: list[list[Ray]] = [[] for _ in range(sectors)]
    for ray in sorted(rays, key=lambda ray: ray.slope):
        by_sector[min(int(ray.azimuth % (2 * math.pi) * sectors / (2 * math.pi)), sectors - 1)].append(ray)
    free = np.zeros((sectors, bins))
    for s, k in np.ndindex(sectors, bins):
        chance = ism.p_miss ** (sectors / (2 * math.pi) / (k + 0.5))  # a cell is met by a part of the sector's rays
        alone = _bin_free([ray for ray in by_sector[s] if not ray.is_silent], k, chance, ground, ism)
        together = _bin_free(by_sector[s], k, chance, ground, ism)
        free[s, k] = alone + ism.no_return_weight * silence[k] * max(together - alone, 0)
    return free


def _bin_free(rays: list[Ray], k: int, chance: float, ground: float, ism: RayISM) -> float:
    """Return the mass of free of bin `k` from the rays, sorted by slope; each misses with `chance`."""
    step, heights, fades = ism.spec.resolution, [], []
    for ray in rays:
        height = _origin(ism)[2] - ground + ray.slope * (k + 0.5) * step
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
