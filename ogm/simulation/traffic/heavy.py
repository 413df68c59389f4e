"""Bodies of lorries, trailers and buses."""

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Floats, Mesh, box, cylinder, loft, merge, quads
from ogm.simulation.traffic.bodies import Body, centered, plate, wheel


def _mirrored(x: float | Floats, y: ArrayLike, z: ArrayLike) -> Floats:
    """Return a closed, symmetric outline (8, 3) from its four left corners, lowest first."""
    outline = np.empty((8, 3))
    outline[:, 0] = x
    outline[:4, 1], outline[:4, 2] = y, z
    outline[4:, 1:] = outline[3::-1, 1:] * [-1, 1]
    return outline


def _closed(first: Floats, last: Floats, materials: list[int]) -> Mesh:
    """Make faces over the two end outlines (8, 3) of a body, each of three bands from below."""
    bands = [end[[k, k + 1, 6 - k, 7 - k]] for end in (first, last) for k in range(3)]
    return quads(bands, materials)


def _axles(places: list[float], half: float, radius: float) -> list[Mesh]:
    """Make a pair of wheels at each position along the vehicle."""
    return [wheel(x, side * half, radius, 0.32) for x in places for side in (-1.0, 1.0)]


def _lamps(x: float, half: float, z: float) -> Mesh:
    """Make two lamps at an end of the vehicle."""
    y, up = half + np.array([-0.38, -0.08, -0.08, -0.38]), z + np.array([-0.09, -0.09, 0.09, 0.09])
    return quads([np.stack([np.full(4, x), side * y, up], axis=1) for side in (-1.0, 1.0)], M.LAMP)


def _cab(front: float, length: float, half: float, height: float, paint: int) -> Mesh:
    """Make a cab-over lorry cab: windscreen, side windows, mirrors, bumper."""
    low, sill = 0.42, 0.52 * height
    places = np.array([0.0, 0.12, 0.35, 0.62, 1.0]) * length
    inset = np.array([0.10, 0.02, 0.0, 0.0, 0.0])
    lean = np.array([0.0, 0.0, 0.02, 0.02, 0.02])
    sections = []
    for s, shrink, drop in zip(places, inset, lean[::-1], strict=True):
        y = half - shrink
        x = front - s - np.array([0.0, 0.0, 0.16, 0.34, 0.34, 0.16, 0.0, 0.0]) * (s < 0.2 * length)
        sections.append(_mirrored(x, (y, y, y - 0.06, y - 0.2), (low, sill, height - 0.22, height - drop)))
    material = np.full((4, 8), paint, np.uint8)
    material[:, 7] = M.PLASTIC_DARK
    material[2, [1, 5]] = M.CAR_GLASS
    skin = loft(np.array(sections), material)
    ends = _closed(sections[0], sections[-1], [M.PLASTIC_DARK, M.CAR_GLASS, paint, paint, paint, paint])
    mirrors = [
        box((front - 0.35, y - 0.11, sill + 0.1), (front - 0.22, y + 0.11, sill + 0.75), M.PLASTIC_DARK)
        for y in (half + 0.12, -half - 0.12)
    ]
    bumper = box((front - 0.3, -half + 0.04, 0.3), (front + 0.04, half - 0.04, 0.62), paint)
    number = quads(plate(front + 0.05, 0.42), M.PLATE)
    return merge([skin, ends, *mirrors, bumper, number, _lamps(front + 0.05, half, 0.52)])


def _load(front: float, rear: float, half: float, height: float, cover: int) -> Mesh:
    """Make a box body or tarpaulin on a frame, with chassis, guards and bumper."""
    y, z = (half, half, half, half - 0.06), (1.02, (1.02 + height) / 2, height - 0.06, height)
    body = loft([_mirrored(x, y, z) for x in (front, (front + rear) / 2, rear)], cover, caps=cover)
    frame = box((rear + 0.1, -0.45, 0.72), (front - 0.05, 0.45, 1.0), M.METAL_SHEET)
    guards = [
        box((rear + 2.1, y - 0.02, 0.5), (front - 1.4, y + 0.02, 0.78), M.METAL_SHEET)
        for y in (half - 0.1, -half + 0.1)
        if front - rear > 4.5
    ]
    bumper = box((rear - 0.02, -half + 0.1, 0.42), (rear + 0.08, half - 0.1, 0.56), M.METAL_SHEET)
    tail = quads(plate(rear - 0.03, 0.68), M.PLATE)
    return merge([body, frame, *guards, bumper, tail, _lamps(rear - 0.03, half, 0.72)])


