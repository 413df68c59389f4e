"""Numba kernels of the maps: one pass over the window per scan, row by row while a row is in the cache.

Maps are stored as ring buffers of rows: `state` is (nx, 2 ny) with free and occupied in turn, or (nx, ny) log-odds. The
window's cell (i, j) is at row (i + row) mod nx, cell (j + column) mod ny, with (row, column) = `ring`. The kernels
check nothing.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from ogm.evidence.kernels import FLOAT32, REVISE, RULES, SMOOTH, Rule
from ogm.fusion.lookup import EPS_CELL, ScanLookup, look_up
from ogm.jit import kernel, vector
from ogm.unknown_cause import UnknownCause

DEMPSTER, YAGER, CUMULATIVE, CAUTIOUS, REVISION, SMOOTHING = range(6)
BLOCK = 64  # cells of a row that age together
# Added and subtracted, it sets very small numbers to zero, which would slow down a loop.
TINY = np.float32(1e-18)
CONFIRMED = 255
BETWEEN_BEAMS, FORGOTTEN = int(UnknownCause.BETWEEN_BEAMS), int(UnknownCause.FORGOTTEN)
CONTRADICTED = int(UnknownCause.CONTRADICTED)
A, B, C = np.float32(1 / 2), np.float32(1 / 6), np.float32(1 / 24)  # coefficients of the series of exp


class BeliefLayers(NamedTuple):
    """A map and the time to which each block of its cells has aged.

    Attributes
    ----------
    state, conflict : (nx, 2 ny) float32
        Masses (free, occupied), and (free -> occupied, occupied -> free).
    aged : (nx, blocks) float64
        Time [s] of each block of `BLOCK` cells of a row; the last block may have fewer cells.
    """

    state: np.ndarray
    conflict: np.ndarray
    aged: np.ndarray


class Memory(NamedTuple):
    """Forgetting parameters of a map, and the time of a scan.

    Attributes
    ----------
    free, occupied, moving, conflict : float
        Half-lives [s], see `ogm.fusion.EvidentialMapper`.
    evidence, observed : bool
        Whether evidence fades instead of mass; whether only cells that the scan observes fade.
    elapsed : float
        Time since the last scan [s].
    now : float
        Time of the scan, on the clock of `aged` [s].
    """

    free: float
    occupied: float
    moving: float
    conflict: float
    evidence: bool
    observed: bool
    elapsed: float
    now: float


class Aging(NamedTuple):
    """Shares of a map that remain after some time.

    Attributes
    ----------
    keep_free, keep_occupied : float
        Remaining share of the masses, or of the evidence if `evidence`, [0, 1].
    dynamic_decay : float
        Occupied falls by exp(-dynamic_decay * excess), with the excess of the conflict free -> occupied over
        occupied -> free.
    keep_conflict : float
        Remaining share of the conflict layers, [0, 1].
    evidence, observed : bool
        Whether evidence fades instead of mass; whether only cells that the scan observes fade.
    """

    keep_free: float
    keep_occupied: float
    dynamic_decay: float
    keep_conflict: float
    evidence: bool
    observed: bool


@kernel
def shares_left(memory: Memory, seconds: float) -> Aging:
    """Return the shares of a map that remain after some time [s], and its dynamic decay."""
    free, occupied = 0.5 ** (seconds / memory.free), 0.5 ** (seconds / memory.occupied)
    if seconds == 0:  # a scan of the same moment
        return Aging(free, occupied, 0.0, 1.0, memory.evidence, memory.observed)
    keep = 0.5 ** (seconds / memory.conflict) if memory.conflict > 0 else 0.0
    decay = math.log(2.0) * max(1 / memory.moving - 1 / memory.occupied, 0.0)
    if 0 < memory.conflict < math.inf:  # the excess itself fades in the meantime
        fading = math.log(2.0) / memory.conflict
        decay = decay * -math.expm1(-fading * seconds) / fading
    else:
        decay *= seconds
    return Aging(free, occupied, decay, keep, memory.evidence, memory.observed)


def _combiner(rule: Rule) -> Any:
    """Return the compiled loop that combines rows of a map with rows of a scan by a rule."""
    cell = rule.cell

    @vector
    def combine(m: Any, c: Any, z: Any, limit: Any) -> None:
        for k in range(m.size // 2):
            f, o, g, p = m[2 * k], m[2 * k + 1], z[2 * k], z[2 * k + 1]
            c[2 * k], c[2 * k + 1] = max(c[2 * k], f * p), max(c[2 * k + 1], o * g)
            free, occupied, whole = cell(FLOAT32, f, o, g, p)
            half = np.float32(0.5) * limit
            scale = limit / max(limit * whole, free + occupied)  # 1 / whole, or limit / known if less
            m[2 * k] = half if whole == 0 else free * scale
            m[2 * k + 1] = half if whole == 0 else occupied * scale

    return combine


_dempster, _yager, _cumulative, _cautious, _revision, _smoothing = map(_combiner, (*RULES.values(), REVISE, SMOOTH))


@vector
def combine_cells(rule: int, m: Any, c: Any, z: Any, limit: Any) -> None:
    """Combine cells of a map with cells of a scan, and raise the conflict of the map to the conflict of the two.

    Parameters
    ----------
    rule : int
        `DEMPSTER`, `YAGER`, `CUMULATIVE`, `CAUTIOUS`, `REVISION` or `SMOOTHING`.
    m, c : (2 n,) float32
        Masses (free, occupied) and conflict (free -> occupied, occupied -> free) of n cells, changed in place.
    z : (2 n,) float32
        Masses of the scan.
    limit : float32
        Upper bound of free + occupied, [0, 1].
    """
    if rule == DEMPSTER:
        _dempster(m, c, z, limit)
    elif rule == YAGER:
        _yager(m, c, z, limit)
    elif rule == CUMULATIVE:
        _cumulative(m, c, z, limit)
    elif rule == CAUTIOUS:
        _cautious(m, c, z, limit)
    elif rule == REVISION:
        _revision(m, c, z, limit)
    else:
        _smoothing(m, c, z, limit)


@vector
def evidential_update(
    layers: BeliefLayers,
    ring: tuple[int, int],
    scan: ScanLookup,
    reliability: float,
    memory: Memory,
    rule: int,
    max_known: float,
) -> None:
    """Age the part of a map within reach of a scan, fuse the scan into it, and record their conflict.

    Ageing in two steps equals ageing once over the total time, so the other blocks of cells wait for `age_blocks`. This
    does not hold if only observed cells fade, or if no conflict is kept: then all cells age now.

    Parameters
    ----------
    layers : BeliefLayers
        Changed in place.
    ring : (int, int)
        Row and column of the window's cell (0, 0) in the buffer.
    scan : ScanLookup
        Masses of the scan.
    reliability : float
        Shafer's discount of the scan, [0, 1].
    memory : Memory
    rule : int
        `DEMPSTER`, `YAGER`, `CUMULATIVE`, `CAUTIOUS`, `REVISION` or `SMOOTHING`.
    max_known : float
        Upper bound of free + occupied, [0, 1].
    """
    state, conflict, aged = layers
    nx, ny = state.shape[0], state.shape[1] // 2
    row, column = ring
    w, limit = np.float32(reliability), np.float32(max_known)
    z = np.zeros(2 * ny, np.float32)
    blocks = not memory.observed and memory.conflict > 0
    shares = shares_left(memory, memory.elapsed)
    last = memory.elapsed
    first = ny - column  # window cells that are stored before the end of the row
    for i in range(nx):
        at = (i + row) % nx
        low, high = look_up(z, scan.values, scan.affine, scan.samples, i, ny)
        if w != 1:
            _scale(z[2 * low : 2 * high], w)
        for part in range(2):
            a, b = (0, first) if part == 0 else (first, ny)  # cells of the window
            shift = column if part == 0 else column - ny  # from window cells to cells of the row
            if a < b and not blocks:
                m, c = state[at, 2 * (a + shift) : 2 * (b + shift)], conflict[at, 2 * (a + shift) : 2 * (b + shift)]
                _age(m, c, z[2 * a : 2 * b], shares)
            a, b = max(a, low), min(b, high)
            if a >= b:
                continue
            if blocks:
                for k in range((a + shift) // BLOCK, (b + shift - 1) // BLOCK + 1):
                    seconds = memory.now - aged[at, k]
                    if seconds <= 0:
                        continue
                    aged[at, k] = memory.now
                    if seconds != last:
                        shares, last = shares_left(memory, seconds), seconds
                    start, stop = 2 * BLOCK * k, 2 * min(BLOCK * (k + 1), ny)
                    _age(state[at, start:stop], conflict[at, start:stop], z, shares)
            m, c = state[at, 2 * (a + shift) : 2 * (b + shift)], conflict[at, 2 * (a + shift) : 2 * (b + shift)]
            combine_cells(rule, m, c, z[2 * a : 2 * b], limit)
        z[2 * low : 2 * high] = 0


@vector
def age_blocks(layers: BeliefLayers, memory: Memory) -> None:
    """Age all blocks of cells of a map to the present time.

    Parameters
    ----------
    layers : BeliefLayers
        Changed in place.
    memory : Memory
    """
    state, conflict, aged = layers
    if memory.observed or not memory.conflict > 0:
        return
    shares, last = shares_left(memory, 0.0), 0.0
    for at in range(aged.shape[0]):
        for k in range(aged.shape[1]):
            seconds = memory.now - aged[at, k]
            if seconds <= 0:
                continue
            aged[at, k] = memory.now
            if seconds != last:
                shares, last = shares_left(memory, seconds), seconds
            m, c = state[at, 2 * BLOCK * k : 2 * BLOCK * (k + 1)], conflict[at, 2 * BLOCK * k : 2 * BLOCK * (k + 1)]
            _age(m, c, m, shares)


@vector
def _age(m: Any, c: Any, z: Any, shares: Aging) -> None:
    one = np.float32(1)
    kf, ko, kc = np.float32(shares.keep_free), np.float32(shares.keep_occupied), np.float32(shares.keep_conflict)
    decay = np.float32(shares.dynamic_decay)
    if not (shares.observed or shares.evidence):
        _decay_and_age(m, c, one, decay, kf, ko, kc)
        return
    if decay > 0:
        _decay(m, c, one, decay)
    if shares.observed:
        _age_observed(m, c, z, one, kf, ko, kc, shares.evidence)
    else:
        _age_evidence(m, c, one, kf, ko, kc)


@vector
def _scale(numbers: Any, factor: Any) -> None:
    for k in range(numbers.size):
        numbers[k] *= factor


@vector
def _kept_of_occupied(one: Any, part: Any, excess: Any) -> Any:
    # exp(x) as (1 + y + y^2 / 2 + ...)^16 with y = x / 16: plain arithmetic runs on vector units
    y = part * max(excess, one - one)
    e = one + y * (one + y * (A + y * (B + y * C)))
    e *= e
    e *= e
    e *= e
    return one / (e * e)


@vector
def _decay(m: Any, c: Any, one: Any, decay: Any) -> None:
    part = decay / np.float32(16)
    for k in range(m.size // 2):
        m[2 * k + 1] *= _kept_of_occupied(one, part, c[2 * k] - c[2 * k + 1])


@vector
def _decay_and_age(m: Any, c: Any, one: Any, decay: Any, kf: Any, ko: Any, kc: Any) -> None:
    part = decay / np.float32(16)
    for k in range(m.size // 2):
        to_occupied, to_free = c[2 * k], c[2 * k + 1]
        m[2 * k] = (m[2 * k] * kf + TINY) - TINY
        m[2 * k + 1] = (m[2 * k + 1] * (ko * _kept_of_occupied(one, part, to_occupied - to_free)) + TINY) - TINY
        c[2 * k], c[2 * k + 1] = (to_occupied * kc + TINY) - TINY, (to_free * kc + TINY) - TINY


@vector
def _age_evidence(m: Any, c: Any, one: Any, kf: Any, ko: Any, kc: Any) -> None:
    for k in range(m.size // 2):
        f, o = m[2 * k], m[2 * k + 1]
        total = max(one - (f + o), one - one) + (kf * f + ko * o)
        scale = one / total if total > 0 else one
        m[2 * k] = (kf * f * scale + TINY) - TINY
        m[2 * k + 1] = (ko * o * scale + TINY) - TINY
        c[2 * k] = (c[2 * k] * kc + TINY) - TINY
        c[2 * k + 1] = (c[2 * k + 1] * kc + TINY) - TINY


@vector
def _age_observed(m: Any, c: Any, z: Any, one: Any, kf: Any, ko: Any, kc: Any, evidence: bool) -> None:
    for k in range(m.size // 2):
        observed = z[2 * k] + z[2 * k + 1] > 0
        f, o = m[2 * k], m[2 * k + 1]
        free, occupied = (kf if observed else one) * f, (ko if observed else one) * o
        total = one
        if evidence:
            total = max(one - (f + o), one - one) + (free + occupied)
            total = total if total > 0 else one
        m[2 * k] = (free / total + TINY) - TINY
        m[2 * k + 1] = (occupied / total + TINY) - TINY
        c[2 * k] = (c[2 * k] * kc + TINY) - TINY
        c[2 * k + 1] = (c[2 * k + 1] * kc + TINY) - TINY


@kernel
def note_causes(
    codes: np.ndarray,
    mass: np.ndarray,
    conflict: np.ndarray,
    ring: tuple[int, int],
    causes: np.ndarray,
    affine: np.ndarray,
) -> None:
    """Update the codes of cells: known, or the cause why the map does not know them.

    Parameters
    ----------
    codes : (nx, ny) uint8
        Code of each cell, changed in place. `CONFIRMED`: the map knows it. `FORGOTTEN`, `CONTRADICTED`: the map knew it
        before. Else the cause of the last scan that covered it, 0 for none.
    mass, conflict : (nx, ny, 2) float32
        Masses and conflict of the map.
    ring : (int, int)
        Row and column of the window's cell (0, 0) in the buffer.
    causes : (mx, my) uint8
        `UnknownCause` of the cells of a scan.
    affine : (2, 3) float64
        See `ScanLookup`.
    """
    (nx, ny), (mx, my) = codes.shape, causes.shape
    row, column = ring
    one, quarter = np.float32(1), np.float32(0.25)
    for i in range(nx):
        at = (i + row) % nx
        u = affine[0, 0] * (i + 0.5) + affine[0, 1] * 0.5 + affine[0, 2] + EPS_CELL
        v = affine[1, 0] * (i + 0.5) + affine[1, 1] * 0.5 + affine[1, 2] + EPS_CELL
        for j in range(ny):
            c = j + column if j < ny - column else j + column - ny
            free, occupied = mass[at, c, 0], mass[at, c, 1]
            if max(free, occupied) + free + occupied > one:
                codes[at, c] = CONFIRMED
                continue
            before = codes[at, c]
            if before == CONFIRMED:
                clash = max(conflict[at, c, 0], conflict[at, c, 1]) >= quarter
                codes[at, c] = CONTRADICTED if clash else FORGOTTEN
            elif before < FORGOTTEN:
                x, y = u + j * affine[0, 1], v + j * affine[1, 1]
                if x >= 0 and x < mx and y >= 0 and y < my:
                    code = causes[int(x), int(y)]
                    codes[at, c] = code if code > 0 else max(before, np.uint8(BETWEEN_BEAMS))


@vector
def bayes_update(
    state: np.ndarray, ring: tuple[int, int], scan: ScanLookup, keep: float, observed: bool, limits: tuple[float, float]
) -> None:
    """Age a map of log-odds and add the log-odds of a scan.

    Parameters
    ----------
    state : (nx, ny) float32
        Log-odds of occupied, changed in place.
    ring, observed
        See `evidential_update`.
    scan : ScanLookup
        Log-odds of the scan.
    keep : float
        Remaining share of the log-odds, [0, 1].
    limits : (float, float)
        Lower and upper bound of the log-odds.
    """
    nx, ny = state.shape
    row, column = ring
    k, low_l, high_l = np.float32(keep), np.float32(limits[0]), np.float32(limits[1])
    z = np.zeros(ny, np.float32)
    for i in range(nx):
        line = state[(i + row) % nx]
        low, high = look_up(z, scan.values, scan.affine, scan.samples, i, ny)
        if not observed:
            for j in range(ny):
                line[j] = (line[j] * k + TINY) - TINY
        for j in range(low, high):
            at = j + column if j < ny - column else j + column - ny
            kept = line[at] * k if observed and z[j] != 0 else line[at]
            line[at] = min(max(kept + z[j], low_l), high_l)
        z[:] = 0


@vector
def log_odds_of(mass: np.ndarray, plausibility: bool, limit: float, out: np.ndarray) -> None:
    """Fill `out` with the log-odds of masses that a scan adds to a Bayesian map.

    Parameters
    ----------
    mass : (cells, 2) float32
    plausibility : bool
        Whether the probability of occupied is the normalised plausibility, else it is the pignistic probability.
    limit : float
        Bound of the absolute log-odds.
    out : (cells,) float32
    """
    bound = np.float32(limit)
    zero, half = np.float32(0), np.float32(0.5)
    for k in range(len(mass)):
        f, o = mass[k, 0], mass[k, 1]
        u = max(np.float32(1) - (f + o), zero)
        if not plausibility:
            u *= half
        value = zero
        if f != o:
            above, below = o + u, f + u
            value = bound if below <= 0 else -bound if above <= 0 else np.log(above / below)
        out[k] = min(max(value, -bound), bound)
