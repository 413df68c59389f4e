"""Kinds of masses in calls: arrays, tensors, lists, triples and opinions; the result has the same kind.

>>> from ogm.evidence import Opinion, dempster
>>> dempster([0.5, 0.2], [0.1, 0.6]).round(3), dempster(Opinion(0.5, 0.2), Opinion(0.1, 0.6))
(array([0.338, 0.529]), Opinion(free=0.34, occupied=0.53, unknown=0.13))
"""

import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np

from ogm.evidence.arrays import as_double, dtype_name, letter, namespace, refuse_worst, stack_last, tolerance_of
from ogm.evidence.opinion import Conclusion, Opinion

P = ParamSpec("P")
R = TypeVar("R")
Rate = Callable[[Sequence[float], Sequence[float]], float]  # of unknown masses and base rates


def takes_masses(
    *names: str,
    gives_masses: bool = True,
    triples: bool = False,
    rate: Rate | None = None,
    base_rates: Mapping[str, str] | None = None,
    numbers: str = "",
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator by which a function of pairs takes masses of every kind.

    Lists and integers become arrays in the library and dtype of the other masses, by default float64. Triples (free,
    occupied, unknown) and opinions become pairs. If all masses are triples, or all are opinions, so is the result.

    Parameters
    ----------
    names : str
        Names of the parameters that are masses; by default all positional arguments.
    gives_masses : bool
        Whether the result is a mass or a `Conclusion`.
    triples : bool
        Whether the function itself takes triples, with a sum that may be below 1.
    rate : function, optional
        Base rate of the result for opinions with different base rates; without it, these raise ValueError.
    base_rates : mapping of str to str, optional
        Parameter that takes the base rate of an opinion by default, for each parameter of a mass.
    numbers : str, optional
        Name of a parameter that may also be a number.
    """
    rate_names = dict(base_rates or {})

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(function)

        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            masses = args[: len(names)] if names else args
            if len(masses) == len(names or args) and all(map(_is_pair, masses)):
                return function(*args, **kwargs)
            bound = signature.bind(*args, **kwargs)
            arguments = bound.arguments
            labels = [name for name in names if not (name == numbers and _is_number(arguments[name]))]
            given = [arguments[name] for name in labels] if names else list(args)
            labels = labels or [letter(k) for k in range(len(args))]
            arrays = _as_arrays(given, labels)
            were_triples = all(array.shape[-1:] == (3,) for array in arrays)
            if not triples:
                arrays = [_pair(array, label) for array, label in zip(arrays, labels, strict=True)]
            arguments.update(zip(labels, arrays, strict=True) if names else {"masses": tuple(arrays)})
            opinions = [mass for mass in given if isinstance(mass, Opinion)]
            for name in {*rate_names.values()} - arguments.keys():
                pairs = zip(given, labels, strict=True)
                own = [m for m, label in pairs if rate_names.get(label) == name and isinstance(m, Opinion)]
                if own:
                    arguments[name] = _common_rate(own, None)
            result = cast(Any, function)(*bound.args, **bound.kwargs)
            if not gives_masses:
                return cast(R, result)
            if len(opinions) < len(given):
                return cast(R, _triple(result) if were_triples and not triples else result)
            if isinstance(result, Conclusion):
                return cast(R, Opinion.from_mass(result.mass, float(result.base_rate)))
            own_rate = arguments.get(rate_names.get(names[0], "")) if names else None
            return cast(R, Opinion.from_mass(result, _common_rate(opinions, rate) if own_rate is None else own_rate))

        return call

    return decorate


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.generic)


def _is_pair(mass: Any) -> bool:
    """Return whether a mass needs no conversion: a floating-point array or tensor (..., 2)."""
    return bool(_is_array(mass) and mass.shape[-1:] == (2,) and _is_floating(mass))


def _is_array(value: Any) -> bool:
    """Return whether a value is a numpy array or a torch tensor."""
    torch = sys.modules.get("torch")
    return isinstance(value, np.ndarray) or (torch is not None and isinstance(value, torch.Tensor))


def _is_floating(array: Any) -> bool:
    return bool(array.dtype.kind == "f" if isinstance(array, np.ndarray) else array.is_floating_point())


def _as_arrays(values: list[Any], labels: list[str]) -> list[Any]:
    """Return arrays or tensors; values without a floating-point dtype take the dtype of the first with one."""
    arrays = [_as_array(value, label) for value, label in zip(values, labels, strict=True)]
    typed = [  # lists of numbers and opinions have no dtype
        _is_floating(array) and (array is value or not isinstance(array, np.ndarray))
        for array, value in zip(arrays, values, strict=True)
    ]
    like = next((array for array, is_typed in zip(arrays, typed, strict=True) if is_typed), None)
    return [array if is_typed else _converted(array, like) for array, is_typed in zip(arrays, typed, strict=True)]


def _as_array(value: Any, label: str) -> Any:
    if _is_array(value):
        return value
    if isinstance(value, list | tuple) and (tensors := [item for item in value if hasattr(item, "detach")]):
        torch = namespace(tensors[0])
        return torch.stack([torch.as_tensor(item) for item in value])
    try:
        array = np.asarray(value)
    except ValueError as error:  # a ragged list
        raise TypeError(f"{label} must be masses (free, occupied) of the same shape, got {value!r}") from error
    if array.dtype.kind not in "fiub":
        raise TypeError(f"{label} must be masses: an array, a tensor, a list or an Opinion, got {type(value).__name__}")
    return array


def _converted(array: Any, like: Any) -> Any:
    """Return an array in the library, dtype and device of another, by default as float64."""
    if like is None:
        return as_double(array)
    if isinstance(like, np.ndarray):
        return array.astype(like.dtype) if isinstance(array, np.ndarray) else array
    return namespace(like).as_tensor(array, dtype=like.dtype, device=like.device)


def _pair(mass: Any, name: str) -> Any:
    """Return the pair of a triple (free, occupied, unknown); in numpy, raise ValueError if it has conflict."""
    if mass.shape[-1:] != (3,):
        return mass
    if isinstance(mass, np.ndarray) and dtype_name(mass) in ("float32", "float64"):
        must = "be triples (free, occupied, unknown) that sum to 1"
        remedy = f"; the rest is conflict, which close_world({name}) removes"
        refuse_worst(abs(mass.sum(-1) - 1), 2 * tolerance_of(mass), mass, name, must, remedy)
    return mass[..., :2]


def _triple(mass: Any) -> Any:
    xp, free, occupied = namespace(mass), mass[..., 0], mass[..., 1]
    return stack_last(xp, [free, occupied, (1 - (free + occupied)).clip(0)], mass)


def _common_rate(opinions: Sequence[Opinion], rate: Rate | None) -> float:
    rates = [opinion.base_rate for opinion in opinions]
    if len(set(rates)) == 1:
        return rates[0]
    if rate is None:
        raise ValueError(
            f"the opinions must have the same base rate, got {', '.join(f'{value:g}' for value in rates)}: this "
            "function has no rule for the base rate of the result; give masses, and the base rate to Opinion.from_mass"
        )
    return float(rate([opinion.unknown for opinion in opinions], rates))
