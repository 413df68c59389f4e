"""Initial state of a scenario: bodies, parked vehicles, drivers with routes, pedestrians, signals."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator

from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Floats, Mask, Mesh
from ogm.simulation.town import Town
from ogm.simulation.traffic.bodies import CARS, VANS, Body, Shape, car, ego_body
from ogm.simulation.traffic.graph import Crossings, LaneTable, Lines, drivable
from ogm.simulation.traffic.heavy import bus, trailer, truck
from ogm.simulation.traffic.parked import park
from ogm.simulation.traffic.people import bicycle, motorcycle, standing, walking
from ogm.simulation.traffic.state import AHEAD, LAST, WARM_UP, Drivers, Signals, Walkers

PAINTS = (M.PAINT_LIGHT, M.PAINT_MEDIUM, M.PAINT_DARK, M.PAINT_BLACK)
PAINT_SHARES = (0.38, 0.27, 0.17, 0.18)
SHAPE_SHARES = {
    "small": 0.16, "hatchback": 0.27, "saloon": 0.13, "estate": 0.16, "suv": 0.17, "coupe": 0.04,
    "people carrier": 0.07,
}  # fmt: skip
# Driving parameters by kind: acceleration, braking, hardest braking [m/s^2], time gap [s], top speed [m/s].
MANNERS = {
    "ego": (1.8, 1.9, 4.0, 1.2, 50.0),
    "car": (1.7, 2.0, 6.0, 1.2, 50.0),
    "van": (1.4, 2.0, 6.0, 1.3, 40.0),
    "truck": (0.9, 1.6, 5.0, 1.6, 22.0),
    "bus": (1.0, 1.5, 5.0, 1.6, 22.0),
    "motorcycle": (2.4, 2.2, 6.0, 1.1, 50.0),
    "bicycle": (0.8, 1.6, 4.0, 1.0, 6.2),
}


class Fleet(NamedTuple):
    """Pools of bodies, shared by the participants of a scenario.

    Attributes
    ----------
    vehicles : dict of list of Body
        Vehicles by kind: the keys of `MANNERS` except "ego", and "trailer".
    walkers : list of list of Body
        Pedestrians, each in all poses of a walking cycle.
    standers : list of Body
        Standing pedestrians.
    """

    vehicles: dict[str, list[Body]]
    walkers: list[list[Body]]
    standers: list[Body]


def make_fleet(rng: Generator) -> Fleet:
    """Draw the bodies of a scenario; each car has its own dimensions."""

    def paint() -> M:
        return PAINTS[int(rng.choice(4, p=PAINT_SHARES))]

    names = rng.choice(list(SHAPE_SHARES), 28, p=np.array(list(SHAPE_SHARES.values())))
    vans = rng.choice(list(VANS), 6)
    vehicles = {
        "car": [car(_vary(CARS[str(name)], rng), paint()) for name in names],
        "van": [car(_vary(VANS[str(name)], rng), paint(), label="van", mirrors=0.16) for name in vans],
        "truck": [truck(rng, paint()) for _ in range(3)],
        "trailer": [trailer(rng) for _ in range(2)],
        "bus": [bus(rng, paint()) for _ in range(2)],
        "motorcycle": [motorcycle(rng, paint()) for _ in range(2)],
        "bicycle": [bicycle(rng) for _ in range(4)],
    }
    walkers = [walking(rng, grown=rng.random() > 0.12) for _ in range(20)]
    return Fleet(vehicles, walkers, [standing(rng) for _ in range(6)])


_ALONG = ("length", "wheelbase", "overhang", "cowl_at", "roof_at", "roof_end", "deck_at")
_UP = ("height", "nose", "cowl", "deck")


def _vary(shape: Shape, rng: Generator) -> Shape:
    """Scale a shape by random factors of a few per cent along each axis."""
    along, across, up = rng.normal(1.0, [0.025, 0.012, 0.02])
    factors = dict.fromkeys(_ALONG, along) | dict.fromkeys(_UP, up) | {"width": across}
    return replace(shape, **{name: getattr(shape, name) * factor for name, factor in factors.items()})


SPACING = 66.0  # [m] of lane per vehicle
MAX_VEHICLES = 60
PER_WALKWAY = 38.0  # [m] of walkway per pedestrian
MAX_WALKERS = 90
BICYCLES = 5  # in a hundred vehicles
HITCH = 0.4  # [m] between a lorry and the drawbar of its trailer


class Density(NamedTuple):
    """Density of the traffic of a scenario, relative to the usual one.

    Attributes
    ----------
    vehicles, people : float
        Factors on the numbers of moving vehicles and of pedestrians.
    bicycles : float
        Factor on the share of bicycles among the vehicles.
    """

    vehicles: float = 1.0
    people: float = 1.0
    bicycles: float = 1.0


USUAL = Density()


class Object(NamedTuple):
    """A moving or parked traffic participant at one time.

    Attributes
    ----------
    label : str
        "car", "van", "truck", "trailer", "bus", "motorcycle", "bicycle" or "pedestrian".
    pose : (4, 4) float64
        ``T_world_object``: origin in the middle of the footprint on the ground, x forward, tilted with the terrain.
    size : (3,) float64
        Length, width, height [m]: exact bounds of `mesh`, centred above the origin.
    velocity : (3,) float64
        Velocity in the world frame [m/s].
    track : int
        Number of the participant, constant within a scenario.
    mesh : Mesh
        Mesh in the object's frame, shared between frames.
    """

    label: str
    pose: Floats
    size: Floats
    velocity: Floats
    track: int
    mesh: Mesh


class Unit(NamedTuple):
    """A body of vehicle `driver`, with its front bumper `behind` metres behind the driver's."""

    body: Body
    driver: int
    behind: float
    left: float  # [m] offset from the lane's centre line


