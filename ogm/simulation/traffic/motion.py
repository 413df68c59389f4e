"""Traffic in motion: who is where at a time, a pure function of town, seed, direction and time."""

from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from ogm.simulation.arrays import Floats
from ogm.simulation.mesh import Mesh
from ogm.simulation.town import Town
from ogm.simulation.traffic.bodies import Body, ego_body
from ogm.simulation.traffic.fleet import EGO_MANNERS, MANNERS, Fleet, Manners, make_fleet
from ogm.simulation.traffic.graph import LaneTable, crossings, drivable, lane_table
from ogm.simulation.traffic.kernels import AHEAD, STEP, Drivers, Signals, Walkers, advance
from ogm.simulation.traffic.parked import frames, park
from ogm.simulation.traffic.paths import Lines, along_lines, along_routes, lines
from ogm.simulation.traffic.people import PHASES, STRIDE

LAST = 1200.0  # [s] scenarios end here
WARM_UP = 30.0  # [s] simulated before time 0, so that queues have formed
CHUNK = 500  # steps simulated at once
SPACING = 66.0  # [m] of lane per vehicle
MOST = 60  # vehicles
PER_WALKWAY = 38.0  # [m] of walkway per pedestrian
MOST_WALKERS = 90
HITCH = 0.4  # [m] between a lorry and the drawbar of its trailer


class Object(NamedTuple):
    """A participant in traffic, moving or parked, at one time.

    Attributes
    ----------
    label : str
        "car", "van", "truck", "trailer", "bus", "motorcycle", "bicycle" or "pedestrian".
    pose : (4, 4) float64
        ``T_world_object``: origin in the middle of the footprint on the ground, x forward, tilted with the terrain.
    size : (3,) float64
        Length, width, height [m]: the exact bounds of `mesh`, centred on the origin and standing on it.
    velocity : (3,) float64
        In the world [m/s].
    track : int
        The same for the same participant in all frames of a scenario.
    mesh : Mesh
        In the object's frame, shared between frames.
    """

    label: str
    pose: Floats
    size: Floats
    velocity: Floats
    track: int
    mesh: Mesh


class TrafficState(NamedTuple):
    """Everything that is not part of the town, at one time.

    Attributes
    ----------
    time : float
        [s]
    ego : (4, 4) float64
        ``T_world_vehicle`` of the ego vehicle.
    ego_velocity : (3,) float64
        In the world [m/s].
    ego_yaw_rate : float
        [rad/s], counter-clockwise is positive.
    objects : tuple of Object
        All others: parked, driving, walking.
    """

    time: float
    ego: Floats
    ego_velocity: Floats
    ego_yaw_rate: float
    objects: tuple[Object, ...]


class _Unit(NamedTuple):
    """One body on wheels: vehicle `driver`, whose front bumper is `behind` metres behind the driver's."""

    body: Body
    driver: int
    behind: float
    left: float  # [m] from the lane's centre line


