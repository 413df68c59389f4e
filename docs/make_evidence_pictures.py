"""Make the pictures of docs/evidence.md: ``python docs/make_evidence_pictures.py``.

Opinion triangles show two masses A and B, their combination (star), and the path to it: the rule applied to A and to
B discounted by every reliability from 0 to 1. Times are those of benchmarks/results/evidence.json.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from evidence_tables import of_other_library, times_per_grid
from record_tables import record

from ogm import evidence

PICTURES = Path(__file__).parent / "pictures"
A, B = np.array([0.5, 0.2]), np.array([0.1, 0.6])
RULES = (
    *("conjunctive", "dempster", "yager", "disjunctive", "cautious", "pcr5", "murphy", "cumulative"),
    *("cumulative_epistemic", "averaging", "weighted", "consensus_compromise"),
)
STEPS = np.linspace(0, 1, 101)
BLUE, ORANGE, DARK, LIGHT = "#1f77b4", "#d55e00", "#222222", "#999999"


def place(mass: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the point of a mass: free lower left, occupied lower right, unknown on top."""
    free, occupied = mass[..., 0], mass[..., 1]
    unknown = 1 - free - occupied
    return occupied + unknown / 2, unknown * np.sqrt(3) / 2


def triangle(axes: Any) -> None:
    """Draw the frame of an opinion triangle."""
    corners = np.array([[1.0, 0], [0, 1], [0, 0], [1, 0]])
    axes.plot(*place(corners), color=DARK, linewidth=1)
    for level in (0.25, 0.5, 0.75):
        line = np.array([[1 - level, 0], [0, 1 - level]])
        axes.plot(*place(line), color="#dddddd", linewidth=0.7, zorder=0)
    axes.text(-0.02, -0.04, "free", ha="center", va="top", fontsize=8)
    axes.text(1.02, -0.04, "occupied", ha="center", va="top", fontsize=8)
    axes.text(0.5, 0.89, "unknown", ha="center", va="bottom", fontsize=8)
    axes.set_aspect("equal")
    axes.set_xlim(-0.2, 1.2)
    axes.set_ylim(-0.16, 1.0)
    axes.axis("off")


def dot(axes: Any, mass: np.ndarray, name: str, color: str, offset: tuple[float, float] | None = None) -> None:
    """Draw a mass with its name beside it, `offset` points away."""
    x, y = place(mass)
    axes.plot(x, y, "o", color=color, markersize=6)
    offset = offset or ((-9, 4) if x < 0.5 else (-3, 7))
    axes.annotate(name, (x, y), offset, textcoords="offset points", color=color, fontsize=9)


def save(figure: Any, name: str) -> None:
    """Write a figure to its picture."""
    figure.savefig(PICTURES / f"evidence_{name}.png", dpi=100, metadata={"Software": ""})
    plt.close(figure)


def draw_rule(axes: Any, name: str) -> None:
    """Draw A, B, their combination, and the path from A to it."""
    triangle(axes)
    rule: Callable[..., Any] = getattr(evidence, name)
    discounted = evidence.discount(np.broadcast_to(B, (len(STEPS), 2)), STEPS)
    path, end = rule(np.broadcast_to(A, discounted.shape), discounted), rule(A, B)
    if name == "conjunctive":
        path, end = evidence.close_world(path), evidence.close_world(end)
    axes.plot(*place(path), color=LIGHT, linewidth=1.5)
    dot(axes, A, "A", BLUE)
    dot(axes, B, "B", ORANGE)
    axes.plot(*place(end), "*", color=DARK, markersize=12)
    axes.set_title(name, fontsize=9, family="monospace")


def picture_of_the_rules() -> None:
    """Draw twelve rules."""
    figure, axes = plt.subplots(3, 4, figsize=(9.6, 7.2), layout="constrained")
    for place_of_rule, name in zip(axes.flat, RULES, strict=True):
        draw_rule(place_of_rule, name)
    save(figure, "rules")


