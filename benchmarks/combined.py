"""Compare the combination of `ray` and `lite` with each, on simulated validation towns and on real recordings.

    python benchmarks/combined.py DATA=DRIVES [DATA=DRIVES ...] [--real FOLDER] [--quick]

DATA are data sets that `ogm simulate` made, DRIVES the numbers of the validation drives to evaluate ("1,3-5"), which
are those that the parameters (`ogm.models.named.COMBINATION`) were not fitted to. Compared are both parts, the
model `combined`, and for reference plain Dempster (reliability 1, no gates), and `combined` with the hits of `ray`
kept. Real recordings are those of `quality`, labelled cells only; nothing was chosen by them. Means over frames, and
`combined` against each part frame by frame, with 95 % intervals over drives; the network in 8-bit integers, its
default, against float32. Cost: the best of many calls on one scan. Writes benchmarks/results/combined.json;
docs/build.py makes tables of it.
"""

import _run as run  # first: it sets the number of threads
from _evaluation_record import means_of, pair
from _recordings import recordings
from _timing import Contender, once

# isort: split
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ogm import EvidentialGrid, GridSpec, Mount, Scan
from ogm.datasets import Dataset, open_dataset
from ogm.deep import DeepISM
from ogm.evaluation import evaluate
from ogm.models.combined import CombinedISM
from ogm.models.named import COMBINATION, COMBINED, LITE, RAY, load_model
from ogm.scan import InverseSensorModel, run_model
from ogm.state import predict_state

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
FLOAT = {LITE: "lite, float32", COMBINED: "combined, float32"}  # of the default network, in 8-bit integers
CALLS = 40
COMPARED = 12  # frames of each dataset whose masses are compared


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
    ways = {name: CombinedISM(list(parts.values()), **options) for name, options in WAYS.items()}
    exact = Once(DeepISM.load(LITE, spec=SPEC, precision="float32"))
    return {
        **parts, **ways, FLOAT[LITE]: exact, FLOAT[COMBINED]: CombinedISM([parts[RAY], exact], **COMBINATION)
    }  # fmt: skip


def recorded(dataset: Dataset, numbers: Sequence[int]) -> dict[str, Any]:
    """Evaluate all methods on some frames; return their means, and `combined` against each part."""
    result = evaluate(methods(), dataset, SPEC, frames=numbers)
    found = {other: result.compare(COMBINED, other) for other in (RAY, LITE, FLOAT[COMBINED])}
    found[FLOAT[LITE]] = result.compare(LITE, FLOAT[LITE])
    against = {other: {m: pair(one[m]) for m in METRICS if m in one} for other, one in found.items()}
    return means_of(result, METRICS) | {"against": against, "8-bit masses": of_integers(dataset, numbers)}


def of_integers(dataset: Dataset, numbers: Sequence[int]) -> dict[str, float]:
    """Return how much the masses of the network in 8-bit integers differ from those in float32."""
    models = [DeepISM.load(LITE, spec=SPEC, precision=precision) for precision in ("int8", "float32")]
    differences, states = [], []
    for k in numbers[:: -(-len(numbers) // COMPARED)]:
        small, exact = (run_model(model, dataset[k]) for model in models)
        differences.append(np.abs(small.mass - exact.mass).ravel())
        states.append(predict_state(small.mass) != predict_state(exact.mass))
    found = np.concatenate(differences)
    return {
        "mean": float(found.mean()),
        "99.9th percentile": float(np.quantile(found, 0.999)),
        "largest": float(found.max()),
        "cells with another state": float(np.mean(states)),
    }


def cost(scan: Scan, mount: Mount) -> dict[str, float]:
    """Return the least milliseconds of each model on a scan, and of what combining adds, measured in turns."""
    models: dict[str, Any] = {name: load_model(name, SPEC, mount) for name in (RAY, LITE, COMBINED)}
    masses = [models[name](scan).mass for name in (RAY, LITE)]
    models[FLOAT[LITE]] = DeepISM.load(LITE, spec=SPEC, mount=mount, precision="float32")
    calls = {name: Contender(lambda _, model=model: model(scan)) for name, model in models.items()}
    both = CombinedISM([load_model(name, SPEC, mount) for name in (RAY, LITE)], **COMBINATION)
    calls["combining alone"] = Contender(lambda _: both.combine(masses))
    calls["copy of both grids"] = Contender(lambda _: np.array(masses))
    rounds = [{name: once(call)[0] for name, call in calls.items()} for _ in range(CALLS)]
    return {name: 1e3 * min(seconds[name] for seconds in rounds) for name in calls}


def validation_frames(words: str) -> tuple[Dataset, str, list[int]]:
    """Return the data set, the drives and the numbers of the validation frames that "DATA=1,3-5" stands for."""
    path, _, drives = words.rpartition("=")
    dataset, ranges = open_dataset(path, split="validation"), [part.split("-") for part in drives.split(",")]
    wanted = {f"drive {k}" for ends in ranges for k in range(int(ends[0]), int(ends[-1]) + 1)}
    return dataset, drives, [k for k, ref in enumerate(dataset.refs) if ref.sequence in wanted]


def main() -> None:
    parser = run.Parser(__doc__, quick=True, real=True)
    parser.add_argument("data", nargs="+", metavar="DATA=DRIVES")
    given = parser.parse_args()
    most = 3 if given.quick else None
    record: dict[str, Any] = {"environment": run.environment(RAY, LITE, COMBINED), "validation": {}, "real": {}}
    record["parameters"] = {key: [one._asdict() for one in value] for key, value in COMBINATION.items()}
    for words in given.data:
        dataset, drives, numbers = validation_frames(words)
        name = Path(words.rpartition("=")[0]).name
        record["validation"][name] = {"drives": drives} | recorded(dataset, numbers[:most])
        record.setdefault("cost [ms]", cost(dataset[numbers[0]].scan, dataset[numbers[0]].mount))
    for name, frames in recordings(given.real):
        record["real"][name] = recorded(frames, range(len(frames))[:most])
    run.write_record(given.out, record)


if __name__ == "__main__":
    main()
