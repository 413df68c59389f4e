"""Numba twins of the rules that fusion runs on every scan.

`dempster`, `yager` and `cumulative` discount the first mass (the map) and combine it with the second (the
scan). They give the same numbers as their namesakes in `ogm.evidence` after `discount`, with one traversal of
memory instead of dozens. They trust their input: values are not checked. A belief below zero is read as zero,
but a sum above one is not brought back to one. NaN in a cell stays NaN in that cell; total conflict and two
dogmatic masses (unknown of at most 4 units of rounding) give the mean. They run on one core, release the GIL,
and their compiled code is cached on disk. `agreement` and `cumulative_cell` are what other kernels build on.

Importing this module loads numba; `ogm.evidence` does not import it.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit

__all__ = ["agreement", "cumulative", "cumulative_cell", "dempster", "yager"]

# "contract" lets a * b + c be one instruction. The flags that assume that NaN or infinity never happen stay
# off.
_jit = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})


def dempster(
    a: np.ndarray, b: np.ndarray, *, reliability: float = 1.0, out: np.ndarray | None = None
) -> np.ndarray:
    """Discount `a` by `reliability` and combine it with `b` by Dempster's rule.

    Parameters
    ----------
    a, b : (..., 2) float32 or float64, C-contiguous, of one shape and dtype
        Masses (free, occupied): the map and the scan.
    reliability : float
        Shafer's discount of `a`, in [0, 1]; 1 keeps all.
    out : array, optional
        Where the result goes: a new array by default; `a` itself for an update in place; or any other
        writeable array of the same shape and dtype that shares no memory with `a` or `b`.

    Returns
    -------
    (..., 2), `out`
    """
    return _run(_dempster_into, _dempster_in_place, a, b, reliability, out)


def yager(
    a: np.ndarray, b: np.ndarray, *, reliability: float = 1.0, out: np.ndarray | None = None
) -> np.ndarray:
    """Discount `a` by `reliability` and combine it with `b` by Yager's rule.

    Parameters
    ----------
    a, b, reliability, out
        As for `dempster`.
    """
    return _run(_yager_into, _yager_in_place, a, b, reliability, out)


def cumulative(
    a: np.ndarray, b: np.ndarray, *, reliability: float = 1.0, out: np.ndarray | None = None
) -> np.ndarray:
    """Discount `a` by `reliability` and fuse it with `b` by cumulative fusion.

    Parameters
    ----------
    a, b, reliability, out
        As for `dempster`.
    """
    return _run(_cumulative_into, _cumulative_in_place, a, b, reliability, out)


def _run(
    into: Callable[..., None],
    in_place: Callable[..., None],
    a: np.ndarray,
    b: np.ndarray,
    reliability: float,
    out: np.ndarray | None,
) -> np.ndarray:
    """Check the form of the arrays and run the loop that fits `out`."""
    _check(a, "a", a)
    _check(b, "b", a)
    if not isinstance(reliability, int | float | np.generic):
        raise TypeError(
            f"reliability must be one number in a kernel, got {type(reliability).__name__}; "
            f"for one per cell use evidence.discount"
        )
    if not 0 <= reliability <= 1:
        raise ValueError(f"reliability must lie in [0, 1], got {reliability}")
    if out is None:
        out = np.empty_like(a)
    _check(out, "out", a)
    if not out.flags.writeable:
        raise ValueError("out must be writeable, got a read-only array")
    if np.may_share_memory(out, b):
        raise ValueError("out must not share memory with b; only a may be updated in place")
    if out.ctypes.data == a.ctypes.data:
        # Its own loop: with a second name for the same memory the compiler could not use vector instructions.
        in_place(out.reshape(-1), b.reshape(-1), reliability)
        return out
    if np.may_share_memory(out, a):
        raise ValueError("out must be a itself or share no memory with it, got a part of it, shifted")
    into(a.reshape(-1), b.reshape(-1), reliability, out.reshape(-1))
    return out


def _check(array: Any, name: str, a: np.ndarray) -> None:
    if not isinstance(array, np.ndarray):
        raise TypeError(f"{name} must be a numpy array, got {type(array).__name__}")
    if array.dtype not in (np.float32, np.float64) or array.dtype != a.dtype:
        raise TypeError(
            f"a, b and out must all be float32 or all float64, got {a.dtype} and, as {name}, {array.dtype}"
        )
    if array.ndim == 0 or array.shape[-1] != 2:
        raise ValueError(
            f"{name} must have 2 states (free, occupied) on its last axis, got shape {array.shape}"
        )
    if array.shape != a.shape:
        raise ValueError(f"a, b and out must have one shape, got {a.shape} and, as {name}, {array.shape}")
    if not array.flags.c_contiguous:
        raise ValueError(f"{name} must be C-contiguous; pass np.ascontiguousarray({name})")


# Below, `a`, `b` and `out` are flat: cell i has free at 2 i and occupied at 2 i + 1. A stride that the
# compiler knows is what lets it use vector instructions. `one` carries the dtype: a literal 1 would make
# float32 sums float64.


@_jit
def _positive(one: Any, belief: Any) -> Any:
    return one - one if belief < 0 else belief  # NaN < 0 is false: NaN stays


@_jit
def _unknown(one: Any, free: Any, occupied: Any) -> Any:
    unknown = one - (free + occupied)
    return one - one if unknown < 0 else unknown


@_jit
def agreement(one: Any, f: Any, o: Any, g: Any, p: Any) -> Any:
    """Return (free, occupied, unknown) on which (f, o) and (g, p) agree."""
    f, o, g, p = _positive(one, f), _positive(one, o), _positive(one, g), _positive(one, p)
    u, v = _unknown(one, f, o), _unknown(one, g, p)
    return f * (g + v) + u * g, o * (p + v) + u * p, u * v


@_jit
def _dempster_cell(one: Any, f: Any, o: Any, g: Any, p: Any) -> Any:
    free, occupied, unknown = agreement(one, f, o, g, p)
    surviving = free + occupied + unknown
    half = one / (one + one)
    return (
        half if surviving == 0 else free / surviving,
        half if surviving == 0 else occupied / surviving,
    )


@_jit
def _yager_cell(one: Any, f: Any, o: Any, g: Any, p: Any) -> Any:
    free, occupied, _ = agreement(one, f, o, g, p)
    return free, occupied


@_jit
def cumulative_cell(one: Any, f: Any, o: Any, g: Any, p: Any, rounding: Any) -> Any:
    """Return (free, occupied) of (f, o) fused with (g, p); both are dogmatic where unknown is at most `rounding`."""
    f, o, g, p = _positive(one, f), _positive(one, o), _positive(one, g), _positive(one, p)
    u, v = _unknown(one, f, o), _unknown(one, g, p)
    total = u + v * (f + o)
    both = (u <= rounding) & (v <= rounding)
    half = one / (one + one)
    return (
        half * (f + g) if both else (f * v + g * u) / total,
        half * (o + p) if both else (o * v + p * u) / total,
    )


@_jit
def _dempster_into(a: np.ndarray, b: np.ndarray, reliability: float, out: np.ndarray) -> None:
    one, r = a.dtype.type(1), a.dtype.type(reliability)
    for i in range(a.size // 2):
        out[2 * i], out[2 * i + 1] = _dempster_cell(
            one, r * a[2 * i], r * a[2 * i + 1], b[2 * i], b[2 * i + 1]
        )


@_jit
def _dempster_in_place(a: np.ndarray, b: np.ndarray, reliability: float) -> None:
    one, r = a.dtype.type(1), a.dtype.type(reliability)
    for i in range(a.size // 2):
        a[2 * i], a[2 * i + 1] = _dempster_cell(one, r * a[2 * i], r * a[2 * i + 1], b[2 * i], b[2 * i + 1])


@_jit
def _yager_into(a: np.ndarray, b: np.ndarray, reliability: float, out: np.ndarray) -> None:
    one, r = a.dtype.type(1), a.dtype.type(reliability)
    for i in range(a.size // 2):
        out[2 * i], out[2 * i + 1] = _yager_cell(one, r * a[2 * i], r * a[2 * i + 1], b[2 * i], b[2 * i + 1])


@_jit
def _yager_in_place(a: np.ndarray, b: np.ndarray, reliability: float) -> None:
    one, r = a.dtype.type(1), a.dtype.type(reliability)
    for i in range(a.size // 2):
        a[2 * i], a[2 * i + 1] = _yager_cell(one, r * a[2 * i], r * a[2 * i + 1], b[2 * i], b[2 * i + 1])


@_jit
def _cumulative_into(a: np.ndarray, b: np.ndarray, reliability: float, out: np.ndarray) -> None:
    one, r = a.dtype.type(1), a.dtype.type(reliability)
    rounding = a.dtype.type(4 * np.finfo(a.dtype).eps)  # an unknown as good as zero
    for i in range(a.size // 2):
        out[2 * i], out[2 * i + 1] = cumulative_cell(
            one, r * a[2 * i], r * a[2 * i + 1], b[2 * i], b[2 * i + 1], rounding
        )


@_jit
def _cumulative_in_place(a: np.ndarray, b: np.ndarray, reliability: float) -> None:
    one, r = a.dtype.type(1), a.dtype.type(reliability)
    rounding = a.dtype.type(4 * np.finfo(a.dtype).eps)  # an unknown as good as zero
    for i in range(a.size // 2):
        a[2 * i], a[2 * i + 1] = cumulative_cell(
            one, r * a[2 * i], r * a[2 * i + 1], b[2 * i], b[2 * i + 1], rounding
        )
