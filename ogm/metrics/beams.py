"""Likelihood and calibration of beams predicted by a map: the quality of a map without truth.

A beam ends in cell i if it passes all cells before and is stopped in this cell, with the probability (Thrun, Burgard
and Fox, *Probabilistic Robotics*, 2005, Sec. 6.3; Schaefer, Luft and Burgard, "An analytical lidar sensor model based
on ray path information", ICRA 2017):

    P(end in i) = h_i * prod_{j < i} (1 - h_j),    h_i = 1 - (1 - p_i) ** (d_i / resolution)

with p the probability of occupied of a cell and d the length of the beam in it, so that a beam rarely ends in a cell
that it only touches. The end is distributed evenly over d_i, the range has normal noise, and a share of echoes is
random, uniform up to the greatest range.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.grid import EvidentialGrid
from ogm.jit import kernel

WITHIN = 2.0  # [cells] between a predicted end and an echo that agrees with it
NEGLIGIBLE = 1e-9  # probability of passing at which tracing stops
CERTAIN = 1e-6  # least distance of a probability from 0 and 1


class PlanarBeams(NamedTuple):
    """Beams in the plane of a map.

    Attributes
    ----------
    origin : (N, 2) float64
        Position of the sensor [m].
    direction : (N, 2) float64
        Unit vectors.
    distance : (N,) float64
        Range of the echo; without echo the greatest range of the sensor [m].
    echo : (N,) bool
    """

    origin: NDArray[np.float64]
    direction: NDArray[np.float64]
    distance: NDArray[np.float64]
    echo: NDArray[np.bool_]


class BeamNoise(NamedTuple):
    """Noise of a planar laser.

    Attributes
    ----------
    max_range : float
        Greatest range [m].
    range_noise : float
        Standard deviation of a range, errors of the pose included [m].
    p_random : float
        Share of echoes not explained by the map (people, dust, mixed pixels), in (0, 1).
    """

    max_range: float
    range_noise: float = 0.03
    p_random: float = 0.05


class BeamScores(NamedTuple):
    """Scores of beams against a map, one row per beam.

    Attributes
    ----------
    log_likelihood : (N,) float64
        Log of the density of the range [nats, of 1/m]; NaN without echo.
    ends_at : (N,) bool
        Echo within 2 cells of the first occupied cell of the beam, h > 1/2.
    passes_through : (N,) bool
        Echo more than 2 cells behind the first occupied cell; without echo, whether there is an occupied cell.
    ends_in_free : (N,) bool
        Echo in a cell with a mass of free above 1/2.
    expected : (N,) float64
        Predicted probability of an echo within 2 cells of the likeliest end.
    hit : (N,) bool
        Whether the echo is within 2 cells of the likeliest end.
    no_echo : (N,) float64
        Predicted probability of passing all cells up to the greatest range.
    """

    log_likelihood: NDArray[np.float64]
    ends_at: NDArray[np.bool_]
    passes_through: NDArray[np.bool_]
    ends_in_free: NDArray[np.bool_]
    expected: NDArray[np.float64]
    hit: NDArray[np.bool_]
    no_echo: NDArray[np.float64]


def score_beams(grid: EvidentialGrid, beams: PlanarBeams, noise: BeamNoise, base_rate: float) -> BeamScores:
    """Return scores of beams that are not in the map.

    Parameters
    ----------
    grid : EvidentialGrid
        The map.
    beams : PlanarBeams
    noise : BeamNoise
    base_rate : float
        P(occupied) of a cell without evidence, in (0, 1): p = occupied + base_rate * unknown. Cells outside the map are
        unknown.
    """
    p = grid.occupied + np.float32(base_rate) * grid.unknown
    decay = -np.log1p(-np.clip(p.astype(np.float64), CERTAIN, 1 - CERTAIN)) / grid.spec.resolution
    outside = -math.log1p(-base_rate) / grid.spec.resolution
    found = np.zeros((len(beams.distance), 6))
    trace_beams(decay, outside, (*grid.spec.origin, grid.spec.resolution), beams, noise, found)
    mode, within, passes, first, last, by_map = found.T
    near = WITHIN * grid.spec.resolution
    expected = (1 - noise.p_random) * within + noise.p_random * min(2 * near / noise.max_range, 1.0)
    ends = beams.origin + beams.direction * beams.distance[:, np.newaxis]
    density = (1 - noise.p_random) * by_map + noise.p_random / noise.max_range
    return BeamScores(
        np.where(beams.echo, np.log(density), np.nan),
        beams.echo & (beams.distance >= first - near) & (beams.distance <= last + near),
        np.where(beams.echo, beams.distance > last + near, np.isfinite(first)),
        beams.echo & (grid.opinion_at(ends)[:, 0] > 0.5),
        expected,
        beams.echo & (np.abs(beams.distance - mode) <= near),
        passes,
    )


@kernel
def trace_beams(
    decay: np.ndarray,
    outside: float,
    cells: tuple[float, float, float],
    beams: PlanarBeams,
    noise: BeamNoise,
    found: np.ndarray,
) -> None:
    """Trace beams through a map.

    Parameters
    ----------
    decay : (nx, ny) float64
        Rate -log(1 - p) / resolution at which beams end in each cell [1/m].
    outside : float
        Rate of cells outside the map [1/m].
    cells : (float, float, float)
        Corner x, y of cell (0, 0) and side of a cell [m].
    beams : PlanarBeams
    noise : BeamNoise
    found : (N, 6) float64
        Filled with: middle of the likeliest end cell [m]; probability of an end within `WITHIN` cells of it;
        probability of passing all cells; near and far side of the first occupied cell [m], infinite if all are passed;
        density of the range of the echo, by the map and the noise of the range [1/m].
    """
    x0, y0, side = cells
    nx, ny = decay.shape
    max_cells = 2 * int(noise.max_range / side) + 8
    edges, ends = np.empty(max_cells + 1), np.empty(max_cells)
    for n in range(len(found)):
        u, v = beams.direction[n, 0], beams.direction[n, 1]
        x, y = (beams.origin[n, 0] - x0) / side, (beams.origin[n, 1] - y0) / side
        i, j = math.floor(x), math.floor(y)
        step_i, step_j = 1 if u > 0 else -1, 1 if v > 0 else -1
        # Ranges to the next line of cells, and between two lines (Amanatides and Woo, 1987)
        per_i = side / abs(u) if u != 0 else np.inf
        per_j = side / abs(v) if v != 0 else np.inf
        next_i = ((i + 1 - x) if u > 0 else (x - i)) * per_i if u != 0 else np.inf
        next_j = ((j + 1 - y) if v > 0 else (y - j)) * per_j if v != 0 else np.inf
        passes, at, count = 1.0, 0.0, 0
        likeliest, first, last, mode = -1.0, np.inf, np.inf, 0.0
        edges[0] = 0.0
        while at < noise.max_range and passes > NEGLIGIBLE and count < max_cells:
            to = min(next_i, next_j, noise.max_range)
            rate = decay[i, j] if 0 <= i < nx and 0 <= j < ny else outside
            end = -math.expm1(-rate * (to - at))
            if end > 0.5 and first == np.inf:
                first, last = at, to
            ends[count], edges[count + 1] = passes * end, to
            if ends[count] > likeliest:
                likeliest, mode = ends[count], 0.5 * (at + to)
            passes *= 1.0 - end
            count += 1
            if next_i <= next_j:
                i, next_i = i + step_i, next_i + per_i
            else:
                j, next_j = j + step_j, next_j + per_j
            at = to
        near, far = mode - WITHIN * side, mode + WITHIN * side
        z, spread = beams.distance[n], math.sqrt(2.0) * noise.range_noise
        within, density = 0.0, 0.0
        for k in range(count):
            a, b = edges[k], edges[k + 1]
            if b <= a:
                continue
            within += ends[k] * max(min(b, far) - max(a, near), 0.0) / (b - a)
            if b > z - 5 * spread and a < z + 5 * spread:
                share = 0.5 * (math.erf((b - z) / spread) - math.erf((a - z) / spread))
                density += ends[k] * share / (b - a)
        found[n, 0], found[n, 1], found[n, 2] = mode, within, passes
        found[n, 3], found[n, 4], found[n, 5] = first, last, density
