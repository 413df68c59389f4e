"""Stand houses, trees and street furniture on the ground, nothing of it on a road or lower than a lorry over it."""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import shapely
import shapely.ops
from numpy.random import Generator
from shapely import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from ogm.simulation.arrays import Floats
from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Mesh
from ogm.simulation.town import fences, plants
from ogm.simulation.town import furniture as f
from ogm.simulation.town.buildings import building
from ogm.simulation.town.layout import Plan
from ogm.simulation.town.lots import Lot
from ogm.simulation.town.network import Street
from ogm.simulation.town.overlay import area, inside, polygons
from ogm.simulation.town.terrain import FIELD, Raster, mask

HEADROOM = 4.6  # [m] nothing over a road is lower
# Share of the fronts that hide what is behind them.
CLOSED = {"suburb": 0.68, "industrial": 0.55, "arterial": 0.3}
_SPOTS = np.array(
    [
        [1, 0, 0],
        [0, 1, 0],
        [0, 0, 1],
        [1, 1, 0],
        [0, 1, 1],
        [1, 0, 1],
        [3, 1, 0],
        [1, 3, 0],
        [0, 3, 1],
        [0, 1, 3],
        [3, 0, 1],
        [1, 0, 3],
    ],
    float,
)
_SPOTS /= _SPOTS.sum(axis=1, keepdims=True)  # corners of a triangle and points between them
Maker = Callable[[Generator], Mesh]


class Yard:
    """Where things go: remembers what stands where, and refuses what would stand in the way."""

    def __init__(self, plan: Plan, lots: list[Lot], height: Raster) -> None:
        self.height = height
        self.meshes: list[Mesh] = []
        size = plan.size
        self._road = Raster(
            mask(plan.road, size, FIELD / 2).astype(np.float32), FIELD / 2, (-size / 2, -size / 2)
        )
        beside = mask(plan.road.buffer(0.6), size, FIELD)
        self._near_road = Raster(beside.astype(np.float32), FIELD, (-size / 2, -size / 2))
        houses: list[BaseGeometry] = [house for lot in lots for house in lot.houses]
        # Cars that park off the road, and people, need their room as well.
        parked = [bay.outline.buffer(0.25) for bay in plan.bays]
        self.blocked = shapely.union_all([shapely.buffer(h, 0.3) for h in houses] + plan.driveways + parked)
        self._walked = shapely.union_all([LineString(line) for line in plan.walkways])
        self._half = size / 2
        shapely.prepare(self.blocked)
        shapely.prepare(self._walked)
        self._places = np.zeros((0, 3))

    def free(self, x: float, y: float, radius: float) -> bool:
        """Whether a round thing may stand at x, y."""
        if max(abs(x), abs(y)) > self._half - 1.0:
            return False
        near = self._places
        if len(near) and (np.hypot(near[:, 0] - x, near[:, 1] - y) < near[:, 2] + radius).any():
            return False
        spot = shapely.Point(x, y)
        if shapely.dwithin(self._walked, spot, 0.2 + min(radius, 0.3)):
            return False
        return not shapely.dwithin(self.blocked, spot, radius)

    def put(self, piece: Mesh, x: float, y: float, yaw: float, radius: float) -> bool:
        """Stand a piece (origin at its foot) upright at x, y, if there is room for it."""
        if not self.free(x, y, radius):
            return False
        T = np.eye(4)
        T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        T[:3, 3] = x, y, float(self.height(np.array([x]), np.array([y]))[0])
        if not self.add(piece.moved(T)):
            return False
        self._places = np.vstack([self._places, [x, y, radius]])
        return True

    def add(self, piece: Mesh) -> bool:
        """Add a piece in the world frame; leaves over a road are cut, anything else there is refused."""
        if len(piece.triangles) == 0:
            return False
        x, y, z = piece.vertices.T.astype(np.float64)
        low = z - self.height(x, y) < HEADROOM
        plant = np.isin(piece.material, (M.FOLIAGE, M.BARK))
        if (low & (self._road(x, y) > 0.3))[piece.triangles[~plant]].any():
            return False
        # Leaves and branches may reach over the road between their corners as well.
        corners = piece.vertices[piece.triangles[plant]].astype(np.float64)
        spots = np.einsum("sk,tkc->tsc", _SPOTS, corners)
        px, py, pz = np.moveaxis(spots, -1, 0)
        cut = np.zeros(len(plant), bool)
        cut[plant] = ((pz - self.height(px, py) < HEADROOM) & (self._near_road(px, py) > 0.3)).any(axis=1)
        if cut.any():
            piece = Mesh(piece.vertices, piece.triangles[~cut], piece.material[~cut])
        self.meshes.append(piece)
        return True

    def line(self, points: Floats) -> Floats:
        """Points (M, 2) lifted to the ground (M, 3)."""
        return np.column_stack([points, self.height(points[:, 0], points[:, 1])])


