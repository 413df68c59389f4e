"""Compiled rules for entering junctions: signals, first come first served, and no stops inside a junction."""

from typing import NamedTuple

import numpy as np

from ogm.jit import kernel
from ogm.simulation.mesh import Floats, Ints, Mask
from ogm.simulation.traffic.graph import LaneTable
from ogm.simulation.traffic.state import AHEAD, GAP, SIGHT, STEP, Drivers, DrivingLimits, Signals

MIN_GREEN, MAX_GREEN, ALL_RED = 4.0, 10.0, 2.0  # [s]
PATIENCE = 8.0  # [s] waiting time after which a vehicle reserves its lanes against later ones
DETOUR = 6.0  # [s] waiting time for space behind a junction after which a vehicle takes another route
SHORT = 7.0  # [m] longer vehicles enter a roundabout only with permission up to their exit


class Queue(NamedTuple):
    """Requests of waiting vehicles.

    Attributes
    ----------
    want, held : (V,) int64
        Position in the route that each vehicle requests, and the last position that a patient vehicle reserves; -1 for
        no request or reservation.
    inside : (J,) int64
        Number of vehicles inside each junction.
    """

    want: Ints
    held: Ints
    inside: Ints


@kernel
def _chain_end(t: LaneTable, d: Drivers, i: int, k: int) -> int:
    """Return the last position of the route that must be granted together with position `k`."""
    while True:
        while t.guarded[d.route[i, k]] and k + 2 < d.route.shape[1]:
            if t.fork[d.route[i, k]] and d.length[i] < SHORT:
                return k
            k += 1
        space = d.start[i, k + 1] - d.start[i, k]
        if space > d.length[i] + GAP + 1.0 or not t.guarded[d.route[i, k + 1]] or k + AHEAD > d.route.shape[1]:
            return k - 1
        k += 1


@kernel
def _meet(t: LaneTable, d: Drivers, i: int, first: int, last: int, j: int, span: tuple[int, int], rear: float) -> bool:
    """Return whether positions first..last of i's route conflict with j's positions `span`, beyond `rear` [m]."""
    for k in range(span[0], span[1] + 1):
        other = d.route[j, k]
        for m in range(first, last + 1):
            until = t.blocked_until[other, d.route[i, m]]
            if until >= 0 and rear < d.start[j, k] + until:
                return True
    return False


@kernel
def _sorted(rank: Floats) -> Ints:
    """Return the indices that sort numbers in ascending order (numba's sorting is slow to compile)."""
    order = np.zeros(len(rank), np.int64)
    for k in range(1, len(rank)):
        index, m = k, k
        while m > 0 and rank[order[m - 1]] > rank[index]:
            order[m] = order[m - 1]
            m -= 1
        order[m] = index
    return order


@kernel
def grant(t: LaneTable, d: Drivers, s: Signals, now: float, limits: DrivingLimits) -> None:
    """Grant permissions; `limits.stop` becomes the distance to the stop of vehicles without permission [m]."""
    count = len(d.x)
    queue = Queue(np.zeros(count, np.int64), np.zeros(count, np.int64), np.zeros(len(t.most), np.int64))
    demand = np.zeros((len(s.phases), 16), np.bool_)
    rank = np.zeros(count)
    for i in range(count):
        queue.held[i] = -1
        queue.want[i] = _request(t, d, s, i, now, limits, demand)
    _switch(s, demand, now)
    for i in range(count):
        rank[i] = d.since[i] + 1e-6 * i - (60.0 if i == 0 else 0.0)
        junction = t.junction[d.route[i, d.rear[i]]]
        if junction < 0:
            junction = t.junction[d.route[i, max(d.front[i], d.granted[i])]]
        if junction >= 0:
            queue.inside[junction] += 1
            if t.fork[d.route[i, d.front[i]]]:
                rank[i] -= 1000.0  # vehicles in a roundabout have priority
    for i in _sorted(rank):
        first = queue.want[i]
        if first < 0:
            continue
        last = _chain_end(t, d, i, first)
        if not _may_enter(t, d, s, i, last, now, limits, queue):
            continue
        junction = t.junction[d.route[i, first]]
        if _free(t, d, i, first, last, queue):
            d.granted[i] = last
            if junction >= 0:
                queue.inside[junction] += 1
            d.since[i] = -1.0
            limits.stop[i] = 1e9
        elif now - d.since[i] > PATIENCE:
            queue.held[i] = last


