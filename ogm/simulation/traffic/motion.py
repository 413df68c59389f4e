"""Motion of the traffic: positions of all participants as a pure function of town, seed, direction and time."""

from typing import NamedTuple

import numpy as np

from ogm.simulation.mesh import Floats
from ogm.simulation.town import Town
from ogm.simulation.traffic.departure import (
    USUAL,
    Density,
    Object,
    choose_people,
    fill_bays,
    make_fleet,
    make_signals,
    set_out,
)
from ogm.simulation.traffic.graph import Lines, along_lines, along_routes, crossings, lane_table, lines
from ogm.simulation.traffic.kernels import advance
from ogm.simulation.traffic.parked import frames
from ogm.simulation.traffic.people import PHASES, STRIDE
from ogm.simulation.traffic.state import LAST, STEP, WARM_UP, Record

CHUNK = 500  # steps per call of the kernel


class TrafficState(NamedTuple):
    """State of all traffic participants at one time.

    Attributes
    ----------
    time : float
        Time since the start of the scenario [s].
    ego : (4, 4) float64
        ``T_world_vehicle`` of the ego vehicle.
    ego_velocity : (3,) float64
        Velocity of the ego vehicle in the world frame [m/s].
    ego_yaw_rate : float
        Yaw rate of the ego vehicle, positive counter-clockwise [rad/s].
    objects : tuple of Object
        All other participants: parked, driving, walking.
    """

    time: float
    ego: Floats
    ego_velocity: Floats
    ego_yaw_rate: float
    objects: tuple[Object, ...]


