"""Street furniture: poles, signs, lamps, benches and other small pieces.

A piece has its origin at its base. Traffic approaches from +x, so the front of a sign faces +x. With right-hand traffic
the road is on the -y side, towards which lamps extend and shelters open.
"""

from collections.abc import Sequence

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import SUNK, Floats, Mesh, box, cylinder, loft, merge, quads, sheet, upright
from ogm.simulation.town.plants import bush


def pole(
    top: float,
    radius: float,
    material: M = M.METAL_POLE,
    at: Sequence[float] = (0, 0),
    end: float | None = None,
    sides: int = 6,
) -> Mesh:
    """Make an upright pole at x, y, sunk into the ground, with an optional other radius at its upper `end`."""
    return cylinder([*at, -SUNK], [*at, top], radius, material, end_radius=end, sides=sides)


def rod(
    low: float, high: float, radius: float, material: M, end: float | None = None, sides: int = 8, *, caps: bool = True
) -> Mesh:
    """Make an upright cylinder between two heights, or a cone with another radius at its upper `end`."""
    return cylinder([0, 0, low], [0, 0, high], radius, material, end_radius=end, sides=sides, caps=caps)


def block(center: ArrayLike, size: ArrayLike, material: M) -> Mesh:
    """Make a box around its middle."""
    center, half = np.asarray(center, np.float64), np.asarray(size, np.float64) / 2
    return box(center - half, center + half, material)


def extruded(profile: ArrayLike, ends: tuple[float, float], material: M, axis: int = 0) -> Mesh:
    """Make a prism from a profile (P, 2) of y, z between two x, or with ``axis=1`` of x, z between two y."""
    p = np.asarray(profile, np.float64)
    sections = [np.insert(p, axis, end, axis=1) for end in ends]
    return loft(sections, material, caps=material)


def panel(width: float, tall: float) -> Floats:
    """Return a rectangle's outline (4, 2) in y, z around the middle."""
    return 0.5 * np.array([[-width, -tall], [width, -tall], [width, tall], [-width, tall]])


def plate(outline: Floats, z: float, radius: float) -> list[Mesh]:
    """Make a plate in front of a pole of that radius: retroreflective towards +x, bare metal 2 cm behind."""
    fan = np.array([(0, k, k + 1) for k in range(1, len(outline) - 1)], np.uint32)
    parts = []
    for x, material in ((radius + 0.03, M.SIGN), (radius + 0.01, M.METAL_SHEET)):
        vertices = np.column_stack([np.full(len(outline), x), outline[:, 0], outline[:, 1] + z])
        parts.append(Mesh(vertices.astype(np.float32), fan, np.full(len(fan), material, np.uint8)))
    return parts


def strip(start: ArrayLike, end: ArrayLike, half: ArrayLike) -> Floats:
    """Return the corners (4, 3) of a flat bar between two points; `half` is the vector of its half width."""
    a, b, h = (np.asarray(v, np.float64) for v in (start, end, half))
    return np.stack([a - h, a + h, b + h, b - h])


def lamp(rng: Generator) -> Mesh:
    """Make a street lamp of 3.6 to 10 m: a tall one extends over the road, a low one has its head on top."""
    height = rng.uniform(3.6, 10.0)
    radius = rng.uniform(0.045, 0.06) + 0.003 * height
    parts = [pole(height, radius, end=0.6 * radius), pole(rng.uniform(0.4, 1.0), 1.5 * radius)]
    if height < 5.6:
        heads = (
            rod(height, height + 0.45, 0.14, M.CAR_GLASS, 0.2, 6),
            rod(height, height + 0.25, 0.3, M.METAL_POLE, 0.1),
            block([0, -0.2, height + 0.05], [0.2, 0.6, 0.1], M.METAL_SHEET),
        )
        return merge([*parts, heads[int(rng.integers(3))]])
    reach = rng.uniform(0.6, 2.2)
    tip = np.array([0, -reach, height + rng.uniform(0.0, 0.5)])
    arm = cylinder([0, 0, height], tip, 0.5 * radius, M.METAL_POLE, sides=5)
    return merge([*parts, arm, block(tip + [0, -0.25, 0], [0.28, 0.7, 0.12], M.METAL_SHEET)])


