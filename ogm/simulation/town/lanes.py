"""Lanes: along the streets, through the crossings, round the roundabout, and closed round trips over them."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ogm.simulation.arrays import Floats
from ogm.simulation.town.network import Street, StreetNetwork

KERB_RADIUS = 7.0  # [m] of kerbs at corners
CROSSWALK = 5.0  # [m] from the corner's arc to the stop line
ISLAND, RING = 7.5, 14.0  # [m] radii of a roundabout's island and of its outer kerb
STRAIGHT = np.deg2rad(35)  # a lane that turns less than this goes straight on
HEAD = 9.5  # [m] radius of the place to turn at a dead end


@dataclass(frozen=True, eq=False)
class Lane:
    """A lane.

    Attributes
    ----------
    points : (M, 3) float64
        Its centre line in driving direction, about 1 m between points, z on the road [m].
    width : float
        Width [m].
    speed : float
        Speed limit, or what a comfortable driver takes in a bend [m/s].
    successors : tuple of int
        Numbers of the lanes that it leads to; its last point is their first.
    junction : int
        Number of the junction that it crosses, -1 on the open road.
    phase : int
        Lanes of a junction with the same phase may be driven at once; -1 where there is no signal:
        on the open road, and in and out of a roundabout's ring.
    """

    points: Floats
    width: float
    speed: float
    successors: tuple[int, ...] = ()
    junction: int = -1
    phase: int = -1

    @property
    def length(self) -> float:
        """Length of the centre line [m]."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())


class Draft(NamedTuple):
    """Lanes in the plane, and what else the layout needs to know."""

    lanes: list[Lane]
    streets: list[int]  # street of each lane, -1 in junctions
    cuts: Floats  # (S, 2) where the lanes of a street begin and how far from its end they stop


class _Arm(NamedTuple):
    street: int
    outward: Floats  # unit vector away from the crossing
    incoming: list[int]  # lanes, rightmost first
    outgoing: list[int]


def cuts(network: StreetNetwork) -> Floats:
    """How far from its two crossings each street's lanes begin and stop (S, 2) [m]."""
    result = np.full((len(network.streets), 2), 0.0)
    for node in range(len(network.nodes)):
        arms = _arms(network, node)
        for street, end, outward in arms:
            if node in network.heads:
                reach = HEAD + 1.0
            elif node == network.roundabout:
                reach = RING + 8.0
            else:
                reach = 6.0
                right, left = _sides(network.streets[street], end)
                for other, other_end, direction in arms:
                    if (other, other_end) == (street, end):
                        continue
                    angle = np.arctan2(outward[0] * direction[1] - outward[1] * direction[0], outward @ direction)
                    # A corner lies between the left side of one arm and the right side of the next one.
                    other_right, other_left = _sides(network.streets[other], other_end)
                    mine, theirs = (left, other_right) if angle > 0 else (right, other_left)
                    turn = abs(angle)
                    if turn < np.deg2rad(150):
                        corner = (theirs + mine * np.cos(turn)) / np.sin(turn)
                        reach = max(reach, corner + (KERB_RADIUS - 0.5) / np.tan(turn / 2))
                reach += CROSSWALK
            result[street, end] = min(reach, 0.45 * network.streets[street].length)
    return result


def _arms(network: StreetNetwork, node: int) -> list[tuple[int, int, Floats]]:
    """Street, which end of it, and direction outward of everything that meets at a crossing."""
    arms = []
    for k, street in enumerate(network.streets):
        for end, at in ((0, street.start), (1, street.end)):
            if at == node:
                line = street.line if end == 0 else street.line[::-1]
                reach = min(12, len(line) - 1)
                outward = line[reach] - line[0]
                arms.append((k, end, outward / np.linalg.norm(outward)))
    return sorted(arms, key=lambda arm: (np.arctan2(arm[2][1], arm[2][0]), arm[0]))


def _sides(street: Street, end: int) -> tuple[float, float]:
    """Right and left half width, seen from an end of the street into it."""
    right, left = street.profile.right, street.profile.left
    return (right, left) if end == 0 else (left, right)


