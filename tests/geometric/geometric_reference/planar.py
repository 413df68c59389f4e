"""Reference of `PlanarISM`: each cell against each pair of neighbouring beams."""

import math
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.planar import PlanarISM
from ogm.scan import Scan

__all__ = ["planar_mass"]


class _Beam(NamedTuple):
    bearing: float
    reach: float
    echo: bool
    marks: bool


def planar_mass(scan: Scan, ism: PlanarISM) -> NDArray[np.float32]:
    """Return the masses of `PlanarISM` for beams in different directions, by plain loops.

    Parameters
    ----------
    scan : Scan
        Scan of a planar laser in the frame of a level sensor; no two beams have the same direction.
    ism : PlanarISM
        Model with a mount.

    Returns
    -------
    (nx, ny, 2) float32
    """
    beams, turns, fits, limits = neighbouring_beams(scan, ism)
    spec, (x0, y0, _) = ism.spec, ism.mount.origin  # type: ignore[union-attr]
    xs, ys = (axis.ravel() for axis in spec.cell_centers)
    mass = np.zeros((*spec.shape, 2), np.float32)
    alone = [k for k in range(len(beams)) if not (fits[k] or fits[k - 1])]
    fans = [_fan(k, (k + 1) % len(beams), beams, turns[k], limits, ism) for k in range(len(beams)) if fits[k]]
    fans += [_fan(k, k, beams, 0.0, limits, ism) for k in alone]
    for i, j in np.ndindex(*spec.shape):
        u, v = float(xs[i] - x0), float(ys[j] - y0)
        mass[i, j, 0] = max((_free(fan, u, v, ism) for fan in fans), default=0.0)
    for k, beam in enumerate(beams):
        if not beam.marks:
            continue
        neighbours = [fits[k] and (k, (k + 1) % len(beams)), fits[k - 1] and ((k - 1) % len(beams), k)]
        beside = [pair for pair in neighbours if pair]
        isolated = beside and not any(_same(beams[a], beams[b], turns[a]) for a, b in beside)
        jump = _jump(beam, beams[(k + 1) % len(beams)], turns[k])
        weight = 0.5 if isolated or beam.reach > limits[k] + jump else 1.0
        for cell, off in _crossed(beam, ism):
            beyond = 1.0 if off == 0 else NormalDist(0, ism.range_noise).cdf(-off)
            value = (1 - ism.p_false_alarm) * weight * beyond
            mass[cell][1] = max(mass[cell][1], value)
    mass[mass[..., 1] > ism.p_false_alarm, 0] = 0
    mass[..., 0] = np.minimum(mass[..., 0], 1 - mass[..., 1])
    a, b, c, d = ism.mount.ego_footprint  # type: ignore[union-attr]
    mass[np.ix_((xs > a) & (xs < b), (ys > c) & (ys < d))] = 0
    return mass


