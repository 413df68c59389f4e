"""Roofs: flat ones behind parapets, gabled and hipped ones with eaves, chimneys and dormers."""

from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import ArrayLike
from shapely import Polygon

from ogm.simulation.arrays import Floats
from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Mesh, box, merge, quads
from ogm.simulation.town.shapes import triangles


def flat(footprint: Polygon, z: float, material: int) -> Mesh:
    """Cover a footprint of any shape with a level sheet at height z [m]."""
    parts = shapely.get_parts(shapely.constrained_delaunay_triangles(footprint))
    corners = shapely.get_coordinates(parts).reshape(-1, 4, 2)[:, :3]
    return triangles(np.concatenate([corners, np.full((*corners.shape[:2], 1), z)], axis=-1), material)


def pitched(
    corners: ArrayLike, z: float, pitch: float, wall: int, over: Sequence[float], hip: float = 0.0, dormers: int = 0
) -> Mesh:
    """Set a gabled or hipped roof on four corners; the ridge runs beside the first edge.

    Parameters
    ----------
    corners : (4, 2) array
        Counter-clockwise [m].
    z : float
        Height of the walls' top [m].
    pitch : float
        Slope: rise over run.
    wall : Material
        Of gables and dormers; the roof itself is ROOF, its soffit WOOD.
    over : (eaves, verge)
        How far it reaches over the walls along and across the slopes [m].
    hip : float
        0 for upright gables, 1 for a hip as steep as the slopes.
    dormers : int
        How many on each slope.
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
    """Set a chimney or lift house of 0.6 m at x, y, between two heights [m]."""
    return box([x - 0.3, y - 0.3, low], [x + 0.3, y + 0.3, top], M.BRICK)


def _dormers(
    ends: Floats, along: Floats, across: Floats, run: float, z: float, rise: float, wall: int, count: int
) -> Mesh:
    """Set boxes with a window into both slopes."""
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
