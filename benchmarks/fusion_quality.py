"""What fusing over time gives, by which rule, and against the classical Bayes filter.

    python benchmarks/fusion_quality.py DRIVES [--ism ray lite combined] [--first N] [--out FILE]

DRIVES holds drives of 10 s at 10 Hz that `ogm simulate --sequences N` made. All maps run over all drives, behind each
sensor model. Intervals are 95 % intervals over drives: the frames of a drive are not independent. Writes
benchmarks/results/fusion_quality.json and docs/pictures/fusion_quality.png, of the last model.

The parameter of each rule was chosen on other drives by the longer version of this benchmark, of commit 07dd60b.

Definitions, see `_fusion_drives`:

* static: cells whose truth, over all frames of the drive and without whatever ever moves, is free (occupied in at most
  a tenth of the frames that see it) or occupied (in half of them and more); in view, visible from some frame so far,
  and with no motion within 5 s. A cell is predicted by P(occupied) = occupied + unknown / 2;
* ghosts: cells that a moving (> 1 m/s), seen (10 points and more) participant covered up to 5 s ago, that nothing
  covers now, and that are static and free with all eight neighbours. Areas are per moving participant and frame; shares
  are of cells in which a scan was occupied while they were covered;
* appears: share of cells under a moving participant that are occupied in the map (P > 1/2) at the first scan that is.
"""

import _run as run  # first: it sets the number of threads

# isort: split
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _charts import caption, save_picture
from _fusion_drives import MEMORY, PAPER, WINDOW, Drive, Trail, read_drive, trails, window
from matplotlib import colormaps
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ogm import EvidentialGrid
from ogm.datasets import Dataset, open_dataset
from ogm.evaluation import mean_interval, ratio_interval
from ogm.evidence import cautious, cumulative, dempster, discount_evidence, pcr6, yager
from ogm.fusion import BinaryBayesMapper, EvidentialMapper, map_scans
from ogm.metrics import accumulate, score
from ogm.models import load_model
from ogm.state import CellState

INF, EVERY = float("inf"), 5  # EVERY: frames from one comparison with a frame's own truth to the next
EVEN = 1e-4  # how near to 1/2 a probability is neither
SCAN, BAYES, DEFAULT = "scan alone", "classical Bayes", "EvidentialMapper, default"
RULES = ("revise", "cautious", "dempster", "yager", "pcr6", "cumulative")
MATCHED = (0.02 / 1.02, 1 / 1.02)  # the plausibilities that min_unknown = 0.02 allows


class ScanAlone:
    """No memory: the map is the last scan."""

    def __init__(self) -> None:
        self.mapper = EvidentialMapper(WINDOW, dempster, INF, moving_half_life=INF, min_unknown=0.0)

    def update(self, grid: EvidentialGrid, T_map_sensor: NDArray[np.float64], *, stamp: float) -> None:
        """Forget the last scan and take this one."""
        self.mapper.reset()
        self.mapper.update(grid, T_map_sensor, stamp=stamp)
        self.grid, self.scan = self.mapper.grid, grid

    def view(self, spec: Any) -> EvidentialGrid:
        """Return the scan as it is."""
        return self.scan


def evidential(*arguments: Any, **options: Any) -> Callable[[], EvidentialMapper]:
    """Return a builder of maps whose dynamic cells decay like all others, unless stated."""
    return lambda: EvidentialMapper(WINDOW, *arguments, **{"moving_half_life": INF, **options})


class Combined(EvidentialMapper):
    """One map of the combined masses, where the mapper would fuse each model by itself."""

    def update(self, grid: EvidentialGrid, *arguments: Any, **options: Any) -> None:
        """Fuse the masses of a grid without its parts."""
        super().update(EvidentialGrid.trusted(grid.spec, grid.mass), *arguments, **options)


