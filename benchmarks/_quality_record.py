"""What `quality` keeps of an evaluation: means with intervals, pooled scores, scores by range, pairs."""

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from _quality_inputs import AGAINST, model_of
from numpy.typing import NDArray

from ogm.evaluation import Comparison, Evaluation, compare_paired
from ogm.files import atomic_write
from ogm.metrics import METRICS, RANGES, by_range, evilog_published, reasons

KEPT = (
    "kl_e10", "kl_e1", "kl_e1_scaled", "iou_free", "iou_occupied", "iou_unknown", "iou_free_known",
    "iou_occupied_known", "false_free", "missed_occupied", "false_occupied", "missed_obstacles",
    "free_recall_1", "free_recall_01", "ap_occupied_near", "brier", "nll", "ece", "ece_relative", "ace",
    "interval_violation", "auroc_unknown", "fpr95_unknown", "aurc", "ause", "conflict", "legacy_kl",
    "legacy_accuracy", "mean_free", "mean_occupied", "mean_unknown",
)  # fmt: skip
PAIRED = (
    "kl_e10", "kl_e1", "iou_free", "iou_occupied", "false_free", "missed_occupied", "missed_obstacles",
    "brier", "ece_relative", "auroc_unknown",
)  # fmt: skip
CONFUSION = "called unknown, free, occupied, of truly unknown, free, occupied"


def record_of(result: Evaluation, rng: np.random.Generator) -> dict[str, Any]:
    """Return what is kept, with intervals by a bootstrap."""
    states = ("unknown", "free", "occupied", "ignored")
    models = {}
    for name, sums in zip(result.methods, result.pooled, strict=True):
        pooled = result.micro(name)
        models[name] = {
            **{key: value for key, value in result.facts.get(name, {}).items() if value},
            "mean": {m: list(result.interval(name, m, rng)) for m in KEPT},
            "pooled": {m: pooled[m] for m in KEPT},
            "by range": {m: column.tolist() for m, column in by_range(sums).items()},
            CONFUSION: _shares(sums.confusion),
            "missing": {m: why for m, why in reasons(sums).items() if m in KEPT},
        }
    return {
        "data": {key: value for key, value in result.data.items() if key != "samples"},
        "frames": len(result.frames),
        "drives": len({frame.sequence for frame in result.frames}),
        "intervals": f"95 %, bootstrap over {'frames' if result.groups is None else 'drives'}",
        "truth, mean shares": dict(zip(states, result.truth.mean(axis=0).tolist(), strict=True)),
        "ranges [m]": [edge if math.isfinite(edge) else None for edge in RANGES],
        "models": models,
        "paired": _compared(result, rng),
    }


def brief(part: Mapping[str, Any]) -> dict[str, Any]:
    """Return means and pairs alone."""
    left = ("pooled", "by range", CONFUSION)
    models = {
        name: {key: value for key, value in one.items() if key not in left} for name, one in part["models"].items()
    }
    return {**part, "models": models}


def published(result: Evaluation, deep: str, geometric: str) -> dict[str, Any]:
    """Return what the released code would report of two methods on these frames."""
    ours, theirs = result.of(deep, "legacy_kl"), result.of(geometric, "legacy_kl")
    report = evilog_published(ours, theirs)
    return {
        "deep": deep,
        "geometric": geometric,
        "KL, deep": report.first.mean(),
        "KL, geometric, mean of both": report.second.mean(),
        "KL, geometric itself": theirs.mean(),
        "frames in which the geometric one is lower": int((report.second < report.first).sum()),
        "accuracy, deep": result.of(deep, "legacy_accuracy").mean(),
        "accuracy, geometric": result.of(geometric, "legacy_accuracy").mean(),
    }


def write(path: Path, record: Mapping[str, Any]) -> None:
    """Write a record as JSON, whole or not at all; lists of numbers in one line."""
    text = json.dumps(record, indent=1, allow_nan=False, ensure_ascii=False)
    short = re.sub(r"\[[^\[\]{}\"]*\]", lambda found: re.sub(r"\s+", " ", found[0]), text)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path, "w") as file:
        file.write(short + "\n")


def _compared(result: Evaluation, rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    """Compare every method with the baseline and with `ray`, frame by frame; a map also with its own scans."""
    found = {}
    for name in result.methods:
        for other in dict.fromkeys((*AGAINST, model_of(name))):
            if other == name or other not in result.methods:
                continue
            pairs = {m: (result.of(name, m), result.of(other, m)) for m in PAIRED}
            found[f"{name} against {other}"] = {
                m: _pair(compare_paired(*pair, METRICS[m].better, rng, groups=result.groups))
                for m, pair in pairs.items()
                if not np.isnan(pair).all(axis=1).any()
            }
    return found


def _pair(one: Comparison) -> dict[str, Any]:
    return {
        "wins, ties, losses": [one.wins, one.ties, one.losses],
        "p": one.p,
        "difference": list(one.difference),
        "ratio": list(one.ratio),
    }


def _shares(confusion: NDArray[np.float64]) -> list[list[float]]:
    """Return, for every true state, the shares that are predicted unknown, free, occupied."""
    total = confusion.sum(axis=1, keepdims=True)
    return (confusion / np.where(total > 0, total, np.nan)).tolist()
