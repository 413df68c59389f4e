"""``ogm evaluate --beams``: evaluate maps of planar scans without truth, by beams of held-out scans."""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ogm.cli.console import complain, distinct, number_table, out, printable, ticked
from ogm.datasets import Dataset
from ogm.grid import GridSpec

RESOLUTION = 0.05  # [m]


def evaluate_dataset_beams(
    dataset: Dataset, models: Sequence[str], rules: Sequence[str], resolution: float | None, folder: Path
) -> None:
    """Evaluate the maps of models and rules, print their metrics, and write ``beams.json``."""
    from ogm.evaluation import BEAM_METRICS, evaluate_beams, named_maps, write_beam_report

    methods = named_maps(models, rules, GridSpec.centered(resolution=resolution or RESOLUTION))
    errors: list[str] = []
    result = evaluate_beams(
        dataset,
        methods,
        on_error=lambda frame, error: errors.append(f"{frame.name}: {error}"),
        progress=lambda splits: ticked(splits, "evaluating", len(splits)),
    )
    if errors:
        complain(f"{len(errors)} of {len(dataset)} scans are skipped, the first: {errors[0]}")
    path = write_beam_report(folder, result, command=shlex.join(["ogm", *sys.argv[1:]]))
    echoes, silent = int(result.echoes.sum()), int(result.no_echoes.sum())
    title = f"{dataset.name}: {echoes} beams with echo and {silent} without, of {len(result.frames)} scans"
    out.print(printable(title), markup=False, soft_wrap=True)
    table = number_table("", *distinct(result.methods))
    for metric, (heading, better, _) in BEAM_METRICS.items():
        sign = {"lower": "-", "higher": "+"}[better]
        table.add_row(f"{sign} {heading}", *(_text(result.interval(name, metric)) for name in result.methods))
    out.print(table)
    out.print(f"(- lower, + higher is better; +- half of the 95 % interval; {result.split})", soft_wrap=True)
    out.print(f"written {path}", markup=False, soft_wrap=True)


def _text(interval: Any) -> str:
    value, low, high = interval
    if value != value:
        return "no value"
    return f"{value:.3f}" if low != low else f"{value:.3f} +-{(high - low) / 2:.3f}"
