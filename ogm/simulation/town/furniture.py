"""What stands in streets besides houses and plants: poles, signs, shelters, fences, things that span a road.

A piece has its origin at its foot. Traffic comes towards it from +x, so that a sign's front looks along +x; with
right-hand traffic the road then lies on its -y side, where lamps reach out to and shelters open to. Pieces of a
line stand on the line's points, whichever frame these are in.
"""

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from ogm.simulation.arrays import Floats
from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Mesh, box, cylinder, loft, merge, quads, sheet, wall
from ogm.simulation.town.fences import bars
from ogm.simulation.town.plants import bush

SUNK = 0.3  # [m] feet reach this far into the ground, so that they stand on a slope as well
OVER_ROAD = 4.7  # [m] everything that hangs over a carriageway is higher than this


def lamp(rng: Generator) -> Mesh:
    """Make a street lamp of 4 to 10 m: a tall one reaches over the road, a low one carries a head on its top."""
    height = rng.uniform(3.6, 10.0)
    radius = rng.uniform(0.045, 0.06) + 0.003 * height
    pole = _pole(height, radius, end_radius=0.6 * radius)
    base = _pole(rng.uniform(0.4, 1.0), 1.5 * radius)
    if height < 5.6:
        head = [
            lambda: cylinder(
                [0, 0, height], [0, 0, height + 0.45], 0.14, M.CAR_GLASS, end_radius=0.2, sides=6
            ),
            lambda: cylinder(
                [0, 0, height], [0, 0, height + 0.25], 0.3, M.METAL_POLE, end_radius=0.1, sides=8
            ),
            lambda: _centred_box([0, -0.2, height + 0.05], [0.2, 0.6, 0.1], M.METAL_SHEET),
        ][int(rng.integers(3))]()
        return merge([pole, base, head])
    reach = rng.uniform(0.6, 2.2)
    tip = np.array([0, -reach, height + rng.uniform(0.0, 0.5)])
    arm = cylinder([0, 0, height], tip, 0.5 * radius, M.METAL_POLE, sides=5)
    head = _centred_box(tip + [0, -0.25, 0], [0.28, 0.7, 0.12], M.METAL_SHEET)
    return merge([pole, base, arm, head])


def traffic_light(rng: Generator) -> Mesh:
    """Make a signal post with one or two heads; some reach over the road with a mast arm above 4.7 m."""
    parts = []
    over = rng.random() < 0.4
    height = rng.uniform(5.6, 6.2) if over else rng.uniform(3.0, 3.6)
    radius = 0.09 if over else rng.uniform(0.05, 0.07)
    parts.append(_pole(height, radius))
    parts += _signal_head(np.array([0.16, 0.0, rng.uniform(2.15, 2.35)]))
    if rng.random() < 0.6:  # for pedestrians
        parts.append(_centred_box([0.0, 0.2, 2.4], [0.2, 0.2, 0.5], M.PLASTIC_DARK))
    if rng.random() < 0.5:
        parts.append(_centred_box([0.0, radius + 0.05, 1.0], [0.1, 0.1, 0.2], M.PLASTIC_DARK))  # push button
    if over:
        reach = rng.uniform(2.5, 5.0)
        parts.append(cylinder([0, 0, height - 0.1], [0, -reach, height], 0.06, M.METAL_POLE, sides=5))
        parts += _signal_head(np.array([0.12, -reach + 0.2, height - 0.75]))
    return merge(parts)


