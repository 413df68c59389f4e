"""The classical binary Bayes filter on the interface of `EvidentialMapper`.

Sources: Elfes, "Using occupancy grids for mobile robot perception and navigation" (1989); Thrun, Burgard and Fox,
*Probabilistic Robotics* (2005), chapters 4.2 and 9.
"""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.kernels import bayes_update, log_odds_of
from ogm.fusion.lookup import ScanLookup
from ogm.fusion.mapper import Forget, Mapper, locked
from ogm.fusion.update_gate import CheckedScan, UpdateGate
from ogm.fusion.window import Window, WindowMode, check_choice
from ogm.grid import EvidentialGrid, GridSpec

Match = Literal["pignistic", "plausibility"]


class BinaryBayesMapper(Mapper):
    """Map of one probability per cell: log-odds are added and clipped to limits.

    A scan adds the log-odds of its own probability of occupied, so the sensor models of `EvidentialMapper` apply.
    Unobserved cells have probability 1/2, as have cells with equal evidence for free and occupied.

    Parameters
    ----------
    spec : GridSpec
        Window of the map, see `EvidentialMapper`.
    half_life : float
        Time in which log-odds halve [s]; infinity, the classical filter, forgets nothing.
    match : {"pignistic", "plausibility"}
        Probability of a mass: "pignistic" is occupied + unknown / 2, "plausibility" the normalised plausibility. The
        log-odds of the plausibility add up under Dempster's rule (Cobb and Shenoy, 2006).
    limits : (float, float)
        Lowest and highest probability of a cell, 0 < low < 0.5 < high < 1. The default is OctoMap's.
    forget, window, max_speed, max_delay
        See `EvidentialMapper`.

    Notes
    -----
    Stamps, poses, jumps and threads are treated as in `EvidentialMapper`. Scans that are free only in the plane of a
    laser are summed separately. A cell takes the larger of the two sums if one of them favours occupied, else the
    smaller one.
    """

    half_life: float
    match: Match
    limits: tuple[float, float]
    forget: Forget

    def __init__(
        self,
        spec: GridSpec,
        half_life: float = math.inf,
        *,
        match: Match = "pignistic",
        limits: tuple[float, float] = (0.12, 0.97),
        forget: Forget = "everywhere",
        window: WindowMode = "rolling",
        max_speed: float = 70.0,
        max_delay: float = 0.5,
    ) -> None:
        if not half_life > 0:
            raise ValueError(f"half_life must be greater than 0 s, got {half_life}; infinity forgets nothing")
        check_choice("match", match, Match)
        low, high = limits
        if not 0 < low < 0.5 < high < 1:
            raise ValueError(f"limits must be two probabilities around 1/2, 0 < low < 0.5 < high < 1, got {limits}")
        self.half_life, self.match, self.limits = float(half_life), match, (float(low), float(high))
        self.forget = check_choice("forget", forget, Forget)
        forgets = self.half_life != math.inf
        super().__init__(Window(spec, window), UpdateGate(max_speed, max_delay, needs_stamps=forgets))
        self._log_odds = np.zeros(spec.shape, np.float32)
        self._plane: NDArray[np.float32] | None = None  # log-odds of in-plane scans; None before the first one

    @property
    def _layers(self) -> Sequence[NDArray[np.float32]]:
        return (self._log_odds,) if self._plane is None else (self._log_odds, self._plane)

    def _fuse(self, grid: EvidentialGrid, scan: CheckedScan, reliability: float) -> None:
        mass = np.ascontiguousarray(grid.mass) * np.float32(reliability)
        log_odds: NDArray[np.float32] = np.empty(grid.spec.shape, np.float32)
        low, high = (math.log(p / (1 - p)) for p in self.limits)
        log_odds_of(mass.reshape(-1, 2), self.match == "plausibility", max(-low, high), log_odds.reshape(-1))
        if grid.in_plane and self._plane is None:
            self._plane = np.zeros_like(self._log_odds)
        layers = self._layers
        self._window.move_to(scan.corner, *layers)
        keep = 0.5 ** (abs(scan.elapsed) / self.half_life)
        if scan.elapsed < 0:  # a late scan is aged to the time of the map
            log_odds, keep = log_odds * np.float32(keep), 1.0
        lookup = ScanLookup(log_odds, scan.affine, scan.samples)
        bayes_update(layers[grid.in_plane], self._window.ring, lookup, keep, self.forget == "observed", (low, high))
        if self._plane is not None and self.forget == "everywhere" and keep < 1:
            layers[not grid.in_plane][:] *= np.float32(keep)

    def __repr__(self) -> str:
        memory = "never forgets" if math.isinf(self.half_life) else f"half-life {self.half_life:g} s"
        return f"BinaryBayesMapper({self.match}, {memory}, {self.scans} scans, {self.spec})"

    @property
    @locked
    def probability(self) -> NDArray[np.float32]:
        """Probability of occupied, (nx, ny), on the cells of `grid`."""
        log_odds = self._window.unrolled(self._log_odds)
        if self._plane is not None:
            plane = self._window.unrolled(self._plane)
            higher = np.maximum(log_odds, plane)
            log_odds = np.where(higher > 0, higher, np.minimum(log_odds, plane))
        p: NDArray[np.float32] = np.exp(-np.logaddexp(0, -log_odds))
        return p

    @property
    @locked
    def grid(self) -> EvidentialGrid:
        """The map as least committed masses with this probability: unknown is 1 at probability 1/2."""
        p = self.probability
        mass = np.stack([np.maximum(1 - 2 * p, 0), np.maximum(2 * p - 1, 0)], axis=-1)
        return EvidentialGrid.trusted(self.spec, mass)
