"""Facts of the values behind the paper's two result figures: functions of its eight curves.

The curves are the coordinates in the LaTeX source of van Kempen, Lampe, Woopen, Eckstein, "A Simulation-based
End-to-End Learning Framework for Evidential Occupancy Grid Mapping", IEEE IV 2021: mean masses of unknown, free and
occupied, and "KL", of the deep and of the geometric model in 100 test frames. How the released code (EviLOG) makes
them: it takes the evidence of a label and of the geometric model as 1 per observed cell, so that such a cell has the
mass 1/3; its "KL" is the clipped categorical divergence of evidence (`ogm.metrics.evilog.evilog_kl`); and it does not
reset that metric between the two models, so that the second value is the mean of both.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm import GridSpec
from ogm.evaluation import compare_paired, ratio_interval
from ogm.evidence import dirichlet_kl

MISSED = -math.log(1e-7)  # what the released code charges for a labelled cell without evidence: 16.118
RESAMPLES = 5000
SHUFFLES = 10_000


class Curves(NamedTuple):
    """The plotted values, (frames,) float64 each; `*_geo` is the geometric model."""

    unknown: NDArray[np.float64]
    unknown_geo: NDArray[np.float64]
    free: NDArray[np.float64]
    free_geo: NDArray[np.float64]
    occupied: NDArray[np.float64]
    occupied_geo: NDArray[np.float64]
    kl: NDArray[np.float64]
    kl_geo: NDArray[np.float64]


COLUMNS = (
    *("t", "m_unknown_deep", "m_unknown_geo", "m_free_deep", "m_free_geo"),
    *("m_occ_deep", "m_occ_geo", "kld_deep", "kld_geo"),
)


def read_curves(path: Path) -> Curves:
    """Read the values: a CSV with the columns of `COLUMNS`, frames in the plotted order."""
    table = np.genfromtxt(path, delimiter=",", names=True)
    if table.dtype.names != COLUMNS:
        raise ValueError(f"{path} must have the columns {', '.join(COLUMNS)}, got {table.dtype.names}")
    curves = Curves(*(np.atleast_1d(table[name]) for name in COLUMNS[1:]))
    off = max(
        np.abs(curves.unknown + curves.free + curves.occupied - 1).max(),
        np.abs(curves.unknown_geo + curves.free_geo + curves.occupied_geo - 1).max(),
    )
    if not off < 1e-5:
        raise ValueError(f"{path}: the masses of a frame must sum to one, some are off by {off}")
    return curves


def described(curves: Curves) -> dict[str, dict[str, Any]]:
    """Return mean, standard deviation, quartiles and extremes of every curve, and the frames of the extremes."""
    return {
        name: {
            "mean": values.mean(),
            "sd": values.std(ddof=1),
            **{f"{q} %": np.percentile(values, q) for q in (5, 25, 50, 75, 95)},
            "least": values.min(),
            "frame of the least": int(values.argmin()),
            "most": values.max(),
            "frame of the most": int(values.argmax()),
        }
        for name, values in curves._asdict().items()
    }


def versus(first: NDArray[np.float64], second: NDArray[np.float64]) -> dict[str, Any]:
    """Compare two curves, of which the lower one is better, frame by frame; intervals are of 95 %.

    Frames count as independent: they are in random order, and neighbours are not alike (`order`).
    """
    found = compare_paired(first, second, "lower")
    ratios, lost = second / first, np.flatnonzero(second < first)
    margins = (first - second)[lost]
    return found._asdict() | {
        "difference": found.difference._asdict(),
        "ratio": found.ratio._asdict(),
        "ratio of a frame, second / first": {
            "mean": ratios.mean(),
            "geometric mean": np.exp(np.log(ratios).mean()),
            "median": np.median(ratios),
            "least": ratios.min(),
            "most": ratios.max(),
        },
        "frames in which the second is lower": lost.tolist(),
        "margin in these": {"mean": margins.mean() if len(lost) else 0.0, "most": margins.max(initial=0.0)},
    }


def shares(curves: Curves) -> dict[str, Any]:
    """Compare the masses: ratios deep / geometric, and the share of occupied in what is not unknown."""
    known, known_geo = 1 - curves.unknown, 1 - curves.unknown_geo
    return {
        "free, deep / geometric": ratio_interval(curves.free, curves.free_geo)._asdict(),
        "occupied, deep / geometric": ratio_interval(curves.occupied, curves.occupied_geo)._asdict(),
        "frames in which deep has less unknown": int((curves.unknown < curves.unknown_geo).sum()),
        "unknown, geometric - deep": compare_paired(curves.unknown_geo, curves.unknown, "lower").difference._asdict(),
        "occupied of what is known, deep": curves.occupied.mean() / known.mean(),
        "occupied of what is known, geometric": curves.occupied_geo.mean() / known_geo.mean(),
    }


def observed(curves: Curves) -> dict[str, float]:
    """Return the geometric model's masses if an observed cell has the mass 1/3, as in the released code."""
    cells = 3 * (1 - curves.unknown_geo)
    return {
        "cells observed": cells.mean(),
        "cells free": 3 * curves.free_geo.mean(),
        "cells occupied": 3 * curves.occupied_geo.mean(),
        "mean unknown if such a cell had evidence 10 (mass 5/6)": 1 - 5 / 6 * cells.mean(),
        "mean unknown if it had mass 1": 1 - cells.mean(),
        "mean unknown, deep": curves.unknown.mean(),
        "unknown of a cell at least": 2 / 3,
    }


