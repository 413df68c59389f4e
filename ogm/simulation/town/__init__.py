"""Random towns from a seed: streets, lanes and round trips, ground with hills and kerbs, houses, trees, furniture."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import shapely
from numpy.random import Generator
from shapely import Polygon

from ogm.simulation.mesh import Array, Floats, Floats32, Mesh, merge
from ogm.simulation.recipe import Country
from ogm.simulation.town.country import CountryBank, lay_fields, turn_rural
from ogm.simulation.town.furnish import furnish
from ogm.simulation.town.ground import Raster, cover, height_raster, make_terrain, raised, surface
from ogm.simulation.town.lanes import RING, Draft, Lane, make_lanes
from ogm.simulation.town.layout import make_plan
from ogm.simulation.town.lots import fill_blocks
from ogm.simulation.town.network import StreetNetwork, make_network

__all__ = ["Town", "build_town"]

HEIGHT_STEP = 0.25  # [m] spacing of the raster of ground heights
SHORTEST = 600.0  # [m] shortest round trip
TRIES = 12000  # random drives, of which the best becomes the round trip
ATTEMPTS = 20  # attempts to draw streets with round trips
SMALLEST, LARGEST = 240.0, 1000.0  # [m] limits of a town's size
APRON = 25.0  # [m] width of the ground, with backs of houses, beyond the square of streets


@dataclass(frozen=True, eq=False)
class Town:
    """A town around (0, 0), z up.

    Attributes
    ----------
    seed : int
        Seed of the town.
    size : float
        Side length of the square of streets [m]. Ground and outer houses extend 25 m beyond it.
    mesh : Mesh
        All static objects and the ground.
    ground : Mesh
        Surfaces for vehicles and pedestrians, without kerb faces.
    lanes : tuple of Lane
        Lanes of right-hand traffic.
    bays : (B, 6) float64
        Parking bays: x, y, z [m], yaw [rad], length, width [m].
    walkways : tuple of (M, 3) float64
        Paths of pedestrians: sidewalks, crossings, footpaths.
    loop, counter_loop : tuple of int
        Lanes of closed round trips of at least 600 m, clockwise and counter-clockwise.
    height : (n, n) float32
        Ground height at the points corner + height_step * (i, j), i along x [m].
    height_step : float
        Spacing of `height` [m].
    corner : (2,) float64
        Position x, y of point (0, 0) of `height` [m].
    districts : tuple of (Polygon, str)
        Blocks between the streets, with the names of their districts.
    """

    seed: int
    size: float
    mesh: Mesh
    ground: Mesh
    lanes: tuple[Lane, ...]
    bays: Floats
    walkways: tuple[Floats, ...]
    loop: tuple[int, ...]
    counter_loop: tuple[int, ...]
    height: Floats32
    height_step: float
    corner: Floats
    districts: tuple[tuple[Polygon, str], ...]

    def ground_height(self, x: Array, y: Array) -> Floats:
        """Return the ground height at x, y [m], interpolated bilinearly and constant beyond the raster."""
        return Raster(self.height, self.height_step, (float(self.corner[0]), float(self.corner[1])))(x, y)


def build_town(seed: int, size: float = 480.0, country: Country | None = None) -> Town:
    """Build the town of a seed.

    Parameters
    ----------
    seed : int
        Seed, 0 or more. Equal seeds and sizes give equal towns, bit for bit.
    size : float
        Side length of the square of streets [m], 240 to 1000. The ground extends 25 m beyond it, and at least 50 m
        beyond every lane.
    country : Country, optional
        Parameters of the country that replaces part of the town: banks, ditches and fields instead of houses.

    Raises
    ------
    ValueError
        If `seed` is not a whole number of 0 or more, or `size` is out of range.
    """
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"seed must be a whole number >= 0, got {seed!r}")
    if not SMALLEST <= float(size) <= LARGEST:
        raise ValueError(f"size must be in {SMALLEST:g} ... {LARGEST:g} m, got {size!r}")
    size = float(size)
    draws = [np.random.default_rng([int(seed), k]) for k in range(6)]
    network, draft, loops = _streets(int(seed), size, country)
    extent = size + 2 * APRON
    plan = make_plan(extent, network, draft, draws[1])
    lots = fill_blocks(plan, draws[4])
    terrain, fields = make_terrain(plan, draws[2]), []
    if country is not None:
        rng = np.random.default_rng([int(seed), 7])
        fields = lay_fields(plan, shapely.union_all([lot.shape for lot in lots]), country, rng)
        if fields:
            terrain = terrain._replace(bank=CountryBank(terrain.bank, fields, plan, rng))
    ground, kerbs = cover(plan, terrain)
    raster = height_raster(surface(ground), extent, HEIGHT_STEP)
    things = furnish(plan, lots, raster, draws[5], fields)
    bays = np.array([(*b.at, b.yaw, b.length, b.width) for b in plan.bays]).reshape(-1, 5)
    return Town(
        seed=int(seed),
        size=size,
        mesh=merge([ground, kerbs, *things]),
        ground=surface(ground),
        lanes=tuple(replace(lane, points=raised(lane.points, terrain.road)) for lane in draft.lanes),
        bays=np.column_stack([raised(bays[:, :2], raster), bays[:, 2:]]),
        walkways=tuple(raised(line, raster) for line in plan.walkways),
        loop=loops[0],
        counter_loop=loops[1],
        height=raster.values,
        height_step=raster.step,
        corner=np.array(raster.corner),
        districts=tuple((block.shape, block.style) for block in plan.blocks),
    )


def _streets(seed: int, size: float, country: Country | None) -> tuple[StreetNetwork, Draft, list[tuple[int, ...]]]:
    """Draw streets until round trips in both directions exist, which the first attempt nearly always achieves."""
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([seed, 6, attempt])
        rural = None if country is None else partial(turn_rural, country=country, rng=rng)
        network = make_network(size, np.random.default_rng([seed, 0, attempt]), rural)
        draft = make_lanes(network)
        shows = [_sight(network, draft, k) for k in range(len(draft.lanes))]
        worth = [_worth(show) for show in shows]
        rng = np.random.default_rng([seed, 3, attempt])
        loops = [round_trip(draft.lanes, shows, worth, sense, rng, 5.0 * size) for sense in (-1.0, 1.0)]
        if all(loops):
            return network, draft, loops
    raise RuntimeError(
        f"no streets with round trips of {SHORTEST:g} m for seed {seed} and size {size:g} m "
        f"in {ATTEMPTS} attempts; use another seed or a larger size"
    )


def _worth(show: str) -> float:
    """Return the value per metre of a trip, which favours streets between houses."""
    kind, _, district = show.partition(" ")
    if kind == "country":
        return 1.4
    if kind == "arterial" or district in ("industrial", "park"):
        return 0.1
    return 1.4 if district == "centre" else 1.0


def _sight(network: StreetNetwork, draft: Draft, lane: int) -> str:
    """Return the kind of surroundings of a lane: kind of street and district, "roundabout", or ""."""
    street = draft.streets[lane]
    if street >= 0:
        shown = network.streets[street]
        return f"{shown.profile.kind} {shown.district}"
    here = draft.lanes[lane]
    away = np.linalg.norm(here.points[0, :2] - network.grid.nodes[network.grid.roundabout])
    return "roundabout" if here.phase < 0 and away < RING else ""


def round_trip(
    lanes: list[Lane], kinds: list[str], worth: list[float], sense: float, rng: Generator, longest: float
) -> tuple[int, ...]:
    """Find a closed round trip of at least 600 m through many kinds of streets.

    Parameters
    ----------
    lanes : list of Lane
        All lanes.
    kinds : list of str
        Surroundings of each lane: kind of street and district, or "roundabout"; "" for neither.
    worth : list of float
        Value per metre of each lane.
    sense : float
        1 for counter-clockwise, -1 for clockwise.
    rng : np.random.Generator
        Generator of the candidate trips.
    longest : float
        Upper limit of the value of a trip's metres.

    Returns
    -------
    tuple of int
        Lanes of the trip in order; empty without a valid trip.
    """
    lengths = [lane.length for lane in lanes]
    begin = [k for k, lane in enumerate(lanes) if lane.junction < 0 and kinds[k]]
    best: tuple[float, tuple[int, ...]] = (-1.0, ())
    for _ in range(TRIES):
        found = _wander(lanes, int(rng.choice(begin)), rng)
        length = sum(lengths[k] for k in found)
        if length < SHORTEST:
            continue
        points = np.concatenate([lanes[k].points[:, :2] for k in found])
        following = np.roll(points, -1, axis=0)
        area = (points[:, 0] * following[:, 1] - following[:, 0] * points[:, 1]).sum() / 2
        if area * sense <= 0:
            continue
        seen = {kinds[k] for k in found if kinds[k]}
        metres = min(sum(lengths[k] * worth[k] for k in found), longest)
        total = 100.0 * len(seen) + 300.0 * ("roundabout" in seen) + metres
        if total > best[0]:
            best = total, found
    return best[1]


def _wander(lanes: list[Lane], start: int, rng: Generator) -> tuple[int, ...]:
    """Return the lanes of a random drive back to its start without crossing a junction twice, or an empty tuple."""
    trip, crossed = [start], set[int]()
    for draw in rng.random(200):
        here = lanes[trip[-1]]
        past = crossed - {here.junction}
        ways = [k for k in here.successors if k == start or not (k in trip or lanes[k].junction in past)]
        if not ways:
            return ()
        following = ways[int(draw * len(ways))]
        if following == start:
            return tuple(trip)
        crossed |= {lanes[following].junction} - {-1}
        trip.append(following)
    return ()
