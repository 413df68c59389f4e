"""Design of a house, and parts of its facades: walls with openings in wall coordinates u, d, z."""

from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike
from shapely import Polygon

from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Bytes, Floats, Mesh, quads

Corners = Floats  # (N, 4, 3)


class Side(NamedTuple):
    """The upright plane of a wall, with the coordinates u along it and d outwards.

    Attributes
    ----------
    start : (2,) float64
        Point x, y with u = 0 [m]. The house is to the left of the wall's direction.
    along, out : (2,) float64
        Unit vectors of u and d in the plane.
    length : float
        Length of the wall [m].
    """

    start: Floats
    along: Floats
    out: Floats
    length: float

    def xy(self, u: ArrayLike, d: float = 0.0) -> Floats:
        """Return x, y (..., 2) of points at u along the wall and d in front of it."""
        return self.start + np.asarray(u, np.float64)[..., None] * self.along + d * self.out

    def built(self, pieces: list[tuple[Corners, ArrayLike]]) -> Mesh:
        """Return the mesh of quadrilaterals with materials in world coordinates, without empty faces."""
        corners = np.concatenate([piece for piece, _ in pieces])
        material = np.concatenate([np.broadcast_to(m, len(piece)) for piece, m in pieces])
        area = np.abs(np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])).max(axis=1)
        corners, material = corners[area > 1e-6], material[area > 1e-6]
        level = self.start + corners[..., :1] * self.along + corners[..., 1:2] * self.out
        return quads(np.concatenate([level, corners[..., 2:]], axis=-1), material)


def side_of(start: ArrayLike, end: ArrayLike) -> Side:
    """Return the side between two corners of a counter-clockwise footprint."""
    a, b = np.asarray(start, np.float64), np.asarray(end, np.float64)
    length = float(np.linalg.norm(b - a))
    along = (b - a) / length
    return Side(a, along, np.array([along[1], -along[0]]), length)


class Openings(NamedTuple):
    """Windows and doors in columns and rows.

    Attributes
    ----------
    left, right : (C,) float64
        Edges of the columns, ascending along u [m].
    sill, head : (C, R) float64
        Lower and upper edges, rows ascending along z [m].
    recess : (C, R) float64
        Distance of the pane behind the wall [m].
    pane : (C, R) uint8
        Material of the pane.
    """

    left: Floats
    right: Floats
    sill: Floats
    head: Floats
    recess: Floats
    pane: Bytes


def upright(u0: ArrayLike, u1: ArrayLike, d0: ArrayLike, d1: ArrayLike, z0: ArrayLike, z1: ArrayLike) -> Corners:
    """Return upright rectangles over the ground lines from (u0, d0) to (u1, d1)."""
    return _corners((u0, u1, u1, u0), (d0, d1, d1, d0), (z0, z0, z1, z1))


def deck(u0: ArrayLike, u1: ArrayLike, d0: ArrayLike, d1: ArrayLike, z0: ArrayLike, z1: ArrayLike) -> Corners:
    """Return level or tilted rectangles from d0 (at height z0) to d1 (at height z1)."""
    return _corners((u0, u1, u1, u0), (d0, d0, d1, d1), (z0, z0, z1, z1))


def _corners(u: tuple[ArrayLike, ...], d: tuple[ArrayLike, ...], z: tuple[ArrayLike, ...]) -> Corners:
    """Return corners (N, 4, 3) from the coordinates of four corners, which are broadcast."""
    corners = np.stack(np.broadcast_arrays(*u, *d, *z), axis=-1).astype(np.float64)
    return corners.reshape(-1, 3, 4).swapaxes(1, 2)


def punched(
    length: float, low: float, top: float, openings: Openings, material: int
) -> list[tuple[Corners, ArrayLike]]:
    """Return a wall from `low` to `top` with openings: wall pieces, reveals and panes."""
    left, right, sill, head, recess, pane = openings
    columns = len(left)
    strips = upright(np.append(0.0, right), np.append(left, length), 0.0, 0.0, low, top)
    under = np.column_stack([np.full(columns, low), head])
    over = np.column_stack([sill, np.full(columns, top)])
    a, b = left[:, None], right[:, None]
    pieces = [
        strips,
        upright(a, b, 0.0, 0.0, under, np.maximum(over, under)),
        upright(a, a, -recess, 0.0, sill, head),
        upright(b, b, -recess, 0.0, sill, head),
        deck(a, b, -recess, 0.0, sill, sill),
        deck(a, b, -recess, 0.0, head, head),
    ]
    return [(np.concatenate(pieces), material), (upright(a, b, -recess, -recess, sill, head), pane.ravel())]