def order(curves: Curves, rng: np.random.Generator) -> dict[str, dict[str, float]]:
    """Return the correlation of each value with the next, and its p value among shuffled orders of the frames.

    p is the share of random orders of the frames with a correlation at least as far from 0.
    """

    def lag(rows: NDArray[np.float64]) -> NDArray[np.float64]:
        centred = rows - rows.mean(axis=-1, keepdims=True)
        return (centred[..., 1:] * centred[..., :-1]).sum(axis=-1) / (centred**2).sum(axis=-1)

    found = {}
    for name, values in curves._asdict().items():
        draws = rng.permuted(np.tile(values, (SHUFFLES, 1)), axis=1)
        at_least = np.count_nonzero(np.abs(lag(draws)) >= abs(lag(values)))
        found[name] = {"lag-1 correlation": float(lag(values)), "p": (1 + at_least) / (1 + SHUFFLES)}
    return found


def demixed(curves: Curves) -> NDArray[np.float64]:
    """Return the geometric model's own value, if the plotted one is the mean of both: 2 g - d."""
    return 2 * curves.kl_geo - curves.kl


def bound(steps: int = 101) -> float:
    """Return the largest KL[Dir(1 + e) || Dir(1 + y)] of a cell with e in [0, 1] each and a label of evidence 1.

    Searched on a grid of evidence; labels are unknown, free, occupied.
    """
    e = np.stack(np.meshgrid(*[np.linspace(0, 1, steps)] * 2, indexing="ij"), axis=-1)
    labels = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    return float(max(dirichlet_kl(1 + e, np.broadcast_to(1 + y, e.shape)).max() for y in labels))


def scale_as_named(curves: Curves) -> dict[str, float]:
    """Take the figure for what its caption names, a Dirichlet KL, and ask for the evidence E of a label.

    With the deep model as the truth, the geometric one misses (u_geo - u) / b cells, b = E / (E + 2), and each costs
    E - ln(1 + E). E is the one that gives the mean of the plotted curve; R² is the fit over the frames.
    """
    missing = curves.unknown_geo - curves.unknown

    def predicted(E: float) -> NDArray[np.float64]:
        return missing * (E + 2) / E * (E - math.log1p(E))

    low, high = 1e-3, 1e3  # the prediction grows with E
    while high - low > 1e-9 * high:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if predicted(middle).mean() > curves.kl_geo.mean() else (middle, high)
    return {"E": low, "R2": _r2(curves.kl_geo, predicted(low))}