def make_lanes(network: StreetNetwork) -> Draft:
    """Lay lanes (z = 0 yet) along all streets and through all crossings."""
    cut = cuts(network)
    lanes: list[Lane] = []
    owners: list[int] = []
    ahead: list[list[int]] = []
    back: list[list[int]] = []
    for k, street in enumerate(network.streets):
        profile = street.profile
        ahead.append([])
        back.append([])
        for forward, count, bucket in ((1, profile.forward, ahead[-1]), (-1, profile.back, back[-1])):
            for n in range(count):  # rightmost first
                offset = -forward * (profile.median / 2 + profile.lane * (count - 1 - n + 0.5))
                stretch = np.linspace(cut[k, 0], street.length - cut[k, 1], 256)
                line = street.at(stretch, offset)[::forward]
                bucket.append(len(lanes))
                lanes.append(Lane(_even(line), profile.lane, profile.speed))
                owners.append(k)
    # Through the crossings.
    number = 0
    links: dict[int, list[int]] = {}
    for node in range(len(network.nodes)):
        arms = [
            _Arm(k, outward, (back if end == 0 else ahead)[k], (ahead if end == 0 else back)[k])
            for k, end, outward in _arms(network, node)
        ]
        if not arms:
            continue
        if node in network.heads:
            new = [(arms[0].incoming[0], _turn_round(lanes, arms[0], network.nodes[node]), arms[0].outgoing[0])]
        elif node == network.roundabout:
            _ring(lanes, links, arms, network.nodes[node], number)
            owners += [-1] * (len(lanes) - len(owners))
            number += 1
            continue
        else:
            new = _across(lanes, arms, number)
            number += 1
        for start, lane, end in new:
            links.setdefault(start, []).append(len(lanes))
            links[len(lanes)] = [end]
            lanes.append(lane)
            owners.append(-1)
    linked = [replace(lane, successors=tuple(links.get(k, ()))) for k, lane in enumerate(lanes)]
    return Draft(linked, owners, cut)


def _across(lanes: list[Lane], arms: list[_Arm], number: int) -> list[tuple[int, Lane, int]]:
    """Lanes from every way into a crossing to every way out of it, but not back where they came from."""
    new = []
    for phase, arm in enumerate(arms):
        exits = []
        for other in arms:
            if other is not arm and other.outgoing:
                turn = np.arctan2(
                    -arm.outward[0] * other.outward[1] + arm.outward[1] * other.outward[0], -arm.outward @ other.outward
                )
                exits.append((float(turn), other))
        exits.sort(key=lambda pair: pair[0])  # rightmost (negative) first
        count = len(arm.incoming)
        for k, start in enumerate(arm.incoming):
            share = []
            for n, (turn, other) in enumerate(exits):
                straight = abs(turn) < STRAIGHT
                mine = straight or len(exits) == 1 or (k == 0 and n == 0) or (k == count - 1 and n == len(exits) - 1)
                if mine or (0 < n < len(exits) - 1):
                    share.append((turn, other))
            for turn, other in share:
                last = len(other.outgoing) - 1
                to = min(k, last) if abs(turn) < STRAIGHT else (0 if turn < 0 else last)
                end = other.outgoing[to]
                line = _join(lanes[start].points, lanes[end].points, CROSSWALK - 0.5)
                speed = min(lanes[start].speed, _comfortable(line))
                new.append((start, Lane(line, lanes[start].width, speed, (), number, phase), end))
    return new


