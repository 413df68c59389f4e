"""The map of belief masses: fuses measurement grids of a moving vehicle and forgets at a given rate.

The map stays aligned with the world and scrolls by whole cells, so driving does not blur it. `EvidentialMapper.view`
returns it in the vehicle's axes, resampled once.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.evidence import cautious, cumulative, dempster, discount, discount_evidence, revise, smooth, yager
from ogm.fusion.kernels import (
    CONFIRMED,
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
DYNAMIC_DECAY_RATIO = 100.0  # default half-life of occupied over `moving_half_life`
_RULES: tuple[Rule, ...] = dempster, yager, cumulative, cautious, revise, smooth
_COMPILED = {rule: code for code, rule in enumerate(_RULES)}  # codes of `ogm.fusion.kernels.combine_cells`
_NO_MASS = np.zeros((1, 1, 2), np.float32)
_NO_MASS.flags.writeable = False
_NO_CAUSE = np.zeros((1, 1), np.uint8)
_NOWHERE = np.array([[1.0, 0.0, 1e9], [0.0, 1.0, 1e9]])  # affine map to cells outside of `_NO_MASS`


class EvidentialMapper(Mapper):
    """Map of belief masses that fuses scan after scan.

    Each `update` ages the map by the time since the last scan, combines it with the new measurement grid, bounds the
    known mass, and records the conflict between the two.

    Parameters
    ----------
    spec : GridSpec
        The window: relative to the vehicle if it rolls, in map coordinates if it is fixed. The measurement grids may
        have other extents and resolutions.
    rule : function
        Combines two masses, ``rule(map, scan)``. The functions `dempster`, `yager`, `cumulative`, `cautious`, `revise`
        and `smooth` of `ogm.evidence` are compiled; other functions of two (..., 2) arrays are 10 times slower or more.
        Open-world rules return triples: close them, ``lambda a, b: close_world(conjunctive(a, b))``. The default treats
        scans as dependent: weak evidence that every scan repeats, such as rays over a roof, does not become certainty.
    half_life : float or (free, occupied)
        Time in which belief halves [s]; infinity forgets nothing.
    moving_half_life : float
        Half-life [s] of occupied in cells that were free and became occupied: it applies in full where the conflict
        free -> occupied exceeds occupied -> free by 1, and in proportion to a smaller excess. It removes the trails of
        moving objects from cells that are no longer measured; infinity keeps them. By default a hundredth of the
        half-life of occupied, so a map with infinite half-life forgets nothing.
    conflict_half_life : float
        Half-life of the conflict layers [s]; 0 keeps only the conflict of the last scan.
    discounting : {discount, discount_evidence}
        Fading quantity: the mass (Shafer), or the evidence, which `cumulative` adds up.
    forget : {"everywhere", "observed"}
        Cells that fade: all, or only the cells that the present scan observes.
    min_unknown : float
        Lower bound of unknown, [0, 1), so that new scans can change the map. With Dempster's rule the number of scans
        needed for a change grows with the logarithm of its inverse; at 0 it may be infinite in float32.
    window : {"rolling", "fixed"}
        Follow the vehicle, or stay in place, for a yard or a whole drive. Both take the memory of one grid.
    max_speed : float
        Greatest speed of the vehicle [m/s]; a pose beyond its reach is a jump.
    max_delay : float
        Greatest age of a scan relative to the map [s].

    Raises
    ------
    ValueError
        If a number is out of its range, or a name is not one of the choices.

    Notes
    -----
    Stamps. A repeated stamp is a scan of the same moment, by another sensor: nothing ages. A scan up to `max_delay`
    older than the map is first aged to the map's time; it moves no window and changes no conflict layer. ValueError is
    raised for an older scan, a missing stamp (unless the map never forgets), a gap of more than a day, and NaN. After a
    stamp that was wrong by hours, all later scans are refused until `reset`. A pose jump raises `PoseJump`. After an
    error the map is unchanged.

    Planes. Scans that are free only in the plane of a laser (`EvidentialGrid.in_plane`) have a map of their own. The
    two maps are joined when read: each state takes its greater mass, and free at most 1 - occupied. So a laser that
    sees between the legs of a table never clears the table top that a depth camera saw.

    Threads. One thread may update the map while other threads read it. Each property and method returns a consistent
    state, from before or after an update. To read several values of the same state use ``with mapper.lock:``.
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
        self._combine: Combine | None = None  # combines the parts of several models
        self._meta: dict[str, str] = {}  # of the last scan that has facts
        self._waiting: dict[int, PartLayers] | None = None  # parts of a saved map, until the first scan
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
            The map in map coordinates, see `ogm.io.read_placed_grid`. It ages from its stamp to the first scan; without
            a stamp it does not. `layers` hold its conflict and the maps of several models. Without them the conflict
            is 0, and scans of several models are joined with the saved map as with one more model.
        spec : GridSpec, optional
            The window, see `EvidentialMapper`; by default as many cells as the map has. Cells that differ from the
            cells of the map take the least free and the greatest occupied (`ogm.fusion.resampled`).
        window : {"rolling", "fixed"}
        T_map_vehicle : (4, 4) array, optional
            First pose of a rolling window; by default the middle of the map.
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
        The state equals that of the saved mapper to the last bit: later scans change both in the same way. A file holds
        neither the vehicle's pose, which is needed to detect jumps, nor the number of scans.
        """
        placed = PlacedGrid.of(saved).upright
        placed.evidential  # noqa: B018  raises without masses
        (nx, ny), side = placed.grid.spec.shape, placed.grid.spec.resolution
        if spec is None:
            spec = placed.grid.spec if window == "fixed" else GridSpec(side, (nx, ny), (-nx * side / 2, -ny * side / 2))
        mapper = cls(spec, window=window, **settings)
        x0, x1, y0, y1 = placed.grid.spec.extent
        start = pose((x0 + x1) / 2, (y0 + y1) / 2) if T_map_vehicle is None else check_pose(T_map_vehicle)
        mapper._window.corner = mapper._window.corner_around(start)
        if not overlaps(affine_between(mapper.spec, placed.grid.spec, np.eye(4)), mapper.spec, placed.grid.spec):
            raise ValueError(
                f"the map, {placed.grid.spec}, has no cell in the window, {mapper.spec}: give the window or "
                "T_map_vehicle in the coordinates of this map"
            )
        bands = resampled(placed, mapper.spec).bands
        whole, parts = parts_of_bands(bands, mapper._window.ring)
        mapper._parts, mapper._waiting = {PLAIN: whole}, parts
        mapper._gate.stamp = placed.stamp
        return mapper

    @property
    @locked
    def layers(self) -> LayeredGrid:
        """Layers that `from_grid` needs in addition to `grid`: conflict, and the maps of several models."""
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
        """The map after the last scan (a copy), in map coordinates."""
        self._age_all()
        masses = {part: self._window.unrolled(layers.mass) for part, layers in self._parts.items()}
        return EvidentialGrid.trusted(self.spec, self._combined(masses, self._window.spec0.shape)).with_meta(self._meta)

    @locked
    def view(
        self,
        spec: GridSpec | None = None,
        T_map_vehicle: ArrayLike | None = None,  # noqa: N803
        *,
        method: ResampleMethod = "nearest",
    ) -> EvidentialGrid:
        """Return the map in the vehicle's axes, see `Mapper.view`. Maps of several models are combined afterwards."""
        cells, T = self._around(spec, T_map_vehicle)
        self._age_all()
        masses = {
            part: view_layers(self._window.unrolled(layers.mass), self.spec, cells, T, method)
            for part, layers in self._parts.items()
        }
        return EvidentialGrid.trusted(cells, self._combined(masses, cells.shape)).with_meta(self._meta)

    @locked
    def reset(self) -> None:
        """Forget everything: the next scan begins a new map, with any model."""
        super().reset()
        self._parts, self._waiting, self._combine, self._now, self._codes = {}, None, None, 0.0, None
        self._meta = {}

    @property
    @locked
    def cause(self) -> LayeredGrid:
        """Layer ``cause``: why cells of `grid` are unknown, as codes of `ogm.UnknownCause`.

        A formerly known cell is contradicted if the conflict exceeded 1/4 when it was lost, else forgotten. Other
        cells have the cause of the last scan that covered them.

        Raises
        ------
        ValueError
            If no grid had causes: the sensor model must be an `ogm.models.ExplainedISM`.
        """
        if self._codes is None:
            raise ValueError("no scan of the map has causes: use the sensor model ogm.models.ExplainedISM(model)")
        self._age_all()
        codes = self._codes.copy()
        note_causes(codes, self._whole(), self._whole_conflict(), self._window.ring, _NO_CAUSE, _NOWHERE)
        codes[codes == 0] = UnknownCause.OUTSIDE_VIEW
        codes[codes == CONFIRMED] = UnknownCause.KNOWN
        return LayeredGrid(self.spec, {"cause": self._window.unrolled(codes.astype(np.float32))})

    @property
    def has_causes(self) -> bool:
        """Whether `cause` is available."""
        return self._codes is not None

    @property
    def _layers(self) -> Sequence[NDArray[Any]]:
        layers: list[NDArray[Any]] = [array for layers in self._parts.values() for array in layers[:2]]
        return layers if self._codes is None else [*layers, self._codes]

    def _conflict_layers(self) -> NDArray[np.float32]:
        self._age_all()
        return self._window.unrolled(self._whole_conflict())

    def _whole(self) -> NDArray[np.float32]:
        """Return the masses of the map in buffer order."""
        masses = {part: layers.mass for part, layers in self._parts.items()}
        return self._combined(masses, self._window.spec0.shape)

    def _whole_conflict(self) -> NDArray[np.float32]:
        """Return the conflict of the map in buffer order: the greatest of its parts."""
        if len(self._parts) == 1:
            return next(iter(self._parts.values())).conflict
        conflict = np.zeros((*self._window.spec0.shape, 2), np.float32)
        for layers in self._parts.values():
            np.maximum(conflict, layers.conflict, out=conflict)
        return conflict

    def _note_causes(self, grid: EvidentialGrid, scan: CheckedScan) -> None:
        """Record why cells are unknown, once a grid with causes was fused."""
        if grid.cause is not None and self._codes is None:
            self._codes = np.zeros(self._window.spec0.shape, np.uint8)
        if self._codes is None or scan.elapsed < 0:
            return
        cause, affine = (_NO_CAUSE, _NOWHERE) if grid.cause is None else (grid.cause, scan.affine)
        note_causes(self._codes, self._whole(), self._whole_conflict(), self._window.ring, cause, affine)

    def _combined(self, masses: Mapping[int, NDArray[np.float32]], shape: tuple[int, int]) -> NDArray[np.float32]:
        """Return the masses of the map from the masses of its parts."""
        whole, plane = masses.get(PLAIN), masses.get(PLANE)
        if self._combine is not None:
            combined = self._combine([mass for part, mass in sorted(masses.items()) if part > PLAIN])
            whole = combined if whole is None else cautious(combined, whole)
        if whole is None:
            return np.zeros((*shape, 2), np.float32) if plane is None else plane
        return whole if plane is None else _joined_with_plane(whole, plane)

    def _fuse(self, grid: EvidentialGrid, scan: CheckedScan, reliability: float) -> None:
        corner, measured, whole_scan = grid.known[0], self._measured(grid), scan
        if self._waiting is not None:
            self._parts, self._waiting = continued_parts(self._parts[PLAIN], self._waiting, measured.keys()), None
            for layers in self._parts.values():  # masses of other programs may leave nothing to unknown
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
        self._meta = grid.meta or self._meta
        self._note_causes(grid, whole_scan)

    def _measured(self, grid: EvidentialGrid) -> dict[int, NDArray[np.float32]]:
        """Return the masses of a scan by part of the map."""
        if not isinstance(grid, CombinedGrid):
            return {PLANE if grid.in_plane else PLAIN: grid.known[1]}
        known = sum(part > PLAIN for part in self._parts)
        if known and known != len(grid.parts):
            raise ValueError(
                f"the map holds {known} models, but the grid is combined of {len(grid.parts)}; call reset() before "
                "another model"
            )
        return dict(enumerate(grid.parts, PLAIN + 1))

    def _update(
        self, layers: PartLayers, mass: NDArray[np.float32] | None, scan: CheckedScan, reliability: float
    ) -> None:
        """Age a part within reach of the scan, and fuse masses of the scan into it, if any."""
        rows = layers.rows
        if scan.elapsed < 0:  # a late scan changes no conflict
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
        """Age the cells that no recent scan reached."""
        if self.rule in _COMPILED:
            for layers in self._parts.values():
                age_blocks(layers.rows, self._memory(0.0))

    def _update_by_any_rule(
        self, layers: PartLayers, mass: NDArray[np.float32] | None, scan: CheckedScan, reliability: float
    ) -> None:
        """Update a part in numpy, by any function of two masses: the reference of the compiled pass."""
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
        contradicted = aged * measured[..., ::-1]  # free -> occupied, occupied -> free
        np.maximum(layers.conflict * np.float32(aging.keep_conflict), contradicted, out=layers.conflict)

    def _lookup(self, mass: NDArray[np.float32] | None, scan: CheckedScan) -> ScanLookup:
        """Return the masses of a scan at the cells of the window; a late scan is aged."""
        if mass is None:
            return ScanLookup(_NO_MASS, _NOWHERE, 1)
        if scan.elapsed < 0:
            mass = self._aged(mass, -scan.elapsed)
        values = np.ascontiguousarray(mass).view()
        values.flags.writeable = False  # one type for the kernel: some grids have read-only masses
        return ScanLookup(values, scan.affine, scan.samples)

    def _memory(self, elapsed: float) -> Memory:
        """Return the forgetting parameters and the time of a scan, `elapsed` [s] after the last scan."""
        evidence, observed = self.discounting is discount_evidence, self.forget == "observed"
        half_lives = *self.half_life, self.moving_half_life, self.conflict_half_life
        return Memory(*half_lives, evidence, observed, elapsed, self._now + elapsed)

    def _by_rule(self, aged: NDArray[np.float32], measured: NDArray[np.float32]) -> NDArray[np.float32]:
        """Apply a rule without a kernel, and check that it returns masses."""
        new = np.asarray(self.rule(aged, measured))
        if new.shape != aged.shape or new.dtype.kind != "f":
            name = getattr(self.rule, "__name__", repr(self.rule))
            hint = "; close it: lambda a, b: close_world(rule(a, b))" if new.shape[-1:] == (3,) else ""
            raise ValueError(
                f"rule {name} must return masses of shape {aged.shape}, got {new.dtype} of {new.shape}{hint}"
            )
        return EvidentialGrid(self._window.spec0, new).mass

    def _aged(self, mass: NDArray[np.float32], seconds: float) -> NDArray[np.float32]:
        """Return the masses that remain after a time [s]."""
        kept = mass * np.array([0.5 ** (seconds / half_life) for half_life in self.half_life], np.float32)
        if self.discounting is discount:
            return kept
        total = np.maximum(1 - mass.sum(axis=-1, keepdims=True), 0) + kept.sum(axis=-1, keepdims=True)
        return (kept / np.where(total > 0, total, 1)).astype(np.float32, copy=False)


def _bounded(mass: NDArray[np.float32], min_unknown: float) -> NDArray[np.float32]:
    """Scale masses down so that unknown is at least `min_unknown`."""
    known = mass.sum(axis=-1, keepdims=True)
    limit = np.float32(1 - min_unknown)
    bounded: NDArray[np.float32] = mass * np.minimum(1, limit / np.maximum(known, limit)).astype(np.float32)
    return bounded


def _joined_with_plane(whole: NDArray[np.float32], plane: NDArray[np.float32]) -> NDArray[np.float32]:
    """Join the masses of a map with the masses of a plane: free of one never reduces occupied of the other."""
    mass = np.maximum(whole, plane)
    mass[..., 0] = np.minimum(mass[..., 0], 1 - mass[..., 1])
    return mass


def _half_lives(half_life: float | Sequence[float]) -> tuple[float, float]:
    both = (half_life, half_life) if isinstance(half_life, int | float | np.number) else tuple(half_life)
    if len(both) != 2 or not all(seconds > 0 for seconds in both):
        raise ValueError(
            f"half_life must be greater than 0 s, one number or two (free, occupied), got {half_life}; "
            "infinity forgets nothing"
        )
    return float(both[0]), float(both[1])