def sign(rng: Generator) -> Mesh:
    """Make a traffic sign: SIGN on the front, METAL_SHEET behind; discs, triangles, panels, signposts.

    It reaches no further than 0.6 m towards the road (-y).
    """
    kind = rng.random()
    radius = rng.uniform(0.03, 0.045)
    if kind < 0.12:  # a large board between two posts
        width, tall, low = rng.uniform(1.4, 2.8), rng.uniform(0.8, 1.8), rng.uniform(1.2, 2.0)
        middle = width / 2 - 0.45  # away from the road
        posts = [_pole(low + tall, radius, y=middle + y) for y in (-0.35 * width, 0.35 * width)]
        return merge([*posts, *_plate(_panel(width, tall) + [middle, 0.0], low + tall / 2, radius)])
    if kind < 0.24:  # arms that point to places, on one post
        count, length = int(rng.integers(1, 4)), rng.uniform(0.9, 1.5)
        parts = [_pole(2.3 + 0.32 * count, 0.045)]
        for k in range(count):
            arrow = _panel(length, 0.28) + [0.3 * length, 0.0]
            parts += _plate(arrow, 2.35 + 0.32 * k, 0.045)
        return merge(parts)
    shapes = (
        _round(0.3, 10),
        _round(0.52, 3, np.pi / 2),
        _round(0.52, 3, -np.pi / 2),
        _round(0.45, 8, np.pi / 8),
    )
    more = (_panel(0.6, 0.6), _panel(0.42, 0.63), _round(0.42, 4, 0.0), _panel(0.25, 0.5))
    low = rng.uniform(2.0, 2.3) if rng.random() < 0.8 else rng.uniform(0.6, 1.0)
    parts, top = [], low
    for _ in range(1 + int(rng.random() < 0.3)):
        plate = (shapes + more)[int(rng.integers(8))] * rng.uniform(0.9, 1.1)
        half = np.abs(plate[:, 1]).max()
        parts += _plate(plate, top + half, radius)
        top += 2 * half + 0.03
    if low > 1.5 and rng.random() < 0.3:
        parts += _plate(_panel(0.6, 0.3), low - 0.18, radius)
    return merge([_pole(top, radius), *parts])


def bollard(rng: Generator) -> Mesh:
    """Make a bollard, 0.6 to 1.1 m high: a steel post, a stone stump, or a plastic one with a reflector."""
    height, kind = rng.uniform(0.6, 1.1), rng.random()
    if kind < 0.25:
        return _pole(0.7 * height, rng.uniform(0.12, 0.2), M.STONE, end_radius=0.11)
    if kind < 0.45:
        band = cylinder([0, 0, height - 0.2], [0, 0, height - 0.08], 0.062, M.HIGH_VIS, sides=6, caps=False)
        return merge([_pole(height, 0.06, M.PLASTIC_DARK), band])
    return _pole(height, rng.uniform(0.035, 0.07))


def bin_(rng: Generator) -> Mesh:
    """Make a litter bin, or a group of wheelie bins."""
    kind = rng.random()
    if kind < 0.35:
        low = rng.uniform(0.35, 0.5)
        basket = cylinder([0.0, 0.18, low], [0.0, 0.18, low + 0.5], 0.17, M.METAL_SHEET, end_radius=0.2)
        return merge([_pole(1.15, 0.035), basket])
    if kind < 0.6:
        radius = rng.uniform(0.2, 0.32)
        return cylinder(
            [0, 0, -0.1], [0, 0, rng.uniform(0.7, 1.1)], radius, M.CONCRETE, end_radius=1.1 * radius
        )
    parts = []
    x = 0.0
    for _ in range(int(rng.integers(1, 4))):
        half, deep, tall = (0.29, 0.36, 1.05) if rng.random() < 0.75 else (0.62, 0.5, 1.3)
        x += half
        profile = np.array([[-0.8, 0.0], [0.8, 0.0], [1.0, 0.92 * tall], [0.9, tall], [-1.0, tall]])
        turned = rng.normal(0, 0.05)
        left, right = (
            np.stack([x + s * half + 0 * profile[:, 0], deep * profile[:, 0] + turned, profile[:, 1]], axis=1)
            for s in (-1, 1)
        )
        parts.append(loft([left, right], M.PLASTIC_DARK, caps=M.PLASTIC_DARK))
        x += half + rng.uniform(0.03, 0.12)
    centred = np.eye(4)
    centred[0, 3] = -x / 2
    return merge(parts).moved(centred)


