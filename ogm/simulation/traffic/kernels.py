"""One step of the traffic after another, compiled: who may go, how hard to accelerate, who walks."""

# mypy: disallow-untyped-defs=False
# numba infers the types of kernels, their docstrings tell them.

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ogm.simulation.arrays import Floats
from ogm.simulation.traffic.graph import Crossings, LaneTable

STEP = 0.1  # [s]
AHEAD = 14  # lanes of its route that a driver looks at
SIGHT = 70.0  # [m]
GAP = 2.0  # [m] between standing vehicles
MIN_GREEN, MAX_GREEN, ALL_RED = 4.0, 10.0, 2.0  # [s]
PATIENCE = 8.0  # [s] who has waited longer is let through before those who come
DETOUR = 6.0  # [s] who has waited so long for room behind a junction turns another way
SHORT = 7.0  # [m] longer vehicles enter a roundabout only with permission as far as their exit


class Drivers(NamedTuple):
    """V vehicles; the first is the ego vehicle. Distances count along each vehicle's own route.

    Attributes
    ----------
    route : (V, R) int64
        Lanes in the order in which they are driven.
    start : (V, R + 1) float64
        Where each of them begins [m].
    x, v : (V,) float64
        Front bumper [m] and speed [m/s]; changed by `advance`.
    front, rear, granted : (V,) int64
        Places in the route of the front and of the rear, and up to which there is permission; changed.
    since : (V,) float64
        Time from which a vehicle has been waiting for permission [s], -1 if it is not; changed.
    dice : (V,) uint64
        State of each vehicle's random numbers; changed.
    length, acceleration, braking, hardest, headway, pace, top : (V,) float64
        Length with trailer [m]; comfortable acceleration and braking, hardest braking [m/s^2]; time gap [s]; share
        of the limit that is driven; highest speed [m/s].
    """

    route: NDArray[np.int64]
    start: Floats
    x: Floats
    v: Floats
    front: NDArray[np.int64]
    rear: NDArray[np.int64]
    granted: NDArray[np.int64]
    since: Floats
    dice: NDArray[np.uint64]
    length: Floats
    acceleration: Floats
    braking: Floats
    hardest: Floats
    headway: Floats
    pace: Floats
    top: Floats


class Signals(NamedTuple):
    """J junctions: number of phases (0: no signal), the one that is green, and since when [s]; changed."""

    phases: NDArray[np.int64]
    green: NDArray[np.int64]
    since: Floats


class Walkers(NamedTuple):
    """N pedestrians, each to and fro on one walkway.

    Attributes
    ----------
    line : (N,) int64
        Walkway.
    way, short : (N,) float64
        Length of the way walked, and how far before either end of the walkway it stops [m].
    w : (N,) float64
        Distance walked; the way out and back is twice `way`; changed.
    pace, rest : (N,) float64
        Speed [m/s]; time that is rested at either end [s].
    resting : (N,) float64
        Rest that is left [s]; changed.
    zone : (N,) int64
        Crossing that is being walked over, -1 if none; changed.
    busy : (Z,) int64
        Pedestrians on each crossing; changed.
    left : (Z,) float64
        When the last of them left it [s]; changed.
    """

    line: NDArray[np.int64]
    way: Floats
    short: Floats
    w: Floats
    pace: Floats
    rest: Floats
    resting: Floats
    zone: NDArray[np.int64]
    busy: NDArray[np.int64]
    left: Floats


@njit(cache=True, nogil=True)
def _leaders(t: LaneTable, d: Drivers, gap, pace):
    """Find for each vehicle the free way ahead `gap` [m] and the speed `pace` of what ends it."""
    count = len(d.x)
    mark = np.full(len(t.length), -1, np.int64)
    offset = np.zeros(len(t.length))
    for i in range(count):
        gap[i], pace[i] = 1e9, 0.0
        last = d.front[i]
        for k in range(d.front[i], d.front[i] + AHEAD):
            if d.start[i, k] - d.x[i] > SIGHT:
                break
            lane = d.route[i, k]
            if mark[lane] != i:
                mark[lane] = i
                offset[lane] = d.start[i, k] - d.x[i]
            last = k
        for j in range(count):
            if j == i:
                continue
            for k in range(d.rear[j], d.front[j] + 1):
                lane = d.route[j, k]
                tail = max(d.x[j] - d.length[j] - d.start[j, k], 0.0)
                head = d.x[j] - d.start[j, k]
                if mark[lane] == i:
                    if head + offset[lane] <= 0 and not (head + offset[lane] == 0 and j > i):
                        continue  # behind
                    free = offset[lane] + tail
                    if free < gap[i]:
                        gap[i], pace[i] = free, d.v[j]
                    continue
                for m in range(d.front[i], last + 1):
                    mine = d.route[i, m]
                    until = t.together_until[lane, mine]
                    if until < 0 or tail > until or head + offset[mine] <= 0:
                        continue
                    free = offset[mine] + tail
                    if free < gap[i]:
                        gap[i], pace[i] = free, d.v[j]