def traffic_light(rng: Generator) -> Mesh:
    """Make a signal post with one or two heads, some with a mast arm over the road above 4.7 m."""
    over = rng.random() < 0.4
    height = rng.uniform(5.6, 6.2) if over else rng.uniform(3.0, 3.6)
    radius = 0.09 if over else rng.uniform(0.05, 0.07)
    parts = [pole(height, radius), *_signal_head(np.array([0.16, 0.0, rng.uniform(2.15, 2.35)]))]
    if rng.random() < 0.6:  # for pedestrians
        parts.append(block([0.0, 0.2, 2.4], [0.2, 0.2, 0.5], M.PLASTIC_DARK))
    if rng.random() < 0.5:  # push button
        parts.append(block([0.0, radius + 0.05, 1.0], [0.1, 0.1, 0.2], M.PLASTIC_DARK))
    if over:
        reach = rng.uniform(2.5, 5.0)
        parts.append(cylinder([0, 0, height - 0.1], [0, -reach, height], 0.06, M.METAL_POLE, sides=5))
        parts += _signal_head(np.array([0.12, -reach + 0.2, height - 0.75]))
    return merge(parts)


def sign(rng: Generator) -> Mesh:
    """Make a traffic sign, SIGN in front and METAL_SHEET behind: disc, triangle, panel or signpost.

    It extends at most 0.6 m towards the road (-y).
    """
    kind = rng.random()
    radius = rng.uniform(0.03, 0.045)
    if kind < 0.12:  # a large board between two posts
        width, tall, low = rng.uniform(1.4, 2.8), rng.uniform(0.8, 1.8), rng.uniform(1.2, 2.0)
        middle = width / 2 - 0.45  # away from the road
        posts = [pole(low + tall, radius, at=(0, middle + y)) for y in (-0.35 * width, 0.35 * width)]
        return merge([*posts, *plate(panel(width, tall) + [middle, 0.0], low + tall / 2, radius)])
    if kind < 0.24:  # signpost with arms
        count, length = int(rng.integers(1, 4)), rng.uniform(0.9, 1.5)
        arrow = panel(length, 0.28) + [0.3 * length, 0.0]
        arms = [part for k in range(count) for part in plate(arrow, 2.35 + 0.32 * k, 0.045)]
        return merge([pole(2.3 + 0.32 * count, 0.045), *arms])
    quarter = np.pi / 2
    shapes = (
        *(_regular(0.3, 10), _regular(0.52, 3, quarter), _regular(0.52, 3, -quarter), _regular(0.45, 8, np.pi / 8)),
        *(panel(0.6, 0.6), panel(0.42, 0.63), _regular(0.42, 4), panel(0.25, 0.5)),
    )
    low = rng.uniform(2.0, 2.3) if rng.random() < 0.8 else rng.uniform(0.6, 1.0)
    parts, top = [], low
    for _ in range(1 + int(rng.random() < 0.3)):
        outline = shapes[int(rng.integers(8))] * rng.uniform(0.9, 1.1)
        half = np.abs(outline[:, 1]).max()
        parts += plate(outline, top + half, radius)
        top += 2 * half + 0.03
    if low > 1.5 and rng.random() < 0.3:
        parts += plate(panel(0.6, 0.3), low - 0.18, radius)
    return merge([pole(top, radius), *parts])