@kernel
def _request(t: LaneTable, d: Drivers, s: Signals, i: int, now: float, limits: DrivingLimits, demand: Mask) -> int:
    """Return the route position for which vehicle i waits, -1 for none, and register its `demand` at signals."""
    limits.stop[i] = 1e9
    k: int = max(d.front[i], d.granted[i]) + 1
    while not t.guarded[d.route[i, k]] and d.start[i, k] - d.x[i] < SIGHT:
        k += 1
    ahead, lane = d.start[i, k] - d.x[i], d.route[i, k]
    if not t.guarded[lane]:
        d.since[i] = -1.0
        return -1
    junction = t.junction[lane]
    if ahead < 45 and junction >= 0 and s.phases[junction] > 0 and t.phase[lane] >= 0:
        demand[junction, t.phase[lane]] = True
    if ahead > d.v[i] ** 2 / 3.6 + 6.0:
        d.since[i] = -1.0
        return -1
    limits.stop[i] = ahead
    if limits.gap[i] < ahead - 0.5:  # another vehicle is ahead
        d.since[i] = -1.0
        return -1
    if d.since[i] < 0:
        d.since[i] = now
    return k


@kernel
def _may_enter(
    t: LaneTable, d: Drivers, s: Signals, i: int, last: int, now: float, limits: DrivingLimits, queue: Queue
) -> bool:
    """Return whether signal and space let vehicle i drive to position `last`; after a wait, change its route."""
    first = queue.want[i]
    lane = d.route[i, first]
    junction = t.junction[lane]
    red = s.green[junction] != t.phase[lane] or now < s.since[junction]
    if junction >= 0 and s.phases[junction] > 0 and t.phase[lane] >= 0 and red:
        return False
    if t.fork[d.route[i, last]]:
        fits: bool = t.fork[d.route[i, first - 1]] or queue.inside[junction] < t.most[junction]
        return fits
    # Space behind the junction, so that no vehicle stops in it.
    space = d.start[i, last + 1] - d.x[i] + d.length[i] + 1.0
    round_trip = t.phase[d.route[i, last]] < 0 and limits.pace[i] > 1.0
    if limits.gap[i] + limits.pace[i] ** 2 / 5.0 < space and not round_trip:
        waited = int(round((now - d.since[i]) / STEP))
        if i > 0 and waited > 0 and waited % int(DETOUR / STEP) == 0:
            _detour(t, d, i, first)
        return False
    return True


@kernel
def _free(t: LaneTable, d: Drivers, i: int, first: int, last: int, queue: Queue) -> bool:
    """Return whether positions first..last of i's route are free of lanes that other vehicles use or reserve."""
    for j in range(len(d.x)):
        if j == i:
            continue
        if _meet(t, d, i, first, last, j, (d.rear[j], max(d.front[j], d.granted[j])), d.x[j] - d.length[j]):
            return False
        if queue.held[j] >= 0 and _meet(t, d, i, first, last, j, (queue.want[j], queue.held[j]), -1e18):
            return False
    return True


@kernel
def _detour(t: LaneTable, d: Drivers, i: int, place: int) -> None:
    """Change the route of vehicle i from a future position on."""
    before, barred = d.route[i, place - 1], d.route[i, place]
    for k in range(place, d.route.shape[1]):
        count = 0
        for lane in t.onward[before]:
            count += lane >= 0 and lane != barred
        if count == 0:  # no alternative; possible only at `place`, because all other lanes lead on
            return
        d.dice[i] = d.dice[i] * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
        pick = int((d.dice[i] >> np.uint64(33)) % np.uint64(count))
        for lane in t.onward[before]:
            if lane >= 0 and lane != barred:
                if pick == 0:
                    before = lane
                    break
                pick -= 1
        d.route[i, k] = before
        d.start[i, k + 1] = d.start[i, k] + t.length[before]
        barred = -2


@kernel
def _switch(s: Signals, demand: Mask, now: float) -> None:
    """Switch signals to the next phase with waiting vehicles."""
    for junction in range(len(s.phases)):
        phases = s.phases[junction]
        if phases == 0:
            continue
        lasted = now - s.since[junction]
        if lasted < MIN_GREEN or (lasted < MAX_GREEN and demand[junction, s.green[junction]]):
            continue
        for turn in range(1, phases):
            phase = (s.green[junction] + turn) % phases
            if demand[junction, phase]:
                s.green[junction] = phase
                s.since[junction] = now + ALL_RED
                break