def _pick(choice: Sequence[Any], rng: Generator) -> Any:
    return choice[int(rng.integers(len(choice)))]


def fill_bays(town: Town, table: LaneTable, walkways: Lines, fleet: Fleet, rng: Generator) -> list[Object]:
    """Return the parked vehicles."""
    kinds = fleet.vehicles
    bodies = kinds["car"] + kinds["van"][:2] + kinds["truck"] + kinds["trailer"]
    placed = park(town.bays, table.points, walkways.points, bodies, town.ground_height, rng)
    first = 1000  # tracks of moving participants are smaller
    still = np.zeros(3)
    return [Object(body.label, pose, body.size, still, first + k, body.mesh) for k, (body, pose) in enumerate(placed)]


def set_out(
    town: Town, table: LaneTable, loop: tuple[int, ...], fleet: Fleet, density: Density, rng: Generator
) -> tuple[list[Unit], Drivers]:
    """Draw vehicles with their starting positions and routes; the ego vehicle is the first."""
    alive = drivable(town.lanes)
    open_road = np.flatnonzero(alive & ~table.guarded & (table.length > 9.0))
    count = int(min(MAX_VEHICLES, 1 + int(table.length[open_road].sum() / SPACING)) * density.vehicles)
    kinds = ["car"] * 70 + ["van"] * 9 + ["truck"] * 5 + ["bus"] * 4 + ["motorcycle"] * 5
    kinds += ["bicycle"] * round(BICYCLES * density.bicycles)
    units: list[Unit] = []
    drivers: list[tuple[int, float, float, tuple[float, ...]]] = []  # lane, front and length [m], manners
    taken: dict[int, list[tuple[float, float]]] = {}
    for n in range(count):
        kind = "ego" if n == 0 else _pick(kinds, rng)
        bodies, left = _bodies(kind, fleet, rng)
        parts, behind = [], 0.0
        for body in bodies:
            parts.append(Unit(body, len(drivers), behind, left))
            behind += body.size[0] + HITCH
        length = behind - HITCH
        for _ in range(40):
            lane = int(rng.choice([k for k in loop if not table.guarded[k]] if n == 0 else open_road))
            if table.length[lane] < length + 4:
                continue
            front = rng.uniform(length + 1, table.length[lane] - 2)
            near = taken.setdefault(lane, [])
            if all(front + 6 < low or front - length - 6 > high for low, high in near):
                near.append((front - length, front))
                units += parts
                drivers.append((lane, front, length, MANNERS[kind]))
                break
        else:
            if n == 0:
                raise ValueError("no lane of the round trip is long enough for the ego vehicle; use another seed")
    k = loop.index(drivers[0][0])
    routes = [[*loop[k:], *loop[:k]]] + [_wander(town, table, alive, lane, rng) for lane, *_ in drivers[1:]]
    _, fronts, lengths, manners = (np.array(column, np.float64) for column in zip(*drivers, strict=True))
    return units, _drivers(table, routes, fronts, lengths, manners, rng)


def _bodies(kind: str, fleet: Fleet, rng: Generator) -> tuple[list[Body], float]:
    """Draw a driver's bodies, and their offset to the left of the lane's centre line [m]."""
    if kind == "ego":
        return [ego_body()], 0.0
    bodies = [_pick(fleet.vehicles[kind], rng)]
    if kind == "truck" and rng.random() < 0.5:
        bodies.append(_pick(fleet.vehicles["trailer"], rng))
    return bodies, -0.6 if kind == "bicycle" else float(np.clip(rng.normal(0, 0.08), -0.15, 0.15))


