"""Figures of an evaluation: distributions of metrics over frames, and some frames."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from ogm.evaluation.result import Evaluation
from ogm.evaluation.text import clean
from ogm.extras import import_extra
from ogm.metrics import METRICS
from ogm.plot import Panel
from ogm.plot.colours import colours
from ogm.storage.files import atomic_write

SHOWN = (
    "nll", "brier", "ece_relative", "auroc_unknown",
    "iou_free", "iou_occupied", "iou_unknown", "missed_occupied",
    "false_free", "kl_e10", "kl_e1", "legacy_kl",
)  # fmt: skip
MAX_METHODS = 6  # side by side
DPI = 110
COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442", "#000000")  # Okabe and Ito 2008


def draw_metrics(path: str | Path, result: Evaluation, title: str, note: str = "") -> None:
    """Draw a box plot over frames for each metric and method: quartiles, whiskers at 5 % and 95 %, mean as a dot.

    Parameters
    ----------
    path : path
        Ends in ``.png``.
    result : Evaluation
    title, note : str
        Texts above and below the picture.
    """
    Figure = import_extra("matplotlib.figure", "evaluate").Figure
    width, height = max(13.0, 3.4 * len(result.methods)), 3.1 * 3 + 1.1
    figure = Figure(figsize=(width, height))
    axes = figure.subplots(3, 4).ravel()
    figure.subplots_adjust(0.6 / width, 0.9 / height, 1 - 0.2 / width, 1 - 0.75 / height, 0.2, 0.45)
    for axis, metric in zip(axes, SHOWN, strict=True):
        labels = [fill(clean(name), 9) for name in result.methods]
        for k, name in enumerate(result.methods):
            colour, values = COLOURS[k % len(COLOURS)], result.of(name, metric)
            values = values[~np.isnan(values)]
            if not len(values):
                axis.text(k, 0.5, "no value", ha="center", transform=axis.get_xaxis_transform())
                continue
            parts = axis.boxplot(values, positions=[k], widths=0.6, whis=(5, 95), sym="", patch_artist=True)
            parts["boxes"][0].set(facecolor=colour, alpha=0.55, edgecolor=colour)
            parts["medians"][0].set(color="black")
            for line in (*parts["whiskers"], *parts["caps"]):
                line.set(color=colour)
            axis.plot(k, values.mean(), "o", color="black", markersize=4)
            labels[k] = f"{values.mean():.3f}\n{labels[k]}"
        heading, better, _ = METRICS[metric]
        axis.set_title(f"{heading}  ({better} is better)" if better else heading, fontsize=10)
        axis.set(xlim=(-0.6, len(result.methods) - 0.4), ylim=(0, None))
        axis.set_xticks(range(len(labels)), labels, fontsize=8)
        axis.grid(axis="y", color="0.9")
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
    figure.suptitle(clean(title), fontsize=12, y=1 - 0.15 / height, va="top")
    figure.text(0.5, 0.05 / height, note, fontsize=7, color="0.35", ha="center")
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=DPI)


def frame_panels(pictures: Mapping[str, bytes], result: Evaluation, frame: int) -> list[Panel]:
    """Return panels of a frame: points, truth, and the grids of the first methods.

    Parameters
    ----------
    pictures : dict of str to bytes
        See `ogm.evaluation.frame_pictures.draw_frame`.
    result : Evaluation
    frame : int
        Index of the frame in the evaluation.
    """
    from PIL import Image

    titles = {"points": "points", "truth": "truth"}
    for k, name in enumerate(result.methods[:MAX_METHODS]):
        value = result.of(name, "nll")[frame]
        titles[f"mass {k}"] = name if np.isnan(value) else f"{name}, NLL {value:.2f}"
    panels = []
    for key, title in titles.items():
        if key in pictures:
            with Image.open(io.BytesIO(pictures[key]), formats=("WEBP",)) as picture:
                image = np.asarray(picture.convert("RGB"))
            panels.append(Panel(image, result.spec, title, colours().legend if key.startswith("mass") else {}))
    return panels


def draw_frames(path: str | Path, rows: Sequence[tuple[str, Sequence[Panel]]], title: str) -> None:
    """Draw frames below each other, each as a row of panels.

    Parameters
    ----------
    path : path
        Ends in ``.png``.
    rows : sequence of (str, panels)
        Name and panels of each frame, all rows with the same kinds of panels.
    title : str
    """
    Figure = import_extra("matplotlib.figure", "evaluate").Figure
    Patch = import_extra("matplotlib.patches", "evaluate").Patch
    columns = len(rows[0][1])
    first = rows[0][1][0].spec
    width, height = 2.6, 2.6 * first.length / first.width
    across, down = width * columns + 0.4, (height + 0.3) * len(rows) + 1.0
    figure = Figure(figsize=(across, down))
    axes = figure.subplots(len(rows), columns, squeeze=False)
    figure.subplots_adjust(0.35 / across, 0.5 / down, 1 - 0.05 / across, 1 - 0.7 / down, 0.02, 0.3 / height)
    legends: dict[str, Any] = {}
    for row, (name, panels) in zip(axes, rows, strict=True):
        for axis, panel in zip(row, panels, strict=True):
            x0, x1, y0, y1 = panel.spec.extent
            axis.imshow(panel.image, extent=(y1, y0, x0, x1), interpolation="antialiased")
            axis.set_title(clean(panel.title), fontsize=8, parse_math=False)
            axis.set(xticks=[], yticks=[])
            legends |= panel.legend
        row[0].set_ylabel(clean(name), fontsize=9, parse_math=False)
    handles = [Patch(facecolor=c, edgecolor="0.6", label=label) for label, c in legends.items()]
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), frameon=False, fontsize=9)
    figure.suptitle(clean(title), fontsize=11, y=1 - 0.1 / down, va="top")
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=DPI)