class Traffic:
    """The traffic of one scenario.

    Parameters
    ----------
    town : Town
    seed : int
        Draws everything: bodies, parked cars, routes, habits. Whole number >= 0.
    clockwise : bool
        Whether the ego vehicle drives ``town.loop`` or ``town.counter_loop``.

    Raises
    ------
    ValueError
        If the seed is no whole number >= 0, or the round trip is not closed.
    """

    def __init__(self, town: Town, seed: int, *, clockwise: bool) -> None:
        if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
            raise ValueError(f"seed must be a whole number >= 0, got {seed!r}")
        loop = town.loop if clockwise else town.counter_loop
        _check_loop(town, loop)
        draws = [np.random.default_rng([int(seed), int(clockwise), k]) for k in range(5)]
        self._town = town
        self._table = lane_table(town.lanes)
        self._fleet = make_fleet(draws[0])
        self._walkways = lines(town.walkways)
        self._parked = _park(town, self._table, self._walkways, self._fleet, draws[1])
        self._units, self._drivers = _set_out(town, self._table, loop, self._fleet, draws[2])
        self._crossings = crossings(self._table, self._walkways)
        self._walkers, self._people, self._sides = _people(
            self._walkways, self._crossings.on_walkway, self._crossings.zones, self._fleet, draws[3]
        )
        self._signals = _signals(self._table, draws[4])
        steps = int(round((LAST + WARM_UP) / STEP)) + 3
        self._x = np.empty((steps, len(self._drivers.x)))
        self._v = np.empty((steps, len(self._drivers.x)), np.float32)
        self._w = np.empty((steps, len(self._walkers.w)), np.float32)
        self._done = 0

    def at(self, time: float) -> TrafficState:
        """Return everybody's place at a time.

        Parameters
        ----------
        time : float
            0 to 1200 s. The first call that reaches a time simulates up to it; earlier and repeated times cost
            nothing, and the order of calls makes no difference.

        Raises
        ------
        ValueError
            If the time lies outside or is not finite.
        """
        time = float(time)
        if not 0 <= time <= LAST:
            raise ValueError(
                f"time must lie in [0, {LAST:g}] s, got {time}; use another seed for more traffic"
            )
        step = (time + WARM_UP) / STEP
        self._simulate(int(step) + 3)
        poses, velocity, turn = self._vehicles(step)
        objects = list(self._parked)
        for k, unit in enumerate(self._units[1:], 1):
            objects.append(Object(unit.body.label, poses[k], unit.body.size, velocity[k], k, unit.body.mesh))
        objects += self._pedestrians(step)
        return TrafficState(time, poses[0], velocity[0], turn, tuple(objects))

    def _simulate(self, steps: int) -> None:
        """Simulate until there are this many states."""
        while self._done < steps:
            rows = slice(self._done, min(self._done + CHUNK, len(self._x)))
            advance(
                self._table,
                self._crossings,
                self._drivers,
                self._signals,
                self._walkers,
                self._done,
                self._x[rows],
                self._v[rows],
                self._w[rows],
            )
            self._done = rows.stop

    def _fronts(self, step: float) -> Floats:
        """Return the way that each driver has covered [m], smooth between the steps (cubic Hermite)."""
        k = int(step)
        t = step - k
        a, b = self._x[k], self._x[k + 1]
        v, u = self._v[k] * STEP, self._v[k + 1] * STEP
        return (
            a + t * v + t * t * (3 * (b - a) - 2 * v - u) + t * t * t * (2 * (a - b) + v + u)
        )  # the polynomial with these values and slopes at both ends

    def _vehicles(self, step: float) -> tuple[Floats, Floats, float]:
        """Return poses (U, 4, 4) and velocities (U, 3) of all units, and the yaw rate of the ego vehicle."""
        h = 0.5  # steps
        now = self._place(step)
        before, after = self._place(step - h), self._place(step + h)
        velocity = (after[0] - before[0]) / (2 * h * STEP)
        turn = (after[1][0] - before[1][0] + np.pi) % (2 * np.pi) - np.pi
        return frames(now[0], now[1], now[2], now[3]), velocity, float(turn / (2 * h * STEP))

    def _place(self, step: float) -> tuple[Floats, Floats, Floats, Floats]:
        """Return middle (U, 3), yaw, slope ahead and slope to the left of each unit."""
        fronts = self._fronts(step)
        units, d = self._units, self._drivers
        driver = np.array([unit.driver for unit in units])
        half = np.array([unit.body.size[0] / 2 for unit in units])
        center = fronts[driver] - [unit.behind for unit in units] - half
        axles = np.array([unit.body.axles for unit in units])
        # Never look beyond the front bumper: the route there may still change.
        reach = np.clip(half - axles[:, 0], 0.1, 0.9)
        points = np.empty((2, len(units), 3))
        t = self._table
        for k in range(2):
            along_routes(
                t.points, t.along, t.first, d.route, d.start, driver, center + axles[:, k], reach, points[k]
            )
        ahead = points[0] - points[1]
        base = np.hypot(ahead[:, 0], ahead[:, 1])
        yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
        slope = ahead[:, 2] / base
        # From the middle between the axles to the middle of the body.
        shift = -axles.mean(axis=1)
        left = np.array([unit.left for unit in units])
        c, s = np.cos(yaw), np.sin(yaw)
        middle = points.mean(axis=0) + shift[:, None] * np.stack([c, s, slope], axis=1)
        middle[:, 0] -= s * left
        middle[:, 1] += c * left
        side = np.array([max(unit.body.size[1] * 0.4, 0.3) for unit in units])
        x, y = middle[:, 0], middle[:, 1]
        heights = [self._town.ground_height(x - q * s * side, y + q * c * side) for q in (1.0, -1.0)]
        bank = (heights[0] - heights[1]) / (2 * side)
        middle[:, 2] += bank * left
        return middle, yaw, slope, bank

    def _pedestrians(self, step: float) -> list[Object]:
        """Return the people on foot."""
        places, walked, yaw = self._walk(step)
        before, after = self._walk(step - 0.5)[0], self._walk(step + 0.5)[0]
        velocity = (after - before) / STEP
        first = len(self._units)
        flat = np.zeros(len(places))
        poses = frames(places, yaw, flat, flat)
        result = []
        for k, poses_of in enumerate(self._people):
            height = poses_of[0].size[2]
            stride = STRIDE * height / 1.75
            body = poses_of[int(walked[k] / stride * PHASES) % len(poses_of)]
            result.append(Object(body.label, poses[k], body.size, velocity[k], first + k, body.mesh))
        return result

    def _walk(self, step: float) -> tuple[Floats, Floats, Floats]:
        """Return place (N, 3), way walked (N,) and direction (N,) of the people on foot."""
        k = int(step)
        t = step - k
        w = (1 - t) * self._w[k].astype(np.float64) + t * self._w[k + 1]
        way = self._walkers.way
        turns = np.floor(w / way)
        forth = turns % 2 == 0
        done = w - turns * way
        u = np.where(forth, done, way - done) + self._walkers.short
        a, places, b = (np.empty((len(w), 3)) for _ in range(3))
        for shift, out in ((-0.8, a), (0.0, places), (0.8, b)):
            along_lines(*self._walkways, self._walkers.line, u + shift, out)
        c, s = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
        norm = np.hypot(c, s)
        # To the right of where one goes; who turns round changes sides within the last metre.
        right = self._sides * np.where(forth, 1.0, -1.0) * np.minimum(np.minimum(done, way - done), 1.0)
        places[:, 0] += right * s / norm
        places[:, 1] -= right * c / norm
        places[:, 2] = self._town.ground_height(places[:, 0], places[:, 1])
        return places, w, np.arctan2(s, c) + np.where(forth, 0, np.pi)


