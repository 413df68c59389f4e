"""What do all metrics of a frame cost, against scikit-learn's few? How long does a report take? Measured.

    python benchmarks/evaluation_speed.py DEV [--rounds N] [--quick]

DEV is a data set of drives (see benchmarks/README.md). One core, 512 x 352 cells. First the metrics of one frame, then
all that `ogm evaluate` does for 100 frames and 5 methods but for reading samples and making grids. Writes
benchmarks/results/evaluation_speed.json.
"""

from _run import RESULTS, Contender, Times, environment, measure, write_json

# isort: split
import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn import metrics as peer

from ogm import GridSpec
from ogm.cli.judging import ResultCache, run_evaluation
from ogm.cli.methods import Methods, methods_of
from ogm.cli.page import write_page
from ogm.cli.report import report, write_csv, write_report
from ogm.cli.source import Source, source_of
from ogm.metrics import (
    METRICS,
    by_range,
    distances,
    free_space,
    intervals,
    precision_recall,
    reliability,
    risk_coverage,
    score,
    accumulate,
)

SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
ISMS, RULE = ("height-band", "ray", "lite"), "cautious"
SHOWN = ("height-band", "ray", "lite", f"ray + {RULE}", f"lite + {RULE}")
FRAMES = 100
WANTED = {"all metrics of a frame [ms]": 60.0, "report, 100 frames x 5 methods [s]": 120.0, "page [MB]": 15.0}


def everything(mass: NDArray[np.float32], state: NDArray[np.uint8], away: NDArray[np.float32]) -> None:
    """Take all metrics of a grid, with curves and ranges."""
    counts = accumulate(mass, state, away)
    score(counts)
    by_range(counts)
    for which in ("all", "predicted_known", "relative"):
        reliability(counts, which)  # type: ignore[arg-type]
    intervals(counts)
    risk_coverage(counts)
    free_space(counts)
    precision_recall(counts, 0)
    precision_recall(counts, 1)


def few(mass: NDArray[np.float32], state: NDArray[np.uint8]) -> None:
    """Take five of them by scikit-learn: IoU, Brier, log loss, AUROC of unknown, average precision of occupied."""
    seen = state < 3
    truth, (free, occupied) = state[seen], mass[seen].T
    rest = 1 - free - occupied
    peer.jaccard_score(truth, np.argmax([rest, free, occupied], axis=0), average=None, labels=[0, 1, 2])
    known = truth > 0
    p, happened = (occupied + rest / 2)[known], truth[known] == 2
    peer.brier_score_loss(happened, p)
    peer.log_loss(happened, p)
    peer.roc_auc_score(~known, rest)
    peer.average_precision_score(happened, p)


def contenders(mass: NDArray[np.float32], state: NDArray[np.uint8]) -> dict[str, Contender]:
    """Return what is timed on one frame."""
    away = distances(SPEC)
    return {
        "copy": Contender(lambda _: (mass.copy(), state.copy(), away.copy())),
        f"all {len(METRICS)} metrics, curves, ranges": Contender(lambda _: everything(mass, state, away)),
        "scikit-learn, five metrics": Contender(lambda _: few(mass, state)),
    }


class Apart:
    """Sums the time that some calls take, to be left out."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __call__(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function whose time is summed."""

        def timed(*words: Any) -> Any:
            start = time.perf_counter()
            result = function(*words)
            self.seconds += time.perf_counter() - start
            return result

        return timed


def whole(source: Source, frames: int) -> dict[str, float]:
    """Judge and report, and say how long that took without reading samples and making grids."""
    given = methods_of(ISMS, [RULE], [], SPEC)
    methods = Methods({name: given[name] for name in SHOWN}, SPEC)
    apart = Apart()
    methods.grids = apart(methods.grids)  # type: ignore[method-assign]
    timed = replace(source, read=apart(source.read))
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        start = time.perf_counter()
        archive = ResultCache(folder / "frames", {"benchmark": "evaluation_speed"})
        result = run_evaluation(timed, range(frames), methods, archive)
        judged = time.perf_counter()
        named = source.frames[:frames]
        record = {
            "title": "evaluation_speed",
            "command": "",
            "date": "",
            "seed": 0,
            "data": {"kind": source.kind, "name": source.name, "truth": source.description},
            "frames": [frame._asdict() for frame in named],
            **report(result, np.random.default_rng(0), [frame.sequence for frame in named], methods.facts()),
        }
        write_report(folder / "report.json", record)
        write_csv(folder / "frames.csv", result, [frame.name for frame in named])
        views = {k: one.views for k in range(frames) if (one := archive.load(k)) is not None}
        write_page(folder / "report.html", record, views)
        end = time.perf_counter()
        size = (folder / "report.html").stat().st_size / 1e6
        kept = sum(path.stat().st_size for path in (folder / "frames").iterdir()) / 1e6
    return {
        "frames": frames,
        "methods": len(SHOWN),
        "samples and grids, left out [s]": apart.seconds,
        "judging and pictures [s]": judged - start - apart.seconds,
        "reporting [s]": end - judged,
        "page [MB]": size,
        "kept frames [MB]": kept,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument(
        "--quick", action="store_true", help="see that everything runs; figures are worth nothing"
    )
    given = parser.parse_args()
    found = environment() | {"command": f"python benchmarks/evaluation_speed.py {given.data.name}"}
    source = source_of(given.data, SPEC, "sequences", judged="maps")
    item = source_of(given.data, SPEC, "sequences").read(50)
    state = item.truth.crop(SPEC).state
    times: dict[str, dict[str, Times]] = {}
    methods = Methods(methods_of(ISMS, [], [], SPEC), SPEC)
    for name, grid in methods.grids(source.frames[50], item).items():
        times[name] = measure(contenders(grid.mass, state), 2 if given.quick else given.rounds)
        print(f"{name}: " + ", ".join(f"{what} {one}" for what, one in times[name].items()))
    run = whole(source, 6 if given.quick else FRAMES)
    print(", ".join(f"{what} {value:.4g}" for what, value in run.items()))
    slowest = max(one.median for group in times.values() for what, one in group.items() if "all" in what)
    reached = {
        "all metrics of a frame [ms]": slowest,
        "report, 100 frames x 5 methods [s]": run["judging and pictures [s]"] + run["reporting [s]"],
        "page [MB]": run["page [MB]"],
    }
    record = {
        "environment": found,
        "frame [ms]": {name: {w: one._asdict() for w, one in group.items()} for name, group in times.items()},
        "report": run,
        "wanted": {what: {"below": WANTED[what], "reached": value} for what, value in reached.items()},
    }
    if not given.quick:
        write_json(RESULTS / "evaluation_speed.json", record)


if __name__ == "__main__":
    main()