MAPS: dict[str, Callable[[], Any]] = {
    SCAN: ScanAlone,
    BAYES: lambda: BinaryBayesMapper(WINDOW),
    DEFAULT: lambda: EvidentialMapper(WINDOW),
    "revise, models combined before": lambda: Combined(WINDOW),
    "cautious, 2 s": lambda: EvidentialMapper(WINDOW, cautious, moving_half_life=0.04),
    "cautious, 2 s, models combined before": lambda: Combined(WINDOW, cautious, moving_half_life=0.04),
    "Dempster, 2 s": evidential(dempster, 2.0),
    "Yager, 2 s": evidential(yager, 2.0),
    "PCR6, 2 s": evidential(pcr6, 2.0),
    "cumulative, 1 s": evidential(cumulative, 1.0),
    "cumulative, evidence fades, 0.5 s": evidential(cumulative, 0.5, discounting=discount_evidence),
    "Bayes by plausibility, limits as Dempster, 0.5 s": lambda: BinaryBayesMapper(
        WINDOW, 0.5, match="plausibility", limits=MATCHED
    ),
}


def evaluate_map(
    drive: Drive, mapper: Any, grids: Sequence[EvidentialGrid], left: Sequence[Trail]
) -> tuple[dict[str, float], NDArray[np.float64]]:
    """Run a map over a drive; return its scores, and how many cells that were left are ghosts by age, (51, 2)."""
    static, views = np.zeros((2, 6)), []
    ages, body, shown, ghosts = np.zeros((MEMORY + 1, 2)), np.zeros(3), np.zeros(2), 0
    for k, (frame, grid) in enumerate(zip(drive.frames, grids, strict=True)):
        mapper.update(grid, drive.poses[k], stamp=frame.stamp)
        now = mapper.grid
        offset = np.rint((np.array(now.spec.origin) - drive.spec.origin) / drive.spec.resolution).astype(int)
        around = window(drive.corners[k] - offset, len(drive.labels[k]))
        for row, state in enumerate((CellState.FREE, CellState.OCCUPIED)):
            mass = now.mass[around][drive.labels[k] == state].astype(np.float64)
            p = mass[:, 1] + 0.5 * (1 - mass.sum(axis=1))
            hits = p > 0.5 + EVEN, p < 0.5 - EVEN, p < 0.25, mass[:, row] > 0.5
            static[row] += [len(p), *map(np.count_nonzero, hits), float(((p - row) ** 2).sum())]

        trail = left[k]
        p = _probability(now, drive, trail.left, offset)
        ghosts += np.count_nonzero(p > 0.5 + EVEN)
        for column, kept in enumerate((trail.touched, trail.touched & (p > 0.5 + EVEN))):
            ages[:, column] += np.bincount(trail.age[kept], minlength=MEMORY + 1)
        p = _probability(now, drive, trail.covered, offset)
        body += (
            len(p),
            np.count_nonzero(p > 0.5 + EVEN),
            np.count_nonzero(_masses(now, drive, trail.covered, offset)[:, 0] > 0.5),
        )
        shown += np.count_nonzero(trail.since == 0), np.count_nonzero(p[trail.since == 0] > 0.5 + EVEN)
        if k % EVERY == EVERY - 1:
            state = frame.truth.crop(PAPER).state
            state = np.where(state == CellState.UNKNOWN, np.uint8(CellState.IGNORE), state)
            views.append(score(accumulate(mapper.view(PAPER).mass, state)))
    (free, miss, right, _, free_known, free_square), (cells, hit, lost, sure, known, square) = static
    scores = {
        "static_iou_occupied": hit / (cells + miss),
        "static_iou_free": right / (free + lost),
        "static_false_free": sure / cells,
        "static_brier": (square + free_square) / (cells + free),
        "static_known": (known + free_known) / (cells + free),
        "ghost_area": ghosts * PAPER.resolution**2 / max(drive.objects, 1),
        "ghost_share": ages[5:, 1].sum() / max(ages[5:, 0].sum(), 1),
        "appears": shown[1] / max(shown[0], 1),
        "body_recall": body[1] / max(body[0], 1),
        "body_free": body[2] / max(body[0], 1),
    }
    for name in ("nll", "false_free", "iou_free_known", "iou_occupied_known", "brier", "ece"):
        scores[f"view_{name}"] = np.nanmean([one[name] for one in views])
    return {name: float(value) for name, value in scores.items()}, ages


