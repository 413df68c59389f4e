"""Parameters of a geometric sensor model from labelled frames, by maximum likelihood.

>>> from ogm.datasets import open_dataset
>>> from ogm.evaluation import calibrate
>>> fitted = calibrate(open_dataset("data/", split="train"), "ray")                                # doctest: +SKIP
>>> fitted.save("ray.json")                    # a model's name from now on: evaluate({"mine": "ray.json"}, ...)
"""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from math import exp, inf, isfinite, log
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ogm.evaluation.likelihood import Likelihood, default_parameters
from ogm.evaluation.statistics import MIN_SAMPLES
from ogm.files import OgmError, atomic_write
from ogm.grid import GridSpec
from ogm.scan import Frame

__all__ = ["BOUNDS", "FITTED", "Calibration", "calibrate"]

FORMAT = "ogm.calibration/1"
FITTED = {  # by default
    "ray": (
        *("p_miss", "p_false_alarm", "free_reliability_at_hits", "no_return_weight", "obstacle_height", "max_mass"),
    ),
    "height-band": ("z_min", "z_max", "evidence"),
}
BOUNDS = {  # that a parameter is searched in
    **{"p_miss": (0.01, 0.999), "p_false_alarm": (1e-4, 0.8), "max_mass": (0.5, 0.9999)},
    **{"free_reliability_at_hits": (0.0, 1.0), "no_return_weight": (0.0, 1.0)},
    **{"obstacle_height": (0.03, 0.5), "clearance": (1.0, 3.0), "below_ground": (0.05, 2.0), "range_noise": (0.0, 0.2)},
    **{"max_range": (20.0, 200.0), "azimuth_step": (0.001, 0.05), "ground_cell": (0.2, 3.0)},
    **{"z_min": (0.05, 1.5), "z_max": (1.6, 3.0), "evidence": (0.1, 100.0)},
}
LOGIT = ("p_miss", "p_false_alarm", "max_mass")  # searched by their log odds
REPORTED = ("nll", "false_free", "missed_occupied", "false_occupied", "iou_free", "iou_occupied", "ece")
DIGITS = 6  # of a fitted parameter
XTOL, FTOL = 1e-2, 1e-4  # of the search: share of the bounds' range, and of the NLL
STEP = 0.02  # of the differences behind standard errors, as a share of the bounds' range
IMPOSSIBLE = 1e3  # [nats] where a model refuses its parameters


