"""Binomial logic on opinions: and, or, conditional deduction, and abduction.

For layers derived from a grid, such as "occupied and moving", "blocked if either lane is blocked" or "drivable, given
the kind of surface". The pair (free, occupied) is (disbelief, belief) in the proposition.
`ogm.evidence.multinomial` has deduction and abduction for more states.

Source: Jøsang, *Subjective Logic* (2016), chapters 7, 9 and 10.
"""

from typing import Any

import numpy as np

from ogm.evidence import multinomial
from ogm.evidence.arrays import Array, as_like, broadcast, namespace, per_cell, split_two, stack_last
from ogm.evidence.kinds import takes_masses
from ogm.evidence.opinion import Conclusion


@takes_masses("x", "y", base_rates={"x": "base_rate_x", "y": "base_rate_y"})
def multiplication(x: Array, y: Array, base_rate_x: Any = 0.5, base_rate_y: Any = 0.5) -> Conclusion:
    """Return the opinion on "x and y" for independent x and y.

    Projected probabilities and base rates multiply. Commutative and associative (mass and base rate together).

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
    return Conclusion(stack_last(xp, [d + e - d * e, belief], x), per_cell(a * r + 0 * u, x))


@takes_masses("x", "y", base_rates={"x": "base_rate_x", "y": "base_rate_y"})
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
    return Conclusion(stack_last(xp, [disbelief, b + c - b * c], x), per_cell(rate + 0 * u, x))


@takes_masses("x", "y_if_x", "y_if_not_x", base_rates={"x": "base_rate_x"})
def deduction(x: Array, y_if_x: Array, y_if_not_x: Array, base_rate_x: Any = 0.5) -> Conclusion:
    """Return the opinion on y from the opinion on x and the opinions on y if x is true and if x is false.

    The projected probability follows the law of total probability. The base rate of y follows from the conditionals
    (0.5 if both are vacuous).

    Parameters
    ----------
    x : (..., 2) float32 or float64, numpy or torch
        Mass (disbelief, belief) in the condition.
    y_if_x, y_if_not_x : (..., 2)
        Conditional masses (disbelief, belief) in y.
    base_rate_x : float or (...) array
        In [0, 1].
    """
    conditionals, rates = _binary(x, y_if_x, y_if_not_x, base_rate_x, ("x", "y_if_x", "y_if_not_x"))
    mass, base_rate = multinomial.deduction(x, conditionals, rates)
    return Conclusion(mass, base_rate[..., 1])


@takes_masses("y", "y_if_x", "y_if_not_x")
def abduction(y: Array, y_if_x: Array, y_if_not_x: Array, base_rate_x: Any = 0.5) -> Conclusion:
    """Return the opinion on x from the opinion on its consequence y: Bayes' theorem on opinions.

    The conditionals are inverted, then `deduction` gives x from y.

    Parameters
    ----------
    y : (..., 2) float32 or float64, numpy or torch
        Mass (disbelief, belief) in the consequence, for example a detection.
    y_if_x, y_if_not_x : (..., 2)
        Conditional masses (disbelief, belief) in y, for example in a detection in occupied and in free cells.
    base_rate_x : float or (...) array
        Prior probability of x, in [0, 1].
    """
    conditionals, rates = _binary(y, y_if_x, y_if_not_x, base_rate_x, ("y", "y_if_x", "y_if_not_x"))
    mass, base_rate = multinomial.abduction(y, conditionals, rates)
    return Conclusion(mass, base_rate[..., 1])


def _binary(given: Any, if_x: Any, if_not_x: Any, base_rate: Any, names: tuple[str, str, str]) -> tuple[Any, Any]:
    """Return the conditionals (..., 2, 2) and the base rates (..., 2) of two states, false and true."""
    xp, (_, _, u) = namespace(given), split_two(given, if_x, names[:2])[0]
    split_two(given, if_not_x, (names[0], names[2]))
    rate = as_like(base_rate, u, "base_rate_x") + 0 * u
    return xp.stack(broadcast(xp, (if_not_x, if_x)), -2), stack_last(xp, [1 - rate, rate], given)


def _two(x: Any, y: Any, base_rate_x: Any, base_rate_y: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Return the library, (disbelief, belief, unknown) of x and of y, and their base rates."""
    first, second = split_two(x, y, ("x", "y"))
    rates = as_like(base_rate_x, first[0], "base_rate_x"), as_like(base_rate_y, second[0], "base_rate_y")
    return namespace(x), first, second, *rates


def _refuse_zero(scale: Any, message: str) -> None:
    """Raise ValueError if a number, or any number of a numpy array, is zero; tensors are not read."""
    if isinstance(scale, float | np.ndarray | np.generic) and np.any(scale == 0):
        raise ValueError(message)
