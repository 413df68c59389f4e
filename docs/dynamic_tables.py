"""Tables of docs/dynamic.md, from the record dynamic.json: the rows and columns that its text needs."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from record_tables import half_width, once, table

__all__ = ["dynamic_tables"]

HYBRID, PLAIN, NUSS = "hybrid, matching, 200k", "hybrid, 200k", "Nuss, 1M"
TITLES = {HYBRID: "**`DynamicMapper`**", PLAIN: "no matching", NUSS: "Nuss' filter"}
STATIC_MAPS = ("conflict layer", "EvidentialMapper", "classical Bayes")  # without velocities
Column = tuple[str, int, int, bool]  # heading, digits, factor, whether all drives are taken together
MOTION: dict[str, Column] = {
    "motion_ap": ("AP", 3, 1, False),
    "static_moving": ("static predicted moving [%]", 2, 100, False),
    "velocity_median": ("velocity: median error [m/s]", 2, 1, False),
    "velocity_rmse": ("RMSE [m/s]", 2, 1, False),
}
STATES: dict[str, Column] = {  # without intervals
    "time_to_detect": ("time to detect [s]", 2, 1, True),
    "pedestrian_normalised_mean": ("people: error / speed", 2, 1, True),
    "inside_95": ("in the 95 % ellipse [%]", 0, 100, True),
    "moving_occupied": ("moving cells more occupied than free [%]", 0, 100, True),
    "static_iou_occupied": ("static IoU", 3, 1, False),
    "ghost_area": ("ghosts [m²]", 2, 1, False),
}
RECORDED: dict[str, Column] = {
    "motion_ap": ("AP", 3, 1, True),
    "static_moving": ("static predicted moving [%]", 2, 100, True),
    "vehicle_velocity_median": ("van: median error [m/s]", 2, 1, True),
    "cyclist_velocity_median": ("cyclist [m/s]", 2, 1, True),
    "inside_95": ("in the 95 % ellipse [%]", 0, 100, True),
}
LATER: dict[str, Column] = {
    f"{metric}_{h}": (f"{title} {h} s", 2, 1, True)
    for metric, title in (("recall", "recall,"), ("precision", "precision,"))
    for h in ("0.5", "1")
} | {f"recall_at_70_{h}": (f"recall at 70 %, {h} s", 2, 1, True) for h in ("0.5", "1", "2")}
WORDS = {key: column[0].split(" [")[0] for key, column in (MOTION | STATES).items()}  # of the targets in the record
WORDS |= {"velocity_rmse": "RMSE of velocities", "brier_moving_2": "Brier score of predictions, 2 s,"}


def dynamic_tables(found: Mapping[str, Any]) -> list[str]:
    """Return the tables of motion, of predictions, and of the targets that were missed."""
    runs = found["runs"]
    real = [run for run in runs if run.startswith("KITTI")]
    simulated = _rows(runs, [run for run in runs if run not in real], ())
    parts = [
        "**Simulated drives** (means of 12 drives ± half of the 95 % interval; Nuss' filter with a million particles):"
    ]
    parts += [_table(MOTION, simulated), _table(STATES, simulated, False)]
    parts += ["**KITTI**, with all layers and with fewer:", _table(RECORDED, _rows(runs, real, STATIC_MAPS))]
    later = _rows(runs, [run for run in runs if run not in real[1:]], (PLAIN,), "recall_0.5")
    parts += [
        "**Predictions** of the cells of moving objects, one cell of tolerance (64 layers: KITTI; at 70 % precision):",
        _table(LATER, later),
    ]
    reached = sum(target[-1] for target in found["targets"])
    missed = []
    for run, name, (value, low, high), limit, met in found["targets"]:
        if not met:
            half = half_width((value, low, high)).replace("\xa0", " ")
            title = re.sub(r"^\w+", lambda key: WORDS.get(key[0], key[0]), name)
            missed.append([f"`{run}`", title, f"{value:.3f}{half}", limit])
    parts.append(f"**Targets**, set beforehand: {reached} of {len(found['targets'])} reached.")
    return [*parts, table(["behind", "missed", "measured", "wanted"], once(missed), left=2)]


def _rows(
    runs: Mapping[str, Any], names: Sequence[str], without: Sequence[str], needed: str = "motion_ap"
) -> dict[tuple[str, str], Any]:
    """Return the maps of some runs by run and map; readings of a map by speed alone stay in the record."""
    return {
        (f"`{run}`" if run.islower() else run.removeprefix("KITTI, "), TITLES.get(name, name)): one
        for run in names
        for name, one in runs[run].items()
        if name not in without and "speed alone" not in name and one["pooled"].get(needed) is not None
    }


def _table(columns: Mapping[str, Column], maps: Mapping[tuple[str, str], Any], intervals: bool = True) -> str:
    values = {name: [_cell(one, key, *column[1:]) for key, column in columns.items()] for name, one in maps.items()}
    if not intervals:
        values = {name: [text.partition("\xa0")[0] for text in row] for name, row in values.items()}
    some = [k for k in range(len(columns)) if any(row[k] for row in values.values())]
    heads = [list(columns.values())[k][0] for k in some]
    rows = [[*names, *(row[k] for k in some)] for names, row in values.items() if any(row)]
    return table(["behind", "map", *heads], once(rows), left=2)


def _cell(one: Mapping[str, Any], key: str, digits: int, factor: int, together: bool) -> str:
    if together:
        value = one["pooled"].get(key)
        return "" if value is None else f"{factor * value:.{digits}f}"
    interval: Sequence[float | None] = one["mean and 95 % interval"].get(key, (None,) * 3)
    if interval[0] is None:
        return ""
    return f"{factor * interval[0]:.{digits}f}{half_width(interval, digits, factor)}"
