"""Shared parts of the pictures: colours, captions, bars of times, curves of long runs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ogm.storage.files import atomic_write

OURS, PEER, SECOND_PEER = "#1b7837", "#2c5f9e", "#b5651d"  # ogm, other libraries
TWIN, FLOOR = "#8c8c8c", "#c9c9c9"  # slow twins, copies


def caption(record: Mapping[str, Any]) -> str:
    """Return one line with the machine and the date of a picture's figures."""
    versions = record["versions"]
    cores = "one core" if record["cores used"] == 1 else f"{record['cores used']} cores"
    return (
        f"{record['cpu']}, {cores}, {record['date'][:10]}, Python {record['python']}, "
        f"numpy {versions['numpy']}, numba {versions['numba']}; remade by: {record['command']}"
    )


def save_picture(figure: Figure, path: Path, note: str, dpi: int = 110) -> None:
    """Write a figure as PNG, whole or not at all, with a note below it."""
    figure.supxlabel(note, fontsize=7, color="#555555")
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=dpi)
    print(f"wrote {path}", flush=True)


def draw_times(axes: Axes, medians: Mapping[str, float], colours: Mapping[str, str], title: str) -> None:
    """Draw a bar for each time [ms], the first one on top; `colours` are by the part of a name before its comma."""
    names, values = list(medians)[::-1], list(medians.values())[::-1]
    axes.barh(names, values, color=[colours.get(name, colours.get(name.split(",")[0], OURS)) for name in names])
    for y, value in enumerate(values):
        axes.text(value * 1.06, y, f"{value:.2f} ms" if value < 10 else f"{value:.0f} ms", va="center", fontsize=9)
    axes.set(xscale="log", xlabel="time [ms], median", title=title, xlim=(min(values) / 1.6, max(values) * 4))


def draw_long_run(axes: Axes, run: Mapping[str, Any], title: str) -> None:
    """Draw the medians of hundreds of calls and the memory of a `long_run`."""
    medians = run["medians of hundreds [ms]"]
    axes.plot((np.arange(len(medians)) + 0.5) * run["scans"] / len(medians), medians, color=OURS, lw=1.2)
    axes.set(xlabel="scans", ylabel="median of a hundred updates [ms]", ylim=(0, None), title=title)
    memory = axes.twinx()
    memory.plot(np.linspace(0, run["scans"], len(run["memory [MB]"])), run["memory [MB]"], color=PEER, lw=1.2)
    memory.set_ylim(0, 1.1 * max(run["memory [MB]"]))
    memory.set_ylabel("memory of the process [MB]", color=PEER)
    memory.tick_params(axis="y", colors=PEER)


def draw_speed(path: Path, record: Mapping[str, Any], colours: Mapping[str, str], title: str) -> None:
    """Draw the times of a record, and its long drive with a title."""
    figure = Figure(figsize=(12.5, 5.2), layout="constrained")
    bars, line = figure.subplots(1, 2, width_ratios=(1.35, 1))
    medians = {name: times.median for name, times in record["times [ms]"].items()}
    draw_times(bars, medians, colours, "one scan, 512 x 352 cells")
    draw_long_run(line, record["long drive"], title)
    save_picture(figure, path, caption(record["environment"]))