@njit(cache=True, nogil=True)
def _chain_end(t: LaneTable, d: Drivers, i, k):
    """Return the last place of the route that must be granted together with place `k`."""
    while True:
        while t.guarded[d.route[i, k]] and k + 2 < d.route.shape[1]:
            if t.fork[d.route[i, k]] and d.length[i] < SHORT:
                return k
            k += 1
        room = d.start[i, k + 1] - d.start[i, k]
        if room > d.length[i] + GAP + 1.0 or not t.guarded[d.route[i, k + 1]] or k + AHEAD > d.route.shape[1]:
            return k - 1
        k += 1


@njit(cache=True, nogil=True)
def _clash(t: LaneTable, d: Drivers, i, first, last, j, low, high):
    """Tell whether places first..last of i's route meet places low..high of j's that j has not cleared."""
    rear = d.x[j] - d.length[j]
    for k in range(low, high + 1):
        other = d.route[j, k]
        for m in range(first, last + 1):
            until = t.blocked_until[other, d.route[i, m]]
            if until >= 0 and rear < d.start[j, k] + until:
                return True
    return False


@njit(cache=True, nogil=True)
def _sorted(rank):
    """Return the order of numbers, smallest first (numba's own sorting takes long to compile)."""
    order = np.arange(len(rank))
    for k in range(1, len(rank)):
        one, m = order[k], k
        while m > 0 and rank[order[m - 1]] > rank[one]:
            order[m] = order[m - 1]
            m -= 1
        order[m] = one
    return order


@njit(cache=True, nogil=True)
def _requests(t: LaneTable, d: Drivers, s: Signals, now, gap, pace, stop):
    """Grant lanes that need permission; `stop` becomes the way to where a vehicle without it halts [m]."""
    count = len(d.x)
    want = np.full(count, -1, np.int64)
    demand = np.zeros((len(s.phases), 16), np.bool_)
    for i in range(count):
        stop[i] = 1e9
        k = max(d.front[i], d.granted[i]) + 1
        while not t.guarded[d.route[i, k]] and d.start[i, k] - d.x[i] < SIGHT:
            k += 1
        ahead = d.start[i, k] - d.x[i]
        if not t.guarded[d.route[i, k]]:
            d.since[i] = -1.0
            continue
        lane = d.route[i, k]
        junction = t.junction[lane]
        if ahead < 45 and junction >= 0 and s.phases[junction] > 0 and t.phase[lane] >= 0:
            demand[junction, t.phase[lane]] = True
        if ahead > d.v[i] ** 2 / 3.6 + 6.0:
            d.since[i] = -1.0
            continue
        stop[i] = ahead
        if gap[i] < ahead - 0.5:  # somebody else is first in line
            d.since[i] = -1.0
            continue
        if d.since[i] < 0:
            d.since[i] = now
        want[i] = k
    _switch(s, demand, now)
    rank = d.since + 1e-6 * np.arange(count)
    rank[0] -= 60.0
    inside = np.zeros(len(t.most), np.int64)
    for i in range(count):
        junction = t.junction[d.route[i, d.rear[i]]]
        if junction < 0:
            junction = t.junction[d.route[i, max(d.front[i], d.granted[i])]]
        if junction >= 0:
            inside[junction] += 1
            if t.fork[d.route[i, d.front[i]]]:
                rank[i] -= 1000.0  # in a roundabout goes before into a roundabout
    order = _sorted(rank)
    held = np.full(count, -1, np.int64)  # last place that a patient one who is refused has a claim to
    for i in order:
        first = want[i]
        if first < 0:
            continue
        lane = d.route[i, first]
        last = _chain_end(t, d, i, first)
        junction = t.junction[lane]
        red = s.green[junction] != t.phase[lane] or now < s.since[junction]
        if junction >= 0 and s.phases[junction] > 0 and t.phase[lane] >= 0 and red:
            continue
        if t.fork[d.route[i, last]]:
            if not t.fork[d.route[i, first - 1]] and inside[junction] >= t.most[junction]:
                continue
        else:  # room behind the junction, so that nobody stands in it
            room = d.start[i, last + 1] - d.x[i] + d.length[i] + 1.0
            round_trip = t.phase[d.route[i, last]] < 0 and pace[i] > 1.0
            if gap[i] + pace[i] ** 2 / 5.0 < room and not round_trip:
                waited = int(round((now - d.since[i]) / STEP))
                if i > 0 and waited > 0 and waited % int(DETOUR / STEP) == 0:
                    _detour(t, d, i, first)
                continue
        free = True
        for j in range(count):
            if j == i:
                continue
            free = not _clash(t, d, i, first, last, j, d.rear[j], max(d.front[j], d.granted[j]))
            if free and held[j] >= 0:
                free = not _meet(t, d, i, first, last, j, want[j], held[j])
            if not free:
                break
        if free:
            d.granted[i] = last
            if junction >= 0:
                inside[junction] += 1
            d.since[i] = -1.0
            stop[i] = 1e9
        elif now - d.since[i] > PATIENCE:
            held[i] = last


