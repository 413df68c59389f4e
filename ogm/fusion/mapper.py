"""Measurement grids of a moving vehicle, one after the other, into a map that remembers and forgets.

The map stays aligned with the world and scrolls by whole cells, so driving blurs nothing. It is looked up in the
vehicle's axes by `EvidentialMapper.view`, resampled once, on the way out.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.evidence import cumulative, dempster, discount, discount_evidence, normalized_cautious, yager
from ogm.fusion.arrival import CheckedScan, Log
from ogm.fusion.kernels import CAUTIOUS, CUMULATIVE, DEMPSTER, YAGER, evidential_update, gather
from ogm.fusion.warp import Method, view_of
from ogm.fusion.window import Kind, Window
from ogm.grid import EvidentialGrid, GridSpec

__all__ = ["EvidentialMapper", "Forget", "Rule"]

Rule = Callable[[Any, Any], Any]
Forget = Literal["everywhere", "observed"]
MOVING = 50.0  # times faster than all else, what came is forgotten
_FAST: dict[Rule, int] = {
    dempster: DEMPSTER,
    yager: YAGER,
    cumulative: CUMULATIVE,
    normalized_cautious: CAUTIOUS,
}


class EvidentialMapper:
    """A map of belief masses, kept from scan to scan.

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
        default takes scans for what they are, dependent: a hint that every scan repeats, such as rays that pass over
        a roof, does not become certainty.
    half_life : float or (free, occupied)
        Time in which belief halves [s]; infinity forgets nothing.
    moving_half_life : float
        The same [s] for occupied where something came, and what comes leaves: belief that a cell is occupied fades
        this fast, in proportion to the excess of the conflict free -> occupied over occupied -> free. It takes the
        trails away that moving things leave where no ray looks any more; infinity lets them stand. By default a
        fiftieth of the half-life of occupied, so that a map that forgets nothing forgets nothing.
    conflict_half_life : float
        Time in which the conflict layers fade by half [s]; 0 keeps the last scan's conflict alone.
    discounting : {discount, discount_evidence}
        What fades: the mass (Shafer), or the evidence, which `cumulative` adds up.
    forget : {"everywhere", "observed"}
        Whether all cells fade, or only those that the present scan says something about.
    min_unknown : float
        What unknown never falls below, [0, 1), so that the map can change its mind: with Dempster's rule the number of
        scans it takes grows with the logarithm of its inverse, and at 0 it may never do so in float32.
    window : {"rolling", "fixed"}
        Follow the vehicle, or stay: for a yard, or a drive as a whole. Memory is that of one grid in both cases.
    max_speed : float
        Beyond which a pose is a jump [m/s].
    max_delay : float
        By which a scan may arrive late [s].

    Raises
    ------
    ValueError
        If a number is out of its range, or a name is none of the choices.

    Notes
    -----
    Stamps. A repeated stamp is a scan of the same moment (another sensor's): nothing ages. A scan that is at most
    `max_delay` older than the map counts as what ageing would have left of it; the window does not move back for
    it, and it says nothing about what came or went. An older one, a missing stamp (unless nothing is ever
    forgotten), a gap of more than a day, NaN: ValueError; so is every scan after one whose stamp was wrong by hours,
    until `reset`. A pose jump: `PoseJump`. After an error the map is as it was.
    """

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
        window: Kind = "rolling",
        max_speed: float = 70.0,
        max_delay: float = 0.5,
    ) -> None:
        if not callable(rule):
            raise TypeError(
                f"rule must be a function of two masses, such as ogm.evidence.dempster, got {rule!r}"
            )
        if discounting not in (discount, discount_evidence):
            raise ValueError(
                f"discounting must be discount or discount_evidence of ogm.evidence, got {discounting!r}"
            )
        if not 0 <= min_unknown < 1:
            raise ValueError(f"min_unknown must be in [0, 1), got {min_unknown}")
        if moving_half_life is not None and not moving_half_life > 0:
            raise ValueError(f"moving_half_life must be greater than 0 s, got {moving_half_life}")
        if not conflict_half_life >= 0:
            raise ValueError(f"conflict_half_life must be 0 s or more, got {conflict_half_life}")
        self.rule, self.half_life = rule, _half_lives(half_life)
        self.moving_half_life = (
            self.half_life[1] / MOVING if moving_half_life is None else float(moving_half_life)
        )
        self.discounting, self.forget = discounting, checked_forget(forget)
        self.min_unknown = float(min_unknown)
        self.conflict_half_life = float(conflict_half_life)
        forgets = not math.inf == self.moving_half_life == min(self.half_life)
        self._window = Window(spec, window)
        self._log = Log(max_speed, max_delay, needs_stamps=forgets)
        self._mass = np.zeros((*spec.shape, 2), np.float32)
        self._conflict = np.zeros((*spec.shape, 2), np.float32)

    def update(
        self,
        grid: EvidentialGrid,
        T_map_sensor: ArrayLike,
        *,
        stamp: float | None = None,
        T_vehicle_sensor: ArrayLike | None = None,
        reliability: float = 1.0,
    ) -> None:
        """Age the map to a new scan's time and fuse its measurement grid.

        Parameters
        ----------
        grid : EvidentialGrid
            What a sensor model made of the scan, in the frame that the next argument takes to the map. Its extent and
            resolution are free: cells of the map take what is said at their middle, or, if the scan's cells are finer,
            the mean over the cell.
        T_map_sensor : (4, 4) array
            Takes the grid's frame to the map [m].
        stamp : float
            When the scan was taken [s].
        T_vehicle_sensor : (4, 4) array, optional
            Where that frame sits on the vehicle, of which there is one for all sensors: the window and the check for
            jumps follow the vehicle. By default the frame is the vehicle's.
        reliability : float
            Of this sensor, [0, 1]: its masses are discounted by it.

        Raises
        ------
        TypeError
            If `grid` is no EvidentialGrid.
        PoseJump
            If the pose is further from the last one than `max_speed` allows.
        ValueError
            If a pose is not rigid, leans by more than 45 degrees or holds NaN, a stamp breaks the rules above, or the
            grid and the window have no cell in common.
        """
        arrival = self._log.check(self._window, grid, T_map_sensor, stamp, T_vehicle_sensor, reliability)
        mass = grid.mass if arrival.elapsed >= 0 else self._aged(grid.mass, -arrival.elapsed)
        if self.rule in _FAST:
            self._window.move_to(arrival.corner, self._mass, self._conflict)
            self._fuse(np.ascontiguousarray(mass), arrival, reliability)
        else:
            self._fuse_by_any_rule(np.ascontiguousarray(mass), arrival, reliability)
        self._log.accept(arrival)

    @property
    def spec(self) -> GridSpec:
        """The window's cells now, in map coordinates."""
        return self._window.spec

    @property
    def grid(self) -> EvidentialGrid:
        """The map (a copy), in map coordinates, as of the last scan."""
        return EvidentialGrid.trusted(self.spec, self._window.unrolled(self._mass))

    @property
    def conflict(self) -> NDArray[np.float32]:
        """Where map and scans contradicted each other of late, (nx, ny, 2) in [0, 1], on the cells of `grid`.

        First what was free and is measured occupied (something came), then what was occupied and is measured free
        (something left): the greatest conflict mass, each fading with `conflict_half_life`.
        """
        return self._window.unrolled(self._conflict)

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
        """Return the map in the vehicle's axes, resampled once, in one of the ways of `ogm.fusion.warp`.

        Parameters
        ----------
        spec : GridSpec, optional
            The cells, in the vehicle's frame; by default as many as the window has, around the vehicle. To see all of
            them at any yaw the window must be a square as wide as their diagonal.
        T_map_vehicle : (4, 4) array, optional
            By default that of the newest scan.
        method : {"nearest", "area", "cautious"}
        """
        T = self.T_map_vehicle if T_map_vehicle is None else T_map_vehicle
        return view_of(self.grid, spec or self._window.around, T, method)

    def conflict_view(
        self, spec: GridSpec | None = None, T_map_vehicle: ArrayLike | None = None
    ) -> NDArray[np.float32]:
        """Return `conflict` in the vehicle's axes, (nx, ny, 2), by nearest cells. Arguments as for `view`."""
        T = self.T_map_vehicle if T_map_vehicle is None else T_map_vehicle
        layers = EvidentialGrid.trusted(self.spec, self.conflict)
        return view_of(layers, spec or self._window.around, T, "nearest").mass

    def reset(self) -> None:
        """Forget everything: the next scan begins a new map."""
        self._mass[:] = 0
        self._conflict[:] = 0
        self._window.corner = (0, 0)
        self._log.clear()

    def _fuse(self, mass: NDArray[np.float32], arrival: CheckedScan, reliability: float) -> None:
        """Fuse a scan in one compiled pass over the map."""
        nx, ny = self._window.given.shape
        elapsed = max(arrival.elapsed, 0.0)
        conflict = self._conflict if arrival.elapsed >= 0 else self._conflict.copy()
        evidential_update(
            self._mass.reshape(nx, 2 * ny),
            conflict.reshape(nx, 2 * ny),
            *self._window.ring,
            mass,
            arrival.affine,
            arrival.samples,
            _FAST[self.rule],
            *self._kept(elapsed),
            self._leaving(elapsed),
            self.discounting is discount_evidence,
            self.forget == "observed",
            float(reliability),
            1.0 - self.min_unknown,
            self._fade(elapsed),
        )

    def _fuse_by_any_rule(self, mass: NDArray[np.float32], arrival: CheckedScan, reliability: float) -> None:
        """Do the same in numpy, with a rule that is only a function of two masses: the slow twin of `_fuse`."""
        before = self._window.corner, self._mass.copy(), self._conflict.copy()
        try:
            self._window.move_to(arrival.corner, self._mass, self._conflict)
            scan = np.empty_like(self._mass)
            rows = scan.reshape(len(scan), -1)
            gather(mass, arrival.affine, arrival.samples, *self._window.ring, rows)
            said = scan * np.float32(reliability)
            elapsed = max(arrival.elapsed, 0.0)
            excess = self._conflict[..., 0] - self._conflict[..., 1]
            stayed = self._mass.copy()
            stayed[..., 1] *= np.exp(-self._leaving(elapsed) * np.maximum(excess, 0))
            aged = self._aged(stayed, elapsed)
            if self.forget == "observed":
                aged = np.where(said.sum(axis=-1, keepdims=True) > 0, aged, stayed)
            self._mass[:] = bounded(self._combined(aged, said), self.min_unknown)
            if arrival.elapsed < 0:
                return
            contradicted = aged * said[..., ::-1]  # free then and occupied now, occupied then and free now
            np.maximum(self._conflict * np.float32(self._fade(elapsed)), contradicted, out=self._conflict)
        except BaseException:
            self._window.corner, self._mass[:], self._conflict[:] = before
            raise

    def _kept(self, seconds: float) -> tuple[float, float]:
        """Return the shares of free and of occupied that are left after some time."""
        free, occupied = (0.5 ** (seconds / one) for one in self.half_life)
        return free, occupied

    def _leaving(self, seconds: float) -> float:
        """Return by how much the logarithm of occupied falls in some time where the excess of conflict was 1."""
        if seconds == 0:
            return 0.0
        rate = math.log(2) * max(1 / self.moving_half_life - 1 / self.half_life[1], 0.0)
        if not 0 < self.conflict_half_life < math.inf:
            return rate * seconds
        fading = math.log(2) / self.conflict_half_life  # the excess itself fades in the meantime
        return rate * -math.expm1(-fading * seconds) / fading

    def _fade(self, seconds: float) -> float:
        """Return the share of the conflict that is left after some time; a scan of the same moment takes none."""
        if seconds == 0:
            return 1.0
        return 0.5 ** (seconds / self.conflict_half_life) if self.conflict_half_life else 0.0

    def _combined(self, aged: NDArray[np.float32], said: NDArray[np.float32]) -> NDArray[np.float32]:
        """Apply a rule that has no kernel, and check that it gives masses."""
        new = np.asarray(self.rule(aged, said))
        if new.shape != aged.shape or new.dtype.kind != "f":
            name = getattr(self.rule, "__name__", repr(self.rule))
            hint = "; close it: lambda a, b: close_world(rule(a, b))" if new.shape[-1:] == (3,) else ""
            raise ValueError(
                f"rule {name} must return masses of shape {aged.shape}, got {new.dtype} of {new.shape}{hint}"
            )
        return EvidentialGrid(self._window.given, new).mass

    def _aged(self, mass: NDArray[np.float32], seconds: float) -> NDArray[np.float32]:
        """Return what is left of masses after some time."""
        kept = mass * np.array(self._kept(seconds), np.float32)
        if self.discounting is discount:
            return kept
        total = np.maximum(1 - mass.sum(axis=-1, keepdims=True), 0) + kept.sum(axis=-1, keepdims=True)
        return (kept / np.where(total > 0, total, 1)).astype(np.float32, copy=False)


def bounded(mass: NDArray[np.float32], min_unknown: float) -> NDArray[np.float32]:
    """Scale beliefs down where they leave less than `min_unknown` to the unknown."""
    known = mass.sum(axis=-1, keepdims=True)
    limit = np.float32(1 - min_unknown)
    return mass * np.minimum(1, limit / np.maximum(known, limit)).astype(np.float32)


def checked_forget(forget: Forget) -> Forget:
    """Return what to forget, or refuse what is no choice."""
    if forget not in get_args(Forget):
        raise ValueError(f"forget must be one of {', '.join(get_args(Forget))}, got {forget!r}")
    return forget


def _half_lives(half_life: float | Sequence[float]) -> tuple[float, float]:
    both = (half_life, half_life) if isinstance(half_life, int | float | np.number) else tuple(half_life)
    if len(both) != 2 or not all(one > 0 for one in both):
        raise ValueError(
            f"half_life must be greater than 0 s, one number or two (free, occupied), got {half_life}; "
            "infinity forgets nothing"
        )
    return float(both[0]), float(both[1])
