"""Opinions on K exclusive states with base rates: probability, deduction, inversion (Bayes' theorem) and abduction.

An opinion is an array of beliefs ``(..., K)``, numpy or torch, K >= 2; the rest to 1 is unknown. Base rates are prior
probabilities ``(K,)`` or ``(..., K)``, by default equal. Conditionals are opinions on L states of y for each of the K
states of x, ``(..., K, L)``. To fuse opinions of at most 6 states, see `ogm.evidence.powerset.from_beliefs`.

>>> from ogm.evidence import multinomial
>>> kind = [0.0, 0.43, 0.0]  # belief in three kinds of observed movements
>>> seen_if = [[0.5, 0.25, 0.25], [0.0, 0.5, 0.5], [0.0, 0.25, 0.75]]  # conditional on each of three plans
>>> plan = multinomial.abduction(kind, seen_if, base_rate=[0.7, 0.2, 0.1])
>>> multinomial.projected_probability(plan.mass, plan.base_rate).round(2)
array([0.65, 0.26, 0.09])

Source: Jøsang, *Subjective Logic* (2016), chapters 3, 9 and 10. The example is from section 10.8; the beliefs in the
book are for inverted conditionals of maximal uncertainty: ``maximize_uncertainty(inversion(...).mass, base_rate)``.
"""

from functools import reduce
from typing import Any, cast

import numpy as np

from ogm.evidence.arrays import Array, check_float, namespace, refuse_worst, tolerance_of
from ogm.evidence.opinion import Conclusion

__all__ = ["abduction", "deduction", "inversion", "maximize_uncertainty", "projected_probability"]


def projected_probability(belief: Array, base_rate: Any = None) -> Array:
    """Return the projected probability of each state, belief + base_rate * unknown, (..., K).

    Parameters
    ----------
    belief : (..., K) float32 or float64, numpy or torch
    base_rate : (K,) or (..., K), optional
        Prior probabilities with sum 1; by default equal.
    """
    b, u = _opinion(belief, "belief")
    return cast(Array, b + _base_rate(base_rate, b) * u[..., None])


def maximize_uncertainty(belief: Array, base_rate: Any = None) -> Array:
    """Return the beliefs of the same projected probability and the greatest unknown, min P / base_rate.

    Parameters
    ----------
    belief, base_rate
        See `projected_probability`.
    """
    b, u = _opinion(belief, "belief")
    rate = _base_rate(base_rate, b)
    p = b + rate * u[..., None]
    return cast(Array, (p - rate * _least_ratio(p, rate)[..., None]).clip(0))


def deduction(x: Any, conditionals: Any, base_rate: Any = None) -> Conclusion:
    """Return the opinion on y from the opinion on x and conditional opinions.

    The projected probability follows the law of total probability. The base rates of y follow from the conditionals
    (equal if all are vacuous).

    Parameters
    ----------
    x : (..., K) float32 or float64, numpy or torch
    conditionals : (..., K, L)
        Beliefs in the states of y for each state of x.
    base_rate : (K,) or (..., K), optional
        Prior probabilities of the states of x.

    Returns
    -------
    Conclusion
        Beliefs (..., L) and base rates (..., L) of y.

    Notes
    -----
    Jøsang (2016), section 9.5: a vacuous x leaves the greatest unknown that the conditionals allow.
    """
    given, of_y = _checked(x, "x"), _checked(conditionals, "conditionals")
    rate = _base_rate(base_rate, given)
    return _deduced(given, of_y, rate, _marginal_base_rate(of_y, rate))


def inversion(conditionals: Any, base_rate: Any = None) -> Conclusion:
    """Return opinions on x for each state of y from opinions on y for each state of x, by Bayes' theorem.

    Parameters
    ----------
    conditionals : (..., K, L) float32 or float64, numpy or torch
        Beliefs in the states of y for each state of x.
    base_rate : (K,) or (..., K), optional
        Prior probabilities of the states of x.

    Returns
    -------
    Conclusion
        Beliefs (..., L, K) in the states of x for each state of y, and the base rates (..., L) of y. For a state of y
        with probability 0 in all states of x, x is vacuous.

    Notes
    -----
    Jøsang (2016), section 10.6. Unknown is the greatest value that the inverted probability allows, times
    r + i - r i, with the unknown r of the conditionals relative to its maximum, and the irrelevance i of y for x.
    """
    of_y = _checked(conditionals, "conditionals")
    rate = _base_rate(base_rate, of_y[..., 0])
    return _inverted(of_y, rate)


def abduction(y: Any, conditionals: Any, base_rate: Any = None) -> Conclusion:
    """Return the opinion on x, given the opinion on y and opinions on y for each state of x.

    The conditionals are inverted (`inversion`); `deduction` then goes from y to x.

    Parameters
    ----------
    y : (..., L) float32 or float64, numpy or torch
    conditionals : (..., K, L)
        Beliefs in the states of y for each state of x.
    base_rate : (K,) or (..., K), optional
        Prior probabilities of the states of x.

    Returns
    -------
    Conclusion
        Beliefs (..., K) and base rates (..., K) of x.
    """
    given, of_y = _checked(y, "y"), _checked(conditionals, "conditionals")
    rate = _base_rate(base_rate, of_y[..., 0])
    of_x, rate_of_y = _inverted(of_y, rate)
    return _deduced(given, of_x, rate_of_y, rate)