def bollard(rng: Generator) -> Mesh:
    """Make a bollard, 0.6 to 1.1 m high: a steel post, a stone stump, or a plastic post with a reflector."""
    height, kind = rng.uniform(0.6, 1.1), rng.random()
    if kind < 0.25:
        return pole(0.7 * height, rng.uniform(0.12, 0.2), M.STONE, end=0.11)
    if kind < 0.45:
        band = rod(height - 0.2, height - 0.08, 0.062, M.HIGH_VIS, sides=6, caps=False)
        return merge([pole(height, 0.06, M.PLASTIC_DARK), band])
    return pole(height, rng.uniform(0.035, 0.07))


def bin_(rng: Generator) -> Mesh:
    """Make a litter bin, or a group of wheelie bins."""
    kind = rng.random()
    if kind < 0.35:
        low = rng.uniform(0.35, 0.5)
        basket = cylinder([0.0, 0.18, low], [0.0, 0.18, low + 0.5], 0.17, M.METAL_SHEET, end_radius=0.2)
        return merge([pole(1.15, 0.035), basket])
    if kind < 0.6:
        radius = rng.uniform(0.2, 0.32)
        return rod(-0.1, rng.uniform(0.7, 1.1), radius, M.CONCRETE, 1.1 * radius)
    parts, x = [], 0.0
    for _ in range(int(rng.integers(1, 4))):
        half, deep, tall = (0.29, 0.36, 1.05) if rng.random() < 0.75 else (0.62, 0.5, 1.3)
        x += half
        profile = np.array([[-0.8, 0.0], [0.8, 0.0], [1.0, 0.92 * tall], [0.9, tall], [-1.0, tall]])
        profile = profile * [deep, 1.0] + [rng.normal(0, 0.05), 0.0]
        parts.append(extruded(profile, (x - half, x + half), M.PLASTIC_DARK))
        x += half + rng.uniform(0.03, 0.12)
    return merge(parts).moved(upright(-x / 2, 0.0, 0.0))


def bench(rng: Generator) -> Mesh:
    """Make a slatted bench along x that faces -y, with or without a back."""
    half = rng.uniform(0.75, 1.1)
    seats = [block([0, y, 0.45], [2 * half, 0.11, 0.04], M.WOOD) for y in (-0.17, 0.0, 0.17)]
    legs = [block([x, 0, 0.165], [0.07, 0.42, 0.53], M.METAL_POLE) for x in (-0.8 * half, 0.8 * half)]
    if rng.random() < 0.7:
        slats = [strip([-half, y, z], [half, y, z], [0, 0.01, 0.05]) for y, z in ((0.26, 0.62), (0.3, 0.78))]
        ends = [strip([x, 0.2, 0.4], [x, 0.31, 0.85], [0.03, 0, 0]) for x in (-half, half)]
        seats += [quads(slats, M.WOOD), quads(ends, M.WOOD)]
    return merge([*seats, *legs])


def bike_rack(rng: Generator) -> Mesh:
    """Make a row of 2 to 6 bicycle hoops along x, some with a bicycle."""
    count, parts = int(rng.integers(2, 7)), []
    hoop = np.array([[-0.38, -0.2], [-0.33, 0.8], [0.33, 0.8], [0.38, -0.2]])
    for k in range(count):
        x = (k - (count - 1) / 2) * 0.9
        parts.append(_tube(np.insert(hoop, 0, x, axis=1), 0.025, M.METAL_POLE))
        if k < 2 and rng.random() < 0.6:
            parts.append(_parked_bike(x + 0.1, rng.uniform(-0.2, 0.2)))
    return merge(parts)


