"""The plan of a town: carriageways, sidewalks, verges, crossings, markings, parking bays, blocks between them."""

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.random import Generator
from shapely import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry

from ogm.simulation.arrays import Floats
from ogm.simulation.materials import Material as M
from ogm.simulation.town.ground import Zone
from ogm.simulation.town.lanes import HEAD, ISLAND, KERB_RADIUS, RING, Draft
from ogm.simulation.town.network import Street, StreetNetwork
from ogm.simulation.town.overlay import area, polygons
from ogm.simulation.town.terrain import Drop

BAY = 5.8  # [m] length of a place to park along the kerb


@dataclass(frozen=True, eq=False)
class Bay:
    """A place to park: middle, direction of its length [rad], length and width [m]."""

    x: float
    y: float
    yaw: float
    length: float
    width: float

    @property
    def outline(self) -> Polygon:
        """The rectangle."""
        ahead = np.array([np.cos(self.yaw), np.sin(self.yaw)]) * self.length / 2
        side = np.array([-np.sin(self.yaw), np.cos(self.yaw)]) * self.width / 2
        middle = np.array([self.x, self.y])
        corners = [middle + ahead + side, middle - ahead + side, middle - ahead - side, middle + ahead - side]
        return Polygon(corners)


@dataclass(frozen=True, eq=False)
class Block:
    """What lies between streets: its outline and the district it belongs to."""

    shape: Polygon
    style: str


@dataclass(eq=False)
class TownLayout:
    """The plan while it is drawn; everything is in the plane."""

    size: float
    network: StreetNetwork
    draft: Draft
    road: BaseGeometry  # carriageways
    corridor: BaseGeometry  # with sidewalks and verges
    zones: list[Zone]
    lines: list[BaseGeometry]
    drops: list[Drop]
    bays: list[Bay]
    walkways: list[Floats]  # (M, 2)
    blocks: list[Block]
    driveways: list[Polygon]
    islands: list[Polygon]
    spans: list[tuple[int, float, str]]  # street, way along it, "bridge" or "gantry"
    reserved: BaseGeometry  # where nothing is built

    def mark(self, shape: Polygon) -> None:
        """Paint a marking."""
        self.zones.append(Zone(shape if shape.is_valid else shape.buffer(0), M.MARKING))


def make_plan(size: float, network: StreetNetwork, draft: Draft, rng: Generator) -> TownLayout:
    """Draw a town around its streets and lanes."""
    road, islands = _carriageway(network, draft)
    corridor = _corridor(network, road, size)
    frame = shapely.box(-size / 2, -size / 2, size / 2, size / 2)
    plan = TownLayout(size, network, draft, road, corridor, [], [], [], [], [], [], [], islands, [], Polygon())
    plan.zones.append(Zone(frame, M.GRASS))
    plan.zones.append(Zone(corridor, M.PAVING))
    _surfaces(plan, islands, rng)
    for k, street in enumerate(network.streets):
        _verges(plan, k, street)
        _parking(plan, k, street, rng)
        _sidewalks(plan, k, street)
    _crossings(plan, rng)
    _markings(plan)
    for block in polygons(shapely.difference(frame, corridor)):
        if block.area > 40:
            plan.blocks.append(Block(block, _style(network, block)))
    _spans(plan, rng)
    # Lines along which a crowned road bends.
    for depth in (1.5, 3.9):
        plan.lines.append(shapely.boundary(shapely.buffer(road, -depth).simplify(0.05)))
    return plan


def _style(network: StreetNetwork, block: Polygon) -> str:
    """Return the district of a block: park where one of its meshes is, else that of the nearest mesh."""
    within = shapely.contains_xy(block, network.faces)
    if len(block.interiors) == 0 and any(network.styles[k] == "park" for k in np.flatnonzero(within)):
        return "park"
    middle = np.array(block.representative_point().coords[0])
    return network.styles[int(np.argmin(np.linalg.norm(network.faces - middle, axis=1)))]


