"""Placement of houses, trees and street furniture on the ground."""

from collections.abc import Sequence
from functools import partial

import numpy as np
import shapely
import shapely.ops
from numpy.random import Generator
from shapely import LineString
from shapely.geometry.base import BaseGeometry

from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Floats, Mesh, upright
from ogm.simulation.town import furniture as f
from ogm.simulation.town import plants, structures
from ogm.simulation.town.buildings import building
from ogm.simulation.town.country import CountryField, plant_fields
from ogm.simulation.town.ground import Raster, raised
from ogm.simulation.town.layout import TownLayout
from ogm.simulation.town.lots import Lot
from ogm.simulation.town.network import Street, area, inside, polygons
from ogm.simulation.town.yard import Maker, Wanted, Yard

# Share of fronts with opaque enclosures.
CLOSED = {"suburb": 0.68, "industrial": 0.55, "arterial": 0.3}
# Pieces on lots by style or use, see `Wanted`.
PIECES: dict[str, Wanted] = {
    "suburb": [(f.bin_, 250, 0.6), (f.bench, 700, 1.0)],
    "industrial": [(structures.container, 170, 3.6), (structures.skip, 320, 2.6), (f.lamp, 600, 0.5),
                   (f.bin_, 500, 0.8)],
    "arterial": [(f.lamp, 700, 0.5), (structures.advert_column, 1200, 0.8), (f.bike_rack, 900, 1.6),
                 (f.sign, 600, 0.3)],
    "square": [(f.bench, 90, 1.1), (f.planter, 120, 0.8), (f.cafe, 70, 1.1), (f.bollard, 90, 0.3), (f.lamp, 250, 0.4),
               (f.bike_rack, 300, 1.6)],
    "works": [(structures.container, 150, 3.6), (structures.skip, 200, 2.6), (f.barrier, 90, 1.4), (f.cone, 60, 0.4)],
    "park": [(f.bench, 60, 1.0), (f.bin_, 150, 0.6), (f.lamp, 150, 0.4)],
    "island": [(f.lamp, 30, 0.2), (f.sign, 60, 0.2)],
}  # fmt: skip


def furnish(
    plan: TownLayout, lots: list[Lot], height: Raster, rng: Generator, fields: Sequence[CountryField] = ()
) -> list[Mesh]:
    """Return the meshes of everything on the ground of a town."""
    yard = Yard(plan, [house for lot in lots for house in lot.houses], height, rng)
    for lot in lots:
        for house in lot.houses:
            yard.add(building(house, lot.style, height, rng))
    _spans(plan, yard)
    for k, street in enumerate(plan.network.streets):
        _street(plan, k, street, yard)
    for lot in lots:
        _lot(lot, yard)
    _islands(plan, yard)
    _woods(plan, [lot.shape for lot in lots] + [field.land for field in fields], yard)
    plant_fields(fields, yard)
    return yard.meshes


def _street(plan: TownLayout, k: int, street: Street, yard: Yard) -> None:
    """Place trees, lamps, signs and other pieces along both sides of a street."""
    begin, end = plan.draft.cuts[k, 0], street.length - plan.draft.cuts[k, 1]
    for side in (-1, 1):  # right, left
        stand = partial(_stand, yard, street, side)
        busy = street.district == "centre" or street.profile.kind in ("main", "arterial")
        # Signs and signals are at the junction where the traffic of this side stops.
        forward = side < 0 or street.profile.back == 0
        node, stop = (street.end, end + 0.6) if forward else (street.start, begin - 0.6)
        if node not in plan.network.heads:
            signal = node != plan.network.grid.roundabout and busy
            stand(f.traffic_light if signal else f.sign, stop, 0.45 if signal else 0.6, 0.15)
        _trees_and_lamps(yard, street, side, begin, end)
        walk = street.profile.sidewalk[0 if side < 0 else 1]
        for maker, rate, back, radius in _pieces_beside(street, walk, busy, yard):
            for _ in range(yard.rng.poisson(rate * max(0.0, end - begin) / 100)):
                stand(maker, yard.rng.uniform(begin + 1, max(begin + 1.1, end - 1)), back, radius)
        _rows(yard, street, side, begin, end)


