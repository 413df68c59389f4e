"""Larger structures in streets: fences, walls, shelters, containers, gantries and bridges.

For origins and axes see `ogm.simulation.town.furniture`.
"""

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import SUNK, Floats, Mesh, box, cylinder, loft, merge, quads, sheet, upright, wall
from ogm.simulation.town.furniture import block, extruded, panel, plate, pole, rod, strip
from ogm.simulation.town.plants import resampled


def fence(line: ArrayLike, rng: Generator) -> Mesh:
    """Build a fence: pickets, iron bars, welded mesh or rails with gaps for rays, or closed boards.

    Parameters
    ----------
    line : (M, 3) array
        Points on the ground along the fence [m], which follows their height.
    rng : Generator
        Generator of kind, height (0.8 to 2.2 m) and gaps.

    Returns
    -------
    Mesh
        At most 25 triangles per metre, and some for posts, in the line's frame.
    """
    kind = rng.random()
    if kind < 0.3:
        return _pickets(line, rng.uniform(0.8, 1.3), rng.uniform(0.13, 0.17), rng.uniform(0.07, 0.1))
    if kind < 0.55:
        return bars(line, rng.uniform(1.0, 2.0), rng.uniform(0.12, 0.15), rng.uniform(0.016, 0.025), M.METAL_POLE)
    if kind < 0.8:
        return _mesh_fence(line, rng.uniform(1.0, 2.2), rng)
    if kind < 0.9:
        return _rails(line, rng.uniform(0.9, 1.3))
    return _boards(line, rng.uniform(1.6, 2.0), M.WOOD)


def screen(line: ArrayLike, rng: Generator, material: M = M.WOOD) -> Mesh:
    """Build a closed fence of boards or metal sheets along a line (M, 3), 1.6 to 2.0 m high."""
    return _boards(line, rng.uniform(1.6, 2.0), material)


def low_wall(line: ArrayLike, rng: Generator, *, lowest: float = 0.4) -> Mesh:
    """Build a garden wall along a line (M, 3): `lowest` to 1.9 m high, 0.2 to 0.4 m thick, some with a coping."""
    points, side = resampled(line, 3.0)
    material = rng.choice([M.BRICK, M.STONE, M.CONCRETE, M.PLASTER_LIGHT])
    low = lowest < 1.0 and rng.random() < 0.6
    height = rng.uniform(lowest, 1.0) if low else rng.uniform(max(lowest, 1.4), 1.9)
    half = rng.uniform(0.1, 0.2)
    edge, down, up = half * side, np.array([0, 0, 2 * SUNK]), np.array([0, 0, height])
    shape = [points - edge - down, points + edge - down, points + edge + up, points - edge + up]
    parts = [loft(np.stack(shape, axis=1), material, caps=material)]
    if rng.random() < 0.5:
        wide, lid = (half + 0.05) * side, up + [0, 0, 0.08]
        cap = [points - wide + up, points + wide + up, points + wide + lid, points - wide + lid]
        parts.append(loft(np.stack(cap, axis=1), M.STONE, caps=M.STONE))
    return merge(parts)


def guard_rail(line: ArrayLike) -> Mesh:
    """Make a guard rail: a W-shaped beam 0.45 to 0.75 m above the points of a line (M, 3), on posts.

    Returns
    -------
    Mesh
        About 8 triangles per metre, at most 0.2 m thick.
    """
    points, side = resampled(line, 2.0)
    profile = [(0.0, 0.44), (0.08, 0.52), (0.0, 0.6), (0.08, 0.68), (0.0, 0.76)]
    rails = [points + y * side + [0, 0, z] for y, z in profile]
    beam = [sheet(a, b, M.METAL_SHEET) for a, b in zip(rails[:-1], rails[1:], strict=True)]
    base = points - 0.05 * side
    ahead = np.stack([side[:, 1], -side[:, 0], side[:, 2]], axis=1)
    posts = [_uprights(base, -SUNK, 0.72, 0.05 * ahead), _uprights(base, -SUNK, 0.72, 0.06 * side)]
    return merge([*beam, quads(np.concatenate(posts), M.METAL_POLE)])