def _check_loop(town: Town, loop: tuple[int, ...]) -> None:
    if not loop:
        raise ValueError("the town has no round trip for the ego vehicle: its loop is empty")
    for a, b in zip(loop, (*loop[1:], loop[0]), strict=True):
        if b not in town.lanes[a].successors:
            raise ValueError(f"the round trip must be closed, but lane {a} of it does not lead to lane {b}")


def _park(town: Town, table: LaneTable, walkways: Lines, fleet: Fleet, rng: Generator) -> list[Object]:
    bodies = fleet.cars + fleet.vans[:2] + fleet.trucks + fleet.trailers
    placed = park(town.bays, table.points, walkways.points, bodies, town.ground_height, rng)
    first = 1000  # tracks of what moves are smaller
    still = np.zeros(3)
    return [
        Object(body.label, pose, body.size, still, first + k, body.mesh)
        for k, (body, pose) in enumerate(placed)
    ]


def _set_out(
    town: Town, table: LaneTable, loop: tuple[int, ...], fleet: Fleet, rng: Generator
) -> tuple[list[_Unit], Drivers]:
    """Choose vehicles, where they start and where they go; the ego vehicle is the first."""
    alive = drivable(town.lanes)
    open_road = np.flatnonzero(alive & ~table.guarded & (table.length > 9.0))
    count = min(MOST, 1 + int(table.length[open_road].sum() / SPACING))
    kinds = ["car"] * 70 + ["van"] * 9 + ["truck"] * 5 + ["bus"] * 4 + ["motorcycle"] * 5 + ["bicycle"] * 5
    units: list[_Unit] = []
    lengths: list[float] = []
    manners: list[Manners] = []
    starts: list[tuple[int, float]] = []
    taken: dict[int, list[tuple[float, float]]] = {}
    for n in range(count):
        kind = "ego" if n == 0 else kinds[int(rng.integers(len(kinds)))]
        bodies, left = _bodies(kind, fleet, rng)
        parts, behind = [], 0.0
        for body in bodies:
            parts.append(_Unit(body, len(lengths), behind, left))
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
                lengths.append(length)
                manners.append(EGO_MANNERS if n == 0 else MANNERS[kind])
                starts.append((lane, front))
                break
        else:
            if n == 0:
                raise ValueError("no lane of the round trip is long enough for the ego vehicle to start on")
    routes = [_around(loop, starts[0][0])] + [
        _wander(town, table, alive, lane, rng) for lane, _ in starts[1:]
    ]
    return units, _drivers(table, routes, lengths, manners, [front for _, front in starts], rng)


def _bodies(kind: str, fleet: Fleet, rng: Generator) -> tuple[list[Body], float]:
    """Draw the bodies that one driver moves, and how far left of the lane's middle."""
    if kind == "ego":
        return [ego_body()], 0.0
    choice = {
        "car": fleet.cars,
        "van": fleet.vans,
        "truck": fleet.trucks,
        "bus": fleet.buses,
        "motorcycle": fleet.motorcycles,
        "bicycle": fleet.bicycles,
    }[kind]
    bodies = [choice[int(rng.integers(len(choice)))]]
    if kind == "truck" and rng.random() < 0.5:
        bodies.append(fleet.trailers[int(rng.integers(len(fleet.trailers)))])
    return bodies, -0.6 if kind == "bicycle" else float(np.clip(rng.normal(0, 0.08), -0.15, 0.15))