def _stand(
    yard: Yard, street: Street, side: int, maker: Maker, at: float, behind: float, radius: float, turn: float = 0.0
) -> None:
    """Place a piece at a distance along the street and behind the kerb, facing its traffic."""
    kerb = street.profile.right if side < 0 else street.profile.left
    x, y = street.at(at, side * (kerb + behind))
    normal = street.normal(at)
    # On the right side traffic approaches from the start of the street, so the piece's +x axis points there.
    yaw = float(np.arctan2(normal[0], -normal[1])) + (0.0 if side < 0 else np.pi)
    yard.put(maker(yard.rng), float(x), float(y), yaw + turn, radius)


def _trees_and_lamps(yard: Yard, street: Street, side: int, begin: float, end: float) -> None:
    """Place trees in the verge or in pits in a wide sidewalk, and lamps."""
    profile, rng = street.profile, yard.rng
    if profile.kind == "country":
        if rng.random() < 0.3:
            for at in np.arange(begin + 3, end - 3, rng.uniform(8, 20)):
                _stand(yard, street, side, lambda _: yard.pick(yard.tall), at, 0.7, 0.4, rng.uniform(0, 6))
        return
    behind = profile.verge / 2 if profile.verge > 0 else 0.9
    walk = profile.sidewalk[0 if side < 0 else 1]
    if profile.verge > 0 or (walk >= 2.4 and rng.random() < 0.6):
        gap = rng.uniform(7, 12)
        for at in np.arange(begin + 3, end - 3, gap):
            if rng.random() < 0.85:
                at, turn = at + rng.normal(0, 0.4), rng.uniform(0, 6)
                _stand(yard, street, side, lambda _: yard.pick(yard.tall), at, behind, 0.5, turn)
    if side < 0 or profile.kind in ("arterial", "main"):
        for at in np.arange(begin + rng.uniform(2, 12), end, rng.uniform(22, 32)):
            _stand(yard, street, side, f.lamp, at, 0.5, 0.2)


def _pieces_beside(street: Street, walk: float, busy: bool, yard: Yard) -> list[tuple[Maker, float, float, float]]:
    """Return pieces along a street: builder, number per 100 m, distance behind the kerb [m], radius [m]."""
    verge, centre = street.profile.verge, street.district == "centre"
    if street.profile.kind == "country":
        return [(f.sign, 1.0, 0.4, 0.2), (lambda _: yard.pick(yard.bushes), 1.0, 1.0, 0.4)]
    back = verge + walk - 0.45
    return [
        (f.sign, 2.0, 0.5, 0.2),
        (f.bin_, 1.5 if busy else 3.0, verge + walk - 0.4, 0.5),
        (f.cabinet, 1.2, max(0.6, back), 0.6),
        (f.hydrant, 0.5, 0.6, 0.3),
        (f.bench, 1.2 if busy else 0.3, back, 0.9),
        (f.bike_rack, 1.4 if busy else 0.2, back, 1.4),
        (f.planter, 1.5 if centre else 0.0, 0.8, 0.7),
        (structures.advert_column, 0.8 if busy else 0.1, 0.9, 0.8),
        (f.cafe, 2.0 if centre else 0.0, walk - 0.9, 1.0),
        (lambda _: yard.pick(yard.bushes), 1.0 if verge > 0 else 0.0, verge / 2, 0.6),
    ]


def _rows(yard: Yard, street: Street, side: int, begin: float, end: float) -> None:
    """Place a shelter, a row of bollards, or a guard rail."""
    profile, rng = street.profile, yard.rng
    if profile.kind in ("arterial", "main", "avenue") and rng.random() < 0.5 and end - begin > 30:
        at = rng.uniform(begin + 8, end - 8)
        _stand(yard, street, side, structures.shelter, at, profile.verge + 0.9, 2.0)
    if profile.kind in ("oneway", "narrow"):
        start = rng.uniform(begin, max(begin + 1, end - 20))
        bollard = f.bollard(rng)
        for at in np.arange(start, min(end, start + rng.uniform(8, 30)), rng.uniform(1.4, 2.2)):
            _stand(yard, street, side, lambda _: bollard, at, 0.35, 0.1)
    if profile.kind in ("arterial", "country") and end - begin > 40 and rng.random() < 0.6:
        start = rng.uniform(begin + 4, end - 30)
        way = np.arange(start, min(start + rng.uniform(16, 60), end - 2), 2.0)
        edge = profile.right if side < 0 else profile.left
        yard.add(structures.guard_rail(raised(street.at(way, side * (edge + 0.5)), yard.height)))