def _uprights(base: Floats, low: float, high: float, half: Floats) -> Floats:
    """Return the corners (N, 4, 3) of upright flat bars at feet (N, 3), with half widths `half` (N, 3)."""
    a, b = base + [0, 0, low], base + [0, 0, high]
    return np.stack([a - half, a + half, b + half, b - half], axis=1)


def _crossed(base: Floats, side: Floats, high: float, radius: float) -> Floats:
    """Return posts of two crossed upright bars each, visible from all directions."""
    ahead = np.stack([side[:, 1], -side[:, 0], side[:, 2]], axis=1)
    return np.concatenate([_uprights(base, -SUNK, high, radius * (ahead + s * side)) for s in (-1, 1)])


def _along(line: ArrayLike, spacing: float) -> tuple[Floats, Floats]:
    """Return the middles of segments of a line, and the unit directions of the line there."""
    points, side = resampled(line, spacing)
    middles = (points[1:] + points[:-1]) / 2
    mean = (side[1:] + side[:-1]) / 2
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    return middles, np.stack([mean[:, 1], -mean[:, 0], mean[:, 2]], axis=1)


def _between(points: Floats, z: float, half: float) -> Floats:
    """Return horizontal bars (N - 1, 4, 3) between consecutive points, upright faces around height z."""
    low, high = points + [0, 0, z - half], points + [0, 0, z + half]
    return np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)


def _pickets(line: ArrayLike, height: float, spacing: float, width: float) -> Mesh:
    """Build a wooden fence of upright laths."""
    feet, ahead = _along(line, spacing)
    points, side = resampled(line, 2.4)
    laths = _uprights(feet, 0.06, height, 0.5 * width * ahead)
    rails = [_between(points - 0.04 * side, z * height, 0.035) for z in (0.25, 0.8)]
    return quads(np.concatenate([laths, *rails, _crossed(points - 0.06 * side, side, height, 0.035)]), M.WOOD)


def bars(line: ArrayLike, height: float, spacing: float, width: float, material: M) -> Mesh:
    """Build a fence of upright iron bars between two rails; the orientation of the flat bars alternates."""
    feet, ahead = _along(line, spacing)
    points, side = resampled(line, 2.4)
    turn = (-1.0) ** np.arange(len(feet))[:, None]
    left = np.stack([-ahead[:, 1], ahead[:, 0], ahead[:, 2]], axis=1)
    bars = _uprights(feet, 0.08, height, 0.35 * width * (ahead + turn * left) * 1.4)
    rails = [_between(points, z, 0.02) for z in (0.12, height - 0.1)]
    return quads(np.concatenate([bars, *rails, _crossed(points, side, height, 0.03)]), material)


def _mesh_fence(line: ArrayLike, height: float, rng: Generator) -> Mesh:
    """Build a fence of welded mesh with every fourth wire, 8 to 12 mm thick to compensate."""
    points, side = resampled(line, 2.5)
    feet, ahead = _along(line, rng.uniform(0.2, 0.3))
    wires = [_between(points, z, rng.uniform(0.005, 0.008)) for z in np.arange(0.08, height, 0.16)]
    rods = _uprights(feet, 0.05, height, 0.005 * ahead)
    return quads(np.concatenate([*wires, rods, _crossed(points, side, height, 0.028)]), M.METAL_POLE)


def _rails(line: ArrayLike, height: float) -> Mesh:
    """Build a paddock fence: two or three broad rails on posts."""
    points, side = resampled(line, 2.2)
    rails = [_between(points + 0.05 * side, z * height, 0.06) for z in (0.35, 0.65, 0.95)]
    return quads(np.concatenate([*rails, _crossed(points, side, height, 0.05)]), M.WOOD)


def _boards(line: ArrayLike, height: float, material: M) -> Mesh:
    """Build a closed screen of boards with alternating offsets."""
    feet, ahead = _along(line, 0.2)
    points, side = resampled(line, 2.0)
    turn = 0.02 * (-1.0) ** np.arange(len(feet))[:, None]
    left = np.stack([-ahead[:, 1], ahead[:, 0], ahead[:, 2]], axis=1)
    boards = _uprights(feet + turn * left, 0.04, height, 0.105 * ahead)
    return quads(np.concatenate([boards, _crossed(points, side, height, 0.045)]), material)


