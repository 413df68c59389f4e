"""The picture of `dynamic.py`: detection, velocities, precision over recall, predictions."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from _charts import FLOOR, OURS, PEER, TWIN, save_picture
from _dynamic_filters import HYBRID, NUSS, PLAIN
from matplotlib.axes import Axes
from matplotlib.figure import Figure

COLOURS = {HYBRID: OURS, PLAIN: "#a6dba0", NUSS: PEER, "Nuss, 200k": "#92b4dc", "conflict layer": TWIN}
HORIZONS = (0.5, 1.0, 2.0)


def draw(path: Path, runs: Mapping[str, Mapping[str, Any]], note: str) -> None:
    """Draw a row of four charts for every run."""
    figure = Figure(figsize=(18, 3.9 * len(runs) + 0.4), layout="constrained")
    for axes, (run, maps) in zip(figure.subplots(len(runs), 4, squeeze=False), runs.items(), strict=True):
        _bars(axes[0], maps, {"motion_ap": "AP", "motion_iou": "IoU", "motion_recall": "recall"})
        axes[0].set(ylabel=run, title="moving cells", ylim=(0, 1))
        errors = {"velocity_median": "median", "velocity_rmse": "RMSE", "vehicle_velocity_median": "median,\nvehicles"}
        errors |= {"cyclist_velocity_median": "cyclists", "pedestrian_velocity_median": "pedestrians"}
        _bars(axes[1], {name: one for name, one in maps.items() if name != "conflict layer"}, errors)
        axes[1].set(title="error of the velocity [m/s]")
        for name, one in maps.items():
            if name in COLOURS:
                axes[2].plot(one["curve"]["recall"], one["curve"]["precision"], color=COLOURS[name], label=name)
        axes[2].set(xlabel="recall of moving cells", ylabel="precision", xlim=(0, 1), ylim=(0, 1.02))
        for name, one in maps.items():
            values = [one["pooled"].get(f"recall_at_70_{h:g}", np.nan) for h in HORIZONS]
            if np.isfinite(values).any():
                style = {"color": COLOURS.get(name, "black"), "linestyle": "-" if name in COLOURS else "--"}
                axes[3].plot(HORIZONS, values, "o", label=name, **style)
        axes[3].set(xlabel="prediction for [s] later", title="recall at 70 % precision", ylim=(0, 1))
        for axis in axes[2:]:
            if axis.get_legend_handles_labels()[0]:
                axis.legend(fontsize=8)
    save_picture(figure, path, note)


def _bars(axis: Axes, maps: Mapping[str, Any], metrics: Mapping[str, str]) -> None:
    """Draw a group of bars for every metric, one bar per map, with the interval over drives."""
    shown = [name for name in maps if name in COLOURS]
    for place, name in enumerate(shown):
        spans = np.array([maps[name]["mean and 95 % interval"][key] for key in metrics], float)
        x = np.arange(len(metrics)) + 0.8 * (place - (len(shown) - 1) / 2) / len(shown)
        axis.bar(x, spans[:, 0], 0.76 / len(shown), color=COLOURS[name], label=name)
        valid = np.isfinite(spans).all(axis=1)
        axis.vlines(x[valid], spans[valid, 1], spans[valid, 2], color="black", linewidth=1)
    axis.set_xticks(range(len(metrics)), list(metrics.values()), fontsize=8)
    axis.grid(axis="y", color=FLOOR)
    axis.set_axisbelow(True)
