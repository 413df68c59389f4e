"""Tables of docs/dynamic.md, from the record dynamic.json."""

from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["dynamic_tables"]

MOTION = {  # metric: heading, digits, factor, whether all drives are taken together
    "motion_ap": ("AP", 3, 1, False),
    "motion_iou": ("IoU", 3, 1, False),
    "static_moving": ("static predicted moving [%]", 2, 100, False),
    "velocity_rmse": ("velocity: RMSE [m/s]", 2, 1, False),
    "velocity_median": ("median", 2, 1, False),
    "pedestrian_normalised_mean": ("pedestrians: error / speed", 2, 1, True),
    "inside_95": ("in the 95 % ellipse [%]", 0, 100, True),
    "time_to_detect": ("time to detect [s]", 2, 1, True),
    "moving_occupied": ("moving cells with more occupied than free [%]", 0, 100, True),
    "static_iou_occupied": ("static IoU", 3, 1, False),
    "ghost_area": ("ghosts [m²]", 2, 1, False),
}
RECORDED = {
    "motion_ap": ("AP", 3, 1, True),
    "motion_iou": ("IoU", 3, 1, True),
    "static_moving": ("static predicted moving [%]", 2, 100, True),
    "vehicle_velocity_median": ("van: median error [m/s]", 2, 1, True),
    "vehicle_velocity_rmse": ("RMSE", 2, 1, True),
    "cyclist_velocity_median": ("cyclist: median", 2, 1, True),
    "cyclist_velocity_rmse": ("RMSE", 2, 1, True),
    "inside_95": ("in the 95 % ellipse [%]", 0, 100, True),
}
HORIZONS = ("0.5", "1", "2")
LATER = {
    f"{metric}_{h}": (f"{title} {h} s", digits, 1, True)
    for metric, title, digits in (
        ("recall", "recall,", 2),
        ("precision", "precision,", 2),
        ("recall_at_70", "recall at 70 %,", 2),
        ("brier_moving", "Brier,", 3),
    )
    for h in HORIZONS
}


def dynamic_tables(found: Mapping[str, Any]) -> list[str]:
    """Return the tables of motion, of predictions and of targets."""
    parts = []
    for run, maps in found["runs"].items():
        real = run.startswith("KITTI")
        title = f"**{run}**" if real else f"**TEST, `{run}` in front** (12 drives, ± half of the 95 % interval)"
        parts += [title, _table(RECORDED if real else MOTION, maps)]
    parts.append("**Predictions** of the cells of moving objects, with one cell of tolerance:")
    rows = {}
    for run, maps in found["runs"].items():
        kept = {name: one for name, one in maps.items() if one["pooled"].get("recall_0.5") is not None}
        rows |= {f"{run}: {name}": one for name, one in kept.items()}
    parts.append(_table(LATER, rows))
    lines = ["| run | target | measured | wanted | |", "|---|---|---:|---:|---|"]
    for run, name, (value, low, high), limit, reached in found["targets"]:
        half = f" ± {(high - low) / 2:.3f}" if None not in (low, high) and high > low else ""
        lines.append(f"| {run} | {name} | {value:.3f}{half} | {limit} | {'reached' if reached else '**missed**'} |")
    return [*parts, "**Targets**, set before the filter was built:", "\n".join(lines)]


def _table(columns: Mapping[str, tuple[str, int, int, bool]], maps: Mapping[str, Any]) -> str:
    values = {name: [_cell(one, key, *column[1:]) for key, column in columns.items()] for name, one in maps.items()}
    some = [k for k in range(len(columns)) if any(row[k] for row in values.values())]
    heads = [list(columns.values())[k][0] for k in some]
    lines = [f"| map | {' | '.join(heads)} |", f"|---|{'---:|' * len(heads)}"]
    lines += [f"| {name} | {' | '.join(row[k] for k in some)} |" for name, row in values.items() if any(row)]
    return "\n".join(lines)


def _cell(one: Mapping[str, Any], key: str, digits: int, factor: int, together: bool) -> str:
    if together:
        value = one["pooled"].get(key)
        return "" if value is None else f"{factor * value:.{digits}f}"
    interval: Sequence[float | None] = one["mean and 95 % interval"].get(key, (None,) * 3)
    value, low, high = interval
    if value is None:
        return ""
    half = f" ± {factor * (high - low) / 2:.{digits}f}" if low is not None and high is not None and high > low else ""
    return f"{factor * value:.{digits}f}{half}"
