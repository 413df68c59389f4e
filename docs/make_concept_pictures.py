"""Make the pictures of docs/concepts.md: ``python docs/make_concept_pictures.py``."""

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from ogm import evidence

PICTURES = Path(__file__).parent / "pictures"
STATES = {"free": "#56b4e9", "occupied": "#d55e00", "unknown": "#d9d9d9"}  # apart for colour-blind eyes, too
CELLS = {
    "never\nobserved": (0.0, 0.0),
    "measured free\nmany times": (0.85, 0.0),
    "one weak\necho": (0.0, 0.3),
    "measurements\ncontradict": (0.4, 0.4),
}
MAP, SCAN = (0.1, 0.7), (0.6, 0.1)
RULES = ("dempster", "yager", "cautious", "averaging", "disjunctive")


def bars(axes: Any, masses: list[np.ndarray], names: list[str]) -> None:
    """Draw each mass as a bar whose three parts sum to one, with their values."""
    base = np.zeros(len(masses))
    values = np.array([[*mass, 1 - sum(mass)] for mass in masses])
    for state, (name, color) in enumerate(STATES.items()):
        axes.bar(names, values[:, state], 0.62, base, color=color, label=name, edgecolor="white", linewidth=1)
        for k, value in enumerate(values[:, state]):
            if value > 0.08:
                axes.text(k, base[k] + value / 2, f"{value:.2f}", ha="center", va="center", fontsize=10)
        base += values[:, state]
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.set_yticks([])
    axes.tick_params(axis="x", length=0, labelsize=10)
    axes.margins(x=0.02)


def save(figure: Any, axes: Any, name: str) -> None:
    """Write a figure, with its legend on the right."""
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles[::-1], labels[::-1], loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=10)
    figure.savefig(PICTURES / f"{name}.png", dpi=110, metadata={"Software": ""})
    plt.close(figure)


def main() -> None:
    """Make both pictures."""
    plt.rcParams["font.family"] = "DejaVu Sans"
    figure, axes = plt.subplots(figsize=(7.4, 3.0), layout="constrained")
    masses = [np.array(mass) for mass in CELLS.values()]
    bars(axes, masses, list(CELLS))
    for k, mass in enumerate(masses):
        axes.text(k, 1.03, f"P(occupied) = {float(evidence.mass_to_probability(mass)):.2f}", ha="center", fontsize=10)
    save(figure, axes, "concepts_cells")
    figure, axes = plt.subplots(figsize=(9.2, 3.0), layout="constrained")
    a, b = np.array(MAP), np.array(SCAN)
    found = [a, b, evidence.discount(b, 0.5), *(getattr(evidence, name)(a, b) for name in RULES)]
    bars(axes, found, ["map", "scan", "scan,\nreliability ½", *RULES])
    axes.axvline(2.5, color="#999999", linewidth=1, linestyle=":")
    axes.set_title("map and scan, combined by", fontsize=10, loc="right", pad=8)
    save(figure, axes, "concepts_rules")


if __name__ == "__main__":
    main()
