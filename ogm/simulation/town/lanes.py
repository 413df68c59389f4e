"""Lanes: along the streets, through the crossings, and round the roundabout."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ogm.simulation.mesh import Floats
from ogm.simulation.town.network import Street, StreetNetwork, evenly, turn

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
    outward: Floats  # unit vector away from the crossing
    incoming: list[int]  # lanes, rightmost first
    outgoing: list[int]


class _Lanes:
    """Lanes while they are laid: those so far, the street of each, and where each leads."""

    def __init__(self) -> None:
        self.lanes: list[Lane] = []
        self.streets: list[int] = []
        self.links: dict[int, list[int]] = {}

    def add(self, lane: Lane, street: int = -1) -> int:
        """Add a lane; returns its number."""
        self.lanes.append(lane)
        self.streets.append(street)
        return len(self.lanes) - 1

    def join(self, start: int, lane: Lane, end: int) -> None:
        """Add a lane that leads from one to another."""
        number = self.add(lane)
        self.links.setdefault(start, []).append(number)
        self.links[number] = [end]


def cuts(network: StreetNetwork) -> Floats:
    """How far from its two crossings each street's lanes begin and stop (S, 2) [m]."""
    result = np.zeros((len(network.streets), 2))
    for node in range(len(network.grid.nodes)):
        arms = _arms(network, node)
        for street, end, outward in arms:
            reach = HEAD + 1.0 if node in network.heads else RING + 8.0 if node == network.grid.roundabout else 0.0
            if not reach:
                others = [arm for arm in arms if arm[:2] != (street, end)]
                right, left = _sides(network.streets[street], end)
                reach = max([6.0, *(_corner(network, other, outward, right, left) for other in others)]) + CROSSWALK
            result[street, end] = min(reach, 0.45 * network.streets[street].length)
    return result


def _corner(
    network: StreetNetwork, other: tuple[int, int, Floats], outward: Floats, right: float, left: float
) -> float:
    """How far from a crossing the kerb's arc towards another arm begins [m]."""
    # A corner lies between the left side of one arm and the right side of the next one.
    angle = turn(outward, other[2])
    other_right, other_left = _sides(network.streets[other[0]], other[1])
    mine, theirs = (left, other_right) if angle > 0 else (right, other_left)
    angle = abs(angle)
    if angle >= np.deg2rad(150):
        return 0.0
    return float((theirs + mine * np.cos(angle)) / np.sin(angle) + (KERB_RADIUS - 0.5) / np.tan(angle / 2))


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
    """Lay lanes (without z yet) along all streets and through all crossings."""
    cut = cuts(network)
    laid = _Lanes()
    ways: dict[tuple[int, int], list[int]] = {}  # lanes of a street forward (1) and back (-1), rightmost first
    for k, street in enumerate(network.streets):
        profile = street.profile
        stretch = np.linspace(cut[k, 0], street.length - cut[k, 1], 256)
        for forward, count in ((1, profile.forward), (-1, profile.back)):
            offsets = [-forward * (profile.median / 2 + profile.lane * (count - 1 - n + 0.5)) for n in range(count)]
            lines = [evenly(street.at(stretch, offset)[::forward]) for offset in offsets]
            ways[k, forward] = [laid.add(Lane(line, profile.lane, profile.speed), k) for line in lines]
    # Through the crossings.
    number = 0
    for node, at in enumerate(network.grid.nodes):
        arms = [_Arm(out, ways[k, 2 * end - 1], ways[k, 1 - 2 * end]) for k, end, out in _arms(network, node)]
        if node in network.heads:
            _turn_round(laid, arms[0], at)
        elif node == network.grid.roundabout:
            _ring(laid, arms, at, number)
        else:
            _across(laid, arms, number)
        number += len(arms) > 0 and node not in network.heads
    lanes = [replace(lane, successors=tuple(laid.links.get(k, ()))) for k, lane in enumerate(laid.lanes)]
    return Draft(lanes, laid.streets, cut)