def _carriageway(network: StreetNetwork, draft: Draft) -> tuple[BaseGeometry, list[Polygon]]:
    """Return the carriageways without the islands in them, and the islands."""
    parts: list[BaseGeometry] = []
    islands: list[Polygon] = []
    for k, street in enumerate(network.streets):
        profile = street.profile
        half = (profile.right + profile.left) / 2
        parts.append(shapely.buffer(street.middle(profile.right, profile.left), half, cap_style="flat"))
        if profile.median > 0:
            start, end = draft.cuts[k, 0] + 1.0, street.length - draft.cuts[k, 1] - 1.0
            strip = LineString(street.at(np.linspace(start + 1, end - 1, 64)))
            islands.append(shapely.buffer(strip, profile.median / 2 - 0.35))
    for node, at in enumerate(network.nodes):
        sides = [
            min(street.profile.right, street.profile.left)
            for street in network.streets
            if node in (street.start, street.end)
        ]
        if node in network.heads:
            parts.append(Point(at).buffer(HEAD))
        elif node == network.roundabout:
            parts.append(Point(at).buffer(RING))
            islands.append(Point(at).buffer(ISLAND))
        elif sides:
            parts.append(Point(at).buffer(min(sides)))
    # Wherever a lane bends through a crossing there is road below it.
    crossing = [lane for lane, owner in zip(draft.lanes, draft.streets, strict=True) if owner < 0]
    parts += [LineString(lane.points).buffer(lane.width / 2 + 0.3) for lane in crossing]
    whole = shapely.union_all(parts).buffer(KERB_RADIUS).buffer(-KERB_RADIUS)
    # Straight edges need few points, arcs keep theirs.
    whole = whole.simplify(0.02)
    return shapely.difference(whole, shapely.union_all(islands)), islands


def _corridor(network: StreetNetwork, road: BaseGeometry, size: float) -> BaseGeometry:
    parts: list[BaseGeometry] = [road.buffer(1.5)]
    for street in network.streets:
        profile = street.profile
        right = profile.right + profile.verge + profile.sidewalk[0]
        left = profile.left + profile.verge + profile.sidewalk[1]
        parts.append(shapely.buffer(street.middle(right, left), (right + left) / 2, cap_style="flat"))
    for node in (network.roundabout, *network.heads):
        if node >= 0:
            parts.append(Point(network.nodes[node]).buffer((HEAD if node in network.heads else RING) + 2.0))
    whole = shapely.union_all(parts).buffer(4.0).buffer(-4.0)
    filled = shapely.union_all([Polygon(part.exterior) for part in polygons(road) if part.area < 0] + [whole])
    frame = shapely.box(-size / 2, -size / 2, size / 2, size / 2)
    return area(shapely.intersection(filled, frame)).simplify(0.02)


def _spans(plan: TownLayout, rng: Generator) -> None:
    """Choose where the broad road passes below a bridge and a gantry, and keep houses away from the bridge."""
    broad = [k for k, street in enumerate(plan.network.streets) if street.profile.kind == "arterial"]
    order = [int(k) for k in rng.permutation(broad)]
    for k, kind in zip(order * 2, ("bridge", "gantry"), strict=False):
        street = plan.network.streets[k]
        free = street.length - plan.draft.cuts[k].sum()
        if free < 30:
            continue
        share = rng.uniform(0.25, 0.45) if kind == "bridge" else rng.uniform(0.6, 0.8)
        at = float(plan.draft.cuts[k, 0] + share * free)
        plan.spans.append((k, at, kind))
        if kind == "bridge":
            plan.reserved = street.band(at - 7, at + 7, -40.0, 40.0).buffer(0)


def _surfaces(plan: TownLayout, islands: list[Polygon], rng: Generator) -> None:
    """Road surfaces street by street, repairs in them, islands."""
    plan.zones.append(Zone(plan.road, M.ASPHALT))
    for street in plan.network.streets:
        profile = street.profile
        if profile.surface != M.ASPHALT:
            band = street.band(6.0, street.length - 6.0, -profile.right - 0.5, profile.left + 0.5)
            plan.zones.append(Zone(shapely.intersection(band.buffer(0), plan.road), profile.surface))
        # Repairs: patches and trenches of another age.
        other = M.WORN_ASPHALT if profile.surface == M.ASPHALT else M.ASPHALT
        for _ in range(rng.poisson(street.length / 45)):
            start = rng.uniform(4, max(5, street.length - 16))
            side = rng.uniform(-profile.right + 0.5, profile.left - 2.5)
            length, width = (rng.uniform(2, 6), rng.uniform(1, 2.4)) if rng.random() < 0.7 else (12.0, 0.8)
            patch = street.band(start, min(start + length, street.length), side, side + width)
            plan.zones.append(Zone(shapely.intersection(patch.buffer(0), plan.road), other))
    for island in islands:
        plan.zones.append(Zone(island, M.PAVING))
        plan.zones.append(Zone(island.buffer(-0.3 if island.area < 60 else -1.5), M.GRASS))


def _verges(plan: TownLayout, k: int, street: Street) -> None:
    profile = street.profile
    start, end = plan.draft.cuts[k, 0] + 1, street.length - plan.draft.cuts[k, 1] - 1
    if profile.verge <= 0 or end - start < 6:
        return
    for right, left in ((-profile.right - profile.verge, -profile.right), (profile.left, profile.left + profile.verge)):
        band = shapely.difference(street.band(start, end, right, left).buffer(0), plan.road)
        plan.zones.append(Zone(band, M.GRASS if profile.kind != "industrial" else M.SOIL))


