"""What do the paper's own two result figures show? Re-plotted from their values, and re-read.

    python benchmarks/paper_curves.py [--curves CSV]

The values are the coordinates in the LaTeX source of the paper (van Kempen, Lampe, Woopen, Eckstein 2021: figures
of the mean masses and of the Kullback-Leibler divergence in 100 test frames), as a CSV with the columns t,
m_unknown_deep, m_unknown_geo, m_free_deep, m_free_geo, m_occ_deep, m_occ_geo, kld_deep, kld_geo: eight curves. They
are not ours to pass on; without the file the benchmark stops with a message. Writes
benchmarks/results/paper_curves.json and docs/pictures/paper_curves.png.

Frames are taken for independent of each other. They are one drive's, one second apart, in random order, so that
intervals are rather too narrow than too wide, and nothing in the figures can tell how much.
"""

import _run as run  # first: it sets the number of threads

# isort: split
import hashlib
from pathlib import Path
from typing import Any

import _paper_facts as read
import numpy as np
from _charts import PEER, TWIN, caption, save_picture
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ogm import GridSpec
from ogm.plot.colours import colours

CITED = (
    "R. van Kempen, B. Lampe, T. Woopen, L. Eckstein: A Simulation-based End-to-End Learning Framework for "
    "Evidential Occupancy Grid Mapping, IEEE Intelligent Vehicles Symposium 2021"
)
CURVES = run.DATA.parent / "paper_fig_curves.csv"
LABEL = GridSpec.centered()
SEED = 0
DEEP, GEO, OWN = "#d55e00", PEER, TWIN  # deep, geometric as plotted, geometric's own
SHOWS = (
    "In the paper's test drive the deep model has less unknown than the geometric one, in every frame.",
    "By the released code's measure it misses fewer labelled cells, in 89 frames of 100 and in the mean.",
    "As the baseline's curve is the mean of both, the difference is twice what is plotted; the 11 frames stay lost.",
)
CANNOT = (
    "How many cells are right: the measure does not see false claims. Evidence of 1 for both states, everywhere, is "
    "perfect.",
    "A divergence of Dirichlet densities, which the caption names: with evidence up to 1 none can exceed 1.",
    "How many cells the baseline leaves unknown: an observed cell of it has the mass 1/3 at most, by convention.",
    "Anything about time: the frames are in random order.",
    "Calibration, accuracy per state, false-free cells, distance: no such number is published.",
    "Other drives: these are 100 frames of one.",
)


def facts(curves: read.Curves, rng: np.random.Generator) -> dict[str, Any]:
    """Return everything that is read off the curves."""
    own, limit = read.demixed(curves), read.bound()
    return {
        "frames": len(curves.kl),
        "curves": read.described(curves),
        "masses": read.shares(curves),
        "the geometric model's masses, if an observed cell has 1/3": read.observed(curves),
        "KL, deep against geometric as plotted": read.versus(curves.kl, curves.kl_geo),
        "KL, deep against geometric de-mixed (2 g - d)": read.versus(curves.kl, own),
        "geometric de-mixed": {"mean": own.mean(), "least": own.min(), "most": own.max()},
        "is it time?": read.order(curves, rng),
        "is it a Dirichlet KL with labels of evidence 1?": {
            "largest possible value of a cell, geometric evidence in [0, 1]": limit,
            "frames whose plotted mean exceeds it": int((curves.kl_geo > limit + 1e-6).sum()),
            "largest plotted mean": curves.kl_geo.max(),
        },
        "evidence of a label if it is a Dirichlet KL": read.scale_as_named(curves),
        "evidence of a label if it is what the released code computes": read.scale_as_released(curves, rng),
        "turning a label of 512 x 352 cells leaves without a label": read.turned(LABEL, 40.0),
        "what the figures show": SHOWS,
        "what they cannot show": CANNOT,
    }


def draw(path: Path, curves: read.Curves, found: dict[str, Any], note: str) -> None:
    """Draw both figures as published, and beside each what we read in it."""
    figure = Figure(figsize=(16, 10.5), layout="constrained")
    (masses, coverage), (kl, pairs) = figure.subplots(2, 2, width_ratios=(1.45, 1))
    _masses(masses, curves)
    _coverage(coverage, curves, found)
    _kl(kl, curves, found)
    _pairs(pairs, curves, found)
    figure.suptitle("The paper's two result figures (van Kempen et al. 2021), re-plotted and re-read", fontsize=14)
    save_picture(figure, path, note)


def _masses(axes: Axes, curves: read.Curves) -> None:
    """Plot the figure of the mean masses."""
    for name, colour in {"unknown": "black", **colours().legend}.items():
        deep, geo = curves._asdict()[name], curves._asdict()[f"{name}_geo"]
        axes.plot(deep, color=colour, lw=1.6, label=f"{name}, deep: mean {deep.mean():.3f}")
        axes.plot(geo, color=colour, lw=1.6, ls=":", label=f"{name}, geometric: {geo.mean():.4f}")
    axes.axhline(2 / 3, color="#777777", lw=0.8)
    axes.text(99, 0.655, "no geometric cell can have less unknown than 2/3", ha="right", va="top", color="#555555")
    axes.set(xlim=(0, 99), ylim=(0, 1), ylabel="mean mass", title="As published: mean masses")
    axes.set_xlabel('"time in seconds"')
    axes.legend(ncols=3, loc="center", bbox_to_anchor=(0.5, 0.45), frameon=False, fontsize=9)