def _parked_bike(x: float, y: float) -> Mesh:
    """Make a bicycle at a hoop from flat bars: two wheels, frame, saddle and handlebar."""
    angles = np.linspace(0, 2 * np.pi, 9)
    parts = []
    for cy in (-0.52, 0.52):
        inner, outer = (
            np.stack([0 * angles + x, y + cy + r * np.cos(angles), 0.34 + r * np.sin(angles)], 1) for r in (0.28, 0.34)
        )
        parts.append(sheet(inner, outer, M.TYRE))
    spots = [[0, -0.52, 0.34], [0, -0.15, 0.8], [0, 0.4, 0.85], [0, 0.0, 0.3], [0, 0.52, 0.34], [0, 0.4, 1.0]]
    s = np.array(spots) + [x, y, 0]
    links = [(0, 1), (1, 2), (1, 3), (2, 3), (0, 3), (2, 4), (2, 5)]
    frame = [strip(s[a], s[b], [0.012, 0.012, 0.012]) for a, b in links]
    frame.append(strip(s[5] - [0.28, 0, 0], s[5] + [0.28, 0, 0], [0, 0.015, 0.015]))
    frame.append(strip(s[1] + [0, -0.13, 0.12], s[1] + [0, 0.13, 0.12], [0.07, 0, 0]))
    return merge([*parts, quads(frame, M.PAINT_DARK)])


def cabinet(rng: Generator) -> Mesh:
    """Make a switchgear cabinet or letter box, 0.8 to 1.6 m high."""
    if rng.random() < 0.2:  # letter box, parking meter
        return merge([pole(0.9, 0.05), block([0, 0, 1.2], [0.3, 0.4, 0.6], M.PAINT_MEDIUM)])
    x, y, tall = rng.uniform(0.5, 1.7) / 2, rng.uniform(0.3, 0.5) / 2, rng.uniform(0.8, 1.5)
    plinth = box([-x + 0.02, -y + 0.02, -SUNK], [x - 0.02, y - 0.02, 0.2], M.CONCRETE)
    lid = box([-x - 0.04, -y - 0.04, tall], [x + 0.04, y + 0.04, tall + 0.05], M.METAL_SHEET)
    return merge([plinth, box([-x, -y, 0.2], [x, y, tall], M.PLASTER_DARK), lid])


def hydrant(rng: Generator) -> Mesh:
    """Make a pillar hydrant of 0.7 to 1 m."""
    height = rng.uniform(0.7, 1.0)
    arm = cylinder([0, -0.2, 0.65 * height], [0, 0.2, 0.65 * height], 0.06, M.PAINT_MEDIUM, sides=5)
    dome = rod(0.85 * height, height, 0.15, M.PAINT_MEDIUM, 0.05)
    return merge([pole(0.85 * height, 0.11, M.PAINT_MEDIUM), arm, dome])


def planter(rng: Generator) -> Mesh:
    """Make a round or square tub with a bush."""
    half, height = rng.uniform(0.3, 0.7), rng.uniform(0.4, 0.7)
    tub = rod(-0.1, height, 0.8 * half, M.CONCRETE, half)
    if rng.random() < 0.5:
        tub = box([-half, -half, -0.1], [half, half, height], M.WOOD)
    plant = bush(rng)
    size = min(1.0, half / np.abs(plant.vertices[:, :2]).max() * 1.2)
    lift = np.diag([size, size, size, 1.0])
    lift[2, 3] = height
    foliage = plant.material == M.FOLIAGE
    thinned = plant._replace(triangles=plant.triangles[foliage][::2], material=plant.material[foliage][::2])
    return merge([tub, thinned.moved(lift)])


def cone(rng: Generator) -> Mesh:
    """Make a traffic cone of 0.5 or 0.75 m with a reflective sleeve."""
    height = float(rng.choice([0.5, 0.75]))
    r = 0.2 * height
    base = block([0, 0, 0.02], [0.55 * height, 0.55 * height, 0.06], M.PLASTIC_DARK)
    rings = [(0.03, r), (0.4 * height, 0.72 * r), (0.75 * height, 0.42 * r), (height, 0.2 * r)]
    materials = (M.PAINT_MEDIUM, M.HIGH_VIS, M.PAINT_MEDIUM)
    sleeves = zip(rings[:-1], rings[1:], materials, strict=True)
    return merge([base, *(rod(a, b, ra, m, rb, 7, caps=False) for (a, ra), (b, rb), m in sleeves)])


