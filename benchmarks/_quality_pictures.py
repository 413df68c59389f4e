"""The pictures of `quality`. Those with scans are drawn of simulated ones alone."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _charts import save_picture
from _quality_methods import model_of
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ogm.evaluation import Evaluation
from ogm.metrics import METRICS
from ogm.plot.colours import colours

COLOURS = {
    "height-band": "#2c5f9e", "height-band-released": "#7fa8d6", "ray": "#d55e00", "lite": "#009e73",
    "combined": "#cc79a7", "paper": "#000000",
}  # fmt: skip
MARKERS = {
    "": "*", "cautious": "o", "dempster": "s", "dempster-plain": "D", "yager": "^", "cumulative": "v", "pcr6": "P",
    "averaging": "X", "weighted": "d", "bayes": "h",
}  # fmt: skip
OTHER = "#555555"


def papers_figures(path: Path, result: Evaluation, deep: str, note: str) -> None:
    """Draw the paper's two figures for our data, and what its second one would be by other measures."""
    figure = Figure(figsize=(16, 10.5), layout="constrained")
    (masses, proper), (strict, legacy) = figure.subplots(2, 2)
    shown = {"height-band-released": "as released", "height-band": "as text", deep: deep}
    truth = {"unknown": result.truth[:, 0], "free": result.truth[:, 1], "occupied": result.truth[:, 2]}
    state_colours = {"unknown": "black", "free": colours().free, "occupied": colours().occupied}
    for (name, short), style in zip(shown.items(), (":", "--", "-"), strict=True):
        for state, colour in state_colours.items():
            values = result.of(name, f"mean_{state}")
            masses.plot(values, style, color=colour, lw=1.4, label=f"{state}, {short}: {values.mean():.3f}")
    for state, colour in state_colours.items():
        masses.plot(truth[state], color=colour, lw=5, alpha=0.15, label=f"{state}, truth: {truth[state].mean():.3f}")
    masses.set(title="Mean masses: the baseline as in the text, as released, the network, the truth")
    masses.set(ylabel="mean mass", ylim=(0, 1.3))
    masses.legend(ncols=4, fontsize=7.5, frameon=False, loc="upper center", columnspacing=1.0)
    _against(proper, result, "nll", deep, "NLL of known cells, a proper score")
    _against(strict, result, "kl_e1", deep, "KL[grid || truth], truth of evidence 1, as the released code's labels")
    ours, theirs = result.of(deep, "legacy_kl"), result.of("height-band-released", "legacy_kl")
    for values, style, colour, name in (
        (ours, "-", COLOURS.get(deep, OTHER), deep),
        ((ours + theirs) / 2, ":", COLOURS["height-band-released"], "height-band-released, as it would be plotted"),
        (theirs, "-", COLOURS["height-band-released"], "height-band-released itself"),
    ):
        legacy.plot(values, style, color=colour, lw=1.5, label=f"{name}: {values.mean():.3f}")
    legacy.set(title='"KL" of the released code (not a divergence of densities)', ylabel='"KL"')
    legacy.set(ylim=(0, 1.25 * legacy.get_ylim()[1]))
    legacy.legend(fontsize=9, frameon=False, loc="upper right")
    for axes in (masses, proper, strict, legacy):
        axes.set(xlim=(0, max(len(result.frames) - 1, 1)), xlabel="frame")
    _finish(figure, path, "The paper's two figures on our simulated test towns", note)


def _against(axes: Axes, result: Evaluation, metric: str, deep: str, title: str) -> None:
    ours = result.of(deep, metric)
    for name in result.methods:
        values = result.of(name, metric)
        wins = "" if name == deep else f", {deep} is lower in {int((ours < values).sum())} of {len(result.frames)}"
        axes.plot(values, color=COLOURS.get(name, OTHER), lw=1.5, label=f"{name}: {values.mean():.3f}{wins}")
    axes.set(title=title, ylabel="nats", ylim=(0, 1.3 * axes.get_ylim()[1]))
    axes.legend(fontsize=9, frameon=False, loc="upper right")


def by_distance(path: Path, part: Mapping[str, Any], note: str) -> None:
    """Draw scores over the distance from the sensor."""
    figure = Figure(figsize=(16, 4.6), layout="constrained")
    edges = [50.0 if edge is None else edge for edge in part["ranges [m]"]]
    middles = 0.5 * (np.array(edges[:-1]) + edges[1:])
    shown = ("iou_occupied", "false_free", "missed_occupied", "free_recall_1")
    for axes, metric in zip(figure.subplots(1, 4), shown, strict=True):
        for name, one in part["models"].items():
            values = [np.nan if value is None else value for value in one["by range"][metric]]
            axes.plot(middles, values, "o-", color=COLOURS.get(name, OTHER), label=name)
        heading, better, _ = METRICS[metric]
        axes.set(title=f"{heading} ({better} is better)", xlabel="distance [m]", xlim=(0, 50), ylim=(0, 1))
        axes.grid(color="0.92")
    axes.legend(fontsize=8, frameon=False)
    _finish(figure, path, "Scores by distance, simulated test towns, pooled", note)


