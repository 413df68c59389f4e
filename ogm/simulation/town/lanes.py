"""Lanes along streets, through crossings, and around the roundabout."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ogm.simulation.mesh import Floats
from ogm.simulation.town.network import Street, StreetNetwork, evenly, turn

KERB_RADIUS = 7.0  # [m] of kerbs at corners
CROSSWALK = 5.0  # [m] between the corner's arc and the stop line
ISLAND, RING = 7.5, 14.0  # [m] radii of a roundabout's island and of its outer kerb
STRAIGHT = np.deg2rad(35)  # largest turn of a lane that goes straight on
HEAD = 9.5  # [m] radius of the turning area of a dead end


@dataclass(frozen=True, eq=False)
class Lane:
    """A lane with its centre line and its successors.

    Attributes
    ----------
    points : (M, 3) float64
        Centre line in driving direction, about 1 m between points, z on the road [m].
    width : float
        Width [m].
    speed : float
        Speed limit, or comfortable speed in a bend [m/s].
    successors : tuple of int
        Indices of the following lanes, which start at the last point of this lane.
    junction : int
        Number of the junction that the lane crosses, -1 outside junctions.
    phase : int
        Signal phase: lanes of a junction with equal phases have green at the same time. -1 without a signal: outside
        junctions, and in and out of a roundabout's ring.
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
    """Lanes in the plane with their streets and the gaps at crossings."""

    lanes: list[Lane]
    streets: list[int]  # street of each lane, -1 in junctions
    cuts: Floats  # (S, 2) distances between a street's lanes and its start and end [m]


class _Arm(NamedTuple):
    outward: Floats  # unit vector from the crossing
    incoming: list[int]  # lanes, rightmost first
    outgoing: list[int]


class _Lanes:
    """Builder of lanes: the lanes, the street of each, and their links."""

    def __init__(self) -> None:
        self.lanes: list[Lane] = []
        self.streets: list[int] = []
        self.links: dict[int, list[int]] = {}

    def add(self, lane: Lane, street: int = -1) -> int:
        """Add a lane and return its index."""
        self.lanes.append(lane)
        self.streets.append(street)
        return len(self.lanes) - 1

    def join(self, start: int, lane: Lane, end: int) -> None:
        """Add a lane that connects two lanes."""
        number = self.add(lane)
        self.links.setdefault(start, []).append(number)
        self.links[number] = [end]


def cuts(network: StreetNetwork) -> Floats:
    """Return the distances from a street's crossings at which its lanes begin and end, (S, 2) [m]."""
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
    """Return the distance from a crossing at which the kerb's arc towards another arm begins [m]."""
    # A corner is between the left side of an arm and the right side of the next.
    angle = turn(outward, other[2])
    other_right, other_left = _sides(network.streets[other[0]], other[1])
    mine, theirs = (left, other_right) if angle > 0 else (right, other_left)
    angle = abs(angle)
    if angle >= np.deg2rad(150):
        return 0.0
    return float((theirs + mine * np.cos(angle)) / np.sin(angle) + (KERB_RADIUS - 0.5) / np.tan(angle / 2))


def _arms(network: StreetNetwork, node: int) -> list[tuple[int, int, Floats]]:
    """Return street, its end (0 or 1) and outward direction of each arm of a crossing, counter-clockwise."""
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
    """Return the half widths to the right and left, seen from an end of the street into it."""
    right, left = street.profile.right, street.profile.left
    return (right, left) if end == 0 else (left, right)


def make_lanes(network: StreetNetwork) -> Draft:
    """Return lanes without z along all streets and through all crossings."""
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
    # Lanes through the crossings.
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
    """Add lanes from every arm of a crossing to every other arm."""
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
    """Add lanes into, around (counter-clockwise) and out of a roundabout; the phase of an entry is its arm's index."""
    radius = (ISLAND + RING) / 2 + 0.4
    angles = np.unwrap([float(np.arctan2(arm.outward[1], arm.outward[0])) for arm in arms])
    spread = np.diff(np.concatenate([angles, [angles[0] + 2 * np.pi]]))
    half = min(np.deg2rad(34), float(spread.min()) / 2 - np.deg2rad(6))
    along: list[int] = []  # arcs from the entry of arm k to the exit of the next arm
    past: list[int] = []  # arcs from the exit of arm k to its entry
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
    """Add a lane around a dead end: to the right, around counter-clockwise, and back."""
    start, end = (laid.lanes[k].points for k in (arm.incoming[0], arm.outgoing[0]))
    inward = -arm.outward
    right = np.array([inward[1], -inward[0]])
    sweep = np.linspace(-0.35 * np.pi, 1.35 * np.pi, 16)
    # Angle 0 is to the right of the incoming direction, so counter-clockwise motion first leads further inward.
    ring = center + (HEAD - 3.2) * (np.cos(sweep)[:, None] * right + np.sin(sweep)[:, None] * inward)
    line = evenly(np.concatenate([_blend(start, ring), ring[1:-1], _blend(ring, end)]))
    laid.join(arm.incoming[0], Lane(line, 2.8, 3.0), arm.outgoing[0])


def _join(start: Floats, end: Floats, straight: float) -> Floats:
    """Return a line from the end of `start` to the start of `end`: straight over the crosswalks, a bend between."""
    a, b = _ahead(start), -_ahead(end[::-1])
    p, q = start[-1] + straight * a, end[0] - straight * b
    return evenly(np.concatenate([start[-1:], _cubic(p, a, q, b), end[:1]]))


def _blend(start: Floats, end: Floats) -> Floats:
    """Return one bend from the end of `start` to the start of `end`."""
    return evenly(_cubic(start[-1], _ahead(start), end[0], -_ahead(end[::-1])))


def _ahead(line: Floats) -> Floats:
    step = line[-1] - line[-2]
    return np.asarray(step / np.linalg.norm(step))


def _cubic(p: Floats, a: Floats, q: Floats, b: Floats) -> Floats:
    """Return a cubic Bezier curve from p in direction a to q in direction b, close to a circular arc if possible."""
    angle = np.arccos(np.clip(a @ b, -1, 1))
    handle = np.linalg.norm(q - p) * (2 / 3) / (1 + np.cos(angle / 2))
    t = np.linspace(0, 1, 33)[:, None]
    c, d = p + handle * a, q - handle * b
    return np.asarray((1 - t) ** 3 * p + 3 * (1 - t) ** 2 * t * c + 3 * (1 - t) * t**2 * d + t**3 * q)


def _comfortable(line: Floats) -> float:
    """Return the speed, 3 to 14 m/s, for a lateral acceleration of 2 m/s^2 in the sharpest bend of a line."""
    step = np.diff(line, axis=0)
    angle = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    if len(angle) < 4:
        return 14.0
    length = np.linalg.norm(step, axis=1)
    bend = abs(angle[3:] - angle[:-3]) / (length[1:-1][: len(angle) - 3] * 3)
    return float(np.clip(np.sqrt(2.0 / max(float(bend.max()), 1e-3)), 3.0, 14.0))
