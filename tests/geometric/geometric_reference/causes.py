"""Causes of unknown cells, by loops over cells and rays or beams."""

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geometric_reference.planar import neighbouring_beams
from geometric_reference.ray import Ray, no_return_rays, returned_rays
from ogm.geometric.planar import PlanarISM
from ogm.geometric.ray import RayISM
from ogm.scan import Scan
from ogm.unknown_cause import UnknownCause

__all__ = ["planar_causes", "ray_causes"]

MAX_GAP = math.radians(10)  # between two beams
WEDGES = 16  # of the full circle; the view of a cell comes from its wedge and the two neighbours


def ray_causes(
    xyz: NDArray[Any], no_returns: NDArray[Any], ground: float, ism: RayISM, sectors: int
) -> NDArray[np.uint8]:
    """Return the causes by which cells would be unknown to `RayISM` over flat ground, (nx, ny); for all cells.

    Parameters
    ----------
    xyz, no_returns, ground, ism, sectors
        See `ray_grid_mass`.
    """
    assert ism.mount is not None
    spec, (x0, y0, z0) = ism.spec, ism.mount.origin.tolist()
    height, by_sector = z0 - ground, [list[Ray]() for _ in range(sectors)]
    rays = returned_rays(xyz, ground, ism, np.zeros(spec.shape)) + no_return_rays(no_returns, ground, ism)
    buried = [(math.atan2(y - y0, x - x0), math.hypot(x - x0, y - y0), z - z0) for x, y, z in xyz if z - ground < -0.3]
    view = [(ray.azimuth, ray.slope) for ray in rays] + [(azimuth, z / run) for azimuth, run, z in buried]
    for ray in rays:
        by_sector[sector_of(ray.azimuth, sectors)].append(ray)
    used = sorted({sector_of(azimuth, sectors) for azimuth, _ in view})
    x_min, x_max, y_min, y_max = ism.mount.ego_footprint
    causes = np.zeros(spec.shape, np.uint8)
    for (i, x), (j, y) in itertools.product(*(enumerate(c.ravel().tolist()) for c in spec.cell_centers)):
        r = math.hypot(x - x0, y - y0)
        k = int(r / spec.resolution)
        middle, width = math.atan2(y - y0, x - x0), spec.resolution / max(r, spec.resolution / 8)
        span = max(round(min(width / (2 * math.pi), 1) * sectors), 1)
        s = (round(middle * sectors / (2 * math.pi) - span / 2) + span // 2) % sectors
        run = (k + 0.5) * spec.resolution
        if x_min < x < x_max and y_min < y < y_max:
            causes[i, j] = UnknownCause.NEAR_VEHICLE
        elif s not in used:
            gap = min((s - other) % sectors for other in used) + min((other - s) % sectors for other in used) - 1
            narrow = gap * 2 * math.pi / sectors <= MAX_GAP + 1e-9
            causes[i, j] = UnknownCause.BETWEEN_BEAMS if narrow else UnknownCause.OUTSIDE_VIEW
        else:
            near = s * WEDGES // sectors
            around = [a for at, a in view if (sector_of(at, sectors) * WEDGES // sectors - near + 1) % WEDGES <= 2]
            ends = [(end, z) for at, end, z in buried if sector_of(at, sectors) == s]
            under = any(height + z / end * run < 0 and k < int(end / spec.resolution) for end, z in ends)
            causes[i, j] = _cause_of_bin(by_sector[s], k, run, height, (min(around), max(around)), under, ism)
    return causes


def sector_of(azimuth: float, sectors: int) -> int:
    """Return the sector that holds an azimuth [rad]."""
    return min(int(azimuth % (2 * math.pi) * sectors / (2 * math.pi)), sectors - 1)


def _cause_of_bin(
    rays: list[Ray], k: int, run: float, height: float, view: tuple[float, float], under: bool, ism: RayISM
) -> UnknownCause:
    """Return the cause of bin `k` of a sector, with its centre at `run` [m]; `under`: a return from below the bin."""
    at = [height + ray.slope * run for ray in rays]
    lowest, highest = (height + slope * run for slope in view)
    reaching = [k < ray.end for ray in rays]
    passing = [here and z < ism.clearance for here, z in zip(reaching, at, strict=True)]
    farthest = -height / view[0] if view[0] < 0 else math.inf
    meets_in_grid = farthest <= max(math.dist((0, 0), corner) for corner in _corners(ism))
    if under or any(ray.is_stopped and not here and z >= 0 for ray, here, z in zip(rays, reaching, at, strict=True)):
        return UnknownCause.BEHIND_OBSTACLE
    if meets_in_grid and lowest >= ism.clearance / 2:
        return UnknownCause.NEAR_VEHICLE
    below = [ray for ray, here in zip(rays, passing, strict=True) if here]
    if below:
        is_silent = min(below, key=lambda ray: (ray.slope, ray.is_silent)).is_silent
        return UnknownCause.NO_ECHO if is_silent else UnknownCause.BETWEEN_BEAMS
    if any(here and not ray.is_silent for ray, here in zip(rays, reaching, strict=True)):
        return UnknownCause.ABOVE_CLEARANCE
    return UnknownCause.NO_ECHO if highest >= 0 else UnknownCause.OUTSIDE_VIEW


def _corners(ism: RayISM) -> list[tuple[float, float]]:
    """Return the corners of the grid relative to the sensor [m]."""
    assert ism.mount is not None
    x0, x1, y0, y1 = ism.spec.extent
    x, y, _ = ism.mount.origin.tolist()
    return [(u - x, v - y) for u in (x0, x1) for v in (y0, y1)]


def planar_causes(scan: Scan, ism: PlanarISM) -> NDArray[np.uint8]:
    """Return the causes by which cells would be unknown to `PlanarISM`, (nx, ny), for level beams.

    Parameters
    ----------
    scan : Scan
        See `planar_mass`: no two beams have the same direction.
    ism : PlanarISM
        With a mount.
    """
    assert ism.mount is not None
    beams, turns, fits, limits = neighbouring_beams(scan, ism)
    causes = np.full(ism.spec.shape, UnknownCause.OUTSIDE_VIEW, np.uint8)
    a, b, c, d = ism.mount.ego_footprint
    for (i, x), (j, y) in itertools.product(*(enumerate(c.ravel().tolist()) for c in ism.spec.cell_centers)):
        u, v = x - float(ism.mount.origin[0]), y - float(ism.mount.origin[1])
        bearing, distance = math.atan2(v, u), math.hypot(u, v)
        if a < x < b and c < y < d:
            causes[i, j] = UnknownCause.NEAR_VEHICLE
            continue
        k = min(range(len(beams)), key=lambda k: (bearing - beams[k].bearing) % (2 * math.pi))
        pair = (k, (k + 1) % len(beams))
        if not fits[k]:
            causes[i, j] = UnknownCause.BETWEEN_BEAMS if turns[k] <= MAX_GAP else UnknownCause.OUTSIDE_VIEW
            continue
        nearer = min(pair, key=lambda n: beams[n].reach)
        if distance < min(limits[n] for n in pair) and distance < beams[nearer].reach:
            silent = not all(beams[n].echo for n in pair)
            causes[i, j] = UnknownCause.NO_ECHO if silent else UnknownCause.BETWEEN_BEAMS
        elif distance < beams[nearer].reach:
            causes[i, j] = UnknownCause.CONTRADICTED
        elif beams[nearer].marks:
            causes[i, j] = UnknownCause.BEHIND_OBSTACLE
    return causes
