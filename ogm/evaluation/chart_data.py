"""Compact data for the script of the report's page: names become indices, numbers have four digits."""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

from ogm.evaluation.text import as_json

HEADLINE = (
    "nll", "brier", "iou_free", "iou_occupied", "false_free", "missed_occupied", "missed_obstacles",
    "free_recall_1", "ece_relative", "auroc_unknown", "ause",
)  # fmt: skip
GROUPS = {  # title: beginnings of metrics' names, in the order of the page
    "Probability and its calibration, on known cells": ("nll", "brier", "map_score", "ece", "ace", "interval"),
    "The three states": ("iou_",),
    "Free space and obstacles": ("false_", "missed_", "free_", "ap_"),
    "Free space and obstacles, without obstacles lower than 0.10 m or 0.50 m": ("from",),
    "Unknown as a mark of unreliable cells": ("auroc_", "aupr_", "fpr", "aurc", "ause"),
    "Distance from a truth of given evidence; no proper scores": ("kl_", "conflict"),
    "Contents of the grid: neither direction is better": ("mean_", "entropy", "dissonance"),
    "Metrics of the released code: to reproduce its figures, not to rank by": ("evilog", "legacy"),
}
MAX_VALUES = 400_000  # per-frame values in the page; with more, only headline metrics are included
GAP = 2.0  # [s] between frames that are joined by a line in charts


def group_metrics(metrics: Collection[str]) -> dict[str, list[str]]:
    """Return metrics by topic; each metric is in one group."""
    return {title: [name for name in metrics if name.startswith(starts)] for title, starts in GROUPS.items()}


def frame_keys(frames: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a unique name for each frame: its name, with its sequence or its number if needed."""
    full = [f"{frame['sequence']}/{frame['name']}" if frame["sequence"] else frame["name"] for frame in frames]
    keys = [frame["name"] for frame in frames]
    for longer in (full, [f"{name} #{k}" for k, name in enumerate(full)]):
        count = Counter(keys)
        keys = [other if count[key] > 1 else key for key, other in zip(keys, longer, strict=True)]
    return keys


def chart_data(record: Mapping[str, Any], shown: Iterable[int]) -> dict[str, Any]:
    """Return the data of a record for the page's script, ready for JSON.

    Parameters
    ----------
    record : dict
        See `ogm.evaluation.report.evaluation_record`.
    shown : iterable of int
        Numbers of the frames with pictures.

    Returns
    -------
    dict
        ``methods``, ``frames`` (key, sequence, whether it follows the previous frame), ``pictures``, ``metrics``,
        ``headline``, ``perFrame`` (metric -> method -> frame), ``truth``, ``curves``, ``byRange``, ``ranges``,
        ``paired`` ("method reference", by their indices -> metric -> frames, wins, ties, losses, p, and difference
        and ratio each with its interval), ``grid``.
    """
    methods, metrics, frames = record["methods"], record["metrics"], record["frames"]
    names, carried = list(methods), list(metrics)
    if len(names) * len(frames) * len(carried) > MAX_VALUES:
        carried = [m for m in metrics if m in HEADLINE or m.startswith(("kl_", "evilog", "legacy", "mean_"))]
    follows = [False, *(_follows(*pair) for pair in pairwise(frames))]
    data = {
        "methods": names,
        "frames": list(zip(frame_keys(frames), (frame["sequence"] for frame in frames), follows, strict=True)),
        "pictures": sorted(shown),
        "metrics": metrics,
        "headline": HEADLINE,
        "perFrame": {m: [methods[name]["per frame"][m] for name in names] for m in carried},
        "truth": record["truth per frame"],
        "curves": [methods[name].get("curves") or {} for name in names],
        "byRange": [methods[name].get("by range") or {} for name in names],
        "ranges": record.get("ranges") or [],
        "paired": {
            f"{a} {b}": {metric: _row(paired) for metric, paired in pair.items()}
            for a, first_name in enumerate(names)
            for b, second in enumerate(names)
            if (pair := record["paired"].get(f"{first_name} against {second}"))
        },
    }
    charted: dict[str, Any] = as_json(data, digits=4) | {"grid": record["grid"]}
    return charted


def _follows(before: Mapping[str, Any], here: Mapping[str, Any]) -> bool:
    """Return whether a frame follows another within `GAP` in the same sequence."""
    if before["sequence"] != here["sequence"] or None in (before["stamp"], here["stamp"]):
        return False
    return bool(0 < here["stamp"] - before["stamp"] <= GAP)


def _row(paired: Mapping[str, Any]) -> list[float | None]:
    counts = [paired["frames"], paired["wins"], paired["ties"], paired["losses"], paired.get("p")]
    return counts + [paired[kind][end] for kind in ("difference", "ratio") for end in ("value", "low", "high")]
