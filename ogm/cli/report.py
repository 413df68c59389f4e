"""What an evaluation says, for machines (JSON) and for people (tables)."""

import json
import math
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table
from rich.text import Text

from ogm.cli.console import out
from ogm.files import atomic_write
from ogm.metrics import METRICS, Evaluation, Paired

if TYPE_CHECKING:
    import numpy as np

__all__ = ["print_tables", "report", "versions", "write_report"]

PRINTED = (
    "kl_e10", "kl_e1", "kl_e1_scaled", "legacy_kl", "iou_free", "iou_occupied", "iou_unknown",
    "iou_free_known", "iou_occupied_known", "auroc_unknown", "ece", "ece_relative", "brier",
    "false_free", "missed_occupied", "mean_unknown",
)  # fmt: skip
COMPARED = (
    "kl_e10", "kl_e1", "kl_e1_scaled", "legacy_kl", "iou_free", "iou_occupied", "ece", "ece_relative",
    "false_free",
)  # fmt: skip
PACKAGES = ("ogm-toolkit", "numpy", "numba", "scipy", "torch", "zarr")


def report(result: Evaluation, rng: "np.random.Generator") -> dict[str, Any]:
    """Return all that an evaluation says, as JSON can hold it: NaN becomes None.

    Parameters
    ----------
    result : Evaluation
    rng : numpy.random.Generator
        For the bootstrap intervals.
    """
    spec = result.spec
    record = {
        "format": "ogm.evaluation/1",
        "versions": versions(),
        "grid": {"resolution": spec.resolution, "shape": spec.shape, "origin": spec.origin},
        "metrics": {name: metric._asdict() for name, metric in METRICS.items()},
        "models": {
            name: {
                "macro": {m: result.interval(name, m, rng)._asdict() for m in METRICS},
                "micro": result.micro(name),
                "confusion [truth][call], unknown free occupied": counts.calls.astype(int).tolist(),
                "per frame": {m: result.of(name, m).tolist() for m in METRICS},
            }
            for name, counts in zip(result.models, result.pooled, strict=True)
        },
        "truth per frame": {
            state: result.truth[:, k].tolist()
            for k, state in enumerate(("unknown", "free", "occupied", "ignored"))
        },
        "paired": {
            f"{b} against {a}": {m: _facts(p) for m, p in result.compare(b, a, rng).items()}
            for a, b in combinations(result.models, 2)
        },
    }
    return _plain(record)


def versions() -> dict[str, str]:
    """Return the versions of the packages that figures may depend on, as far as they are installed."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _facts(p: Paired) -> dict[str, Any]:
    return p._asdict() | {"difference": p.difference._asdict(), "ratio": p.ratio._asdict()}


def _plain(value: Any) -> Any:
    """Round to seven digits, and turn NaN into None and whatever is a sequence into a list."""
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, float):
        return float(f"{value:.7g}") if math.isfinite(value) else None
    return value


def write_report(path: Path, record: Mapping[str, Any]) -> None:
    """Write a report, whole or not at all."""
    with atomic_write(path, "w") as file:
        json.dump(record, file, allow_nan=False)
        file.write("\n")


def print_tables(result: Evaluation, record: Mapping[str, Any], title: str) -> None:
    """Print what a person wants to know first: the means, and how the last model stands against the others."""
    table = Table(title=f"Means over {title}", title_justify="left", title_style="", box=None, pad_edge=False)
    table.add_column("")
    for name in result.models:
        table.add_column(Text(name), justify="right", overflow="fold")
    for metric in PRINTED:
        heading, better, _ = METRICS[metric]
        row = [record["models"][name]["macro"][metric] for name in result.models]
        means = [one["value"] for one in row if one["value"] is not None]
        best = None if not means or not better else min(means) if better == "lower" else max(means)
        sign = {"lower": "-", "higher": "+", "": " "}[better]
        cells = (Text(_said(one), "bold" if one["value"] == best else "") for one in row)
        table.add_row(f"{sign} {heading}", *cells)
    out.print(table)
    out.print("(- lower, + higher is better; +- half of the 95 % interval; report.json says what each is)")
    for name, metrics in record["paired"].items():
        if not name.startswith(f"{result.models[-1]} against "):
            continue
        table = Table(title=f"\n{name}", title_justify="left", title_style="", box=None, pad_edge=False)
        for head in ("", "wins", "ties", "losses", "ratio of means"):
            table.add_column(head, justify="left" if head == "" else "right")
        for metric in COMPARED:
            one = metrics[metric]
            counts = (str(one[key]) for key in ("wins", "ties", "losses"))
            table.add_row(METRICS[metric].title, *counts, _said(one["ratio"]))
        out.print(table)


def _said(interval: Mapping[str, float | None]) -> str:
    value, low, high = (interval[key] for key in ("value", "low", "high"))
    if value is None:
        return "no value"
    return f"{value:.3f}" if low is None or high is None else f"{value:.3f} +-{(high - low) / 2:.3f}"
