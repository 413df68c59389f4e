"""Kernels that compare the beams of a planar laser with their neighbours: which fans are free, which ends count."""

import math

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import BeamColumns, BeamNumbers, Directions
from ogm.jit import kernel

__all__ = ["ends_of", "fans_of", "find_directions", "range_limits"]

MAX_STEP = math.radians(3)  # [rad] between neighbouring beams: wider gaps may hide what stands in them
FLATTEST = math.tan(math.radians(5))  # angle at which a surface is seen; flatter ones count as edges
MIN_JUMP = 0.1  # [m] between the ranges of two beams that end at different surfaces
MAX_MARGIN = 10.0  # [cells] that a fan ends before a surface seen at a flat angle
ISOLATED = 0.5  # reliability of an echo that its neighbours contradict
NARROW = 0.3  # [m] openings up to this width may be a mirror, or a pane with echoes from behind it
PANE = 4.0  # [m] the same for openings of which half of the beams or more have no echo


@kernel
def find_directions(beams: BeamColumns, step: float, cone: bool) -> Directions:
    """Return the directions of beams, of which several may be echoes of one, and which are neighbours.

    Parameters
    ----------
    beams : BeamColumns
    step : float
        Angle from one beam of the sensor to the next [rad].
    cone : bool
        Whether beams are too wide to have neighbours.
    """
    count = len(beams.azimuth)
    of_beam = np.zeros(count, np.int64)
    for k in range(1, count):
        of_beam[k] = of_beam[k - 1] + (beams.azimuth[k] - beams.azimuth[k - 1] > 0.05 * step)
    size = of_beam[-1] + 1 if count else 0
    x, y, azimuth, reach = np.zeros(size), np.zeros(size), np.zeros(size), np.full(size, np.inf)
    silent, adjacent, same = np.ones(size, np.bool_), np.zeros(size, np.bool_), np.zeros(size, np.bool_)
    turn, jump, limit = np.zeros(size), np.zeros(size), np.full(size, np.inf)
    for k in range(count - 1, -1, -1):
        d = of_beam[k]
        x[d], y[d], azimuth[d] = beams.x[k], beams.y[k], beams.azimuth[k]
        reach[d], silent[d] = min(reach[d], beams.reach[k]), silent[d] and not beams.echo[k]
    for d in range(size):
        n = (d + 1) % size
        turn[d] = azimuth[n] - azimuth[d] + (0.0 if n > d else 2 * math.pi)
        adjacent[d] = size > 1 and not cone and turn[d] <= min(1.5 * step, MAX_STEP)
        jump[d] = max(MIN_JUMP, min(reach[d], reach[n]) * turn[d] / FLATTEST)
        same[d] = adjacent[d] and not (silent[d] or silent[n]) and abs(reach[d] - reach[n]) <= jump[d]
    directions = Directions(of_beam, x, y, reach, silent, turn, jump, adjacent, same, limit)
    range_limits(directions)
    return directions


@kernel
def range_limits(directions: Directions) -> None:
    """Find the range beyond which the beams in narrow openings and panes are contradicted by their edges.

    Parameters
    ----------
    directions : Directions
        `limit`, infinity before, becomes the range of the chord between the two edges of an opening.
    """
    x, y, reach, silent = directions.x, directions.y, directions.reach, directions.silent
    jump, adjacent, count = directions.jump, directions.adjacent, len(directions.reach)
    for first in range(count):
        near, quiet = reach[first], 0
        if silent[first] or not adjacent[first] or not reach[(first + 1) % count] > near + jump[first]:
            continue
        for k in range(1, count):
            inner, before = (first + k) % count, (first + k - 1) % count
            across = abs(x[first] * y[inner] - y[first] * x[inner])  # sine of the angle
            if not adjacent[before] or x[first] * x[inner] + y[first] * y[inner] <= 0 or near * across > PANE:
                break
            if k > 1 and not silent[inner] and reach[before] > reach[inner] + jump[before]:
                ex, ey = reach[inner] * x[inner] - near * x[first], reach[inner] * y[inner] - near * y[first]
                if math.hypot(ex, ey) <= (PANE if 2 * quiet >= k - 1 else NARROW):
                    for inside in range(1, k):
                        at = (first + inside) % count
                        turn = x[at] * ey - y[at] * ex
                        if turn != 0:
                            chord = near * (x[first] * ey - y[first] * ex) / turn
                            directions.limit[at] = min(directions.limit[at], max(chord, 0.0))
            quiet += silent[inner]


@kernel
def fans_of(directions: Directions, numbers: BeamNumbers) -> NDArray[np.float64]:
    """Return what is free: a fan between neighbours, up to the nearer of their ends, and single beams.

    Parameters
    ----------
    directions : Directions
    numbers : BeamNumbers

    Returns
    -------
    (K, 7) float64
        Cosine and sine of the middle, tangent of half the width, range [m] and mass of a near part, range and mass
        of a far part; see `kernels.planar.clear_fans`.
    """
    x, y, reach, silent, limit = directions.x, directions.y, directions.reach, directions.silent, directions.limit
    size, count = len(reach), 0
    fans = np.zeros((size, 7))
    weak, full = numbers.free * numbers.weak, numbers.free
    for d in range(size):
        n = (d + 1) % size
        if directions.adjacent[d]:
            u, v = x[d] + x[n], y[d] + y[n]
            length = math.hypot(u, v)
            half = abs(x[d] * y[n] - y[d] * x[n]) / (1 + x[d] * x[n] + y[d] * y[n])
        elif directions.adjacent[d - 1]:
            continue
        else:
            n, u, v, length, half = d, x[d], y[d], 1.0, numbers.half_width
        near, far = min(reach[d], limit[d], reach[n], limit[n]), min(reach[d], reach[n])
        if silent[d]:
            far = min(far, limit[d])
        if silent[n]:
            far = min(far, limit[n])
        if directions.same[d] and n != d:  # depth of the surface in the width of a cell
            depth = abs(reach[d] - reach[n]) / max(min(reach[d], reach[n]) * directions.turn[d], 1e-9)
            margin = numbers.side * min(depth, MAX_MARGIN)
            near, far = max(near - margin, 0.0), max(far - margin, 0.0)
        fan = fans[count]
        fan[0], fan[1], fan[2], fan[3], fan[5], fan[6] = u / length, v / length, half, near, far, weak
        fan[4] = weak if numbers.cone or silent[d] or silent[n] else full
        count += 1
    return fans[:count]


@kernel
def ends_of(beams: BeamColumns, directions: Directions, numbers: BeamNumbers) -> NDArray[np.float64]:
    """Return what is occupied: the ends of beams with an echo, of which those count less that others contradict.

    Parameters
    ----------
    beams : BeamColumns
    directions : Directions
    numbers : BeamNumbers

    Returns
    -------
    (M, 5) float64
        Cosine and sine, range [m], tangent of half the width, mass; see `kernels.planar.mark_ends`.
    """
    ends, count = np.zeros((len(beams.reach), 5)), 0
    for k in range(len(beams.reach)):
        if not beams.marks[k]:
            continue
        d = directions.of_beam[k]
        before, jump = d - 1, directions.jump[d]
        beside = directions.adjacent[d] or directions.adjacent[before]
        alone = beside and not (directions.same[d] or directions.same[before])
        behind = beams.reach[k] > min(directions.reach[d], directions.limit[d]) + jump
        end = ends[count]
        end[0], end[1], end[2], end[3] = beams.x[k], beams.y[k], beams.reach[k], numbers.half_width
        end[4] = numbers.occupied * (ISOLATED if alone or behind else 1.0)
        count += 1
    return ends[:count]
