"""Storeys of one side of a house: windows, doors, shops, gates, balconies, bays, and fixtures on the wall."""

from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Bytes, Floats, HeightAt, Mesh
from ogm.simulation.town import facades
from ogm.simulation.town.facades import HouseDesign, Openings, Side, deck, ledge, punched, side_of

Pieces = list[tuple[Floats, ArrayLike]]

SUNK = 0.8  # [m] depth of walls below the lowest ground
OVERHANG = 2.6  # [m] smallest height of balconies, bays and awnings above the ground


class House(NamedTuple):
    """Common data of a house's sides.

    Attributes
    ----------
    design : HouseDesign
    height_at : callable
        Height of the ground [m] at x, y [m].
    low, floor, upper, top : float
        Heights of the walls' base, the ground floor, the next storey's floor, and the walls' upper edge [m].
    """

    design: HouseDesign
    height_at: HeightAt
    low: float
    floor: float
    upper: float
    top: float


def ground_floor(side: Side, role: str, door: bool, house: House, rng: Generator) -> Pieces:
    """Return the ground floor of a side: shops, gates, or windows and a door.

    Parameters
    ----------
    side : Side
        Plane of the wall.
    role : str
        "front", "side", "back", or "blind" for a wall without openings.
    door : bool
        Whether this side has the door of the house.
    house : House
    rng : Generator
        Generator of all other choices.

    Returns
    -------
    list
        Quadrilaterals in the side's u, d, z with their materials, for `Side.built`.
    """
    design, height_at, low, floor, upper, _ = house
    kind = design.ground_floor
    front = role == "front"
    bay, (width, sill, head) = design.bay, design.window
    if kind == "shop":
        bay, width, sill, head = (bay, 0.85 * bay, rng.uniform(0.1, 0.5), 2.8) if front else (5.0, 1.2, 1.6, 2.6)
    elif kind == "garage":
        bay, width, sill, head = (3.2, 2.5, 0.0, 2.1) if front else (4.0, 0.8, 1.3, 2.0)
    elif kind == "hall" and not front:
        sill, head = 0.62 * (upper - floor), 0.8 * (upper - floor)
    if role == "blind" or upper - floor < head or side.length < 1.7:
        return punched(side.length, low, upper, _openings(np.zeros(0), 0.0), design.base)
    columns, width, middle = _columns(side, bay, width)
    openings = _openings(middle, width)
    ground = np.asarray(height_at(*side.xy(middle, 0.3).T), np.float64)
    recess, pane = rng.uniform(0.8, 1.2, columns) * design.recess, _panes(rng, columns)
    sills, heads = np.maximum(floor + sill, ground + 0.1), np.full(columns, min(floor + head, upper - 0.25))
    extra: Pieces = []
    if kind == "garage" and front:
        sills, recess, pane = ground, rng.uniform(0.05, 0.2, columns), np.full(columns, M.METAL_SHEET)
    if kind == "hall" and front:
        sills, heads, recess, pane, extra = _gates(side, middle, width, ground, house, rng)
        door = False
    if kind == "shop" and front:
        extra += _shops(openings, floor, upper, float(ground.max()), rng)
    if door and kind != "garage":
        k = int(rng.integers(columns))
        sills[k], heads[k], recess[k], pane[k], wide, stairs = _door(ground[k], middle[k], width, house, rng)
        openings.left[k], openings.right[k] = middle[k] - wide / 2, middle[k] + wide / 2
        extra += stairs
    if front:
        extra += _clutter(openings, float(ground.max()), upper, side.length, rng)
    heads = np.maximum(heads, sills)
    rows = Openings(*openings[:2], *(np.asarray(column)[:, None] for column in (sills, heads, recess, pane)))
    if front and design.storeys > 1 and rng.random() < 0.7:
        extra.append((ledge(0.0, side.length, rng.uniform(0.05, 0.15), upper - 0.12, upper + 0.1), design.base))
    if front and side.length > 4 and rng.random() < 0.7:
        top = upper + (design.storeys - 1) * design.storey
        ends = [ledge(u, u + 0.09, 0.13, low, top) for u in (0.15, side.length - 0.24)]
        extra.append((np.concatenate(ends[: int(rng.integers(1, 3))]), M.METAL_SHEET))
    return [*punched(side.length, low, upper, rows, design.base), *extra]


