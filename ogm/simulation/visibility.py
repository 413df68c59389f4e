"""What no ray of a scan could tell: beyond its sector, behind blocked views, in fog and dust, out of reach."""

import math
from typing import NamedTuple

import numpy as np

from ogm.jit import kernel
from ogm.simulation.mesh import Array, Floats, Floats32, Mask

BINS = 3600  # of azimuth
# Shares of what a white target sends back: of grass or gravel at grazing incidence, of a bright wall or leaf head-on.
BRIGHT_GROUND, BRIGHT_WALL = 0.1, 0.3


class View(NamedTuple):
    """Where the beams of a scan see, and how far.

    Attributes
    ----------
    low, high : (BINS,) float32
        Sines of the lowest and the highest elevation that is seen at an azimuth, from -pi on; low above high where
        nothing is.
    near, far, reach : float
        `LidarSpec.range_min`, `range_max` and `reach` [m].
    extinction : float
        Of the air [1/m].
    dust : (P, 5) float64
        As in `ogm.simulation.conditions.Conditions`.
    """

    low: Floats32
    high: Floats32
    near: float
    far: float
    reach: float
    extinction: float
    dust: Floats


def make_view(directions: Floats32, seeing: Mask, limits: tuple[float, float, float], air: float, dust: Floats) -> View:
    """Return what a scan can see.

    Parameters
    ----------
    directions : (layers, columns, 3) float32
        Of all beams, in the sensor's frame.
    seeing : (layers, columns) bool
        Beams that see anything.
    limits : (near, far, reach)
        As in `View` [m].
    air : float
        Extinction [1/m].
    dust : (P, 5) float64
    """  # fmt: skip
    low, high = np.full(BINS, 2, np.float32), np.full(BINS, -2, np.float32)
    half = max(1, math.ceil(BINS / directions.shape[1] / 2))  # bins that half a column covers
    _widen(low, high, directions, seeing, half)
    return View(low, high, *limits, air, dust)


@kernel
def _bin(x: float, y: float) -> int:
    return int((math.atan2(y, x) / (2 * math.pi) + 0.5) * BINS) % BINS


@kernel
def _widen(low: Floats32, high: Floats32, directions: Floats32, seeing: Mask, half: int) -> None:
    layers, columns = seeing.shape
    for i in range(layers):
        for j in range(columns):
            if not seeing[i, j]:
                continue
            z, middle = directions[i, j, 2], _bin(directions[i, j, 0], directions[i, j, 1])
            for k in range(middle - half, middle + half + 1):
                b = k % BINS
                low[b], high[b] = min(low[b], z), max(high[b], z)


@kernel
def in_view(directions: Array, view: View) -> Array:
    """Return which rays (N, 3), unit vectors in the sensor's frame, pass where beams see: (N,) bool."""
    result = np.zeros(len(directions), np.bool_)
    for i in range(len(directions)):
        b = _bin(directions[i, 0], directions[i, 1])
        result[i] = view.low[b] <= directions[i, 2] <= view.high[b]
    return result


@kernel
def _meet(direction: Array, ball: Array, far: float) -> tuple[float, float, float]:
    """Return where a ray from the origin enters and leaves a ball of dust [m] before `far`, and the optical depth."""
    along = direction[0] * ball[0] + direction[1] * ball[1] + direction[2] * ball[2]
    apart = ball[0] ** 2 + ball[1] ** 2 + ball[2] ** 2 - along * along
    inside = ball[3] ** 2 - apart
    if inside <= 0:
        return 0.0, 0.0, 0.0
    half = math.sqrt(inside)
    start, stop = min(max(along - half, 0.0), far), min(max(along + half, 0.0), far)
    # extinction falls as 1 - (r / radius)^2: its integral along the whole chord, and the share that is passed
    return start, stop, ball[4] * 4 / 3 * half**3 / ball[3] ** 2 * (stop - start) / (2 * half)


@kernel
def lose_sight(distance: Array, directions: Array, ground: Array, view: View) -> None:
    """Set the distance of hits (N,) to inf where the lidar would see no bright surface.

    Hits of `ground` (N,) bool are seen as far as bright ground is at grazing incidence, all others as far as a bright
    wall is, head-on.
    """
    for i in range(len(distance)):
        d = 1.0 * distance[i]
        if not d < math.inf:
            continue
        depth = view.extinction * d
        sent_back = BRIGHT_GROUND if ground[i] else BRIGHT_WALL
        for k in range(len(view.dust)):
            depth += _meet(directions[i], view.dust[k], d)[2]
        if not view.near <= d <= view.far or sent_back * math.exp(-2 * depth) < (d / view.reach) ** 2:
            distance[i] = math.inf


@kernel
def beams_in_dust(
    distance: Array, strength: Array, directions: Array, dust: Array, draws: Array, scattered: Array
) -> None:
    """Let dust dim what beams return, or return light itself.

    Parameters
    ----------
    distance, strength : (N,) float32
        Of the beams' returns [m], [percent]; changed in place.
    directions : (N, 3) float32
        In the sensor's frame.
    dust : (P, 5) float64
    draws : (N, 3) float32
        In [0, 1).
    scattered : (N,) bool
        Set where the return comes from dust.
    """
    for i in range(len(distance)):
        wanted, depth, nearest = -math.log(1.0 - draws[i, 0]), 0.0, math.inf
        for k in range(len(dust)):
            start, stop, through = _meet(directions[i], dust[k], min(1.0 * distance[i], 1e3))
            if through <= 0:
                continue
            if depth + through > wanted:
                nearest = min(nearest, start + (stop - start) * draws[i, 2])
            depth += through
        if nearest < math.inf and draws[i, 1] < 0.7:
            distance[i], strength[i], scattered[i] = nearest, 2.0 + 18.0 * draws[i, 1], True
        else:
            strength[i] *= math.exp(-2 * depth)