def furnish(plan: Plan, lots: list[Lot], height: Raster, rng: Generator) -> list[Mesh]:
    """Return everything that stands on the ground of a town."""
    yard = Yard(plan, lots, height)
    trees = [plants.tree(rng) for _ in range(36)]
    tall = [plants.tree(rng, clearance=3.0) for _ in range(24)]
    bushes = [plants.bush(rng) for _ in range(24)]
    for lot in lots:
        for house in lot.houses:
            yard.add(building(house, lot.style, height, rng))
    _spans(plan, yard, rng)
    for k, street in enumerate(plan.network.streets):
        _street(plan, k, street, yard, tall, bushes, rng)
    for lot in lots:
        _lot(lot, yard, trees, tall, bushes, rng)
    _islands(plan, yard, tall, bushes, rng)
    _woods(plan, lots, yard, trees, bushes, rng)
    return yard.meshes


def _pick(pool: list[Mesh], rng: Generator) -> Mesh:
    """One of a pool of plants, larger or smaller."""
    piece = pool[int(rng.integers(len(pool)))]
    return piece.moved(np.diag([*([rng.uniform(0.8, 1.15)] * 2), rng.uniform(0.85, 1.15), 1.0]))


def _given(piece: Mesh, _: Generator) -> Mesh:
    return piece


def _street(
    plan: Plan, k: int, street: Street, yard: Yard, trees: list[Mesh], bushes: list[Mesh], rng: Generator
) -> None:
    """Trees, lamps, signs and what else stands along a street."""
    profile = street.profile
    begin, end = plan.draft.cuts[k, 0], street.length - plan.draft.cuts[k, 1]
    busy = street.district == "centre" or profile.kind in ("main", "arterial")
    signals = len(plan.draft.lanes) > 0
    for side in (-1, 1):  # right, left
        edge = profile.right if side < 0 else profile.left
        walk = profile.sidewalk[0 if side < 0 else 1]
        forward = side < 0 or profile.back == 0

        def stand(
            maker: Maker, at: float, behind: float, radius: float, *, turn: float = 0.0, side: int = side
        ) -> bool:
            """Stand a piece at a way along the street and so far behind the kerb; it looks at its traffic."""
            kerb = profile.right if side < 0 else profile.left
            x, y = street.at(at, side * (kerb + behind))
            normal = street.normal(at)
            # On the right side traffic comes from behind: +x of the piece points back along the street.
            yaw = float(np.arctan2(normal[0], -normal[1])) + (0.0 if side < 0 else np.pi)
            return yard.put(maker(rng), float(x), float(y), yaw + turn, radius)

        # At the junction where this side's traffic stops.
        node = street.end if forward else street.start
        stop = end + 0.6 if forward else begin - 0.6
        if signals and node not in plan.network.heads:
            if node != plan.network.roundabout and busy:
                stand(f.traffic_light, stop, 0.45, 0.15)
            else:
                stand(f.sign, stop, 0.6, 0.15)
        # Trees in the verge, or in pits in a wide sidewalk.
        behind = profile.verge / 2 if profile.verge > 0 else 0.9
        if profile.verge > 0 or (walk >= 2.4 and rng.random() < 0.6):
            gap = rng.uniform(7, 12)
            for at in np.arange(begin + 3, end - 3, gap):
                if rng.random() < 0.85:
                    stand(partial(_pick, trees), at + rng.normal(0, 0.4), behind, 0.5, turn=rng.uniform(0, 6))
        # Lamps.
        if side < 0 or profile.kind in ("arterial", "main"):
            for at in np.arange(begin + rng.uniform(2, 12), end, rng.uniform(22, 32)):
                stand(f.lamp, at, 0.5, 0.2)
        # The rest: how many of each for 100 m.
        wanted: list[tuple[Maker, float, float, float]] = [
            (f.sign, 2.0, 0.5, 0.2),
            (f.bin_, 1.5 if busy else 3.0, profile.verge + walk - 0.4, 0.5),
            (f.cabinet, 1.2, max(0.6, profile.verge + walk - 0.45), 0.6),
            (f.hydrant, 0.5, 0.6, 0.3),
            (f.bench, 1.2 if busy else 0.3, profile.verge + walk - 0.45, 0.9),
            (f.bike_rack, 1.4 if busy else 0.2, profile.verge + walk - 0.45, 1.4),
            (f.planter, 1.5 if street.district == "centre" else 0.0, 0.8, 0.7),
            (f.advert_column, 0.8 if busy else 0.1, 0.9, 0.8),
            (f.cafe, 2.0 if street.district == "centre" else 0.0, walk - 0.9, 1.0),
            (partial(_pick, bushes), 1.0 if profile.verge > 0 else 0.0, profile.verge / 2, 0.6),
        ]
        for maker, rate, back, radius in wanted:
            for _ in range(rng.poisson(rate * max(0.0, end - begin) / 100)):
                stand(maker, rng.uniform(begin + 1, max(begin + 1.1, end - 1)), back, radius)
        if profile.kind in ("arterial", "main", "avenue") and rng.random() < 0.5 and end - begin > 30:
            stand(f.shelter, rng.uniform(begin + 8, end - 8), profile.verge + 0.9, 2.0)
        if profile.kind in ("oneway", "narrow"):  # rows of bollards keep cars off the sidewalk
            start = rng.uniform(begin, max(begin + 1, end - 20))
            row = partial(_given, f.bollard(rng))
            for at in np.arange(start, min(end, start + rng.uniform(8, 30)), rng.uniform(1.4, 2.2)):
                stand(row, at, 0.35, 0.1)
        if profile.kind == "arterial" and end - begin > 40 and rng.random() < 0.6:
            start = rng.uniform(begin + 4, end - 30)
            way = np.arange(start, min(start + rng.uniform(16, 60), end - 2), 2.0)
            yard.add(fences.guard_rail(yard.line(street.at(way, side * (edge + 0.5)))))