def _parking(plan: TownLayout, k: int, street: Street, rng: Generator) -> None:
    """Bays along the kerbs, with gaps here and there."""
    profile = street.profile
    start, end = plan.draft.cuts[k, 0] + 2.0, street.length - plan.draft.cuts[k, 1] - 2.0
    long = 9.0 if profile.kind == "industrial" else BAY
    for side, width in ((-1, profile.parking[0]), (1, profile.parking[1])):
        if width <= 0:
            continue
        edge = profile.right if side < 0 else profile.left
        offset = side * (edge - 0.1 - width / 2)
        at = start + long / 2
        while at + long / 2 < end:
            ends = street.normal(np.array([at - long / 2, at + long / 2]))
            if rng.random() < 0.08 or ends[0] @ ends[1] < np.cos(0.12):  # a gap; no straight bay in a bend
                at += 4.0
                continue
            x, y = street.at(at, offset)
            normal = street.normal(at)
            yaw = float(np.arctan2(-normal[0], normal[1]))
            if side > 0 and profile.back:
                yaw += np.pi
            plan.bays.append(Bay(float(x), float(y), float((yaw + np.pi) % (2 * np.pi) - np.pi), long, width))
            if profile.kind in ("main", "avenue"):
                tick = street.band(
                    at + long / 2 - 0.05, at + long / 2 + 0.05, side * edge - side * width, side * (edge - 0.3)
                )
                plan.mark(tick)
            at += long


def _sidewalks(plan: TownLayout, k: int, street: Street) -> None:
    """Lay a line for pedestrians along either sidewalk."""
    profile = street.profile
    start, end = plan.draft.cuts[k, 0] - 3.0, street.length - plan.draft.cuts[k, 1] + 3.0
    if end - start < 10:
        return
    way = np.linspace(start, end, int(end - start) + 1)
    for offset in (
        -profile.right - profile.verge - profile.sidewalk[0] / 2,
        profile.left + profile.verge + profile.sidewalk[1] / 2,
    ):
        plan.walkways.append(street.at(way, offset))


def _crossings(plan: TownLayout, rng: Generator) -> None:
    """Where people cross at junctions: kerbs let down, a line to walk, sometimes a zebra."""
    network = plan.network
    for k, street in enumerate(network.streets):
        profile = street.profile
        for end, node in ((0, street.start), (1, street.end)):
            if node in network.heads:
                continue
            cut = plan.draft.cuts[k, end]
            at = cut - 2.6 if end == 0 else street.length - cut + 2.6
            zebra = profile.kind in ("main", "avenue", "arterial") and rng.random() < 0.7
            edges = (-profile.right, profile.left)
            for edge in edges:
                point, normal = street.at(at, edge), street.normal(at)
                plan.drops.append(Drop(float(point[0]), float(point[1]), (float(normal[1]), float(-normal[0])), 1.5))
            reach = (
                edges[0] - profile.verge - profile.sidewalk[0] / 2,
                edges[1] + profile.verge + profile.sidewalk[1] / 2,
            )
            plan.walkways.append(street.at(at, np.linspace(*reach, int(reach[1] - reach[0]) + 2)))
            if zebra:
                for left in np.arange(edges[0] + 0.4, edges[1] - 0.6, 1.0):
                    stripe = street.band(at - 1.4, at + 1.4, left, left + 0.5)
                    plan.mark(stripe)


def _markings(plan: TownLayout) -> None:
    """Lines: between and beside lanes, and where to stop."""
    for k, street in enumerate(plan.network.streets):
        profile = street.profile
        if profile.kind in ("lane", "oneway"):
            continue
        start, end = plan.draft.cuts[k, 0], street.length - plan.draft.cuts[k, 1]
        dashed, solid = [], []
        if profile.median == 0 and profile.back and profile.kind not in ("residential",):
            dashed.append(0.0)
        for n in range(1, profile.forward):
            dashed.append(-profile.median / 2 - n * profile.lane)
        for n in range(1, profile.back):
            dashed.append(profile.median / 2 + n * profile.lane)
        outer = (-profile.median / 2 - profile.forward * profile.lane, profile.median / 2 + profile.back * profile.lane)
        if profile.cycle > 0 or profile.kind == "arterial":
            solid += [outer[0], outer[1]]
        for offset in dashed:
            for at in np.arange(start + 1, end - 4, 8.0):
                plan.mark(street.band(at, at + 3.5, offset - 0.06, offset + 0.06))
        for offset in solid:
            plan.mark(street.band(start, end, offset - 0.06, offset + 0.06))
        for at, right, left, node in (
            (start - 0.5, profile.median / 2, outer[1], street.start),
            (end, outer[0], -profile.median / 2, street.end),
        ):
            if left - right > 1 and node not in plan.network.heads:
                plan.mark(street.band(at, at + 0.5, right + 0.1, left - 0.1))
    plan.lines += [LineString(street.line[::3]) for street in plan.network.streets if street.profile.median == 0]