def _door(
    ground: float, middle: float, width: float, house: House, rng: Generator
) -> tuple[float, float, float, int, float, Pieces]:
    """Return sill, head, recess, pane and width of the door, with its stairs and canopy."""
    design, kind = house.design, house.design.ground_floor
    wide = min(1.8 if kind == "shop" else rng.uniform(1.0, 1.5), max(width, 1.0))
    highest = 0.36 if design.blind_sides else 0.72  # [m] of the sill above the ground; the other stairs are indoors
    sill = min(max(house.floor, ground + 0.02), ground + highest)
    head = min(sill + rng.uniform(2.1, 2.5), house.upper - 0.2)
    recess = rng.choice([0.12, rng.uniform(0.3, 1.2)])
    extra: Pieces = []
    if sill - ground > 0.1:
        u0, u1 = middle - wide / 2 - 0.2, middle + wide / 2 + 0.2
        extra.append((facades.steps(u0, u1, float(ground), float(sill)), M.STONE))
    roof = max(head + 0.15, ground + OVERHANG)
    if kind == "home" and roof < house.upper + 0.3 and rng.random() < 0.4:
        u0, u1 = middle - wide / 2 - 0.4, middle + wide / 2 + 0.4
        extra.append((ledge(u0, u1, rng.uniform(0.7, 1.2), roof, roof + 0.12), M.METAL_SHEET))
    return sill, head, recess, M.WINDOW if kind == "shop" else M.WOOD, wide, extra


def upper_storeys(side: Side, role: str, house: House, rng: Generator) -> list[Mesh]:
    """Return the upper storeys of a side with bays and balconies; for the parameters see `ground_floor`."""
    design, height_at, _, _, upper, top = house
    width, sill, head = design.window
    if role == "blind" or side.length < 1.7:
        return [side.built(punched(side.length, upper, top, _openings(np.zeros(0), 0.0), design.wall))]
    columns, width, middle = _columns(side, design.bay, width)
    rows = design.storeys - 1
    floors = upper + np.arange(rows) * design.storey
    ground = float(np.max(height_at(*side.xy([*middle, 0.0, side.length], 0.8).T)))
    shape = (columns, rows)
    sills = np.broadcast_to(floors + sill, shape).copy()
    heads = np.broadcast_to(np.minimum(floors + head, floors + design.storey - 0.2), shape).copy()
    recess = np.full(shape, design.recess)
    pane = _panes(rng, columns * rows).reshape(shape)
    recess[pane != M.WINDOW] *= 0.4  # shutters are closer to the wall's face
    extra: Pieces = []
    parts: list[Mesh] = []

    # Balconies are stacked, on the sides to the street and to the courtyard.
    chance = design.balconies if role in ("front", "back") else 0.0
    high = floors - 0.18 - ground > OVERHANG
    for k in np.flatnonzero(rng.random(columns) < chance).tolist():
        half = min(rng.uniform(1.1, 2.0), 0.47 * side.length / columns)
        depth = rng.uniform(0.8, 1.6)
        sills[k, high] = floors[high] + 0.05
        bars = 7 if design.panel == M.METAL_POLE else 0
        for z in floors[high]:
            extra += facades.balcony(middle[k] - half, middle[k] + half, depth, float(z), bars, design.panel)

    if design.bays and role == "front" and columns >= 2 and upper - 0.3 - ground > OVERHANG:
        k = int(rng.integers(columns))
        half = min(1.4, 0.48 * side.length / columns)
        rows_of_bay = ((floors + sill)[None], heads[:1], recess[:1], pane[:1])
        faces, lids = _bay(side, middle[k], half, rows_of_bay, house, rng)
        parts += faces
        extra.append((lids, design.wall))
    if role == "front" and rng.random() < 0.5:
        extra.append((ledge(0.0, side.length, rng.uniform(0.1, 0.3), top - 0.3, top), design.wall))
    openings = Openings(*_openings(middle, width)[:2], sills, heads, recess, pane)
    return [side.built([*punched(side.length, upper, top, openings, design.wall), *extra]), *parts]


def _bay(side: Side, middle: float, half: float, rows: Any, house: House, rng: Generator) -> tuple[list[Mesh], Floats]:
    """Return a bay over all upper storeys: three narrow walls in front of the wall, floor and roof.

    `rows` are the last four attributes of `Openings`.
    """
    depth = rng.uniform(0.45, 0.9)
    cut = half - rng.uniform(0.0, 0.4)
    line = [(middle - half, 0.0), (middle - cut, depth), (middle + cut, depth), (middle + half, 0.0)]
    ends = [side.xy(u, d) for u, d in line]
    low, top = house.upper - 0.1, house.top
    faces = []
    for start, end in zip(ends[:-1], ends[1:], strict=True):
        face = side_of(start, end)
        n = int(face.length >= 0.8)  # number of windows
        holes = _openings(np.full(n, face.length / 2), max(face.length - 0.5, 0.0))
        holes = Openings(*holes[:2], *(column[:n] for column in rows))
        faces.append(face.built(punched(face.length, low, top, holes, house.design.wall)))
    lids = np.concatenate([deck(line[0][0], line[3][0], 0.0, depth, z, z) for z in (low, top)])
    lids[:, 2, 0], lids[:, 3, 0] = line[2][0], line[1][0]
    return faces, lids