def _spans(plan: Plan, yard: Yard, rng: Generator) -> None:
    """Span a bridge and a gantry over the broad road."""
    for k, at, kind in plan.spans:
        street = plan.network.streets[k]
        profile = street.profile
        x, y = street.at(at)
        normal = street.normal(at)
        yaw = float(np.arctan2(normal[0], -normal[1]))
        middle = (profile.left - profile.right) / 2
        x, y = float(x + normal[0] * middle), float(y + normal[1] * middle)
        if kind == "bridge":
            reach = profile.right + profile.left + 2 * profile.verge + sum(profile.sidewalk) + 3.0
            piece = f.bridge(reach, rng.uniform(3, 9), rng)
        else:
            piece = f.gantry(profile.right + profile.left + 1.6, rng)
        T = np.eye(4)
        T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        T[:3, 3] = x, y, float(yard.height(np.array([x]), np.array([y]))[0]) + 0.15
        yard.add(piece.moved(T))


def _lot(
    lot: Lot, yard: Yard, trees: list[Mesh], tall: list[Mesh], bushes: list[Mesh], rng: Generator
) -> None:
    if lot.use == "houses":
        _fences(lot, yard, rng)
        if lot.style == "suburb":
            near = LineString(lot.front).buffer(9.0)  # no low crowns beside the street
            _scatter(shapely.intersection(lot.shape, near), yard, tall, 1 / 120, 1.2, rng)
            _scatter(shapely.difference(lot.shape, near), yard, trees, 1 / 130, 1.2, rng)
            _scatter(lot.shape, yard, bushes, 1 / 120, 0.7, rng)
            _pieces(lot.shape, yard, [(f.bin_, 1 / 250, 0.6), (f.bench, 1 / 700, 1.0)], rng)
        elif lot.style == "industrial":
            wanted = [
                (f.container, 1 / 170, 3.6),
                (f.skip, 1 / 320, 2.6),
                (f.lamp, 1 / 600, 0.5),
                (f.bin_, 1 / 500, 0.8),
            ]
            _pieces(lot.shape, yard, wanted, rng)
        elif lot.style == "arterial":
            wanted = [
                (f.lamp, 1 / 700, 0.5),
                (f.advert_column, 1 / 1200, 0.8),
                (f.bike_rack, 1 / 900, 1.6),
                (f.sign, 1 / 600, 0.3),
            ]
            _pieces(lot.shape, yard, wanted, rng)
            _scatter(lot.shape, yard, tall, 1 / 250, 1.5, rng)
    elif lot.use == "square":
        middle = lot.shape.centroid
        yard.put(f.monument(rng), middle.x, middle.y, rng.uniform(0, 6), 4.0)
        _scatter(lot.shape, yard, tall, 1 / 110, 2.0, rng)
        wanted = [
            (f.bench, 1 / 90, 1.1),
            (f.planter, 1 / 120, 0.8),
            (f.cafe, 1 / 70, 1.1),
            (f.bollard, 1 / 90, 0.3),
            (f.lamp, 1 / 250, 0.4),
            (f.bike_rack, 1 / 300, 1.6),
        ]
        _pieces(lot.shape, yard, wanted, rng)
    elif lot.use == "car park":
        _scatter(lot.shape.difference(lot.shape.buffer(-1.6)), yard, tall, 1 / 30, 0.8, rng)
        if rng.random() < 0.5:
            _edge(lot, yard, 0.8, rng)
        else:
            _scatter(lot.shape.difference(lot.shape.buffer(-1.6)), yard, bushes, 1 / 12, 0.6, rng)
    elif lot.use == "works":
        for part in polygons(lot.shape.buffer(-1.0).simplify(0.3))[:1]:
            for side in shapely.get_parts(shapely.difference(part.exterior, area(yard.blocked))):
                if side.length > 1.6:
                    yard.add(fences.fence(yard.line(np.array(side.segmentize(3.0).coords)), rng))
        _pieces(
            lot.shape.buffer(-3),
            yard,
            [
                (f.container, 1 / 150, 3.6),
                (f.skip, 1 / 200, 2.6),
                (f.barrier, 1 / 90, 1.4),
                (f.cone, 1 / 60, 0.4),
            ],
            rng,
        )
    else:
        _edge(lot, yard, 0.6, rng)
        open_ground = shapely.difference(lot.shape, shapely.union_all(lot.gaps))
        _scatter(open_ground.buffer(-1.5), yard, trees, 1 / 95, 1.8, rng)
        _scatter(open_ground.buffer(-1.0), yard, bushes, 1 / 80, 0.9, rng)
        beside = shapely.union_all(lot.gaps).buffer(1.4).difference(shapely.union_all(lot.gaps).buffer(0.6))
        _pieces(
            shapely.intersection(beside, lot.shape),
            yard,
            [(f.bench, 1 / 60, 1.0), (f.bin_, 1 / 150, 0.6), (f.lamp, 1 / 150, 0.4)],
            rng,
        )
        yard.add(plants.grass_tufts(open_ground.buffer(-1), yard.height, rng, density=0.35))


