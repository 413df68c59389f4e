"""The tables of `dynamic.py`, and what the targets ask for."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from _dynamic_filters import BAYES, EVIDENTIAL, HYBRID, NUSS, STANDING

from ogm.evaluation import ratio_interval

Runs = Mapping[str, Mapping[str, Mapping[str, Any]]]
MOTION = {  # score: heading, digits, factor
    "motion_ap": ("AP", 3, 1),
    "motion_iou": ("IoU", 3, 1),
    "motion_precision": ("precision", 2, 1),
    "motion_recall": ("recall", 2, 1),
    "static_moving": ("static predicted moving [%]", 2, 100),
    "velocity_rmse": ("velocity RMSE [m/s]", 2, 1),
    "velocity_median": ("median [m/s]", 2, 1),
    "heading_median": ("heading [°]", 1, 1),
    "inside_95": ("in the 95 % ellipse [%]", 0, 100),
    "time_to_detect": ("time to detect [s]", 2, 1),
}
KINDS = {
    "vehicle_recall": ("vehicles: recall", 2, 1),
    "vehicle_velocity_rmse": ("RMSE [m/s]", 2, 1),
    "vehicle_velocity_median": ("median [m/s]", 2, 1),
    "cyclist_recall": ("cyclists: recall", 2, 1),
    "cyclist_velocity_rmse": ("RMSE", 2, 1),
    "cyclist_velocity_median": ("median", 2, 1),
    "pedestrian_recall": ("pedestrians: recall", 2, 1),
    "pedestrian_velocity_median": ("median", 2, 1),
    "pedestrian_normalised_mean": ("normalised error", 2, 1),
    "static_motion_mean": ("static: mean error", 3, 1),
    "slow_motion_mean": ("≤ 5 m/s", 2, 1),
    "fast_motion_mean": ("> 5 m/s", 2, 1),
}
CELLS = {
    "moving_occupied": ("moving cells occupied [%]", 0, 100),
    "moving_free": ("free [%]", 0, 100),
    "static_iou_occupied": ("static IoU", 3, 1),
    "static_false_free": ("static false free", 3, 1),
    "ghost_area": ("ghost area [m²]", 3, 1),
    "ghost_share": ("ghosts 0.5 to 5 s", 4, 1),
}
HORIZONS = ("0.5", "1", "2")
PREDICTED = {
    f"{name}_{h}": (f"{title}, {h} s", digits, 1)
    for h in HORIZONS
    for name, title, digits in (
        ("recall", "recall", 2), ("precision", "precision", 2), ("recall_at_70", "recall at 70 %", 2),
        ("brier_moving", "Brier", 3), ("ece_moving", "ECE", 3),
    )
}  # fmt: skip


class Target(NamedTuple):
    """One target: what it is of, the measured value with its interval, the limit, and whether it is reached."""

    run: str
    name: str
    value: tuple[float, float, float]
    limit: str
    reached: bool


def tables(runs: Runs) -> list[str]:
    """Return the tables of all runs in Markdown: means over drives, with half of the interval."""
    lines: list[str] = []
    for run, maps in runs.items():
        lines += ["", f"### {run}"]
        for columns in (MOTION, KINDS, CELLS, PREDICTED):
            rows = {name: one["mean and 95 % interval"] for name, one in maps.items()}
            kept = {key: column for key, column in columns.items() if any(_valued(row, key) for row in rows.values())}
            if not kept:
                continue
            lines += ["", "| map | " + " | ".join(heading for heading, *_ in kept.values()) + " |"]
            lines.append("|---|" + "---:|" * len(kept))
            for name, row in rows.items():
                cells = [_cell(row.get(key), digits, factor) for key, (_, digits, factor) in kept.items()]
                if any(cells):
                    lines.append(f"| {name} | " + " | ".join(cells) + " |")
    lines += ["", "| run | target | measured | limit | |", "|---|---|---:|---:|---|"]
    for run, name, value, limit, reached in failures(runs):
        lines.append(
            f"| {run} | {name} | {_cell(value, 3, 1)} | {limit} | {'reached' if reached else '**not reached**'} |"
        )
    return lines


def failures(runs: Runs) -> list[Target]:
    """Return every target, the failed ones among them, for the runs that it is of."""
    found: list[Target] = []
    for run, maps in runs.items():
        if HYBRID in maps:
            found += [one for one in (_kitti(run, maps) if run.startswith("KITTI") else _simulated(run, maps)) if one]
    return found


def _kitti(run: str, maps: Mapping[str, Any]) -> list[Target]:
    ours = maps[HYBRID]["pooled"]
    limits = [
        ("AP", "motion_ap", 0.95, 1), ("IoU", "motion_iou", 0.80, 1),
        ("static predicted moving", "static_moving", 0.007, -1),
        ("median velocity error, cyclist", "cyclist_velocity_median", 0.5, -1),
        ("median velocity error, van", "vehicle_velocity_median", 0.8, -1),
        ("recall at 70 % precision, +0.5 s", "recall_at_70_0.5", 0.55, 1),
    ]  # fmt: skip
    measured = (row for row in limits if not np.isnan(ours.get(row[1], np.nan)))
    return [_limited(run, title, (ours[key],) * 3, limit, sign) for title, key, limit, sign in measured]


def _simulated(run: str, maps: Mapping[str, Any]) -> list[Target]:
    ours, pooled = maps[HYBRID]["drives"], maps[HYBRID]["pooled"]
    found = []
    for other, key, limit, sign in (
        (NUSS, "motion_ap", 1.25, 1), (NUSS, "static_moving", 1 / 3, -1), (NUSS, "velocity_median", 0.5, -1),
        (NUSS, "velocity_rmse", 0.8, -1), (BAYES, "ghost_area", 0.8, -1), (BAYES, "ghost_share", 0.8, -1),
    ):  # fmt: skip
        if other in maps and key in ours:
            value = tuple(ratio_interval(ours[key], maps[other]["drives"][key]))
            found.append(_limited(run, f"{key}, ratio to {other}", value, limit, sign))
    for key, limit, sign in (
        ("pedestrian_normalised_mean", 0.5, -1), ("pedestrian_normalised_median", 0.5, -1), ("inside_95", 0.85, 1),
        ("inside_95", 0.98, -1), ("time_to_detect", 0.4, -1), ("moving_occupied", 0.6, 1),
    ):  # fmt: skip
        found.append(_limited(run, f"{key}, all drives together", (pooled[key],) * 3, limit, sign))
    if EVIDENTIAL in maps and "static_iou_occupied" in ours:
        change = ours["static_iou_occupied"] - maps[EVIDENTIAL]["drives"]["static_iou_occupied"]
        found.append(
            _limited(run, f"static IoU, less that of {EVIDENTIAL}", (float(np.nanmean(change)),) * 3, -0.01, 1)
        )
    for h in HORIZONS:
        for other in (STANDING, NUSS):
            for key in (f"recall_at_70_{h}", f"best_f1_{h}", f"brier_moving_{h}"):
                value, limit = (maps.get(name, {"pooled": {}})["pooled"].get(key, np.nan) for name in (HYBRID, other))
                if not np.isnan(value + limit):
                    sign = -1 if key.startswith("brier") else 1
                    found.append(_limited(run, f"{key} against {other}", (value,) * 3, limit, sign))
    return found


def _limited(run: str, name: str, value: Sequence[float], limit: float, sign: int) -> Target:
    low = tuple(float(one) for one in value)
    return Target(run, name, low, f"{'≥' if sign > 0 else '≤'} {limit:.3g}", bool(sign * (low[0] - limit) >= 0))


def _valued(row: Mapping[str, Any], key: str) -> bool:
    return key in row and bool(np.isfinite(row[key][0]))


def _cell(interval: Sequence[float] | None, digits: int, factor: float) -> str:
    if interval is None or not np.isfinite(interval[0]):
        return ""
    value, low, high = (factor * one for one in interval)
    half = f" ± {(high - low) / 2:.{digits}f}" if np.isfinite(high - low) and high > low else ""
    return f"{value:.{digits}f}{half}"
