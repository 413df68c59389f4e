"""Lanes and walkways as arrays: positions on them, speed profiles, conflicts of lanes, crossings of pedestrians."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from ogm.jit import kernel
from ogm.simulation.mesh import Floats, Floats32, Ints, Mask
from ogm.simulation.town.lanes import Lane


class Lines(NamedTuple):
    """Concatenated polylines: points (P, 3), distance along each line (P,) [m], first point of each line (L + 1,)."""

    points: Floats
    along: Floats
    first: Ints

    @property
    def length(self) -> Floats:
        """Length of each line [m]."""
        return self.along[self.first[1:] - 1]


def lines(parts: Sequence[Floats]) -> Lines:
    """Concatenate lines (M, 3), without repeated points."""
    kept = []
    for part in parts:
        points = np.asarray(part, np.float64)
        step = np.linalg.norm(np.diff(points, axis=0), axis=1)
        kept.append(points[np.concatenate([[True], step > 1e-9])])
    along = [np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))]) for p in kept]
    first = np.concatenate([[0], np.cumsum([len(p) for p in kept])]).astype(np.int64)
    return Lines(np.concatenate([np.zeros((0, 3)), *kept]), np.concatenate([np.zeros(0), *along]), first)


@kernel
def _add(table: Lines, first: int, last: int, s: float, weight: float, out: Floats) -> None:
    """Add the weighted point at distance `s` along a line to `out`."""
    points, along = table.points, table.along
    low, high = first, last - 1
    while high - low > 1:
        middle = (low + high) // 2
        if along[middle] <= s:
            low = middle
        else:
            high = middle
    share = (s - along[low]) / (along[low + 1] - along[low])
    for k in range(3):
        out[k] += weight * ((1 - share) * points[low, k] + share * points[low + 1, k])


@kernel
def along_routes(
    table: Lines, route: Ints, start: Floats, driver: Ints, way: Floats, reach: Floats, out: Floats
) -> None:
    """Write positions (U, 3) at distance `way` on drivers' routes to `out`, with corners rounded over `reach` [m]."""
    first = table.first
    for u in range(len(way)):
        n = driver[u]
        out[u] = 0.0
        for k in range(3):
            s = way[u] + (k - 1) * reach[u]
            place = max(np.searchsorted(start[n], s, side="right") - 1, 0)
            lane = route[n, place]
            weight = 0.5 if k == 1 else 0.25
            _add(table, first[lane], first[lane + 1], s - start[n, place], weight, out[u])


@kernel
def along_lines(table: Lines, line: Ints, way: Floats, out: Floats) -> None:
    """Write the positions (N, 3) at distance `way` on lines, clipped to their ends, to `out`."""
    for n in range(len(way)):
        low, high = table.first[line[n]], table.first[line[n] + 1]
        out[n] = 0.0
        _add(table, low, high, min(max(way[n], 0.0), table.along[high - 1]), 1.0, out[n])


SIDEWAYS = 2.0  # [m/s^2] comfortable lateral acceleration
BRAKING = 1.6  # [m/s^2] comfortable braking before a bend
APART = 2.5  # [m] distance of centre lines below which two lanes of a junction are in conflict
MERGED = 1.6  # [m] the same outside junctions, where lanes run side by side


class LaneTable(NamedTuple):
    """Concatenated lanes with their conflicts; P points, L lanes.

    Attributes
    ----------
    points : (P, 3) float64
        Centre lines [m].
    along : (P,) float64
        Distance from the lane's start [m].
    limit : (P,) float64
        Highest speed [m/s], which includes bends and braking before them within the lane.
    first : (L + 1,) int64
        First point of each lane.
    length : (L,) float64
        Length of each lane [m].
    guarded : (L,) bool
        Lanes that require permission: all in junctions, and lanes that cross or merge.
    junction, phase : (L,) int64
        Junction and signal phase of each lane; -1 outside junctions, or without a signal.
    blocked_until : (L, L) float32
        [c, l]: a vehicle on lane c blocks lane l until its rear is this far along c [m]; -1 without a conflict.
    together_until : (L, L) float32
        [a, b]: distance [m] at which lanes with a common start diverge; -1 without a common start.
    onward : (L, S) int64
        Successors of each lane from which a route never ends, padded with -1.
    fork : (L,) bool
        Lanes within a junction with several successors: arcs of a roundabout that end at an exit.
    most : (J,) int64
        Largest number of vehicles in a roundabout: its waiting positions less 1, so that some vehicle can always move.
    """

    points: Floats
    along: Floats
    limit: Floats
    first: Ints
    length: Floats
    guarded: Mask
    junction: Ints
    phase: Ints
    blocked_until: Floats32
    together_until: Floats32
    onward: Ints
    fork: Mask
    most: Ints


