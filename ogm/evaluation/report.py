"""Report of an evaluation: record (JSON), table (CSV), page (HTML) and two pictures."""

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
from ogm.evaluation.motion import motion_record
from ogm.evaluation.page import write_page
from ogm.evaluation.result import Evaluation
from ogm.evaluation.runner import package_versions
from ogm.evaluation.statistics import MIN_DRIVES, has_parts
from ogm.evaluation.text import as_json, clean, pluralize
from ogm.metrics import METRICS, ConfusionSums
from ogm.metrics.counts import RANGES
from ogm.metrics.scores import by_range, reasons
from ogm.storage.files import atomic_write

RANKED_BY = "nll"
WORST, BEST = 0.5, 0.25  # shares of frames in the page; the rest is spread evenly over the ranks
ROWS = 6  # of the contact sheet
MAX_ALL_PAIRS = 6  # methods; with more, not all pairs are compared


def write_report(
    folder: str | Path,
    result: Evaluation,
    *,
    title: str | None = None,
    command: str = "",
    pictured: int = 100,
    machine: str | None = None,
) -> dict[str, Any]:
    """Write ``report.html``, ``report.json``, ``frames.csv``, ``metrics.png`` and ``frames.png``.

    Parameters
    ----------
    folder : path
        Created if missing.
    result : Evaluation
        With pictures if it was evaluated with ``out=``; ``frames.png`` needs them.
    title, command, machine : str, optional
        Texts of the page; by default dataset and methods, "", and this machine.
    pictured : int
        Number of frames with pictures in the page: the worst, the best, and others evenly between them.

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
        **evaluation_record(result),
    }
    record["machine"] = machine or record["machine"]
    with atomic_write(folder / "report.json", "w") as file:
        json.dump(record, file, allow_nan=False)
        file.write("\n")
    write_csv(folder / "frames.csv", result)
    chosen = _frames_to_show(result, pictured) if result.cache else []
    write_page(folder / "report.html", record, {k: found for k in chosen if (found := result.pictures(k))})
    heading = f"{name}, {record['extent']}: quartiles, 5 to 95 % of the frames, dot and number: mean"
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


def evaluation_record(result: Evaluation) -> dict[str, Any]:
    """Return all results of an evaluation, ready for JSON: NaN becomes None."""
    spec = result.spec
    record = {
        "format": "ogm.evaluation/6",
        "versions": package_versions(),
        "machine": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "grid": {"resolution": spec.resolution, "shape": spec.shape, "origin": spec.origin},
        "extent": describe_extent(result),
        "intervals": describe_intervals(result),
        "metrics": METRICS,
        "ranges": RANGES,
        "methods": {
            name: {
                "description": result.facts.get(name, {}).get("description", ""),
                "weights": result.facts.get(name, {}).get("weights"),
                "macro": {m: result.interval(name, m) for m in METRICS},
                "micro": result.micro(name),
                "missing": reasons(sums),
                "confusion": sums.confusion.astype(int),  # [truth][predicted], unknown free occupied
                "by range": by_range(sums),
                "curves": _curves(sums),
                "per frame": {m: result.of(name, m) for m in METRICS},
            }
            for name, sums in zip(result.methods, result.pooled, strict=True)
        },
        "motion": motion_record(result.motion),
        "truth per frame": dict(zip(("unknown", "free", "occupied", "ignored"), result.truth.T, strict=True)),
        "paired": {f"{b} against {a}": result.compare(b, a) for a, b in _pairs(result.methods)},
    }
    return {"data": result.data, "frames": [frame._asdict() for frame in result.frames], **as_json(record)}


def write_csv(path: str | Path, result: Evaluation) -> None:
    """Write a CSV row of metrics for each frame and method; missing values are empty."""
    motion = result.motion
    with atomic_write(path, "w") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["frame", "method", *METRICS, *(motion.values if motion else ())])
        for k, frame in enumerate(result.frames):
            for name in result.methods:
                row = [result.of(name, metric)[k] for metric in METRICS]
                if motion:
                    at = motion.methods.index(name) if name in motion.methods else None
                    row += [math.nan if at is None else rows[at, k] for rows in motion.values.values()]
                cells = ("" if math.isnan(value) else f"{value:.7g}" for value in row)
                writer.writerow([clean(frame.name), clean(name), *cells])


def describe_extent(result: Evaluation) -> str:
    """Return the numbers of frames, drives and towns of an evaluation as text, as far as known."""
    drives, towns = len({frame.sequence for frame in result.frames} - {""}), result.data.get("towns")
    text = pluralize(len(result.frames), "frame")
    if drives:
        text += f" of {pluralize(drives, 'drive')}" + (f" in {pluralize(towns, 'town')}" if towns else "")
    return text


def describe_intervals(result: Evaluation) -> str:
    """Return a description of the intervals and their validity."""
    drives = set(result.drives)
    if has_parts(result.drives):
        return f"95 %, Student's t over {MIN_DRIVES} parts of one drive; not valid for other drives"
    unit = "drive" if drives & {frame.sequence for frame in result.frames} else "frame"
    if len(drives) < MIN_DRIVES:
        return f"none: {pluralize(len(drives), unit)} cannot show how much {unit}s differ"
    return f"95 %, Student's t over {len(drives)} {unit}s"


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
    """Return the pairs to compare: all pairs of few methods; else each with the first, and maps with their models."""
    if len(names) <= MAX_ALL_PAIRS:
        return list(combinations(names, 2))
    pairs = [(names[0], name) for name in names[1:]]
    models = [(name.rpartition(" + ")[0], name) for name in names]
    return pairs + [(a, b) for a, b in models if a in names[1:]]


def _ranked(result: Evaluation) -> NDArray[np.int64]:
    """Return the frames from the best to the worst of the last method, without frames that have no value.

    If no frame has a value, all frames are returned.
    """
    values = result.of(result.methods[-1], RANKED_BY)
    order = np.argsort(values, kind="stable")  # NaN last
    return order[: np.count_nonzero(~np.isnan(values)) or None]


def _frames_to_show(result: Evaluation, limit: int) -> list[int]:
    """Choose the frames with pictures: the worst, the best, and others spread evenly over the ranks."""
    order = _ranked(result) if len(result.frames) > limit else np.arange(len(result.frames))
    if len(order) > limit:
        worst = max(round(WORST * limit), 1)
        best = min(round(BEST * limit), limit - worst)
        between = order[best : len(order) - worst]
        places = np.linspace(0, len(between) - 1, limit - worst - best).round().astype(int)
        order = np.concatenate([order[:best], between[places], order[len(order) - worst :]])
    frames: list[int] = np.sort(order).tolist()
    return frames
