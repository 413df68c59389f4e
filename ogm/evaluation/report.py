"""The report of an evaluation: record (JSON), table (CSV), page (HTML) and two pictures."""

import csv
import json
import math
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm import metrics
from ogm.evaluation import figures
from ogm.evaluation.page import write_page
from ogm.evaluation.result import Evaluation
from ogm.evaluation.runner import package_versions
from ogm.evaluation.statistics import MIN_SAMPLES
from ogm.evaluation.text import as_json, clean
from ogm.files import atomic_write
from ogm.metrics import METRICS, RANGES, ConfusionSums, by_range, reasons

__all__ = ["evaluation_record", "write_csv", "write_report"]

RANKED_BY = "kl_e10"
WORST, BEST = 0.5, 0.25  # shares of the frames in the page; the rest is spread evenly over the ranks
ROWS = 6  # of the contact sheet
FEW = 6  # methods of which all pairs are compared


def write_report(
    folder: str | Path,
    result: Evaluation,
    *,
    title: str | None = None,
    command: str = "",
    seed: int = 0,
    pictured: int = 100,
    machine: str | None = None,
) -> dict[str, Any]:
    """Write ``report.html``, ``report.json``, ``frames.csv``, ``metrics.png`` and ``frames.png``.

    Parameters
    ----------
    folder : path
        Made if need be.
    result : Evaluation
        With pictures of frames if it was evaluated with ``out=``; without them there is no ``frames.png``.
    title, command, machine : str, optional
        Texts of the page; by default data set and methods, none, and this machine.
    seed : int
        Of the bootstrap.
    pictured : int
        Frames with pictures in the page: the worst, the best, and others evenly between them.

    Returns
    -------
    dict
        The record, as in ``report.json``.
    """
    folder, name = Path(folder), result.data.get("name", "frames")
    folder.mkdir(parents=True, exist_ok=True)
    record = {
        "title": title or (f"{name}: {', '.join(result.methods)}" if len(result.methods) < 5 else name),
        "command": command,
        "date": datetime.now(UTC).date().isoformat(),
        "seed": seed,
        **evaluation_record(result, np.random.default_rng(seed)),
    }
    record["machine"] = machine or record["machine"]
    with atomic_write(folder / "report.json", "w") as file:
        json.dump(record, file, allow_nan=False)
        file.write("\n")
    write_csv(folder / "frames.csv", result)
    chosen = _frames_to_show(result, pictured) if result.cache else []
    write_page(folder / "report.html", record, {k: found for k in chosen if (found := result.pictures(k))})
    heading = f"{name}, {len(result.frames)} frames: quartiles, 5 to 95 %, dot and number: mean"
    figures.draw_metrics(folder / "metrics.png", result, heading)
    order = _ranked(result)
    places = np.linspace(0, len(order) - 1, min(ROWS, len(order))).round().astype(int)
    rows = [
        (result.frames[k].name, figures.frame_panels(found, result, k))
        for k in order[places].tolist()
        if (found := result.pictures(k))
    ]
    if rows:
        heading = f"frames from the best to the worst of {result.methods[-1]}"
        figures.draw_frames(folder / "frames.png", rows, heading)
    return record


def evaluation_record(result: Evaluation, rng: np.random.Generator) -> dict[str, Any]:
    """Return all of an evaluation as JSON can hold it: NaN becomes None.

    Parameters
    ----------
    result : Evaluation
    rng : numpy.random.Generator
        For the bootstrap intervals.
    """
    spec = result.spec
    record = {
        "format": "ogm.evaluation/3",
        "versions": package_versions(),
        "machine": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "grid": {"resolution": spec.resolution, "shape": spec.shape, "origin": spec.origin},
        "intervals": _describe_intervals(result),
        "metrics": METRICS,
        "ranges": RANGES,
        "methods": {
            name: {
                "description": result.facts.get(name, {}).get("description", ""),
                "weights": result.facts.get(name, {}).get("weights"),
                "macro": {m: result.interval(name, m, rng) for m in METRICS},
                "micro": result.micro(name),
                "missing": reasons(sums),
                "confusion": sums.confusion.astype(int),  # [truth][predicted], unknown free occupied
                "by range": by_range(sums),
                "curves": _curves(sums),
                "per frame": {m: result.of(name, m) for m in METRICS},
            }
            for name, sums in zip(result.methods, result.pooled, strict=True)
        },
        "truth per frame": dict(zip(("unknown", "free", "occupied", "ignored"), result.truth.T, strict=True)),
        "paired": {f"{b} against {a}": result.compare(b, a, rng) for a, b in _pairs(result.methods)},
    }
    return {"data": result.data, "frames": [frame._asdict() for frame in result.frames], **as_json(record)}


def write_csv(path: str | Path, result: Evaluation) -> None:
    """Write every metric of every method in every frame, a row each; a missing value is empty."""
    with atomic_write(path, "w") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["frame", "method", *METRICS])
        for k, frame in enumerate(result.frames):
            for name in result.methods:
                cells = ("" if math.isnan(v := result.of(name, metric)[k]) else f"{v:.7g}" for metric in METRICS)
                writer.writerow([clean(frame.name), clean(name), *cells])


def _describe_intervals(result: Evaluation) -> str:
    """Return what the bootstrap draws."""
    if result.groups is not None:
        return f"95 %, bootstrap over {len(set(result.groups))} drives"
    count, drives = len(result.frames), len({frame.sequence for frame in result.frames} - {""})
    if count < MIN_SAMPLES:
        return f"none, as {count} frames are too few" if count > 1 else "none, as there is one frame"
    alike = f" of {drives} drive{'s' * (drives > 1)}, which are alike: too narrow for other drives"
    return f"95 %, bootstrap over {count} frames{alike if drives else ''}"


def _curves(sums: ConfusionSums) -> dict[str, Any]:
    """Return the curves of pooled sums."""
    return {
        "reliability": {which: metrics.reliability(sums, which) for which in ("all", "relative")},
        "intervals": metrics.intervals(sums),
        "risk_coverage": metrics.risk_coverage(sums),
        "free_space": metrics.free_space(sums),
        "precision_recall": {cells: metrics.precision_recall(sums, cells) for cells in (0, 1)},
    }


def _pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    """Return which methods are compared: all of a few; of many, each with the first and a map with its model."""
    if len(names) <= FEW:
        return list(combinations(names, 2))
    pairs = [(names[0], name) for name in names[1:]]
    models = [(name.rpartition(" + ")[0], name) for name in names]
    return pairs + [(a, b) for a, b in models if a in names[1:]]


def _ranked(result: Evaluation) -> NDArray[np.int64]:
    """Return the frames from the best to the worst of the last method; those without a value only if none has one."""
    values = result.of(result.methods[-1], RANKED_BY)
    order = np.argsort(values, kind="stable")  # those without a value come last
    return order[: np.count_nonzero(~np.isnan(values)) or None]


def _frames_to_show(result: Evaluation, most: int) -> list[int]:
    """Choose the frames with pictures: the worst, the best, and others spread evenly over the ranks."""
    order = _ranked(result) if len(result.frames) > most else np.arange(len(result.frames))
    if len(order) > most:
        worst = max(round(WORST * most), 1)
        best = min(round(BEST * most), most - worst)
        between = order[best : len(order) - worst]
        places = np.linspace(0, len(between) - 1, most - worst - best).round().astype(int)
        order = np.concatenate([order[:best], between[places], order[len(order) - worst :]])
    return np.sort(order).tolist()