@dataclass(frozen=True)
class Calibration:
    """Fitted parameters of a geometric model.

    Parameters
    ----------
    model : {"ray", "height-band"}
    parameters : dict of str to float
        The fitted ones, and those of the calibration that the fit started from.
    start : dict of str to float
        The same before the fit.
    errors : dict of str to float or None
        Standard errors of the fitted parameters; None where there is none: fewer than five drives, a parameter at its
        bound or without effect, an interrupted fit.
    before, after : dict of str to float
        Metrics of `ogm.metrics` on the frames of the fit: means over the frames of a drive, then over drives.
    data : dict
        What the frames are from, and how many they and their drives are.
    evaluations : int
        How many sets of parameters were tried.
    finished : bool
        False if the fit was interrupted.
    """

    model: str
    parameters: dict[str, float]
    start: dict[str, float] = field(default_factory=dict)
    errors: dict[str, float | None] = field(default_factory=dict)
    before: dict[str, float] = field(default_factory=dict)
    after: dict[str, float] = field(default_factory=dict)
    data: dict[str, Any] = field(default_factory=dict)
    evaluations: int = 0
    finished: bool = True

    def __post_init__(self) -> None:
        known = default_parameters(self.model)
        for name, value in self.parameters.items():
            if name not in known:
                raise OgmError(f"{self.model} has no parameter {name!r}; it has {', '.join(known)}")
            if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
                raise OgmError(f"{name} must be a finite number, got {value!r}")

    def save(self, path: str | Path) -> None:
        """Write a JSON file, whole or not at all."""
        with atomic_write(path, "w") as file:
            json.dump({"format": FORMAT} | asdict(self), file, indent=1)
            file.write("\n")

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what `save` wrote.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        OgmError
            If it is no calibration, or one with a model or parameters that this version does not have.
        """
        try:
            record = json.loads(Path(path).read_text("utf-8"))
            if not isinstance(record, dict) or record.pop("format", None) != FORMAT:
                raise OgmError(f"no {FORMAT} that `ogm calibrate` wrote")
            return cls(**record)
        except (ValueError, TypeError, AttributeError) as error:
            raise OgmError(f"{path}: {error}") from error


def calibrate(
    dataset: Sequence[Frame],
    model: str = "ray",
    spec: GridSpec | None = None,
    *,
    fit: Mapping[str, tuple[float, float]] | None = None,
    frames: Iterable[int] | None = None,
    threads: int = 1,
    reading: Callable[[Iterable[int]], Iterable[int]] = iter,
    progress: Callable[[int, float], object] = lambda evaluations, nll: None,
) -> Calibration:
    """Fit the parameters of a geometric model to labelled frames (Thrun, Burgard, Fox 2005, Sec. 9.3).

    Minimises the mean over drives of `Likelihood`, the log loss on known cells, by Powell's method within bounds.
    Nothing is drawn at random. An interrupt (Ctrl-C) ends the search: the best parameters so far are returned.

    Parameters
    ----------
    dataset : sequence of Frame
        Frames with truth, as `ogm.datasets.open_dataset` returns them.
    model : str
        "ray" or "height-band", or the path of a calibration to start from.
    spec : GridSpec, optional
        The cells; by default the 81.92 m x 56.32 m of the paper.
    fit : dict of str to (low, high), optional
        The fitted parameters with their bounds; by default those of `FITTED`, within `BOUNDS`. One without effect on
        these frames keeps its value.
    frames : iterable of int, optional
        Numbers of the frames; all by default.
    threads : int
        Frames that are mapped at the same time. The result does not depend on it.
    reading : function
        Iterates over the numbers of the frames while they are read, and may draw a progress bar.
    progress : function
        Called after each evaluation with their number and the least NLL.

    Raises
    ------
    ValueError
        If there are no labelled frames, there is no such model or parameter, or bounds do not hold the start.
    """
    begun = Calibration.load(model) if model.endswith(".json") else Calibration(model, {})
    start = default_parameters(begun.model) | begun.parameters
    chosen = {name: BOUNDS[name] for name in FITTED[begun.model]} if fit is None else dict(fit)
    _check_fit(begun.model, chosen, start)
    numbers = range(len(dataset)) if frames is None else frames
    likelihood = Likelihood(begun.model, (dataset[k] for k in reading(numbers)), spec, threads=threads)

    search = _Search(likelihood, start, chosen, progress)
    errors: dict[str, float | None] = dict.fromkeys(chosen)
    finished = True
    try:
        search.keep_those_without_effect()
        search.minimise()
        errors |= search.standard_errors()
    except KeyboardInterrupt:
        finished = False

    names = [*dict.fromkeys([*begun.parameters, *chosen])]
    end = search.parameters(search.best)
    before, after = (
        {metric: scores[metric] for metric in REPORTED} for scores in map(likelihood.scores, (start, end))
    )
    about = {"name": "frames", "format": "frames in Python", "description": ""}
    data = {key: getattr(dataset, key, default) for key, default in about.items()}
    data |= {key: value for key, value in getattr(dataset, "facts", {}).items() if key in ("split", "plan")}
    data |= {"frames": len(likelihood.frames), "drives": len(likelihood.drives)}
    both = ({name: values[name] for name in names} for values in (end, start))
    return Calibration(begun.model, *both, errors, before, after, data, search.evaluations, finished)


def _check_fit(model: str, chosen: Mapping[str, tuple[float, float]], start: Mapping[str, float]) -> None:
    if not chosen:
        raise ValueError(f"there is nothing to fit: give parameters of {model}, such as {', '.join(FITTED[model])}")
    for name, (low, high) in chosen.items():
        if name not in start:
            raise ValueError(f"{model} has no parameter {name!r}; it has {', '.join(start)}")
        if not (-inf < low < high < inf and low <= start[name] <= high):
            raise ValueError(f"{name} starts at {start[name]:g}; its bounds must hold that, got {low:g} ... {high:g}")


@dataclass(frozen=True)
class _Axis:
    """A fitted parameter, and its coordinate from 0 to 1 between its bounds."""

    name: str
    low: float
    high: float

    def coordinate(self, value: float) -> float:
        low, high, at = map(self._scaled, (self.low, self.high, value))
        return (at - low) / (high - low)

    def value(self, coordinate: float) -> float:
        low, high = map(self._scaled, (self.low, self.high))
        at = low + min(max(coordinate, 0.0), 1.0) * (high - low)
        value = 1 / (1 + exp(-at)) if self._logit else at
        return min(max(float(f"{value:.{DIGITS}g}"), self.low), self.high)

    def _scaled(self, value: float) -> float:
        return log(value / (1 - value)) if self._logit else value

    @property
    def _logit(self) -> bool:
        return self.name in LOGIT and 0 < self.low and self.high < 1


class _Search:
    """The search for the least NLL: how often it was evaluated, and the best coordinates so far."""

    def __init__(
        self,
        likelihood: Likelihood,
        start: Mapping[str, float],
        chosen: Mapping[str, tuple[float, float]],
        progress: Callable[[int, float], object],
    ) -> None:
        self._likelihood, self._start, self._progress = likelihood, start, progress
        self._axes = [_Axis(name, *bounds) for name, bounds in chosen.items()]
        self.best = np.array([axis.coordinate(start[axis.name]) for axis in self._axes])
        self.evaluations, self._least = 0, inf

    def parameters(self, x: NDArray[np.float64]) -> dict[str, float]:
        """Return all parameters of the model at some coordinates."""
        return {**self._start, **{axis.name: axis.value(at) for axis, at in zip(self._axes, x, strict=True)}}

    def of_drives(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the NLL of every drive, and remember the best."""
        try:
            values = self._likelihood(self.parameters(x))
        except ValueError:  # such parameters do not go together
            if not self.evaluations:
                raise
            values = np.full(len(self._likelihood.drives), IMPOSSIBLE)
        self.evaluations += 1
        if values.mean() < self._least:
            self._least, self.best = float(values.mean()), np.array(x)
        self._progress(self.evaluations, self._least)
        return values

    def keep_those_without_effect(self) -> None:
        """Take parameters out of the search that change nothing on these frames, even at their bounds."""
        start = self.best.copy()
        now = self.of_drives(start)

        def matters(k: int) -> bool:
            ends = (np.where(np.arange(len(start)) == k, end, start) for end in (0.0, 1.0))
            return any((self.of_drives(x) != now).any() for x in ends)

        kept = [k for k in range(len(start)) if matters(k)]
        if not kept:
            raise ValueError(f"{', '.join(axis.name for axis in self._axes)} change nothing on these frames")
        self._axes, self.best = [self._axes[k] for k in kept], self.best[kept]

    def minimise(self) -> None:
        """Search for the least mean over drives."""
        from scipy.optimize import minimize  # doubles the time of the import

        minimize(
            lambda x: self.of_drives(x).mean(),
            np.clip(self.best, 0, 1),
            method="Powell",
            bounds=[(0, 1)] * len(self.best),
            options={"xtol": XTOL, "ftol": FTOL},
        )

    def standard_errors(self) -> dict[str, float | None]:
        """Return the standard errors of the parameters that lie within their bounds.

        The sandwich H^-1 C H^-1 / n: H is the Hessian of the mean NLL, C the covariance over the n drives of their
        gradients. Drives are taken for independent; cells and frames of one drive are not.
        """
        x, drives = self.best.copy(), len(self._likelihood.drives)
        inner = [k for k in range(len(x)) if STEP <= x[k] <= 1 - STEP]
        if drives < MIN_SAMPLES or not inner:
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
        spread = np.atleast_2d(np.cov(gradients))
        errors = np.sqrt(np.diag(inverse @ spread @ inverse) / drives)
        axes = [self._axes[k] for k in inner]
        slopes = [(axis.value(at + STEP) - axis.value(at - STEP)) / (2 * STEP) for axis, at in zip(axes, x[inner], strict=True)]
        return {axis.name: float(slope * one) for axis, slope, one in zip(axes, slopes, errors, strict=True)}
