"""Binomial logic on opinions: and, or, and conditional deduction.

For layers on top of a grid: "occupied and moving", "blocked if either lane is", "drivable, given what the
surface is". The pair keeps its order: (free, occupied) stands for (disbelief, belief) in the proposition.

Source: Jøsang, *Subjective Logic* (2016), chapters 7 and 9.
"""

from typing import Any, NamedTuple

import numpy as np

from ogm.evidence.arrays import Array, as_like, namespace, per_cell, split_two, stack_last


class Conclusion(NamedTuple):
    """Result of a logical operator: masses (..., 2), and the base rate of the new proposition."""

    mass: Any
    base_rate: Any


def multiplication(x: Array, y: Array, base_rate_x: Any = 0.5, base_rate_y: Any = 0.5) -> Conclusion:
    """Return the opinion on "x and y" for independent x and y.

    Projected probabilities and base rates multiply. Commutative and associative (in mass and base rate
    together).

    Parameters
    ----------
    x, y : (..., 2) float32 or float64, numpy or torch
        Masses (disbelief, belief).
    base_rate_x, base_rate_y : float or (...) array
        In [0, 1], not both 1.
    """
    xp, (d, b, u), (e, c, v), a, r = _two(x, y, base_rate_x, base_rate_y)
    scale = 1 - a * r
    _refuse_zero(scale, "base rates must not both be 1")
    belief = b * c + ((1 - a) * r * b * v + a * (1 - r) * u * c) / scale
    return Conclusion(stack_last(xp, [d + e - d * e, belief], x), _rate(a * r, u, x))


def comultiplication(x: Array, y: Array, base_rate_x: Any = 0.5, base_rate_y: Any = 0.5) -> Conclusion:
    """Return the opinion on "x or y" for independent x and y: the dual of `multiplication`.

    Parameters
    ----------
    x, y : (..., 2) float32 or float64, numpy or torch
        Masses (disbelief, belief).
    base_rate_x, base_rate_y : float or (...) array
        In [0, 1], not both 0.
    """
    xp, (d, b, u), (e, c, v), a, r = _two(x, y, base_rate_x, base_rate_y)
    rate = a + r - a * r
    _refuse_zero(rate, "base rates must not both be 0")
    disbelief = d * e + (a * (1 - r) * d * v + (1 - a) * r * u * e) / rate
    return Conclusion(stack_last(xp, [disbelief, b + c - b * c], x), _rate(rate, u, x))


def deduction(x: Array, y_if_x: Array, y_if_not_x: Array, base_rate_x: Any = 0.5) -> Conclusion:
    """Return the opinion on y, given the opinion on x and those on y if x is true, and if it is false.

    The projected probability follows the law of total probability, with the base rate of y taken from the
    conditionals (0.5 if both are vacuous).

    Parameters
    ----------
    x : (..., 2) float32 or float64, numpy or torch
        Mass (disbelief, belief) in the condition.
    y_if_x, y_if_not_x : (..., 2)
        Conditional masses (disbelief, belief) in y.
    base_rate_x : float or (...) array
        In [0, 1].
    """
    xp, (d, b, u), (d1, b1, u1), a, _ = _two(x, y_if_x, base_rate_x, 0.5, ("x", "y_if_x"))
    _, (d0, b0, u0) = split_two(x, y_if_not_x, ("x", "y_if_not_x"))
    # Marginal base rate of y: where it is consistent with itself.
    known = 1 - a * u1 - (1 - a) * u0
    nothing = known <= 0
    rate = xp.where(nothing, 0.5 + 0 * known, (a * b1 + (1 - a) * b0) / (known + nothing)).clip(0, 1)
    # Law of total probability.
    p_x = b + a * u
    p1, p0 = b1 + rate * u1, b0 + rate * u0
    p = p_x * p1 + (1 - p_x) * p0
    # Greatest unknown that a vacuous x could leave: the apex of the triangle of conditionals.
    p_hat = a * p1 + (1 - a) * p0
    apex = xp.minimum(
        _ratio(xp, p_hat - xp.minimum(b1, b0), rate), _ratio(xp, 1 - p_hat - xp.minimum(d1, d0), 1 - rate)
    ).clip(0, 1)
    unknown = u * apex + b * u1 + d * u0
    disbelief, belief = 1 - p - (1 - rate) * unknown, p - rate * unknown
    mass = stack_last(xp, [disbelief.clip(0), belief.clip(0)], x)  # rounding may leave them below zero
    return Conclusion(mass, per_cell(rate, x))


def _two(
    x: Any, y: Any, base_rate_x: Any, base_rate_y: Any, names: tuple[str, str] = ("x", "y")
) -> tuple[Any, tuple[Any, Any, Any], tuple[Any, Any, Any], Any, Any]:
    first, second = split_two(x, y, names)
    rates = as_like(base_rate_x, first[0], "base_rate_x"), as_like(base_rate_y, second[0], "base_rate_y")
    return namespace(x), first, second, *rates


def _rate(rate: Any, cells: Any, mass: Any) -> Any:
    return per_cell(rate + 0 * cells, mass)


def _refuse_zero(scale: Any, message: str) -> None:
    """Raise if a number, or one of a numpy array, is zero; tensors are not read."""
    if isinstance(scale, float | np.ndarray | np.generic) and np.any(scale == 0):
        raise ValueError(message)


def _ratio(xp: Any, above: Any, below: Any) -> Any:
    """Divide; where the divisor is zero the bound does not bind, so it is 1."""
    zero = below <= 0
    return xp.where(zero, 1 + 0 * above, above / (below + zero))
