"""Layout of a town: carriageways, sidewalks, verges, crossings, markings, parking bays, and blocks between them."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import shapely
from numpy.random import Generator
from shapely import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry

from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Floats
from ogm.simulation.town.lanes import HEAD, ISLAND, KERB_RADIUS, RING, Draft
from ogm.simulation.town.network import Street, StreetNetwork, area, polygons

BAY = 5.8  # [m] length of a parking bay along the kerb


class Bay(NamedTuple):
    """A parking bay: middle [m], direction of its length [rad], length and width [m]."""

    at: Floats  # (2,)
    yaw: float
    length: float
    width: float

    @property
    def outline(self) -> Polygon:
        """Outline of the bay."""
        ahead = np.array([np.cos(self.yaw), np.sin(self.yaw)]) * self.length / 2
        side = np.array([-np.sin(self.yaw), np.cos(self.yaw)]) * self.width / 2
        return rectangle(self.at, ahead, side)


def rectangle(middle: Floats, ahead: Floats, side: Floats) -> Polygon:
    """Return the rectangle around a point, given the vectors from there to its front and its side."""
    return Polygon([middle + ahead + side, middle - ahead + side, middle - ahead - side, middle + ahead - side])


class Zone(NamedTuple):
    """A polygon with one surface."""

    shape: BaseGeometry
    material: M


class Drop(NamedTuple):
    """A dropped kerb: its middle, unit vector along the kerb, and half its length [m]."""

    at: Floats  # (2,)
    along: Floats
    half: float

    def share(self, x: Floats, y: Floats) -> Floats:
        """Return how far the kerb is lowered at x, y, from 0 to 1; the sidewalk behind follows as a ramp."""
        dx, dy = x - self.at[0], y - self.at[1]
        along = abs(dx * self.along[0] + dy * self.along[1])
        across = abs(dx * self.along[1] - dy * self.along[0])
        return np.asarray(np.clip((self.half + 0.7 - along) / 0.7, 0, 1) * np.clip((2.2 - across) / 1.2, 0, 1))


class Block(NamedTuple):
    """The land between streets: its outline and its district."""

    shape: Polygon
    style: str


@dataclass(eq=False)
class TownLayout:
    """Layout of a town in the plane, filled step by step."""

    size: float
    network: StreetNetwork
    draft: Draft
    road: BaseGeometry  # carriageways
    corridor: BaseGeometry  # carriageways with sidewalks and verges
    islands: list[Polygon]
    zones: list[Zone] = field(default_factory=list)
    lines: list[BaseGeometry] = field(default_factory=list)
    drops: list[Drop] = field(default_factory=list)
    bays: list[Bay] = field(default_factory=list)
    walkways: list[Floats] = field(default_factory=list)  # (M, 2)
    blocks: list[Block] = field(default_factory=list)
    driveways: list[Polygon] = field(default_factory=list)
    spans: list[tuple[int, float, str]] = field(
        default_factory=list
    )  # street, position along it [m], "bridge" or "gantry"
    reserved: BaseGeometry = field(default_factory=Polygon)  # area without buildings

    def pave(self, shape: BaseGeometry, material: M) -> None:
        """Cover a shape with a surface."""
        self.zones.append(Zone(shape, material))

    def mark(self, shape: Polygon) -> None:
        """Paint a marking."""
        self.pave(shape if shape.is_valid else shape.buffer(0), M.MARKING)


def make_plan(size: float, network: StreetNetwork, draft: Draft, rng: Generator) -> TownLayout:
    """Draw the layout of a town around its streets and lanes."""
    road, islands = _carriageway(network, draft)
    frame = shapely.box(-size / 2, -size / 2, size / 2, size / 2)
    corridor = _corridor(network, road, frame)
    plan = TownLayout(size, network, draft, road, corridor, islands)
    plan.pave(frame, M.GRASS)
    plan.pave(corridor, M.PAVING)
    _surfaces(plan, rng)
    for k, street in enumerate(network.streets):
        _verges(plan, k, street)
        _parking(plan, k, street, rng)
        _sidewalks(plan, k, street)
    _crossings(plan, rng)
    _markings(plan)
    land = polygons(shapely.difference(frame, corridor))
    plan.blocks += [Block(block, _style(network, block)) for block in land if block.area > 40]
    _spans(plan, rng)
    # Breaklines of a crowned road.
    for depth in (1.5, 3.9):
        plan.lines.append(shapely.boundary(shapely.buffer(road, -depth).simplify(0.05)))
    return plan


def _style(network: StreetNetwork, block: Polygon) -> str:
    """Return the district of a block: park if it contains a park's mesh, else the district of the nearest mesh."""
    within = shapely.contains_xy(block, network.grid.faces)
    if len(block.interiors) == 0 and any(network.grid.styles[k] == "park" for k in np.flatnonzero(within)):
        return "park"
    return network.grid.district(np.array(block.representative_point().coords[0]))


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
    for node, at in enumerate(network.grid.nodes):
        sides = [min(s.profile.right, s.profile.left) for s in network.streets if node in (s.start, s.end)]
        if node in network.heads:
            parts.append(Point(at).buffer(HEAD))
        elif node == network.grid.roundabout:
            parts.append(Point(at).buffer(RING))
            islands.append(Point(at).buffer(ISLAND))
        elif sides:
            parts.append(Point(at).buffer(min(sides)))
    # Lanes through crossings are always on the road.
    crossing = [lane for lane, owner in zip(draft.lanes, draft.streets, strict=True) if owner < 0]
    parts += [LineString(lane.points).buffer(lane.width / 2 + 0.3) for lane in crossing]
    # Straight edges are reduced to few points, arcs keep theirs.
    whole = shapely.union_all(parts).buffer(KERB_RADIUS).buffer(-KERB_RADIUS).simplify(0.02)
    return shapely.difference(whole, shapely.union_all(islands)), islands