OVER_ROAD = 4.7  # [m] smallest height of structures over a carriageway


def shelter(rng: Generator) -> Mesh:
    """Make a bus shelter along x, open to -y: posts, roof, glass panes, seat, stop sign."""
    length, depth, height = rng.uniform(3.0, 5.0), rng.uniform(1.3, 1.7), rng.uniform(2.45, 2.7)
    half = length / 2
    roof = box([-half - 0.1, -0.35, height], [half + 0.1, depth + 0.05, height + 0.12], M.METAL_SHEET)
    spots = [(-half, depth), (half, depth), (0.0, depth), (-half, 0.0), (half, 0.0)]
    posts = [pole(height, 0.04, at=spot, sides=4) for spot in spots]
    glass = M.CAR_GLASS if rng.random() < 0.8 else M.WOOD
    back = [[-half, depth, 0.15], [half, depth, 0.15], [half, depth, 2.2], [-half, depth, 2.2]]
    side = [[-half, 0.1, 0.15], [-half, depth, 0.15], [-half, depth, 2.2], [-half, 0.1, 2.2]]
    seat = box([-0.35 * length, depth - 0.5, 0.42], [0.2 * length, depth - 0.12, 0.48], M.WOOD)
    poster = box([half - 0.06, 0.1, 0.25], [half + 0.06, depth - 0.1, 2.1], M.WINDOW)
    stop = merge([pole(2.6, 0.035), *plate(panel(0.45, 0.45), 2.35, 0.035)]).moved(upright(half + 1.0, -0.2, 0.0))
    return merge([roof, *posts, quads([back, side], glass), seat, poster, stop])


def advert_column(rng: Generator) -> Mesh:
    """Make a round advertising column, 1.1 to 1.4 m across, or an upright illuminated panel."""
    if rng.random() < 0.5:
        radius, height = rng.uniform(0.55, 0.7), rng.uniform(2.7, 3.6)
        shaft = rod(-SUNK, height, radius, M.PLASTER_LIGHT, sides=14)
        return merge([shaft, rod(height, height + 0.35, radius + 0.12, M.ROOF, 0.1, 14)])
    base = box([-0.08, -0.2, -SUNK], [0.08, 0.2, 0.6], M.METAL_SHEET)
    return merge([base, box([-0.11, -0.66, 0.6], [0.11, 0.66, 2.6], M.WINDOW)])


def container(rng: Generator) -> Mesh:
    """Make a ribbed shipping or site container along x, 3 to 12 m long."""
    half = float(rng.choice([1.5, 3.03, 3.03, 6.1]))
    x = np.linspace(-half, half, int(half / 0.3) + 2)
    y = 1.22 - 0.04 * (np.arange(len(x)) % 2)
    sides: list[ArrayLike] = [np.stack([x, s * y, 0.05 + 0 * x], axis=1) for s in (-1, 1)]
    sides += [[[s * half, -1.2, 0.05], [s * half, 1.2, 0.05]] for s in (-1, 1)]
    walls = [wall(line, 2.5, M.METAL_SHEET, depth=0.15) for line in sides]
    return merge([*walls, box([-half, -1.22, 2.5], [half, 1.22, 2.6], M.METAL_SHEET)])


def skip(rng: Generator) -> Mesh:
    """Make an open skip along x, loaded with rubble."""
    long, high = rng.uniform(1.5, 2.0), rng.uniform(1.0, 1.5)
    low, top = [[-0.65, 0.1], [0.65, 0.1]], [[1.0, 0.6 * high], [1.0, high], [-1.0, high], [-1.0, 0.6 * high]]
    body = extruded(np.array(low + top) * [long, 1.0], (-0.9, 0.9), M.METAL_SHEET, 1)
    base = box([-0.6 * long, -0.7, -0.1], [0.6 * long, 0.7, 0.1], M.METAL_SHEET)
    return merge([body, base, rod(high, high + rng.uniform(0.1, 0.5), 0.8, M.CONCRETE, 0.2, 7)])


