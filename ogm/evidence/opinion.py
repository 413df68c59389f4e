"""The readings of a pair: mass, subjective opinion, Dirichlet evidence.

A cell holds ``mass = (free, occupied)``, the belief masses of a binary frame; ``unknown = 1 - free -
occupied`` is derived. The same pair is, in other words,

* a subjective opinion (belief = occupied, disbelief = free, uncertainty = unknown, base rate a of occupied),
* evidence ``e = W b / u`` with prior weight W,
* a Dirichlet (here: Beta) density with ``alpha = e + W a``,
* a probability of being occupied, see `ogm.evidence.probability`.

Sources: Shafer, *A Mathematical Theory of Evidence* (1976); Jøsang, *Subjective Logic* (2016), chapter 3.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ogm.evidence.arrays import Array, as_like, check_form, namespace, per_cell, refuse, rounding, split, stack_last


@dataclass(frozen=True, slots=True, init=False, repr=False)
class Opinion:
    """The opinion about one cell, with a readable repr; computations on many cells use arrays.

    Parameters
    ----------
    free, occupied : float
        Belief masses in [0, 1].
    unknown : float, optional
        The rest to one, derived by default; where given, the three must sum to one (within 1e-6).
    base_rate : float
        Prior probability of occupied, in [0, 1]; 0.5 prefers neither state.

    Raises
    ------
    ValueError
        If a number is NaN or outside [0, 1], or if the masses do not sum to one.
    """

    free: float
    occupied: float
    unknown: float
    base_rate: float

    def __init__(self, free: float, occupied: float, unknown: float | None = None, base_rate: float = 0.5) -> None:
        if unknown is None:
            rest = 1 - free - occupied
            unknown = 0.0 if -1e-6 <= rest < 0 else rest
        numbers = {"free": free, "occupied": occupied, "unknown": unknown, "base_rate": base_rate}
        for name, number in numbers.items():
            if not -1e-6 <= number <= 1 + 1e-6:
                raise ValueError(f"{name} must lie in [0, 1], got {number} in {numbers}")
            object.__setattr__(self, name, float(number))
        total = free + occupied + unknown
        if not abs(total - 1) <= 1e-6:
            raise ValueError(f"free + occupied + unknown must be 1, got {total}; leave unknown out to have it derived")

    @classmethod
    def from_mass(cls, mass: Any, base_rate: float = 0.5) -> "Opinion":
        """Return the opinion of one pair, an array or tensor of shape (2,)."""
        free, occupied, u = split(mass)
        if free.ndim:
            raise ValueError(f"an opinion is one cell, mass of shape (2,); got shape {tuple(mass.shape)}")
        return cls(float(free), float(occupied), float(u), base_rate)

    @property
    def mass(self) -> np.ndarray:
        """The pair (free, occupied) as a (2,) float64 array."""
        return np.array([self.free, self.occupied])

    @property
    def probability(self) -> float:
        """Projected probability of occupied, occupied + base_rate * unknown."""
        return self.occupied + self.base_rate * self.unknown

    def __repr__(self) -> str:
        base_rate = "" if self.base_rate == 0.5 else f", base_rate={self.base_rate:.2f}"
        masses = f"free={self.free:.2f}, occupied={self.occupied:.2f}, unknown={self.unknown:.2f}"
        return f"Opinion({masses}{base_rate})"


def unknown(mass: Array) -> Array:
    """Return the mass of unknown, 1 - free - occupied, never below zero.

    In float32 it is exact to 6e-8: below an unknown of 1e-5 its relative error exceeds 0.6 %.
    """
    return per_cell(split(mass)[2], mass)


def mass_to_evidence(mass: Array, prior_weight: float = 2.0, min_unknown: float = 0.0) -> Array:
    """Return the Dirichlet evidence of a mass, e = W b / u.

    Parameters
    ----------
    mass : (..., 2) float32 or float64, numpy or torch
    prior_weight : float
        W > 0, the prior weight; 2 makes the vacuous opinion the uniform density.
    min_unknown : float
        Floor of u in [0, 1). At 0 a dogmatic cell has infinite evidence for what it believes; a floor of 2e-5
        caps evidence at 1e5, the most that float32 masses can carry with an error below one percent.

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

    def of(belief: Any) -> Any:
        infinite = xp.where(belief > 0, xp.inf, 0.0)
        return xp.where(dogmatic, xp.asarray(infinite, dtype=belief.dtype), prior_weight * belief / safe)

    return stack_last(xp, [of(free), of(occupied)], mass)


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
        If a numpy array holds negative, infinite or NaN evidence; the message names the first.
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
        If a numpy array holds an alpha below its prior: that would be negative evidence.
    """
    _check_weight(prior_weight)
    xp = check_form(alpha, "alpha")
    given: Any = alpha
    rate = as_like(base_rate, given[..., 0], "base_rate")
    evidence = stack_last(xp, [given[..., 0] - prior_weight * (1 - rate), given[..., 1] - prior_weight * rate], alpha)
    _check_positive(evidence, "alpha - prior")
    return evidence


def _split_evidence(evidence: Any, prior_weight: float) -> tuple[Any, Any, Any]:
    """Check evidence; return (module, free, occupied)."""
    _check_weight(prior_weight)
    xp = check_form(evidence, "evidence")
    _check_positive(evidence, "evidence")
    return xp, evidence[..., 0], evidence[..., 1]


def _check_weight(prior_weight: float) -> None:
    if not prior_weight > 0:
        raise ValueError(f"prior_weight must be greater than 0, got {prior_weight}")


def _check_positive(values: Any, name: str) -> None:
    """Refuse negative, infinite and NaN numbers of a numpy array, naming the first."""
    if namespace(values) is np and not (values.min(initial=0) >= 0 and np.isfinite(values.max(initial=0))):
        refuse(~(np.isfinite(values) & (values >= 0)), values, name, "be finite and not negative")
