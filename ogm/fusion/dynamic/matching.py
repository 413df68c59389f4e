"""Velocities of moving objects, by matching groups of occupied cells with occupied cells of earlier scans.

The velocity of a group takes its cells back to cells that were occupied before. In contrast to the motion of single
cells it uses the shape: the sides of a vehicle slide along themselves, its corners do not.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.dynamic.groups import LEVELS, MAX_CAP, Groups, capped_distance, find_groups
from ogm.fusion.dynamic.matching_kernels import MAX_CELLS, UNSEEN, MatchNumbers, match_groups
from ogm.fusion.dynamic.scan_history import ScanCells


@dataclass(frozen=True)
class MatchSettings:
    """Parameters of `match_velocities`.

    Parameters
    ----------
    max_speed : float
        Greatest speed in the search [m/s].
    link : float
        Cells belong to one group if neither their rows nor their columns are further apart than this [m].
    cap : float
        Upper bound of the distance to the nearest earlier cell [m], which limits the weight of cells that were not
        seen before. At most 11 cells.
    speed_cost : float
        Distance added per speed [s], so that the slower of two equal matches is taken.
    min_cells : int
        Least number of cells of a group that is matched.
    max_cells : int
        Greatest number of cells that are matched in a group, evenly chosen; at most 655.
    min_gain : float
        Least decrease of the mean distance relative to speed 0 that makes a match [m]. A group rests if its mean
        distance at speed 0 is no greater than this.
    max_residual : float
        Greatest mean distance of a match [m]. For a group of fewer than `sure_cells` cells it is reduced by
        sqrt(cells / sure_cells), since a few cells match by chance.
    sure_cells : int
        See `max_residual`.
    max_sigma, relative_sigma : float
        Greatest standard deviation of a match [m/s], and as a share of the speed. The share applies if the measured
        cells lie at most `min_gain` from earlier ones and two deviations keep the speed below `max_speed`. Other
        matches are ambiguous.
    margin : float
        Earlier cells within this distance [m] of a cell that is occupied now by another group do not match: a moving
        object leaves its place.
    spread : float
        Scale of the covariance [m]: a velocity that costs spread / sqrt(cells) more than the minimum is less likely by
        a factor of e.
    sigma : float
        Standard deviation of an unambiguous match [m/s].
    gate, prior_scatter : float
        A match must lie within `gate` [m/s] of the mean velocity that `prior` gives to its group. This applies if the
        velocities of the group's cells differ from the mean by at most `prior_scatter` (root mean square) [m/s].

    Raises
    ------
    ValueError
        If a number is negative, NaN, or out of its range.
    """

    max_speed: float = 20.0
    link: float = 0.8
    cap: float = 0.48
    speed_cost: float = 0.0016
    min_cells: int = 5
    max_cells: int = 512
    min_gain: float = 0.032
    max_residual: float = 0.24
    sure_cells: int = 20
    max_sigma: float = 0.5
    relative_sigma: float = 0.1
    margin: float = 0.16
    spread: float = 0.04
    sigma: float = 0.15
    gate: float = 3.0
    prior_scatter: float = 1.5

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{field.name} must be a number of 0 or more, got {value}")
        for name in ("max_speed", "cap", "spread", "link", "sure_cells"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be greater than 0, got {getattr(self, name)}")
        if not 1 <= self.min_cells <= self.max_cells <= MAX_CELLS:
            raise ValueError(
                f"1 <= min_cells <= max_cells <= {MAX_CELLS} must hold, got {self.min_cells} and {self.max_cells}"
            )


class Matches(NamedTuple):
    """Velocities of groups of occupied cells.

    Attributes
    ----------
    label : (nx, ny) int32
        Number of a cell's group, from 1; 0 for none. Group n is row n - 1 of the other arrays.
    velocity : (G, 2) float64
        Velocity over ground, along the grid's x and y [m/s].
    covariance : (G, 2, 2) float64
        Covariance of the velocity [m²/s²], large along a direction in which the shape does not change when moved.
    valid : (G,) bool
        Whether the match is accepted; other velocities have no meaning.
    residual : (G,) float64
        Mean distance of the cells, moved back, to earlier ones [m].
    gain : (G,) float64
        Decrease of this distance relative to speed 0 [m].
    resting : (G,) bool
        Whether the group rests: no velocity fits its cells better than 0, and speed 0 fits the cells that the earlier
        scans measured, at least half of all.
    """

    label: NDArray[np.int32]
    velocity: NDArray[np.float64]
    covariance: NDArray[np.float64]
    valid: NDArray[np.bool_]
    residual: NDArray[np.float64]
    gain: NDArray[np.float64]
    resting: NDArray[np.bool_]


def match_velocities(
    now: ScanCells,
    candidates: NDArray[np.bool_],
    earlier: Sequence[ScanCells],
    resolution: float,
    settings: MatchSettings | None = None,
    prior: NDArray[np.floating] | None = None,
) -> Matches:
    """Return the velocities of groups of occupied cells.

    For each group the velocity v is searched that minimises the cost

        mean over cells p and earlier scans of min(distance of p - v age to occupied cells, cap) + speed_cost |v|

    at all displacements by whole cells since the oldest scan. Distances are interpolated between cells. The distance is
    the cap at cells that other groups still occupy, and half the cap at cells that the earlier scan did not measure:
    the group may have been there or not. The result is the mean over the velocities near the minimum, see the notes.

    Parameters
    ----------
    now : ScanCells
        Present scan; its occupied cells are grouped.
    candidates : (nx, ny) bool
        Cells that may have moved: cells with dynamic mass, or free before and occupied now. Groups without a candidate
        are left out.
    earlier : sequence of ScanCells
        Scans on the same lattice in map coordinates, with ages above 0 s. Scans without occupied cells are ignored.
    resolution : float
        Side of a cell [m].
    settings : MatchSettings, optional
    prior : (nx, ny, 2) float array, optional
        Known velocity of each cell [m/s]; NaN if unknown or doubtful.

    Returns
    -------
    Matches

    Raises
    ------
    ValueError
        If shapes differ, or an age or the resolution is not above 0.

    Notes
    -----
    Velocities are weighted by exp(-sqrt(cells) (cost - minimum cost) / spread). The result is the mean of velocities
    whose displacement since the oldest scan differs from the best by at most two cells along x and y. The covariance is
    the second moment about it of all velocities within `max_speed`, plus sigma² in every direction: it is large for two
    equally good matches, and along a wall.
    """
    settings = settings or MatchSettings()
    scans = _checked(now, candidates, earlier, resolution)
    cap = min(settings.cap / resolution, MAX_CAP)
    link = max(int(settings.link / resolution + 1e-6), 1)
    occupied = np.ascontiguousarray(now.occupied).view(np.uint8)
    groups = find_groups(occupied, (now.occupied & candidates).view(np.uint8), link, settings.min_cells)
    size = np.diff(groups.start)
    count = len(size)
    if not scans or not count:
        no_match, nowhere = np.full(count, np.nan), np.zeros(count, bool)
        covariance = np.full((count, 2, 2), np.nan)
        return Matches(groups.label, np.zeros((count, 2)), covariance, nowhere, no_match, no_match, nowhere)
    ages = np.array([scan.age for scan in scans])
    distance = np.empty((len(scans), *candidates.shape), np.uint8)
    for scan, out in zip(scans, distance, strict=True):
        capped_distance(np.ascontiguousarray(scan.occupied).view(np.uint8), cap, out)
        np.copyto(out, UNSEEN + 1, where=out == UNSEEN)
        np.copyto(out, UNSEEN, where=scan.hidden)
    step = resolution / ages.max()
    numbers = MatchNumbers(
        max(int(settings.max_speed / step + 1e-6), 1),
        step,
        cap,
        settings.speed_cost / resolution,
        settings.spread / resolution,
        settings.gate,
        int(settings.margin / resolution + 1e-6),
        settings.max_cells,
    )
    expected = _expected(groups, prior, settings)
    velocity, covariance, cost, unseen = match_groups(occupied, groups, distance, ages / ages.max(), expected, numbers)
    covariance += np.eye(2) * settings.sigma**2
    residual, still = cost.T * resolution
    apart, contradicted = (cost - unseen * (UNSEEN / LEVELS * cap)).T * resolution  # of measured cells
    gain = still - residual
    max_residual = settings.max_residual * np.sqrt(np.minimum(size / settings.sure_cells, 1))
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)  # root mean square over directions
    sure = sigma <= settings.max_sigma
    speed = np.hypot(*velocity.T)
    fast = (sigma <= settings.relative_sigma * speed) & (speed + 2 * sigma <= settings.max_speed)
    fast &= apart <= settings.min_gain
    valid = (sure | fast) & (gain >= settings.min_gain) & (residual <= max_residual)
    resting = sure & (gain < settings.min_gain) & (unseen[:, 1] <= 0.5)
    resting &= contradicted <= settings.min_gain * (1 - unseen[:, 1])
    return Matches(groups.label, velocity, covariance, valid, residual, gain, resting)


def _checked(
    now: ScanCells, candidates: NDArray[np.bool_], earlier: Sequence[ScanCells], resolution: float
) -> list[ScanCells]:
    """Check shapes, types and ages; return the earlier scans with occupied cells."""
    if not resolution > 0:
        raise ValueError(f"resolution must be greater than 0 m, got {resolution}")
    named = [("occupied", now.occupied), ("hidden", now.hidden), ("candidates", candidates)]
    named += [("an earlier mask", mask) for scan in earlier for mask in (scan.occupied, scan.hidden)]
    for name, mask in named:
        if mask.dtype != bool or mask.shape != now.occupied.shape or mask.ndim != 2:
            raise ValueError(f"{name} must be bool of shape {now.occupied.shape}, got {mask.dtype} of {mask.shape}")
    for scan in earlier:
        if not 0 < scan.age < math.inf:
            raise ValueError(f"ages of earlier scans must be above 0 s, got {scan.age}")
    return [scan for scan in earlier if scan.occupied.any()]


def _expected(groups: Groups, prior: NDArray[np.floating] | None, settings: MatchSettings) -> NDArray[np.float64]:
    """Return the known mean velocity of each group, (G, 2); NaN if too few cells have one, or if it scatters."""
    size = np.diff(groups.start)
    count = len(size)
    if prior is None:
        return np.full((count, 2), np.nan)
    if prior.shape != (*groups.label.shape, 2):
        raise ValueError(f"prior must have shape {(*groups.label.shape, 2)}, got {prior.shape}")
    cells = np.nonzero(groups.label)
    known, group = prior[cells].astype(np.float64), groups.label[cells] - 1
    finite = np.isfinite(known).all(axis=1)
    known, group = known[finite], group[finite]
    number = np.bincount(group, minlength=count)
    total = np.stack([np.bincount(group, known[:, axis], count) for axis in (0, 1)], axis=1)
    mean: NDArray[np.float64] = total / np.maximum(number, 1)[:, None]
    square = np.bincount(group, ((known - mean[group]) ** 2).sum(axis=1), count)
    confident = (2 * number >= size) & (square <= settings.prior_scatter**2 * number)
    mean[~confident] = np.nan
    return mean