def scale_as_released(curves: Curves, rng: np.random.Generator) -> dict[str, Any]:
    """Take the figure for what the released code computes, and ask for the evidence E of an observed cell.

    Then the deep model's known mass is

        1 - u = c [ (E + 2) / E (1 - u_geo) + (2 g - d) / 16.118 - (d / c) / 16.118 ]:

    c, the belief that it puts into a cell that the label knows, times the cells that the geometric model sees and
    those that it misses. A regression of 1 - u on (1 - u_geo, g, d) and a constant leaves all coefficients free, so
    that c follows from that of g and E from that of 1 - u_geo. Coverage is taken to be nested, c to be the same in
    all frames. Without the averaging, c would be twice as large.
    """
    known, known_geo = 1 - curves.unknown, 1 - curves.unknown_geo
    columns = np.stack([known_geo, curves.kl_geo, curves.kl, np.ones_like(known)], axis=-1)

    def fit(rows: NDArray[np.int64]) -> NDArray[np.floating]:
        return np.linalg.lstsq(columns[rows], known[rows], rcond=None)[0]

    def belief_and_scale(b: NDArray[np.floating]) -> tuple[float, float]:
        c = 0.5 * MISSED * b[1]
        return c, 2 / (b[0] / c - 1)

    n = len(known)
    b = fit(np.arange(n))
    c, E = belief_and_scale(b)
    draws = np.array([belief_and_scale(fit(rng.integers(n, size=n))) for _ in range(RESAMPLES)])
    (c_low, E_low), (c_high, E_high) = np.percentile(draws, (2.5, 97.5), axis=0)
    labelled = 3 * known_geo + demixed(curves) / MISSED  # E = 1: cells that it sees, and those that it misses
    alone = float((labelled @ known) / (labelled @ labelled))
    return {
        "coefficients of 1 - u_geo, g, d, 1": b.tolist(),
        "R2": _r2(known, columns @ b),
        "belief c": {"value": c, "low": c_low, "high": c_high},
        "belief c without the averaging": 2 * c,
        "E": {"value": E, "low": E_low, "high": E_high},
        "one parameter: c": alone,
        "one parameter: R2": _r2(known, alone * labelled),
        "cells that the labels know": {"mean": labelled.mean(), "least": labelled.min(), "most": labelled.max()},
        "cells that the geometric model misses, at most": _mean_and_ends(demixed(curves) / MISSED),
        "cells that the deep model misses, at most": _mean_and_ends(curves.kl / MISSED),
    }


def turned(spec: GridSpec, ahead: float, steps: int = 360) -> dict[str, float]:
    """Return the share of a label's cells that lose their label when it is turned by a random angle.

    That is how the paper augments its training data: label and points are turned alike, and what a finite label
    does not hold is filled with zeros, which mean unknown. The cell so far `ahead` of the sensor [m] is reported alone.
    """
    x, y = spec.cell_centers
    low, high, right, left = spec.extent

    def outside(x: NDArray[np.floating], y: NDArray[np.floating], angle: float) -> NDArray[np.bool_]:
        u, v = math.cos(angle) * x - math.sin(angle) * y, math.sin(angle) * x + math.cos(angle) * y
        return ~((low <= u) & (u < high) & (right <= v) & (v < left))

    angles = (np.arange(steps) + 0.5) * 2 * math.pi / steps
    everywhere = [outside(x, y, angle).mean() for angle in angles]
    there = [outside(np.array(ahead), np.array(0.0), angle).mean() for angle in angles]
    return {
        "mean share of cells": float(np.mean(everywhere)),
        "share of cells at 90 degrees": float(outside(x, y, math.pi / 2).mean()),
        f"share of angles, {ahead:g} m straight ahead": float(np.mean(there)),
    }


def _mean_and_ends(values: NDArray[np.float64]) -> Mapping[str, float]:
    return {"mean": values.mean(), "least": values.min(), "most": values.max()}


def _r2(values: NDArray[np.float64], predicted: NDArray[np.float64]) -> float:
    return float(1 - ((values - predicted) ** 2).sum() / ((values - values.mean()) ** 2).sum())