def _spans(plan: TownLayout, yard: Yard) -> None:
    """Place a bridge and a gantry over the broad road."""
    for k, at, kind in plan.spans:
        street = plan.network.streets[k]
        profile, normal = street.profile, street.normal(at)
        width = profile.right + profile.left
        x, y = street.at(at) + normal * (profile.left - profile.right) / 2
        if kind == "bridge":
            reach = width + 2 * profile.verge + sum(profile.sidewalk) + 3.0
            piece = structures.bridge(reach, yard.rng.uniform(3, 9), yard.rng)
        else:
            piece = structures.gantry(width + 1.6, yard.rng)
        z = float(yard.height(x, y)) + 0.15
        yard.add(piece.moved(upright(x, y, z, float(np.arctan2(normal[0], -normal[1])))))


def _lot(lot: Lot, yard: Yard) -> None:
    """Furnish a lot by its use."""
    shape, scatter = lot.shape, yard.scatter
    if lot.use == "houses":
        _fences(lot, yard)
        if lot.style == "suburb":
            near = LineString(lot.front).buffer(9.0)  # without low crowns
            scatter(shapely.intersection(shape, near), yard.tall, 120, 1.2)
            scatter(shapely.difference(shape, near), yard.trees, 130, 1.2)
            scatter(shape, yard.bushes, 120, 0.7)
        if lot.style in PIECES and lot.style != "park":
            yard.pieces(shape, PIECES[lot.style])
        if lot.style == "arterial":
            scatter(shape, yard.tall, 250, 1.5)
    elif lot.use == "square":
        middle = shape.centroid
        yard.put(structures.monument(yard.rng), middle.x, middle.y, yard.rng.uniform(0, 6), 4.0)
        scatter(shape, yard.tall, 110, 2.0)
        yard.pieces(shape, PIECES["square"])
    elif lot.use == "car park":
        scatter(shape.difference(shape.buffer(-1.6)), yard.tall, 30, 0.8)
        if yard.rng.random() < 0.5:
            _edge(lot, yard, 0.8)
        else:
            scatter(shape.difference(shape.buffer(-1.6)), yard.bushes, 12, 0.6)
    elif lot.use == "works":
        for part in polygons(shape.buffer(-1.0).simplify(0.3))[:1]:
            for side in shapely.get_parts(shapely.difference(part.exterior, area(yard.blocked))):
                if side.length > 1.6:
                    yard.add(structures.fence(yard.line(side, 3.0), yard.rng))
        yard.pieces(shape.buffer(-3), PIECES["works"])
    else:
        _edge(lot, yard, 0.6)
        paths = shapely.union_all(lot.gaps)
        open_ground = shapely.difference(shape, paths)
        scatter(open_ground.buffer(-1.5), yard.trees, 95, 1.8)
        scatter(open_ground.buffer(-1.0), yard.bushes, 80, 0.9)
        yard.pieces(shapely.intersection(paths.buffer(1.4).difference(paths.buffer(0.6)), shape), PIECES["park"])
        yard.add(plants.grass_tufts(open_ground.buffer(-1), yard.height, yard.rng, density=0.35))


def _edge(lot: Lot, yard: Yard, share: float) -> None:
    """Build tall hedges and walls along a share of a lot's outline."""
    ways = shapely.union_all([*lot.gaps, area(shapely.intersection(yard.blocked, lot.shape))]).buffer(0.35)
    for part in polygons(lot.shape.buffer(-0.8).simplify(0.3))[:1]:
        ring = part.exterior
        for at in np.arange(0.0, ring.length - 8.0, 16.0):
            piece = shapely.ops.substring(ring, at, min(at + 16.0, ring.length - 1.0))
            hides, kind = yard.rng.random() < share, yard.rng.uniform(0.0, 0.6)
            for line in shapely.get_parts(shapely.difference(piece, ways)):
                if hides and line.length > 1.6:
                    _enclose(yard.line(line, 2.5), lot.style, kind, hides, yard)


