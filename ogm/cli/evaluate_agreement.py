"""``ogm evaluate --agreement``: compare methods with each other, without truth."""

import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.text import Text

from ogm.cli.console import number_table, out, printable, ticked

if TYPE_CHECKING:
    from ogm.datasets import Dataset
    from ogm.grid import GridSpec


def evaluate_dataset_agreement(
    dataset: "Dataset", methods: Mapping[str, Any], spec: "GridSpec", numbers: Sequence[int], folder: Path
) -> None:
    """Compare methods with each other, print the metrics of every pair, and write ``agreement.json``."""
    from ogm.evaluation import AGREEMENT_METRICS, evaluate_agreement, write_agreement_report

    result = evaluate_agreement(
        methods,
        dataset,
        spec,
        frames=numbers,
        progress=lambda k: ticked(k, "evaluating (the first frame compiles kernels)"),
    )
    path = write_agreement_report(folder, result, command=shlex.join(["ogm", *sys.argv[1:]]))
    out.print(printable(f"Means over {dataset.name}, {len(result.frames)} frames"), markup=False, soft_wrap=True)
    table = number_table("first, second", *(title for title, _ in AGREEMENT_METRICS.values()))
    for pair, means in result.table().items():
        table.add_row(Text(printable(pair)), *("no value" if v != v else f"{v:.3f}" for v in means.values()))
    out.print(table)
    for title, text in AGREEMENT_METRICS.values():
        out.print(f"{title}: {text}", markup=False, soft_wrap=True)
    out.print(f"written {path}", markup=False, soft_wrap=True)
