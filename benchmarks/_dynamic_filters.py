"""The maps that `dynamic.py` compares, all with the interface of `DynamicMapper` as far as they have it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from _fusion_drives import WINDOW
from numpy.typing import NDArray

from ogm import EvidentialGrid, GridSpec
from ogm.dynamic_grid import DynamicGrid
from ogm.fusion import BinaryBayesMapper, DynamicMapper, EvidentialMapper
from ogm.fusion.dynamic.settings import DynamicSettings
from ogm.metrics.motion import predicted_moving

HYBRID, PLAIN, NUSS, NUSS_FEW = "hybrid, matching, 200k", "hybrid, 200k", "Nuss, 1M", "Nuss, 200k"
CONFLICT, EVIDENTIAL, BAYES = "conflict layer", "EvidentialMapper", "classical Bayes"
SPEED_ALONE = "score by speed alone"
STANDING = "standing still"
PASSING = 1e-3  # [m/s] more than 2 m/s, so that the score of a conflict is its belief


class Static:
    """A map without motion, for its masses alone."""

    def __init__(self, mapper: Any) -> None:
        self.mapper, self.update, self.view = mapper, mapper.update, mapper.view

    grid = property(lambda self: self.mapper.grid)

    def dynamic_view(self, spec: GridSpec) -> DynamicGrid:
        """Return masses whose dynamic part is 0."""
        return _dynamic_grid(self.view(spec), np.zeros(spec.shape, np.float32), np.nan)


class ConflictDetector(Static):
    """`EvidentialMapper` whose conflict "was free, is occupied" is taken for belief in dynamic; no velocities."""

    def __init__(self) -> None:
        super().__init__(EvidentialMapper(WINDOW))

    def dynamic_view(self, spec: GridSpec) -> DynamicGrid:
        """Return the masses, occupied being shared out by the conflict."""
        conflict = self.mapper.conflict_view(spec).layers["free_to_occupied"]
        return _dynamic_grid(self.view(spec), np.clip(np.nan_to_num(conflict), 0, 1), 2 + PASSING)


def _dynamic_grid(grid: EvidentialGrid, share: NDArray[np.float32], speed: float) -> DynamicGrid:
    """Return a dynamic grid with a share of occupied as dynamic, and the same velocity [m/s] everywhere."""
    mass = np.stack([grid.free, grid.occupied * (1 - share), grid.occupied * share], axis=-1)
    velocity = np.full((*grid.spec.shape, 2), speed, np.float32)
    return DynamicGrid(grid.spec, mass, velocity, np.full((*grid.spec.shape, 2, 2), np.nan, np.float32))


class Reading(NamedTuple):
    """Functions that return the compared grid of a map, and the cells that it predicts moving."""

    grid: Callable[[DynamicGrid], DynamicGrid] = lambda grid: grid
    predicted: Callable[[DynamicGrid], NDArray[np.bool_]] = predicted_moving


def significant(grid: DynamicGrid) -> NDArray[np.bool_]:
    """Return the cells whose velocity is more than 1 m/s and more than two standard deviations away from 0."""
    return (_squared_deviations(grid) > 4) & (grid.speed > 1)


def by_significance(grid: DynamicGrid) -> DynamicGrid:
    """Share occupied out into dynamic and static by the probability that the velocity is not 0.

    Nuss' filter has no belief in static. Of a cell's velocity, the share 1 - exp(-m²/2) lies nearer to its mean than 0
    does, with m the Mahalanobis distance of 0.
    """
    share = (1 - np.exp(-np.minimum(_squared_deviations(grid), 100.0) / 2)).astype(np.float32)
    mass = np.stack([grid.free, grid.static + grid.dynamic * (1 - share), grid.dynamic * share], axis=-1)
    return DynamicGrid(grid.spec, mass, grid.velocity, grid.covariance)


def _squared_deviations(grid: DynamicGrid) -> NDArray[np.float64]:
    """Return squared Mahalanobis distances of 0 from the velocity, (nx, ny); 0 of none, and of a single particle."""
    velocity, covariance = grid.velocity.astype(np.float64), grid.covariance.astype(np.float64)
    (x, y), (xx, xy, yy) = np.moveaxis(velocity, -1, 0), (covariance[..., i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    determinant = xx * yy - xy * xy
    valid = determinant > 1e-9
    value = (yy * x * x - 2 * xy * x * y + xx * y * y) / np.where(valid, determinant, 1.0)
    return np.where(valid, np.maximum(value, 0.0), 0.0)


def _dynamic(particles: int, **options: Any) -> Callable[[], Any]:
    return lambda: DynamicMapper(WINDOW, particles, **options)


def _followed() -> DynamicMapper:
    """Return a map that follows its objects, so that predictions know how they turn."""
    mapper = DynamicMapper(WINDOW, 200_000)
    mapper.objects()
    return mapper


OF_NUSS = DynamicSettings(  # per 0.1 s: p_S 0.99, p_B 0.02, alpha 0.9, noise of 0.01 m and 0.3 m/s
    free_half_life=0.66, dynamic_half_life=6.9, birth_rate=0.2, position_noise=0.03, velocity_noise=1.0
)

FILTERS: dict[str, Callable[[], Any]] = {
    HYBRID: _followed,
    PLAIN: _dynamic(200_000, matching=False),
    NUSS_FEW: _dynamic(200_000, filter="nuss", settings=OF_NUSS),
    NUSS: _dynamic(1_000_000, filter="nuss", settings=OF_NUSS),
    CONFLICT: ConflictDetector,
    EVIDENTIAL: lambda: Static(EvidentialMapper(WINDOW)),
    BAYES: lambda: Static(BinaryBayesMapper(WINDOW)),
}
READINGS: dict[str, dict[str, Reading]] = {  # name in the tables: reading; predictions are of the first
    name: {name: Reading(by_significance, significant), f"{name}, {SPEED_ALONE}": Reading(predicted=significant)}
    for name in (NUSS, NUSS_FEW)
}
