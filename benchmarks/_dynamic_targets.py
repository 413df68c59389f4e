"""Targets of `dynamic.py`: measured values with their intervals, and their limits."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from _dynamic_filters import BAYES, EVIDENTIAL, HYBRID, NUSS, STANDING

from ogm.evaluation import ratio_interval

Runs = Mapping[str, Mapping[str, Mapping[str, Any]]]
HORIZONS = ("0.5", "1", "2")
Target = list[Any]  # run, name, value with its interval, limit, whether it is reached


def targets(runs: Runs) -> list[Target]:
    """Return the targets of all runs that have the map `HYBRID`."""
    found: list[Target] = []
    for run, maps in runs.items():
        if HYBRID in maps:
            found += _kitti(run, maps) if run.startswith("KITTI") else _simulated(run, maps)
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
    reached = bool(sign * (value[0] - limit) >= 0)
    return [run, name, list(map(float, value)), f"{'≥' if sign > 0 else '≤'} {limit:.3g}", reached]
