"""What `quality` keeps of an evaluation: means with intervals, pooled scores, scores by range, pairs."""

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _quality_methods import AGAINST, made_of
from numpy.typing import NDArray

from ogm.files import atomic_write
from ogm.metrics import (
    METRICS,
    RANGES,
    Evaluation,
    Interval,
    Paired,
    by_range,
    evilog_published,
    paired,
    reasons,
)
from ogm.metrics.paired import FEWEST

__all__ = ["KEPT", "PAIRED", "brief", "of_evaluation", "published", "write"]

KEPT = (
    *("kl_e10", "kl_e1", "kl_e1_scaled", "iou_free", "iou_occupied", "iou_unknown", "iou_free_known"),
    *(
        "iou_occupied_known",
        "false_free",
        "missed_occupied",
        "false_occupied",
        "missed_obstacles",
        "free_recall_1",
    ),
    *(
        "free_recall_01",
        "ap_occupied_near",
        "brier",
        "nll",
        "ece",
        "ece_relative",
        "ace",
        "interval_violation",
    ),
    *("auroc_unknown", "fpr95_unknown", "aurc", "ause", "conflict", "legacy_kl", "legacy_accuracy"),
    *("mean_free", "mean_occupied", "mean_unknown"),
)
PAIRED = (
    *(
        "kl_e10",
        "kl_e1",
        "iou_free",
        "iou_occupied",
        "false_free",
        "missed_occupied",
        "missed_obstacles",
        "brier",
    ),
    *("ece_relative", "auroc_unknown"),
)


def of_evaluation(
    result: Evaluation,
    rng: np.random.Generator,
    sequences: Sequence[str],
    facts: Mapping[str, Mapping[str, Any]],
) -> dict[str, Any]:
    """Return what is kept.

    Parameters
    ----------
    result : Evaluation
    rng : numpy.random.Generator
        For the bootstrap.
    sequences : sequence of str
        Of every frame, its drive.
    facts : dict of str to dict
        What each method says of itself, and its weights.
    """
    groups = sequences if len(set(sequences)) >= FEWEST else None
    truth = dict(
        zip(("unknown", "free", "occupied", "ignored"), result.truth.mean(axis=0).tolist(), strict=True)
    )
    models = {}
    for name, counts in zip(result.models, result.pooled, strict=True):
        pooled, ranges = result.micro(name), by_range(counts)
        models[name] = {
            **{key: value for key, value in facts[name].items() if value},
            "mean": {m: _interval(result.interval(name, m, rng, groups)) for m in KEPT},
            "pooled": {m: pooled[m] for m in KEPT},
            "by range": {m: column.tolist() for m, column in ranges.items()},
            "called unknown, free, occupied, of truly unknown, free, occupied": _rows(counts.confusion),
            "missing": {m: why for m, why in reasons(counts).items() if m in KEPT},
        }
    return {
        "frames": result.frames,
        "drives": len(set(sequences)),
        "intervals": f"95 %, bootstrap over {'frames' if groups is None else 'drives'}",
        "truth, mean shares": truth,
        "ranges [m]": [edge if math.isfinite(edge) else None for edge in RANGES],
        "models": models,
        "paired": _compared(result, rng, groups),
    }


def brief(part: Mapping[str, Any]) -> dict[str, Any]:
    """Return means and pairs alone."""
    left = ("pooled", "by range", "called unknown, free, occupied, of truly unknown, free, occupied")
    models = {
        name: {key: value for key, value in one.items() if key not in left}
        for name, one in part["models"].items()
    }
    return {**part, "models": models}


def published(result: Evaluation, deep: str, geometric: str) -> dict[str, Any]:
    """Return what the released code would report of two methods on these frames."""
    ours, theirs = result.of(deep, "legacy_kl"), result.of(geometric, "legacy_kl")
    said = evilog_published(ours, theirs)
    return {
        "deep": deep,
        "geometric": geometric,
        "KL, deep": said.first.mean(),
        "KL, geometric, mean of both": said.second.mean(),
        "KL, geometric itself": theirs.mean(),
        "frames in which the geometric one is lower": int((said.second < said.first).sum()),
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


def _compared(
    result: Evaluation, rng: np.random.Generator, groups: Sequence[str] | None
) -> dict[str, dict[str, Any]]:
    """Compare every method with the baseline and with `ray`, frame by frame; a map also with its own scans."""
    found = {}
    for name in result.models:
        for other in dict.fromkeys((*AGAINST, made_of(name))):
            if other == name or other not in result.models:
                continue
            found[f"{name} against {other}"] = {
                m: _pair(
                    paired(result.of(name, m), result.of(other, m), METRICS[m].better, rng, groups=groups)
                )
                for m in PAIRED
                if not np.isnan([result.of(name, m), result.of(other, m)]).all(axis=1).any()
            }
    return found


def _interval(one: Interval) -> list[float]:
    return [one.value, one.low, one.high]


def _pair(one: Paired) -> dict[str, Any]:
    return {
        "wins, ties, losses": [one.wins, one.ties, one.losses],
        "p": one.p,
        "difference": _interval(one.difference),
        "ratio": _interval(one.ratio),
    }


def _rows(calls: NDArray[np.float64]) -> list[list[float]]:
    """Return, for every truth, the shares that are called unknown, free, occupied."""
    total = calls.sum(axis=1, keepdims=True)
    return (calls / np.where(total > 0, total, np.nan)).tolist()