class Traffic:
    """The traffic of a scenario.

    Parameters
    ----------
    town : Town
    seed : int
        Seed of bodies, parked vehicles, routes and driving parameters; 0 or more.
    clockwise : bool
        Whether the ego vehicle drives ``town.loop`` or ``town.counter_loop``.
    density : Density

    Raises
    ------
    ValueError
        If the seed is not a whole number of 0 or more.
    """

    def __init__(self, town: Town, seed: int, *, clockwise: bool, density: Density = USUAL) -> None:
        if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
            raise ValueError(f"seed must be a whole number >= 0, got {seed!r}")
        loop = town.loop if clockwise else town.counter_loop
        draws = [np.random.default_rng([int(seed), int(clockwise), k]) for k in range(5)]
        self._town = town
        self._table = lane_table(town.lanes)
        self._fleet = make_fleet(draws[0])
        self._walkways = lines(town.walkways)
        self._parked = fill_bays(town, self._table, self._walkways, self._fleet, draws[1])
        self._units, self._drivers = set_out(town, self._table, loop, self._fleet, density, draws[2])
        self._crossings = crossings(self._table, self._walkways)
        people = choose_people(self._walkways, self._crossings, self._fleet, density, draws[3])
        self._walkers, self._people, self._sides = people
        self._signals = make_signals(self._table, draws[4])
        steps = int(round((LAST + WARM_UP) / STEP)) + 3
        vehicles, walkers = len(self._drivers.x), len(self._walkers.w)
        v, w = np.empty((steps, vehicles), np.float32), np.empty((steps, walkers), np.float32)
        self._record = Record(np.empty((steps, vehicles)), v, w)
        self._done = 0

    def at(self, time: float) -> TrafficState:
        """Return the traffic at a time.

        Parameters
        ----------
        time : float
            Time, 0 to 1200 s. The first call that reaches a time simulates up to it; earlier times take no simulation,
            and the results do not depend on the order of calls.

        Raises
        ------
        ValueError
            If the time is out of range or not finite.
        """
        time = float(time)
        if not 0 <= time <= LAST:
            raise ValueError(f"time must be in 0 ... {LAST:g} s, got {time}; use another seed for more traffic")
        step = (time + WARM_UP) / STEP
        self._simulate(int(step) + 3)
        poses, velocity, turn = self._vehicles(step)
        objects = list(self._parked)
        for k, unit in enumerate(self._units[1:], 1):
            objects.append(Object(unit.body.label, poses[k], unit.body.size, velocity[k], k, unit.body.mesh))
        objects += self._pedestrians(step)
        return TrafficState(time, poses[0], velocity[0], turn, tuple(objects))

    def _simulate(self, steps: int) -> None:
        """Simulate until the record has `steps` states."""
        while self._done < steps:
            rows = slice(self._done, min(self._done + CHUNK, len(self._record.x)))
            state = (self._table, self._crossings, self._drivers, self._signals, self._walkers)
            x, v, w = self._record
            advance(*state, self._done, Record(x[rows], v[rows], w[rows]))
            self._done = rows.stop

    def _vehicles(self, step: float) -> tuple[Floats, Floats, float]:
        """Return poses (U, 4, 4) and velocities (U, 3) of all units, and the yaw rate of the ego vehicle."""
        before, now, after = (self._place(step + half) for half in (-0.5, 0.0, 0.5))
        turn = (after[1][0] - before[1][0] + np.pi) % (2 * np.pi) - np.pi
        return frames(*now), (after[0] - before[0]) / STEP, float(turn / STEP)

    def _place(self, step: float) -> tuple[Floats, Floats, Floats, Floats]:
        """Return middle (U, 3), yaw, slope ahead and slope to the left of each unit at a step."""
        units, d = self._units, self._drivers
        # Distance covered by each driver [m]: cubic Hermite polynomial through positions and speeds at both steps.
        k, t = int(step), step - int(step)
        a, b = self._record.x[k], self._record.x[k + 1]
        v, u = self._record.v[k] * STEP, self._record.v[k + 1] * STEP
        fronts = a + t * v + t * t * (3 * (b - a) - 2 * v - u) + t * t * t * (2 * (a - b) + v + u)
        driver = np.array([unit.driver for unit in units])
        half = np.array([unit.body.size[0] / 2 for unit in units])
        center = fronts[driver] - [unit.behind for unit in units] - half
        axles = np.array([unit.body.axles for unit in units])
        # Rounding stops at the front bumper, because the route beyond it may still change.
        reach = np.clip(half - axles[:, 0], 0.1, 0.9)
        points = np.empty((2, len(units), 3))
        centers = Lines(self._table.points, self._table.along, self._table.first)
        for k in range(2):
            along_routes(centers, d.route, d.start, driver, center + axles[:, k], reach, points[k])
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
        """Return the pedestrians at a step."""
        places, walked, yaw = self._walk(step)
        before, after = self._walk(step - 0.5)[0], self._walk(step + 0.5)[0]
        velocity = (after - before) / STEP
        flat = np.zeros(len(places))
        poses = frames(places, yaw, flat, flat)
        result = []
        for k, phases in enumerate(self._people):
            stride = STRIDE * phases[0].size[2] / 1.75
            body = phases[int(walked[k] / stride * PHASES) % len(phases)]
            result.append(Object(body.label, poses[k], body.size, velocity[k], len(self._units) + k, body.mesh))
        return result

    def _walk(self, step: float) -> tuple[Floats, Floats, Floats]:
        """Return position (N, 3), distance walked (N,) and direction (N,) of the pedestrians at a step."""
        k, t = int(step), step - int(step)
        w = (1 - t) * self._record.w[k].astype(np.float64) + t * self._record.w[k + 1]
        way = self._walkers.way
        turns = np.floor(w / way)
        forth = turns % 2 == 0
        done = w - turns * way
        u = np.where(forth, done, way - done) + self._walkers.short
        a, places, b = (np.empty((len(w), 3)) for _ in range(3))
        for shift, out in ((-0.8, a), (0.0, places), (0.8, b)):
            along_lines(self._walkways, self._walkers.line, u + shift, out)
        c, s = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
        norm = np.hypot(c, s)
        # Pedestrians walk on the right, and change sides within a metre of the turning points.
        right = self._sides * np.where(forth, 1.0, -1.0) * np.minimum(np.minimum(done, way - done), 1.0)
        places[:, 0] += right * s / norm
        places[:, 1] -= right * c / norm
        places[:, 2] = self._town.ground_height(places[:, 0], places[:, 1])
        return places, w, np.arctan2(s, c) + np.where(forth, 0, np.pi)
