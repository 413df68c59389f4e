"""Fit the numbers of the model `combined` to simulated validation drives.

    python benchmarks/combined_fit.py DATA=DRIVES [DATA=DRIVES ...] [--occupied 0.5] [--quick]

DATA are data sets that `ogm simulate` made, DRIVES the numbers of the validation drives to fit to ("0,2,5-8"). Of
every frame up to 900 cells of each true state are drawn and weighted by their share. Searched by Nelder-Mead are the
reliability of free of `lite` and the gates of both; that of occupied of `ray` is given, all others are 1. Made least is
the mean over data sets of the logarithm of the log loss over the better part's; a ratio of log loss, Brier score,
false free or 1 - IoU above 1 less a margin is penalised. Writes benchmarks/results/combined_fit.json.

The optimum is flat: `ogm.models.named.COMBINATION` is the rounded result of the same search over other cells of
the same frames, and its ratios are recorded beside those of the fit.
"""

import _run as run  # first: it sets the number of threads
from combined import validation_frames

# isort: split
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from ogm import GridSpec, Mount
from ogm.models.combined import CombinedISM, FreeGate, StateReliability
from ogm.models.named import COMBINATION, LITE, RAY, load_model
from ogm.scan import run_model
from ogm.state import CellState, predict_state

SPEC = GridSpec.centered()
DRAWN = 900  # cells of each state in a frame
MARGINS = {"nll": 0.02, "brier": 0.0, "false_free": 0.15, "1 - iou_free": 0.03, "1 - iou_occupied": 0.0}
PENALTY = 10.0
START = (0.8, 0.6, 0.12, 0.73, 0.3)
STEP = 0.1  # of the first simplex
RESTARTS, EVALUATIONS = 3, 450


class Cells(NamedTuple):
    """Cells drawn from frames: masses of `ray` and `lite` (2, N, 2), true states, weights, numbers of their frames."""

    masses: NDArray[np.float32]
    state: NDArray[np.uint8]
    weight: NDArray[np.float64]
    frame: NDArray[np.int64]


def draw_cells(words: str, most: int | None) -> Cells:
    """Map the frames of some validation drives by both models, and draw cells."""
    dataset, _, numbers = validation_frames(words)
    models, rng, parts = [load_model(name, SPEC) for name in (RAY, LITE)], np.random.default_rng(1), []
    for number in numbers[:most]:
        frame = dataset[number]
        masses = np.stack([run_model(model, frame).mass.reshape(-1, 2) for model in models])
        state = frame.truth.crop(SPEC).state.ravel()  # type: ignore[union-attr]
        for one in (CellState.UNKNOWN, CellState.FREE, CellState.OCCUPIED):
            found = np.flatnonzero(state == one)
            some = rng.choice(found, min(DRAWN, len(found)), replace=False)
            weight = np.full(len(some), len(found) / max(len(some), 1))
            parts.append(Cells(masses[:, some], state[some], weight, np.full(len(some), number)))
    masses, state, weight, frame = zip(*parts, strict=True)
    places = np.unique(np.concatenate(frame), return_inverse=True)[1]
    return Cells(np.concatenate(masses, axis=1), np.concatenate(state), np.concatenate(weight), places)


def scores(cells: Cells, mass: NDArray[np.float32]) -> dict[str, float]:
    """Return means over frames of what is made small, from the drawn cells."""
    free, occupied = mass.astype(np.float64).T
    probability, state, predicted = 0.5 * (1 + occupied - free), cells.state, predict_state(mass)
    is_occupied, is_free = state == CellState.OCCUPIED, state == CellState.FREE
    known = is_occupied | is_free
    right = np.maximum(np.where(is_occupied, probability, 1 - probability), 1e-5)

    def share(part: NDArray, whole: NDArray) -> float:
        """Return the mean over frames of the ratio of two sums, where the second is not 0."""
        a, b = (np.bincount(cells.frame, cells.weight * one) for one in (part, whole))
        return float((a[b > 0] / b[b > 0]).mean())

    def missed(truth: NDArray, which: CellState) -> float:
        given = predicted == which
        return 1 - share(truth & given, truth | given)

    return {
        "nll": share(known * -np.log(right), known),
        "brier": share(known * (1 - right) ** 2, known),
        "false_free": share(is_occupied & (free > 0.5), is_occupied),
        "1 - iou_free": missed(is_free, CellState.FREE),
        "1 - iou_occupied": missed(is_occupied, CellState.OCCUPIED),
    }


