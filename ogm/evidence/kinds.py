"""Kinds of masses that functions take: arrays, tensors, lists, triples and opinions; the result has the same kind.

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

from ogm.evidence.arrays import dtype_name, letter, namespace, refuse_worst, stack_last, tolerance_of
from ogm.evidence.opinion import Conclusion, Opinion

P = ParamSpec("P")
R = TypeVar("R")
Rate = Callable[[Sequence[float], Sequence[float]], float]  # base rate of a result, by the sources' unknown and rates


def takes_masses(
    *names: str,
    gives_masses: bool = True,
    triples: bool = False,
    rate: Rate | None = None,
    base_rates: Mapping[str, str] | None = None,
    numbers: str = "",
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator of a function of pairs, which then takes masses of every kind.

    Lists and whole numbers become arrays of the library and dtype of the other masses, by default float64. Triples
    (free, occupied, unknown) become pairs, and the result a triple, if all masses are; so do opinions.

    Parameters
    ----------
    names : str
        Parameters that are masses; by default all positional arguments.
    gives_masses : bool
        Whether the result is a mass, or a `Conclusion`.
    triples : bool
        Whether the function itself takes triples, whose sum may be below 1.
    rate : function, optional
        Base rate of the result of opinions whose base rates differ; without it they are refused.
    base_rates : mapping of str to str, optional
        For each of some masses, the parameter that takes the base rate of an opinion where it is not given.
    numbers : str, optional
        Parameter that may also be a number.
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
            opinions = [one for one in given if isinstance(one, Opinion)]
            for name in {*rate_names.values()} - arguments.keys():
                own = [one for one, label in zip(given, labels, strict=True) if rate_names.get(label) == name]
                if own := [one for one in own if isinstance(one, Opinion)]:
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
    """Return whether a mass needs no conversion: an array or a tensor of numbers that are not whole, (..., 2)."""
    torch: Any = sys.modules.get("torch")
    if isinstance(mass, np.ndarray):
        return bool(mass.shape[-1:] == (2,) and mass.dtype.kind == "f")
    is_tensor = torch is not None and isinstance(mass, torch.Tensor)
    return bool(is_tensor and mass.shape[-1:] == (2,) and mass.is_floating_point())


def _as_arrays(values: list[Any], labels: list[str]) -> list[Any]:
    """Return arrays or tensors; what is not of an own floating-point dtype takes that of the others."""
    torch = sys.modules.get("torch")
    arrays = [_as_array(value, label, torch) for value, label in zip(values, labels, strict=True)]
    own = [
        (isinstance(value, np.ndarray) and value.dtype.kind == "f")
        or (torch is not None and isinstance(array, torch.Tensor) and array.is_floating_point())
        for value, array in zip(values, arrays, strict=True)
    ]
    like = next((array for array, is_own in zip(arrays, own, strict=True) if is_own), None)
    return [array if is_own else _converted(array, like) for array, is_own in zip(arrays, own, strict=True)]


def _as_array(value: Any, label: str, torch: Any) -> Any:
    if isinstance(value, np.ndarray) or (torch is not None and isinstance(value, torch.Tensor)):
        return value
    if torch is not None and isinstance(value, list | tuple) and any(isinstance(one, torch.Tensor) for one in value):
        return torch.stack([torch.as_tensor(one) for one in value])
    try:
        array = np.asarray(value)
    except ValueError as error:  # a ragged list
        raise TypeError(f"{label} must be masses (free, occupied) of one shape, got {value!r}") from error
    if array.dtype.kind not in "fiub":
        raise TypeError(f"{label} must be masses: an array, a tensor, a list or an Opinion, got {type(value).__name__}")
    return array


def _converted(array: Any, like: Any) -> Any:
    """Return numbers in the library, dtype and device of an array, by default as float64."""
    if like is None:
        return array.astype(np.float64) if isinstance(array, np.ndarray) else array.double()
    if isinstance(like, np.ndarray):
        return array.astype(like.dtype) if isinstance(array, np.ndarray) else array
    return namespace(like).as_tensor(array, dtype=like.dtype, device=like.device)


def _pair(mass: Any, name: str) -> Any:
    """Return the pair of a triple (free, occupied, unknown); in numpy, refuse one with conflict."""
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
    rates = [one.base_rate for one in opinions]
    if len(set(rates)) == 1:
        return rates[0]
    if rate is None:
        raise ValueError(
            f"the opinions must have one base rate, got {', '.join(f'{one:g}' for one in rates)}: no formula combines "
            "them here; give the masses, and the base rate of the result to Opinion.from_mass"
        )
    return float(rate([one.unknown for one in opinions], rates))