def neighbouring_beams(scan: Scan, ism: PlanarISM) -> tuple[list[_Beam], list[float], list[bool], list[float]]:
    """Return the sorted beams; for each the turn to the next, whether both are neighbours, and its range limit."""
    beams = sorted(beams_of(scan, ism))
    turns = [(b.bearing - a.bearing) % (2 * math.pi) for a, b in zip(beams, beams[1:] + beams[:1], strict=True)]
    step = sorted(turns[:-1])[(len(turns) - 1) // 2]
    fits = [turn <= min(1.5 * step, math.radians(3)) for turn in turns]
    return beams, turns, fits, [opening_limit(k, beams, turns, fits) for k in range(len(beams))]


def beams_of(scan: Scan, ism: PlanarISM) -> list[_Beam]:
    """Return the beams of a level sensor; a tilted beam ends at the floor margin or at clearance."""
    assert ism.mount is not None
    height, footprint, found = ism.mount.sensor_height, ism.mount.ego_footprint, []
    silent = [] if scan.no_returns is None or scan.max_range is None else (scan.no_returns * scan.max_range).tolist()
    for k, (x, y, z) in enumerate([*scan.points[:, :3].tolist(), *silent]):
        echo = k < len(scan)
        px, py = x + float(ism.mount.origin[0]), y + float(ism.mount.origin[1])
        if echo and footprint[0] < px < footprint[1] and footprint[2] < py < footprint[3]:
            continue
        reach = distance = math.dist((0, 0), (x, y))
        lowest = min(ism.floor_margin, height / 2)
        if height + z < lowest:
            reach = distance * (height - lowest) / -z
        if height < ism.clearance < height + z:
            reach = distance * (ism.clearance - height) / z
        found.append(_Beam(math.atan2(y, x), reach, echo, echo and reach == distance))
    return found


def _jump(a: _Beam, b: _Beam, turn: float) -> float:
    return max(0.1, min(a.reach, b.reach) * turn / math.tan(math.radians(5)))


def _same(a: _Beam, b: _Beam, turn: float) -> bool:
    return a.echo and b.echo and abs(a.reach - b.reach) <= _jump(a, b, turn)


def _place(beam: _Beam) -> NDArray[np.float64]:
    return beam.reach * np.array([math.cos(beam.bearing), math.sin(beam.bearing)])


def opening_limit(k: int, beams: list[_Beam], turns: list[float], fits: list[bool]) -> float:
    """Return the range of the nearest chord of all narrow openings and panes around beam `k` [m], inf without any."""
    n, limit = len(beams), math.inf
    for before in range(1, n):
        left = (k - before) % n
        if not fits[left]:
            break
        for after in range(1, n - before):
            right = (k + after) % n
            if not fits[right - 1]:
                break
            edges, first = (beams[left], beams[right]), beams[(left + 1) % n]
            if not (edges[0].echo and edges[1].echo):
                continue
            angle = sum(turns[(left + m) % n] for m in range(before + after))
            opens = first.reach > edges[0].reach + _jump(edges[0], first, turns[left])
            closes = beams[right - 1].reach > edges[1].reach + _jump(beams[right - 1], edges[1], turns[right - 1])
            if not (opens and closes) or angle >= math.pi / 2 or edges[0].reach * math.sin(angle) > 4.0:
                continue
            inside = [beams[(left + m) % n] for m in range(1, before + after)]
            quiet = sum(not beam.echo for beam in inside) >= len(inside) / 2
            start, stop = map(_place, edges)
            if np.linalg.norm(stop - start) <= (4.0 if quiet else 0.3):
                ray = _place(beams[k]._replace(reach=1.0))
                along, _ = np.linalg.solve(np.column_stack([ray, start - stop]), start)
                limit = min(limit, max(float(along), 0.0))
    return limit


class _Fan(NamedTuple):
    start: float  # bearing
    turn: float
    parts: list[tuple[float, float]]  # range up to which it is free, and mass


def _fan(k: int, n: int, beams: list[_Beam], turn: float, limits: list[float], ism: PlanarISM) -> _Fan:
    """Return the fan from beam `k` to beam `n`, which may be the same."""
    near, far = [], []
    for at in (k, n):
        near.append(min(beams[at].reach, limits[at]))
        far.append(beams[at].reach if beams[at].echo else near[-1])
    margin = 0.0
    if n != k and _same(beams[k], beams[n], turn):
        slope = abs(beams[k].reach - beams[n].reach) / (min(beams[k].reach, beams[n].reach) * turn)
        margin = ism.spec.resolution * min(slope, 10.0)
    weight = 1.0 if beams[k].echo and beams[n].echo else ism.no_return_weight
    free = 1 - ism.p_miss
    parts = [(min(near) - margin, free * weight), (min(far) - margin, free * ism.no_return_weight)]
    return _Fan(beams[k].bearing, turn, parts)


def _free(fan: _Fan, u: float, v: float, ism: PlanarISM) -> float:
    """Return the mass of free from a fan in a cell at (u, v) from the sensor."""
    distance, side, middle = math.hypot(u, v), ism.spec.resolution, fan.start + fan.turn / 2
    off = (math.atan2(v, u) - middle + math.pi) % (2 * math.pi) - math.pi
    if abs(off) >= math.pi / 2 or not (abs(off) <= fan.turn / 2 or abs(distance * math.sin(off)) <= side / 2 + 1e-6):
        return 0.0
    extent = side / 2 * (abs(math.cos(middle)) + abs(math.sin(middle)))
    left = ((reach - extent - distance, mass) for reach, mass in fan.parts)
    return max(mass * -math.expm1(-0.5 * (max(rest, 0.0) / ism.range_noise) ** 2) for rest, mass in left)


def _crossed(beam: _Beam, ism: PlanarISM) -> list[tuple[tuple[int, int], float]]:
    """Return the cells on the axis of a beam near its end, and the distance from the end at their entry [m]."""
    assert ism.mount is not None
    spec, reach = ism.spec, 4 * ism.range_noise
    place, ray = _place(beam) + ism.mount.origin[:2], _place(beam._replace(reach=1.0))
    cuts = [-reach, 0.0, reach]
    for axis in (0, 1):  # distances at which the axis crosses grid lines
        if abs(ray[axis]) > 1e-9:
            lines = spec.origin[axis] + spec.resolution * np.arange(spec.shape[axis] + 1)
            cuts += [t for t in ((lines - place[axis]) / ray[axis]).tolist() if abs(t) < reach]
    cuts.sort()
    found = []
    for start, stop in zip(cuts, cuts[1:], strict=False):
        x, y = place + ray * (start + stop) / 2
        if spec.contains(x, y):
            i, j = spec.index(x, y)
            found.append(((int(i), int(j)), max(start, -stop, 0.0)))
    return found
