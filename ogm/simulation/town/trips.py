"""Closed round trips over the lanes of a town."""

import numpy as np
from numpy.random import Generator

from ogm.simulation.town.lanes import Lane

SHORTEST = 600.0  # [m]
TRIES = 12000  # random drives, of which the best is taken


def round_trip(
    lanes: list[Lane], kinds: list[str], worth: list[float], sense: float, rng: Generator, longest: float
) -> tuple[int, ...]:
    """Find a closed trip of at least 600 m that sees many kinds of street.

    Parameters
    ----------
    lanes : list of Lane
        All lanes.
    kinds : list of str
        What a trip over each lane shows: kind of street and district, or "roundabout"; "" for nothing.
    worth : list of float
        What a metre of each lane is worth.
    sense : float
        1 for counter-clockwise, -1 for clockwise.
    rng : np.random.Generator
        Draws the trips that are tried.
    longest : float
        Trips worth more metres than this are no better.

    Returns
    -------
    tuple of int
        Its lanes in order; none if no such trip was found.
    """
    lengths = [lane.length for lane in lanes]
    begin = [k for k, lane in enumerate(lanes) if lane.junction < 0 and kinds[k]]
    best: tuple[float, tuple[int, ...]] = (-1.0, ())
    for _ in range(TRIES):
        found = _wander(lanes, int(rng.choice(begin)), rng)
        length = sum(lengths[k] for k in found)
        if length < SHORTEST:
            continue
        points = np.concatenate([lanes[k].points[:, :2] for k in found])
        following = np.roll(points, -1, axis=0)
        area = (points[:, 0] * following[:, 1] - following[:, 0] * points[:, 1]).sum() / 2
        if area * sense <= 0:
            continue
        seen = {kinds[k] for k in found if kinds[k]}
        metres = min(sum(lengths[k] * worth[k] for k in found), longest)
        total = 100.0 * len(seen) + 300.0 * ("roundabout" in seen) + metres
        if total > best[0]:
            best = total, found
    return best[1]


def _wander(lanes: list[Lane], start: int, rng: Generator) -> tuple[int, ...]:
    """Drive at random and cross no junction twice; the lanes of the trip if it comes back, else none."""
    trip, crossed = [start], set[int]()
    for draw in rng.random(200):
        here = lanes[trip[-1]]
        past = crossed - {here.junction}
        ways = [k for k in here.successors if k == start or not (k in trip or lanes[k].junction in past)]
        if not ways:
            return ()
        following = ways[int(draw * len(ways))]
        if following == start:
            return tuple(trip)
        crossed |= {lanes[following].junction} - {-1}
        trip.append(following)
    return ()
