"""Conversions between masses, subjective opinions, Dirichlet evidence and Dirichlet parameters.

A cell holds ``mass = (free, occupied)``, the belief masses of a binary frame; ``unknown = 1 - free - occupied`` is
derived. The same pair stands for

* a subjective opinion (belief = occupied, disbelief = free, uncertainty = unknown, base rate a of occupied),
* evidence ``e = W b / u`` with prior weight W,
* a Dirichlet (here: Beta) density with ``alpha = e + W a``,
* a probability of being occupied, see `ogm.evidence.probability`.

Sources: Shafer, *A Mathematical Theory of Evidence* (1976); Jøsang, *Subjective Logic* (2016), chapter 3.
"""

from typing import Any, cast

import numpy as np

from ogm.evidence.arrays import Array, as_like, check_form, namespace, per_cell, refuse, rounding, split, stack_last
from ogm.evidence.kinds import takes_masses


@takes_masses("mass", gives_masses=False)
def unknown(mass: Array) -> Array:
    """Return the mass of unknown, 1 - free - occupied, never below zero.

    In float32 the error is up to 6e-8: below an unknown of 1e-5 the relative error exceeds 0.6 %.
    """
    return per_cell(split(mass)[2], mass)


@takes_masses("mass", gives_masses=False)
def mass_to_evidence(mass: Array, prior_weight: float = 2.0, min_unknown: float = 0.0) -> Array:
    """Return the Dirichlet evidence of a mass, e = W b / u.

    Parameters
    ----------
    mass : (..., 2) float32 or float64, numpy or torch
    prior_weight : float
        W > 0, the prior weight; 2 makes the vacuous opinion the uniform density.
    min_unknown : float
        Lower bound of u, in [0, 1). With 0, a dogmatic cell has infinite evidence. With 2e-5, evidence is at most 1e5,
        the greatest evidence that float32 masses represent with an error below one percent.

    Returns
    -------
    (..., 2), evidence in [0, inf]

    Notes
    -----
    Jøsang (2016), eq. 3.33 [the mapping of opinions and Dirichlet densities].
    """
    _check_weight(prior_weight)
    free, occupied, u = split(mass)
    xp = namespace(mass)
    floor = as_like(min_unknown, free, "min_unknown")
    u = u.clip(floor)
    dogmatic = u <= rounding(mass)
    safe = xp.where(dogmatic, xp.ones_like(u), u)
    limits = (xp.asarray(xp.where(belief > 0, xp.inf, 0.0), dtype=u.dtype) for belief in (free, occupied))
    finite = (prior_weight * belief / safe for belief in (free, occupied))
    return stack_last(xp, [xp.where(dogmatic, *pair) for pair in zip(limits, finite, strict=True)], mass)


def evidence_to_mass(evidence: Array, prior_weight: float = 2.0) -> Array:
    """Return the mass of Dirichlet evidence, b = e / (W + e_free + e_occupied).

    Parameters
    ----------
    evidence : (..., 2) float32 or float64, numpy or torch
        Evidence for (free, occupied), finite and not negative.
    prior_weight : float
        W > 0.

    Raises
    ------
    ValueError
        If a numpy array holds negative, infinite or NaN evidence; the message has the first.
    """
    xp, free, occupied = _split_evidence(evidence, prior_weight)
    strength = prior_weight + free + occupied
    return stack_last(xp, [free / strength, occupied / strength], evidence)


def evidence_to_alpha(evidence: Array, prior_weight: float = 2.0, base_rate: float = 0.5) -> Array:
    """Return the Dirichlet parameters, alpha = e + W (1 - a, a); with the defaults alpha = e + 1."""
    xp, free, occupied = _split_evidence(evidence, prior_weight)
    rate = as_like(base_rate, free, "base_rate")
    return stack_last(xp, [free + prior_weight * (1 - rate), occupied + prior_weight * rate], evidence)


def alpha_to_evidence(alpha: Array, prior_weight: float = 2.0, base_rate: float = 0.5) -> Array:
    """Return the evidence of Dirichlet parameters, e = alpha - W (1 - a, a).

    Raises
    ------
    ValueError
        If a numpy array holds an alpha below the prior, which means negative evidence.
    """
    _check_weight(prior_weight)
    xp = check_form(alpha, "alpha")
    free, occupied = (cast(Any, alpha)[..., state] for state in (0, 1))
    rate = as_like(base_rate, free, "base_rate")
    evidence = stack_last(xp, [free - prior_weight * (1 - rate), occupied - prior_weight * rate], alpha)
    _check_positive(evidence, "alpha - prior")
    return evidence


def _split_evidence(evidence: Any, prior_weight: float) -> tuple[Any, Any, Any]:
    """Check evidence; return library, free and occupied."""
    _check_weight(prior_weight)
    xp = check_form(evidence, "evidence")
    _check_positive(evidence, "evidence")
    return xp, evidence[..., 0], evidence[..., 1]


def _check_weight(prior_weight: float) -> None:
    if not prior_weight > 0:
        raise ValueError(f"prior_weight must be greater than 0, got {prior_weight}")


def _check_positive(values: Any, name: str) -> None:
    """Raise ValueError for negative, infinite or NaN numbers of a numpy array, with the first."""
    if namespace(values) is np and not (values.min(initial=0) >= 0 and np.isfinite(values.max(initial=0))):
        refuse(~(np.isfinite(values) & (values >= 0)), values, name, "be finite and not negative")
