"""Parts of an evaluation in records: means, intervals, pooled scores, scores by range, pairs, beliefs."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _quality_methods import AGAINST, model_of
from numpy.typing import NDArray

from ogm.evaluation import Comparison, Evaluation, compare_paired
from ogm.evaluation.report import describe_extent, describe_intervals
from ogm.metrics import METRICS, ConfusionSums
from ogm.metrics.counts import RANGES
from ogm.metrics.scores import by_range, reasons

KEPT = (
    "nll", "brier", "iou_free", "iou_occupied", "iou_unknown", "iou_free_known", "iou_occupied_known", "false_free",
    "missed_occupied", "false_occupied", "missed_obstacles", *(m for m in METRICS if m.startswith("from")),
    "free_recall_1", "free_recall_01", "ap_occupied_near", "ece", "ece_relative", "ace", "interval_violation",
    "auroc_unknown", "fpr95_unknown", "aurc", "ause", "conflict", "kl_e10", "kl_e1", "kl_e1_scaled", "legacy_kl",
    "legacy_accuracy", "mean_free", "mean_occupied", "mean_unknown",
)  # fmt: skip
PAIRED = (
    "nll", "brier", "iou_free", "iou_occupied", "false_free", "missed_occupied", "missed_obstacles", "ece_relative",
    "auroc_unknown", "kl_e10", "kl_e1",
)  # fmt: skip
BINS = 15  # of belief
CONFUSION = "called unknown, free, occupied, of truly unknown, free, occupied"


def means_of(result: Evaluation, metrics: Sequence[str]) -> dict[str, Any]:
    """Return the numbers of frames and drives, and the means of all methods."""
    return {
        "frames": len(result.frames),
        "drives": len({frame.sequence or frame.name for frame in result.frames}),
        "means": {name: {m: result.macro(name)[m] for m in metrics} for name in result.methods},
    }


def differences(result: Evaluation, name: str, base: str, metrics: Sequence[str]) -> dict[str, list[float]]:
    """Return the differences of a method from `base` with 95 % intervals over drives."""
    found = result.compare(name, base)
    return {m: list(found[m].difference) for m in metrics if m in found}


def compared(result: Evaluation, base: str, metrics: Sequence[str]) -> dict[str, Any]:
    """Return the means of all methods, and the differences of the others from `base`."""
    others = [name for name in result.methods if name != base]
    pairs = {name: differences(result, name, base, metrics) for name in others}
    return means_of(result, metrics) | {f"minus {base}": pairs}


def pair(comparison: Comparison) -> dict[str, Any]:
    """Return a paired comparison: frames won, p, difference and ratio with their intervals."""
    return {
        "wins, ties, losses": [comparison.wins, comparison.ties, comparison.losses],
        "p": comparison.p,
        "difference": list(comparison.difference),
        "ratio": list(comparison.ratio),
    }


def record_of(result: Evaluation) -> dict[str, Any]:
    """Return the part of a quality record for an evaluation."""
    states = ("unknown", "free", "occupied", "ignored")
    models = {}
    for name, sums in zip(result.methods, result.pooled, strict=True):
        pooled = result.micro(name)
        models[name] = {
            **{key: value for key, value in result.facts.get(name, {}).items() if value},
            "mean": {m: list(result.interval(name, m)) for m in KEPT},
            "pooled": {m: pooled[m] for m in KEPT},
            "by range": {m: column.tolist() for m, column in by_range(sums).items()},
            CONFUSION: _shares(sums.confusion),
            "missing": {m: why for m, why in reasons(sums).items() if m in KEPT},
        }
    return {
        "data": {key: value for key, value in result.data.items() if key != "samples"},
        "frames": len(result.frames),
        "drives": len({frame.sequence for frame in result.frames} - {""}),
        "extent": describe_extent(result),
        "intervals": describe_intervals(result),
        "truth, mean shares": dict(zip(states, result.truth.mean(axis=0).tolist(), strict=True)),
        "ranges [m]": [edge if math.isfinite(edge) else None for edge in RANGES],
        "models": models,
        "paired": _compared(result),
    }


def brief(part: Mapping[str, Any]) -> dict[str, Any]:
    """Return means and pairs alone."""
    left = ("pooled", "by range", CONFUSION)
    models = {
        name: {key: value for key, value in one.items() if key not in left} for name, one in part["models"].items()
    }
    return {**part, "models": models}


def published(result: Evaluation, deep: str, geometric: str) -> dict[str, Any]:
    """Return the figures that the released code would report of two methods on these frames."""
    ours, theirs = result.of(deep, "legacy_kl"), result.of(geometric, "legacy_kl")
    mixed = (ours + theirs) / 2  # its metric is not reset between the two
    return {
        "deep": deep,
        "geometric": geometric,
        "KL, deep": ours.mean(),
        "KL, geometric, mean of both": mixed.mean(),
        "KL, geometric itself": theirs.mean(),
        "frames in which the geometric one is lower": int((mixed < ours).sum()),
        "accuracy, deep": result.of(deep, "legacy_accuracy").mean(),
        "accuracy, geometric": result.of(geometric, "legacy_accuracy").mean(),
    }


def beliefs(sums: ConfusionSums) -> dict[str, dict[str, list[float]]]:
    """Return the shares of known cells that are free, and occupied, in 15 bins of their belief in it."""
    hist, levels = sums.bel_free_hist, np.linspace(0, 1, sums.bel_free_hist.shape[1])
    place = np.minimum((levels * BINS).astype(int), BINS - 1)
    free = [np.bincount(place, weights) for weights in (hist.sum(axis=0), hist.sum(axis=0) * levels, hist[0])]
    found = {}
    for state, (cells, belief, right) in (("free", free), ("occupied", sums.intervals.T[[0, 1, 3]])):
        some = cells > 0
        columns = {"belief": belief[some] / cells[some], "share": right[some] / cells[some], "cells": cells[some]}
        found[state] = {name: column.tolist() for name, column in columns.items()}
    return found


def earlier(folder: Path, name: str) -> ConfusionSums:
    """Return the sums of a method in an earlier run for `beliefs`, from the folder of one of its parts."""
    place = list(json.loads((folder / "report.json").read_text(encoding="utf-8"))["methods"]).index(name)
    total = ConfusionSums.zeros()
    for path in sorted((folder / "frames").glob("*.npz")):
        with np.load(path) as data:
            some = {field: data[f"sums {field}"][place] for field in ("bel_free_hist", "intervals")}
            total = total.plus(ConfusionSums.zeros()._replace(**some))
    return total


def _compared(result: Evaluation) -> dict[str, dict[str, Any]]:
    """Compare every method with the baseline and with `ray`, frame by frame; a map also with its own scans."""
    found = {}
    for name in result.methods:
        for other in dict.fromkeys((*AGAINST, model_of(name))):
            if other == name or other not in result.methods:
                continue
            pairs = {m: (result.of(name, m), result.of(other, m)) for m in PAIRED}
            found[f"{name} against {other}"] = {
                m: pair(compare_paired(*values, METRICS[m].better, result.drives))
                for m, values in pairs.items()
                if not np.isnan(values).all(axis=1).any()
            }
    return found


def _shares(confusion: NDArray[np.float64]) -> list[list[float]]:
    """Return, for every true state, the shares that are predicted unknown, free, occupied."""
    total = confusion.sum(axis=1, keepdims=True)
    return (confusion / np.where(total > 0, total, np.nan)).tolist()