def shelter(rng: Generator) -> Mesh:
    """Make a bus shelter along x, open to -y: posts, roof, panes that let rays through, seat, stop sign."""
    length, depth, height = rng.uniform(3.0, 5.0), rng.uniform(1.3, 1.7), rng.uniform(2.45, 2.7)
    half = length / 2
    roof = box([-half - 0.1, -0.35, height], [half + 0.1, depth + 0.05, height + 0.12], M.METAL_SHEET)
    spots = [(-half, depth), (half, depth), (0.0, depth), (-half, 0.0), (half, 0.0)]
    posts = [_pole(height, 0.04, x=x, y=y, sides=4) for x, y in spots]
    glass = M.CAR_GLASS if rng.random() < 0.8 else M.WOOD
    pane = np.array([[-half, depth, 0.15], [half, depth, 0.15], [half, depth, 2.2], [-half, depth, 2.2]])
    side = np.array([[-half, 0.1, 0.15], [-half, depth, 0.15], [-half, depth, 2.2], [-half, 0.1, 2.2]])
    seat = box([-0.35 * length, depth - 0.5, 0.42], [0.2 * length, depth - 0.12, 0.48], M.WOOD)
    poster = box([half - 0.06, 0.1, 0.25], [half + 0.06, depth - 0.1, 2.1], M.WINDOW)
    stop = _stop_sign(half + 1.0, -0.2)
    return merge([roof, *posts, quads([pane, side], glass), seat, poster, stop])


def _stop_sign(x: float, y: float) -> Mesh:
    """Make the sign of a bus stop beside its shelter."""
    shift = np.eye(4)
    shift[:2, 3] = x, y
    return merge([_pole(2.6, 0.035), *_plate(_panel(0.45, 0.45), 2.35, 0.035)]).moved(shift)


def advert_column(rng: Generator) -> Mesh:
    """Make a round column for posters, 1.1 to 1.4 m across, or an upright illuminated panel."""
    if rng.random() < 0.5:
        radius, height = rng.uniform(0.55, 0.7), rng.uniform(2.7, 3.6)
        shaft = cylinder([0, 0, -SUNK], [0, 0, height], radius, M.PLASTER_LIGHT, sides=14)
        cap = cylinder([0, 0, height], [0, 0, height + 0.35], radius + 0.12, M.ROOF, end_radius=0.1, sides=14)
        return merge([shaft, cap])
    foot = box([-0.08, -0.2, -SUNK], [0.08, 0.2, 0.6], M.METAL_SHEET)
    return merge([foot, box([-0.11, -0.66, 0.6], [0.11, 0.66, 2.6], M.WINDOW)])


def bench(rng: Generator) -> Mesh:
    """Make a bench of slats along x that looks to -y, with or without a back."""
    half = rng.uniform(0.75, 1.1)
    seats = [_centred_box([0, y, 0.45], [2 * half, 0.11, 0.04], M.WOOD) for y in (-0.17, 0.0, 0.17)]
    legs = [_centred_box([x, 0, 0.165], [0.07, 0.42, 0.53], M.METAL_POLE) for x in (-0.8 * half, 0.8 * half)]
    if rng.random() < 0.7:
        slats = [_strip([-half, y, z], [half, y, z], [0, 0.01, 0.05]) for y, z in ((0.26, 0.62), (0.3, 0.78))]
        seats.append(quads(slats, M.WOOD))
        seats.append(
            quads([_strip([x, 0.2, 0.4], [x, 0.31, 0.85], [0.03, 0, 0]) for x in (-half, half)], M.WOOD)
        )
    return merge([*seats, *legs])


def bike_rack(rng: Generator) -> Mesh:
    """Make a row of 2 to 6 hoops along x; a few hold a bicycle's frame and wheels."""
    count, parts = int(rng.integers(2, 7)), []
    hoop = np.array([[-0.38, -0.2], [-0.33, 0.8], [0.33, 0.8], [0.38, -0.2]])
    for k in range(count):
        x = (k - (count - 1) / 2) * 0.9
        parts.append(
            _tube(np.stack([x + 0 * hoop[:, 0], hoop[:, 0], hoop[:, 1]], axis=1), 0.025, M.METAL_POLE)
        )
        if k < 2 and rng.random() < 0.6:
            parts.append(_parked_bike(x + 0.1, rng.uniform(-0.2, 0.2)))
    return merge(parts)