def _shops(openings: Openings, floor: float, upper: float, ground: float, rng: Generator) -> Pieces:
    """Return fixtures above shop windows: signs along the wall, awnings, and projecting signs."""
    extra: Pieces = []
    low = max(floor + 2.9, ground + OVERHANG)
    start, columns = 0, len(openings.left)
    while start < columns:
        end = min(start + int(rng.integers(1, 4)), columns) - 1
        u0, u1 = float(openings.left[start]), float(openings.right[end])
        if low + 0.55 < upper + 0.4:
            if rng.random() < 0.6:
                extra.append((ledge(u0, u1, rng.uniform(0.06, 0.25), low, low + 0.5), M.PLASTIC_DARK))
            if rng.random() < 0.35:
                drop, depth = rng.uniform(0.3, 0.6), rng.uniform(0.9, 1.7)
                z = max(low + 0.3, ground + OVERHANG + drop + 0.2)
                extra.append((facades.awning(u0, u1, depth, z, drop), M.TARPAULIN))
            if rng.random() < 0.4:
                out = ledge(u1, u1 + 0.12, rng.uniform(0.6, 0.9), low + 0.1, low + 0.8)
                extra.append((out, M.METAL_SHEET))
        start = end + 1
    return extra


def _gates(
    side: Side, middle: Floats, width: float, ground: Floats, house: House, rng: Generator
) -> tuple[Any, Any, Any, Any, Pieces]:
    """Return sills, heads, recesses and panes of a hall's front (gates, docks, windows), and its other parts."""
    design, floor, upper = house.design, house.floor, house.upper
    columns = len(middle)
    kind = rng.choice(3, columns, p=[0.35, 0.25, 0.4])
    sills = np.choose(kind, [ground, ground + 1.15, floor + 1.0])
    heads = np.minimum(np.choose(kind, [ground + rng.uniform(3.6, 4.5), ground + 4.0, floor + 2.6]), upper - 0.4)
    recess = np.choose(kind, [rng.uniform(0.2, 0.5), 0.3, 0.1])
    pane = np.where(kind < 2, M.METAL_SHEET, _panes(rng, columns))
    extra: Pieces = []
    if rng.random() < 0.5:
        joints = np.linspace(0, side.length, columns + 1)
        low = float(ground.min()) - SUNK
        posts = [ledge(max(u - 0.2, 0), min(u + 0.2, side.length), 0.2, low, upper) for u in joints]
        extra.append((np.concatenate(posts), design.base))
    docks = middle[kind == 1]
    if len(docks):
        edges, low, top = [u + s * width / 2 for u in docks for s in (-1, 1)], ground.min() + 0.5, ground.max() + 1.1
        extra.append((np.concatenate([ledge(u - 0.15, u + 0.15, 0.25, low, top) for u in edges]), M.TYRE))
    canopy = float(ground.max()) + 4.8
    if canopy + 0.3 < upper and rng.random() < 0.4:
        extra.append((ledge(0.1 * side.length, 0.8 * side.length, 2.5, canopy, canopy + 0.2), M.METAL_SHEET))
    return sills, heads, recess, pane, extra


def _clutter(openings: Openings, ground: float, upper: float, length: float, rng: Generator) -> Pieces:
    """Return small fixtures between windows: letter boxes, lamps, meters, name plates, air conditioners."""
    edges = np.append(np.append(0.0, openings.right), length)
    extra: Pieces = []
    for a, b in zip(edges[:-1], np.append(openings.left, length), strict=True):
        if b - a > 0.35 and rng.random() < 0.35:
            width, tall = rng.uniform(0.12, min(0.8, b - a - 0.1)), rng.uniform(0.15, 0.7)
            u, z = rng.uniform(a + 0.05, b - width - 0.05), ground + rng.uniform(0.7, 2.3)
            if z + tall < upper - 0.2:
                out = ledge(u, u + width, rng.uniform(0.05, 0.28), z, z + tall)
                extra.append((out, int(rng.choice([M.METAL_SHEET, M.PLASTIC_DARK, M.PLASTER_LIGHT]))))
    return extra


def _columns(side: Side, bay: float, width: float) -> tuple[int, float, Floats]:
    """Return the number of window columns of a side, their largest width, and their middles."""
    count = max(int((side.length - 0.7) / bay), 1)
    return count, min(width, side.length / count - 0.5), (np.arange(count) + 0.5) * side.length / count


def _openings(middle: Floats, width: float) -> Openings:
    """Return openings with columns around the given middles and without rows."""
    none = np.zeros((len(middle), 0))
    return Openings(middle - width / 2, middle + width / 2, none, none, none, none.astype(np.uint8))


def _panes(rng: Generator, count: int) -> Bytes:
    """Draw materials of panes: most are glass, some have closed shutters or blinds."""
    shut = rng.random() * 0.35
    other = rng.choice([M.PLASTER_LIGHT, M.WOOD, M.PLASTIC_DARK])
    return np.where(rng.random(count) < shut, other, M.WINDOW).astype(np.uint8)
