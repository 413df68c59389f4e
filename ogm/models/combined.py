"""Combination of several sensor models: each maps the scan, and their masses are combined cell by cell.

>>> from ogm import GridSpec, Mount, load_model
>>> from ogm.models.combined import CombinedISM
>>> spec, mount = GridSpec.centered(), Mount(1.9)
>>> ray, band = (load_model(name, spec, mount) for name in ("ray", "height-band"))
>>> both = CombinedISM([ray, band], reliability=[1.0, (0.5, 0.8)])
>>> both.spec == spec
True

The models map the same scan, so they are not independent, as Dempster's rule assumes. Reliabilities below 1, fitted to
labelled frames, compensate for it. ``benchmarks/combined.py`` measures the calibration of the result.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.evidence import check_mass, dempster
from ogm.evidence.kernels import FLOAT32
from ogm.evidence.kernels import RULES as COMPILED
from ogm.grid import CombinedGrid, GridSpec
from ogm.jit import log_compilation, vector
from ogm.scan import InverseSensorModel, Scan, as_scan

Rule = Callable[..., Any]
dempster_cell, yager_cell, cumulative_cell, cautious_cell = (rule.cell for rule in COMPILED.values())
HIT = 0.5  # mass of occupied above which a cell is a hit


class StateReliability(NamedTuple):
    """Factors in [0, 1] for a model's masses of free and occupied (Shafer's discounting, per state)."""

    free: float = 1.0
    occupied: float = 1.0


class FreeGate(NamedTuple):
    """Factor for a model's mass of free, by the support of the other models.

    The support of a cell is its greatest mass of free in any other model.

    Attributes
    ----------
    share : float
        Factor without support, [0, 1]. With 1 the gate is open everywhere.
    low, high : float
        Support up to which the factor is `share`, and from which it is 1; linear between. 0 <= low < high.
    """

    share: float
    low: float = 0.0
    high: float = 1.0


OPEN = FreeGate(1.0)


@dataclass(frozen=True)
class Combination:
    """Function that combines the masses of several models, one array per model.

    Attributes
    ----------
    rule : function
    weights : tuple of (StateReliability, FreeGate)
        One pair for each model.
    keep_hits : int or None
        See `CombinedISM`.
    """

    rule: Rule
    weights: tuple[tuple[StateReliability, FreeGate], ...]
    keep_hits: int | None

    def __call__(self, masses: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
        """Combine one mass array per model.

        Parameters
        ----------
        masses : sequence of (..., 2) float32
            Arrays of equal shape, in the order of the models. Their values are not checked.

        Returns
        -------
        (..., 2) float32

        Raises
        ------
        ValueError
            If number or shapes do not fit, or a custom rule returns no masses.
        """
        if len(masses) != len(self.weights) or len({mass.shape for mass in masses}) > 1:
            got = ", ".join(str(mass.shape) for mass in masses)
            raise ValueError(f"there must be {len(self.weights)} mass arrays of one shape, got {got or 'none'}")
        rule = next((k for k, compiled in enumerate(COMPILED.values()) if compiled.arrays is self.rule), None)
        if rule is None or len(masses) != 2:
            return self._by_arrays(masses)
        log_compilation(_COMBINERS[rule])
        a, b = (np.ascontiguousarray(mass, np.float32) for mass in masses)
        out = np.empty_like(a)
        numbers = [_numbers(*self.weights[k], self.keep_hits == 1 - k) for k in (0, 1)]
        _COMBINERS[rule](a.reshape(-1), b.reshape(-1), out.reshape(-1), numbers[0], numbers[1])
        return out

    def _by_arrays(self, masses: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
        """Combine any number of masses by any rule, in plain arrays; the reference of the kernels."""
        left = np.stack(masses).astype(np.float32, copy=True)
        for k, (reliability, gate) in enumerate(self.weights):
            others = [mass[..., 0] for n, mass in enumerate(masses) if n != k]
            if others:
                support = np.max(others, axis=0)
                part = np.clip((support - gate.low) / (gate.high - gate.low), 0, 1)
                left[k, ..., 0] *= gate.share + (1 - gate.share) * part
            if self.keep_hits is not None and self.keep_hits != k:
                left[k, ..., 0][masses[self.keep_hits][..., 1] > HIT] = 0
            left[k] *= np.array(reliability, np.float32)
        if len(left) == 1:
            alone: NDArray[np.float32] = left[0]
            return alone
        combined = np.asarray(self.rule(left, axis=0), np.float32)
        check_mass(combined, name="the combined mass")
        return combined


@dataclass(frozen=True, eq=False)
class CombinedISM:
    """Inverse sensor models on one grid, combined cell by cell.

    Parameters
    ----------
    models : sequence of InverseSensorModel
        One model or more, all with the same `spec`.
    rule : function
        Combines two masses, ``rule(a, b)``, or a stack, ``rule(stack, axis=0)``: `ogm.evidence.dempster`, `yager`, ...
        Two models with `dempster`, `yager`, `cumulative` or `cautious` run in one compiled pass.
    reliability : float, or one per model
        Shafer's reliability: a number, or a pair for free and occupied (`StateReliability`).
    free_gates : sequence of FreeGate or None, optional
        Gate of each model; None does not change the model's free. By default there are no gates.
    keep_hits : int, optional
        Index of a model with protected hits: in cells with its mass of occupied above 1/2, the free of the other models
        is dropped. By default no hits are protected.

    Attributes
    ----------
    combination : Combination
        Combines one mass array per model.

    Raises
    ------
    TypeError
        If a model is no callable with a `spec`, or the rule is no function.
    ValueError
        If there is no model, the models fill different grids, or a number is out of range.

    Notes
    -----
    The masses (f, o) of each model become ``f * reliability.free * gate`` and ``o * reliability.occupied``, with the
    gate's factor by the unchanged free of the other models. The removed mass becomes unknown. The rule combines the
    results.
    """

    models: Sequence[InverseSensorModel]
    rule: Rule = dempster
    reliability: float | Sequence[float | tuple[float, float]] = 1.0
    free_gates: Sequence[FreeGate | None] | None = None
    keep_hits: int | None = None
    combination: Combination = field(init=False, repr=False)
    _shared: tuple[int | None, ...] = field(init=False, repr=False)  # index of the model whose masses each model takes

    def __post_init__(self) -> None:
        models = tuple(self.models)
        if not models:
            raise ValueError("models must contain at least one sensor model, got none")
        for model in models:
            if not (callable(model) and isinstance(getattr(model, "spec", None), GridSpec)):
                raise TypeError(f"models must be callables with a .spec, such as RayISM(spec, mount), got {model!r}")
        for a, b in combinations(models, 2):
            if a.spec != b.spec:
                raise ValueError(
                    f"all models must fill the same grid, got {a.spec} of {type(a).__name__} and {b.spec} of "
                    f"{type(b).__name__}; make them with one spec"
                )
        if not callable(self.rule):
            raise TypeError(f"rule must be a function of two masses, such as ogm.evidence.dempster, got {self.rule!r}")
        if self.keep_hits is not None and not 0 <= self.keep_hits < len(models):
            raise ValueError(f"keep_hits must be the index of a model, 0 to {len(models) - 1}, got {self.keep_hits}")
        reliability = _checked_reliability(self.reliability, len(models))
        gates = _checked_gates(self.free_gates, len(models))
        shared = tuple(
            next((k for k, other in enumerate(models[:n]) if _takes(model, other)), None)
            for n, model in enumerate(models)
        )
        combination = Combination(self.rule, tuple(zip(reliability, gates, strict=True)), self.keep_hits)
        self.__dict__.update(models=models, _shared=shared, combination=combination)

    @property
    def spec(self) -> GridSpec:
        """Cells of all models."""
        return self.models[0].spec

    def __call__(
        self, scan: Scan | NDArray[np.float32], known: Mapping[int, NDArray[np.float32]] | None = None
    ) -> CombinedGrid:
        """Map one scan by every model, and combine their grids.

        Parameters
        ----------
        scan : Scan or (N, 4) float32
            Scan for all models.
        known : mapping of int to (nx, ny, 2) float32, optional
            Masses of the scan that are computed already, by index in `models`.

        Returns
        -------
        CombinedGrid
            Combined masses and the masses of each model: an `ogm.fusion.EvidentialMapper` fuses each model in a
            separate map, and combines the maps when it is read.
        """
        scan = as_scan(scan)
        masses: list[NDArray[np.float32]] = []
        for k, (model, shared) in enumerate(zip(self.models, self._shared, strict=True)):
            if known and k in known:
                masses.append(known[k])
                continue
            grid = model(scan) if shared is None else model(scan, masses[shared])  # type: ignore[call-arg]
            masses.append(grid.mass)
        return CombinedGrid.of_parts(self.spec, masses, self.combination)

    def combine(self, masses: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
        """Combine one mass array per model; see `Combination`."""
        return self.combination(masses)


def _takes(model: InverseSensorModel, other: InverseSensorModel) -> bool:
    """Return whether a network takes the masses of another model's rays."""
    return hasattr(model, "takes_rays_of") and bool(model.takes_rays_of(other))