def _fences(lot: Lot, yard: Yard) -> None:
    """Build enclosures along the front, between neighbours and between houses, with gaps at ways."""
    if lot.style not in CLOSED:
        return
    rng, front, inward, along, width = yard.rng, lot.front[0], lot.inward, lot.along, lot.width
    ways = shapely.union_all(lot.gaps).buffer(0.35)
    solid = shapely.union_all([ways, area(shapely.intersection(yard.blocked, lot.shape))])
    space = shapely.difference(lot.shape.buffer(-0.55), solid)
    # Median distance of the houses behind the front, plus 2 m.
    back = float(np.median([((np.array(h.exterior.coords) - front) @ inward).min() for h in lot.houses])) + 2.0

    def stand(start: Floats, stop: Floats, share: float) -> None:
        """Build one kind of enclosure along a line, opaque with probability `share`."""
        kind, hides = rng.random(), rng.random() < share
        for part in inside(LineString([start, stop]), space):
            if part.length >= 1.2:
                _enclose(yard.line(part, 2.5), lot.style, kind, hides, yard)

    at = 0.0
    while at < width - 4:
        to = min(width, at + rng.uniform(14, 24))
        to = width if width - to < 5 else to
        start, stop = front + along * (at + 0.3), front + along * (to - 0.3)
        stand(start + 0.7 * inward, stop + 0.7 * inward, CLOSED[lot.style])
        if lot.style == "suburb":
            stand(stop + 1.2 * inward, stop + rng.uniform(6, 26) * inward, 0.5)
        stand(start + back * inward, stop + back * inward, 0.85)
        at = to


def _enclose(points: Floats, style: str, kind: float, hides: bool, yard: Yard) -> None:
    """Build a hedge, wall or fence along points on the ground, or nothing."""
    rng = yard.rng
    if hides and kind < 0.42:
        yard.add(plants.hedge(points, rng, lowest=1.5))
    elif hides and kind < 0.7:
        yard.add(structures.low_wall(points, rng, lowest=1.5))
    elif hides:
        yard.add(structures.screen(points, rng, M.METAL_SHEET if style == "industrial" else M.WOOD))
    elif style != "suburb" and kind < 0.75:
        yard.add(structures.fence(points, rng))
    elif style == "suburb" and kind < 0.85:
        build = plants.hedge if kind < 0.25 else structures.fence if kind < 0.6 else structures.low_wall
        yard.add(build(points, rng))


def _islands(plan: TownLayout, yard: Yard) -> None:
    """Plant the roundabout and the strips between carriageways."""
    for island in plan.islands:
        if island.area > 60 and max(np.ptp(np.array(island.exterior.coords), axis=0)) < 30:
            yard.scatter(island.buffer(-2.5), yard.tall, 50, 1.0)
            yard.scatter(island.buffer(-1.5), yard.bushes, 9, 0.5)
            continue
        planted = yard.rng.random()
        if planted < 0.7:
            yard.scatter(island.buffer(-0.55), yard.bushes if planted < 0.35 else yard.tall, 6, 0.8)
        yard.pieces(island.buffer(-0.3), PIECES["island"])


def _woods(plan: TownLayout, taken: list[BaseGeometry], yard: Yard) -> None:
    """Plant the rest of the blocks."""
    used = shapely.union_all(taken).buffer(0.5)
    rest = shapely.union_all([block.shape for block in plan.blocks]).difference(used)
    inner = shapely.box(*(np.array([-1, -1, 1, 1]) * (plan.size / 2 - 30.0)))
    near = shapely.intersection(rest, inner)
    yard.scatter(near.buffer(-1.5), yard.trees, 140, 1.5)
    yard.scatter(near.buffer(-1.0), yard.bushes, 200, 0.9)
    yard.scatter(shapely.difference(rest, inner).buffer(-1.5), yard.trees, 260, 1.5)  # far from any street