def ledge(u0: float, u1: float, depth: float, z0: float, z1: float) -> Corners:
    """Return the visible faces of a box on a wall, such as a cornice, shop sign, pilaster or downpipe."""
    faces = upright([u0, u0, u1], [u1, u0, u1], [depth, 0, 0], depth, z0, z1)
    return np.concatenate([faces, deck(u0, u1, 0, depth, [z0, z1], [z0, z1])])


def awning(u0: float, u1: float, depth: float, z: float, drop: float) -> Corners:
    """Return a shop awning that descends by `drop`, with a short fringe."""
    fringe = upright(u0, u1, depth, depth, z - drop - 0.2, z - drop)
    return np.concatenate([deck(u0, u1, 0.0, depth, z, z - drop), fringe])


def balcony(u0: float, u1: float, depth: float, z: float, bars: int, panel: int) -> list[tuple[Corners, ArrayLike]]:
    """Return a balcony with the upper face of its slab at height z.

    Parameters
    ----------
    u0, u1, depth, z : float
        Ends along the wall, depth, and height of the floor [m].
    bars : int
        Number of bars in the front railing; 0 for closed panels.
    panel : Material
        Material of panels; bars are METAL_POLE.
    """
    pieces: list[tuple[Corners, ArrayLike]] = [(ledge(u0, u1, depth, z - 0.18, z), M.CONCRETE)]
    d = depth - 0.05
    if not bars:
        fronts = upright([u0, u0, u1], [u1, u0, u1], [d, 0, 0], d, z + 0.06, z + 1.0)
        return [*pieces, (fronts, panel)]
    rail = upright([u0, u0, u1], [u1, u0, u1], [d, 0, 0], d, z + 0.96, z + 1.02)
    u = np.linspace(u0, u1, bars)
    side = np.linspace(0.2, d, 3)
    front = upright(u - 0.012, u + 0.012, d - 0.012, d + 0.012, z, z + 1.0)
    at, out = np.repeat([u0, u1], 3), np.tile(side, 2)
    ends = upright(at, at, out - 0.012, out + 0.012, z, z + 1)
    return [*pieces, (np.concatenate([rail, front, ends]), M.METAL_POLE)]


def steps(u0: float, u1: float, ground: float, top: float) -> Corners:
    """Return steps up to a door's sill, 0.28 m deep each; the lowest extends below the ground."""
    count = max(int(np.ceil((top - ground) / 0.18)), 1)
    rise = (top - ground) / count
    k = np.arange(count)
    z1, d1 = top - k * rise, 0.45 + 0.28 * k
    d0 = np.append(0.0, d1[:-1])
    z0 = np.append(z1[1:], ground - 0.4)
    ends = [upright(u, u, d0, d1, ground - 0.4, z1) for u in (u0, u1)]
    return np.concatenate([upright(u0, u1, d1, d1, z0, z1), deck(u0, u1, d0, d1, z1, z1), *ends])


class HouseDesign(NamedTuple):
    """Sizes and materials of a house; lengths in metres."""

    storeys: int
    ground_storey: float
    storey: float
    plinth: float  # height of the floor above the highest ground at the front
    wall: int
    base: int  # material of the ground floor's wall
    bay: float  # spacing of windows
    window: tuple[float, float, float]  # width, sill and head above the floor
    recess: float
    ground_floor: str  # "home", "shop", "hall"
    balconies: float  # share of the front's columns with balconies
    panel: int  # material of balcony panels; METAL_POLE for bars
    bays: bool
    blind_sides: bool
    roof: str  # "flat", "gable", "hip"
    pitch: float
    eaves: float