def reliability(path: Path, record: Mapping[str, Any], note: str) -> None:
    """Draw how often cells are free, and occupied, over the belief in it; `record` is by place and method."""
    figure = Figure(figsize=(5.2 * len(record), 9.8), layout="constrained")
    grid = figure.subplots(2, len(record), squeeze=False)
    for state, row in zip(("free", "occupied"), grid, strict=True):
        for axes, (place, methods) in zip(row, record.items(), strict=True):
            axes.plot([0, 1], [0, 1], color="0.6", lw=1)
            for name, one in methods.items():
                model, _, before = name.partition(", ")
                curve = one[state]
                style = {"color": COLOURS.get(model, OTHER), "ls": "--" if before else "-", "label": name}
                axes.plot(curve["belief"], curve["share"], lw=1.2, **style)
                sizes = 150 * np.sqrt(np.array(curve["cells"]) / sum(curve["cells"]))
                axes.scatter(curve["belief"], curve["share"], sizes, color=style["color"], alpha=0.6)
            axes.set(xlabel=f"belief in {state}", ylabel=f"share of cells that are {state}", xlim=(0, 1), ylim=(0, 1))
            axes.set_title(place, fontsize=10)
            axes.grid(color="0.92")
    grid[0, 0].legend(fontsize=8, frameon=False)
    _finish(
        figure, path, "Reliability of beliefs: below the diagonal too much is claimed (larger dots: more cells)", note
    )


def maps(path: Path, part: Mapping[str, Any], note: str) -> None:
    """Draw every model alone and fused: obstacles found against obstacles predicted free, and the Brier score."""
    figure = Figure(figsize=(16, 7.2), layout="constrained")
    pairs = (("false_free", "iou_occupied"), ("missed_occupied", "brier"))
    for axes, (x, y) in zip(figure.subplots(1, 2), pairs, strict=True):
        for name, one in part["models"].items():
            model, rule = model_of(name), name.partition(" + ")[2]
            (px, *_), (py, *_) = one["mean"][x], one["mean"][y]
            if px is None or py is None:
                continue
            start = part["models"].get(model, one)["mean"]
            if rule:
                axes.plot([start[x][0], px], [start[y][0], py], color=COLOURS.get(model, OTHER), lw=0.5, alpha=0.4)
            size = 220 if not rule else 60
            style = {"color": COLOURS.get(model, OTHER), "marker": MARKERS.get(rule, ".")}
            axes.scatter(px, py, size, edgecolor="white", zorder=3, **style)
        for metric, set_label in ((x, axes.set_xlabel), (y, axes.set_ylabel)):
            set_label(f"{METRICS[metric].title} ({METRICS[metric].better} is better)")
        axes.grid(color="0.92")
    for model in dict.fromkeys(model_of(name) for name in part["models"]):
        axes.scatter([], [], 80, color=COLOURS.get(model, OTHER), label=model)
    for rule in dict.fromkeys(name.partition(" + ")[2] for name in part["models"]):
        axes.scatter([], [], 60, color="0.3", marker=MARKERS.get(rule, "."), label=rule or "scan alone")
    axes.legend(fontsize=9, frameon=False, ncols=2)
    title = f"Scans alone and fused over time: {part['drives']} simulated drives, {part['frames']} frames"
    _finish(figure, path, title, note)


def recordings(path: Path, real: Mapping[str, Any], note: str) -> None:
    """Draw scores on real recordings: a bar per method and recording."""
    shown = ("iou_free", "iou_occupied", "false_free", "brier")
    there = {name: one["alone"] for name, one in real.items() if one.get("alone")}
    figure = Figure(figsize=(16, 4.4 + 0.2 * len(there)), layout="constrained")
    for axes, metric in zip(figure.subplots(1, 4, sharey=True), shown, strict=True):
        for row, part in enumerate(there.values()):
            width = 0.8 / len(part["models"])
            for k, (name, one) in enumerate(part["models"].items()):
                value, low, high = (np.nan if v is None else v for v in one["mean"][metric])
                place = row - 0.4 + width * (k + 0.5)
                label = name if row == 0 else None
                axes.barh(place, value, 0.9 * width, color=COLOURS.get(name, OTHER), label=label, zorder=2)
                axes.plot([low, high], [place] * 2, color="black", lw=1, zorder=3)
        heading, better, _ = METRICS[metric]
        axes.set(title=f"{heading} ({better} is better)", xlim=(0, None))
        axes.grid(axis="x", color="0.92")
    axes.set_yticks(range(len(there)), [f"{name} ({part['frames']})" for name, part in there.items()])
    axes.invert_yaxis()
    figure.axes[0].legend(fontsize=8, frameon=False, ncols=2, loc="upper left")  # nothing is free in the first one
    _finish(figure, path, "Real recordings, labelled cells only (number of frames)", note)


def _finish(figure: Figure, path: Path, title: str, note: str) -> None:
    figure.suptitle(title, fontsize=13)
    save_picture(figure, path, note, dpi=100)


def chosen(result: Evaluation, name: str, metric: str) -> Sequence[tuple[str, int]]:
    """Return the best, a middling and the worst frame of a method by a metric of which less is better."""
    values = result.of(name, metric)
    order = np.argsort(values, kind="stable")[: np.count_nonzero(~np.isnan(values))]
    places = {"best": 0, "middling": len(order) // 2, "worst": len(order) - 1}
    return [(f"{word} by {METRICS[metric].title}", int(order[k])) for word, k in places.items()]
