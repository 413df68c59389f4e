"""Lots in the blocks between streets: houses, yards, driveways, squares, car parks, parks."""

from typing import NamedTuple

import numpy as np
import shapely
from numpy.random import Generator
from shapely import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Floats
from ogm.simulation.town.footprints import split_front
from ogm.simulation.town.layout import Bay, Block, Drop, TownLayout, rectangle, wrapped
from ogm.simulation.town.network import area, polygons

DEPTH = {"centre": 19.0, "suburb": 30.0, "industrial": 48.0, "arterial": 34.0, "park": 14.0}  # [m] of a lot
SETBACK = {"centre": 0.0, "suburb": 1.2, "industrial": 2.0, "arterial": 1.0, "park": 2.0}  # [m] smallest, of houses
OPEN_SPACE = {"centre": 0.05, "suburb": 0.03, "industrial": 0.12, "arterial": 0.15, "park": 0.2}  # share of car parks

# Share and material of the usual surface of yards, and the material of the others.
YARDS = {"industrial": (0.3, M.GRAVEL, M.WORN_ASPHALT), "arterial": (0.4, M.ASPHALT, M.PAVING)}


class Lot(NamedTuple):
    """A piece of land along a street.

    Attributes
    ----------
    use : str
        "houses", "car park", "square", "park", or "works" for a building site.
    style : str
        Style of the houses, see `ogm.simulation.town.buildings`.
    shape : Polygon
        Outline of the lot.
    front : (2, 2) float64
        Ends of its street side.
    inward : (2,) float64
        Unit vector from the street into the lot.
    houses : list of Polygon
        Footprints of the houses.
    gaps : list of Polygon
        Driveways and paths, which interrupt fences.
    """

    use: str
    style: str
    shape: Polygon
    front: Floats
    inward: Floats
    houses: list[Polygon]
    gaps: list[Polygon]

    @property
    def width(self) -> float:
        """Length of the front [m]."""
        return float(np.linalg.norm(self.front[1] - self.front[0]))

    @property
    def along(self) -> Floats:
        """Unit vector along the front."""
        return np.asarray((self.front[1] - self.front[0]) / self.width)

    def at(self, u: float, depth: float = 0.0) -> Floats:
        """Return x, y of a point at distance `u` along the front and `depth` behind it [m]."""
        return np.asarray(self.front[0] + self.along * u + depth * self.inward)


def fill_blocks(plan: TownLayout, rng: Generator) -> list[Lot]:
    """Divide all blocks into lots, and add surfaces, driveways, bays and paths to the layout."""
    lots: list[Lot] = []
    blocks = [k for k, block in enumerate(plan.blocks) if block.style == "centre" and _inside(plan, block)]
    square = min(blocks, key=lambda k: abs(plan.blocks[k].shape.area - 2600.0)) if blocks else -1
    for k, block in enumerate(plan.blocks):
        if block.style == "park" and _inside(plan, block):
            lots.append(_park(plan, block, rng))
            continue
        ground = {"centre": M.PAVING, "suburb": M.GRASS, "industrial": M.WORN_ASPHALT}
        if _inside(plan, block):
            plan.pave(block.shape, ground.get(block.style, M.GRASS))
            if block.style == "centre":  # courtyards
                plan.pave(block.shape.buffer(-22.0), M.GRAVEL if rng.random() < 0.3 else M.GRASS)
        lots += _along(plan, block, k == square, rng)
    return lots


def _inside(plan: TownLayout, block: Block) -> bool:
    """Return whether a block is surrounded by streets, not at the town's edge."""
    return bool(np.abs(np.array(block.shape.bounds)).max() < plan.size / 2 - 1.0)


def _along(plan: TownLayout, block: Block, square: bool, rng: Generator) -> list[Lot]:
    """Return lots along all sides of a block, longest side first."""
    network = plan.network
    streets = np.array([LineString(street.line) for street in network.streets], dtype=object)
    taken: BaseGeometry = plan.reserved
    lots = []
    for a, b, inward in _sides(plan, block):
        middle = (a + b) / 2
        near = int(np.argmin(shapely.distance(streets, shapely.points(middle))))
        style = network.grid.district(middle)
        if style == "country":
            continue
        street = network.streets[near]
        if style == "park":
            style = "suburb"
        if street.profile.kind == "arterial" and style == "suburb" and rng.random() < 0.7:
            style = "arterial"
        depth = DEPTH[style]
        strip = Polygon([a, b, b + depth * inward, a + depth * inward])
        shape = next(iter(polygons(area(shapely.intersection(block.shape, strip)).difference(taken))), Polygon())
        if shape.area < 60:
            continue
        taken = taken.union(shape)
        width, use = float(np.linalg.norm(b - a)), "houses"
        if square and width > 25:
            use, square = "square", False
        elif width > 26 and rng.random() < OPEN_SPACE[style]:
            use = "car park"
        elif rng.random() < 0.03:
            use = "works"
        lot = Lot(use, style, shape, np.array([a, b]), inward, [], [])
        if use == "houses":
            site = polygons(shapely.intersection(shape, block.shape.buffer(-SETBACK[style])).buffer(-0.05))
            lot.houses.extend(split_front(site[0], lot.front, style, rng) if site else [])
            if not lot.houses:
                continue
            _access(plan, lot, near, rng)
        elif use == "car park":
            _car_park(plan, lot, near)
        elif use == "square":
            _square(plan, lot, rng)
        else:
            plan.pave(shape, M.SOIL)
        lots.append(lot)
    return lots


