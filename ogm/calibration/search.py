"""Search for the parameters of greatest likelihood, and their standard errors."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import exp, inf, log

import numpy as np
from numpy.typing import NDArray

from ogm.calibration.likelihood import Likelihood
from ogm.evaluation.statistics import MIN_DRIVES
from ogm.extras import import_extra

LOGIT = ("p_miss", "p_false_alarm", "max_mass")  # searched by log odds
DIGITS = 6  # significant digits of a fitted parameter
XTOL, FTOL = 5e-3, 1e-5  # tolerances of the search, as shares of the range of the bounds and of the NLL
STEP = 0.01  # step of the finite differences for standard errors, as a share of the range of the bounds
INVALID_NLL = 1e3  # [nats] NLL of parameters that a model does not accept


@dataclass(frozen=True)
class Axis:
    """Fitted parameter with a coordinate from 0 to 1 between its bounds."""

    name: str
    low: float
    high: float

    def coordinate(self, value: float) -> float:
        """Return the coordinate of a value."""
        low, high, at = map(self._scaled, (self.low, self.high, value))
        return (at - low) / (high - low)

    def value(self, coordinate: float) -> float:
        """Return the value at a coordinate, rounded to `DIGITS`."""
        low, high = map(self._scaled, (self.low, self.high))
        at = low + min(max(coordinate, 0.0), 1.0) * (high - low)
        value = 1 / (1 + exp(-at)) if self._logit else at
        return min(max(float(f"{value:.{DIGITS}g}"), self.low), self.high)

    def _scaled(self, value: float) -> float:
        return log(value / (1 - value)) if self._logit else value

    @property
    def _logit(self) -> bool:
        return self.name in LOGIT and self.low > 0 and self.high < 1


class LikelihoodSearch:
    """Search for the least NLL, with the number of evaluations and the best coordinates so far."""

    best: NDArray[np.float64]
    evaluations: int

    def __init__(
        self,
        likelihood: Likelihood,
        start: Mapping[str, float],
        chosen: Mapping[str, tuple[float, float]],
        progress: Callable[[int, float], object],
    ) -> None:
        self._likelihood, self._start, self._progress = likelihood, start, progress
        self._axes = [Axis(name, *bounds) for name, bounds in chosen.items()]
        self.best = np.array([axis.coordinate(start[axis.name]) for axis in self._axes])
        self.evaluations, self._least = 0, inf

    def parameters(self, x: NDArray[np.float64]) -> dict[str, float]:
        """Return all parameters of the model at the given coordinates."""
        return {**self._start, **{axis.name: axis.value(at) for axis, at in zip(self._axes, x, strict=True)}}

    def of_drives(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the NLL of each drive, and store the best coordinates."""
        try:
            values = self._likelihood(self.parameters(x))
        except ValueError:  # an invalid combination of parameters
            if not self.evaluations:
                raise
            values = np.full(len(self._likelihood.drives), INVALID_NLL)
        self.evaluations += 1
        if values.mean() < self._least:
            self._least, self.best = float(values.mean()), np.array(x)
        self._progress(self.evaluations, self._least)
        return values

    def drop_parameters_without_effect(self) -> None:
        """Remove parameters from the search that do not change the NLL, even at their bounds."""
        start = self.best.copy()
        now = self.of_drives(start)

        def matters(k: int) -> bool:
            ends = (np.where(np.arange(len(start)) == k, end, start) for end in (0.0, 1.0))
            return any((self.of_drives(x) != now).any() for x in ends)

        kept = [k for k in range(len(start)) if matters(k)]
        if not kept:
            names = ", ".join(axis.name for axis in self._axes)
            raise ValueError(f"{names} have no effect on these frames; give other parameters to fit")
        self._axes, self.best = [self._axes[k] for k in kept], self.best[kept]

    def minimise(self) -> None:
        """Minimise the mean over drives."""
        minimize = import_extra("scipy.optimize", "evaluate").minimize

        minimize(
            lambda x: self.of_drives(x).mean(),
            np.clip(self.best, 0, 1),
            method="Powell",
            bounds=[(0, 1)] * len(self.best),
            options={"xtol": XTOL, "ftol": FTOL},
        )

    def newton_step(self) -> dict[str, float]:
        """Take a Newton step from the best parameters; return the standard errors of parameters inside their bounds.

        The sandwich estimate H^-1 C H^-1 / n, with the Hessian H of the mean NLL and the covariance C of the gradients
        of the n drives. It assumes independent drives, but not independent cells or frames of a drive.
        """
        x, drives = self.best.copy(), len(self._likelihood.drives)
        inner = [k for k in range(len(x)) if STEP <= x[k] <= 1 - STEP]
        if drives < MIN_DRIVES or not inner:
            return {}
        steps = STEP * np.eye(len(x))[inner]
        here = self.of_drives(x)
        up, down = (np.array([self.of_drives(x + sign * step) for step in steps]) for sign in (1, -1))
        gradients, hessian = (up - down) / (2 * STEP), np.diag((up + down - 2 * here).mean(axis=1))
        for i in range(len(inner)):
            for j in range(i):
                mixed = (self.of_drives(x + steps[i] + steps[j]) - up[i] - up[j] + here).mean()
                hessian[i, j] = hessian[j, i] = mixed
        hessian /= STEP**2
        if np.linalg.eigvalsh(hessian)[0] <= 0:
            return {}
        inverse = np.linalg.inv(hessian)
        self.of_drives(np.clip(x - inverse @ gradients.mean(axis=1) @ np.eye(len(x))[inner], 0, 1))
        spread = np.atleast_2d(np.cov(gradients))
        errors = np.sqrt(np.diag(inverse @ spread @ inverse) / drives)
        axes = [self._axes[k] for k in inner]
        slopes = [
            (axis.value(at + STEP) - axis.value(at - STEP)) / (2 * STEP)
            for axis, at in zip(axes, x[inner], strict=True)
        ]
        return {axis.name: float(slope * error) for axis, slope, error in zip(axes, slopes, errors, strict=True)}