def _deduced(x: Any, conditionals: Any, rate_of_x: Any, rate_of_y: Any) -> Conclusion:
    xp = namespace(x)
    u, u_if = 1 - x.sum(-1), 1 - conditionals.sum(-1)
    p_if = conditionals + rate_of_y[..., None, :] * u_if[..., None]
    # Law of total probability
    p = ((x + rate_of_x * u[..., None])[..., None] * p_if).sum(-2)
    # Greatest unknown of y for a vacuous x: the apex of the simplex of conditionals
    lowest = _over_states(xp.minimum, conditionals, -2)
    apex = _least_ratio((rate_of_x[..., None] * p_if).sum(-2) - lowest, rate_of_y).clip(0, 1)
    unknown = u * apex + (x * u_if).sum(-1)
    belief = (p - rate_of_y * unknown[..., None]).clip(0)  # rounding may give negative beliefs
    return Conclusion(belief, rate_of_y + 0 * belief)


def _inverted(conditionals: Any, rate: Any) -> Conclusion:
    xp = namespace(conditionals)
    rate_of_y = _marginal_base_rate(conditionals, rate)
    u_if = (1 - conditionals.sum(-1)).clip(0)
    p_if = conditionals + rate_of_y[..., None, :] * u_if[..., None]  # (..., K, L)
    # Bayes' theorem
    p_y = (rate[..., None] * p_if).sum(-2)
    never = p_y <= 0
    likelihood_ratio = xp.where(never[..., None, :], 1 + 0 * p_if, p_if / (p_y + never)[..., None, :])
    p_x = rate[..., None] * likelihood_ratio
    # Greatest unknown of x, times the relative unknown of the conditionals combined with the irrelevance of y
    greatest = _over_states(xp.minimum, likelihood_ratio, -2).clip(0, 1)
    highest, lowest = _over_states(xp.maximum, p_if, -2), _over_states(xp.minimum, p_if, -2)
    irrelevance = xp.where(never, 1 + 0 * p_y, 1 - (highest - lowest))
    weights = u_if.sum(-1)
    weights = u_if / (weights + (weights == 0))[..., None]
    bound = _least_ratio(p_if, rate_of_y[..., None, :])
    relative = (weights * u_if / (bound + (bound == 0))).sum(-1)[..., None]
    unknown = greatest * (relative + irrelevance - relative * irrelevance)
    belief = (xp.moveaxis(p_x, -1, -2) - rate[..., None, :] * unknown[..., None]).clip(0)
    return Conclusion(belief, rate_of_y)


def _marginal_base_rate(conditionals: Any, rate: Any) -> Any:
    """Return the marginal base rates of y, equal where all conditionals are vacuous."""
    xp = namespace(conditionals)
    beliefs = (rate[..., None] * conditionals).sum(-2)
    known = beliefs.sum(-1)[..., None]
    vacuous = known <= 0
    return xp.where(vacuous, 1 / beliefs.shape[-1] + 0 * beliefs, beliefs / (known + vacuous))


def _opinion(belief: Any, name: str) -> tuple[Any, Any]:
    """Check beliefs (..., K); return them and unknown (...)."""
    b = _checked(belief, name)
    return b, (1 - b.sum(-1)).clip(0)


def _checked(belief: Any, name: str) -> Any:
    """Return beliefs as an array or tensor; in numpy check every opinion."""
    b = belief if hasattr(belief, "dtype") else np.asarray(belief, np.float64)
    xp = check_float(b, name)
    if b.ndim == 0 or b.shape[-1] < 2:
        raise ValueError(f"{name} must have beliefs in at least 2 states on the last axis, got shape {tuple(b.shape)}")
    if xp is np:
        outside = np.maximum(-b.min(-1), b.sum(-1) - 1)
        must = "be non-negative and sum to at most 1 in every opinion"
        refuse_worst(outside, tolerance_of(b) * b.shape[-1], b, name, must)
    return b.clip(0)


def _base_rate(base_rate: Any, like: Any) -> Any:
    """Return base rates in the library and dtype of beliefs (..., K)."""
    xp, states = namespace(like), like.shape[-1]
    if base_rate is None:
        return 0 * like + 1 / states
    if xp is np or not hasattr(base_rate, "detach"):
        rate = np.asarray(base_rate, np.float64)
        if rate.shape[-1:] != (states,) or not ((rate >= 0).all() and (abs(rate.sum(-1) - 1) <= 1e-6).all()):
            raise ValueError(
                f"base_rate must be {states} prior probabilities with sum 1, one for each state, got {base_rate}"
            )
        base_rate = rate.astype(like.dtype) if xp is np else xp.as_tensor(rate, dtype=like.dtype, device=like.device)
    return base_rate


def _over_states(choose: Any, values: Any, axis: int) -> Any:
    """Reduce an axis by a function of two arrays, such as ``minimum`` or ``maximum``."""
    moved = namespace(values).moveaxis(values, axis, 0)
    return reduce(choose, [moved[k] for k in range(moved.shape[0])])


def _least_ratio(above: Any, below: Any) -> Any:
    """Return the least quotient over the last axis; a quotient with divisor 0 counts as 1."""
    xp = namespace(above)
    zero = below <= 0
    quotient = xp.where(zero, 1 + 0 * above, above / (below + zero))
    return _over_states(xp.minimum, quotient, -1)