def _corridor(network: StreetNetwork, road: BaseGeometry, frame: Polygon) -> BaseGeometry:
    parts: list[BaseGeometry] = [road.buffer(1.5)]
    for street in network.streets:
        profile = street.profile
        right = profile.right + profile.verge + profile.sidewalk[0]
        left = profile.left + profile.verge + profile.sidewalk[1]
        parts.append(shapely.buffer(street.middle(right, left), (right + left) / 2, cap_style="flat"))
    for node in (network.grid.roundabout, *network.heads):
        if node >= 0:
            parts.append(Point(network.grid.nodes[node]).buffer((HEAD if node in network.heads else RING) + 2.0))
    whole = shapely.union_all(parts).buffer(4.0).buffer(-4.0)
    return area(shapely.intersection(whole, frame)).simplify(0.02)


def _spans(plan: TownLayout, rng: Generator) -> None:
    """Choose the positions of a bridge and a gantry over the broad road, and keep houses away from the bridge."""
    broad = [k for k, street in enumerate(plan.network.streets) if street.profile.kind == "arterial"]
    for k, kind in zip(rng.permutation(broad).tolist() * 2, ("bridge", "gantry"), strict=False):
        street = plan.network.streets[k]
        free = street.length - plan.draft.cuts[k].sum()
        if free < 30:
            continue
        share = rng.uniform(0.25, 0.45) if kind == "bridge" else rng.uniform(0.6, 0.8)
        at = float(plan.draft.cuts[k, 0] + share * free)
        plan.spans.append((k, at, kind))
        if kind == "bridge":
            plan.reserved = street.band(at - 7, at + 7, -40.0, 40.0).buffer(0)


def _surfaces(plan: TownLayout, rng: Generator) -> None:
    """Pave the streets with repairs, and the islands."""
    plan.pave(plan.road, M.ASPHALT)
    for street in plan.network.streets:
        profile = street.profile
        if profile.surface != M.ASPHALT:
            band = street.band(6.0, street.length - 6.0, -profile.right - 0.5, profile.left + 0.5)
            plan.pave(shapely.intersection(band.buffer(0), plan.road), profile.surface)
        # Repairs: patches and trenches with another surface.
        other = M.WORN_ASPHALT if profile.surface == M.ASPHALT else M.ASPHALT
        for _ in range(rng.poisson(street.length / 45)):
            start = rng.uniform(4, max(5, street.length - 16))
            side = rng.uniform(-profile.right + 0.5, profile.left - 2.5)
            length, width = (rng.uniform(2, 6), rng.uniform(1, 2.4)) if rng.random() < 0.7 else (12.0, 0.8)
            patch = street.band(start, min(start + length, street.length), side, side + width)
            plan.pave(shapely.intersection(patch.buffer(0), plan.road), other)
    for island in plan.islands:
        plan.pave(island, M.PAVING)
        plan.pave(island.buffer(-0.3 if island.area < 60 else -1.5), M.GRASS)