def _ring(lanes: list[Lane], links: dict[int, list[int]], arms: list[_Arm], center: Floats, number: int) -> None:
    """Lanes into, round (counter-clockwise) and out of a roundabout; the phase of an entry is its arm."""
    radius = (ISLAND + RING) / 2 + 0.4
    width = 4.0
    angles = np.unwrap([float(np.arctan2(arm.outward[1], arm.outward[0])) for arm in arms])
    spread = np.diff(np.concatenate([angles, [angles[0] + 2 * np.pi]]))
    half = min(np.deg2rad(34), float(spread.min()) / 2 - np.deg2rad(6))
    along: list[int] = []  # arc from the entry of arm k to the exit of the next one
    past: list[int] = []  # arc from the exit of arm k to its entry
    for k, angle in enumerate(angles):
        following = angles[(k + 1) % len(arms)] + (2 * np.pi if k == len(arms) - 1 else 0)
        for bucket, start, end in ((past, angle - half, angle + half), (along, angle + half, following - half)):
            sweep = np.linspace(start, end, max(3, int((end - start) * radius) + 1))
            line = center + radius * np.stack([np.cos(sweep), np.sin(sweep)], axis=1)
            bucket.append(len(lanes))
            lanes.append(Lane(line, width, 6.0, (), number, -1))
    for k, arm in enumerate(arms):
        onward = (k + 1) % len(arms)
        links[past[k]] = [along[k]]
        links[along[k]] = [past[onward]]
        for start in arm.incoming:
            line = _blend(lanes[start].points, lanes[along[k]].points)
            links[start] = [len(lanes)]
            links[len(lanes)] = [along[k]]
            lanes.append(Lane(line, lanes[start].width, 6.0, (), number, k))
        for end in arm.outgoing:
            before = along[k - 1]
            line = _blend(lanes[before].points, lanes[end].points)
            links[before] = [*links.get(before, []), len(lanes)]
            links[len(lanes)] = [end]
            lanes.append(Lane(line, lanes[end].width, 6.0, (), number, -1))
    for k in range(len(arms)):  # the arc before arm k leads on round the ring and out at the arm
        out = [n for n in links[along[k]] if n != past[(k + 1) % len(arms)]]
        links[along[k]] = [past[(k + 1) % len(arms)], *out]


def _turn_round(lanes: list[Lane], arm: _Arm, center: Floats) -> Lane:
    """Round a dead end: swing right, go round counter-clockwise, come back."""
    start, end = lanes[arm.incoming[0]].points, lanes[arm.outgoing[0]].points
    inward = -arm.outward
    right = np.array([inward[1], -inward[0]])
    radius = HEAD - 3.2
    sweep = np.linspace(-0.35 * np.pi, 1.35 * np.pi, 16)
    # Angle 0 is to the right of the way in; going round counter-clockwise first leads further inward.
    ring = center + radius * (np.cos(sweep)[:, None] * right + np.sin(sweep)[:, None] * inward)
    first = _blend(start, ring)
    last = _blend(ring, end)
    return Lane(_even(np.concatenate([first, ring[1:-1], last])), 2.8, 3.0)


def _join(start: Floats, end: Floats, straight: float) -> Floats:
    """From the end of one line to the start of another: straight over the crosswalks, a bend between."""
    a, b = _ahead(start), -_ahead(end[::-1])
    p, q = start[-1] + straight * a, end[0] - straight * b
    return _even(np.concatenate([start[-1:], _cubic(p, a, q, b), end[:1]]))


def _blend(start: Floats, end: Floats) -> Floats:
    """From the end of one line to the start of another in one bend."""
    return _even(_cubic(start[-1], _ahead(start), end[0], -_ahead(end[::-1])))


def _ahead(line: Floats) -> Floats:
    step = line[-1] - line[-2]
    return step / np.linalg.norm(step)


def _cubic(p: Floats, a: Floats, q: Floats, b: Floats) -> Floats:
    """Draw a cubic Bezier curve from p towards a to q, arriving in direction b; close to an arc where one fits."""
    turn = np.arccos(np.clip(a @ b, -1, 1))
    chord = np.linalg.norm(q - p)
    handle = chord * (2 / 3) / (1 + np.cos(turn / 2))
    t = np.linspace(0, 1, 33)[:, None]
    c, d = p + handle * a, q - handle * b
    return (1 - t) ** 3 * p + 3 * (1 - t) ** 2 * t * c + 3 * (1 - t) * t**2 * d + t**3 * q


def _even(line: Floats) -> Floats:
    """Return the same line with about 1 m between points; its ends stay where they are."""
    way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    even = np.linspace(0, way[-1], max(2, int(round(way[-1])) + 1))
    return np.stack([np.interp(even, way, line[:, k]) for k in range(line.shape[1])], axis=1)


def _comfortable(line: Floats) -> float:
    """Return the speed [m/s] at which the sharpest bend of a line takes 2 m/s^2 sideways, between 3 and 14."""
    step = np.diff(line, axis=0)
    angle = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    if len(angle) < 4:
        return 14.0
    length = np.linalg.norm(step, axis=1)
    bend = abs(angle[3:] - angle[:-3]) / (length[1:-1][: len(angle) - 3] * 3)
    return float(np.clip(np.sqrt(2.0 / max(float(bend.max()), 1e-3)), 3.0, 14.0))
