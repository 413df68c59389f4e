"""Input checks, and helpers by which the same code serves numpy and torch.

The two libraries agree on the few functions that the algebra needs (``where``, ``stack``, ``sqrt``, ``log``, ...).
Torch is never imported: a tensor can exist only if torch is in ``sys.modules``.

Two kinds of checks: *Form* (library, dtype, last axis, shapes) is checked on every call. *Values* (the simplex, NaN)
are checked on every call for numpy arrays, and never for tensors, because reading a value would stall the GPU and stop
tracing: use `check_mass` where tensors enter.
"""

import sys
from collections.abc import Callable, Sequence
from functools import reduce
from operator import add
from typing import Any, TypeVar, cast

import numpy as np

Array = TypeVar("Array")  # a numpy array or a torch tensor; results have the same type

_STATES = {2: "2 states (free, occupied)", 3: "3 numbers (free, occupied, unknown)"}
_BLOCK_SIZE = 2**16  # numbers checked at a time, so that temporary arrays stay in the cache
_TOLERANCE = {"float32": 1e-6, "float64": 1e-12}  # greatest distance of a mass from the simplex by rounding


def namespace(array: Any, name: str = "mass") -> Any:
    """Return the library of an array, numpy or torch; raise TypeError for other types."""
    refuse_masked(array, name)
    if isinstance(array, np.ndarray | np.generic):
        return np
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(array, torch.Tensor):
        return torch
    raise TypeError(
        f"{name} must be a numpy array or a torch tensor, got {type(array).__name__}; convert it: np.asarray({name})"
    )


def refuse_masked(array: Any, name: str) -> None:
    """Raise TypeError for a masked array: its mask would be dropped, and the masked values used."""
    if isinstance(array, np.ma.MaskedArray):
        raise TypeError(f"{name} must not be a masked array, because masks are ignored; fill it: {name}.filled(0)")


def dtype_name(array: Any) -> str:
    """Return the name of the dtype, such as ``"float32"`` for numpy and torch."""
    return str(array.dtype).removeprefix("torch.")


def tolerance_of(mass: Any) -> float:
    """Return the tolerance at the edges of the simplex for the dtype: 1e-6 (float32), 1e-12 (float64)."""
    return _TOLERANCE[dtype_name(mass)]


def check_float(array: Any, name: str) -> Any:
    """Check library and dtype; return the library."""
    xp = namespace(array, name)
    if dtype_name(array) not in _TOLERANCE:
        raise TypeError(
            f"{name} must be float32 or float64, got {dtype_name(array)}; convert it, "
            f"for example {name}.{'astype(np.float32)' if xp is np else 'float()'}"
        )
    return xp


def check_form(array: Any, name: str = "mass", states: tuple[int, ...] = (2,)) -> Any:
    """Check library, dtype and last axis; return the library."""
    xp = check_float(array, name)
    if array.ndim == 0 or array.shape[-1] not in states:
        wanted = " or ".join(_STATES[number] for number in states)
        raise ValueError(f"{name} must have {wanted} on its last axis, got shape {tuple(array.shape)}")
    return xp


def first_index(condition: Any) -> list[int]:
    """Return the index of the first true element."""
    return [int(i) for i in np.unravel_index(condition.ravel().tolist().index(True), tuple(condition.shape))]


def refuse(bad: Any, values: Any, name: str, must: str) -> None:
    """Raise ValueError with the first bad number of an array, if any."""
    if bad.any():
        index = first_index(bad)
        raise ValueError(f"{name} must {must}, but {name}{index} is {values[tuple(index)]}")


def refuse_worst(outside: Any, tolerance: float, values: Any, name: str, must: str, remedy: str = "") -> None:
    """Raise ValueError with the worst cell, if any is outside by more than the tolerance or NaN."""
    inside = outside <= tolerance
    if bool(inside.all()):
        return
    index = tuple(map(int, np.unravel_index(int(outside.argmax()), tuple(outside.shape))))  # or of the first NaN
    raise ValueError(
        f"{name} must {must} (tolerance {tolerance:g}); the worst of the {int((~inside).sum())} cells that are not, "
        f"{name}[{', '.join(map(str, (*index, ':')))}], is {values[index].tolist()}{remedy}"
    )


def check_alike(a: Any, b: Any, names: tuple[str, str] = ("a", "b")) -> None:
    """Raise an error if two arrays differ in library, dtype or device, or their shapes do not broadcast."""
    first, second = names
    properties: tuple[tuple[str, Callable[[Any], Any], str], ...] = (
        ("be from the same library", lambda x: namespace(x).__name__, "convert one: torch.from_numpy(x) or x.numpy()"),
        ("have the same dtype", dtype_name, "cast one of them"),
        ("be on the same device", lambda x: getattr(x, "device", None), "move one of them"),
    )
    for must, value, remedy in properties:
        if value(a) != value(b):
            raise TypeError(f"{first} and {second} must {must}, got {value(a)} and {value(b)}; {remedy}")
    try:
        np.broadcast_shapes(tuple(a.shape[:-1]), tuple(b.shape[:-1]))
    except ValueError:
        raise ValueError(
            f"{first} and {second} must have shapes that broadcast, got {tuple(a.shape)} and {tuple(b.shape)}"
        ) from None


