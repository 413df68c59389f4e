"""Combination rules of a single cell, compiled by numba, and a table of the rules on arrays and cells.

Kernels of grids use the cell functions. `RULES` has, by name, a rule on arrays and the same rule on a cell. Both use
the same formula; simple sums of products are the same function, compiled.

A cell function takes the `Constants` of a dtype and the masses (free, occupied) of two sources. It returns
(free, occupied, whole), masses times `whole`, so that the caller divides once. In total conflict `whole` is 0. Values
are not checked, and NaN stays NaN.

Importing this module loads numba; `ogm.evidence` does not import it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ogm.evidence import rules, subjective
from ogm.jit import inline


class Constants(NamedTuple):
    """Numbers of a dtype, because a literal 1 would convert float32 sums to float64."""

    one: Any
    dogmatic: Any  # greatest unknown of a dogmatic mass: 4 units of rounding
    least_unknown: Any  # lower bound of unknown in the cautious rule


class Rule(NamedTuple):
    """A rule on arrays, ``arrays(a, b)``, and on a cell, ``cell(constants, f, o, g, p)``."""

    arrays: Callable[..., Any]
    cell: Callable[..., Any]


FLOAT32 = Constants(np.float32(1), np.float32(4 * 2.0**-23), np.float32(1e-6))
FLOAT64 = Constants(np.float64(1), np.float64(4 * 2.0**-52), np.float64(1e-12))

_agreement = inline(rules.agreement)
_added_evidence = inline(subjective.added_evidence)


@inline
def _split(one: Any, free: Any, occupied: Any) -> Any:
    """Return (free, occupied, unknown), each at least 0."""
    zero = one - one
    free, occupied = (zero if free < 0 else free, zero if occupied < 0 else occupied)  # NaN < 0 is false: NaN stays
    unknown = one - (free + occupied)
    return free, occupied, zero if unknown < 0 else unknown


@inline
def _joint(c: Constants, f: Any, o: Any, g: Any, p: Any) -> Any:
    f, o, u = _split(c.one, f, o)
    g, p, v = _split(c.one, g, p)
    return _agreement(f, o, u, g, p, v)


@inline
def _dempster(c: Constants, f: Any, o: Any, g: Any, p: Any) -> Any:
    free, occupied, unknown = _joint(c, f, o, g, p)
    return free, occupied, free + occupied + unknown


@inline
def _yager(c: Constants, f: Any, o: Any, g: Any, p: Any) -> Any:
    free, occupied, _ = _joint(c, f, o, g, p)
    return free, occupied, c.one


@inline
def _cumulative(c: Constants, f: Any, o: Any, g: Any, p: Any) -> Any:
    f, o, u = _split(c.one, f, o)
    g, p, v = _split(c.one, g, p)
    both = (u <= c.dogmatic) & (v <= c.dogmatic)
    half = c.one / (c.one + c.one)
    free, occupied, whole = _added_evidence(f, o, u, g, p, v)
    return half * (f + g) if both else free / whole, half * (o + p) if both else occupied / whole, c.one


@inline
def _cautious(c: Constants, f: Any, o: Any, g: Any, p: Any) -> Any:
    u, v = max(c.one - (f + o), c.least_unknown), max(c.one - (g + p), c.least_unknown)
    free, occupied = max(f * v, g * u), max(o * v, p * u)  # max(f / u, g / v) times u v
    return free, occupied, free + occupied + u * v


@inline
def _revise(c: Constants, f: Any, o: Any, g: Any, p: Any) -> Any:
    zero, half = c.one - c.one, c.one / (c.one + c.one)
    old_loss = c.one - half * half
    occupied = max(o * (c.one - old_loss * max(g - f, zero)), p * (c.one - half * max(f - g, zero)))
    free = max(f * (c.one - max(p - o, zero)), g * (c.one - max(o - p, zero)))
    return min(free, c.one - occupied), occupied, c.one


@inline
def _smooth(c: Constants, f: Any, o: Any, g: Any, p: Any) -> Any:
    zero, half = c.one - c.one, c.one / (c.one + c.one)
    quarter = half * half
    hit, rest = p >= g, c.one - g
    gain = max(c.one - (f + o) / (quarter * quarter), quarter)
    grown = min(f + g * (c.one - f) * (c.one - o), max(max(f, g), c.one - (rest + rest) * rest))
    occupied = o + gain * max(p - o, zero) if hit else o * (c.one - quarter * g)
    free = f * (c.one - p) if hit else grown
    return min(free, c.one - occupied), occupied, c.one


RULES = {
    "dempster": Rule(rules.dempster, _dempster),
    "yager": Rule(rules.yager, _yager),
    "cumulative": Rule(subjective.cumulative, _cumulative),
    "cautious": Rule(rules.cautious, _cautious),
}
# Not symmetric: for a map and a scan
REVISE, SMOOTH = Rule(rules.revise, _revise), Rule(rules.smooth, _smooth)