def _checked_reliability(given: Any, count: int) -> tuple[StateReliability, ...]:
    """Return one reliability per model."""
    each = (given,) * count if isinstance(given, int | float | np.number) else tuple(given)
    if len(each) != count:
        raise ValueError(f"reliability must be a number, or have an entry for each of {count} models, got {len(each)}")
    found = []
    for value in each:
        pair = StateReliability(*((value, value) if isinstance(value, int | float | np.number) else value))
        if not all(0 <= factor <= 1 for factor in pair):
            raise ValueError(f"reliability must lie in [0, 1], got {tuple(pair)}")
        found.append(StateReliability(*map(float, pair)))
    return tuple(found)


def _checked_gates(given: Any, count: int) -> tuple[FreeGate, ...]:
    """Return one gate per model."""
    each = (None,) * count if given is None else tuple(given)
    if len(each) != count:
        raise ValueError(f"free_gates must have an entry for each of {count} models, got {len(each)}")
    gates = tuple(OPEN if gate is None else FreeGate(*map(float, gate)) for gate in each)
    for gate in gates:
        if not (0 <= gate.share <= 1 and 0 <= gate.low < gate.high < np.inf):
            raise ValueError(f"a gate must have a share in [0, 1] and 0 <= low < high, got {gate}")
    return gates


