"""The classical binary Bayes filter on the interface of `EvidentialMapper`, for comparisons that are fair.

Sources: Elfes, "Using occupancy grids for mobile robot perception and navigation" (1989); Thrun, Burgard and Fox,
*Probabilistic Robotics* (2005), chapters 4.2 and 9.
"""

import math
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit

from ogm.fusion.arrival import Log
from ogm.fusion.kernels import bayes_update, log_odds_of
from ogm.fusion.mapper import Forget, checked_forget
from ogm.fusion.warp import Method, view_of
from ogm.fusion.window import Kind, Window
from ogm.grid import EvidentialGrid, GridSpec

__all__ = ["BinaryBayesMapper", "Match"]

Match = Literal["pignistic", "plausibility"]


class BinaryBayesMapper:
    """A map of one probability per cell: log-odds that add up, between two limits.

    A scan adds the log-odds of its own probability of occupied, so both kinds of map get the same sensor model. A cell
    that nobody saw and one that was contradicted evenly are both 1/2.

    Parameters
    ----------
    spec : GridSpec
        As for `EvidentialMapper`.
    half_life : float
        Time in which log-odds halve [s]; infinity, the classical filter, forgets nothing.
    match : {"pignistic", "plausibility"}
        What a mass means as a probability: occupied + unknown / 2, or the normalised plausibility. With the latter the
        log-odds are those that Dempster's rule adds up too (Cobb and Shenoy, 2006).
    limits : (float, float)
        Between which the probability is kept; the default is OctoMap's.
    forget, window, max_speed, max_delay
        As for `EvidentialMapper`.
    """

    def __init__(
        self,
        spec: GridSpec,
        half_life: float = math.inf,
        *,
        match: Match = "pignistic",
        limits: tuple[float, float] = (0.12, 0.97),
        forget: Forget = "everywhere",
        window: Kind = "rolling",
        max_speed: float = 70.0,
        max_delay: float = 0.5,
    ) -> None:
        if not half_life > 0:
            raise ValueError(f"half_life must be greater than 0 s, got {half_life}; infinity forgets nothing")
        if match not in get_args(Match):
            raise ValueError(f"match must be one of {', '.join(get_args(Match))}, got {match!r}")
        low, high = limits
        if not 0 < low < 0.5 < high < 1:
            raise ValueError(
                f"limits must be two probabilities around 1/2, 0 < low < 0.5 < high < 1, got {limits}"
            )
        self.half_life, self.match, self.limits = float(half_life), match, (float(low), float(high))
        self.forget = checked_forget(forget)
        self._window = Window(spec, window)
        self._log = Log(max_speed, max_delay, needs_stamps=self.half_life != math.inf)
        self._log_odds = np.zeros(spec.shape, np.float32)

    def update(
        self,
        grid: EvidentialGrid,
        T_map_sensor: ArrayLike,
        *,
        stamp: float | None = None,
        T_vehicle_sensor: ArrayLike | None = None,
        reliability: float = 1.0,
    ) -> None:
        """Age the map to a new scan's time and add the scan's log-odds: `EvidentialMapper.update`."""
        arrival = self._log.check(self._window, grid, T_map_sensor, stamp, T_vehicle_sensor, reliability)
        mass = np.ascontiguousarray(grid.mass) * np.float32(reliability)
        said: NDArray[np.float32] = np.empty_like(mass)
        low, high = (math.log(p / (1 - p)) for p in self.limits)
        log_odds_of(mass.reshape(-1, 2), self.match == "plausibility", max(-low, high), said.reshape(-1, 2))
        self._window.move_to(arrival.corner, self._log_odds)
        keep = 0.5 ** (abs(arrival.elapsed) / self.half_life)
        if arrival.elapsed < 0:  # late: what ageing would have left of it
            said, keep = said * np.float32(keep), 1.0
        bayes_update(
            self._log_odds, *self._window.ring, said, arrival.affine, arrival.samples, keep,
            self.forget == "observed", low, high,
        )  # fmt: skip
        self._log.accept(arrival)

    @property
    def spec(self) -> GridSpec:
        """The window's cells now, in map coordinates."""
        return self._window.spec

    @property
    def probability(self) -> NDArray[np.float32]:
        """Probability of occupied, (nx, ny), on the cells of `grid`."""
        p: NDArray[np.float32] = expit(self._window.unrolled(self._log_odds))
        return p

    @property
    def grid(self) -> EvidentialGrid:
        """The map as masses: the least committed ones with the filter's probability, unknown 1 where it is 1/2."""
        p = self.probability
        mass = np.stack([np.maximum(1 - 2 * p, 0), np.maximum(2 * p - 1, 0)], axis=-1)
        return EvidentialGrid.trusted(self.spec, mass)

    @property
    def stamp(self) -> float | None:
        """Time of the map [s]: that of the newest scan."""
        return self._log.stamp

    @property
    def T_map_vehicle(self) -> NDArray[np.float64] | None:
        """Where the vehicle was at that time, (4, 4)."""
        return self._log.T_map_vehicle

    @property
    def scans(self) -> int:
        """Number of scans in the map."""
        return self._log.scans

    def view(
        self,
        spec: GridSpec | None = None,
        T_map_vehicle: ArrayLike | None = None,
        *,
        method: Method = "nearest",
    ) -> EvidentialGrid:
        """Return the map in the vehicle's axes: `EvidentialMapper.view`."""
        T = self.T_map_vehicle if T_map_vehicle is None else T_map_vehicle
        return view_of(self.grid, spec or self._window.around, T, method)

    def reset(self) -> None:
        """Forget everything: the next scan begins a new map."""
        self._log_odds[:] = 0
        self._window.corner = (0, 0)
        self._log.clear()