def rounding(mass: Any) -> float:
    """Return the greatest unknown that counts as rounding of 0: 4.8e-7 (float32) or 8.9e-16 (float64)."""
    return float(4 * np.finfo(dtype_name(mass)).eps)


def as_like(value: Any, cells: Any, name: str, low: float = 0.0, high: float = 1.0) -> Any:
    """Convert a number, or an array of numbers per cell, to the library and dtype of `cells`.

    Numbers and numpy arrays must lie in [low, high], and arrays must broadcast with `cells`.
    """
    xp = namespace(cells)
    if isinstance(value, int | float | np.generic):
        number = float(value)
        if not low <= number <= high:
            raise ValueError(f"{name} must lie in [{low:g}, {high:g}], got {number}")
        return number
    if namespace(value, name) is not xp:
        raise TypeError(f"{name} must be a number or come from the library of the mass, got {type(value).__name__}")
    try:
        np.broadcast_shapes(tuple(value.shape), tuple(cells.shape))
    except ValueError:
        raise ValueError(
            f"{name} must have one number per cell, shape {tuple(cells.shape)}, got shape {tuple(value.shape)}"
        ) from None
    if xp is not np:
        return value.to(cells.dtype)
    refuse(~((value >= low) & (value <= high)), value, name, f"lie in [{low:g}, {high:g}]")
    return value.astype(cells.dtype, copy=False)


def maybe_any(xp: Any, condition: Any) -> bool:
    """Return whether a rare case may occur, so that numpy can skip it; always True for tensors, which are not read."""
    return xp is not np or bool(condition.any())


def split(mass: Any, name: str = "mass") -> tuple[Any, Any, Any]:
    """Check a pair and return its (free, occupied, unknown), each of the leading shape.

    Unknown is 1 - free - occupied. Negative numbers within the tolerance are read as zero. In numpy, a pair is divided
    by its sum if the sum exceeds 1 by more than rounding, because rules that divide small numbers would amplify the
    error. The array itself is not changed.
    """
    (free, occupied), unknown = _take_apart(mass, name, (2,))
    return free, occupied, unknown


def split_two(a: Any, b: Any, names: tuple[str, str] = ("a", "b")) -> tuple[Any, Any]:
    """Check two pairs and that they match; return (free, occupied, unknown) of each."""
    parts = split(a, names[0]), split(b, names[1])
    check_alike(a, b, names)
    return parts


def split_open(mass: Any, name: str = "mass", states: tuple[int, ...] = (2, 3)) -> tuple[Any, Any, Any, Any]:
    """Return (free, occupied, unknown, conflict) of a pair (its conflict is 0) or an open-world triple."""
    (free, occupied, *unknown), rest = _take_apart(mass, name, states)
    return (free, occupied, unknown[0], rest) if unknown else (free, occupied, rest, 0 * rest)


def _take_apart(mass: Any, name: str, states: tuple[int, ...]) -> tuple[list[Any], Any]:
    """Return the numbers per cell and their rest to 1; in numpy check them and correct rounding."""
    xp = check_form(mass, name, states)
    numbers = [mass[..., place] for place in range(mass.shape[-1])]
    if xp is not np:
        numbers = [number.clip(0) for number in numbers]
        return numbers, _rest(numbers).clip(0)
    unknown = _rest(numbers)
    min_given, min_unknown = float(mass.min(initial=0)), float(unknown.min(initial=0))
    if not (min_given >= -tolerance_of(mass) and min_unknown >= -tolerance_of(mass)):
        check_mass(mass, name=name)
    if min_given < 0:
        numbers = [np.maximum(number, 0) for number in numbers]
        unknown = _rest(numbers)
        min_unknown = float(unknown.min(initial=0))
    if min_unknown < -np.finfo(mass.dtype).eps:  # more than the last bit of a dogmatic mass
        scale = np.maximum(1 - unknown, 1)
        numbers = [number / scale for number in numbers]
    return numbers, unknown if min_unknown >= 0 else np.maximum(unknown, 0)


def _rest(numbers: list[Any]) -> Any:
    """Return 1 - unknown - (free + occupied); in this order the result is symmetric in free and occupied."""
    free, occupied, *unknown = numbers
    return 1 - sum(unknown) - (free + occupied)


def sources(masses: Sequence[Any], axis: int | None) -> tuple[Any, list[tuple[Any, Any, Any]]]:
    """Return the library, and (free, occupied, unknown) of each mass or of each source along `axis` of a stack."""
    return each_source(masses, axis, split)