@njit(cache=True, nogil=True)
def _detour(t: LaneTable, d: Drivers, i, place):
    """Change the route of vehicle i from a place on that it has not come to."""
    before = d.route[i, place - 1]
    count = 0
    for lane in t.onward[before]:
        count += lane >= 0 and lane != d.route[i, place]
    if count == 0:
        return
    barred = d.route[i, place]
    for k in range(place, d.route.shape[1]):
        count = 0
        for lane in t.onward[before]:
            count += lane >= 0 and lane != barred
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


@njit(cache=True, nogil=True)
def _meet(t: LaneTable, d: Drivers, i, first, last, j, low, high):
    """Tell whether places of two routes meet, wherever the vehicles are."""
    for k in range(low, high + 1):
        for m in range(first, last + 1):
            if t.blocked_until[d.route[j, k], d.route[i, m]] >= 0:
                return True
    return False


@njit(cache=True, nogil=True)
def _switch(s: Signals, demand, now):
    """Change signals: green goes round to the next phase that somebody waits for."""
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


@njit(cache=True, nogil=True)
def _zones(c: Crossings, d: Drivers, w: Walkers, barred, stop):
    """Let vehicles stop before crossings in use, and bar crossings that a vehicle is on or cannot stop before."""
    barred[:] = False
    for i in range(len(d.x)):
        reach = d.v[i] ** 2 / 4.4 + 0.6 * d.v[i] + 1.5
        for k in range(d.rear[i], d.front[i] + AHEAD):
            if d.start[i, k] - d.x[i] > max(reach, 50.0):
                break
            lane = d.route[i, k]
            for row in range(c.lane_first[lane], c.lane_first[lane + 1]):
                low, high = d.start[i, k] + c.on_lane[row, 1], d.start[i, k] + c.on_lane[row, 2]
                zone = int(c.on_lane[row, 3])
                if d.x[i] - d.length[i] > high:
                    continue
                ahead = low - 0.8 - d.x[i]
                if w.busy[zone] > 0 and ahead > -0.75:
                    stop[i] = min(stop[i], max(ahead, 0.0))
                elif ahead < reach and (k <= d.front[i] or k <= d.granted[i] or ahead < reach / 2):
                    barred[zone] = True


@njit(cache=True, nogil=True)
def _speed_limit(t: LaneTable, d: Drivers, i):
    """Return the highest speed [m/s] that bends and limits ahead of vehicle i allow."""
    speed = 1e9
    for back in (0.0, 0.6 * d.length[i]):
        k = d.front[i]
        while k > d.rear[i] and d.x[i] - back < d.start[i, k]:
            k -= 1
        lane = d.route[i, k]
        s = d.x[i] - back - d.start[i, k]
        first, last = t.first[lane], t.first[lane + 1] - 1
        p = first + int(s / t.length[lane] * (last - first))
        p = min(max(p, first), last)
        speed = min(speed, t.limit[p] if back > 0 else min(t.limit[p], t.limit[min(p + 1, last)]))
    for k in range(d.front[i] + 1, d.front[i] + AHEAD):
        ahead = d.start[i, k] - d.x[i]
        if ahead > SIGHT:
            break
        speed = min(speed, np.sqrt(t.limit[t.first[d.route[i, k]]] ** 2 + 3.2 * max(ahead, 0.0)))
    return min(speed * d.pace[i], d.top[i])


