"""Numba kernels of the maps: one pass over the window per scan, row by row while a row is in the cache.

Maps are kept as ring buffers of rows: `state` is (nx, 2 ny) with free and occupied in turn (or (nx, ny) log-odds),
and the window's cell (i, j) stands at row (i + row) mod nx, cell (j + column) mod ny. `affine` (2, 3) takes the middle
of a window cell, (i + 1/2, j + 1/2, 1), to the cell coordinates of the scan. Nothing is checked here.
"""

from typing import Any

import numpy as np
from numba import njit

from ogm.evidence.kernels import agreement, cumulative_cell

__all__ = [
    "CAUTIOUS",
    "CUMULATIVE",
    "DEMPSTER",
    "YAGER",
    "bayes_update",
    "evidential_update",
    "gather",
    "log_odds_of",
]

DEMPSTER, YAGER, CUMULATIVE, CAUTIOUS = 0, 1, 2, 3
# Added and taken away, it makes zeros of numbers so small that they would slow a loop down.
TINY = np.float32(1e-18)
LEAST = np.float32(1e-6)  # what the cautious rule reads unknown as at least, as the plain one does
DOGMATIC = np.float32(4 * 2.0**-23)  # an unknown as good as zero
A, B, C = np.float32(1 / 2), np.float32(1 / 6), np.float32(1 / 24)  # of the series of exp
EPS_CELL = 1e-6  # of a cell, so that rounding does not decide where middles of cells fall on edges of others

_jit = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})


@_jit
def evidential_update(
    state: np.ndarray,
    conflict: np.ndarray,
    row: int,
    column: int,
    scan: np.ndarray,
    affine: np.ndarray,
    samples: int,
    rule: int,
    keep_free: float,
    keep_occupied: float,
    leaving: float,
    evidence: bool,
    observed: bool,
    reliability: float,
    known_limit: float,
    fade: float,
) -> None:
    """Age a map, fuse a scan into it, and keep where the two contradict each other.

    Parameters
    ----------
    state, conflict : (nx, 2 ny) float32
        Masses (free, occupied), and (free -> occupied, occupied -> free); both are changed in place.
    row, column : int
        Where the window's cell (0, 0) stands.
    scan : (mx, my, 2) float32
        Masses of the measurement grid.
    affine : (2, 3) float64
    samples : int
        Points per cell and axis at which the scan is looked up; their mean counts.
    rule : int
        `DEMPSTER`, `YAGER`, `CUMULATIVE` or `CAUTIOUS`.
    keep_free, keep_occupied : float
        What ageing leaves of the beliefs, or of the evidence if `evidence`, [0, 1].
    leaving : float
        What came may leave: occupied falls by exp(-leaving * excess), with the excess of the conflict
        free -> occupied over occupied -> free.
    evidence, observed : bool
        Whether evidence fades, not mass; whether only cells fade of which the scan says something.
    reliability : float
        Shafer's discount of the scan, [0, 1].
    known_limit : float
        The most that free + occupied may be, [0, 1].
    fade : float
        What is left of the conflict layers, [0, 1].
    """
    nx, ny = state.shape[0], state.shape[1] // 2
    one = np.float32(1)
    kf, ko, gone = np.float32(keep_free), np.float32(keep_occupied), np.float32(leaving)
    w, limit, left = np.float32(reliability), np.float32(known_limit), np.float32(fade)
    z = np.zeros(2 * ny, np.float32)
    plain = not (observed or evidence)
    first = ny - column  # window cells that stand before the end of the row
    for i in range(nx):
        at = (i + row) % nx
        low, high = _look_up(z, scan, affine, i, ny, samples)
        if w != 1:
            _scale(z[2 * low : 2 * high], w)
        for part in range(2):
            a, b = (0, first) if part == 0 else (first, ny)  # cells of the window
            shift = column if part == 0 else column - ny  # to their place in the row
            if a >= b:
                continue
            m = state[at, 2 * (a + shift) : 2 * (b + shift)]
            c = conflict[at, 2 * (a + shift) : 2 * (b + shift)]
            if gone > 0 and not plain:
                _leave(m, c, one, gone)
            if plain and gone > 0:
                _leave_and_age(m, c, one, gone, kf, ko, left)
            elif plain:
                _age(m, c, kf, ko, left)
            elif observed:
                _age_observed(m, c, z[2 * a : 2 * b], one, kf, ko, left, evidence)
            else:
                _age_evidence(m, c, one, kf, ko, left)
            a, b = max(a, low), min(b, high)
            if a >= b:
                continue
            m = state[at, 2 * (a + shift) : 2 * (b + shift)]
            c = conflict[at, 2 * (a + shift) : 2 * (b + shift)]
            if rule == DEMPSTER:
                _dempster(m, c, z[2 * a : 2 * b], one, limit)
            elif rule == YAGER:
                _yager(m, c, z[2 * a : 2 * b], one, limit)
            elif rule == CUMULATIVE:
                _cumulative(m, c, z[2 * a : 2 * b], one, limit)
            else:
                _cautious(m, c, z[2 * a : 2 * b], one, limit)
        z[:] = 0