def options(x: Sequence[float], occupied: float) -> dict[str, Any]:
    """Return the options of `CombinedISM` for a point of the search."""
    free, low, width, share, high = map(float, x)
    gates = FreeGate(0.0, low, low + max(width, 0.001)), FreeGate(share, 0.0, max(high, 0.001))
    return {"reliability": (StateReliability(1.0, occupied), StateReliability(free, 1.0)), "free_gates": gates}


def ratios(cells: Cells, ism: CombinedISM) -> dict[str, float]:
    """Return the scores of a combination over those of the better part, which differ from score to score."""
    parts = [scores(cells, mass) for mass in cells.masses]
    found = scores(cells, ism.combine(list(cells.masses)))
    return {name: value / min(one[name] for one in parts) for name, value in found.items()}


def fit(data: Mapping[str, Cells], occupied: float, evaluations: int) -> NDArray[np.float64]:
    """Return the point of the search with the least objective."""
    models = [load_model(name, SPEC, Mount(1.9)) for name in (RAY, LITE)]  # any: only masses are combined
    best = {n: [scores(c, mass) for mass in c.masses] for n, c in data.items()}
    least = {name: {m: min(part[m] for part in parts) for m in MARGINS} for name, parts in best.items()}

    def objective(x: NDArray[np.float64]) -> float:
        if ((x < 0) | (x > 1)).any():
            return 100 + float(np.abs(x).sum())
        ism, total = CombinedISM(models, **options(x, occupied)), 0.0
        for name, cells in data.items():
            found = scores(cells, ism.combine(list(cells.masses)))
            excess = {m: np.log(found[m] / least[name][m]) for m in MARGINS}
            total += excess["nll"] / len(data) + PENALTY * sum(max(0.0, excess[m] + MARGINS[m]) for m in MARGINS)
        return float(total)

    x = np.array(START)
    for _ in range(RESTARTS):
        steps = np.where(x < 0.8, STEP, -STEP) * np.eye(len(x))
        simplex = np.clip(np.vstack([x, x + steps]), 0, 1)
        x = minimize(objective, x, method="Nelder-Mead", options={"maxfev": evaluations, "initial_simplex": simplex}).x
    return x


def main() -> None:
    parser = run.Parser(__doc__, quick=True)
    parser.add_argument("data", nargs="+", metavar="DATA=DRIVES")
    parser.add_argument("--occupied", type=float, default=0.5, help="reliability of occupied of ray")
    given = parser.parse_args()
    data = {Path(w.rpartition("=")[0]).name: draw_cells(w, 3 if given.quick else None) for w in given.data}
    found = options(fit(data, given.occupied, 20 if given.quick else EVALUATIONS), given.occupied)
    models = [load_model(name, SPEC, Mount(1.9)) for name in (RAY, LITE)]
    ways = {"fitted": CombinedISM(models, **found), "COMBINATION": CombinedISM(models, **COMBINATION)}
    record = {
        "environment": run.environment(RAY, LITE),
        "fitted": {key: [one._asdict() for one in value] for key, value in found.items()},
        "ratio to the better part": {
            way: {name: ratios(cells, ism) for name, cells in data.items()} for way, ism in ways.items()
        },
    }
    run.write_record(given.out, record)
    print(record["fitted"], record["ratio to the better part"], sep="\n")


if __name__ == "__main__":
    main()