def truck(rng: Generator, paint: M) -> Body:
    """Make a lorry of cab and load, 7 to 9 m long and 3.2 to 3.8 m high."""
    length, height, half = rng.uniform(7.0, 8.8), rng.uniform(3.2, 3.8), rng.uniform(1.18, 1.25)
    cover = (M.TARPAULIN, M.METAL_SHEET, M.PAINT_LIGHT)[rng.integers(3)]
    front, cab = length / 2, 2.0
    load_front = front - cab - rng.uniform(0.3, 0.6)
    axles = [front - 1.35, -front + rng.uniform(1.7, 2.1)]
    parts = [
        _cab(front, cab, half - 0.03, rng.uniform(2.7, 3.1), paint),
        _load(load_front, -front, half, height, cover),
        box((load_front, -0.45, 0.72), (front - 0.4, 0.45, 1.0), M.METAL_SHEET),
        cylinder((load_front - 1.2, 0.7, 0.68), (load_front - 0.2, 0.7, 0.68), 0.28, M.METAL_SHEET, sides=6),
        *_axles(axles, half - 0.02, 0.5),
    ]
    return centered("truck", merge(parts), axles)


def trailer(rng: Generator) -> Body:
    """Make a trailer, 5.5 to 7 m long including its drawbar."""
    length, height, half = rng.uniform(4.6, 6.0), rng.uniform(3.2, 3.8), rng.uniform(1.18, 1.25)
    cover = (M.TARPAULIN, M.METAL_SHEET)[rng.integers(2)]
    front = length / 2
    axles = [front - 1.0, -front + 1.2]
    bar = [
        cylinder((front - 0.6, y, 0.75), (front + 1.0, y / 6, 0.62), 0.06, M.METAL_SHEET, sides=6) for y in (-0.5, 0.5)
    ]
    return centered(
        "trailer", merge([_load(front, -front, half, height, cover), *_axles(axles, half - 0.02, 0.45), *bar]), axles
    )


def bus(rng: Generator, paint: M) -> Body:
    """Make a low-floor city bus of 9.5 to 12 m with a band of windows."""
    length, height, half = rng.uniform(9.5, 12.0), rng.uniform(2.95, 3.2), 1.25
    front, low, sill = length / 2, 0.3, 1.0
    axles = [front - 2.6, -front + 3.1]
    count = int(length / 1.3)
    windows = np.linspace(front - 0.7, -front + 0.5, count + 1)
    panes = np.stack([windows[:-1] - 0.04, windows[1:] + 0.04], axis=1).ravel()
    x = np.array([front, front - 0.12, *panes, -front + 0.1, -front])
    width = half - np.interp(x, [-front, -front + 0.1, front - 0.12, front], [0.12, 0.0, 0.0, 0.14])
    sections = []
    for place, y in zip(x, width, strict=True):
        arch = min(abs(place - axle) for axle in axles) < 0.62
        bottom = 0.98 if arch else low
        heights = (bottom, max(sill, bottom + 0.01), height - 0.45, height)
        sections.append(_mirrored(place, (y, y, y - 0.03, y - 0.2), heights))
    material = np.full((len(x) - 1, 8), paint, np.uint8)
    material[:, 7] = M.PLASTIC_DARK
    material[2:-1:2, [1, 5]] = M.CAR_GLASS
    ends = _closed(sections[0], sections[-1], [paint, M.CAR_GLASS, paint, paint, M.CAR_GLASS, paint])
    floor = box((-front + 0.3, -half + 0.15, 0.36), (front - 0.3, half - 0.15, 0.42), M.PLASTIC_DARK)
    seats = [
        [(s, y, 0.5), (s, y + 0.8, 0.5), (s - 0.12, y + 0.8, 1.35), (s - 0.12, y, 1.35)]
        for s in np.arange(-front + 1.2, front - 3.0, 1.6)
        for y in (-1.1, 0.3)
    ]
    mirrors = [
        box((front - 0.05, y - 0.08, 1.9), (front + 0.12, y + 0.08, 2.35), M.PLASTIC_DARK) for y in (half, -half)
    ]
    plates = quads([plate(front + 0.01, 0.5), plate(-front - 0.01, 0.6)], M.PLATE)
    lamps = [_lamps(front + 0.01, half - 0.12, 0.7), _lamps(-front - 0.01, half - 0.1, 0.8)]
    parts = [loft(np.array(sections), material), ends, floor, quads(seats, M.PLASTIC_DARK), *mirrors, plates, *lamps]
    return centered("bus", merge(parts + _axles(axles, half - 0.02, 0.48)), axles)
