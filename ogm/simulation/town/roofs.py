"""Roofs: flat ones behind parapets, gabled and hipped ones with eaves, chimneys and dormers."""

import numpy as np
import shapely
from numpy.typing import ArrayLike
from shapely import Polygon

from ogm.simulation.arrays import Floats
from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Mesh, box, merge, quads


def flat(footprint: Polygon, z: float, material: int) -> Mesh:
    """Cover a footprint of any shape with a level sheet at height z [m]."""
    corners = np.array(
        [np.array(part.exterior.coords)[:3] for part in shapely.constrained_delaunay_triangles(footprint).geoms]
    ).reshape(-1, 3, 2)
    vertices = np.concatenate([corners, np.full((*corners.shape[:2], 1), z)], axis=-1).reshape(-1, 3)
    triangles = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
    return Mesh(vertices.astype(np.float32), triangles, np.full(len(triangles), material, np.uint8))


def pitched(
    corners: ArrayLike,
    z: float,
    pitch: float,
    wall: int,
    *,
    eaves: float = 0.4,
    verge: float = 0.2,
    hip: float = 0.0,
    dormers: int = 0,
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
    eaves, verge : float
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
    rise, low = pitch * run, z - pitch * eaves
    over = verge if hip == 0 else eaves
    eave = np.column_stack(
        [p + over * np.array([[-1], [1], [1], [-1]]) * along + eaves * np.array([[1], [1], [-1], [-1]]) * across]
        + [np.full(4, low)]
    )
    inset = min(hip * run, 0.48 * span) if hip else -verge
    ridge = np.column_stack([ends + inset * np.array([[1], [-1]]) * along, np.full(2, z + rise)])
    slopes = quads([[eave[0], eave[1], ridge[1], ridge[0]], [eave[2], eave[3], ridge[0], ridge[1]]], M.ROOF)
    soffit = quads(eave, M.WOOD)
    if hip:
        triangles, ends_material = [[eave[1], eave[2], ridge[1]], [eave[3], eave[0], ridge[0]]], int(M.ROOF)
    else:
        top = np.column_stack([ends, np.full(2, z + rise)])
        at = np.column_stack([p, np.full(4, z)])
        triangles, ends_material = [[at[1], at[2], top[1]], [at[3], at[0], top[0]]], wall
    gables = Mesh(
        np.array(triangles, np.float32).reshape(-1, 3),
        np.arange(6, dtype=np.uint32).reshape(2, 3),
        np.full(2, ends_material, np.uint8),
    )
    parts = [slopes, soffit, gables]
    if dormers and rise > 2.4:
        parts.append(_dormers(ends, along, across, run, z, rise, wall, dormers))
    return merge(parts)


def chimney(x: float, y: float, low: float, top: float) -> Mesh:
    """Set a chimney or lift house of 0.6 m at x, y, between two heights [m]."""
    return box([x - 0.3, y - 0.3, low], [x + 0.3, y + 0.3, top], M.BRICK)


def _dormers(
    ends: Floats, along: Floats, across: Floats, run: float, z: float, rise: float, wall: int, count: int
) -> Mesh:
    """Set boxes with a window into both slopes."""
    length = float(np.linalg.norm(ends[1] - ends[0]))
    faces, material = [], []
    for u in (np.arange(count) + 0.5) / count * length:
        for s in (1.0, -1.0):
            out, front, top = s * across, 0.78 * run, z + min(0.22 * rise + 1.5, 0.9 * rise)
            back = run * (1 - (top - z) / rise)
            eave = z + rise * (1 - front / run)
            a, b = (ends[0] + (u + k) * along for k in (-0.7, 0.7))
            fa, fb, ba, bb = a + front * out, b + front * out, a + back * out, b + back * out
            faces += [
                [[*fa, eave], [*fb, eave], [*fb, top], [*fa, top]],
                [[*fa, top], [*fb, top], [*bb, top], [*ba, top]],
                [[*fa, eave], [*fa, top], [*ba, top], [*ba, top - 0.01]],
                [[*fb, eave], [*fb, top], [*bb, top], [*bb, top - 0.01]],
            ]
            material += [int(M.WINDOW), int(M.ROOF), wall, wall]
    return quads(faces, material)