@njit(cache=True, nogil=True)
def _drive(t: LaneTable, d: Drivers, gap, pace, stop):
    """Accelerate by the intelligent driver model (Treiber, Hennecke, Helbing 2000) and move on by one step."""
    for i in range(len(d.x)):
        v, a, b = d.v[i], d.acceleration[i], d.braking[i]
        limit = max(_speed_limit(t, d, i), 0.5)
        push = a * (1 - (v / limit) ** 4) if v <= limit else max(-2.5, (limit - v) / 0.3)
        root = 2 * np.sqrt(a * b)
        wish = GAP + max(0.0, v * d.headway[i] + v * (v - pace[i]) / root)
        push = min(push, a * (1 - (wish / max(gap[i], 0.05)) ** 2))
        need = (v * v - pace[i] ** 2) / (2 * max(gap[i] - 1.0, 0.05))
        if need > 0.8 * b:  # the model's pull is soft at low speed: what the way left demands
            push = min(push, -need)
        if stop[i] < 1e8:
            wish = GAP + max(0.0, 0.6 * v + v * v / root)
            push = min(push, a * (1 - (wish / max(stop[i] + GAP - 0.4, 0.05)) ** 2))
            need = v * v / (2 * max(stop[i] - 0.35, 0.02))
            if need > 0.5 * b:
                push = min(push, -need)
        push = min(max(push, -d.hardest[i]), a)
        after = max(v + push * STEP, 0.0)
        if after < 0.02 and push < 0.05:
            after = 0.0
        d.x[i] += (v + after) / 2 * STEP
        d.v[i] = after
        while d.x[i] >= d.start[i, d.front[i] + 1]:
            d.front[i] += 1
        while d.x[i] - d.length[i] >= d.start[i, d.rear[i] + 1]:
            d.rear[i] += 1


@njit(cache=True, nogil=True)
def _walk(c: Crossings, w: Walkers, barred, now):
    """Let pedestrians walk on, keep apart, and wait at crossings."""
    for p in range(len(w.w)):
        if w.resting[p] > 0:
            w.resting[p] -= STEP
            continue
        if w.pace[p] == 0:
            continue
        way = w.way[p]
        turns = np.floor(w.w[p] / way)
        forth = turns % 2 == 0
        u = w.w[p] - turns * way + w.short[p]  # from the end of the walkway where this leg began
        whole = way + 2 * w.short[p]
        step = w.pace[p] * STEP
        for q in range(len(w.w)):
            if q == p or w.line[q] != w.line[p] or w.pace[q] == 0:
                continue
            other = np.floor(w.w[q] / w.way[q])
            if (other % 2 == 0) != forth:
                continue
            ahead = w.w[q] - other * w.way[q] + w.short[q] - u
            if (0 < ahead < 2.0) or (ahead == 0 and q < p):
                step = 0.0 if ahead < 1.5 else min(step, w.pace[q] * STEP)
        for row in range(c.walkway_first[w.line[p]], c.walkway_first[w.line[p] + 1]):
            low, high, zone = c.on_walkway[row, 1], c.on_walkway[row, 2], int(c.on_walkway[row, 3])
            if not forth:
                low, high = whole - high, whole - low
            if w.zone[p] == zone:
                if u > high:
                    w.zone[p] = -1
                    w.busy[zone] -= 1
                    w.left[zone] = now
            elif low - 0.5 < u + step and u < high and w.zone[p] < 0:
                if barred[zone] or (w.busy[zone] == 0 and now - w.left[zone] < 6.0):
                    step = 0.0
                elif step > 0:
                    w.zone[p] = zone
                    w.busy[zone] += 1
        if u + step >= way + w.short[p]:
            if w.zone[p] >= 0:
                w.busy[w.zone[p]] -= 1
                w.left[w.zone[p]] = now
                w.zone[p] = -1
            w.w[p] = (turns + 1) * way + 1e-6
            w.resting[p] = w.rest[p]
        else:
            w.w[p] += step


@njit(cache=True, nogil=True)
def advance(t: LaneTable, c: Crossings, d: Drivers, s: Signals, w: Walkers, first, xs, vs, ws):
    """Simulate as many steps as `xs` has rows, from step number `first` on; each row is the state before its step."""
    count = len(d.x)
    gap, pace, stop = np.zeros(count), np.zeros(count), np.zeros(count)
    barred = np.zeros(max(c.zones, 1), np.bool_)
    for n in range(len(xs)):
        xs[n], vs[n], ws[n] = d.x, d.v, w.w
        now = (first + n) * STEP
        _leaders(t, d, gap, pace)
        _requests(t, d, s, now, gap, pace, stop)
        _zones(c, d, w, barred, stop)
        _walk(c, w, barred, now)
        _drive(t, d, gap, pace, stop)
