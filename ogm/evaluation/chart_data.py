"""What the page's script draws, in few bytes: names become numbers, numbers get four digits."""

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
    "The same without obstacles lower than 0.10 m, than 0.50 m": ("from",),
    "Unknown: does it mark the cells not to trust?": ("auroc_", "aupr_", "fpr", "aurc", "ause"),
    "Distance from a truth of given evidence; no proper scores": ("kl_", "conflict"),
    "What the grid holds: neither is better": ("mean_", "entropy", "dissonance"),
    "The released code's metrics: to reproduce its figures, not to rank by": ("evilog", "legacy"),
}
MOST = 400_000  # per-frame values that the page carries; beyond this, those of the headline metrics only
GAP = 2.0  # [s] after the frame before: lines of charts join them


def group_metrics(metrics: Collection[str]) -> dict[str, list[str]]:
    """Return metrics by topic; each is in one group."""
    return {title: [name for name in metrics if name.startswith(starts)] for title, starts in GROUPS.items()}


def frame_keys(frames: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a unique name for every frame: its own, or with its sequence, or with its number."""
    full = [f"{one['sequence']}/{one['name']}" if one["sequence"] else one["name"] for one in frames]
    keys = [one["name"] for one in frames]
    for longer in (full, [f"{name} #{k}" for k, name in enumerate(full)]):
        count = Counter(keys)
        keys = [other if count[key] > 1 else key for key, other in zip(keys, longer, strict=True)]
    return keys


def chart_data(record: Mapping[str, Any], shown: Iterable[int]) -> dict[str, Any]:
    """Return what the page's script needs of a record, as JSON can hold it.

    Parameters
    ----------
    record : dict
        See `ogm.evaluation.report.evaluation_record`.
    shown : iterable of int
        Numbers of the frames with pictures.

    Returns
    -------
    dict
        ``methods``, ``frames`` (key, sequence, whether it follows the one before), ``pictures``, ``metrics``,
        ``headline``, ``perFrame`` (metric -> method -> frame), ``truth``, ``curves``, ``byRange``, ``ranges``,
        ``paired`` ("method reference", by their numbers -> metric -> frames, wins, ties, losses, p, and difference
        and ratio each with its interval), ``grid``.
    """
    methods, metrics, frames = record["methods"], record["metrics"], record["frames"]
    names, carried = list(methods), list(metrics)
    if len(names) * len(frames) * len(carried) > MOST:
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
            f"{a} {b}": {metric: _row(one) for metric, one in pair.items()}
            for a, first_name in enumerate(names)
            for b, second in enumerate(names)
            if (pair := record["paired"].get(f"{first_name} against {second}"))
        },
    }
    charted: dict[str, Any] = as_json(data, digits=4) | {"grid": record["grid"]}
    return charted


def _follows(before: Mapping[str, Any], here: Mapping[str, Any]) -> bool:
    """Return whether a frame was taken soon after the one before, in the same sequence."""
    if before["sequence"] != here["sequence"] or None in (before["stamp"], here["stamp"]):
        return False
    return bool(0 < here["stamp"] - before["stamp"] <= GAP)


def _row(one: Mapping[str, Any]) -> list[float | None]:
    counts = [one["frames"], one["wins"], one["ties"], one["losses"], one.get("p")]
    return counts + [one[what][end] for what in ("difference", "ratio") for end in ("value", "low", "high")]