def _sides(plan: TownLayout, block: Block) -> list[tuple[Floats, Floats, Floats]]:
    """Return the straight sides of a block along streets, with unit vectors into the block, longest first."""
    result = []
    outline = shapely.geometry.polygon.orient(block.shape.simplify(1.0), 1.0)
    for ring in (outline.exterior, *outline.interiors):
        points = np.array(ring.coords)
        for a, b in zip(points[:-1], points[1:], strict=True):
            length = float(np.linalg.norm(b - a))
            if length < 9 or np.abs(np.concatenate([a, b])).max() > plan.size / 2 - 2:
                continue
            result.append((a, b, np.array([a[1] - b[1], b[0] - a[0]]) / length))
    return sorted(result, key=lambda side: -float(np.linalg.norm(side[1] - side[0])))


def _driveway(plan: TownLayout, lot: Lot, near: int, at: Floats, reach: float, width: float, material: M) -> None:
    """Pave a driveway from the kerb to `reach` metres behind the front, and lower the kerb."""
    along = np.array([lot.inward[1], -lot.inward[0]])
    hit = shapely.intersection(LineString([at, at - 16.0 * lot.inward]), plan.road)
    if hit.is_empty:
        return
    kerb = at - lot.inward * float(shapely.distance(shapely.points(at), hit))
    corners = (kerb, -1, -0.3), (kerb, 1, -0.3), (at, 1, reach), (at, -1, reach)
    way = Polygon([start + side * (along * width / 2) + depth * lot.inward for start, side, depth in corners])
    plan.pave(shapely.difference(way, plan.road), material)
    lot.gaps.append(way)
    plan.driveways.append(way)
    plan.drops.append(Drop(kerb, along, width / 2))
    if max(plan.network.streets[near].profile.parking) > 0:  # driveways stay free of parked cars
        spots = shapely.points(np.array([bay.at for bay in plan.bays]).reshape(-1, 2))
        far = shapely.distance(way.buffer(0.5), spots)
        plan.bays[:] = [bay for bay, d in zip(plan.bays, far, strict=True) if d > bay.length / 2]


def _access(plan: TownLayout, lot: Lot, near: int, rng: Generator) -> None:
    """Add driveways to garages and yards, and paths to entrances."""
    if lot.style in YARDS:
        for house in lot.houses:
            plan.pave(house.buffer(0.9, join_style="mitre"), M.PAVING)
        share, usual, other = YARDS[lot.style]
        plan.pave(lot.shape, usual if rng.random() < share else other)
        for u in np.arange(rng.uniform(6, 14), lot.width - 6, rng.uniform(30, 45)):
            _driveway(plan, lot, near, lot.at(u), 1.0, 6.5, M.ASPHALT)
        _yard_bays(plan, lot, rng)
    for house in lot.houses if lot.style == "suburb" else ():
        corners = np.array(house.exterior.coords)[:-1] - lot.front[0]
        u, d = corners @ lot.along, corners @ lot.inward
        width, setback = float(np.ptp(u)), float(d.min())
        at = lot.at(float((u.min() + u.max()) / 2))
        if width < 6.3:  # a garage
            surface = rng.choice([M.PAVING, M.COBBLES, M.ASPHALT, M.GRAVEL])
            _driveway(plan, lot, near, at, setback + 0.5, min(width, 3.4), surface)
            if setback > 6.5 and rng.random() < 0.8:
                spot = at + lot.inward * (setback / 2 + 0.4)
                yaw = float(np.arctan2(lot.inward[1], lot.inward[0]) + (np.pi if rng.random() < 0.5 else 0))
                plan.bays.append(Bay(spot, wrapped(yaw), 5.2, 2.4))
        elif setback > 1.0:
            at = at + lot.along * rng.uniform(-0.25, 0.25) * width
            line = LineString([at - 0.1 * lot.inward, at + (setback + 0.5) * lot.inward])
            path = line.buffer(0.65, cap_style="flat")
            plan.pave(path, M.PAVING)
            lot.gaps.append(path)


