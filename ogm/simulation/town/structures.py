"""Larger things in streets: shelters, containers, monuments, and what spans a road.

Origins and axes are those of `ogm.simulation.town.furniture`.
"""

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Mesh, box, cylinder, merge, quads, wall
from ogm.simulation.town.fences import bars
from ogm.simulation.town.shapes import SUNK, block, extruded, panel, plate, pole, rod, strip, upright

OVER_ROAD = 4.7  # [m] everything that hangs over a carriageway is higher than this


def shelter(rng: Generator) -> Mesh:
    """Make a bus shelter along x, open to -y: posts, roof, panes that let rays through, seat, stop sign."""
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
    """Make a round column for posters, 1.1 to 1.4 m across, or an upright illuminated panel."""
    if rng.random() < 0.5:
        radius, height = rng.uniform(0.55, 0.7), rng.uniform(2.7, 3.6)
        shaft = rod(-SUNK, height, radius, M.PLASTER_LIGHT, sides=14)
        return merge([shaft, rod(height, height + 0.35, radius + 0.12, M.ROOF, 0.1, 14)])
    base = box([-0.08, -0.2, -SUNK], [0.08, 0.2, 0.6], M.METAL_SHEET)
    return merge([base, box([-0.11, -0.66, 0.6], [0.11, 0.66, 2.6], M.WINDOW)])


def container(rng: Generator) -> Mesh:
    """Make a shipping or site container along x, 3 to 12 m long, ribbed."""
    half = float(rng.choice([1.5, 3.03, 3.03, 6.1]))
    x = np.linspace(-half, half, int(half / 0.3) + 2)
    y = 1.22 - 0.04 * (np.arange(len(x)) % 2)
    sides: list[ArrayLike] = [np.stack([x, s * y, 0.05 + 0 * x], axis=1) for s in (-1, 1)]
    sides += [[[s * half, -1.2, 0.05], [s * half, 1.2, 0.05]] for s in (-1, 1)]
    walls = [wall(line, 2.5, M.METAL_SHEET, depth=0.15) for line in sides]
    return merge([*walls, box([-half, -1.22, 2.5], [half, 1.22, 2.6], M.METAL_SHEET)])


def skip(rng: Generator) -> Mesh:
    """Make an open skip for rubble along x, with its load."""
    long, high = rng.uniform(1.5, 2.0), rng.uniform(1.0, 1.5)
    low, top = [[-0.65, 0.1], [0.65, 0.1]], [[1.0, 0.6 * high], [1.0, high], [-1.0, high], [-1.0, 0.6 * high]]
    body = extruded(np.array(low + top) * [long, 1.0], (-0.9, 0.9), M.METAL_SHEET, 1)
    base = box([-0.6 * long, -0.7, -0.1], [0.6 * long, 0.7, 0.1], M.METAL_SHEET)
    return merge([body, base, rod(high, high + rng.uniform(0.1, 0.5), 0.8, M.CONCRETE, 0.2, 7)])


def monument(rng: Generator) -> Mesh:
    """Make the middle of a square or park: a fountain's basin, or a statue on its pedestal."""
    if rng.random() < 0.5:
        radius = rng.uniform(1.5, 3.0)
        rim = rod(-SUNK, 0.5, radius, M.STONE, sides=14, caps=False)
        inner = rod(0.1, 0.5, radius - 0.25, M.STONE, sides=14)
        return merge([rim, inner, pole(1.6, 0.25, M.STONE), rod(1.5, 1.7, 0.3, M.STONE, 0.8)])
    steps = ((0.05, 2.6, 0.5), (0.4, 1.8, 0.4), (1.3, 1.0, 1.6))  # middle, width, height
    parts = [block([0, 0, z], [width, width, tall], M.STONE) for z, width, tall in steps]
    return merge([*parts, rod(2.1, 3.3, 0.3, M.STONE, 0.35, 6), rod(3.3, 3.75, 0.18, M.STONE, 0.1, 6)])


def gantry(width: float, rng: Generator) -> Mesh:
    """Span a gantry across a road (along y) of that width [m], with signs above 4.7 m; origin at the road's middle.

    The posts stand at ``y = ±width / 2``.
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
    """Build a bridge over a road that runs along x: its own way runs along y, `length` from end to end [m].

    Parameters
    ----------
    length, width : float
        Span along y between the abutments' outer ends; size of the deck along x [m].
    rng : Generator
        Chooses the clearance (4.7 to 5.5 m above the origin).

    Returns
    -------
    Mesh
        Origin in the middle of the road below. The abutments are 1.2 m thick, at ``|y| = length / 2``.
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
