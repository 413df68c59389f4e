"""The map of belief masses: fuses the measurement grids of a moving vehicle, and forgets at a given rate.

The map stays aligned with the world and scrolls by whole cells, so driving blurs nothing. `EvidentialMapper.view`
returns it in the vehicle's axes, resampled once.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.evidence import cautious, cumulative, dempster, discount, discount_evidence, revise, smooth, yager
from ogm.fusion.kernels import (
    CAUTIOUS,
    CONFIRMED,
    CUMULATIVE,
    DEMPSTER,
    REVISION,
    SMOOTHING,
    YAGER,
    Aging,
    Memory,
    age_blocks,
    evidential_update,
    note_causes,
    shares_left,
)  # fmt: skip
from ogm.fusion.lookup import ScanLookup, gather
from ogm.fusion.map_editing import resampled
from ogm.fusion.mapper import Forget, Mapper, locked
from ogm.fusion.parts import PLAIN, PLANE, PartLayers, bands_of_parts, continued_parts, parts_of_bands
from ogm.fusion.resample import ResampleMethod, view_layers
from ogm.fusion.update_gate import TOLERANCE, CheckedScan, UpdateGate
from ogm.fusion.window import Window, WindowMode, affine_between, check_choice, overlaps
from ogm.grid import Combine, CombinedGrid, EvidentialGrid, GridSpec, LayeredGrid
from ogm.io.grids.placed import PlacedGrid
from ogm.pose import check_pose, pose
from ogm.unknown_cause import UnknownCause

Rule = Callable[[Any, Any], Any]
DYNAMIC_DECAY_RATIO = 100.0  # how many times faster dynamic cells are forgotten by default
_COMPILED: dict[Rule, int] = {
    **{
        dempster: DEMPSTER,
        yager: YAGER,
        cumulative: CUMULATIVE,
        cautious: CAUTIOUS,
        revise: REVISION,
        smooth: SMOOTHING,
    }
}
_NOTHING = np.zeros((1, 1, 2), np.float32)
_NOTHING.flags.writeable = False
_NOWHERE = np.array([[1.0, 0.0, 1e9], [0.0, 1.0, 1e9]])  # affine map to cells that `_NOTHING` does not have


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
        Combines two masses, ``rule(map, scan)``. `ogm.evidence.cautious`, `dempster`, `yager` and
        `cumulative` run as one compiled pass; any other function of two (..., 2) arrays works too, ten times and more
        slower. Rules in an open world give triples: close them, ``lambda a, b: close_world(conjunctive(a, b))``. The
        default treats scans as dependent, which they are: weak evidence that every scan repeats, such as rays that
        pass over a roof, does not become certainty.
    half_life : float or (free, occupied)
        Time in which belief halves [s]; infinity forgets nothing.
    moving_half_life : float
        The same [s] for occupied in cells that were free and became occupied: the belief halves this fast where the
        conflict free -> occupied exceeds occupied -> free by 1, and in proportion to the excess else. It removes the
        trails that moving objects leave where no ray measures any more; infinity keeps them. By default a hundredth of
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

    Planes. Cells that are free in the plane of a laser alone (`EvidentialGrid.in_plane`) are a map by themselves. It is
    joined with the rest when it is read: the greater mass of each state, and free at most what occupied leaves. So a
    laser that sees between the legs of a table never clears the top that a depth camera saw.

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
        rule: Rule = revise,
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
        self._parts: dict[int, PartLayers] = {}
        self._combine: Combine | None = None  # of the parts beyond `PLAIN`
        self._waiting: dict[int, PartLayers] | None = (
            None  # of a saved map, until the first scan: the map of each model
        )
        self._now = 0.0  # [s] sum of the times between scans
        self._codes: NDArray[np.uint8] | None = None  # see `note_causes`; None until a grid has causes

    @classmethod
    def from_grid(
        cls,
        saved: EvidentialGrid | PlacedGrid,
        spec: GridSpec | None = None,
        *,
        window: WindowMode = "rolling",
        T_map_vehicle: ArrayLike | None = None,  # noqa: N803
        **settings: Any,
    ) -> Self:
        """Return a mapper that continues a saved map.

        Parameters
        ----------
        saved : PlacedGrid or EvidentialGrid
            The map, in map coordinates, as `ogm.io.read_placed_grid` reads it: with its stamp, by which it ages until
            the first scan (without one it does not), and with `layers`. Without these there is no conflict, and scans
            of several models, each of which has a map of its own, are joined with the saved map as with one more model.
        spec : GridSpec, optional
            The window, see `EvidentialMapper`; by default as many cells as the map has. Other cells than those of the
            map take the least free and the greatest occupied (`ogm.fusion.resampled`).
        window : {"rolling", "fixed"}
        T_map_vehicle : (4, 4) array, optional
            Where a rolling window begins; by default in the middle of the map.
        **settings
            Further parameters of `EvidentialMapper`; no file holds them.

        Raises
        ------
        TypeError
            If the map is dynamic.
        ValueError
            If it has no masses, is turned in its frame, or has no cell in the window.

        Notes
        -----
        The map is that of the mapper that was saved, to the last bit: scans that follow change both in the same way.
        Neither the vehicle's pose, with which jumps are found, nor the number of scans is in a file.
        """
        placed = PlacedGrid.of(saved).upright
        placed.evidential  # noqa: B018  it must have masses
        (nx, ny), side = placed.grid.spec.shape, placed.grid.spec.resolution
        if spec is None:
            spec = placed.grid.spec if window == "fixed" else GridSpec(side, (nx, ny), (-nx * side / 2, -ny * side / 2))
        mapper = cls(spec, window=window, **settings)
        x0, x1, y0, y1 = placed.grid.spec.extent
        start = pose((x0 + x1) / 2, (y0 + y1) / 2) if T_map_vehicle is None else check_pose(T_map_vehicle)
        mapper._window.corner = mapper._window.corner_around(start)
        if not overlaps(affine_between(mapper.spec, placed.grid.spec, np.eye(4)), mapper.spec, placed.grid.spec):
            raise ValueError(
                f"the map, {placed.grid.spec}, has no cell in the window, {mapper.spec}: is it of this place?"
            )
        bands = resampled(placed, mapper.spec).bands
        whole, parts = parts_of_bands(bands, mapper._window.ring)
        mapper._parts, mapper._waiting = {PLAIN: whole}, parts
        mapper._gate.stamp = placed.stamp
        return mapper

    @property
    @locked
    def layers(self) -> LayeredGrid:
        """All that `from_grid` continues from besides `grid`: conflict, and the map of each of several models."""
        parts = {} if self._parts.keys() <= {PLAIN} or self._parts.keys() == {PLANE} else self._parts
        unrolled = {
            n: (self._window.unrolled(part.mass), self._window.unrolled(part.conflict)) for n, part in parts.items()
        }
        return LayeredGrid(self.spec, {**self.conflict.layers, **bands_of_parts(unrolled)})

    def __repr__(self) -> str:
        rule = getattr(self.rule, "__name__", repr(self.rule))
        free, occupied = self.half_life
        memory = f"{free:g} s" if free == occupied else f"({free:g}, {occupied:g}) s"
        return f"EvidentialMapper({rule}, half-life {memory}, {self.scans} scans, {self.spec})"

    @property
    @locked
    def grid(self) -> EvidentialGrid:
        """The map (a copy), in map coordinates, as of the last scan."""
        self._age_all()
        masses = {part: self._window.unrolled(layers.mass) for part, layers in self._parts.items()}
        return EvidentialGrid.trusted(self.spec, self._combined(masses, self._window.spec0.shape))

    @locked
    def view(
        self,
        spec: GridSpec | None = None,
        T_map_vehicle: ArrayLike | None = None,  # noqa: N803
        *,
        method: ResampleMethod = "nearest",
    ) -> EvidentialGrid:
        """Return the map in the vehicle's axes: see `Mapper.view`. Maps of several models are combined after it."""
        cells, T = self._around(spec, T_map_vehicle)
        self._age_all()
        masses = {
            part: view_layers(self._window.unrolled(layers.mass), self.spec, cells, T, method)
            for part, layers in self._parts.items()
        }
        return EvidentialGrid.trusted(cells, self._combined(masses, cells.shape))

    @locked
    def reset(self) -> None:
        """Forget everything: the next scan begins a new map, and may be one of another model."""
        super().reset()
        self._parts, self._waiting, self._combine, self._now, self._codes = {}, None, None, 0.0, None

    @property
    @locked
    def cause(self) -> LayeredGrid:
        """Why cells of `grid` are unknown: the layer ``cause``, with codes of `ogm.UnknownCause`.

        A cell that the map once knew is contradicted, if the conflict exceeded 1/4 when it was lost, else forgotten;
        other cells have the cause of the last scan that covered them.

        Raises
        ------
        ValueError
            If no grid had causes: the model of the scans must be an `ogm.models.ExplainedISM`.
        """
        if self._codes is None:
            raise ValueError("no scan of the map has causes: map scans by ogm.models.ExplainedISM(model)")
        self._age_all()
        codes, grid = self._codes.copy(), _NOTHING[..., 0].astype(np.uint8)
        note_causes(codes, self._whole(), self._whole_conflict(), self._window.ring, grid, _NOWHERE)
        codes[codes == 0] = UnknownCause.OUTSIDE_VIEW
        codes[codes == CONFIRMED] = UnknownCause.KNOWN
        return LayeredGrid(self.spec, {"cause": self._window.unrolled(codes.astype(np.float32))})

    @property
    def has_causes(self) -> bool:
        """Whether `cause` is known."""
        return self._codes is not None

    @property
    def _layers(self) -> Sequence[NDArray[Any]]:
        layers: list[NDArray[Any]] = [array for layers in self._parts.values() for array in layers[:2]]
        return layers if self._codes is None else [*layers, self._codes]

    def _conflict_layers(self) -> NDArray[np.float32]:
        self._age_all()
        return self._window.unrolled(self._whole_conflict())

    def _whole(self) -> NDArray[np.float32]:
        """Return the masses of the map as they are stored."""
        masses = {part: layers.mass for part, layers in self._parts.items()}
        return self._combined(masses, self._window.spec0.shape)

    def _whole_conflict(self) -> NDArray[np.float32]:
        """Return the conflict of the map as it is stored, the greatest of its parts."""
        if len(self._parts) == 1:
            return next(iter(self._parts.values())).conflict
        conflict = np.zeros((*self._window.spec0.shape, 2), np.float32)
        for layers in self._parts.values():
            np.maximum(conflict, layers.conflict, out=conflict)
        return conflict

    def _note_causes(self, grid: EvidentialGrid, scan: CheckedScan) -> None:
        """Note why cells are unknown, if any grid so far said it of its own."""
        if grid.cause is not None and self._codes is None:
            self._codes = np.zeros(self._window.spec0.shape, np.uint8)
        if self._codes is None or scan.elapsed < 0:
            return
        cause, affine = (
            (_NOTHING[..., 0].astype(np.uint8), _NOWHERE) if grid.cause is None else (grid.cause, scan.affine)
        )
        note_causes(self._codes, self._whole(), self._whole_conflict(), self._window.ring, cause, affine)

    def _combined(self, masses: Mapping[int, NDArray[np.float32]], shape: tuple[int, int]) -> NDArray[np.float32]:
        """Return the masses of the map from those of its parts."""
        whole, plane = masses.get(PLAIN), masses.get(PLANE)
        if self._combine is not None:
            combined = self._combine([mass for part, mass in sorted(masses.items()) if part > PLAIN])
            whole = combined if whole is None else cautious(combined, whole)
        if whole is None:
            return np.zeros((*shape, 2), np.float32) if plane is None else plane
        return whole if plane is None else _beside_plane(whole, plane)

    def _fuse(self, grid: EvidentialGrid, scan: CheckedScan, reliability: float) -> None:
        corner, measured, whole_scan = grid.known[0], self._measured(grid), scan
        if self._waiting is not None:
            self._parts, self._waiting = continued_parts(self._parts[PLAIN], self._waiting, measured.keys()), None
            for layers in self._parts.values():  # of other programs, which leave nothing to unknown
                sure = layers.mass.sum(axis=-1) > 1 - self.min_unknown + TOLERANCE
                layers.mass[sure] = _bounded(layers.mass[sure], self.min_unknown)
        shape, now = self._window.spec0.shape, self._now + max(scan.elapsed, 0.0)
        added = {part: PartLayers.empty(shape, now) for part in measured.keys() - self._parts.keys()}
        scan = scan._replace(affine=scan.affine - [[0, 0, corner[0]], [0, 0, corner[1]]])
        if self.rule in _COMPILED:
            self._parts |= added
            self._window.move_to(scan.corner, *self._layers)
            for part, layers in self._parts.items():
                self._update(layers, measured.get(part), scan, reliability)
        else:
            before, parts, codes = self._window.corner, self._parts, self._codes
            self._codes = None if codes is None else codes.copy()
            copies = {part: layers.copy() for part, layers in (parts | added).items()}
            try:
                self._parts = copies
                self._window.move_to(scan.corner, *self._layers)
                for part, layers in copies.items():
                    self._update_by_any_rule(layers, measured.get(part), scan, reliability)
            except BaseException:
                self._window.corner, self._parts, self._codes = before, parts, codes
                raise
        self._now = now
        if isinstance(grid, CombinedGrid):
            self._combine = grid.combine
        self._note_causes(grid, whole_scan)

    def _measured(self, grid: EvidentialGrid) -> dict[int, NDArray[np.float32]]:
        """Return the masses of a scan by the part of the map that they belong to."""
        if not isinstance(grid, CombinedGrid):
            return {PLANE if grid.in_plane else PLAIN: grid.known[1]}
        known = sum(part > PLAIN for part in self._parts)
        if known and known != len(grid.parts):
            raise ValueError(
                f"the map holds {known} models, each by itself, but the grid is combined of {len(grid.parts)}; "
                "call reset() before another model"
            )
        return dict(enumerate(grid.parts, PLAIN + 1))

    def _update(
        self, layers: PartLayers, mass: NDArray[np.float32] | None, scan: CheckedScan, reliability: float
    ) -> None:
        """Age a part where the scan may reach, and fuse the masses of a scan into it, if it has any."""
        rows = layers.rows
        if scan.elapsed < 0:  # it changes no conflict
            age_blocks(rows, self._memory(0.0))
            rows = rows._replace(conflict=rows.conflict.copy())
        evidential_update(
            rows,
            self._window.ring,
            self._lookup(mass, scan),
            float(reliability),
            self._memory(max(scan.elapsed, 0.0)),
            _COMPILED[self.rule],
            1.0 - self.min_unknown,
        )

    def _age_all(self) -> None:
        """Age what has waited since no scan reached it."""
        if self.rule in _COMPILED:
            for layers in self._parts.values():
                age_blocks(layers.rows, self._memory(0.0))

    def _update_by_any_rule(
        self, layers: PartLayers, mass: NDArray[np.float32] | None, scan: CheckedScan, reliability: float
    ) -> None:
        """Do the same in numpy, by a rule that is only a function of two masses: the reference of the compiled pass."""
        measured = np.empty_like(layers.mass)
        gather(self._lookup(mass, scan), self._window.ring, measured.reshape(len(measured), -1))
        measured *= np.float32(reliability)
        aging: Aging = shares_left(self._memory(0.0), max(scan.elapsed, 0.0))
        excess = layers.conflict[..., 0] - layers.conflict[..., 1]
        decayed = layers.mass.copy()
        decayed[..., 1] *= np.exp(-aging.dynamic_decay * np.maximum(excess, 0))
        aged = self._aged(decayed, max(scan.elapsed, 0.0))
        if self.forget == "observed":
            aged = np.where(measured.sum(axis=-1, keepdims=True) > 0, aged, decayed)
        fused = aged if mass is None else _bounded(self._by_rule(aged, measured), self.min_unknown)
        layers.mass[:] = fused
        if scan.elapsed < 0:
            return
        contradicted = aged * measured[..., ::-1]  # free then and occupied now, occupied then and free now
        np.maximum(layers.conflict * np.float32(aging.keep_conflict), contradicted, out=layers.conflict)

    def _lookup(self, mass: NDArray[np.float32] | None, scan: CheckedScan) -> ScanLookup:
        """Return the masses of a scan, of which what is late has aged, at the cells of the window."""
        if mass is None:
            return ScanLookup(_NOTHING, _NOWHERE, 1)
        if scan.elapsed < 0:
            mass = self._aged(mass, -scan.elapsed)
        values = np.ascontiguousarray(mass).view()
        values.flags.writeable = False  # as masses of some grids are: the kernel is compiled for one type
        return ScanLookup(values, scan.affine, scan.samples)

    def _memory(self, elapsed: float) -> Memory:
        """Return how the map forgets, and the time of a scan [s after the last one]."""
        evidence, observed = self.discounting is discount_evidence, self.forget == "observed"
        half_lives = *self.half_life, self.moving_half_life, self.conflict_half_life
        return Memory(*half_lives, evidence, observed, elapsed, self._now + elapsed)

    def _kept(self, seconds: float) -> tuple[float, float]:
        """Return the shares of free and of occupied that are left after some time."""
        return 0.5 ** (seconds / self.half_life[0]), 0.5 ** (seconds / self.half_life[1])

    def _by_rule(self, aged: NDArray[np.float32], measured: NDArray[np.float32]) -> NDArray[np.float32]:
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


def _beside_plane(whole: NDArray[np.float32], plane: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the masses of a map and of another in a plane alone: free of neither takes from occupied of the other."""
    mass = np.maximum(whole, plane)
    mass[..., 0] = np.minimum(mass[..., 0], 1 - mass[..., 1])
    return mass


def _half_lives(half_life: float | Sequence[float]) -> tuple[float, float]:
    both = (half_life, half_life) if isinstance(half_life, int | float | np.number) else tuple(half_life)
    if len(both) != 2 or not all(one > 0 for one in both):
        raise ValueError(
            f"half_life must be greater than 0 s, one number or two (free, occupied), got {half_life}; "
            "infinity forgets nothing"
        )
    return float(both[0]), float(both[1])
