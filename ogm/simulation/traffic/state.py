"""State of the traffic as kernels change it, step by step."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.simulation.mesh import Floats, Floats32, Ints

LAST = 1200.0  # [s] scenarios end here
WARM_UP = 30.0  # [s] simulated before time 0, so that queues have formed
STEP = 0.1  # [s]
AHEAD = 14  # lanes of its route that a driver takes into account
SIGHT = 70.0  # [m]
GAP = 2.0  # [m] between standing vehicles


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
    """J junctions: number of phases (0: no signal), the one that is green, and since when [s]; changed."""

    phases: Ints
    green: Ints
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
    """States before each of n steps: `Drivers.x` and `v` (n, V), `Walkers.w` (n, N); filled."""

    x: Floats
    v: Floats32
    w: Floats32


class DrivingLimits(NamedTuple):
    """What limits each vehicle in one step.

    Attributes
    ----------
    gap, pace, stop : (V,) float64
        Free way ahead [m]; speed of what ends it [m/s]; way to where it has to stop [m].
    """

    gap: Floats
    pace: Floats
    stop: Floats
