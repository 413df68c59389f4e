"""Free fans and occupied ends of the beams of a planar laser, by comparison with neighbouring beams."""

import math

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import BeamColumns, BeamNumbers, Directions
from ogm.jit import kernel

__all__ = ["ends_of", "fans_of", "find_directions", "range_limits"]

MAX_STEP = math.radians(3)  # [rad] largest angle between neighbouring beams; wider gaps may hide an obstacle
MIN_INCIDENCE = math.tan(math.radians(5))  # smallest angle between beam and surface; below it an edge
MIN_JUMP = 0.1  # [m] smallest difference of range between two surfaces
MAX_MARGIN = 10.0  # [cells] largest distance of the end of a fan from a surface at a flat angle
ISOLATED_RELIABILITY = 0.5  # reliability of an echo that the neighbours contradict
MAX_MIRROR_WIDTH = 0.3  # [m] largest width of a mirror, or of a pane with echoes from behind it
MAX_PANE_WIDTH = 4.0  # [m] the same if at least half of the beams in the opening have no echo


@kernel
def find_directions(beams: BeamColumns, step: float, cone: bool) -> Directions:
    """Return the directions of beams and the relations of neighbouring directions.

    Several echoes of a beam share a direction.

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
        jump[d] = max(MIN_JUMP, min(reach[d], reach[n]) * turn[d] / MIN_INCIDENCE)
        same[d] = adjacent[d] and not (silent[d] or silent[n]) and abs(reach[d] - reach[n]) <= jump[d]
    directions = Directions(of_beam, x, y, reach, silent, turn, jump, adjacent, same, limit)
    range_limits(directions)
    return directions


@kernel
def range_limits(directions: Directions) -> None:
    """Limit the range of the beams in narrow openings and panes by the edges of the opening.

    Parameters
    ----------
    directions : Directions
        `limit`, infinite at first, becomes the range of the chord between the two edges of an opening.
    """
    x, y, reach, silent = directions.x, directions.y, directions.reach, directions.silent
    jump, adjacent, count = directions.jump, directions.adjacent, len(directions.reach)
    for first in range(count):
        near, silent_count = reach[first], 0
        if silent[first] or not adjacent[first] or not reach[(first + 1) % count] > near + jump[first]:
            continue
        for k in range(1, count):
            inner, before = (first + k) % count, (first + k - 1) % count
            across = abs(x[first] * y[inner] - y[first] * x[inner])  # sine of the angle
            if not adjacent[before] or x[first] * x[inner] + y[first] * y[inner] <= 0 or near * across > MAX_PANE_WIDTH:
                break
            if k > 1 and not silent[inner] and reach[before] > reach[inner] + jump[before]:
                ex, ey = reach[inner] * x[inner] - near * x[first], reach[inner] * y[inner] - near * y[first]
                if math.hypot(ex, ey) <= (MAX_PANE_WIDTH if 2 * silent_count >= k - 1 else MAX_MIRROR_WIDTH):
                    for inside in range(1, k):
                        at = (first + inside) % count
                        turn = x[at] * ey - y[at] * ex
                        if turn != 0:
                            chord = near * (x[first] * ey - y[first] * ex) / turn
                            directions.limit[at] = min(directions.limit[at], max(chord, 0.0))
            silent_count += silent[inner]


@kernel
def fans_of(directions: Directions, numbers: BeamNumbers) -> NDArray[np.float64]:
    """Return the free fans: between neighbours up to the nearer end, and around single beams.

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
    """Return the occupied ends of the beams with an echo.

    An end that neighbours or a nearer surface contradict has less mass.

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
        has_neighbour = directions.adjacent[d] or directions.adjacent[before]
        is_alone = has_neighbour and not (directions.same[d] or directions.same[before])
        is_behind = beams.reach[k] > min(directions.reach[d], directions.limit[d]) + jump
        end = ends[count]
        end[0], end[1], end[2], end[3] = beams.x[k], beams.y[k], beams.reach[k], numbers.half_width
        end[4] = numbers.occupied * (ISOLATED_RELIABILITY if is_alone or is_behind else 1.0)
        count += 1
    return ends[:count]
