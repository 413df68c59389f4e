"""What do all metrics of a frame cost, against scikit-learn's few? How long does a report take? Measured.

    python benchmarks/evaluation_speed.py DEV [--rounds N] [--quick]

DEV is a data set of drives (see benchmarks/README.md). One core, 512 x 352 cells. First the metrics of one frame, then
all that `ogm evaluate` does for 100 frames and 5 methods without reading samples and making grids. Writes
benchmarks/results/evaluation_speed.json.
"""

import _run as run  # first: it sets the number of threads

# isort: split
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from _timing import Contender, measure
from numpy.typing import NDArray
from sklearn import metrics as peer

from ogm import GridSpec, metrics
from ogm.datasets import Dataset, open_dataset
from ogm.evaluation import FusedMethod, MethodRunner, SingleScanMethod, evaluate, write_report

SPEC = GridSpec.centered()
MODELS, RULE = ("height-band", "ray", "lite"), "cautious"
FRAMES = 100


def everything(mass: NDArray[np.float32], state: NDArray[np.uint8], away: NDArray[np.float32]) -> None:
    """Compute all metrics of a grid, with curves and ranges."""
    counts = metrics.accumulate(mass, state, away)
    metrics.score(counts)
    metrics.by_range(counts)
    for which in ("all", "predicted_known", "relative"):
        metrics.reliability(counts, which)  # type: ignore[arg-type]
    metrics.intervals(counts)
    metrics.risk_coverage(counts)
    metrics.free_space(counts)
    metrics.precision_recall(counts, 0)
    metrics.precision_recall(counts, 1)


def few(mass: NDArray[np.float32], state: NDArray[np.uint8]) -> None:
    """Compute five of them by scikit-learn: IoU, Brier, log loss, AUROC of unknown, average precision of occupied."""
    kept = state < 3
    truth, (free, occupied) = state[kept], mass[kept].T
    rest = 1 - free - occupied
    peer.jaccard_score(truth, np.argmax([rest, free, occupied], axis=0), average=None, labels=[0, 1, 2])
    known = truth > 0
    p, happened = (occupied + rest / 2)[known], truth[known] == 2
    peer.brier_score_loss(happened, p)
    peer.log_loss(happened, p)
    peer.roc_auc_score(~known, rest)
    peer.average_precision_score(happened, p)


def contenders(mass: NDArray[np.float32], state: NDArray[np.uint8]) -> dict[str, Contender]:
    """Return the contenders on one frame."""
    away = metrics.distances(SPEC)
    return {
        "copy": Contender(lambda _: (mass.copy(), state.copy(), away.copy())),
        f"all {len(metrics.METRICS)} metrics, curves, ranges": Contender(lambda _: everything(mass, state, away)),
        "scikit-learn, five metrics": Contender(lambda _: few(mass, state)),
    }


def methods() -> dict[str, SingleScanMethod | FusedMethod]:
    """Return three models, and two of them fused over time."""
    scans = {name: SingleScanMethod.named(name, SPEC) for name in MODELS}
    fused = {f"{name} + {RULE}": FusedMethod.by_rule(name, scans[name].model, RULE, SPEC) for name in ("ray", "lite")}
    return scans | fused


def whole(dataset: Dataset, frames: int) -> dict[str, float]:
    """Evaluate and report; return how long that took without reading samples and making grids."""
    apart = [0.0]

    def update(runner: MethodRunner, frame: Any, step: Callable[..., Any] = MethodRunner.update, **how: Any) -> None:
        start = time.perf_counter()
        frame.truth, frame.scan  # noqa: B018  read here
        step(runner, frame, **how)
        apart[0] += time.perf_counter() - start

    def read_ahead(numbers: Iterable[int]) -> Iterator[int]:
        for number in numbers:
            start = time.perf_counter()
            dataset[number].truth  # noqa: B018  kept by the data set
            apart[0] += time.perf_counter() - start
            yield number

    with tempfile.TemporaryDirectory() as place, mock.patch.object(MethodRunner, "update", update):
        folder = Path(place)
        start = time.perf_counter()
        result = evaluate(methods(), dataset, SPEC, frames=range(frames), out=folder, progress=read_ahead)
        evaluated = time.perf_counter()
        write_report(folder, result, pictured=frames)
        end = time.perf_counter()
        size = (folder / "report.html").stat().st_size / 1e6
        kept = sum(path.stat().st_size for path in (folder / "frames").iterdir()) / 1e6
    return {
        "frames": frames,
        "methods": len(result.methods),
        "samples and grids, left out [s]": apart[0],
        "evaluation and pictures [s]": evaluated - start - apart[0],
        "reporting [s]": end - evaluated,
        "page [MB]": size,
        "kept frames [MB]": kept,
    }


def main() -> None:
    parser = run.Parser(__doc__, quick=True, rounds=20)
    parser.add_argument("data", type=Path)
    given = parser.parse_args()
    found = run.environment(*MODELS, RULE)
    frame = open_dataset(given.data, split="sequences")[50]
    state = frame.truth.crop(SPEC).state
    runner = MethodRunner({name: SingleScanMethod.named(name, SPEC) for name in MODELS}, SPEC)
    runner.update(frame)
    rounds = 2 if given.quick else given.rounds
    times = {name: measure(contenders(grid.mass, state), rounds) for name, grid in runner.grids().items()}
    dataset = open_dataset(given.data, split="sequences", others="later")
    report = whole(dataset, 6 if given.quick else FRAMES)
    slowest = max(one.median for group in times.values() for what, one in group.items() if "all" in what)
    seconds = report["evaluation and pictures [s]"] + report["reporting [s]"]
    rows = [
        ("all metrics of a frame", slowest, "<=", 60.0, "ms"),
        ("report, 100 frames x 5 methods", seconds, "<=", 120.0, "s"),
        ("page", report["page [MB]"], "<=", 15.0, "MB"),
    ]
    record = {"environment": found, "frame [ms]": times, "report": report, "verdicts": run.verdicts(rows)}
    run.write_record(given.out, record)


if __name__ == "__main__":
    main()
