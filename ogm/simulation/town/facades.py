"""One side of a house: a wall with openings, and what stands out of it. Everything in the side's own u, d, z."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.simulation.arrays import Floats
from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Mesh, quads

Corners = Floats  # (N, 4, 3)


class Side(NamedTuple):
    """The upright plane of a wall.

    Attributes
    ----------
    start : (2,) float64
        Where u is 0: x, y [m]. The house lies to the left of the way from here.
    along, out : (2,) float64
        Unit vectors of u (along the wall) and d (out of the house).
    length : float
        Of the wall [m].
    """

    start: Floats
    along: Floats
    out: Floats
    length: float

    def xy(self, u: ArrayLike, d: float = 0.0) -> Floats:
        """Return x, y (..., 2) of places along the wall, d before it."""
        return self.start + np.asarray(u, np.float64)[..., None] * self.along + d * self.out

    def built(self, pieces: list[tuple[Corners, ArrayLike]]) -> Mesh:
        """Take quadrilaterals with their materials to the world; drop those without area."""
        corners = np.concatenate([piece for piece, _ in pieces])
        material = np.concatenate([np.broadcast_to(m, len(piece)) for piece, m in pieces])
        area = np.abs(np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])).max(axis=1)
        corners, material = corners[area > 1e-6], material[area > 1e-6]
        level = self.start + corners[..., :1] * self.along + corners[..., 1:2] * self.out
        return quads(np.concatenate([level, corners[..., 2:]], axis=-1), material)


def side_of(start: ArrayLike, end: ArrayLike) -> Side:
    """Return the side between two corners of a footprint that runs counter-clockwise."""
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
        How far the pane is set back [m].
    pane : (C, R) uint8
        Material of the pane.
    """

    left: Floats
    right: Floats
    sill: Floats
    head: Floats
    recess: Floats
    pane: NDArray[np.uint8]


def upright(u0: ArrayLike, u1: ArrayLike, d0: ArrayLike, d1: ArrayLike, z0: ArrayLike, z1: ArrayLike) -> Corners:
    """Return upright rectangles over the ground lines from (u0, d0) to (u1, d1)."""
    return _corners((u0, u1, u1, u0), (d0, d1, d1, d0), (z0, z0, z1, z1))


def deck(u0: ArrayLike, u1: ArrayLike, d0: ArrayLike, d1: ArrayLike, z0: ArrayLike, z1: ArrayLike) -> Corners:
    """Return level or tilted rectangles from d0 (at height z0) to d1 (at height z1)."""
    return _corners((u0, u1, u1, u0), (d0, d0, d1, d1), (z0, z0, z1, z1))


def _corners(u: tuple[ArrayLike, ...], d: tuple[ArrayLike, ...], z: tuple[ArrayLike, ...]) -> Corners:
    """Return (N, 4, 3) corners from the coordinates of the four, which broadcast against each other."""
    corners = np.stack(np.broadcast_arrays(*u, *d, *z), axis=-1).astype(np.float64)
    return corners.reshape(-1, 3, 4).swapaxes(1, 2)


def punched(
    length: float, low: float, top: float, openings: Openings, material: int
) -> list[tuple[Corners, ArrayLike]]:
    """Cut openings into a wall from `low` to `top`: what is left of it, reveals and panes."""
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
    """Return what is seen of a box on a wall: a cornice, a sign above a shop, a pilaster, a downpipe."""
    faces = upright([u0, u0, u1], [u1, u0, u1], [depth, 0, 0], depth, z0, z1)
    return np.concatenate([faces, deck(u0, u1, 0, depth, [z0, z1], [z0, z1])])


def awning(u0: float, u1: float, depth: float, z: float, drop: float) -> Corners:
    """Return a shop's awning: cloth that falls by `drop`, with a short fringe."""
    fringe = upright(u0, u1, depth, depth, z - drop - 0.2, z - drop)
    return np.concatenate([deck(u0, u1, 0.0, depth, z, z - drop), fringe])


def balcony(u0: float, u1: float, depth: float, z: float, bars: int, panel: int) -> list[tuple[Corners, ArrayLike]]:
    """Make a balcony whose slab ends at height z.

    Parameters
    ----------
    u0, u1, depth, z : float
        Its edges along the wall, how far it stands out, height of its floor [m].
    bars : int
        Upright bars of the railing's front; 0 for closed panels.
    panel : Material
        Of the panels; bars are METAL_POLE.
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
    """Return the steps up to a door's sill, 0.28 m deep each; the lowest reaches below the ground."""
    count = max(int(np.ceil((top - ground) / 0.18)), 1)
    rise = (top - ground) / count
    k = np.arange(count)
    z1, d1 = top - k * rise, 0.45 + 0.28 * k
    d0 = np.append(0.0, d1[:-1])
    z0 = np.append(z1[1:], ground - 0.4)
    ends = [upright(u, u, d0, d1, ground - 0.4, z1) for u in (u0, u1)]
    return np.concatenate([upright(u0, u1, d1, d1, z0, z1), deck(u0, u1, d0, d1, z1, z1), *ends])
