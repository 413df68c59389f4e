"""Result of an evaluation: metrics of all methods in all frames, with means, intervals and comparisons."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ogm.evaluation.cache import ResultCache
from ogm.evaluation.motion import MotionResult
from ogm.evaluation.statistics import Comparison, Interval, compare_paired, drives_of, mean_interval
from ogm.evaluation.text import text_table
from ogm.grid import GridSpec
from ogm.metrics import METRICS, ConfusionSums, score


class FrameInfo(NamedTuple):
    """Name, sequence and stamp [s] of an evaluated frame."""

    name: str
    sequence: str = ""
    stamp: float | None = None


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Result of `ogm.evaluation.evaluate`.

    Parameters
    ----------
    methods : tuple of str
    spec : GridSpec
        Evaluated cells.
    values : dict of str to (methods, frames) float64
        Values of each metric in `ogm.metrics.METRICS`; NaN in frames without a value.
    pooled : tuple of ConfusionSums
        Sums over all frames, of each method.
    truth : (frames, 4)
        Shares of cells with true state unknown, free, occupied, ignored.
    frames : tuple of FrameInfo
    data : dict
        Facts about the dataset, for JSON: name, kind, truth (its sources), and others.
    facts : dict of str to dict
        Description and weights (or None) of each method.
    numbers : tuple of int
        Numbers of the frames in the dataset.
    cache : ResultCache, optional
        Stored results of the frames, with their pictures.
    reused : int
        Number of frames reused from an earlier run.
    motion : MotionResult, optional
        Motion results of methods with dynamic grids, if the true motion is known.
    """

    methods: tuple[str, ...]
    spec: GridSpec
    values: dict[str, NDArray[np.float64]]
    pooled: tuple[ConfusionSums, ...]
    truth: NDArray[np.float64]
    frames: tuple[FrameInfo, ...]
    data: Mapping[str, Any] = field(default_factory=dict)
    facts: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    numbers: tuple[int, ...] = ()
    cache: ResultCache | None = None
    reused: int = 0
    motion: MotionResult | None = None

    def __str__(self) -> str:
        """Return a table of means over frames: a row per metric with values, a column per method."""
        return text_table(f"mean of {len(self.frames)} frames", self.table())

    def table(self) -> dict[str, dict[str, float]]:
        """Return the means over frames by method and metric; ``pandas.DataFrame(result.table())`` is a table."""
        return {name: self.macro(name) for name in self.methods}

    @classmethod
    def from_sums(
        cls,
        methods: Iterable[str],
        spec: GridSpec,
        frames: Iterable[tuple[Sequence[ConfusionSums], NDArray[np.floating]]],
        infos: Iterable[FrameInfo],
    ) -> Self:
        """Build an evaluation from sums and shares of true states of each frame.

        Parameters
        ----------
        methods : iterable of str
            Unique names.
        spec : GridSpec
            Evaluated cells.
        frames : iterable of (sums, truth)
            For each frame the sums of each method, and the shares of cells with true state unknown, free, occupied,
            ignored, (4,). Read once and not stored.
        infos : iterable of FrameInfo
        """
        pooled: list[ConfusionSums] = []
        rows, shares = [], []
        for sums, truth in frames:
            pooled = [a.plus(b) for a, b in zip(pooled, sums, strict=True)] if pooled else list(sums)
            rows.append([list(score(method_sums).values()) for method_sums in sums])
            shares.append(truth)
        values = dict(zip(METRICS, np.array(rows).transpose(2, 1, 0), strict=True))
        return cls(tuple(methods), spec, values, tuple(pooled), np.array(shares, np.float64), tuple(infos))

    def of(self, method: str, metric: str) -> NDArray[np.float64]:
        """Return a metric of a method in every frame, (frames,)."""
        if method not in self.methods:
            raise KeyError(f"there is no method {method!r}, only {', '.join(self.methods)}")
        if metric not in self.values:
            raise KeyError(f"there is no metric {metric!r}, only {', '.join(self.values)}")
        return np.asarray(self.values[metric][self.methods.index(method)])

    def select(self, methods: Sequence[str]) -> Self:
        """Return the evaluation of some of the methods."""
        at = [self.methods.index(name) for name in methods]
        values = {metric: rows[at] for metric, rows in self.values.items()}
        return replace(self, methods=tuple(methods), values=values, pooled=tuple(self.pooled[k] for k in at))

    def pictures(self, frame: int) -> dict[str, bytes]:
        """Return the pictures of a frame by index; empty if the evaluation was run without a folder."""
        return {} if self.cache is None else self.cache.load(self.numbers[frame]).pictures

    def macro(self, method: str) -> dict[str, float]:
        """Return the means over frames of every metric; frames without a value are left out."""
        return {metric: _mean(self.of(method, metric)) for metric in self.values}

    def micro(self, method: str) -> dict[str, float]:
        """Return every metric, over the cells of all frames together."""
        return score(self.pooled[self.methods.index(method)])

    @property
    def drives(self) -> list[str]:
        """Drive of each frame; a frame without a sequence is its own drive."""
        return drives_of(self.frames)

    def interval(self, method: str, metric: str) -> Interval:
        """Return a metric's mean over frames with its 95 % interval over drives, see `mean_interval`."""
        return mean_interval(self.of(method, metric), self.drives)

    def compare(self, method: str, other: str) -> dict[str, Comparison]:
        """Compare two methods frame by frame, in every metric with a better direction, see `compare_paired`."""
        return {
            m: compare_paired(self.of(method, m), self.of(other, m), METRICS[m].better, self.drives)
            for m in self.values
            if METRICS[m].better
        }


def _mean(values: NDArray[np.float64]) -> float:
    kept = values[~np.isnan(values)]
    return float(kept.mean()) if len(kept) else float("nan")
