"""Ground of a town: heights of hills, banks, crowned roads and kerbs, and the triangles of roads, sidewalks and yards.

Two heights are defined everywhere: the road's, and the land's next to it, which is a kerb higher. The layout selects
one of the two. All lines of the layout and a grid are cut at their crossings into faces. Every face is triangulated
with all its corners, so that neighbours share corners exactly and no ray passes between them. An upright kerb closes
the step between road and land.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
from numpy.random import Generator
from numpy.typing import ArrayLike
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial import cKDTree
from shapely.geometry.base import BaseGeometry

from ogm.extras import import_extra
from ogm.simulation.materials import GROUND, Material
from ogm.simulation.mesh import Array, Floats, Floats32, HeightAt, Mask, Mesh, quads
from ogm.simulation.town.layout import Drop, TownLayout

CROWN = 0.025  # cross slope of a road, from its middle to the kerbs
CROWN_REACH = 4.0  # [m] distance from the kerb beyond which the road is level
FIELD = 0.5  # [m] spacing of the rasters of heights
DROPPED = 0.02  # [m] height of a dropped kerb
# [m] unevenness of the land in a district
UNEVEN = {"centre": 0.1, "suburb": 0.5, "industrial": 0.15, "park": 1.4, "country": 0.9}
STEEPEST = 0.068  # steepest grade of the hills, without crown and bumps


@dataclass(frozen=True, eq=False)
class Raster:
    """A square raster of values at the points `corner` + `step` * (i, j)."""

    values: Floats32
    step: float
    corner: tuple[float, float]

    def __call__(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """Return values interpolated bilinearly, constant beyond the edge."""
        u = np.clip((np.asarray(x, np.float64) - self.corner[0]) / self.step, 0, len(self.values) - 1)
        v = np.clip((np.asarray(y, np.float64) - self.corner[1]) / self.step, 0, self.values.shape[1] - 1)
        i = np.minimum(u.astype(np.int64), len(self.values) - 2)
        j = np.minimum(v.astype(np.int64), self.values.shape[1] - 2)
        u, v = u - i, v - j
        near = self.values[i, j] * (1 - v) + self.values[i, j + 1] * v
        far = self.values[i + 1, j] * (1 - v) + self.values[i + 1, j + 1] * v
        return np.asarray(near * (1 - u) + far * u)


def raster(values: Array, step: float, size: float) -> Raster:
    """Return a raster over a square of `size` metres around (0, 0)."""
    return Raster(values.astype(np.float32), step, (-size / 2, -size / 2))


def raised(points: Floats, height_at: HeightAt) -> Floats:
    """Return points (M, 2) with their heights, (M, 3)."""
    return np.column_stack([points, height_at(*points.T)])


class Terrain(NamedTuple):
    """Components of the ground heights."""

    waves: Floats  # (W, 4) wave numbers along x and y [rad/m], phase [rad], amplitude [m]
    bowls: Floats  # (B, 4) x, y, radius, height of dips (negative) and humps [m]
    crown: Raster
    bank: HeightAt
    kerb: Raster

    def base(self, x: Floats, y: Floats) -> Floats:
        """Return the height of the hills alone [m]."""
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        z = np.zeros(np.broadcast(x, y).shape)
        for kx, ky, phase, amplitude in self.waves:
            z += amplitude * np.sin(kx * x + ky * y + phase)
        for cx, cy, radius, height in self.bowls:
            z += height * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * radius**2))
        return z

    def road(self, x: Floats, y: Floats) -> Floats:
        """Return the height of the road surface [m]."""
        return self.base(x, y) + self.crown(x, y)

    def land(self, x: Floats, y: Floats, drops: Sequence[Drop] = ()) -> Floats:
        """Return the height of the land next to the road, including the kerb [m]."""
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        kerb = self.kerb(x, y)
        if drops:
            tree = cKDTree(np.stack([x, y], axis=1))
            low = np.zeros(len(x))
            for drop in drops:
                near = np.array(tree.query_ball_point(drop.at, drop.half + 3.0), np.int64)
                low[near] = np.maximum(low[near], drop.share(x[near], y[near]))
            kerb = kerb * (1 - low) + DROPPED * low
        return self.road(x, y) + kerb + self.bank(x, y)


def mask(shape: BaseGeometry, size: float, step: float) -> Mask:
    """Return the mask (n, n) of a raster's points from -size/2 to size/2 within a shape."""
    ticks = np.arange(int(round(size / step)) + 1) * step - size / 2
    result = np.zeros((len(ticks), len(ticks)), bool)
    if shape.is_empty:
        return result
    x0, y0, x1, y1 = shape.bounds
    i, j = slice(*np.searchsorted(ticks, (x0, x1 + step))), slice(*np.searchsorted(ticks, (y0, y1 + step)))
    shapely.prepare(shape)
    x, y = np.meshgrid(ticks[i], ticks[j], indexing="ij")
    result[i, j] = shapely.contains_xy(shape, x, y)
    return result


