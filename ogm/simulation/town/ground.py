"""The ground: the triangles of roads, sidewalks and yards, and the kerbs between them.

Two heights are defined everywhere: that of the road and that of the land beside it, which lies a kerb
higher. Which one holds is given by the plan. All lines of the plan and a grid are cut at their crossings
into faces; every face is triangulated with all its corners, so neighbours share their corners exactly and
no ray falls between them; where road and land meet, an upright kerb closes the step.
"""

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from ogm.extras import import_extra
from ogm.simulation.materials import GROUND, Material
from ogm.simulation.mesh import Mesh, quads
from ogm.simulation.town.layout import TownLayout
from ogm.simulation.town.terrain import Raster, Terrain, raster

TILE = 4.0  # [m] of the grid that cuts the ground


def cover(plan: TownLayout, terrain: Terrain) -> tuple[Mesh, Mesh]:
    """Cover the town with ground: surfaces and kerbs as two meshes.

    The road's height holds on the plan's `road`, elsewhere the land's. Of its `zones`, which together cover the
    town, a later one covers an earlier one; its `lines` are more lines to cut along, such as the ridge of a road.
    """
    half, road, zones = plan.size / 2, plan.road, plan.zones
    ticks = np.arange(int(np.ceil(plan.size / TILE)) + 1) * TILE - half
    ticks[-1] = half
    cuts = np.array([[(t, -half), (t, half)] for t in ticks] + [[(-half, t), (half, t)] for t in ticks])
    shapes = np.array([zone.shape for zone in zones], dtype=object)
    edges = [*shapely.linestrings(cuts), *shapely.boundary(shapes), *plan.lines, shapely.boundary(road)]
    parts = shapely.get_parts(np.array([edge for edge in edges if not edge.is_empty], dtype=object))
    noded = shapely.union_all(parts, grid_size=1e-3)
    frame = shapely.box(-half, -half, half, half)
    faces = shapely.get_parts(shapely.polygonize([shapely.intersection(noded, frame)]))
    # What each face is made of: the last zone that holds a point of it.
    probe = shapely.point_on_surface(faces)
    tree = shapely.STRtree(probe)
    material = np.full(len(faces), int(Material.GRASS), np.uint8)
    shapely.prepare(shapes)
    zone_of, face_of = tree.query(shapes, predicate="intersects")
    order = np.argsort(zone_of, kind="stable")
    material[face_of[order]] = np.array([zone.material for zone in zones], np.uint8)[zone_of[order]]
    shapely.prepare(road)
    low = np.asarray(shapely.intersects(road, probe))
    # Triangles of every face, with all its corners.
    pieces, owner = shapely.get_parts(shapely.constrained_delaunay_triangles(faces), return_index=True)
    corners = shapely.get_coordinates(pieces).reshape(-1, 4, 2)[:, :3]
    keys = np.round((corners + half) * 1000).astype(np.int64)
    step = 1 << 24
    code = (keys[..., 0] * step + keys[..., 1]) * 2 + low[owner][:, None]
    unique, index = np.unique(code, return_inverse=True)
    triangles = index.reshape(-1, 3)
    kept = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    triangles, owner = triangles[kept], owner[kept]
    lowered = (unique & 1).astype(bool)
    x = (unique // 2 // step) / 1000 - half
    y = (unique // 2 % step) / 1000 - half
    z = np.where(lowered, terrain.road(x, y), terrain.land(x, y, plan.drops))
    vertices = np.stack([x, y, z], axis=1).astype(np.float32)
    return Mesh(vertices, triangles.astype(np.uint32), material[owner]), _kerbs(vertices, triangles, unique, lowered)


def _kerbs(vertices: NDArray[Any], triangles: NDArray[Any], code: NDArray[Any], lowered: NDArray[Any]) -> Mesh:
    """Close the steps between road and land: wherever an edge of the one runs along an edge of the other."""
    sides = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    place = code // 2
    swap = place[sides[:, 0]] > place[sides[:, 1]]
    sides = np.where(swap[:, None], sides[:, ::-1], sides)
    below = np.unique(sides[lowered[sides[:, 0]]], axis=0)
    above = np.unique(sides[~lowered[sides[:, 0]]], axis=0)
    _, number = np.unique(np.concatenate([place[below], place[above]]), axis=0, return_inverse=True)
    _, at_below, at_above = np.intersect1d(number[: len(below)], number[len(below) :], return_indices=True)
    lower, upper = below[at_below], above[at_above]
    used = np.stack([lower[:, 0], lower[:, 1], upper[:, 1], upper[:, 0]], axis=1)
    height = np.max(vertices[upper, 2] - vertices[lower, 2], axis=1)
    material = np.where(height < 0.05, int(Material.PAVING), int(Material.KERB)).astype(np.uint8)
    return quads(vertices[used], material)


def height_raster(ground: Mesh, size: float, step: float) -> Raster:
    """Sample the height of a ground's triangles by rays cast down."""
    open3d = import_extra("open3d", "sim")
    tensor = open3d.core.Tensor
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(tensor(ground.vertices), tensor(ground.triangles))
    ticks = np.arange(int(round(size / step)) + 1) * step - size / 2
    inside = np.clip(ticks, -size / 2 + 1e-3, size / 2 - 1e-3)
    top = float(ground.vertices[:, 2].max()) + 1.0
    rays = np.zeros((len(ticks), len(ticks), 6), np.float32)
    rays[..., 0], rays[..., 1] = inside[:, None], inside
    rays[..., 2], rays[..., 5] = top, -1.0
    height = top - scene.cast_rays(tensor(rays), nthreads=1)["t_hit"].numpy()
    missed = ~np.isfinite(height)
    if missed.any():  # a ray that slipped between two triangles: take its neighbour
        nearest = distance_transform_edt(missed, return_distances=False, return_indices=True)
        height = height[tuple(nearest)]
    return raster(height, step, size)


def surface(ground: Mesh) -> Mesh:
    """Return the triangles that one may stand on."""
    stand = np.isin(ground.material, [int(m) for m in GROUND])
    return Mesh(ground.vertices, ground.triangles[stand], ground.material[stand])