def cabinet(rng: Generator) -> Mesh:
    """Make a box for switchgear or the mail, 0.7 to 1.6 m high."""
    if rng.random() < 0.2:  # letter box, parking meter
        return merge([_pole(0.9, 0.05), _centred_box([0, 0, 1.2], [0.3, 0.4, 0.6], M.PAINT_MEDIUM)])
    wide, deep, tall = rng.uniform(0.5, 1.7), rng.uniform(0.3, 0.5), rng.uniform(0.8, 1.5)
    plinth = box(
        [-wide / 2 + 0.02, -deep / 2 + 0.02, -SUNK], [wide / 2 - 0.02, deep / 2 - 0.02, 0.2], M.CONCRETE
    )
    body = box([-wide / 2, -deep / 2, 0.2], [wide / 2, deep / 2, tall], M.PLASTER_DARK)
    lid = box(
        [-wide / 2 - 0.04, -deep / 2 - 0.04, tall],
        [wide / 2 + 0.04, deep / 2 + 0.04, tall + 0.05],
        M.METAL_SHEET,
    )
    return merge([plinth, body, lid])


def hydrant(rng: Generator) -> Mesh:
    """Make a pillar hydrant of 0.7 to 1 m."""
    height = rng.uniform(0.7, 1.0)
    arm = cylinder([0, -0.2, 0.65 * height], [0, 0.2, 0.65 * height], 0.06, M.PAINT_MEDIUM, sides=5)
    dome = cylinder([0, 0, 0.85 * height], [0, 0, height], 0.15, M.PAINT_MEDIUM, end_radius=0.05)
    return merge([_pole(0.85 * height, 0.11, M.PAINT_MEDIUM), arm, dome])


def planter(rng: Generator) -> Mesh:
    """Make a tub, round or square, with a bush in it."""
    half, height = rng.uniform(0.3, 0.7), rng.uniform(0.4, 0.7)
    tub = cylinder([0, 0, -0.1], [0, 0, height], 0.8 * half, M.CONCRETE, end_radius=half, sides=8)
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
    """Make a traffic cone of 0.5 or 0.75 m with its reflecting sleeve."""
    height = float(rng.choice([0.5, 0.75]))
    r = 0.2 * height
    foot = _centred_box([0, 0, 0.02], [0.55 * height, 0.55 * height, 0.06], M.PLASTIC_DARK)
    rings = [(0.03, r), (0.4 * height, 0.72 * r), (0.75 * height, 0.42 * r), (height, 0.2 * r)]
    parts = [
        cylinder([0, 0, a], [0, 0, b], ra, m, end_radius=rb, sides=7, caps=False)
        for (a, ra), (b, rb), m in zip(
            rings[:-1], rings[1:], (M.PAINT_MEDIUM, M.HIGH_VIS, M.PAINT_MEDIUM), strict=True
        )
    ]
    return merge([foot, *parts])


def barrier(rng: Generator) -> Mesh:
    """Make a barrier of road works across the way (along y): a fence with reflecting boards, or a concrete block."""
    half = rng.uniform(0.9, 1.3)
    if rng.random() < 0.3:
        profile = np.array(
            [[-0.3, -0.05], [0.3, -0.05], [0.3, 0.1], [0.1, 0.35], [0.08, 0.81], [-0.08, 0.81]]
        )
        profile = np.vstack([profile, [[-0.1, 0.35], [-0.3, 0.1]]])
        ends = [
            np.stack([profile[:, 0], y + 0 * profile[:, 0], profile[:, 1]], axis=1) for y in (-half, half)
        ]
        return loft(ends, M.CONCRETE, caps=M.CONCRETE)
    parts = [_pole(1.05, 0.025, y=y, sides=4) for y in (-half, half)]
    for z in (0.95, 0.35):
        face = np.array([[0.04, -half, z], [0.04, half, z], [0.04, half, z - 0.2], [0.04, -half, z - 0.2]])
        parts.append(quads([face, face - [0.03, 0, 0]], [M.SIGN, M.METAL_SHEET]))
    for y in (-half, half):
        parts.append(box([-0.4, y - 0.1, -0.02], [0.4, y + 0.1, 0.1], M.PLASTIC_DARK))
    return merge(parts)


def container(rng: Generator) -> Mesh:
    """Make a shipping or site container along x, 3 to 12 m long, ribbed."""
    half = float(rng.choice([1.5, 3.03, 3.03, 6.1]))
    x = np.linspace(-half, half, int(half / 0.3) + 2)
    y = 1.22 - 0.04 * (np.arange(len(x)) % 2)
    ribs = [np.stack([x, s * y, 0.05 + 0 * x], axis=1) for s in (-1, 1)]
    walls = [wall(line, 2.5, M.METAL_SHEET, depth=0.15) for line in ribs]
    ends = [
        wall([[s * half, -1.2, 0.05], [s * half, 1.2, 0.05]], 2.5, M.METAL_SHEET, depth=0.15) for s in (-1, 1)
    ]
    lid = box([-half, -1.22, 2.5], [half, 1.22, 2.6], M.METAL_SHEET)
    return merge([*walls, *ends, lid])


