"""Models over many frames: every score of every model in every frame, and what follows from it."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from ogm.grid import EvidentialGrid, GridSpec
from ogm.metrics.counts import ConfusionSums, accumulate
from ogm.metrics.paired import Interval, Paired, bootstrap_mean, paired
from ogm.metrics.ranges import distances
from ogm.metrics.scores import METRICS, score
from ogm.scan import InverseSensorModel, as_scan

__all__ = ["Evaluation", "ModelFor", "Mounted", "evaluate", "model_for", "resample_to"]

ModelFor = Callable[[NDArray[np.float64]], InverseSensorModel]  # (4, 4) pose of the sensor -> its model


class Sample(Protocol):
    """A scan with its truth: the simulator's samples are such."""

    @property
    def points(self) -> NDArray[np.float32]:
        """Points of the scan, (N, 4)."""
        ...

    @property
    def truth(self) -> Any:
        """The truth: has ``crop(spec)``, whose result has ``state``."""
        ...


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What `evaluate` found.

    Parameters
    ----------
    models : tuple of str
    spec : GridSpec
        The cells that were judged.
    values : dict of str to (models, frames) float64
        Each metric of `METRICS` of every model in every frame; NaN where a frame has no such value.
    pooled : tuple of Tally
        Of every model, the counts over all frames.
    truth : (frames, 4)
        Shares of the cells whose truth is unknown, free, occupied, ignored.
    """

    models: tuple[str, ...]
    spec: GridSpec
    values: dict[str, NDArray[np.float64]]
    pooled: tuple[ConfusionSums, ...]
    truth: NDArray[np.float64]

    def __str__(self) -> str:
        """Tabulate the means over frames: a row per metric, a column per model."""
        means = {model: self.macro(model) for model in self.models}
        width = max(12, *(len(model) + 2 for model in self.models))
        lines = [
            f"{'mean of ' + str(self.frames) + ' frames':22}" + "".join(f"{m:>{width}}" for m in self.models)
        ]
        lines += [
            f"{metric:22}" + "".join(f"{means[m][metric]:>{width}.4f}" for m in self.models)
            for metric in self.values
        ]
        return "\n".join(lines)

    @classmethod
    def from_counts(
        cls,
        models: Sequence[str],
        spec: GridSpec,
        frames: Iterable[tuple[Sequence[ConfusionSums], NDArray[np.floating]]],
    ) -> Self:
        """Build an evaluation from what was counted before: `evaluate` ends here, and so can a loop of one's own.

        Parameters
        ----------
        models : sequence of str
            Names, each once.
        spec : GridSpec
            The cells that were judged.
        frames : iterable of (counts, truth)
            Of each frame, the counts of every model in their order, and the shares of its cells whose truth is
            unknown, free, occupied, ignored, (4,). Looked at once, none is kept: give an iterator where many frames
            would not fit into memory.

        Raises
        ------
        ValueError
            If there is no model or no frame, a name comes twice, or the numbers of models or frames differ.
        """
        names = tuple(models)
        if not names or len(set(names)) < len(names):
            raise ValueError(f"models need names, each once, got {names}")
        pooled: list[ConfusionSums] = []
        rows, shares = [], []
        for k, (counts, truth) in enumerate(frames):
            if len(counts) != len(names) or np.shape(truth) != (4,):
                raise ValueError(
                    f"frame {k} has counts of {len(counts)} models and {np.shape(truth)} shares of truth, wanted "
                    f"{len(names)} ({', '.join(names)}) and (4,)"
                )
            pooled = [a.plus(b) for a, b in zip(pooled, counts, strict=True)] if pooled else list(counts)
            rows.append([list(score(one).values()) for one in counts])
            shares.append(truth)
        if not rows:
            raise ValueError("no frames to build an evaluation from")
        values = np.array(rows).transpose(2, 1, 0)
        return cls(
            names,
            spec,
            dict(zip(METRICS, values, strict=True)),
            tuple(pooled),
            np.array(shares, np.float64),
        )

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.truth)

    def of(self, model: str, metric: str) -> NDArray[np.float64]:
        """Return a metric of a model in every frame, (frames,)."""
        if model not in self.models:
            raise KeyError(f"there is no model {model!r} here, only {', '.join(self.models)}")
        if metric not in self.values:
            raise KeyError(f"there is no metric {metric!r}, only {', '.join(self.values)}")
        return self.values[metric][self.models.index(model)]

    def macro(self, model: str) -> dict[str, float]:
        """Return the means over frames of every metric; frames without a value are left out."""
        return {metric: _mean(self.of(model, metric)) for metric in self.values}

    def micro(self, model: str) -> dict[str, float]:
        """Return every metric of all frames' cells together."""
        return score(self.pooled[self.models.index(model)])

    def interval(
        self, model: str, metric: str, rng: np.random.Generator, groups: Sequence[str] | None = None
    ) -> Interval:
        """Return a metric's mean over frames with its 95 % bootstrap interval, see `bootstrap_mean`."""
        return bootstrap_mean(self.of(model, metric), rng, groups=groups)

    def compare(
        self, model: str, other: str, rng: np.random.Generator, groups: Sequence[str] | None = None
    ) -> dict[str, Paired]:
        """Compare two models frame by frame, in every metric of which one direction is better, see `paired`."""
        return {
            metric: paired(
                self.of(model, metric), self.of(other, metric), METRICS[metric].better, rng, groups=groups
            )
            for metric in self.values
            if METRICS[metric].better
        }


