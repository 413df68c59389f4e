"""The two pictures of `fusion_quality`."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _fusion_methods import BASELINE, FAMILIES, SCAN
from _sequences import PAPER, Drive, planar
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ogm import EvidentialGrid, GridSpec
from ogm.files import atomic_write
from ogm.plot import BLACK, GREEN, RED, Panel, conflict, masses, points, probability
from ogm.truth import IGNORE, Truth

__all__ = ["curves", "gallery"]

COLOURS = {
    "scan": "#8c8c8c", "Bayes": "#2c5f9e", "Dempster": "#1b7837", "Yager": "#b35806", "cumulative": "#8e3b9e",
    "PCR6": "#c51b7d", "averaging": "#7f6a00", "weighted": "#40807c", "cautious": "#c0202b",
}  # fmt: skip
AHEAD = GridSpec.centered(length=44.8, width=32.0, resolution=0.16)  # what the gallery shows


def colour(family: str) -> str:
    """Return the colour of a family of maps."""
    return COLOURS[family.split(",")[0].split()[0]]


def curves(
    path: Path,
    ghosts: Mapping[str, tuple[str, NDArray[np.float64]]],
    fill: Mapping[str, tuple[str, Mapping[str, NDArray[np.float64]]]],
    sweep: Sequence[Mapping[str, Any]],
    chosen: Mapping[str, float],
    words: Mapping[str, str],
    note: str,
) -> None:
    """Draw ghosts over time, completeness over time, and ghosts against static accuracy.

    Parameters
    ----------
    path : Path
    ghosts : dict of str to (family, (ages,) share)
        Share of the cells that were left and are still called occupied, from 0.1 s on.
    fill : dict of str to (family, completeness)
    sweep : sequence of dict
        Rows of the dev sweep: family, parameter, ghost_area, static_iou_occupied.
    chosen : dict of str to float
        The parameter that was chosen for each family.
    words : dict
        What was judged: "judged" and "dev".
    note : str
    """
    figure = Figure(figsize=(17.5, 12.5), layout="constrained")
    (first, second), (third, fourth) = figure.subplots(2, 2)
    edges = (1, 2, 3, 4, 5, 6, 8, 11, 16, 21, 31, 41, 51)  # frames, of which means are drawn
    seconds = [0.05 * (a + b - 1) for a, b in itertools.pairwise(edges)]
    marks = dict(zip(ghosts, "os^vDPX*phd<>", strict=False))
    for name, (family, share) in ghosts.items():
        style = "--" if family == SCAN else "-"
        first.plot(
            seconds, [100 * max(share[a - 1 : b - 1].mean(), 1e-9) for a, b in itertools.pairwise(edges)],
            style, color=colour(family), marker=marks[name], ms=5, lw=1.6, label=name,
        )  # fmt: skip
    first.set(
        xscale="log",
        yscale="log",
        xlim=(0.09, 5.5),
        ylim=(0.02, 100),
        xlabel="time since the participant left the cell [s]",
    )
    first.set_ylabel("cells still called occupied, P > 1/2 [%]")
    ticks = [0.1, 0.2, 0.5, 1, 2, 5]
    first.set_xticks(ticks, [f"{t:g}" for t in ticks])
    first.minorticks_off()
    first.set_title(f"Ghost trails ({words['judged']})")
    first.legend(fontsize=8.5, framealpha=0.95)

    for name, (family, one) in fill.items():
        frames = 0.1 * np.arange(len(one["seen so far"]))
        second.plot(frames, 100 * one["seen so far"], color=colour(family), lw=2, label=name)
        second.plot(frames, 100 * one["ring"], ":", color=colour(family), lw=1.8)
    second.plot([], [], color="black", lw=2, label="all static cells visible so far")
    second.plot([], [], ":", color="black", lw=1.8, label="of them, nearer than 4 m\n(below the lowest beam)")
    second.set(xlabel="time since the start [s]", xlim=(0, 10), ylim=(0, 101))
    second.set_ylabel("static cells known rightly [%]")
    second.set_title(f"How the view fills ({words['judged']})")
    second.legend(fontsize=8.5, loc="lower right")

    baseline = next(row for row in sweep if (row["family"], row["parameter"]) == BASELINE)
    _trade(third, sweep, chosen, "static_iou_occupied", baseline)
    third.set_ylabel("IoU of static occupied cells [%]")
    third.set_title(f"Ghosts against static accuracy ({words['dev']}; circles: chosen)")
    _trade(fourth, sweep, chosen, "body_recall", baseline)
    fourth.set_ylabel("cells of moving participants called occupied [%]")
    fourth.set_title(f"Ghosts against seeing who moves ({words['dev']})")
    figure.legend(*third.get_legend_handles_labels(), fontsize=9, loc="outside right center")
    for axes in (first, second, third, fourth):
        axes.grid(alpha=0.25)
    figure.supxlabel(note, fontsize=7.5, color="#555555")
    _save(figure, path)


def _trade(
    axes: Any,
    sweep: Sequence[Mapping[str, Any]],
    chosen: Mapping[str, float],
    score: str,
    baseline: Mapping[str, Any],
) -> None:
    """Draw a score over the ghost area, a line per family of maps."""
    rows: dict[str, list[Mapping[str, Any]]] = {}
    for row in sweep:
        if row["family"] != SCAN:
            rows.setdefault(row["family"], []).append(row)
    lines: list[Any] = ["-", "--", ":", "-.", (0, (1, 3)), (0, (6, 2, 1, 2, 1, 2)), (0, (8, 3))]
    seen: dict[str, int] = {}
    for family, ones in rows.items():
        main = colour(family)
        style = lines[seen.setdefault(main, 0) % len(lines)]
        seen[main] += 1
        x = [one["ghost_area"] for one in ones]
        y = [100 * one[score] for one in ones]
        axes.plot(x, y, linestyle=style, color=main, marker=".", ms=6, lw=1.5, label=_titled(family))
        for one, a, b in zip(ones, x, y, strict=True):
            if one["parameter"] == chosen.get(family):
                axes.plot(a, b, "o", mfc="none", mec=main, ms=11, mew=1.6)
    at = baseline["ghost_area"], 100 * baseline[score]
    axes.plot(*at, "*", color="black", ms=16, ls="none", zorder=5, label="classical Bayes filter")
    half = at[0] / 2
    axes.axvline(half, color="black", lw=0.8, ls=":")
    axes.text(
        half, 0.985, "half the classical \nfilter's ghosts ", fontsize=8, va="top", ha="right",
        transform=axes.get_xaxis_transform(),
    )  # fmt: skip
    axes.set_xlabel("ghost area behind a moving participant [m²]")


def _titled(family: str) -> str:
    """Return a family's name with its parameter and the span of it."""
    one = FAMILIES[family]
    low, high = ("never" if np.isinf(p) else f"{p:g}" for p in (one.parameters[0], one.parameters[-1]))
    return f"{family}\n  {one.what} {low} to {high}"