def _edge(lot: Lot, yard: Yard, share: float, rng: Generator) -> None:
    """Tall hedges and walls along a share of a lot's outline."""
    ways = shapely.union_all([*lot.gaps, area(shapely.intersection(yard.blocked, lot.shape))]).buffer(0.35)
    for part in polygons(lot.shape.buffer(-0.8).simplify(0.3))[:1]:
        ring = part.exterior
        for at in np.arange(0.0, ring.length - 8.0, 16.0):
            piece = shapely.ops.substring(ring, at, min(at + 16.0, ring.length - 1.0))
            hides, kind = rng.random() < share, rng.uniform(0.0, 0.6)
            for line in shapely.get_parts(shapely.difference(piece, ways)):
                if hides and line.length > 1.6:
                    points = yard.line(np.array(line.segmentize(2.5).coords))
                    _enclose(points, lot.style, kind, hides, yard, rng)


def _fences(lot: Lot, yard: Yard, rng: Generator) -> None:
    """Hedges, walls and fences along the front, between neighbours and between houses; open at ways."""
    if lot.style not in CLOSED:
        return
    along = lot.front[1] - lot.front[0]
    width = float(np.linalg.norm(along))
    along = along / width
    ways = shapely.union_all(lot.gaps).buffer(0.35)
    solid = shapely.union_all([ways, area(shapely.intersection(yard.blocked, lot.shape))])
    room = shapely.difference(lot.shape.buffer(-0.55), solid)
    closed = CLOSED[lot.style]
    back = _behind(lot) + 2.0

    def stand(line: LineString, share: float) -> None:
        """Build one kind of enclosure along a line, one that hides what is behind it with that probability."""
        kind, hides = rng.random(), rng.random() < share
        for part in inside(line, room):
            if part.length >= 1.2:
                points = yard.line(np.array(shapely.segmentize(part, 2.5).coords))
                _enclose(points, lot.style, kind, hides, yard, rng)

    at = 0.0
    while at < width - 4:
        to = min(width, at + rng.uniform(14, 24))
        to = width if width - to < 5 else to
        start, stop = lot.front[0] + along * (at + 0.3), lot.front[0] + along * (to - 0.3)
        stand(LineString([start + 0.7 * lot.inward, stop + 0.7 * lot.inward]), closed)
        if lot.style == "suburb":
            stand(LineString([stop + 1.2 * lot.inward, stop + rng.uniform(6, 26) * lot.inward]), 0.5)
        stand(LineString([start + back * lot.inward, stop + back * lot.inward]), 0.85)
        at = to


