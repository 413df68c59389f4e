"""The map of belief masses: fuses the measurement grids of a moving vehicle, and forgets at a given rate.

The map stays aligned with the world and scrolls by whole cells, so driving blurs nothing. `EvidentialMapper.view`
returns it in the vehicle's axes, resampled once.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.evidence import cumulative, dempster, discount, discount_evidence, normalized_cautious, yager
from ogm.fusion.kernels import CAUTIOUS, CUMULATIVE, DEMPSTER, YAGER, Aging, evidential_update
from ogm.fusion.lookup import ScanLookup, gather
from ogm.fusion.mapper import Forget, Mapper, locked
from ogm.fusion.update_gate import CheckedScan, UpdateGate
from ogm.fusion.window import Window, WindowMode, check_choice
from ogm.grid import EvidentialGrid, GridSpec

Rule = Callable[[Any, Any], Any]
DYNAMIC_DECAY_RATIO = 50.0  # how many times faster dynamic cells are forgotten by default
_COMPILED: dict[Rule, int] = {dempster: DEMPSTER, yager: YAGER, cumulative: CUMULATIVE, normalized_cautious: CAUTIOUS}


class EvidentialMapper(Mapper):
    """A map of belief masses that fuses scan after scan.

    Every `update` ages the map by the time since the last scan, combines it with the new measurement grid, bounds its
    certainty, and keeps where the two contradict each other.

    Parameters
    ----------
    spec : GridSpec
        The window: relative to the vehicle if it rolls, in map coordinates if it is fixed. The measurement grids may
        have other extents and resolutions.
    rule : function
        Combines two masses, ``rule(map, scan)``. `ogm.evidence.normalized_cautious`, `dempster`, `yager` and
        `cumulative` run as one compiled pass; any other function of two (..., 2) arrays works too, ten times and more
        slower. Rules in an open world give triples: close them, ``lambda a, b: close_world(conjunctive(a, b))``. The
        default treats scans as dependent, which they are: weak evidence that every scan repeats, such as rays that
        pass over a roof, does not become certainty.
    half_life : float or (free, occupied)
        Time in which belief halves [s]; infinity forgets nothing.
    moving_half_life : float
        The same [s] for occupied in cells that were free and became occupied: the belief halves this fast where the
        conflict free -> occupied exceeds occupied -> free by 1, and in proportion to the excess else. It removes the
        trails that moving objects leave where no ray measures any more; infinity keeps them. By default a fiftieth of
        the half-life of occupied, so that a map with infinite half-life forgets nothing.
    conflict_half_life : float
        Time in which the conflict layers fade by half [s]; 0 keeps the last scan's conflict alone.
    discounting : {discount, discount_evidence}
        What fades: the mass (Shafer), or the evidence, which `cumulative` adds up.
    forget : {"everywhere", "observed"}
        Whether all cells fade, or only those that the present scan has a belief about.
    min_unknown : float
        Lower bound of unknown, [0, 1), so that new scans can change the map: with Dempster's rule the number of scans
        that this takes grows with the logarithm of its inverse, and at 0 it may be infinite in float32.
    window : {"rolling", "fixed"}
        Follow the vehicle, or stay in place, for a yard or a whole drive. Memory is that of one grid in both cases.
    max_speed : float
        Beyond which a pose is a jump [m/s].
    max_delay : float
        How much older than the map a scan may be [s].

    Raises
    ------
    ValueError
        If a number is out of its range, or a name is none of the choices.

    Notes
    -----
    Stamps. A repeated stamp is a scan of the same moment (another sensor's): nothing ages. A scan that is at most
    `max_delay` older than the map counts as much as ageing would have left of it; the window does not move back for
    it, and it changes no conflict layer. An older one, a missing stamp (unless nothing is ever forgotten), a gap of
    more than a day, NaN: ValueError; so is every scan after one whose stamp was wrong by hours, until `reset`. A pose
    jump: `PoseJump`. After an error the map is as it was.

    Threads. One thread may update the map while any number of others read it: each property and method returns a
    whole state, that before or after an update. What belongs together is read with ``with mapper.lock:``.
    """

    rule: Rule
    half_life: tuple[float, float]
    moving_half_life: float
    discounting: Callable[..., Any]
    forget: Forget
    min_unknown: float
    conflict_half_life: float

    def __init__(
        self,
        spec: GridSpec,
        rule: Rule = normalized_cautious,
        half_life: float | Sequence[float] = 2.0,
        *,
        moving_half_life: float | None = None,
        conflict_half_life: float = 2.0,
        discounting: Callable[..., Any] = discount,
        forget: Forget = "everywhere",
        min_unknown: float = 0.02,
        window: WindowMode = "rolling",
        max_speed: float = 70.0,
        max_delay: float = 0.5,
    ) -> None:
        if not callable(rule):
            raise TypeError(f"rule must be a function of two masses, such as ogm.evidence.dempster, got {rule!r}")
        if discounting not in (discount, discount_evidence):
            raise ValueError(f"discounting must be discount or discount_evidence of ogm.evidence, got {discounting!r}")
        if not 0 <= min_unknown < 1:
            raise ValueError(f"min_unknown must be in [0, 1), got {min_unknown}")
        if moving_half_life is not None and not moving_half_life > 0:
            raise ValueError(f"moving_half_life must be greater than 0 s, got {moving_half_life}")
        if not conflict_half_life >= 0:
            raise ValueError(f"conflict_half_life must be 0 s or more, got {conflict_half_life}")
        self.rule, self.half_life = rule, _half_lives(half_life)
        by_default = self.half_life[1] / DYNAMIC_DECAY_RATIO
        self.moving_half_life = by_default if moving_half_life is None else float(moving_half_life)
        self.discounting, self.forget = discounting, check_choice("forget", forget, Forget)
        self.min_unknown = float(min_unknown)
        self.conflict_half_life = float(conflict_half_life)
        forgets = not math.inf == self.moving_half_life == min(self.half_life)
        super().__init__(Window(spec, window), UpdateGate(max_speed, max_delay, needs_stamps=forgets))
        self._mass, self._conflict = np.zeros((2, *spec.shape, 2), np.float32)

    def __repr__(self) -> str:
        rule = getattr(self.rule, "__name__", repr(self.rule))
        free, occupied = self.half_life
        memory = f"{free:g} s" if free == occupied else f"({free:g}, {occupied:g}) s"
        return f"EvidentialMapper({rule}, half-life {memory}, {self.scans} scans, {self.spec})"

    @property
    @locked
    def grid(self) -> EvidentialGrid:
        """The map (a copy), in map coordinates, as of the last scan."""
        return EvidentialGrid.trusted(self.spec, self._window.unrolled(self._mass))

    @property
    def _layers(self) -> Sequence[NDArray[np.float32]]:
        return self._mass, self._conflict

    def _conflict_layers(self) -> NDArray[np.float32]:
        return self._window.unrolled(self._conflict)

    def _fuse(self, grid: EvidentialGrid, scan: CheckedScan, reliability: float) -> None:
        mass = np.ascontiguousarray(grid.mass if scan.elapsed >= 0 else self._aged(grid.mass, -scan.elapsed))
        if self.rule not in _COMPILED:
            self._fuse_by_any_rule(mass, scan, reliability)
            return
        self._window.move_to(scan.corner, self._mass, self._conflict)
        nx, ny = self._window.spec0.shape
        conflict = self._conflict if scan.elapsed >= 0 else self._conflict.copy()
        evidential_update(
            self._mass.reshape(nx, 2 * ny),
            conflict.reshape(nx, 2 * ny),
            self._window.ring,
            ScanLookup(mass, scan.affine, scan.samples),
            float(reliability),
            self._aging(max(scan.elapsed, 0.0)),
            _COMPILED[self.rule],
            1.0 - self.min_unknown,
        )

    def _fuse_by_any_rule(self, mass: NDArray[np.float32], scan: CheckedScan, reliability: float) -> None:
        """Fuse in numpy, with a rule that is only a function of two masses: the slow reference of the compiled pass."""
        before = self._window.corner, self._mass.copy(), self._conflict.copy()
        try:
            self._window.move_to(scan.corner, self._mass, self._conflict)
            measured = np.empty_like(self._mass)
            lookup = ScanLookup(mass, scan.affine, scan.samples)
            gather(lookup, self._window.ring, measured.reshape(len(measured), -1))
            measured *= np.float32(reliability)
            aging = self._aging(max(scan.elapsed, 0.0))
            excess = self._conflict[..., 0] - self._conflict[..., 1]
            decayed = self._mass.copy()
            decayed[..., 1] *= np.exp(-aging.dynamic_decay * np.maximum(excess, 0))
            aged = self._aged(decayed, max(scan.elapsed, 0.0))
            if self.forget == "observed":
                aged = np.where(measured.sum(axis=-1, keepdims=True) > 0, aged, decayed)
            self._mass[:] = _bounded(self._combined(aged, measured), self.min_unknown)
            if scan.elapsed < 0:
                return
            contradicted = aged * measured[..., ::-1]  # free then and occupied now, occupied then and free now
            np.maximum(self._conflict * np.float32(aging.keep_conflict), contradicted, out=self._conflict)
        except BaseException:
            self._window.corner, self._mass[:], self._conflict[:] = before
            raise

    def _aging(self, seconds: float) -> Aging:
        """Return the shares of the map that are left after some time, and its dynamic decay."""
        free, occupied = self._kept(seconds)
        evidence, observed = self.discounting is discount_evidence, self.forget == "observed"
        if seconds == 0:  # a scan of the same moment
            return Aging(free, occupied, 0.0, 1.0, evidence, observed)
        keep = 0.5 ** (seconds / self.conflict_half_life) if self.conflict_half_life else 0.0
        decay = math.log(2) * max(1 / self.moving_half_life - 1 / self.half_life[1], 0.0)
        if 0 < self.conflict_half_life < math.inf:  # the excess itself fades in the meantime
            fading = math.log(2) / self.conflict_half_life
            decay = decay * -math.expm1(-fading * seconds) / fading
        else:
            decay *= seconds
        return Aging(free, occupied, decay, keep, evidence, observed)

    def _kept(self, seconds: float) -> tuple[float, float]:
        """Return the shares of free and of occupied that are left after some time."""
        return 0.5 ** (seconds / self.half_life[0]), 0.5 ** (seconds / self.half_life[1])

    def _combined(self, aged: NDArray[np.float32], measured: NDArray[np.float32]) -> NDArray[np.float32]:
        """Apply a rule that has no kernel, and check that it gives masses."""
        new = np.asarray(self.rule(aged, measured))
        if new.shape != aged.shape or new.dtype.kind != "f":
            name = getattr(self.rule, "__name__", repr(self.rule))
            hint = "; close it: lambda a, b: close_world(rule(a, b))" if new.shape[-1:] == (3,) else ""
            raise ValueError(
                f"rule {name} must return masses of shape {aged.shape}, got {new.dtype} of {new.shape}{hint}"
            )
        return EvidentialGrid(self._window.spec0, new).mass

    def _aged(self, mass: NDArray[np.float32], seconds: float) -> NDArray[np.float32]:
        """Return what is left of masses after some time."""
        kept = mass * np.array(self._kept(seconds), np.float32)
        if self.discounting is discount:
            return kept
        total = np.maximum(1 - mass.sum(axis=-1, keepdims=True), 0) + kept.sum(axis=-1, keepdims=True)
        return (kept / np.where(total > 0, total, 1)).astype(np.float32, copy=False)


def _bounded(mass: NDArray[np.float32], min_unknown: float) -> NDArray[np.float32]:
    """Scale beliefs down where they leave less than `min_unknown` to unknown."""
    known = mass.sum(axis=-1, keepdims=True)
    limit = np.float32(1 - min_unknown)
    bounded: NDArray[np.float32] = mass * np.minimum(1, limit / np.maximum(known, limit)).astype(np.float32)
    return bounded


def _half_lives(half_life: float | Sequence[float]) -> tuple[float, float]:
    both = (half_life, half_life) if isinstance(half_life, int | float | np.number) else tuple(half_life)
    if len(both) != 2 or not all(one > 0 for one in both):
        raise ValueError(
            f"half_life must be greater than 0 s, one number or two (free, occupied), got {half_life}; "
            "infinity forgets nothing"
        )
    return float(both[0]), float(both[1])