def skip(rng: Generator) -> Mesh:
    """Make an open skip for rubble along x, with its load."""
    long, high = rng.uniform(1.5, 2.0), rng.uniform(1.0, 1.5)
    profile = np.array(
        [[-0.65, 0.1], [0.65, 0.1], [1.0, 0.6 * high], [1.0, high], [-1.0, high], [-1.0, 0.6 * high]]
    )
    sides = [
        np.stack([long * profile[:, 0], y + 0 * profile[:, 0], profile[:, 1]], axis=1) for y in (-0.9, 0.9)
    ]
    body = loft(sides, M.METAL_SHEET, caps=M.METAL_SHEET)
    foot = box([-0.6 * long, -0.7, -0.1], [0.6 * long, 0.7, 0.1], M.METAL_SHEET)
    heap = cylinder(
        [0, 0, high], [0, 0, high + rng.uniform(0.1, 0.5)], 0.8, M.CONCRETE, end_radius=0.2, sides=7
    )
    return merge([body, foot, heap])


def cafe(rng: Generator) -> Mesh:
    """Make a table with two to four chairs, often below a parasol."""
    top = cylinder([0, 0, 0.72], [0, 0, 0.75], rng.uniform(0.35, 0.5), M.WOOD, sides=8)
    parts = [top, cylinder([0, 0, -0.05], [0, 0, 0.72], 0.03, M.METAL_POLE, sides=4, caps=False)]
    turn = rng.uniform(0, 2 * np.pi)
    for k in range(int(rng.integers(2, 4))):
        a = turn + 2.1 * k
        out = np.array([np.cos(a), np.sin(a), 0.0])
        side, up = np.array([-out[1], out[0], 0.0]), np.array([0, 0, 1.0])
        p, w = 0.75 * out, 0.2 * side
        seat = [p - w - 0.2 * out, p + w - 0.2 * out, p + w + 0.2 * out, p - w + 0.2 * out]
        back = [
            p - w + 0.2 * out,
            p + w + 0.2 * out,
            p + w + 0.26 * out + 0.45 * up,
            p - w + 0.26 * out + 0.45 * up,
        ]
        legs = [
            _strip(p + s * w + t * out - 0.05 * up, p + s * w + t * out + 0.45 * up, 0.015 * (side + out))
            for s in (-1, 1)
            for t in (-0.2, 0.2)
        ]
        parts.append(quads([np.array(seat) + 0.45 * up, np.array(back) + 0.45 * up, *legs], M.PLASTIC_DARK))
    if rng.random() < 0.5:
        parts.append(cylinder([0, 0, 0.7], [0, 0, 2.5], 0.025, M.METAL_POLE, sides=4, caps=False))
        parts.append(
            cylinder([0, 0, 2.2], [0, 0, 2.6], 1.4, M.TARPAULIN, end_radius=0.05, sides=8, caps=False)
        )
    return merge(parts)


def monument(rng: Generator) -> Mesh:
    """Make the middle of a square or park: a fountain's basin, or a statue on its pedestal."""
    if rng.random() < 0.5:
        radius = rng.uniform(1.5, 3.0)
        rim = cylinder([0, 0, -SUNK], [0, 0, 0.5], radius, M.STONE, sides=14, caps=False)
        inner = cylinder([0, 0, 0.1], [0, 0, 0.5], radius - 0.25, M.STONE, sides=14)
        return merge(
            [
                rim,
                inner,
                _pole(1.6, 0.25, M.STONE),
                cylinder([0, 0, 1.5], [0, 0, 1.7], 0.3, M.STONE, end_radius=0.8),
            ]
        )
    steps = [
        _centred_box([0, 0, 0.05], [2.6, 2.6, 0.5], M.STONE),
        _centred_box([0, 0, 0.4], [1.8, 1.8, 0.4], M.STONE),
    ]
    pedestal = _centred_box([0, 0, 1.3], [1.0, 1.0, 1.6], M.STONE)
    figure = [
        cylinder([0, 0, 2.1], [0, 0, 3.3], 0.3, M.STONE, end_radius=0.35, sides=6),
        cylinder([0, 0, 3.3], [0, 0, 3.75], 0.18, M.STONE, end_radius=0.1, sides=6),
    ]
    return merge([*steps, pedestal, *figure])


