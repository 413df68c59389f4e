"""What an evaluation says, for machines (JSON) and for people (tables)."""

import csv
import json
import math
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text

from ogm.cli.charts import clean
from ogm.cli.console import out
from ogm.files import atomic_write
from ogm.metrics import (
    METRICS,
    RANGES,
    ConfusionSums,
    Evaluation,
    Paired,
    by_range,
    free_space,
    intervals,
    precision_recall,
    reasons,
    reliability,
    risk_coverage,
)
from ogm.metrics.paired import FEWEST

__all__ = ["plain", "print_tables", "report", "versions", "write_csv", "write_report"]

PRINTED = (
    "kl_e10", "kl_e1", "kl_e1_scaled", "legacy_kl", "iou_free", "iou_occupied", "iou_unknown",
    "iou_free_known", "iou_occupied_known", "auroc_unknown", "ece", "ece_relative", "brier",
    "false_free", "missed_occupied", "mean_unknown",
)  # fmt: skip
COMPARED = (
    "kl_e10", "kl_e1", "kl_e1_scaled", "legacy_kl", "iou_free", "iou_occupied", "ece", "ece_relative",
    "false_free",
)  # fmt: skip
BRIEF = ("kl_e10", "iou_free", "iou_occupied", "false_free", "brier", "ece")  # of many methods
FEW = 6  # methods of which all pairs are compared
PACKAGES = ("ogm-toolkit", "numpy", "numba", "scipy", "torch", "zarr")


def report(
    result: Evaluation,
    rng: np.random.Generator,
    sequences: Sequence[str] = (),
    methods: Mapping[str, Mapping[str, Any]] | None = None,
) -> dict[str, Any]:
    """Return all that an evaluation says, as JSON can hold it: NaN becomes None.

    Parameters
    ----------
    result : Evaluation
    rng : numpy.random.Generator
        For the bootstrap intervals.
    sequences : sequence of str
        Of every frame, the drive it belongs to. Where there are five drives or more, they are drawn, not frames: frames
        of a drive are alike.
    methods : dict of str to facts, optional
        What each method ``says`` of itself, and its ``weights``.
    """
    spec, facts = result.spec, methods or {}
    drives = len(set(sequences) - {""})
    groups = sequences if len(set(sequences)) >= FEWEST else None
    record = {
        "format": "ogm.evaluation/2",
        "versions": versions(),
        "machine": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "grid": {"resolution": spec.resolution, "shape": spec.shape, "origin": spec.origin},
        "intervals": _drawn(result.frames, "frames", drives)
        if groups is None
        else _drawn(len(set(groups)), "drives"),
        "metrics": {name: metric._asdict() for name, metric in METRICS.items()},
        "ranges": list(RANGES),
        "models": {
            name: {
                "what": facts.get(name, {}).get("description", ""),
                "weights": facts.get(name, {}).get("weights"),
                "macro": {m: result.interval(name, m, rng, groups)._asdict() for m in METRICS},
                "micro": result.micro(name),
                "missing": reasons(counts),
                "confusion [truth][call], unknown free occupied": counts.confusion.astype(int).tolist(),
                "by range": {key: column.tolist() for key, column in by_range(counts).items()},
                "curves": _curves(counts),
                "per frame": {m: result.of(name, m).tolist() for m in METRICS},
            }
            for name, counts in zip(result.models, result.pooled, strict=True)
        },
        "truth per frame": {
            state: result.truth[:, k].tolist()
            for k, state in enumerate(("unknown", "free", "occupied", "ignored"))
        },
        "paired": {
            f"{b} against {a}": {m: _facts(p) for m, p in result.compare(b, a, rng, groups).items()}
            for a, b in _pairs(result.models)
        },
    }
    return plain(record)


def _drawn(count: int, what: str, of: int = 0) -> str:
    """Say what intervals are drawn from."""
    if count < FEWEST:
        return f"none, as {count} {what} are too few" if count > 1 else f"none, as there is one {what[:-1]}"
    alike = f" of {of} drive{'s' * (of > 1)}, which are alike: too narrow for other drives" if of else ""
    return f"95 %, bootstrap over {count} {what}{alike}"