def monument(rng: Generator) -> Mesh:
    """Make a fountain, or a statue on a pedestal, for the middle of a square or park."""
    if rng.random() < 0.5:
        radius = rng.uniform(1.5, 3.0)
        rim = rod(-SUNK, 0.5, radius, M.STONE, sides=14, caps=False)
        inner = rod(0.1, 0.5, radius - 0.25, M.STONE, sides=14)
        return merge([rim, inner, pole(1.6, 0.25, M.STONE), rod(1.5, 1.7, 0.3, M.STONE, 0.8)])
    steps = ((0.05, 2.6, 0.5), (0.4, 1.8, 0.4), (1.3, 1.0, 1.6))  # middle, width, height
    parts = [block([0, 0, z], [width, width, tall], M.STONE) for z, width, tall in steps]
    return merge([*parts, rod(2.1, 3.3, 0.3, M.STONE, 0.35, 6), rod(3.3, 3.75, 0.18, M.STONE, 0.1, 6)])


def gantry(width: float, rng: Generator) -> Mesh:
    """Make a gantry of a given width [m] along y over a road, with signs above 4.7 m; origin in the road's middle.

    The posts are at ``y = ±width / 2``.
    """
    half, z = width / 2, rng.uniform(6.0, 6.6)
    posts = [pole(z + 0.4, 0.14, at=(0, y), sides=8) for y in (-half, half)]
    beams = [cylinder([0, -half, h], [0, half, h], 0.07, M.METAL_POLE, sides=5, caps=False) for h in (z - 0.3, z + 0.3)]
    ends = np.linspace(-half, half, int(width / 1.2) + 2)
    zigzag = z + 0.3 * (-1.0) ** np.arange(len(ends))
    lattice = np.stack([0 * ends, ends, zigzag], axis=1)
    braces = [strip(a, b, [0.0, 0.03, 0.03]) for a, b in zip(lattice[:-1], lattice[1:], strict=True)]
    parts = [*posts, *beams, quads(braces, M.METAL_POLE)]
    count = max(int(width / 4.5), 1)
    for k in range(count):
        y, tall = -half + (k + 0.5) * width / count, rng.uniform(1.0, 1.9)
        board = panel(rng.uniform(1.2, 3.4), tall) + [y, 0.0]
        parts += plate(board, max(z, OVER_ROAD + 0.1 + tall / 2), 0.08)
    return merge(parts)


def bridge(length: float, width: float, rng: Generator) -> Mesh:
    """Build a bridge along y, `length` from end to end [m], over a road along x.

    Parameters
    ----------
    length, width : float
        Length along y between the outer ends of the abutments; width of the deck along x [m].
    rng : Generator
        Generator of the clearance (4.7 to 5.5 m above the origin).

    Returns
    -------
    Mesh
        Mesh with its origin in the middle of the road below. The abutments are 1.2 m thick, at ``|y| = length / 2``.
    """
    half, side, clear = length / 2, width / 2, rng.uniform(OVER_ROAD, 5.5)
    depth = 0.35 + length / 40
    girders = np.linspace(-side + 0.4, side - 0.4, max(int(width / 2.5) + 1, 2))
    parts = [block([x, 0, clear + depth / 2], [0.4, length, depth], M.CONCRETE) for x in girders]
    top = clear + depth + 0.25
    parts.append(box([-side, -half, clear + depth], [side, half, top], M.CONCRETE))
    for y in (-1, 1):
        lower, upper = sorted((y * (half - 1.2), y * (half + 0.3)))
        parts.append(box([-side - 0.3, lower, -1.5], [side + 0.3, upper, clear], M.CONCRETE))
    for x in (-side + 0.1, side - 0.1):
        edge = np.array([[x, -half, top], [x, half, top]])
        parts.append(bars(edge, 1.1, max(0.15, length / 120), 0.02, M.METAL_POLE))
        parts.append(block([x, 0, top + 0.05], [0.25, length, 0.3], M.CONCRETE))
    return merge(parts)