def _yard_bays(plan: TownLayout, lot: Lot, rng: Generator) -> None:
    """Add parking bays across the front of a yard, between its houses and ways."""
    yaw = float(np.arctan2(lot.inward[1], lot.inward[0]))
    built = shapely.union_all(lot.houses + lot.gaps).buffer(0.6)
    ground = lot.shape.buffer(-0.8)
    for u in np.arange(3.0, lot.width - 3, 2.6):
        spot = lot.at(u, 3.6)
        place = rectangle(spot, lot.along * 1.2, lot.inward * 2.4)
        if rng.random() < 0.75 and shapely.contains(ground, place) and not shapely.intersects(built, place):
            plan.bays.append(Bay(spot, yaw, 5.0, 2.5))


def _car_park(plan: TownLayout, lot: Lot, near: int) -> None:
    """Make a car park: asphalt, rows of bays parallel to the street, and a driveway."""
    width, x, t = lot.width, lot.along * 1.25, lot.inward * 2.45
    ground = lot.shape.buffer(-1.6, join_style="mitre")
    plan.pave(lot.shape, M.GRASS)
    plan.pave(ground, M.ASPHALT)
    _driveway(plan, lot, near, lot.front[0] + lot.along * width * 0.5, 2.0, 6.0, M.ASPHALT)
    shapely.prepare(ground)
    row, facing = 1.9 + 2.5, 1.0
    while row + 2.5 < DEPTH[lot.style]:
        yaw = float(np.arctan2(facing * lot.inward[1], facing * lot.inward[0]))
        for u in np.arange(3.5, width - 3.5, 2.55):
            way_in = facing > 0 and row < 6 and abs(u - width / 2) < 5
            spot = lot.at(u, row)
            if not way_in and shapely.contains(ground, rectangle(spot, x, t)):
                plan.bays.append(Bay(spot, yaw, 5.0, 2.5))
                line = LineString([spot + x - t, spot + x + t])
                plan.pave(line.buffer(0.06, cap_style="flat"), M.MARKING)
        row, facing = row + (11.2 if facing > 0 else 5.2), -facing


def _square(plan: TownLayout, lot: Lot, rng: Generator) -> None:
    plan.pave(lot.shape, M.PAVING)
    plan.pave(lot.shape.buffer(-3.0), M.COBBLES if rng.random() < 0.6 else M.PAVING)
    for _ in range(3):
        a, b = _point_in(lot.shape, rng), _point_in(lot.shape, rng)
        if np.linalg.norm(a - b) > 8:
            plan.walkways.append(np.linspace(a, b, int(np.linalg.norm(a - b)) + 1))


def _park(plan: TownLayout, block: Block, rng: Generator) -> Lot:
    """Return a park: grass with winding paths from side to side."""
    plan.pave(block.shape, M.GRASS)
    middle = np.array(block.shape.centroid.coords[0])
    ring = np.array(block.shape.exterior.coords)
    lot = Lot("park", "park", block.shape, ring[:2], np.array([0.0, 1.0]), [], [])
    for start in rng.permutation(len(ring) - 1)[:5]:
        bow = rng.normal(0, 6, 2)
        line = LineString([ring[start], ring[start] * 0.6 + middle * 0.4 + bow, middle + rng.normal(0, 3, 2)])
        points = np.array(line.segmentize(2.0).coords)
        for _ in range(2):
            points[1:-1] = (points[:-2] + 2 * points[1:-1] + points[2:]) / 4
        path = shapely.intersection(LineString(points).buffer(rng.uniform(0.9, 1.6)), block.shape)
        plan.pave(path, M.GRAVEL if rng.random() < 0.7 else M.PAVING)
        lot.gaps.extend(polygons(path))
        plan.walkways.append(points)
    for _ in range(3):  # flower beds and bare soil
        spot = shapely.Point(_point_in(block.shape, rng)).buffer(rng.uniform(1, 3))
        plan.pave(shapely.intersection(spot, block.shape), M.SOIL)
    return lot


def _point_in(shape: Polygon, rng: Generator) -> Floats:
    """Draw a point of a polygon."""
    x0, y0, x1, y1 = shape.bounds
    for _ in range(100):
        point = rng.uniform((x0, y0), (x1, y1))
        if shapely.contains_xy(shape, *point):
            return point
    return np.array(shape.representative_point().coords[0])