def picture_of_discounting() -> None:
    """Draw the paths of a mass under three kinds of discounting."""
    figure, axes = plt.subplots(figsize=(3.4, 2.9), layout="constrained")
    triangle(axes)
    start = np.broadcast_to(np.array([0.3, 0.6]), (len(STEPS), 2))
    tenths = slice(0, None, 10)
    # Two of them move along the same line, in different steps: rings around dots, a dashed line on a solid one.
    for discount, color, name, line, face, size in [
        (evidence.discount, BLUE, "mass", "-", "none", 6.5),
        (evidence.discount_evidence, ORANGE, "evidence", (0, (3, 3)), ORANGE, 3.0),
    ]:
        x, y = place(discount(start, STEPS))
        axes.plot(x, y, linestyle=line, color=color, linewidth=1.2, label=f"{name} discount")
        axes.plot(x[tenths], y[tenths], "o", color=color, markerfacecolor=face, markersize=size)
    x, y = place(evidence.contextual_discount(start, 1.0, STEPS))
    axes.plot(x, y, "--", color=LIGHT, linewidth=1.5, label="contextual, free only")
    axes.legend(loc="upper left", fontsize=7, frameon=False, bbox_to_anchor=(-0.08, 1.02))
    save(figure, "discounting")


def picture_of_times(found: dict[str, Any]) -> None:
    """Draw the times of the fused rules, of other libraries, of a copy and of a general frame."""
    times = {
        name: ms
        for name, ms in times_per_grid(found).items()
        if "with discount" in name or of_other_library(name) or name in ("copy", "powerset K=3 dempster")
    }
    names = sorted(times, key=times.__getitem__, reverse=True)
    colors = {"copy": LIGHT, "numba": ORANGE, "numpy": BLUE, "powerset": "#56b4e9"}
    figure, axes = plt.subplots(figsize=(8, 0.27 * len(names) + 1.3), layout="constrained")
    bars = axes.barh(names, [times[n] for n in names], color=[colors.get(n.split()[0], "#bbbbbb") for n in names])
    texts = [f"{times[n]:,.0f}" if times[n] > 100 else f"{times[n]:.2g}" for n in names]
    axes.bar_label(bars, texts, padding=3, fontsize=8)
    axes.set_xscale("log")
    axes.set_xlim(0.05, 5 * max(times.values()))
    axes.tick_params(axis="y", labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    nx, ny = found["grid"]["shape"]
    axes.set_xlabel(f"time for a grid of {nx} x {ny} cells [ms], one core; other libraries extrapolated")
    axes.set_title(f"{found['machine']['cpu']}, {found['date']}", fontsize=9, loc="left")
    figure.savefig(PICTURES / "evidence_speed.png", dpi=110, metadata={"Software": ""})
    plt.close(figure)


def picture_of_the_maximal_unknown() -> None:
    """Draw the line of equal probability and its uppermost point."""
    figure, axes = plt.subplots(figsize=(2.4, 2.1), layout="constrained")
    triangle(axes)
    mass = np.array([0.1, 0.7])
    axes.plot(*place(np.stack([mass, evidence.maximize_uncertainty(mass)])), color=LIGHT, linewidth=1.5)
    axes.plot(*place(np.stack([evidence.maximize_uncertainty(mass), [0.2, 0.8]])), ":", color=LIGHT, linewidth=1.5)
    dot(axes, mass, "A", BLUE, (-13, -2))
    axes.plot(*place(evidence.maximize_uncertainty(mass)), "*", color=DARK, markersize=12)
    save(figure, "maximize_uncertainty")


def main() -> None:
    """Make all pictures."""
    plt.rcParams["font.family"] = "DejaVu Sans"
    picture_of_the_rules()
    picture_of_discounting()
    picture_of_the_maximal_unknown()
    picture_of_times(record("evidence"))


if __name__ == "__main__":
    main()
