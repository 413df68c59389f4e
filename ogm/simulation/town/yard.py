"""Placement of objects on the ground of a town, none on a road or lower than a lorry above it."""

from collections.abc import Callable, Sequence

import numpy as np
import shapely
from numpy.random import Generator
from shapely import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Floats, Mesh, upright
from ogm.simulation.town import plants
from ogm.simulation.town.ground import FIELD, Raster, mask, raised, raster
from ogm.simulation.town.layout import TownLayout

HEADROOM = 4.6  # [m] smallest height of objects above a road
_SPOTS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, 1], [1, 0, 1]], float)
_SPOTS = np.vstack([_SPOTS, [[3, 1, 0], [1, 3, 0], [0, 3, 1], [0, 1, 3], [3, 0, 1], [1, 0, 3]]])
_SPOTS /= _SPOTS.sum(axis=1, keepdims=True)  # corners of a triangle and points between them
Maker = Callable[[Generator], Mesh]
Wanted = Sequence[tuple[Maker, float, float]]  # builder of a piece, area per piece [m²], radius of a piece [m]


class Yard:
    """Placed objects of a town; rejects objects that would overlap others or block a way.

    Attributes
    ----------
    meshes : list of Mesh
        Meshes of all placed objects.
    trees, tall, bushes : list of Mesh
        Pools of plants; the crowns of `tall` begin at 3 m.
    blocked : shapely geometry
        Houses, driveways and parking bays.
    """

    def __init__(self, plan: TownLayout, houses: list[Polygon], height: Raster, rng: Generator) -> None:
        self.height, self.rng = height, rng
        self.meshes: list[Mesh] = []
        size = plan.size
        self._road = raster(mask(plan.road, size, FIELD / 2), FIELD / 2, size)
        self._near_road = raster(mask(plan.road.buffer(0.6), size, FIELD), FIELD, size)
        # Parked cars off the road, and pedestrians, need space too.
        parked = [bay.outline.buffer(0.25) for bay in plan.bays]
        self.blocked = shapely.union_all([shapely.buffer(h, 0.3) for h in houses] + plan.driveways + parked)
        self._walked = shapely.union_all([LineString(line) for line in plan.walkways])
        self.size, self._half = size, size / 2
        shapely.prepare(self.blocked)
        shapely.prepare(self._walked)
        self._places = np.zeros((0, 3))
        self.trees = [plants.tree(rng) for _ in range(36)]
        self.tall = [plants.tree(rng, clearance=3.0) for _ in range(24)]
        self.bushes = [plants.bush(rng) for _ in range(24)]

    def free(self, x: float, y: float, radius: float) -> bool:
        """Return whether there is space for a round object at x, y."""
        near, spot = self._places, shapely.Point(x, y)
        if max(abs(x), abs(y)) > self._half - 1.0:
            return False
        if (np.hypot(near[:, 0] - x, near[:, 1] - y) < near[:, 2] + radius).any():
            return False
        blocks_path = shapely.dwithin(self._walked, spot, 0.2 + min(radius, 0.3))
        return not (blocks_path or shapely.dwithin(self.blocked, spot, radius))

    def put(self, piece: Mesh, x: float, y: float, yaw: float, radius: float) -> bool:
        """Place a piece with its origin at its base upright at x, y; return False without space for it."""
        z = float(self.height(x, y))
        if not self.free(x, y, radius) or not self.add(piece.moved(upright(x, y, z, yaw))):
            return False
        self._places = np.vstack([self._places, [x, y, radius]])
        return True

    def add(self, piece: Mesh) -> bool:
        """Add a piece in the world frame; foliage over a road is cut, other parts there make it return False."""
        if len(piece.triangles) == 0:
            return False
        x, y, z = piece.vertices.T.astype(np.float64)
        low = z - self.height(x, y) < HEADROOM
        plant = np.isin(piece.material, (M.FOLIAGE, M.BARK))
        if (low & (self._road(x, y) > 0.3))[piece.triangles[~plant]].any():
            return False
        # Leaves and branches may also extend over the road between their corners.
        corners = piece.vertices[piece.triangles[plant]].astype(np.float64)
        px, py, pz = np.moveaxis(np.einsum("sk,tkc->tsc", _SPOTS, corners), -1, 0)
        cut = np.zeros(len(plant), bool)
        cut[plant] = ((pz - self.height(px, py) < HEADROOM) & (self._near_road(px, py) > 0.3)).any(axis=1)
        if cut.any():
            piece = Mesh(piece.vertices, piece.triangles[~cut], piece.material[~cut])
        self.meshes.append(piece)
        return True

    def line(self, line: LineString, step: float) -> Floats:
        """Return points (M, 3) on the ground along a line, at most `step` apart [m]."""
        return raised(np.array(line.segmentize(step).coords), self.height)

    def pick(self, pool: list[Mesh]) -> Mesh:
        """Return a random plant of a pool, randomly scaled."""
        rng = self.rng
        piece = pool[int(rng.integers(len(pool)))]
        return piece.moved(np.diag([*([rng.uniform(0.8, 1.15)] * 2), rng.uniform(0.85, 1.15), 1.0]))

    def scatter(self, shape: BaseGeometry, pool: list[Mesh], every: float, radius: float) -> None:
        """Place random plants of a pool in a shape, one per `every` square metres on average."""
        self._strew(shape, lambda _: self.pick(pool), every, radius)

    def pieces(self, shape: BaseGeometry, wanted: Wanted) -> None:
        """Place pieces in a shape at random."""
        for maker, every, radius in wanted:
            self._strew(shape.buffer(-radius), maker, every, radius)

    def _strew(self, shape: BaseGeometry, maker: Maker, every: float, radius: float) -> None:
        if shape.is_empty:
            return
        x0, y0, x1, y1 = shape.bounds
        count = self.rng.poisson((x1 - x0) * (y1 - y0) * (1 / every))
        x, y = self.rng.uniform(x0, x1, count), self.rng.uniform(y0, y1, count)
        within = shapely.contains_xy(shape, x, y)
        for px, py in zip(x[within].tolist(), y[within].tolist(), strict=True):
            self.put(maker(self.rng), px, py, self.rng.uniform(0, 2 * np.pi), radius)