def barrier(rng: Generator) -> Mesh:
    """Make a roadworks barrier along y: a fence with reflective boards, or a concrete block."""
    half = rng.uniform(0.9, 1.3)
    if rng.random() < 0.3:
        right = [[-0.3, -0.05], [0.3, -0.05], [0.3, 0.1], [0.1, 0.35], [0.08, 0.81], [-0.08, 0.81]]
        return extruded([*right, [-0.1, 0.35], [-0.3, 0.1]], (-half, half), M.CONCRETE, 1)
    parts = [pole(1.05, 0.025, at=(0, y), sides=4) for y in (-half, half)]
    for z in (0.95, 0.35):
        face = np.array([[0.04, -half, z], [0.04, half, z], [0.04, half, z - 0.2], [0.04, -half, z - 0.2]])
        parts.append(quads([face, face - [0.03, 0, 0]], [M.SIGN, M.METAL_SHEET]))
    parts += [box([-0.4, y - 0.1, -0.02], [0.4, y + 0.1, 0.1], M.PLASTIC_DARK) for y in (-half, half)]
    return merge(parts)


def cafe(rng: Generator) -> Mesh:
    """Make a café table with two or three chairs, often with a parasol."""
    parts = [rod(0.72, 0.75, rng.uniform(0.35, 0.5), M.WOOD), rod(-0.05, 0.72, 0.03, M.METAL_POLE, sides=4, caps=False)]
    turn = rng.uniform(0, 2 * np.pi)
    for k in range(int(rng.integers(2, 4))):
        a = turn + 2.1 * k
        out = np.array([np.cos(a), np.sin(a), 0.0])
        side, up = np.array([-out[1], out[0], 0.0]), np.array([0, 0, 1.0])
        p, w = 0.75 * out, 0.2 * side
        rear = [p - w + 0.2 * out, p + w + 0.2 * out]
        seat = [p - w - 0.2 * out, p + w - 0.2 * out, rear[1], rear[0]]
        back = [*rear, p + w + 0.26 * out + 0.45 * up, p - w + 0.26 * out + 0.45 * up]
        ends = [p + s * w + t * out for s in (-1, 1) for t in (-0.2, 0.2)]
        legs = [strip(end - 0.05 * up, end + 0.45 * up, 0.015 * (side + out)) for end in ends]
        parts.append(quads([np.array(seat) + 0.45 * up, np.array(back) + 0.45 * up, *legs], M.PLASTIC_DARK))
    if rng.random() < 0.5:
        parts.append(rod(0.7, 2.5, 0.025, M.METAL_POLE, sides=4, caps=False))
        parts.append(rod(2.2, 2.6, 1.4, M.TARPAULIN, 0.05, caps=False))
    return merge(parts)


def _signal_head(at: Floats) -> list[Mesh]:
    """Make a signal head of three lamps with its backing board; `at` is the middle of the lower edge."""
    square = np.array([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1.0]])
    body = block(at + [0, 0, 0.45], [0.2, 0.28, 0.9], M.PLASTIC_DARK)
    board = quads(at + [-0.06, 0, 0.45] + square * [1, 0.28, 0.6], M.PLASTIC_DARK)
    return [body, board, *(quads(at + [0.105, 0, z] + 0.1 * square, M.LAMP) for z in (0.16, 0.45, 0.74))]


def _regular(radius: float, sides: int, turn: float = 0.0) -> Floats:
    """Return a regular polygon (sides, 2) in y, z around the origin."""
    angles = turn + 2 * np.pi * np.arange(sides) / sides
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _tube(line: Floats, radius: float, material: M) -> Mesh:
    """Make a three-sided tube along a line in a plane of constant x."""
    ahead = np.gradient(line, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    out = np.cross([1.0, 0.0, 0.0], ahead)
    across = np.array([[1.0, 0.0, 0.0]])
    ring = [out, 0.87 * across - 0.5 * out, -0.87 * across - 0.5 * out]
    return loft(np.stack([line + radius * r for r in ring], axis=1), material)