def draw_design(style: str, outline: Polygon, rng: Generator) -> HouseDesign:
    """Draw sizes and materials of a house for a style and the size of its footprint."""
    area = outline.area
    light, dark, brick, stone = int(M.PLASTER_LIGHT), int(M.PLASTER_DARK), int(M.BRICK), int(M.STONE)
    sheet, concrete, wood = int(M.METAL_SHEET), int(M.CONCRETE), int(M.WOOD)
    u = rng.uniform
    if style == "centre":
        old = rng.random() < 0.6
        wall = int(rng.choice([light, dark, brick, stone], p=[0.45, 0.25, 0.2, 0.1]))
        shop = rng.random() < 0.6
        storeys = int(rng.integers(3, 7)) if area > 60 else int(rng.integers(1, 4))
        window = (u(1.0, 1.35), u(0.5, 0.85), u(2.3, 2.7)) if old else (u(1.3, 2.0), u(0.8, 0.95), u(2.15, 2.3))
        return HouseDesign(
            storeys, u(3.7, 4.4), u(3.2, 3.7) if old else u(2.8, 3.0), 0.03 if shop else u(0.15, 0.9),
            wall, stone if rng.random() < 0.3 else wall, u(2.2, 2.8) if old else u(2.6, 3.4), window,
            u(0.08, 0.16), "shop" if shop else "home", u(0.0, 0.5) if rng.random() < 0.45 else 0.0,
            int(M.METAL_POLE) if old else int(rng.choice([light, int(M.CAR_GLASS), sheet])),
            old and rng.random() < 0.35, rng.random() < 0.75,
            "gable" if rng.random() < 0.6 else "flat", u(0.6, 1.1), u(0.2, 0.5),
        )  # fmt: skip
    if style == "suburb":
        hut = area < 40
        storeys = 1 if hut else int(rng.choice([2, 2, 2, 3] if area > 150 else [1, 2, 2, 2]))
        wall = int(rng.choice([light, dark, brick, wood], p=[0.6, 0.15, 0.18, 0.07]))
        return HouseDesign(
            storeys, u(2.4, 2.6) if hut else u(2.7, 2.9), u(2.6, 2.8), 0.0 if hut else u(0.1, 0.7),
            wall, wall, u(2.6, 3.6), (u(1.0, 1.9), u(0.8, 0.95), u(2.1, 2.25)),
            u(0.06, 0.14), "garage" if hut else "home", u(0.2, 0.7) if storeys > 1 and rng.random() < 0.4 else 0.0,
            int(rng.choice([int(M.METAL_POLE), wood])), not hut and rng.random() < 0.25, False,
            "flat" if rng.random() < (0.6 if hut else 0.1) else "gable" if rng.random() < 0.75 else "hip",
            u(0.55, 1.0), u(0.3, 0.7),
        )  # fmt: skip
    if style == "industrial" and area > 60:
        return HouseDesign(
            1, u(5.5, 10.5), 3.2, 0.0, int(rng.choice([sheet, concrete, brick], p=[0.55, 0.25, 0.2])), concrete,
            u(5.0, 7.0), (u(2.5, 4.5), 3.4, 4.6), 0.1, "hall", 0.0, sheet, False, False,
            "flat" if rng.random() < 0.6 else "gable", u(0.1, 0.25), u(0.1, 0.4),
        )  # fmt: skip
    if style == "park":
        return HouseDesign(
            1, u(2.7, 3.6), 2.8, 0.05, wood if rng.random() < 0.6 else light, wood, 2.2, (1.3, 0.95, 2.1), 0.1,
            "home", 0.0, wood, False, False, str(rng.choice(["gable", "hip", "flat"])), u(0.4, 0.8), u(0.3, 0.8),
        )  # fmt: skip
    kind = rng.random() if area > 120 else 0.5
    if style == "arterial" and kind < 0.3:  # a market
        wall = int(rng.choice([sheet, light, brick]))
        return HouseDesign(
            1, u(4.8, 6.8), 3.0, 0.0, wall, wall, u(2.8, 3.6), (2.4, 0.2, 2.7), 0.12, "shop", 0.0, sheet, False,
            False, "flat", 0.3, 0.6,
        )  # fmt: skip
    flats = style == "arterial" and kind > 0.65
    wall = int(rng.choice([light, dark, concrete, brick, sheet], p=[0.4, 0.15, 0.2, 0.15, 0.1]))
    bay = u(2.8, 3.8)
    storeys = int(rng.integers(3, 9)) if style == "arterial" else int(rng.integers(1, 4))
    return HouseDesign(
        storeys, u(3.0, 4.2), u(2.8, 3.5), u(0.0, 0.5), wall, concrete if rng.random() < 0.3 else wall, bay,
        (u(1.4, 2.0), 0.85, 2.25) if flats else (0.82 * bay, u(0.6, 0.9), 2.5),
        u(0.06, 0.18), "shop" if rng.random() < 0.5 else "home", u(0.3, 0.7) if flats else 0.0,
        int(rng.choice([sheet, concrete, int(M.CAR_GLASS)])), False, False, "flat", 0.3, 0.4,
    )  # fmt: skip
