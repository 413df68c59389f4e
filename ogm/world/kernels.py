"""Numba kernels for map tiles: integrating a grid, merging two tiles, resampling a tile at another pose.

A tile is (7, n, n): the layers of `ogm.world.layout.LAYERS`, as uint16 or as float32. In uint16, masses are stored in
steps of 1 / `MASS_STEPS`, conflict in steps of 1 / `CONFLICT_STEPS`. The kernels check nothing.

No kernel is a closure over another: numba would compile it again in every process.
"""

from typing import Any

import numpy as np
from numba.core.types import Float
from numba.extending import overload

from ogm.fusion.kernels import combine_cells
from ogm.fusion.lookup import ScanLookup, look_up
from ogm.jit import vector

MASS_STEPS, CONFLICT_STEPS = 4095, 255  # finer steps would store noise of the sensors, and compress badly
COUNT_LIMIT = 65535


def _packed(value: Any, steps: Any, row: Any) -> Any:
    """Return a number in [0, 1] in the stored form of a tile's row; the choice is made at compile time."""
    return _as_it_is(value, steps, row) if row.dtype == np.float32 else _in_steps(value, steps, row)


def _as_it_is(value: Any, steps: Any, row: Any) -> Any:
    return value


def _in_steps(value: Any, steps: Any, row: Any) -> Any:
    return np.uint16(np.int32(value * np.float32(steps) + np.float32(0.5)))


@overload(_packed, inline="always")  # type: ignore[untyped-decorator]
def _compiled_packed(value: Any, steps: Any, row: Any) -> Any:
    return _as_it_is if isinstance(row.dtype, Float) else _in_steps


@vector
def _write_pairs(known: Any, pairs: Any, steps: Any, first: Any, second: Any) -> None:
    """Write pairs to two rows of a tile, in cells that the scan observes."""
    for k in range(first.size):  # chosen in variables and stored always: a conditional store prevents vector code
        a, b = first[k], second[k]
        packed_a, packed_b = _packed(pairs[2 * k], steps, first), _packed(pairs[2 * k + 1], steps, first)
        has = known[2 * k] + known[2 * k + 1] > np.float32(0)
        a = packed_a if has else a
        b = packed_b if has else b
        first[k], second[k] = a, b


@vector
def _mark_seen(known: Any, stamp: Any, count: Any, high: Any, low: Any) -> int:
    """Count a scan and note its stamp in cells that it observes; return the number of these cells."""
    seen = 0
    number = count.dtype.type
    high_word, low_word = number(stamp >> np.uint32(16)), number(stamp & np.uint32(0xFFFF))
    for k in range(count.size):
        has = known[2 * k] + known[2 * k + 1] > np.float32(0)
        count[k] += number(has & (count[k] < number(COUNT_LIMIT)))
        seen += has
        later = has & ((high[k] < high_word) | ((high[k] == high_word) & (low[k] < low_word)))
        high[k], low[k] = high_word if later else high[k], low_word if later else low[k]
    return seen


@vector
def _integrate(tile: Any, scan: Any, reliability: Any, rule: Any, limit: Any, stamp: Any, step: Any) -> int:
    n = tile.shape[1]
    z, m, c = np.zeros(2 * n, np.float32), np.empty(2 * n, np.float32), np.empty(2 * n, np.float32)
    changed = 0
    for i in range(n):
        low, high = look_up(z, scan.values, scan.affine, scan.samples, i, n)
        if low >= high:
            continue
        count = high - low
        known = z[2 * low : 2 * high]
        _load(tile[0, i, low:high], tile[1, i, low:high], step[0], m)
        _load(tile[2, i, low:high], tile[3, i, low:high], step[1], c)
        if reliability != 1:
            for k in range(2 * count):
                known[k] *= reliability
        combine_cells(rule, m[: 2 * count], c[: 2 * count], known, limit)
        changed += _mark_seen(known, stamp, tile[4, i, low:high], tile[5, i, low:high], tile[6, i, low:high])
        _write_pairs(known, m, MASS_STEPS, tile[0, i, low:high], tile[1, i, low:high])
        _write_pairs(known, c, CONFLICT_STEPS, tile[2, i, low:high], tile[3, i, low:high])
        z[2 * low : 2 * high] = 0
    return changed