class Crossings(NamedTuple):
    """Zones in which walkways cross lanes, used either by pedestrians or by vehicles.

    Attributes
    ----------
    on_lane : (K, 4) float64
        Lane, start and end along it [m], zone; sorted by lane.
    lane_first : (L + 1,) int64
        First row of each lane in `on_lane`.
    on_walkway : (K', 4) float64
        Walkway, start and end along it [m], zone; sorted by walkway.
    walkway_first : (W + 1,) int64
        First row of each walkway in `on_walkway`.
    zones : int
        Number of zones.
    """

    on_lane: Floats
    lane_first: Ints
    on_walkway: Floats
    walkway_first: Ints
    zones: int


def _limit(lane: Lane, along: Floats) -> Floats:
    """Return the speed profile of a lane [m/s] from its limit, its bends, and braking before them."""
    points = lane.points[:, :2]
    limit: Floats = np.full(len(points), float(lane.speed))
    if len(points) > 3:
        reach = min(2, (len(points) - 1) // 2)
        heading = np.unwrap(np.arctan2(*np.diff(points, axis=0).T[::-1]))
        middle = (along[1:] + along[:-1]) / 2
        turn = np.abs(heading[reach:] - heading[:-reach]) / np.maximum(middle[reach:] - middle[:-reach], 0.3)
        bend = np.interp(along, (middle[reach:] + middle[:-reach]) / 2, turn)
        limit = np.minimum(limit, np.sqrt(SIDEWAYS / np.maximum(bend, 1e-4)))
    limit = np.maximum(limit, 2.0)
    for k in range(len(limit) - 2, -1, -1):
        limit[k] = min(limit[k], np.sqrt(limit[k + 1] ** 2 + 2 * BRAKING * (along[k + 1] - along[k])))
    return limit


def lane_table(lanes: Sequence[Lane]) -> LaneTable:
    """Return the arrays of all lanes for the kernels, with their conflicts."""
    centers = lines([lane.points for lane in lanes])
    along = np.split(centers.along, centers.first[1:-1])
    blocked, together = _conflicts(lanes, along)
    junction = np.array([lane.junction for lane in lanes], np.int64)
    phase = np.array([lane.phase for lane in lanes], np.int64)
    fork = (junction >= 0) & (np.array([len(lane.successors) for lane in lanes]) > 1)
    limit = np.concatenate([_limit(lane, s) for lane, s in zip(lanes, along, strict=True)])
    guarded = (junction >= 0) | (blocked >= 0).any(axis=1)
    most = np.array([max(1, fork[junction == j].sum() - 1) for j in range(junction.max() + 1)], np.int64)
    roads = (centers.points, centers.along, limit, centers.first, centers.length)
    return LaneTable(*roads, guarded, junction, phase, blocked, together, _onward(lanes), fork, most)


def _onward(lanes: Sequence[Lane]) -> Ints:
    """Return `LaneTable.onward`."""
    alive = drivable(lanes)
    onward = np.full((len(lanes), max(1, *(len(lane.successors) for lane in lanes))), -1, np.int64)
    for number, lane in enumerate(lanes):
        good = [k for k in lane.successors if alive[k]]
        onward[number, : len(good)] = good
    return onward


def _conflicts(lanes: Sequence[Lane], along: list[Floats]) -> tuple[Floats32, Floats32]:
    """Return `LaneTable.blocked_until` and `LaneTable.together_until`."""
    count = len(lanes)
    blocked = np.full((count, count), -1, np.float32)
    together = np.full((count, count), -1, np.float32)
    trees = [cKDTree(lane.points[:, :2]) for lane in lanes]
    low = np.array([lane.points[:, :2].min(axis=0) for lane in lanes])
    high = np.array([lane.points[:, :2].max(axis=0) for lane in lanes])
    before = [{k for k, lane in enumerate(lanes) if number in lane.successors} for number in range(count)]
    ends = np.array([lane.points[-1, :2] for lane in lanes])
    near = (low[:, None] < high[None] + APART).all(axis=2) & (low[None] < high[:, None] + APART).all(axis=2)
    for a, b in np.argwhere(near).tolist():
        if a == b or _follows(lanes, a, b) or _follows(lanes, b, a):
            continue
        inside = lanes[a].junction >= 0 and lanes[a].junction == lanes[b].junction
        distance, _ = trees[b].query(lanes[a].points[:, :2], distance_upper_bound=APART)
        if before[a] & before[b]:
            apart = np.flatnonzero(~(distance < APART))
            split = along[a][apart[0]] if len(apart) else along[a][-1]
            together[a, b] = split
            distance[along[a] <= split] = np.inf  # they may meet again at their ends
        close = np.flatnonzero(distance < (APART if inside else MERGED))
        merging = np.hypot(*(ends[a] - ends[b])) < 0.3
        # Lanes outside a junction that touch its lanes only with an end belong to its corner.
        if len(close) and (inside or merging or lanes[a].junction == lanes[b].junction == -1):
            blocked[a, b] = along[a][close[-1]] + 1.0
    blocked[blocked.T < 0] = -1
    return blocked, together


def _follows(lanes: Sequence[Lane], a: int, b: int) -> bool:
    """Return whether lane b follows lane a, directly or through one lane of a junction."""
    return b in lanes[a].successors or any(
        b in lanes[k].successors for k in lanes[a].successors if lanes[k].junction >= 0
    )


def drivable(lanes: Sequence[Lane]) -> Mask:
    """Return a mask of the lanes from which a route can continue for ever without turning at a dead end."""
    alive = np.ones(len(lanes), bool)
    for number, lane in enumerate(lanes):
        steps = np.diff(lane.points[:, :2], axis=0)
        heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
        alive[number] = lane.junction >= 0 or np.ptp(heading) < np.deg2rad(170) or len(steps) > 70
    while True:
        dead = [n for n in np.flatnonzero(alive).tolist() if not any(alive[k] for k in lanes[n].successors)]
        if not dead:
            return alive
        alive[dead] = False


def crossings(table: LaneTable, walkways: Lines) -> Crossings:
    """Return the zones in which walkways are closer to lanes than half a vehicle's width plus a margin."""
    reach = 1.9
    tree = cKDTree(table.points[:, :2])
    owner = np.repeat(np.arange(len(table.length)), np.diff(table.first))
    on_lane: list[tuple[float, ...]] = []
    on_walkway: list[tuple[float, ...]] = []
    zone = 0
    for number, (first, last) in enumerate(itertools.pairwise(walkways.first)):
        line, way = walkways.points[first:last], walkways.along[first:last]
        even = np.linspace(0, way[-1], max(2, int(way[-1] / 0.4) + 1))
        points = np.stack([np.interp(even, way, line[:, k]) for k in range(2)], axis=1)
        met = tree.query_ball_point(points, reach)
        wet = np.array([len(found) > 0 for found in met])
        edges = np.flatnonzero(np.diff(np.concatenate([[0], wet, [0]])))
        for start, stop in edges.reshape(-1, 2):
            on_walkway.append((number, even[start], even[stop - 1], zone))
            hit = np.unique(np.concatenate([met[k] for k in range(start, stop)]).astype(np.int64))
            for lane in np.unique(owner[hit]):
                s = table.along[hit[owner[hit] == lane]]
                for part in np.split(s, np.flatnonzero(np.diff(s) > 6.0) + 1):
                    on_lane.append((lane, part[0] - 0.7, part[-1] + 0.7, zone))
            zone += 1
    return Crossings(*_by_line(on_lane, len(table.length)), *_by_line(on_walkway, len(walkways.length)), zone)


def _by_line(found: list[tuple[float, ...]], count: int) -> tuple[Floats, Ints]:
    """Return rows sorted by their first column, and the first row of each of the `count` lines."""
    rows = np.array(sorted(found), np.float64).reshape(-1, 4)
    return rows, np.searchsorted(rows[:, 0], np.arange(count + 1)).astype(np.int64)