def gantry(width: float, rng: Generator) -> Mesh:
    """Span a gantry across a road (along y) of that width [m], with signs above 4.7 m; origin at the road's middle.

    The posts stand at ``y = ±width / 2``.
    """
    if not 4 <= width <= 60:
        raise ValueError(f"width of a gantry must lie between 4 and 60 m, got {width}")
    half, z = width / 2, rng.uniform(6.0, 6.6)
    posts = [_pole(z + 0.4, 0.14, y=y, sides=8) for y in (-half, half)]
    beams = [
        cylinder([0, -half, h], [0, half, h], 0.07, M.METAL_POLE, sides=5, caps=False)
        for h in (z - 0.3, z + 0.3)
    ]
    ends = np.linspace(-half, half, int(width / 1.2) + 2)
    zigzag = z + 0.3 * (-1.0) ** np.arange(len(ends))
    lattice = np.stack([0 * ends, ends, zigzag], axis=1)
    braces = [_strip(a, b, [0.0, 0.03, 0.03]) for a, b in zip(lattice[:-1], lattice[1:], strict=True)]
    parts = [*posts, *beams, quads(braces, M.METAL_POLE)]
    for k in range(max(int(width / 4.5), 1)):
        y = -half + (k + 0.5) * width / max(int(width / 4.5), 1)
        tall = rng.uniform(1.0, 1.9)
        board = _panel(rng.uniform(1.2, 3.4), tall) + [y, 0.0]
        parts += _plate(board, max(z, OVER_ROAD + 0.1 + tall / 2), 0.08)
    return merge(parts)


def bridge(length: float, width: float, rng: Generator) -> Mesh:
    """Build a bridge over a road that runs along x: its own way runs along y, `length` from end to end [m].

    Parameters
    ----------
    length, width : float
        Span along y between the abutments' outer ends, 8 to 80 m; size of the deck along x, 1.5 to 30 m.
    rng : Generator
        Chooses clearance (4.7 to 5.5 m above the origin) and the look of girders and railing.

    Returns
    -------
    Mesh
        Origin in the middle of the road below. The abutments are 1.2 m thick, at ``|y| = length / 2``.
    """
    if not 8 <= length <= 80 or not 1.5 <= width <= 30:
        raise ValueError(f"a bridge is 8 to 80 m long and 1.5 to 30 m wide, got {length} x {width} m")
    half, side, clear = length / 2, width / 2, rng.uniform(OVER_ROAD, 5.5)
    depth = 0.35 + length / 40
    girders = max(int(width / 2.5) + 1, 2)
    parts = [
        _centred_box([x, 0, clear + depth / 2], [0.4, length, depth], M.CONCRETE)
        for x in np.linspace(-side + 0.4, side - 0.4, girders)
    ]
    top = clear + depth + 0.25
    parts.append(box([-side, -half, clear + depth], [side, half, top], M.CONCRETE))
    for y in (-1, 1):
        lower, upper = sorted((y * (half - 1.2), y * (half + 0.3)))
        parts.append(box([-side - 0.3, lower, -1.5], [side + 0.3, upper, clear], M.CONCRETE))
    for x in (-side + 0.1, side - 0.1):
        edge = np.array([[x, -half, top], [x, half, top]])
        parts.append(bars(edge, 1.1, max(0.15, length / 120), 0.02, M.METAL_POLE))
        parts.append(_centred_box([x, 0, top + 0.05], [0.25, length, 0.3], M.CONCRETE))
    return merge(parts)


def _pole(
    height: float,
    radius: float,
    material: M = M.METAL_POLE,
    *,
    x: float = 0.0,
    y: float = 0.0,
    end_radius: float | None = None,
    sides: int = 6,
) -> Mesh:
    """Make an upright pole that reaches into the ground."""
    return cylinder([x, y, -SUNK], [x, y, height], radius, material, end_radius=end_radius, sides=sides)


