"""Houses on footprints: storeys, passages, flat roofs with parapets, and pitched roofs."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import shapely
from numpy.random import Generator
from numpy.typing import ArrayLike
from shapely import Polygon

from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Floats, HeightAt, Mesh, box, cylinder, merge, quads, triangles
from ogm.simulation.town.facades import HouseDesign, Side, draw_design, side_of, upright
from ogm.simulation.town.footprints import front_first
from ogm.simulation.town.storeys import SUNK, House, ground_floor, upper_storeys

HEADROOM = 3.2  # [m] smallest height of a passage


def building(footprint: Polygon, style: str, height_at: HeightAt, rng: Generator) -> Mesh:
    """Build a house.

    Parameters
    ----------
    footprint : Polygon
        Valid outline of at least 4 m² and, at its widest, more than 1 m [m]. Its first edge faces the street, see
        `split_front`.
    style : str
        Style of the house, one of `STYLES`.
    height_at : callable
        Height of the ground [m] at x, y [m].
    rng : Generator
        Generator of all other choices.

    Returns
    -------
    Mesh
        House in the footprint's frame. Walls follow the outline and reach below the lowest ground. Windows and doors
        are recessed. Parts that protrude more than 0.3 m, except steps, are more than 2.5 m above the ground.
    """
    outline = footprint.simplify(0.03)
    if not isinstance(outline, Polygon) or not outline.is_valid or outline.area < 0.9 * footprint.area:
        outline = footprint
    a, b = footprint.exterior.coords[:2] if footprint.exterior.is_ccw else footprint.exterior.coords[1::-1]
    outline = front_first(outline, side_of(a, b).out)
    ring = np.array(outline.exterior.coords)
    street = side_of(ring[0], ring[1])
    if style == "park" and outline.area < 60 and rng.random() < 0.5:
        return _pavilion(ring, height_at, rng)
    if style == "arterial" and outline.area > 150 and len(ring) == 5 and rng.random() < 0.15:
        return _canopy(ring, height_at, rng)
    if style == "suburb" and outline.area < 40 and rng.random() < 0.25:
        return _pavilion(ring, height_at, rng)  # a carport
    return _house(outline, street, draw_design(style, outline, rng), height_at, rng)


def _house(outline: Polygon, street: Side, design: HouseDesign, height_at: HeightAt, rng: Generator) -> Mesh:
    """Assemble walls, storeys and the roof of a house."""
    corners = shapely.get_coordinates(outline)
    ground = np.asarray(height_at(corners[:, 0], corners[:, 1]), np.float64)
    u = np.linspace(0, street.length, 5)
    at_front = np.asarray(height_at(*street.xy(u, 0.3).T), np.float64)
    low = float(min(ground.min(), at_front.min())) - SUNK
    floor = float(at_front.max()) + design.plinth
    upper = floor + design.ground_storey
    design = design._replace(bay=_spared(design, outline))
    parts = []

    # A passage leads through the ground floor, whose walls follow the rest of the footprint.
    lower, passage = _passage(outline, street, design, rng)
    if not passage.is_empty:
        through = np.array(passage.exterior.coords)
        upper = max(upper, float(np.max(height_at(*through.T))) + HEADROOM + 0.1)
        parts.append(flat(passage, upper, design.wall))
    top = upper + (design.storeys - 1) * design.storey
    house = House(design, height_at, low, floor, upper, top)
    inner = outline.buffer(-0.05, join_style="mitre")
    door_done = False
    for piece in shapely.get_parts(lower):
        for side in _sides(piece):
            hidden = bool(shapely.contains_xy(inner, *side.xy(side.length / 2)))
            role = "blind" if hidden else _role(side, street, design)
            door = role == "front" and not door_done and side.length > 2.2
            door_done |= door
            parts.append(side.built(ground_floor(side, role, door, house, rng)))
    for side in _sides(outline) if design.storeys > 1 else ():
        parts += upper_storeys(side, _role(side, street, design), house, rng)
    parts.append(_roof(outline, street, top, design, rng))
    return merge(parts)


def _spared(design: HouseDesign, outline: Polygon) -> float:
    """Return the spacing of windows, increased for houses with more windows than their budget."""
    max_windows = 30 if outline.area < 170 else 110
    seen = outline.length * (0.6 if design.blind_sides else 1.0)
    return float(max(design.bay, seen * design.storeys / max_windows))


def _sides(polygon: Polygon) -> list[Side]:
    """Return the sides of a polygon and of its holes."""
    polygon = shapely.geometry.polygon.orient(polygon, 1.0)
    pairs = [pair for ring in (polygon.exterior, *polygon.interiors) for pair in pairwise(np.array(ring.coords))]
    return [side_of(a, b) for a, b in pairs if np.linalg.norm(b - a) > 0.01]


def _role(side: Side, street: Side, design: HouseDesign) -> str:
    """Return "front", "back", "side", or "blind" for a wall that may touch a neighbouring house."""
    facing = float(side.out @ street.out)
    if facing > 0.7:
        return "front"
    if facing < -0.7:
        return "back"
    return "blind" if design.blind_sides or side.length < 2.0 else "side"


def _passage(outline: Polygon, street: Side, design: HouseDesign, rng: Generator) -> tuple[shapely.Geometry, Polygon]:
    """Cut a passage for cars through the ground floor of some row houses; return remaining footprint and passage."""
    none = outline, Polygon()
    if design.storeys < 2 or design.ground_storey < 3.5 or not 11 < street.length < 40 or rng.random() > 0.3:
        return none
    width = rng.uniform(3.0, 4.0)
    at = rng.uniform(1.5, street.length - width - 1.5)
    strip = Polygon([street.xy(u, d) for u, d in ((at, 1), (at, -200), (at + width, -200), (at + width, 1))])
    way, rest = outline.intersection(strip), outline.difference(strip.buffer(1e-6, join_style="mitre"))
    parts = shapely.get_parts(rest)
    if not isinstance(way, Polygon) or len(parts) != 2 or min(part.area for part in parts) < 8:
        return none
    return rest, way


def _roof(outline: Polygon, street: Side, top: float, design: HouseDesign, rng: Generator) -> Mesh:
    """Build the roof: pitched if the footprint is nearly a quadrilateral, else flat behind a parapet."""
    corners = np.array(outline.exterior.coords)[:-1]
    if len(corners) != 4:
        box = front_first(outline.minimum_rotated_rectangle, street.out)
        corners = np.array(box.exterior.coords)[:-1]
    filled = outline.area / max(Polygon(corners).area, 1e-9)
    narrow = float(min(np.linalg.norm(corners[1] - corners[0]), np.linalg.norm(corners[2] - corners[1])))
    beyond = float(shapely.distance(outline, shapely.points(corners)).max())
    odd = filled < 0.75 or beyond > 3.2 or outline.interiors
    if design.roof == "flat" or odd or (narrow > 18 and design.pitch > 0.3):
        return _flat_roof(outline, top, design, rng)
    if not design.blind_sides and rng.random() < 0.4:  # the gable faces the street
        corners = np.roll(corners, -1, axis=0)
    ridge = np.linalg.norm(corners[1] - corners[0])
    over, hip = (design.eaves, 0.0 if design.blind_sides else 0.25), 0.9 if design.roof == "hip" else 0.0
    dormers = int(ridge / 4.5) if design.roof == "gable" and rng.random() < 0.35 else 0
    parts = [pitched(corners, top, design.pitch, design.wall, over, hip, dormers)]
    if design.ground_floor in ("home", "shop"):
        x, y = corners.mean(axis=0) + rng.normal(0, 0.8, 2)
        parts.append(chimney(float(x), float(y), top, top + design.pitch * narrow / 2 + 0.9))
    return merge(parts)


def _flat_roof(outline: Polygon, top: float, design: HouseDesign, rng: Generator) -> Mesh:
    """Build a flat roof with a parapet, or with eaves beyond the walls."""
    if design.storeys == 1 and rng.random() < 0.5:
        over = outline.buffer(design.eaves, join_style="mitre")
        parts = [flat(over, z, M.ROOF) for z in (top, top + 0.25)]
        return merge([*parts, *_rim(over, top, top + 0.25, M.METAL_SHEET)])
    parts = [flat(outline, top, M.ROOF), *_rim(outline, top, top + rng.uniform(0.3, 0.9), design.wall)]
    if outline.area > 120:
        x, y = outline.representative_point().coords[0]
        parts.append(chimney(x, y, top, top + 2.4))
    return merge(parts)


def _rim(outline: Polygon, low: float, high: float, material: int) -> list[Mesh]:
    """Build upright faces along an outline between two heights [m]."""
    return [s.built([(upright(0.0, s.length, 0.0, 0.0, low, high), material)]) for s in _sides(outline)]


def _pavilion(ring: Floats, height_at: HeightAt, rng: Generator) -> Mesh:
    """Build an open pavilion: a roof on posts."""
    ground = np.asarray(height_at(*ring[:-1].T), np.float64)
    top = float(ground.max()) + rng.uniform(2.6, 3.2)
    middle = ring[:-1].mean(axis=0)
    feet = middle + 0.93 * (ring[:-1] - middle)
    posts = [
        cylinder([*xy, z - 0.4], [*xy, top], 0.09, M.WOOD, sides=6, caps=False)
        for xy, z in zip(feet, ground, strict=True)
    ]
    outline = Polygon(ring)
    if len(ring) == 5 and rng.random() < 0.6:
        return merge([*posts, pitched(ring[:-1], top, rng.uniform(0.4, 0.7), M.WOOD, (0.4, 0.2), 0.9)])
    over = outline.buffer(0.2, join_style="mitre")
    lids = [flat(over, z, M.ROOF) for z in (top, top + 0.2)]
    return merge([*posts, *_rim(over, top, top + 0.2, M.WOOD), *lids])


def _canopy(ring: Floats, height_at: HeightAt, rng: Generator) -> Mesh:
    """Build a filling station: a roof at 4.7 m or more on columns, pumps, and a shop at the back."""
    p = ring[:-1]
    ground = np.asarray(height_at(*p.T), np.float64)
    low, high = float(ground.min()) - SUNK, float(ground.max())
    z = high + rng.uniform(4.7, 5.4)

    def spot(s: float, t: float) -> Floats:
        return np.asarray((1 - t) * ((1 - s) * p[0] + s * p[1]) + t * ((1 - s) * p[3] + s * p[2]))

    deck_outline = Polygon([spot(0, 0.05), spot(1, 0.05), spot(1, 0.6), spot(0, 0.6)])
    parts = [flat(deck_outline, h, M.METAL_SHEET) for h in (z, z + 0.9)]
    parts += _rim(deck_outline, z, z + 0.9, M.METAL_SHEET)
    for s in (0.2, 0.8):
        for t in (0.18, 0.48):
            xy = spot(s, t)
            parts.append(cylinder([*xy, low], [*xy, z], 0.18, M.METAL_SHEET, sides=8, caps=False))
            for ds in (-0.08, 0.08):
                at = spot(s + ds, t)
                parts.append(cylinder([*at, low], [*at, high + 1.9], 0.38, M.PLASTIC_DARK, sides=4))
    shop = Polygon([spot(0.1, 0.75), spot(0.9, 0.75), spot(0.9, 1.0), spot(0.1, 1.0)])
    design = draw_design("arterial", Polygon(ring), rng)
    design = design._replace(storeys=1, ground_floor="shop", roof="flat", ground_storey=4.0, plinth=0.02, balconies=0.0)
    if shop.area > 12:
        parts.append(_house(shop, side_of(spot(0.1, 0.75), spot(0.9, 0.75)), design, height_at, rng))
    return merge(parts)


def flat(footprint: Polygon, z: float, material: int) -> Mesh:
    """Build a level sheet over a footprint at height z [m]."""
    parts = shapely.get_parts(shapely.constrained_delaunay_triangles(footprint))
    corners = shapely.get_coordinates(parts).reshape(-1, 4, 2)[:, :3]
    return triangles(np.concatenate([corners, np.full((*corners.shape[:2], 1), z)], axis=-1), material)


def pitched(
    corners: ArrayLike, z: float, pitch: float, wall: int, over: Sequence[float], hip: float = 0.0, dormers: int = 0
) -> Mesh:
    """Build a gabled or hipped roof over four corners, with its ridge parallel to the first edge.

    Parameters
    ----------
    corners : (4, 2) array
        Corners, counter-clockwise [m].
    z : float
        Height of the walls' upper edge [m].
    pitch : float
        Slope of the roof, rise over run.
    wall : Material
        Material of gables and dormers. The roof itself is ROOF, its soffit WOOD.
    over : (eaves, verge)
        Overhang beyond the walls, below the slopes and at the gables [m].
    hip : float
        0 for upright gables, 1 for hips as steep as the slopes.
    dormers : int
        Number of dormers on each slope.
    """
    p = np.asarray(corners, np.float64)
    ends = np.stack([p[0] + p[3], p[1] + p[2]]) / 2  # below the ridge's ends
    span = float(np.linalg.norm(ends[1] - ends[0]))
    along = (ends[1] - ends[0]) / span
    run = float(np.linalg.norm(p[3] - p[0]) + np.linalg.norm(p[2] - p[1])) / 4
    across = (p[0] - p[3]) / np.linalg.norm(p[0] - p[3])
    eaves, verge = over
    rise, ahead, aside = pitch * run, eaves if hip else verge, np.array([[-1], [1], [1], [-1]])
    level = p + ahead * aside * along + eaves * np.array([[1], [1], [-1], [-1]]) * across
    eave = np.column_stack([level, np.full(4, z - pitch * eaves)])
    inset = min(hip * run, 0.48 * span) if hip else -verge
    ridge = np.column_stack([ends + inset * np.array([[1], [-1]]) * along, np.full(2, z + rise)])
    slopes = quads([[eave[0], eave[1], ridge[1], ridge[0]], [eave[2], eave[3], ridge[0], ridge[1]]], M.ROOF)
    soffit = quads(eave, M.WOOD)
    if hip:
        gables = triangles([[eave[1], eave[2], ridge[1]], [eave[3], eave[0], ridge[0]]], M.ROOF)
    else:
        top = np.column_stack([ends, np.full(2, z + rise)])
        at = np.column_stack([p, np.full(4, z)])
        gables = triangles([[at[1], at[2], top[1]], [at[3], at[0], top[0]]], wall)
    windows = _dormers(ends, along, across, run, z, rise, wall, dormers if rise > 2.4 else 0)
    return merge([slopes, soffit, gables, windows])


def chimney(x: float, y: float, low: float, top: float) -> Mesh:
    """Build a chimney or lift overrun, 0.6 m wide, at x, y between two heights [m]."""
    return box([x - 0.3, y - 0.3, low], [x + 0.3, y + 0.3, top], M.BRICK)


def _dormers(
    ends: Floats, along: Floats, across: Floats, run: float, z: float, rise: float, wall: int, count: int
) -> Mesh:
    """Build dormers with a window on both slopes."""
    length = float(np.linalg.norm(ends[1] - ends[0]))
    front, top = 0.78 * run, z + min(0.22 * rise + 1.5, 0.9 * rise)
    back, eave = run * (1 - (top - z) / rise), z + rise * (1 - front / run)
    faces = []
    for u in (np.arange(count) + 0.5) / max(count, 1) * length:
        for out in (across, -across):
            a, b = (ends[0] + (u + k) * along for k in (-0.7, 0.7))
            fa, fb, ba, bb = a + front * out, b + front * out, a + back * out, b + back * out
            faces += [
                [[*fa, eave], [*fb, eave], [*fb, top], [*fa, top]],
                [[*fa, top], [*fb, top], [*bb, top], [*ba, top]],
                [[*fa, eave], [*fa, top], [*ba, top], [*ba, top - 0.01]],
                [[*fb, eave], [*fb, top], [*bb, top], [*bb, top - 0.01]],
            ]
    return quads(faces, np.tile([int(M.WINDOW), int(M.ROOF), wall, wall], 2 * count))