def _verges(plan: TownLayout, k: int, street: Street) -> None:
    profile = street.profile
    start, end = plan.draft.cuts[k, 0] + 1, street.length - plan.draft.cuts[k, 1] - 1
    if profile.verge <= 0 or end - start < 6:
        return
    for right, left in ((-profile.right - profile.verge, -profile.right), (profile.left, profile.left + profile.verge)):
        if profile.kind == "country":  # no sidewalk, grass up to the road
            right, left = right - (right < 0) * profile.sidewalk[0], left + (right > 0) * profile.sidewalk[1]
        band = shapely.difference(street.band(start, end, right, left).buffer(0), plan.road)
        plan.pave(band, M.GRASS if profile.kind != "industrial" else M.SOIL)


def _parking(plan: TownLayout, k: int, street: Street, rng: Generator) -> None:
    """Add parking bays along the kerbs, with occasional gaps."""
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
            if rng.random() < 0.08 or ends[0] @ ends[1] < np.cos(0.12):  # a gap, or a bend too sharp for a bay
                at += 4.0
                continue
            normal = street.normal(at)
            yaw = np.arctan2(-normal[0], normal[1]) + (np.pi if side > 0 and profile.back else 0.0)
            plan.bays.append(Bay(street.at(at, offset), wrapped(yaw), long, width))
            end_of_bay = at + long / 2
            if profile.kind in ("main", "avenue"):
                inner, outer = side * edge - side * width, side * (edge - 0.3)
                plan.mark(street.band(end_of_bay - 0.05, end_of_bay + 0.05, inner, outer))
            at += long


def wrapped(yaw: float) -> float:
    """Return an angle wrapped to -pi ... pi [rad]."""
    return float((yaw + np.pi) % (2 * np.pi) - np.pi)


def _sidewalks(plan: TownLayout, k: int, street: Street) -> None:
    """Add the paths of pedestrians along both sidewalks."""
    start, end = plan.draft.cuts[k, 0] - 3.0, street.length - plan.draft.cuts[k, 1] + 3.0
    if end - start < 10:
        return
    way = np.linspace(start, end, int(end - start) + 1)
    plan.walkways += [street.at(way, offset) for offset in street.profile.walks]


def _crossings(plan: TownLayout, rng: Generator) -> None:
    """Add crossings for pedestrians at junctions: dropped kerbs, a path, sometimes a zebra crossing."""
    network = plan.network
    for k, street in enumerate(network.streets):
        profile = street.profile
        for end, node in ((0, street.start), (1, street.end)):
            if node in network.heads:
                continue
            cut = plan.draft.cuts[k, end]
            at = cut - 2.6 if end == 0 else street.length - cut + 2.6
            edges = (-profile.right, profile.left)
            for edge in edges:
                point, normal = street.at(at, edge), street.normal(at)
                plan.drops.append(Drop(point, np.array([normal[1], -normal[0]]), 1.5))
            right, left = profile.walks
            plan.walkways.append(street.at(at, np.linspace(right, left, int(left - right) + 2)))
            if profile.kind in ("main", "avenue", "arterial") and rng.random() < 0.7:  # a zebra
                for stripe in np.arange(edges[0] + 0.4, edges[1] - 0.6, 1.0):
                    plan.mark(street.band(at - 1.4, at + 1.4, stripe, stripe + 0.5))


def _markings(plan: TownLayout) -> None:
    """Paint lane lines, edge lines and stop lines."""
    for k, street in enumerate(plan.network.streets):
        profile = street.profile
        if profile.kind in ("lane", "oneway"):
            continue
        start, end = plan.draft.cuts[k, 0], street.length - plan.draft.cuts[k, 1]
        middle, lane = profile.median / 2, profile.lane
        dashed = [0.0] if middle == 0 and profile.back and profile.kind != "residential" else []
        dashed += [-middle - n * lane for n in range(1, profile.forward)]
        dashed += [middle + n * lane for n in range(1, profile.back)]
        outer = (-middle - profile.forward * lane, middle + profile.back * lane)
        for offset in dashed:
            for at in np.arange(start + 1, end - 4, 8.0):
                plan.mark(street.band(at, at + 3.5, offset - 0.06, offset + 0.06))
        for offset in outer if profile.cycle > 0 or profile.kind == "arterial" else ():
            plan.mark(street.band(start, end, offset - 0.06, offset + 0.06))
        stops = (start - 0.5, middle, outer[1], street.start), (end, outer[0], -middle, street.end)
        for at, right, left, node in stops:
            if left - right > 1 and node not in plan.network.heads:
                plan.mark(street.band(at, at + 0.5, right + 0.1, left - 0.1))
    plan.lines += [LineString(street.line[::3]) for street in plan.network.streets if street.profile.median == 0]