class _Numbers(NamedTuple):
    """Numbers of a model for a kernel, in float32; the gate's slope is 1 / (high - low)."""

    free: np.float32
    occupied: np.float32
    share: np.float32
    low: np.float32
    slope: np.float32
    most_occupied: np.float32  # mass of occupied in the other model above which free is dropped


def _numbers(reliability: StateReliability, gate: FreeGate, other_is_kept: bool) -> _Numbers:
    slope = 1 / (gate.high - gate.low)
    return _Numbers(*map(np.float32, (*reliability, gate.share, gate.low, slope, HIT if other_is_kept else 2.0)))


@vector
def _kept(free: Any, other_free: Any, other_occupied: Any, n: Any) -> Any:
    """Return a cell's free after reliability, gate and protected hits."""
    zero, one = np.float32(0), np.float32(1)
    part = min(max((other_free - n.low) * n.slope, zero), one)
    left = free * (n.free * (n.share + (one - n.share) * part))
    return zero if other_occupied > n.most_occupied else left


def _combiner(rule: int) -> Any:
    """Return the kernel that combines the flat masses of two models by a rule, an index in `COMPILED`.

    The rule is a constant of the kernel, so that the other rules are not compiled.
    """

    @vector
    def combine(a: Any, b: Any, out: Any, m: _Numbers, n: _Numbers) -> None:
        one, half = np.float32(1), np.float32(0.5)
        for k in range(a.size // 2):
            f, o, g, p = a[2 * k], a[2 * k + 1], b[2 * k], b[2 * k + 1]
            first, second = _kept(f, g, p, m), _kept(g, f, o, n)
            if rule == 0:
                free, occupied, whole = dempster_cell(FLOAT32, first, m.occupied * o, second, n.occupied * p)
            elif rule == 1:
                free, occupied, whole = yager_cell(FLOAT32, first, m.occupied * o, second, n.occupied * p)
            elif rule == 2:
                free, occupied, whole = cumulative_cell(FLOAT32, first, m.occupied * o, second, n.occupied * p)
            else:
                free, occupied, whole = cautious_cell(FLOAT32, first, m.occupied * o, second, n.occupied * p)
            scale = one / max(whole, free + occupied)
            out[2 * k] = half if whole == 0 else free * scale
            out[2 * k + 1] = half if whole == 0 else occupied * scale

    return combine


_COMBINERS = tuple(map(_combiner, range(len(COMPILED))))