@vector
def _merge(tile: Any, other: Any, rule: Any, limit: Any, step: Any) -> None:
    n = tile.shape[1]
    z, d = np.empty(2 * n, np.float32), np.empty(2 * n, np.float32)
    m, c = np.empty(2 * n, np.float32), np.empty(2 * n, np.float32)
    for i in range(n):
        _load(other[0, i], other[1, i], step[0], z)
        _load(other[2, i], other[3, i], step[1], d)
        _load(tile[0, i], tile[1, i], step[0], m)
        _load(tile[2, i], tile[3, i], step[1], c)
        combine_cells(rule, m, c, z, limit)
        for k in range(n):
            if tile[4, i, k] == 0:  # copied as it is: combining with unknown would round again
                for layer in range(tile.shape[0]):
                    tile[layer, i, k] = other[layer, i, k]
            elif other[4, i, k] > 0:
                tile[0, i, k] = _packed(m[2 * k], MASS_STEPS, tile)
                tile[1, i, k] = _packed(m[2 * k + 1], MASS_STEPS, tile)
                tile[2, i, k] = _packed(max(c[2 * k], d[2 * k]), CONFLICT_STEPS, tile)
                tile[3, i, k] = _packed(max(c[2 * k + 1], d[2 * k + 1]), CONFLICT_STEPS, tile)
                tile[4, i, k] = min(np.int32(tile[4, i, k]) + np.int32(other[4, i, k]), COUNT_LIMIT)
                before = (np.int64(tile[5, i, k]) << 16) | np.int64(tile[6, i, k])
                if ((np.int64(other[5, i, k]) << 16) | np.int64(other[6, i, k])) > before:
                    tile[5, i, k], tile[6, i, k] = other[5, i, k], other[6, i, k]


@vector
def _load(first: Any, second: Any, scale: Any, out: Any) -> None:
    for k in range(first.size):
        out[2 * k], out[2 * k + 1] = np.float32(first[k]) * scale, np.float32(second[k]) * scale


def _step(tile: np.ndarray) -> tuple[np.float32, np.float32]:
    """Return the values of 1 in a tile: for masses, and for conflict."""
    one = np.float32(1)
    return (one, one) if tile.dtype == np.float32 else (np.float32(1 / MASS_STEPS), np.float32(1 / CONFLICT_STEPS))


def integrate(tile: np.ndarray, scan: ScanLookup, reliability: float, rule: int, max_known: float, stamp: int) -> int:
    """Combine a measurement grid with a tile, in place; return the number of cells that it observes.

    Parameters
    ----------
    tile : (7, n, n) uint16 or float32
    scan : ScanLookup
        Masses of the grid; its affine map is from the tile's cells.
    reliability : float
        Shafer's discount of the grid, [0, 1].
    rule : int
        `ogm.fusion.kernels.DEMPSTER`, `CUMULATIVE` or `CAUTIOUS`.
    max_known : float
        Upper bound of free + occupied, [0, 1].
    stamp : int
        Stamp [s] plus 1, below 2**32; 0 if unknown. Cells keep the greatest.
    """
    numbers = np.float32(reliability), rule, np.float32(max_known), np.uint32(stamp)
    return int(_integrate(tile, scan, *numbers, _step(tile)))


def merge(tile: np.ndarray, other: np.ndarray, rule: int, max_known: float) -> None:
    """Combine a tile with another of the same cells, in place; unseen cells of the other change nothing.

    Masses are combined by the rule. The conflict is the greatest of both tiles and of the conflict between them. Counts
    are added, and the later stamp is kept. For the parameters see `integrate`.
    """
    _merge(tile, other, rule, np.float32(max_known), _step(tile))


def discount(tile: np.ndarray, reliability: float) -> None:
    """Discount the masses of a tile by Shafer's rule, in place, rounded to stored steps."""
    if reliability < 1:
        masses = tile[:2] * np.float32(reliability)
        tile[:2] = masses if tile.dtype == np.float32 else np.rint(masses)


@vector
def moved(source: np.ndarray, affine: np.ndarray, out: np.ndarray) -> int:
    """Fill a tile with the layers of the source cells at its cells' centres; return the number of seen cells.

    Parameters
    ----------
    source : (7, a, b) uint16 or float32
    affine : (2, 3) float64
        Affine map from the cells of `out` to the cells of `source`.
    out : (7, n, n)
        Output of the same type; 0 outside of the source.
    """
    _, nx, ny = out.shape
    _, mx, my = source.shape
    seen = 0
    for i in range(nx):
        u0 = affine[0, 0] * (i + 0.5) + affine[0, 1] * 0.5 + affine[0, 2] + 1e-6
        v0 = affine[1, 0] * (i + 0.5) + affine[1, 1] * 0.5 + affine[1, 2] + 1e-6
        for j in range(ny):
            u, v = u0 + j * affine[0, 1], v0 + j * affine[1, 1]
            if 0 <= u < mx and 0 <= v < my:
                a, b = int(u), int(v)
                for layer in range(out.shape[0]):
                    out[layer, i, j] = source[layer, a, b]
                seen += source[4, a, b] > 0
    return seen