def _behind(lot: Lot) -> float:
    """How far behind the front the houses of a lot stand, in the middle [m]."""
    return float(
        np.median([((np.array(h.exterior.coords) - lot.front[0]) @ lot.inward).min() for h in lot.houses])
    )


def _enclose(points: Floats, style: str, kind: float, hides: bool, yard: Yard, rng: Generator) -> None:
    """Build a hedge, wall or fence along points on the ground, or nothing."""
    if hides and kind < 0.42:
        yard.add(plants.hedge(points, rng, lowest=1.5))
    elif hides and kind < 0.7:
        yard.add(fences.low_wall(points, rng, lowest=1.5))
    elif hides:
        yard.add(fences.screen(points, rng, M.METAL_SHEET if style == "industrial" else M.WOOD))
    elif style != "suburb":
        if kind < 0.75:
            yard.add(fences.fence(points, rng))
    elif kind < 0.25:
        yard.add(plants.hedge(points, rng))
    elif kind < 0.6:
        yard.add(fences.fence(points, rng))
    elif kind < 0.85:
        yard.add(fences.low_wall(points, rng))


def _scatter(
    shape: BaseGeometry, yard: Yard, pool: list[Mesh], density: float, radius: float, rng: Generator
) -> None:
    """Plant at random, so many to the square metre."""
    for x, y in _points(shape, density, rng):
        yard.put(_pick(pool, rng), x, y, rng.uniform(0, 2 * np.pi), radius)


def _pieces(
    shape: BaseGeometry, yard: Yard, wanted: Sequence[tuple[Maker, float, float]], rng: Generator
) -> None:
    for maker, density, radius in wanted:
        for x, y in _points(shape.buffer(-radius), density, rng):
            yard.put(maker(rng), x, y, rng.uniform(0, 2 * np.pi), radius)


def _points(shape: BaseGeometry, density: float, rng: Generator) -> list[tuple[float, float]]:
    if shape.is_empty:
        return []
    x0, y0, x1, y1 = shape.bounds
    count = rng.poisson((x1 - x0) * (y1 - y0) * density)
    x, y = rng.uniform(x0, x1, count), rng.uniform(y0, y1, count)
    within = shapely.contains_xy(shape, x, y)
    return [(float(px), float(py)) for px, py in zip(x[within], y[within], strict=True)]


def _islands(plan: Plan, yard: Yard, trees: list[Mesh], bushes: list[Mesh], rng: Generator) -> None:
    """Plant the roundabout and the strips between carriageways."""
    for island in plan.islands:
        if island.area > 60 and max(np.ptp(np.array(island.exterior.coords), axis=0)) < 30:
            _scatter(island.buffer(-2.5), yard, trees, 1 / 50, 1.0, rng)
            _scatter(island.buffer(-1.5), yard, bushes, 1 / 9, 0.5, rng)
        else:
            planted = rng.random()
            if planted < 0.7:
                _scatter(island.buffer(-0.55), yard, bushes if planted < 0.35 else trees, 1 / 6, 0.8, rng)
            _pieces(island.buffer(-0.3), yard, [(f.lamp, 1 / 30, 0.2), (f.sign, 1 / 60, 0.2)], rng)


def _woods(
    plan: Plan, lots: list[Lot], yard: Yard, trees: list[Mesh], bushes: list[Mesh], rng: Generator
) -> None:
    """Trees and bushes on what is left of the blocks."""
    used: list[Polygon] = [lot.shape for lot in lots]
    rest = shapely.union_all([block.shape for block in plan.blocks]).difference(
        shapely.union_all(used).buffer(0.5)
    )
    inner = shapely.box(*(np.array([-1, -1, 1, 1]) * (plan.size / 2 - 30.0)))
    near, far = shapely.intersection(rest, inner), shapely.difference(rest, inner)
    _scatter(near.buffer(-1.5), yard, trees, 1 / 140, 1.5, rng)
    _scatter(near.buffer(-1.0), yard, bushes, 1 / 200, 0.9, rng)
    _scatter(far.buffer(-1.5), yard, trees, 1 / 260, 1.5, rng)  # hardly seen