def _coverage(axes: Axes, curves: read.Curves, found: dict[str, Any]) -> None:
    """Plot the known share of the grid, the baseline's cells counted with another mass each."""
    seen = 3 * (1 - curves.unknown_geo)
    rank = np.argsort(curves.unknown)
    masses = found["the geometric model's masses, if an observed cell has 1/3"]
    axes.plot(1 - curves.unknown[rank], color=DEEP, lw=2, label=f"deep: mean {1 - curves.unknown.mean():.3f}")
    for mass, style, words in (
        (1 / 3, ":", "as published, mass 1/3 per observed cell"),
        (5 / 6, "--", "if it were as sure as evidence 10, mass 5/6"),
        (1.0, "-", "observed cells, mass 1"),
    ):
        axes.plot(mass * seen[rank], color=GEO, lw=1.4, ls=style, label=f"geometric, {words}: {mass * seen.mean():.3f}")
    axes.set(xlim=(0, 99), ylim=(0, 0.5), ylabel="mean mass of what is known", xlabel="frames, by the deep model's")
    axes.set_title(f"Re-read: the baseline observes {100 * masses['cells observed']:.1f} % of the cells at mass 1/3")
    axes.legend(loc="upper right", frameon=False, fontsize=9)


def _kl(axes: Axes, curves: read.Curves, found: dict[str, Any]) -> None:
    """Plot the figure of the divergence."""
    pair = found["KL, deep against geometric as plotted"]
    lost = np.array(pair["frames in which the second is lower"], int)
    impossible = found["is it a Dirichlet KL with labels of evidence 1?"]
    axes.plot(curves.kl, color=DEEP, lw=1.6, label=f"deep: mean {curves.kl.mean():.3f}")
    axes.plot(curves.kl_geo, color=GEO, lw=1.6, ls=":", label=f"geometric, as plotted: mean {curves.kl_geo.mean():.3f}")
    axes.plot(lost, curves.kl[lost] + 0.06, "v", color="black", label=f"{len(lost)} frames: geometric is lower")
    above = f"{impossible['frames whose plotted mean exceeds it']} means above it"
    axes.axhline(1, color="#777777", lw=0.8, label=f"bound of a Dirichlet KL: {above}")
    lags = [abs(one["lag-1 correlation"]) for one in found["is it time?"].values()]
    axes.set(xlim=(0, 99), ylim=(0, 2.3), ylabel='"KL"', title="As published: Kullback-Leibler divergence")
    axes.set_xlabel(f'"time in seconds": no correlation with the next value beyond {max(lags):.2f}')
    axes.legend(loc="upper right", ncols=2, frameon=False, fontsize=9)


def _pairs(axes: Axes, curves: read.Curves, found: dict[str, Any]) -> None:
    """Plot the divergence of one model against that of the other."""
    own, lost = read.demixed(curves), curves.kl_geo < curves.kl
    axes.plot([0, 3], [0, 3], color="#777777", lw=0.8)
    for kept, sign, size, colour, which in ((~lost, "o", 4.5, GEO, "deep"), (lost, "v", 6, "black", "geometric")):
        label = f"as plotted: {which} lower, {kept.sum()}"
        axes.plot(curves.kl[kept], curves.kl_geo[kept], sign, ms=size, color=colour, label=label)
    axes.plot(curves.kl, own, "x", ms=4.5, color=OWN, label=f"geometric de-mixed, 2 g - d: mean {own.mean():.3f}")
    scale = found["evidence of a label if it is what the released code computes"]
    E = scale["E"]
    axes.set(xlim=(0.1, 1.3), ylim=(0.1, 3.0), xlabel='"KL" of the deep model', ylabel='"KL" of the geometric model')
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xticks(ticks := (0.2, 0.5, 1, 2), [f"{tick:g}" for tick in ticks])
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    evidence = f"{E['value']:.2f} ({E['low']:.2f} to {E['high']:.2f})"
    axes.set_title(f"Re-read: evidence per observed cell {evidence}, R² {scale['R2']:.2f}")
    axes.legend(loc="lower right", frameon=False, fontsize=9)


def main() -> None:
    parser = run.Parser(__doc__, picture=True)
    parser.add_argument("--curves", type=Path, default=CURVES, help="the values behind the figures, a CSV")
    options = parser.parse_args()
    if not options.curves.is_file():
        print(f"there is no {options.curves}: give the values behind the paper's figures with --curves")
        return
    sha256 = hashlib.sha256(options.curves.read_bytes()).hexdigest()
    record = run.environment() | {"source": CITED, "sha256 of the values": sha256, "seed": SEED}
    curves = read.read_curves(options.curves)
    found = facts(curves, np.random.default_rng(SEED))
    run.write_record(options.out, record | found)
    draw(options.picture, curves, found, caption(record))


if __name__ == "__main__":
    main()