def _around(loop: tuple[int, ...], start: int) -> list[int]:
    """Return the round trip from one of its lanes on."""
    k = loop.index(start)
    return list(loop[k:] + loop[:k])


def _wander(town: Town, table: LaneTable, alive: NDArray[np.bool_], start: int, rng: Generator) -> list[int]:
    """Return a route that turns at random for as long as the scenario lasts, and so does the fastest driver."""
    route, length = [start], float(table.length[start])
    while length < float(table.limit.max()) * (LAST + WARM_UP) + 200.0:
        choice = [k for k in town.lanes[route[-1]].successors if alive[k]]
        route.append(choice[int(rng.integers(len(choice)))])
        length += float(table.length[route[-1]])
    return route


def _drivers(
    table: LaneTable,
    routes: list[list[int]],
    lengths: list[float],
    manners: list[Manners],
    fronts: list[float],
    rng: Generator,
) -> Drivers:
    """Arrange vehicles for the kernels."""
    # As many lanes as the fastest driver can come to; a shorter route is begun again.
    far = float(table.limit.max()) * (LAST + WARM_UP) + 200.0
    rounds = [int(np.ceil(far / table.length[route].sum())) for route in routes]
    places = max(len(route) * n for route, n in zip(routes, rounds, strict=True)) + AHEAD + 2
    route = np.array([np.resize(one, places) for one in routes], np.int64)
    start = np.zeros((len(routes), places + 1))
    start[:, 1:] = np.cumsum(table.length[route], axis=1)
    count = len(routes)
    zero = np.zeros(count, np.int64)
    pace = np.clip(rng.normal(0.93, 0.06, count), 0.75, 1.0)
    pace[0] = 0.97
    columns = np.array(manners, np.float64).T
    return Drivers(
        route,
        start,
        np.array(fronts),
        np.full(count, 2.0),
        zero.copy(),
        zero.copy(),
        zero - 1,
        np.full(count, -1.0),
        rng.integers(1, 2**63, count).astype(np.uint64),
        np.array(lengths),
        columns[0].copy(),
        columns[1].copy(),
        columns[2].copy(),
        columns[3].copy(),
        pace,
        columns[4].copy(),
    )


def _signals(table: LaneTable, rng: Generator) -> Signals:
    """Put signals at some of the junctions of three and more arms that are no roundabouts."""
    count = int(table.junction.max()) + 1 if len(table.junction) else 0
    phases, green = np.zeros(count, np.int64), np.zeros(count, np.int64)
    for junction in range(count):
        inside = table.phase[table.junction == junction]
        if len(inside) and inside.min() >= 0 and inside.max() >= 2 and rng.random() < 0.6:
            phases[junction] = min(int(inside.max()) + 1, 16)
            green[junction] = rng.integers(phases[junction])
    return Signals(phases, green, np.zeros(count))


def _people(
    walkways: Lines, zones: Floats, count: int, fleet: Fleet, rng: Generator
) -> tuple[Walkers, list[list[Body]], Floats]:
    """Choose pedestrians, where they start, how fast they walk, and how far right of the line."""
    lengths = walkways.length
    usable = np.flatnonzero(lengths > 6.0)
    number = min(MOST_WALKERS, int(lengths[usable].sum() / PER_WALKWAY)) if len(usable) else 0
    share = lengths[usable] * np.where(
        lengths[usable] < 25, 0.5, 1.0
    )  # crossings are waited at, not lived on
    still = min(number // 10, len(usable) // 4)  # who stands has a walkway for himself
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
        if n < still:
            people.append([fleet.standers[int(rng.integers(len(fleet.standers)))]])
        else:
            people.append(fleet.walkers[int(rng.integers(len(fleet.walkers)))])
    rest = rng.uniform(1, 15, number) + np.where(way < 25, 12.0, 0.0)
    side = rng.uniform(0.36, 0.44, number)
    walkers = Walkers(
        line,
        way,
        short,
        w,
        pace,
        rest,
        rest * (w % np.maximum(way, 1e-9) == 0),
        np.full(number, -1, np.int64),
        np.zeros(max(count, 1), np.int64),
        np.full(max(count, 1), -100.0),
    )
    return walkers, people, side