def _across(laid: _Lanes, arms: list[_Arm], number: int) -> None:
    """Lay lanes from every way into a crossing to every way out of it, but not back where they came from."""
    for phase, arm in enumerate(arms):
        exits = [(turn(-arm.outward, other.outward), other) for other in arms if other is not arm and other.outgoing]
        exits.sort(key=lambda pair: pair[0])  # rightmost (negative) first
        count = len(arm.incoming)
        for k, start in enumerate(arm.incoming):
            for n, (angle, other) in enumerate(exits):
                straight, last = abs(angle) < STRAIGHT, len(other.outgoing) - 1
                outermost = (k == 0 and n == 0) or (k == count - 1 and n == len(exits) - 1)
                if not (straight or len(exits) == 1 or outermost or 0 < n < len(exits) - 1):
                    continue
                end = other.outgoing[min(k, last) if straight else 0 if angle < 0 else last]
                before = laid.lanes[start]
                line = _join(before.points, laid.lanes[end].points, CROSSWALK - 0.5)
                speed = min(before.speed, _comfortable(line))
                laid.join(start, Lane(line, before.width, speed, (), number, phase), end)


def _ring(laid: _Lanes, arms: list[_Arm], center: Floats, number: int) -> None:
    """Lay lanes into, round (counter-clockwise) and out of a roundabout; the phase of an entry is its arm."""
    radius = (ISLAND + RING) / 2 + 0.4
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
            bucket.append(laid.add(Lane(line, 4.0, 6.0, (), number, -1)))
    lanes = laid.lanes
    for k, arm in enumerate(arms):
        laid.links[past[k]] = [along[k]]
        laid.links[along[k]] = [past[(k + 1) % len(arms)]]
        for start in arm.incoming:
            line = _blend(lanes[start].points, lanes[along[k]].points)
            laid.join(start, Lane(line, lanes[start].width, 6.0, (), number, k), along[k])
        for end in arm.outgoing:
            line = _blend(lanes[along[k - 1]].points, lanes[end].points)
            laid.join(along[k - 1], Lane(line, lanes[end].width, 6.0, (), number, -1), end)


def _turn_round(laid: _Lanes, arm: _Arm, center: Floats) -> None:
    """Lay a lane round a dead end: swing right, go round counter-clockwise, come back."""
    start, end = (laid.lanes[k].points for k in (arm.incoming[0], arm.outgoing[0]))
    inward = -arm.outward
    right = np.array([inward[1], -inward[0]])
    sweep = np.linspace(-0.35 * np.pi, 1.35 * np.pi, 16)
    # Angle 0 is to the right of the way in; going round counter-clockwise first leads further inward.
    ring = center + (HEAD - 3.2) * (np.cos(sweep)[:, None] * right + np.sin(sweep)[:, None] * inward)
    line = evenly(np.concatenate([_blend(start, ring), ring[1:-1], _blend(ring, end)]))
    laid.join(arm.incoming[0], Lane(line, 2.8, 3.0), arm.outgoing[0])


def _join(start: Floats, end: Floats, straight: float) -> Floats:
    """From the end of one line to the start of another: straight over the crosswalks, a bend between."""
    a, b = _ahead(start), -_ahead(end[::-1])
    p, q = start[-1] + straight * a, end[0] - straight * b
    return evenly(np.concatenate([start[-1:], _cubic(p, a, q, b), end[:1]]))


def _blend(start: Floats, end: Floats) -> Floats:
    """From the end of one line to the start of another in one bend."""
    return evenly(_cubic(start[-1], _ahead(start), end[0], -_ahead(end[::-1])))


def _ahead(line: Floats) -> Floats:
    step = line[-1] - line[-2]
    return np.asarray(step / np.linalg.norm(step))


def _cubic(p: Floats, a: Floats, q: Floats, b: Floats) -> Floats:
    """Draw a cubic Bezier curve from p towards a to q, arriving in direction b; close to an arc where one fits."""
    angle = np.arccos(np.clip(a @ b, -1, 1))
    handle = np.linalg.norm(q - p) * (2 / 3) / (1 + np.cos(angle / 2))
    t = np.linspace(0, 1, 33)[:, None]
    c, d = p + handle * a, q - handle * b
    return np.asarray((1 - t) ** 3 * p + 3 * (1 - t) ** 2 * t * c + 3 * (1 - t) * t**2 * d + t**3 * q)


def _comfortable(line: Floats) -> float:
    """Return the speed [m/s] at which the sharpest bend of a line takes 2 m/s^2 sideways, between 3 and 14."""
    step = np.diff(line, axis=0)
    angle = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    if len(angle) < 4:
        return 14.0
    length = np.linalg.norm(step, axis=1)
    bend = abs(angle[3:] - angle[:-3]) / (length[1:-1][: len(angle) - 3] * 3)
    return float(np.clip(np.sqrt(2.0 / max(float(bend.max()), 1e-3)), 3.0, 14.0))