def _wander(town: Town, table: LaneTable, alive: Mask, start: int, rng: Generator) -> list[int]:
    """Return a random route, long enough for the fastest driver until the end of the scenario."""
    route, length = [start], float(table.length[start])
    while length < float(table.limit.max()) * (LAST + WARM_UP) + 200.0:
        choice = [k for k in town.lanes[route[-1]].successors if alive[k]]
        route.append(choice[int(rng.integers(len(choice)))])
        length += float(table.length[route[-1]])
    return route


def _drivers(
    table: LaneTable, routes: list[list[int]], fronts: Floats, lengths: Floats, manners: Floats, rng: Generator
) -> Drivers:
    """Return the state of all vehicles for the kernels."""
    # Routes are as long as the fastest driver can get; shorter ones are repeated.
    far = float(table.limit.max()) * (LAST + WARM_UP) + 200.0
    rounds = [int(np.ceil(far / table.length[route].sum())) for route in routes]
    places = max(len(route) * n for route, n in zip(routes, rounds, strict=True)) + AHEAD + 2
    route = np.array([np.resize(lanes, places) for lanes in routes], np.int64)
    start = np.zeros((len(routes), places + 1))
    start[:, 1:] = np.cumsum(table.length[route], axis=1)
    count = len(routes)
    pace = np.clip(rng.normal(0.93, 0.06, count), 0.75, 1.0)
    pace[0] = 0.97
    dice = rng.integers(1, 2**63, count).astype(np.uint64)
    front, rear, granted = np.zeros(count, np.int64), np.zeros(count, np.int64), np.full(count, -1)
    speed, since = np.full(count, 2.0), np.full(count, -1.0)
    acceleration, braking, hardest, headway, top = manners.T.copy()
    moving = (route, start, fronts, speed, front, rear, granted, since, dice)
    return Drivers(*moving, lengths, acceleration, braking, hardest, headway, pace, top)


def make_signals(table: LaneTable, rng: Generator) -> Signals:
    """Draw signals at some junctions of three or more arms, except roundabouts."""
    count = int(table.junction.max()) + 1 if len(table.junction) else 0
    phases, green = np.zeros(count, np.int64), np.zeros(count, np.int64)
    for junction in range(count):
        inside = table.phase[table.junction == junction]
        if len(inside) and inside.min() >= 0 and inside.max() >= 2 and rng.random() < 0.6:
            phases[junction] = min(int(inside.max()) + 1, 16)
            green[junction] = rng.integers(phases[junction])
    return Signals(phases, green, np.zeros(count))


def choose_people(
    walkways: Lines, crossed: Crossings, fleet: Fleet, density: Density, rng: Generator
) -> tuple[Walkers, list[list[Body]], Floats]:
    """Draw pedestrians with their walkways, positions and speeds; return their bodies and offsets to the right too."""
    zones, count = crossed.on_walkway, max(crossed.zones, 1)
    lengths = walkways.length
    usable = np.flatnonzero(lengths > 6.0)
    number = int(min(MAX_WALKERS, int(lengths[usable].sum() / PER_WALKWAY)) * density.people) if len(usable) else 0
    share = lengths[usable] * np.where(
        lengths[usable] < 25, 0.5, 1.0
    )  # fewer pedestrians start on short walkways: crossings
    still = min(number // 10, len(usable) // 4)  # standing pedestrians have a walkway of their own
    line = np.zeros(number, np.int64)
    if number:
        line[:still] = rng.choice(usable, still, replace=False, p=share / share.sum())
        share = np.where(np.isin(usable, line[:still]), 0.0, share)
        line[still:] = rng.choice(usable, number - still, p=share / share.sum())
    slot = np.array([np.count_nonzero(line[:n] == line[n]) for n in range(number)], np.int64)
    short = np.minimum(0.1 + 0.9 * slot, lengths[line] / 3)
    way = lengths[line] - 2 * short
    w = np.zeros(number)
    people: list[list[Body]] = []
    pace = np.clip(rng.normal(1.3, 0.18, number), 0.7, 1.9)
    pace[:still] = 0.0
    for n in range(number):
        mine = zones[zones[:, 0] == line[n]]
        for _ in range(20):
            u = rng.uniform(0, way[n])
            if not ((mine[:, 1] - 0.8 < u + short[n]) & (u + short[n] < mine[:, 2] + 0.8)).any():
                w[n] = u
                break
        if n >= still and rng.random() < 0.5 and w[n] > 0:
            w[n] = 2 * way[n] - w[n]
        people.append([_pick(fleet.standers, rng)] if n < still else _pick(fleet.walkers, rng))
    rest = rng.uniform(1, 15, number) + np.where(way < 25, 12.0, 0.0)
    side = rng.uniform(0.36, 0.44, number)
    resting = rest * (w % np.maximum(way, 1e-9) == 0)
    zone, busy, left = np.full(number, -1, np.int64), np.zeros(count, np.int64), np.full(count, -100.0)
    return Walkers(line, way, short, w, pace, rest, resting, zone, busy, left), people, side