def _curves(counts: ConfusionSums) -> dict[str, Any]:
    """Return the curves of pooled counts, as columns."""

    def columns(curve: Any) -> dict[str, list[float]]:
        return {name: column.tolist() for name, column in curve._asdict().items()}

    return {
        "reliability": {which: columns(reliability(counts, which)) for which in ("all", "relative")},
        "intervals": columns(intervals(counts)),
        "risk_coverage": columns(risk_coverage(counts)),
        "free_space": columns(free_space(counts)),
        "precision_recall": {str(cells): columns(precision_recall(counts, cells)) for cells in (0, 1)},
    }


def _pairs(models: Sequence[str]) -> list[tuple[str, str]]:
    """Return which methods are compared: all of a few; of many, each with the first and with the one it is made of."""
    if len(models) <= FEW:
        return list(combinations(models, 2))
    pairs = [(models[0], name) for name in models[1:]]
    made_of = [(name.rpartition(" + ")[0], name) for name in models]
    return pairs + [(a, b) for a, b in made_of if a in models[1:]]


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


def plain(value: Any) -> Any:
    """Return a record as JSON can hold it: numbers with seven digits, NaN and infinity as None, sequences as lists."""
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return float(f"{value:.7g}") if math.isfinite(value) else None
    return value


def write_csv(path: Path, result: Evaluation, frames: Sequence[str]) -> None:
    """Write every metric of every method in every frame, a row each, whole or not at all; no value is empty."""
    with atomic_write(path, "w") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["frame", "method", *METRICS])
        for k, frame in enumerate(frames):
            for name in result.models:
                values = (result.of(name, metric)[k] for metric in METRICS)
                writer.writerow(
                    [clean(frame), clean(name), *("" if math.isnan(v) else f"{v:.7g}" for v in values)]
                )


def write_report(path: Path, record: Mapping[str, Any]) -> None:
    """Write a report, whole or not at all."""
    with atomic_write(path, "w") as file:
        json.dump(record, file, allow_nan=False)
        file.write("\n")


def print_tables(result: Evaluation, record: Mapping[str, Any], title: str) -> None:
    """Print what a person wants to know first: the means, and how the last method stands against the others."""
    models = result.models
    table = Table(
        title=Text(f"Means over {clean(title)}"),
        title_justify="left",
        title_style="",
        box=None,
        pad_edge=False,
    )
    table.add_column("")
    if len(models) <= FEW:
        for name in models:
            table.add_column(Text(clean(name)), justify="right", overflow="fold")
        for metric in PRINTED:
            table.add_row(_heading(metric), *_marked(record, models, metric))
    else:
        for metric in BRIEF:
            table.add_column(_heading(metric), justify="right")
        columns = [_marked(record, models, metric) for metric in BRIEF]
        for name, *row in zip(models, *columns, strict=True):
            table.add_row(Text(clean(name)), *row)
    out.print(table)
    out.print("(- lower, + higher is better; +- half of the 95 % interval; report.html says what each is)")
    last = [name for name in record["paired"] if name.startswith(f"{models[-1]} against ")]
    for name in last[-FEW:]:
        table = Table(
            title=Text(f"\n{clean(name)}"), title_justify="left", title_style="", box=None, pad_edge=False
        )
        for head in ("", "wins", "ties", "losses", "ratio of means"):
            table.add_column(head, justify="left" if head == "" else "right")
        for metric in COMPARED:
            one = record["paired"][name][metric]
            counts = (str(one[key]) for key in ("wins", "ties", "losses"))
            table.add_row(METRICS[metric].title, *counts, _said(one["ratio"]))
        out.print(table)


def _heading(metric: str) -> str:
    title, better, _ = METRICS[metric]
    return f"{ {'lower': '-', 'higher': '+', '': ' '}[better] } {title}"


def _marked(record: Mapping[str, Any], models: Sequence[str], metric: str) -> list[Text]:
    """Return a metric of all methods, the best one in bold."""
    better = METRICS[metric].better
    row = [record["models"][name]["macro"][metric] for name in models]
    means = [one["value"] for one in row if one["value"] is not None]
    best = None if not means or not better else min(means) if better == "lower" else max(means)
    return [Text(_said(one), "bold" if one["value"] == best else "") for one in row]


def _said(interval: Mapping[str, float | None]) -> str:
    value, low, high = (interval[key] for key in ("value", "low", "high"))
    if value is None:
        return "no value"
    kind = ".3f" if abs(value) < 1e5 else ".3g"
    return f"{value:{kind}}" if low is None or high is None else f"{value:{kind}} +-{(high - low) / 2:{kind}}"
