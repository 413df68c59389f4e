"""Compare the combination of `ray` and `lite` with each, on simulated validation towns and on real recordings.

    python benchmarks/combined.py DATA=DRIVES [DATA=DRIVES ...] [--real FOLDER] [--quick]

DATA are data sets that `ogm simulate` made, DRIVES the numbers of the validation drives to evaluate ("1,3-5"), which
are those that the parameters (`ogm.models.named.COMBINATION`) were not fitted to. Compared are both parts, the
model `combined`, and for reference plain Dempster (reliability 1, no gates), and `combined` with the hits of `ray`
kept. Real recordings are those of `quality`, labelled cells only; nothing was chosen by them. Means over frames, and
`combined` against each part frame by frame, with 95 % intervals over drives. Cost: the best of many calls on one scan.
Writes benchmarks/results/combined.json; docs/build.py makes tables of it.
"""

import _run as run  # first: it sets the number of threads
from _quality_inputs import real
from _quality_record import write

# isort: split
import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ogm import EvidentialGrid, GridSpec, Mount, Scan
from ogm.datasets import Dataset, open_dataset
from ogm.evaluation import Evaluation, evaluate
from ogm.models.combined import CombinedISM
from ogm.models.named import COMBINATION, COMBINED, LITE, RAY, load_model
from ogm.scan import InverseSensorModel

SPEC = GridSpec.centered()
METRICS = (
    *("nll", "brier", "false_free", "iou_free", "iou_occupied", "missed_occupied", "false_occupied"),
    *("ece", "ece_relative", "auroc_unknown", "mean_unknown", "free_recall_1"),
)
WAYS: dict[str, dict[str, Any]] = {
    COMBINED: COMBINATION,
    "combined, hits kept": COMBINATION | {"keep_hits": 0},
    "plain Dempster": {},
}
CALLS = 40


class Once:
    """A model that maps each scan once, for all that ask for it."""

    def __init__(self, model: InverseSensorModel) -> None:
        self.model, self.spec = model, model.spec
        self.last: tuple[Scan | None, Any] = None, None

    def __call__(self, scan: Scan) -> EvidentialGrid:
        """Map one scan, or return its grid if it was the last."""
        if self.last[0] is not scan:
            self.last = scan, self.model(scan)
        return self.last[1]


def methods() -> dict[str, InverseSensorModel]:
    """Return both parts and all ways to combine them, each scan mapped once by each part."""
    parts = {name: Once(load_model(name, SPEC)) for name in (RAY, LITE)}
    return {**parts, **{name: CombinedISM(list(parts.values()), **options) for name, options in WAYS.items()}}


def recorded(dataset: Dataset, numbers: Sequence[int]) -> dict[str, Any]:
    """Evaluate all methods on some frames; return their means, and `combined` against each part."""
    result = evaluate(methods(), dataset, SPEC, frames=numbers, draw=lambda *frame: {})
    return {
        "frames": len(result.frames),
        "drives": len({one.sequence or one.name for one in result.frames}),
        "means": {name: {m: run.finite(result.macro(name)[m]) for m in METRICS} for name in result.methods},
        "against": {other: against(result, other) for other in (RAY, LITE)},
    }


def against(result: Evaluation, other: str) -> dict[str, Any]:
    """Compare `combined` with a part."""
    found = result.compare(COMBINED, other)
    return {
        m: {
            "wins, ties, losses": [found[m].wins, found[m].ties, found[m].losses],
            "difference": [run.finite(x) for x in found[m].difference],
            "ratio": [run.finite(x) for x in found[m].ratio],
            "p": run.finite(found[m].p),
        }
        for m in METRICS
        if m in found
    }


def cost(scan: Scan, mount: Mount) -> dict[str, float]:
    """Return the least milliseconds of each model on a scan, and of what combining adds, measured in turns."""
    models: dict[str, Any] = {name: load_model(name, SPEC, mount) for name in (RAY, LITE, COMBINED)}
    masses = [models[name](scan).mass for name in (RAY, LITE)]
    models = {name: (lambda model=model: model(scan)) for name, model in models.items()}
    both = CombinedISM([load_model(name, SPEC, mount) for name in (RAY, LITE)], **COMBINATION)
    models |= {"combining alone": lambda: both.combine(masses), "copy of both grids": lambda: np.array(masses)}
    best = dict.fromkeys(models, float("inf"))
    for _ in range(CALLS):
        for name, call in models.items():
            start = time.perf_counter()
            call()
            best[name] = min(best[name], 1e3 * (time.perf_counter() - start))
    return best


def drives_of(words: str) -> set[int]:
    """Return the numbers that "1,3-5" stands for."""
    ends = [one.split("-") for one in words.split(",")]
    return {k for one in ends for k in range(int(one[0]), int(one[-1]) + 1)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="+", metavar="DATA=DRIVES")
    parser.add_argument("--real", type=Path, default=run.DATA, help="folder of real recordings (default OGM_DATA)")
    parser.add_argument("--quick", action="store_true", help="three frames of each; writes to the folder runs/")
    parser.add_argument("--out", type=Path, default=run.RESULTS / "combined.json")
    given = parser.parse_args()
    most = 3 if given.quick else None
    out = run.ROOT / "runs" / given.out.name if given.quick else given.out

    record: dict[str, Any] = {"environment": run.environment(), "validation": {}, "real": {}}
    record["parameters"] = {key: [one._asdict() for one in value] for key, value in COMBINATION.items()}
    for words in given.data:
        path, _, drives = words.rpartition("=")
        dataset = open_dataset(path, split="validation")
        wanted = {f"drive {k}" for k in drives_of(drives)}
        numbers = [k for k, ref in enumerate(dataset.refs) if ref.sequence in wanted][:most]
        record["validation"][Path(path).name] = {"drives": drives} | recorded(dataset, numbers)
        print(path, "is evaluated", file=sys.stderr, flush=True)
        record.setdefault("cost [ms]", cost(dataset[numbers[0]].scan, dataset[numbers[0]].mount))
    for one in real(given.real) if given.real.is_dir() else ():
        if one.alone is None:
            print(f"{one.name} is left out: {one.reason}", file=sys.stderr)
            continue
        record["real"][one.name] = recorded(one.alone, range(len(one.alone))[:most])
        print(one.name, "is evaluated", file=sys.stderr, flush=True)
    write(out, record)
    for place in (record["validation"], record["real"]):
        for name, found in place.items():
            print(f"{name}, {found['frames']} frames")
            for method, means in found["means"].items():
                print(f"  {method:22}" + "  ".join(f"{m} {means[m]:.3f}" for m in METRICS if means[m] is not None))
    print("cost [ms]:", ", ".join(f"{name} {value:.2f}" for name, value in record["cost [ms]"].items()))
    print(f"written {out}")


if __name__ == "__main__":
    main()
