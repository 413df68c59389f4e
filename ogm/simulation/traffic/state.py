"""State of the traffic, updated by kernels step by step."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.simulation.mesh import Floats, Floats32, Ints

LAST = 1200.0  # [s] duration of a scenario
WARM_UP = 30.0  # [s] simulated before time 0 to form queues
STEP = 0.1  # [s]
AHEAD = 14  # lanes of the route that a driver considers
SIGHT = 70.0  # [m] range that a driver considers
GAP = 2.0  # [m] between standing vehicles


class Drivers(NamedTuple):
    """State of V vehicles, the ego vehicle first; distances are along each vehicle's own route.

    Attributes
    ----------
    route : (V, R) int64
        Lanes of the route in driving order.
    start : (V, R + 1) float64
        Start of each lane along the route [m].
    x, v : (V,) float64
        Position of the front bumper [m] and speed [m/s]; changed by `advance`.
    front, rear, granted : (V,) int64
        Route positions of the front, of the rear, and of the last permission; changed.
    since : (V,) float64
        Time since which a vehicle waits for permission [s], -1 without waiting; changed.
    dice : (V,) uint64
        State of each vehicle's random number generator; changed.
    length, acceleration, braking, hardest, headway, pace, top : (V,) float64
        Length with trailer [m]; comfortable acceleration and braking, hardest braking [m/s^2]; time gap [s]; driven
        share of the speed limit; top speed [m/s].
    """

    route: Ints
    start: Floats
    x: Floats
    v: Floats
    front: Ints
    rear: Ints
    granted: Ints
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
    """Signals of J junctions: number of phases (0 without a signal), green phase, and its start [s]; changed."""

    phases: Ints
    green: Ints
    since: Floats


class Walkers(NamedTuple):
    """State of N pedestrians, who walk back and forth on a walkway each.

    Attributes
    ----------
    line : (N,) int64
        Walkway of each pedestrian.
    way, short : (N,) float64
        Length of the path [m], and its distance from both ends of the walkway [m].
    w : (N,) float64
        Distance walked [m], where a return trip counts twice `way`; changed.
    pace, rest : (N,) float64
        Speed [m/s], and time of rest at either end [s].
    resting : (N,) float64
        Remaining rest [s]; changed.
    zone : (N,) int64
        Crossing in use, -1 for none; changed.
    busy : (Z,) int64
        Number of pedestrians on each crossing; changed.
    left : (Z,) float64
        Time when the last pedestrian left each crossing [s]; changed.
    """

    line: Ints
    way: Floats
    short: Floats
    w: Floats
    pace: Floats
    rest: Floats
    resting: Floats
    zone: Ints
    busy: Ints
    left: Floats


class Record(NamedTuple):
    """States before each of n steps: `Drivers.x` and `v` (n, V), `Walkers.w` (n, N); output of `advance`."""

    x: Floats
    v: Floats32
    w: Floats32


class DrivingLimits(NamedTuple):
    """Limits of each vehicle in one step.

    Attributes
    ----------
    gap, pace, stop : (V,) float64
        Free distance ahead [m], speed of the vehicle at its end [m/s], and distance to a required stop [m].
    """

    gap: Floats
    pace: Floats
    stop: Floats