def _centred_box(center: ArrayLike, size: ArrayLike, material: M) -> Mesh:
    center, half = np.asarray(center, np.float64), np.asarray(size, np.float64) / 2
    return box(center - half, center + half, material)


def _signal_head(at: Floats) -> list[Mesh]:
    """Make the three lamps of a signal with their backing board; `at` is the lower edge's middle."""
    body = _centred_box(at + [0, 0, 0.45], [0.2, 0.28, 0.9], M.PLASTIC_DARK)
    board = (
        at + [-0.06, 0, 0.45] + np.array([[0, -0.28, -0.6], [0, 0.28, -0.6], [0, 0.28, 0.6], [0, -0.28, 0.6]])
    )
    lamps = [
        quads(at + [0.105, 0, z] + 0.1 * np.array([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1.0]]), M.LAMP)
        for z in (0.16, 0.45, 0.74)
    ]
    return [body, quads(board, M.PLASTIC_DARK), *lamps]


def _round(radius: float, sides: int, turn: float = 0.0) -> Floats:
    """Return a regular outline (sides, 2) in y, z around the middle."""
    angles = turn + 2 * np.pi * np.arange(sides) / sides
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _panel(width: float, tall: float) -> Floats:
    """Return a rectangle's outline (4, 2) in y, z around the middle."""
    return 0.5 * np.array([[-width, -tall], [width, -tall], [width, tall], [-width, tall]])


def _plate(outline: Floats, z: float, radius: float) -> list[Mesh]:
    """Make a plate before a pole of that radius: retroreflective front towards +x, bare metal 2 cm behind it."""
    fan = np.array([(0, k, k + 1) for k in range(1, len(outline) - 1)], np.uint32)
    parts = []
    for x, material in ((radius + 0.03, M.SIGN), (radius + 0.01, M.METAL_SHEET)):
        vertices = np.column_stack([np.full(len(outline), x), outline[:, 0], outline[:, 1] + z])
        parts.append(Mesh(vertices.astype(np.float32), fan, np.full(len(fan), material, np.uint8)))
    return parts


def _strip(start: ArrayLike, end: ArrayLike, half: ArrayLike) -> Floats:
    """Return the corners (4, 3) of a flat bar between two points, `half` its half width as a vector."""
    a, b, h = (np.asarray(v, np.float64) for v in (start, end, half))
    return np.stack([a - h, a + h, b + h, b - h])


def _tube(line: Floats, radius: float, material: M) -> Mesh:
    """Make a three-sided tube along a line that lies in an upright plane across x."""
    ahead = np.gradient(line, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    out = np.cross([1.0, 0.0, 0.0], ahead)
    across = np.array([[1.0, 0.0, 0.0]])
    ring = [out, 0.87 * across - 0.5 * out, -0.87 * across - 0.5 * out]
    return loft(np.stack([line + radius * r for r in ring], axis=1), material)


def _parked_bike(x: float, y: float) -> Mesh:
    """Make a bicycle leaning at a hoop: two wheels (rings), frame, saddle and handlebar, as flat bars."""
    parts = []
    angles = np.linspace(0, 2 * np.pi, 9)
    for cy in (-0.52, 0.52):
        rims = [
            np.stack([0 * angles + x, y + cy + r * np.cos(angles), 0.34 + r * np.sin(angles)], 1)
            for r in (0.28, 0.34)
        ]
        parts.append(sheet(rims[0], rims[1], M.TYRE))
    spots = np.array(
        [[0, -0.52, 0.34], [0, -0.15, 0.8], [0, 0.4, 0.85], [0, 0.0, 0.3], [0, 0.52, 0.34], [0, 0.4, 1.0]]
    )
    spots = spots + [x, y, 0]
    links = [(0, 1), (1, 2), (1, 3), (2, 3), (0, 3), (2, 4), (2, 5)]
    bars = [_strip(spots[a], spots[b], [0.012, 0.012, 0.012]) for a, b in links]
    bars.append(_strip(spots[5] - [0.28, 0, 0], spots[5] + [0.28, 0, 0], [0, 0.015, 0.015]))
    bars.append(_strip(spots[1] + [0, -0.13, 0.12], spots[1] + [0, 0.13, 0.12], [0.07, 0, 0]))
    return merge([*parts, quads(bars, M.PAINT_DARK)])
