"""Evaluation of methods without truth, by the agreement of their grids for the same scans.

>>> from ogm.datasets import open_dataset
>>> from ogm.evaluation import evaluate_agreement
>>> result = evaluate_agreement(["ray", "height-band", "lite"], open_dataset("scans/"))  # doctest: +SKIP
>>> result.table()["ray, lite"]["kl"]                                                    # doctest: +SKIP
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.evaluation.methods import MethodRunner, as_methods
from ogm.evaluation.result import FrameInfo
from ogm.evaluation.runner import checked_frames
from ogm.evaluation.statistics import Interval, drives_of, mean_interval
from ogm.evaluation.tasks import FrameTask, Progress
from ogm.evaluation.text import text_table, write_record
from ogm.evidence import conflict, kl_divergence
from ogm.grid import GridSpec
from ogm.scan import Frame
from ogm.state import predict_state

AGREEMENT_METRICS = {  # name: title, description
    "agreement": (
        "same state", "Share of cells with the same predicted state, among cells that either method predicts as free "
        "or occupied.",
    ),
    "conflict": ("conflict", "Mean over cells of the mass of free in one method and occupied in the other."),
    "kl": ("KL", "Mean over cells of KL[first || second] of the Beta densities [nats]."),
    "kl_reverse": ("KL, reverse", "Mean over cells of KL[second || first] [nats]."),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class AgreementEvaluation:
    """Comparison of methods with each other on the same frames.

    Parameters
    ----------
    methods : tuple of str
    pairs : tuple of (str, str)
        First and second method of each pair.
    values : dict of str to (pairs, frames) float64
        Values of each metric in `AGREEMENT_METRICS`; NaN in frames without a value.
    frames : tuple of FrameInfo
    """

    methods: tuple[str, ...]
    pairs: tuple[tuple[str, str], ...]
    values: Mapping[str, NDArray[np.float64]]
    frames: tuple[FrameInfo, ...]

    def interval(self, first: str, second: str, metric: str) -> Interval:
        """Return a metric's mean over frames with its 95 % interval over drives, see `mean_interval`.

        The order of the two methods is free.
        """
        if (first, second) not in self.pairs:
            first, second = second, first
            metric = {"kl": "kl_reverse", "kl_reverse": "kl"}.get(metric, metric)
        return mean_interval(self.values[metric][self.pairs.index((first, second))], drives_of(self.frames))

    def table(self) -> dict[str, dict[str, float]]:
        """Return the means over frames by pair and metric; ``pandas.DataFrame(result.table())`` is a table."""
        return {f"{a}, {b}": {m: self.interval(a, b, m).value for m in AGREEMENT_METRICS} for a, b in self.pairs}

    def __str__(self) -> str:
        return text_table(f"mean of {len(self.frames)} frames", self.table())

    def record(self) -> dict[str, Any]:
        """Return all results as a dict, for `ogm.evaluation.text.as_json`."""
        return {
            "format": "ogm.agreement/1",
            "frames": [frame._asdict() for frame in self.frames],
            "metrics": {name: {"title": title, "text": text} for name, (title, text) in AGREEMENT_METRICS.items()},
            "pairs": [
                {
                    "first": a,
                    "second": b,
                    "means": {metric: self.interval(a, b, metric) for metric in AGREEMENT_METRICS},
                    "per frame": {metric: rows[k] for metric, rows in self.values.items()},
                }
                for k, (a, b) in enumerate(self.pairs)
            ],
        }


def evaluate_agreement(
    methods: Mapping[str, Any] | Sequence[str],
    dataset: Sequence[Frame],
    spec: GridSpec | None = None,
    *,
    frames: Iterable[int] | None = None,
    progress: Progress = iter,
) -> AgreementEvaluation:
    """Compare methods with each other on the same frames, without truth.

    Parameters
    ----------
    methods, spec, progress
        See `ogm.evaluation.evaluate`; two or more methods.
    dataset : sequence of Frame
        Frames of `ogm.datasets.open_dataset`; a folder of scans is enough.
    frames : iterable of int, optional
        Numbers of the compared frames; by default all.

    Raises
    ------
    ValueError
        If there are fewer than two methods or no frame, or a grid covers another area than `spec`.
    """
    spec = GridSpec.centered() if spec is None else spec
    used = as_methods(methods, spec)
    if len(used) < 2:
        raise ValueError(f"methods must be two or more, to compare them with each other, got {', '.join(used)}")
    numbers = sorted(set(range(len(dataset)) if frames is None else frames))
    infos, pairs = checked_frames(used, dataset, numbers), tuple(combinations(used, 2))
    runner, wanted, rows = MethodRunner(used, spec), set(numbers), []
    for number in progress(FrameTask(used, spec, dataset, None).to_read(numbers)):
        runner.update(dataset[number], evaluated=number in wanted)
        if number in wanted:
            masses = {name: grid.mass for name, grid in runner.grids().items()}
            rows.append([compare_grids(masses[a], masses[b]) for a, b in pairs])
    values = dict(zip(AGREEMENT_METRICS, np.moveaxis(np.array(rows, np.float64), -1, 0).swapaxes(1, 2), strict=True))
    return AgreementEvaluation(tuple(used), pairs, values, infos)


def compare_grids(a: NDArray[np.float32], b: NDArray[np.float32]) -> tuple[float, ...]:
    """Return the values of `AGREEMENT_METRICS` for the masses (nx, ny, 2) of two grids."""
    states = predict_state(a), predict_state(b)
    known = (states[0] > 0) | (states[1] > 0)
    same = float((states[0] == states[1])[known].mean()) if known.any() else float("nan")
    apart = (a != b).any(axis=-1)  # elsewhere both divergences are 0
    both = a[apart], b[apart]
    ways = (float(kl_divergence(*pair).sum(dtype=np.float64)) / apart.size for pair in (both, both[::-1]))
    return same, float(conflict(a, b).mean(dtype=np.float64)), *ways


def write_agreement_report(folder: Path, result: AgreementEvaluation, *, command: str = "") -> Path:
    """Write ``agreement.json`` into a folder, which is created, and return its path.

    Parameters
    ----------
    folder : Path
    result : AgreementEvaluation
    command : str
        Command of the evaluation, for the record.
    """
    return write_record(folder / "agreement.json", result.record(), command)
