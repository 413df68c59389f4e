"""Compiled simulation steps of the traffic: acceleration, stops, and pedestrians."""

import numpy as np

from ogm.jit import kernel
from ogm.simulation.mesh import Floats, Mask
from ogm.simulation.traffic.graph import Crossings, LaneTable
from ogm.simulation.traffic.permission import grant
from ogm.simulation.traffic.state import AHEAD, GAP, SIGHT, STEP, Drivers, DrivingLimits, Record, Signals, Walkers


@kernel
def _leaders(t: LaneTable, d: Drivers, gap: Floats, pace: Floats) -> None:
    """Fill `DrivingLimits.gap` and `DrivingLimits.pace`."""
    count = len(d.x)
    mark, offset = np.zeros(len(t.length), np.int64), np.zeros(len(t.length))
    for i in range(count):
        gap[i], pace[i] = 1e9, 0.0
        last = d.front[i]
        for k in range(d.front[i], d.front[i] + AHEAD):
            if d.start[i, k] - d.x[i] > SIGHT:
                break
            lane = d.route[i, k]
            if mark[lane] != i + 1:
                mark[lane] = i + 1
                offset[lane] = d.start[i, k] - d.x[i]
            last = k
        for j in range(count):
            if j == i:
                continue
            for k in range(d.rear[j], d.front[j] + 1):
                lane = d.route[j, k]
                tail = max(d.x[j] - d.length[j] - d.start[j, k], 0.0)
                head = d.x[j] - d.start[j, k]
                if mark[lane] == i + 1:
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


@kernel
def _zones(c: Crossings, d: Drivers, w: Walkers, barred: Mask, stop: Floats) -> None:
    """Stop vehicles before crossings in use, and bar crossings that a vehicle is on or cannot stop before."""
    for zone in range(len(barred)):
        barred[zone] = False
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


@kernel
def _speed_limit(t: LaneTable, d: Drivers, i: int) -> float:
    """Return the highest speed of vehicle i allowed by bends and limits ahead [m/s]."""
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
    allowed: float = min(speed * d.pace[i], d.top[i])
    return allowed


@kernel
def _drive(t: LaneTable, d: Drivers, limits: DrivingLimits) -> None:
    """Move vehicles by one step of the intelligent driver model (Treiber, Hennecke, Helbing 2000)."""
    gap, pace, stop = limits
    for i in range(len(d.x)):
        v, a, b = d.v[i], d.acceleration[i], d.braking[i]
        limit = max(_speed_limit(t, d, i), 0.5)
        push = a * (1 - (v / limit) ** 4) if v <= limit else max(-2.5, (limit - v) / 0.3)
        root = 2 * np.sqrt(a * b)
        wish = GAP + max(0.0, v * d.headway[i] + v * (v - pace[i]) / root)
        push = min(push, a * (1 - (wish / max(gap[i], 0.05)) ** 2))
        need = (v * v - pace[i] ** 2) / (2 * max(gap[i] - 1.0, 0.05))
        if need > 0.8 * b:  # the model brakes too softly at low speed: use the braking that the distance requires
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


@kernel
def _walk(c: Crossings, w: Walkers, barred: Mask, now: float) -> None:
    """Move pedestrians by one step: they walk, keep apart, and wait at crossings."""
    for p in range(len(w.w)):
        if w.resting[p] > 0:
            w.resting[p] -= STEP
            continue
        if w.pace[p] == 0:
            continue
        way = w.way[p]
        turns = np.floor(w.w[p] / way)
        forth = turns % 2 == 0
        u = w.w[p] - turns * way + w.short[p]  # from the end at which this leg began
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


@kernel
def advance(t: LaneTable, c: Crossings, d: Drivers, s: Signals, w: Walkers, first: int, record: Record) -> None:
    """Simulate one step per row of `record`, from step number `first` on."""
    count = len(d.x)
    limits = DrivingLimits(np.zeros(count), np.zeros(count), np.zeros(count))
    barred = np.zeros(max(c.zones, 1), np.bool_)
    for n in range(len(record.x)):
        for i in range(count):  # loops: numba takes seconds to compile copies of rows
            record.x[n, i], record.v[n, i] = d.x[i], d.v[i]
        for p in range(len(w.w)):
            record.w[n, p] = w.w[p]
        now = (first + n) * STEP
        _leaders(t, d, limits.gap, limits.pace)
        grant(t, d, s, now, limits)
        _zones(c, d, w, barred, limits.stop)
        _walk(c, w, barred, now)
        _drive(t, d, limits)