def gallery(
    path: Path,
    drive: Drive,
    frame: int,
    scan: EvidentialGrid,
    evidential: EvidentialGrid,
    bayes: EvidentialGrid,
    layers: NDArray[np.float32],
    note: str,
) -> None:
    """Draw one moment: points, scan, both maps, conflict, truth, on `AHEAD`, the vehicle facing up.

    Parameters
    ----------
    path : Path
    drive : Drive
    frame : int
    scan, evidential, bayes : EvidentialGrid
        On the cells of `AHEAD`.
    layers : (nx, ny, 2) float32
        Conflict, likewise.
    note : str
    """
    panels = (
        points(drive.points[frame], AHEAD, "one scan: points"),
        masses(scan, "one scan: measurement grid"),
        masses(evidential, "EvidentialMapper, as it comes"),
        probability(bayes, "classical Bayes filter: P(occupied)"),
        conflict(layers, AHEAD, "conflict of the last seconds"),
        _truth_panel(Truth(PAPER, drive.truth[frame]).crop(AHEAD)),
    )
    figure = Figure(figsize=(15, 14.2), layout="constrained")
    x0, x1, y0, y1 = AHEAD.extent
    for axes, panel in zip(figure.subplots(2, 3).flat, panels, strict=True):
        axes.imshow(panel.image, extent=(y1, y0, x0, x1), interpolation="nearest")
        for corners in _outlines(drive, frame):
            axes.plot(corners[:, 1], corners[:, 0], color="white", lw=2.6)
            axes.plot(corners[:, 1], corners[:, 0], color="#00b7ff", lw=1.3)
        axes.plot([1.1, -1.1, -1.1, 1.1, 1.1], [-2.5, -2.5, 2.5, 2.5, -2.5], color="white", lw=1)
        axes.set(xlim=(y1, y0), ylim=(x0, x1), title=panel.title, aspect="equal")
        axes.set_xlabel("y, to the left [m]")
        axes.set_ylabel("x, ahead [m]")
        for name, rgb in panel.legend.items():
            axes.plot([], [], "s", color=rgb, ms=8, mec="#888888", mew=0.5, label=name)
        if panel.legend:
            axes.legend(loc="lower left", fontsize=8.5, framealpha=0.9)
    figure.suptitle(
        "A moment of a drive. Blue boxes: participants that move; white: the own vehicle", fontsize=13
    )
    figure.supxlabel(note, fontsize=8, color="#555555")
    _save(figure, path)


def _truth_panel(truth: Truth) -> Panel:
    colours = np.array([BLACK, GREEN, RED, (0.45, 0.45, 0.45)])
    image = (255 * colours[truth.state]).astype(np.uint8)[::-1, ::-1]
    legend = {"free": GREEN, "occupied": RED, "not visible": BLACK}
    if (truth.state == IGNORE).any():
        legend["not judged"] = (0.45, 0.45, 0.45)
    return Panel(image, AHEAD, "truth, as visible from here", legend)


def _outlines(drive: Drive, frame: int) -> list[NDArray[np.float64]]:
    """Return the closed outlines of the moving participants in the vehicle's axes, (5, 2) each."""
    x, y, yaw = planar(drive.poses[frame])
    result = []
    for bx, by, angle, length, width in drive.boxes[frame]:
        u = 0.5 * length * np.array([1, 1, -1, -1, 1])
        v = 0.5 * width * np.array([1, -1, -1, 1, 1])
        wx = bx + np.cos(angle) * u - np.sin(angle) * v - x
        wy = by + np.sin(angle) * u + np.cos(angle) * v - y
        c, s = np.cos(yaw), np.sin(yaw)
        result.append(np.column_stack([c * wx + s * wy, c * wy - s * wx]))
    return result


def _save(figure: Figure, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=110)