def make_terrain(plan: TownLayout, rng: Generator) -> Terrain:
    """Draw hills, and fit banks, crowns and kerbs to the streets of a layout."""
    size, streets = plan.size, plan.network.streets
    # Hills: long waves no steeper than STEEPEST, and bumps that a car feels.
    length = np.concatenate([rng.uniform(170, 420, 5), rng.uniform(70, 130, 3)])
    angle = rng.uniform(0, 2 * np.pi, 8)
    amplitude = length / 100 * np.where(np.arange(8) < 5, 1.0, 0.35) * rng.uniform(0.5, 1.2, 8)
    waves = _waves(length, angle, amplitude, rng)
    around = rng.uniform(-0.3, 0.3, (2, 2)) * size
    longest = max(streets, key=lambda street: street.length)
    dip = longest.at(longest.length * 0.5)
    bowls = np.array([[*dip, 16.0, -0.9], [*around[0], 30.0, 1.5], [*around[1], 25.0, -1.2]])
    level = raster(np.zeros((2, 2)), size, size)
    ticks = np.arange(-size / 2, size / 2 + 2, 2.0)
    hills = Terrain(waves, bowls, level, level, level).base(*np.meshgrid(ticks, ticks, indexing="ij"))
    share = STEEPEST / np.hypot(*np.gradient(hills, 2.0)).max()
    waves[:, 3] *= share
    bowls[:, 3] *= share
    fine = np.concatenate([rng.uniform(18, 40, 4), rng.uniform(6, 12, 4)])
    bumps = _waves(fine, rng.uniform(0, 2 * np.pi, 8), np.where(np.arange(8) < 4, 0.012, 0.003), rng)
    # Crown: rises from the kerbs to the middle of the road.
    on_road = mask(plan.road, size, FIELD)
    inside = distance_transform_edt(on_road) * FIELD
    crown = CROWN * np.minimum(gaussian_filter(np.minimum(inside, CROWN_REACH + 1), 1.0), CROWN_REACH)
    crown = np.where(on_road, crown, 0.0)
    # Banks: behind the sidewalk the land departs from the street's level, depending on the district.
    beyond = distance_transform_edt(~mask(plan.corridor, size, FIELD)) * FIELD
    ramp = np.clip(beyond - 0.5, 0, 9) / 9
    ramp = ramp**2 * (3 - 2 * ramp)
    shape = on_road.shape
    rough = gaussian_filter(rng.standard_normal((shape[0] // 8 + 2, shape[1] // 8 + 2)), 3.0)
    rough = rough / rough.std()
    edge = size / 2
    rim = [p for t in np.linspace(-edge, edge, 9) for p in ((t, -edge), (t, edge), (-edge, t), (edge, t))]
    uneven = np.array([UNEVEN[style] for style in plan.network.grid.styles] + [1.3] * len(rim))
    gx, gy = np.meshgrid(*(np.arange(s) * 8 * FIELD - edge for s in rough.shape), indexing="ij")
    far = np.stack([np.hypot(gx - x, gy - y) for x, y in [*plan.network.grid.faces, *rim]])
    field = raster(rough * gaussian_filter(uneven[far.argmin(axis=0)], 2.0), 8 * FIELD, size)
    px, py = np.meshgrid(*(np.arange(s) * FIELD - edge for s in shape), indexing="ij")
    bank = ramp * np.clip(field(px, py), -2.5, 2.5)
    # Kerbs: height from the cross-section of the nearest street.
    kerb = np.full(shape, 0.11)
    for street in streets:
        near = shapely.buffer(shapely.linestrings(street.line), 14.0, cap_style="flat")
        kerb[mask(near, size, FIELD)] = street.profile.kerb
    rasters = (raster(values, FIELD, size) for values in (crown, bank, gaussian_filter(kerb, 4.0)))
    return Terrain(np.concatenate([waves, bumps]), bowls, *rasters)


def _waves(length: Floats, angle: Floats, amplitude: Floats, rng: Generator) -> Floats:
    """Return waves (W, 4), see `Terrain`, of given lengths, directions and amplitudes with random phases."""
    k = 2 * np.pi / length
    return np.stack([k * np.cos(angle), k * np.sin(angle), rng.uniform(0, 2 * np.pi, 8), amplitude], axis=1)


TILE = 4.0  # [m] spacing of the grid that cuts the ground


def cover(plan: TownLayout, terrain: Terrain) -> tuple[Mesh, Mesh]:
    """Return the ground of a town as two meshes, surfaces and kerbs.

    The layout's `road` has the road's height, the rest the land's. Its `zones` together cover the town, later zones on
    top of earlier ones. The ground is also cut along its `lines`, such as the ridge of a road.
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
    # Material of each face: that of the last zone that contains a point of the face.
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


def _kerbs(vertices: Array, triangles: Array, code: Array, lowered: Array) -> Mesh:
    """Return upright faces between the coincident edges of road and land."""
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
    """Sample the height of the ground by vertical rays."""
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
    if missed.any():  # rays between two triangles get the height of their neighbour
        nearest = distance_transform_edt(missed, return_distances=False, return_indices=True)
        height = height[tuple(nearest)]
    return raster(height, step, size)


def surface(ground: Mesh) -> Mesh:
    """Return the triangles of `GROUND` materials."""
    stand = np.isin(ground.material, [int(m) for m in GROUND])
    return Mesh(ground.vertices, ground.triangles[stand], ground.material[stand])