def _probability(
    grid: EvidentialGrid, drive: Drive, cells: NDArray[np.int64], offset: NDArray[np.int64]
) -> NDArray[np.float64]:
    mass = _masses(grid, drive, cells, offset)
    return mass[:, 1] + 0.5 * (1 - mass.sum(axis=1))


def _masses(
    grid: EvidentialGrid, drive: Drive, cells: NDArray[np.int64], offset: NDArray[np.int64]
) -> NDArray[np.float64]:
    ix, iy = np.divmod(cells, drive.spec.shape[1])
    return grid.mass[ix - offset[0], iy - offset[1]].astype(np.float64)


def draw(path: Path, ages: dict[str, NDArray[np.float64]], rows: dict[str, Any], note: str) -> None:
    """Draw ghosts over time, and false free against the log loss."""
    figure = Figure(figsize=(14, 5.5), layout="constrained")
    first, second = figure.subplots(1, 2)
    colors = colormaps["tab20"].colors  # type: ignore[attr-defined]
    for color, (name, counts) in zip(colors, ages.items(), strict=False):
        share = 100 * counts[1:, 1] / np.maximum(counts[1:, 0], 1)
        first.plot(0.1 * np.arange(1, len(counts)), np.maximum(share, 1e-2), color=color, label=name)
        false_free, loss = (np.nanmean(rows[name][key]) for key in ("view_false_free", "view_nll"))
        second.plot(100 * false_free, loss, "o", color=color, label=name)
    first.set(xscale="log", yscale="log", xlabel="time since the participant left the cell [s]")
    first.set_ylabel("cells still occupied, P > 1/2 [%]")
    second.set(xlabel="occupied cells that are free in the map [%]", ylabel="log loss of known cells")
    second.legend(fontsize=8)
    save_picture(figure, path, note)


def over_drives(dataset: Dataset, ism: str, first: int | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Run all maps over the drives behind a model; return by map scores of each drive, and cells by age."""
    model = load_model(ism, PAPER)
    found: dict[str, list[dict[str, float]]] = {name: [] for name in MAPS}
    ages: dict[str, NDArray[np.float64]] = {name: np.zeros((MEMORY + 1, 2)) for name in MAPS}
    sequences = dict(list(dataset.sequences.items())[:first])
    for name, numbers in sequences.items():
        print(f"{ism}: {name} of {len(sequences)}", file=sys.stderr, flush=True)
        drive = read_drive(dataset.select(numbers))
        grids = [grid for _, grid in map_scans(drive.frames, model)]
        left = list(trails(drive, [grid.mass for grid in grids]))
        for method, make in MAPS.items():
            scores, counts = evaluate_map(drive, make(), grids, left)
            found[method].append(scores)
            ages[method] += counts
    return {name: {key: np.array([row[key] for row in rows]) for key in rows[0]} for name, rows in found.items()}, ages


def summarize(values: dict[str, Any], ages: dict[str, Any]) -> dict[str, Any]:
    """Return by map means and ratios to the classical filter with their intervals, and shares of ghosts by age."""
    return {
        name: {
            "mean and 95 % interval": {key: list(mean_interval(v)) for key, v in scores.items()},
            "ratio to the classical filter": {
                key: list(ratio_interval(v, values[BAYES][key])) for key, v in scores.items()
            },
            "ghost share by age 0.1 s, 0.2 s, ...": list(ages[name][1:, 1] / np.maximum(ages[name][1:, 0], 1)),
        }
        for name, scores in values.items()
    }


def main() -> None:
    parser = run.Parser(__doc__, picture=True)
    parser.add_argument("drives", type=Path)
    parser.add_argument("--ism", nargs="+", default=["ray", "combined"])
    parser.add_argument("--first", type=int, help="take the first N drives")
    given = parser.parse_args()
    dataset = open_dataset(given.drives, split="sequences")
    environment = run.environment(*given.ism, *RULES, "bayes")
    record = {"environment": environment, "definitions": __doc__, "drives": dataset.facts, "maps": {}}
    for ism in given.ism:
        values, ages = over_drives(dataset, ism, given.first)
        record["maps"][ism] = summarize(values, ages)
        run.write_record(given.out, record)
    draw(given.picture, ages, values, f"behind {ism}; {caption(environment)}")


if __name__ == "__main__":
    main()
