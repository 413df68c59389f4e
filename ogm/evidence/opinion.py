"""Opinion about a cell as a value with operators.

>>> from ogm.evidence import Opinion
>>> lidar, radar = Opinion(free=0.1, occupied=0.6), Opinion(free=0.0, occupied=0.4)
>>> lidar + radar
Opinion(free=0.08, occupied=0.67, unknown=0.25)
>>> 0.5 * lidar
Opinion(free=0.05, occupied=0.30, unknown=0.65)

Source: Jøsang, *Subjective Logic* (2016), chapters 3, 6, 7 and 12.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from ogm.evidence.arrays import split


class Conclusion(NamedTuple):
    """Result of a logical operator: mass (..., 2), and base rate of the new proposition."""

    mass: Any
    base_rate: Any


@dataclass(frozen=True, slots=True, init=False, repr=False)
class Opinion:
    """Opinion about a cell or another proposition; computations on many cells use arrays.

    Rules of opinions return an opinion, as ``dempster(a, b, c)``. Operators: ``a + b`` and ``a - b`` add and subtract
    evidence (`cumulative`, `cumulative_unfusion`), ``0.8 * a`` is `discount`, ``a & b`` and ``a | b`` are
    `multiplication` and `comultiplication` with occupied as true, ``~a`` exchanges free and occupied.

    Parameters
    ----------
    free, occupied : float
        Belief masses in [0, 1].
    unknown : float, optional
        Rest to 1 by default; if given, the three masses must sum to 1 (within 1e-6).
    base_rate : float
        Prior probability of occupied, in [0, 1].

    Raises
    ------
    ValueError
        If a number is NaN or outside [0, 1], or the masses do not sum to 1.
    """

    free: float
    occupied: float
    unknown: float
    base_rate: float

    __array_ufunc__: ClassVar[None] = None  # so that a numpy number times an opinion is an opinion

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
            raise ValueError(f"free + occupied + unknown must be 1, got {total}; omit unknown to derive it")

    @classmethod
    def from_mass(cls, mass: Any, base_rate: float = 0.5) -> "Opinion":
        """Return the opinion of a pair (free, occupied): a list, an array or a tensor of shape (2,)."""
        mass = mass if hasattr(mass, "dtype") else np.asarray(mass)
        mass = mass.astype(np.float64) if isinstance(mass, np.ndarray) and mass.dtype.kind in "iub" else mass
        free, occupied, u = split(mass)
        if free.ndim:
            raise ValueError(f"mass must have shape (2,), got {tuple(mass.shape)}; use arrays for many cells")
        return cls(float(free), float(occupied), float(u), base_rate)

    @property
    def mass(self) -> NDArray[np.float64]:
        """Mass (free, occupied) as a (2,) float64 array."""
        return np.array([self.free, self.occupied])

    @property
    def probability(self) -> float:
        """Projected probability of occupied, occupied + base_rate * unknown."""
        return self.occupied + self.base_rate * self.unknown

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return the pair (free, occupied) for numpy."""
        return np.asarray(self.mass, dtype)

    def __add__(self, other: "Opinion") -> "Opinion":
        """Return the cumulative fusion of both opinions: evidence adds."""
        from ogm.evidence.subjective import cumulative

        return cumulative(self, other) if isinstance(other, Opinion) else NotImplemented

    def __sub__(self, other: "Opinion") -> "Opinion":
        """Return the opinion that gives this opinion by fusion with `other`: evidence subtracts."""
        from ogm.evidence.subjective import cumulative_unfusion

        return cumulative_unfusion(self, other) if isinstance(other, Opinion) else NotImplemented

    def __mul__(self, reliability: float) -> "Opinion":
        """Return the discounted opinion; the reliability is in [0, 1]."""
        from ogm.evidence.discounting import discount

        return NotImplemented if isinstance(reliability, Opinion) else discount(self, reliability)

    __rmul__ = __mul__

    def __and__(self, other: "Opinion") -> "Opinion":
        """Return the opinion that both of two independent propositions are true."""
        from ogm.evidence.logic import multiplication

        return cast(Opinion, multiplication(self, other)) if isinstance(other, Opinion) else NotImplemented

    def __or__(self, other: "Opinion") -> "Opinion":
        """Return the opinion that at least one of two independent propositions is true."""
        from ogm.evidence.logic import comultiplication

        return cast(Opinion, comultiplication(self, other)) if isinstance(other, Opinion) else NotImplemented

    def __invert__(self) -> "Opinion":
        """Return the opinion on the negated proposition."""
        return Opinion(self.occupied, self.free, self.unknown, 1 - self.base_rate)

    def __repr__(self) -> str:
        base_rate = "" if self.base_rate == 0.5 else f", base_rate={self.base_rate:.2f}"
        masses = f"free={self.free:.2f}, occupied={self.occupied:.2f}, unknown={self.unknown:.2f}"
        return f"Opinion({masses}{base_rate})"