@_jit
def _scale(numbers: Any, factor: Any) -> None:
    for k in range(numbers.size):
        numbers[k] *= factor


@_jit
def _stay(one: Any, part: Any, excess: Any) -> Any:
    # exp(x) as (1 + y + y^2 / 2 + ...)^16 with y = x / 16: plain arithmetic, which runs on vector units
    y = part * max(excess, one - one)
    e = one + y * (one + y * (A + y * (B + y * C)))
    e *= e
    e *= e
    e *= e
    return one / (e * e)


@_jit
def _leave(m: Any, c: Any, one: Any, gone: Any) -> None:
    part = gone / np.float32(16)
    for k in range(m.size // 2):
        m[2 * k + 1] *= _stay(one, part, c[2 * k] - c[2 * k + 1])


@_jit
def _leave_and_age(m: Any, c: Any, one: Any, gone: Any, kf: Any, ko: Any, left: Any) -> None:
    part = gone / np.float32(16)
    for k in range(m.size // 2):
        came, went = c[2 * k], c[2 * k + 1]
        m[2 * k] = (m[2 * k] * kf + TINY) - TINY
        m[2 * k + 1] = (m[2 * k + 1] * (ko * _stay(one, part, came - went)) + TINY) - TINY
        c[2 * k], c[2 * k + 1] = (came * left + TINY) - TINY, (went * left + TINY) - TINY


@_jit
def _age(m: Any, c: Any, kf: Any, ko: Any, left: Any) -> None:
    for k in range(m.size // 2):
        m[2 * k] = (m[2 * k] * kf + TINY) - TINY
        m[2 * k + 1] = (m[2 * k + 1] * ko + TINY) - TINY
        c[2 * k] = (c[2 * k] * left + TINY) - TINY
        c[2 * k + 1] = (c[2 * k + 1] * left + TINY) - TINY


@_jit
def _age_evidence(m: Any, c: Any, one: Any, kf: Any, ko: Any, left: Any) -> None:
    for k in range(m.size // 2):
        f, o = m[2 * k], m[2 * k + 1]
        total = max(one - (f + o), one - one) + (kf * f + ko * o)
        scale = one / total if total > 0 else one
        m[2 * k] = (kf * f * scale + TINY) - TINY
        m[2 * k + 1] = (ko * o * scale + TINY) - TINY
        c[2 * k] = (c[2 * k] * left + TINY) - TINY
        c[2 * k + 1] = (c[2 * k + 1] * left + TINY) - TINY


@_jit
def _age_observed(m: Any, c: Any, z: Any, one: Any, kf: Any, ko: Any, left: Any, evidence: bool) -> None:
    for k in range(m.size // 2):
        seen = z[2 * k] + z[2 * k + 1] > 0
        f, o = m[2 * k], m[2 * k + 1]
        free, occupied = (kf if seen else one) * f, (ko if seen else one) * o
        total = one
        if evidence:
            total = max(one - (f + o), one - one) + (free + occupied)
            total = total if total > 0 else one
        m[2 * k] = (free / total + TINY) - TINY
        m[2 * k + 1] = (occupied / total + TINY) - TINY
        c[2 * k] = (c[2 * k] * left + TINY) - TINY
        c[2 * k + 1] = (c[2 * k + 1] * left + TINY) - TINY


@_jit
def _dempster(m: Any, c: Any, z: Any, one: Any, limit: Any) -> None:
    for k in range(m.size // 2):
        f, o, g, p = m[2 * k], m[2 * k + 1], z[2 * k], z[2 * k + 1]
        c[2 * k], c[2 * k + 1] = max(c[2 * k], f * p), max(c[2 * k + 1], o * g)
        free, occupied, unknown = agreement(one, f, o, g, p)
        known = free + occupied
        whole = known + unknown
        half = limit / (one + one)
        scale = limit / max(limit * whole, known)  # 1 / whole, or limit / known where that is less
        m[2 * k] = half if whole == 0 else free * scale
        m[2 * k + 1] = half if whole == 0 else occupied * scale


@_jit
def _yager(m: Any, c: Any, z: Any, one: Any, limit: Any) -> None:
    for k in range(m.size // 2):
        f, o, g, p = m[2 * k], m[2 * k + 1], z[2 * k], z[2 * k + 1]
        c[2 * k], c[2 * k + 1] = max(c[2 * k], f * p), max(c[2 * k + 1], o * g)
        free, occupied, _ = agreement(one, f, o, g, p)
        scale = limit / max(limit, free + occupied)
        m[2 * k], m[2 * k + 1] = free * scale, occupied * scale


@_jit
def _cumulative(m: Any, c: Any, z: Any, one: Any, limit: Any) -> None:
    for k in range(m.size // 2):
        f, o, g, p = m[2 * k], m[2 * k + 1], z[2 * k], z[2 * k + 1]
        c[2 * k], c[2 * k + 1] = max(c[2 * k], f * p), max(c[2 * k + 1], o * g)
        free, occupied = cumulative_cell(one, f, o, g, p, DOGMATIC)
        scale = limit / max(limit, free + occupied)
        m[2 * k], m[2 * k + 1] = free * scale, occupied * scale


@_jit
def _cautious(m: Any, c: Any, z: Any, one: Any, limit: Any) -> None:
    for k in range(m.size // 2):
        f, o, g, p = m[2 * k], m[2 * k + 1], z[2 * k], z[2 * k + 1]
        u, v = max(one - (f + o), LEAST), max(one - (g + p), LEAST)
        c[2 * k], c[2 * k + 1] = max(c[2 * k], f * p), max(c[2 * k + 1], o * g)
        # Both sides times u v: max(f / u, g / v) is max(f v, g u)
        free, occupied = max(f * v, g * u), max(o * v, p * u)
        known = free + occupied
        scale = limit / max(limit * (known + u * v), known)
        m[2 * k], m[2 * k + 1] = free * scale, occupied * scale


@_jit
def bayes_update(
    state: np.ndarray,
    row: int,
    column: int,
    scan: np.ndarray,
    affine: np.ndarray,
    samples: int,
    keep: float,
    observed: bool,
    low_limit: float,
    high_limit: float,
) -> None:
    """Age a map of log-odds and add those of a scan.

    Parameters
    ----------
    state : (nx, ny) float32
        Log-odds of occupied, changed in place.
    row, column, affine, samples, observed
        As for `evidential_update`.
    scan : (mx, my, 2) float32
        Log-odds of occupied, twice each (so that one way of looking up serves both kinds of map).
    keep : float
        What ageing leaves of the log-odds, [0, 1].
    low_limit, high_limit : float
        Between which log-odds are kept.
    """
    nx, ny = state.shape
    k, low_l, high_l = np.float32(keep), np.float32(low_limit), np.float32(high_limit)
    z = np.zeros(2 * ny, np.float32)
    for i in range(nx):
        line = state[(i + row) % nx]
        low, high = _look_up(z, scan, affine, i, ny, samples)
        if not observed:
            for j in range(ny):
                line[j] = (line[j] * k + TINY) - TINY
        for j in range(low, high):
            at = j + column if j < ny - column else j + column - ny
            said = z[2 * j]
            kept = line[at] * k if observed and said != 0 else line[at]
            line[at] = min(max(kept + said, low_l), high_l)
        z[:] = 0


@_jit
def log_odds_of(mass: np.ndarray, plausibility: bool, limit: float, out: np.ndarray) -> None:
    """Turn masses into the log-odds that a scan adds to a Bayesian map, in both columns of `out`.

    Parameters
    ----------
    mass : (cells, 2) float32
    plausibility : bool
        Whether the probability of occupied is the normalised plausibility, not the pignistic probability.
    limit : float
        The log-odds are kept within +- this.
    out : (cells, 2) float32
    """
    most = np.float32(limit)
    zero, half = np.float32(0), np.float32(0.5)
    for k in range(len(mass)):
        f, o = mass[k, 0], mass[k, 1]
        u = max(np.float32(1) - (f + o), zero)
        if not plausibility:
            u *= half
        value = zero
        if f != o:
            above, below = o + u, f + u
            value = most if below <= 0 else -most if above <= 0 else np.log(above / below)
        out[k, 0] = out[k, 1] = min(max(value, -most), most)


@_jit
def gather(
    scan: np.ndarray, affine: np.ndarray, samples: int, row: int, column: int, out: np.ndarray
) -> None:
    """Look a grid up at the cells of another, by its nearest cell, into `out` (nx, 2 ny); outside it is 0.

    Parameters as for `evidential_update`.
    """
    nx, ny = out.shape[0], out.shape[1] // 2
    z = np.zeros(2 * ny, np.float32)
    for i in range(nx):
        low, high = _look_up(z, scan, affine, i, ny, samples)
        line = out[(i + row) % nx]
        first = 2 * (ny - column)
        _copy(z[:first], line[2 * column :])
        _copy(z[first:], line[: 2 * column])
        z[:] = 0


@_jit
def _copy(numbers: Any, out: Any) -> None:
    for k in range(numbers.size):
        out[k] = numbers[k]


@_jit
def _look_up(
    z: np.ndarray, scan: np.ndarray, affine: np.ndarray, i: int, ny: int, samples: int
) -> tuple[int, int]:
    """Fill row i of the window with what the scan says; return the cells [low, high) that it may cover."""
    mx, my = scan.shape[0], scan.shape[1]
    said = scan.reshape(-1)
    du, dv = affine[0, 1], affine[1, 1]
    u0 = affine[0, 0] * (i + 0.5) + affine[0, 1] * 0.5 + affine[0, 2] + EPS_CELL
    v0 = affine[1, 0] * (i + 0.5) + affine[1, 1] * 0.5 + affine[1, 2] + EPS_CELL
    if samples == 1:
        low, high = _span(u0, du, mx, 0.0, 0, ny)
        low, high = _span(v0, dv, my, 0.0, low, high)
        for j in range(low, high):
            # Unsigned, so that no code for negative indices slows the loop down fourfold.
            at = np.uint64(2 * (np.int32(u0 + j * du) * np.int32(my) + np.int32(v0 + j * dv)))
            z[2 * j], z[2 * j + 1] = said[at], said[at + np.uint64(1)]
        return low, high
    reach_u = 0.5 * (abs(affine[0, 0]) + abs(du))
    reach_v = 0.5 * (abs(affine[1, 0]) + abs(dv))
    low, high = _span(u0, du, mx, reach_u, 0, ny)
    low, high = _span(v0, dv, my, reach_v, low, high)
    share = np.float32(1.0 / (samples * samples))
    for j in range(low, high):
        free, occupied = np.float32(0), np.float32(0)
        for p in range(samples):
            s = (p + 0.5) / samples - 0.5
            for q in range(samples):
                t = (q + 0.5) / samples - 0.5
                u = u0 + j * du + s * affine[0, 0] + t * du
                v = v0 + j * dv + s * affine[1, 0] + t * dv
                if 0 <= u < mx and 0 <= v < my:
                    free += scan[int(u), int(v), 0]
                    occupied += scan[int(u), int(v), 1]
        z[2 * j], z[2 * j + 1] = share * free, share * occupied
    return low, high


@_jit
def _span(start: float, step: float, size: int, reach: float, low: int, high: int) -> tuple[int, int]:
    """Narrow [low, high) to the j for which -reach <= start + j step < size + reach."""
    if step == 0:
        return (low, high) if -reach <= start < size + reach else (low, low)
    a, b = (-reach - start) / step, (size + reach - start) / step
    if a > b:
        a, b = b, a
    low = max(low, int(np.floor(min(max(a, -1.0), 2.0**31))) - 1)
    high = min(high, int(np.ceil(max(min(b, 2.0**31), -1.0))) + 2)
    while low < high and not -reach <= start + low * step < size + reach:
        low += 1
    while low < high and not -reach <= start + (high - 1) * step < size + reach:
        high -= 1
    return (low, high) if low < high else (0, 0)