def each_source(
    masses: Sequence[Any], axis: int | None, take_apart: Callable[[Any, str], Any]
) -> tuple[Any, list[tuple[Any, ...]]]:
    """Return the library, and the arrays from `take_apart` of each mass or of each source along `axis` of a stack."""
    if len(masses) < 1 + (axis is None) or (len(masses) > 1 and axis is not None):
        raise TypeError(
            "give two or more masses, rule(a, b), or a stack of sources and its axis, rule(stack, axis=0), "
            f"got {len(masses)} and axis={axis}"
        )
    parts = [take_apart(mass, letter(k)) for k, mass in enumerate(masses)]
    stack, xp = masses[0], namespace(masses[0])
    if axis is None:
        for k, mass in enumerate(masses[1:], start=1):
            check_alike(stack, mass, ("a", letter(k)))
        return xp, parts
    if not -stack.ndim <= axis < stack.ndim or axis % stack.ndim == stack.ndim - 1:
        raise ValueError(
            f"axis must be a leading axis, not the last one (the states), got {axis} for shape {tuple(stack.shape)}"
        )
    if stack.shape[axis] == 0:
        raise ValueError(f"a rule needs at least one source, got none along axis {axis} of shape {tuple(stack.shape)}")
    return xp, list(zip(*(xp.moveaxis(number, axis % stack.ndim, 0) for number in parts[0]), strict=True))


def letter(place: int) -> str:
    """Return the name of a source in error messages: a, b, c, ..."""
    return chr(ord("a") + place % 26)


def stack_last(xp: Any, numbers: Sequence[Any], mass: Array) -> Array:
    """Stack numbers per cell on a new last axis, in the dtype of `mass`."""
    return per_cell(xp.stack(broadcast(xp, numbers), -1), mass)


def broadcast(xp: Any, numbers: Sequence[Any]) -> Any:
    """Broadcast arrays or tensors against each other."""
    return xp.broadcast_arrays(*numbers) if xp is np else xp.broadcast_tensors(*numbers)


def per_cell(value: Any, mass: Array) -> Array:
    """Return numbers in the dtype of `mass`; numpy 1 would convert a single float32 to float64."""
    dtype = cast(Any, mass).dtype
    return cast(Array, value.astype(dtype, copy=False) if namespace(mass) is np else value.to(dtype))


def as_double(array: Any) -> Any:
    """Return an array or tensor in float64."""
    return array.double() if hasattr(array, "detach") else array.astype(np.float64)


def _outside(values: Any) -> Any:
    """Return the excess of each cell over the simplex: below zero, or above one in sum; NaN stays NaN."""
    xp = namespace(values)
    states = [values[..., k] for k in range(values.shape[-1])]  # reductions of an axis of two are ten times as slow
    below = -reduce(xp.minimum, states)
    above = reduce(add, states) - 1
    return xp.where(below > above, below, above)


def check_mass(mass: Any, tolerance: float | None = None, name: str = "mass") -> None:
    """Raise an error unless every cell is a mass: free >= 0, occupied >= 0, free + occupied <= 1.

    Use it once, where data enters. Nothing is changed; see `renormalize` for a repair.

    Parameters
    ----------
    mass : (..., 2) float32 or float64, numpy or torch
        Pairs (free, occupied); or (..., 3), triples (free, occupied, unknown), in which the rest to 1 is conflict.
    tolerance : float, optional
        Greatest excess of a cell over the simplex; by default 1e-6 for float32 and 1e-12 for float64.
    name : str
        Name of the array in error messages.

    Raises
    ------
    ValueError
        If a cell is NaN or outside the simplex by more than `tolerance`; the message has the worst cell, its value
        and the tolerance.
    TypeError
        If `mass` is not a float32 or float64 array or tensor.
    """
    xp = check_form(mass, name, states=(2, 3))
    tolerance = tolerance_of(mass) if tolerance is None else tolerance
    values = mass if xp is np else mass.detach()
    if xp is np and values.ndim > 1 and values.size > _BLOCK_SIZE:
        step = max(_BLOCK_SIZE * len(values) // values.size, 1)
        parts = (values[k : k + step] for k in range(0, len(values), step))
        if all((_outside(part) <= tolerance).all() for part in parts):
            return
    outside = _outside(values)
    must = "be non-negative and sum to at most 1 in every cell"
    remedy = f"; evidence becomes masses by evidence_to_mass, rounding is repaired by renormalize({name})"
    refuse_worst(outside, tolerance, values, name, must, remedy)


def renormalize(mass: Array) -> Array:
    """Set negative numbers to 0, and divide masses with a sum above 1 by the sum.

    Use it for external data with rounding or resampling errors. No function of this package repairs data implicitly.

    Parameters
    ----------
    mass : (..., 2) float32 or float64, numpy or torch
        Finite numbers (free, occupied), or (..., 3) triples.

    Raises
    ------
    ValueError
        If a numpy array holds NaN or infinity.
    """
    xp = check_form(mass, states=(2, 3))
    if xp is np:
        refuse(~np.isfinite(cast(Any, mass)), mass, "mass", "be finite to be renormalized")
    positive = cast(Any, mass).clip(0)
    total = positive.sum(-1)[..., None]
    return cast(Array, positive / xp.where(total > 1, total, xp.ones_like(total)))