def evaluate(
    models: Mapping[str, InverseSensorModel | ModelFor],
    samples: Iterable[Sample],
    spec: GridSpec | None = None,
) -> Evaluation:
    """Judge models on the same samples.

    Parameters
    ----------
    models : dict of str to model
        A model is anything with ``.spec`` that maps points to an `EvidentialGrid`. Where samples differ in how
        their sensor is mounted, give a function instead: ``T -> model``, for T the (4, 4) pose of the sensor
        over the ground below it (its height in ``T[2, 3]``, its tilt; no shift in x and y, as the truth lies
        around the sensor). It is called when a sample's T differs from that of the sample before.
    samples : iterable
        Each with ``.points`` (N, 4) in the sensor's frame and ``.truth``, a `Truth` that covers `spec`; with
        ``.T_vehicle_sensor`` if a model is given as a function. Read one after the other, none is kept.
    spec : GridSpec, optional
        The cells to judge; by default those of the first model. Grids of coarser cells of the same area are
        repeated onto them, see `resample_to`.

    Returns
    -------
    Evaluation

    Raises
    ------
    ValueError
        If there is no model or no sample, or a grid covers another area than `spec`.
    """
    if not models:
        raise ValueError("no models to judge: give at least one by its name")
    mounted = [Mounted(model) for model in models.values()]
    queue = iter(samples)
    first = next(queue, None)
    if first is None:
        raise ValueError("no samples to judge the models on")
    cells = spec or mounted[0](first).spec
    away = distances(cells)

    def judged(sample: Sample) -> tuple[list[ConfusionSums], NDArray[np.float64]]:
        grids = [model(sample)(as_scan(sample.points)) for model in mounted]
        state = sample.truth.crop(cells).state
        counts = [accumulate(resample_to(grid, cells).mass, state, away) for grid in grids]
        return counts, np.bincount(state.ravel(), minlength=4) / state.size

    return Evaluation.from_counts(tuple(models), cells, map(judged, chain([first], queue)))


def resample_to(grid: EvidentialGrid, spec: GridSpec) -> EvidentialGrid:
    """Return the grid on the cells of `spec`: itself, or each of its coarser cells repeated.

    Nothing is interpolated: a cell of twice the side gives four cells the masses that it has.

    Raises
    ------
    ValueError
        If `spec` covers another area, or its cells do not divide those of the grid.
    """
    if grid.spec == spec:
        return grid
    factor = round(grid.spec.resolution / spec.resolution)
    if factor < 1 or not (
        grid.spec.shape[0] * factor == spec.shape[0]
        and grid.spec.shape[1] * factor == spec.shape[1]
        and np.allclose(grid.spec.extent, spec.extent, rtol=0, atol=1e-3 * spec.resolution)
    ):
        raise ValueError(
            f"the grid has {_said(grid.spec)}, but judged are {_said(spec)}; make the model with that spec, "
            "or with whole multiples of its cells over the same area"
        )
    return EvidentialGrid.trusted(spec, grid.mass.repeat(factor, axis=0).repeat(factor, axis=1))


def model_for(model: InverseSensorModel | ModelFor, sample: Sample) -> InverseSensorModel:
    """Return a model for how a sample's sensor is mounted: itself, or what the function makes, see `evaluate`."""
    return Mounted(model)(sample)


class Mounted:
    """A model or a function that makes one, see `evaluate`: called with a sample, it returns the sample's model.

    What a function made is kept until a sample comes whose sensor is mounted otherwise.
    """

    def __init__(self, model: InverseSensorModel | ModelFor) -> None:
        self.model = model
        self.T = np.full((4, 4), np.nan)

    def __call__(self, sample: Any) -> InverseSensorModel:
        """Return the model for a sample."""
        if isinstance(self.model, InverseSensorModel):
            return self.model
        T = np.array(sample.T_vehicle_sensor, np.float64)
        T[:2, 3] = 0.0
        if not np.array_equal(T, self.T):
            self.made, self.T = self.model(T), T
        return self.made


def _mean(values: NDArray[np.float64]) -> float:
    kept = values[~np.isnan(values)]
    return float(kept.mean()) if len(kept) else float("nan")


def _said(spec: GridSpec) -> str:
    (nx, ny), (x0, x1, y0, y1) = spec.shape, spec.extent
    return f"{nx} x {ny} cells of {spec.resolution:g} m over x {x0:g} to {x1:g}, y {y0:g} to {y1:g} m"
