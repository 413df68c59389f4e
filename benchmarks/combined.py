"""Compare the combination of `ray` and `lite` with each, on simulated validation towns and on real recordings.

    python benchmarks/combined.py DATA=DRIVES [DATA=DRIVES ...] [--real FOLDER] [--quick]

DATA are data sets that `ogm simulate` made, DRIVES the numbers of the validation drives to evaluate ("1,3-5"), which
are those that the parameters (`ogm.models.named.COMBINATION`) were not fitted to. Compared are both parts, the
model `combined`, and for reference plain Dempster (reliability 1, no gates), and `combined` with the hits of `ray`
kept. Real recordings are those of `quality`, labelled cells only; nothing was chosen by them. Means over frames, and
`combined` against each part frame by frame, with 95 % intervals over drives; the network in 8-bit integers, its
default, and in bfloat16 where OpenVINO is installed, against float32. Cost: the best of many calls on one scan. Writes
benchmarks/results/combined.json; docs/build.py makes tables of it.
"""

import _run as run  # first: it sets the number of threads
from _evaluation_record import means_of, pair
from _recordings import recordings
from _timing import Contender, once

# isort: split
from collections.abc import Sequence
from importlib.util import find_spec
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
FLOAT = "float32"
PRECISIONS: dict[str, dict[str, Any]] = {"8-bit": {"precision": "int8"}, FLOAT: {"precision": FLOAT}}
if find_spec("openvino"):  # the default on processors with AMX
    PRECISIONS["bfloat16"] = {"engine": "openvino", "precision": "bfloat16"}
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


def networks(mount: Mount | None = None) -> dict[str, DeepISM]:
    """Return the network by precision; 8-bit integers are its default on most processors."""
    return {name: DeepISM.load(LITE, spec=SPEC, mount=mount, **options) for name, options in PRECISIONS.items()}


def methods() -> dict[str, InverseSensorModel]:
    """Return both parts and all ways to combine them, each scan mapped once by each part."""
    ray = Once(load_model(RAY, SPEC))
    lite, *others = (Once(network) for network in networks().values())
    found: dict[str, Any] = {RAY: ray, LITE: lite}
    found |= {name: CombinedISM([ray, lite], **options) for name, options in WAYS.items()}
    for name, network in zip(list(PRECISIONS)[1:], others, strict=True):
        found |= {f"{LITE}, {name}": network, f"{COMBINED}, {name}": CombinedISM([ray, network], **COMBINATION)}
    return found


def recorded(dataset: Dataset, numbers: Sequence[int]) -> dict[str, Any]:
    """Evaluate all methods on some frames; return their means, and `combined` against each part."""
    result = evaluate(methods(), dataset, SPEC, frames=numbers)
    found = {other: result.compare(COMBINED, other) for other in (RAY, LITE, f"{COMBINED}, {FLOAT}")}
    found[f"{LITE}, {FLOAT}"] = result.compare(LITE, f"{LITE}, {FLOAT}")
    against = {other: {m: pair(one[m]) for m in METRICS if m in one} for other, one in found.items()}
    return means_of(result, METRICS) | {"against": against} | of_precisions(dataset, numbers)


def of_precisions(dataset: Dataset, numbers: Sequence[int]) -> dict[str, dict[str, float]]:
    """Return how much the masses of the network in other precisions differ from those in float32."""
    models = networks()
    differences: dict[str, list[Any]] = {name: [] for name in models if name != FLOAT}
    states: dict[str, list[Any]] = {name: [] for name in differences}
    for k in numbers[:: -(-len(numbers) // COMPARED)]:
        grids = {name: run_model(model, dataset[k]) for name, model in models.items()}
        for name in differences:
            differences[name].append(np.abs(grids[name].mass - grids[FLOAT].mass).ravel())
            states[name].append(predict_state(grids[name].mass) != predict_state(grids[FLOAT].mass))
    found = {name: np.concatenate(parts) for name, parts in differences.items()}
    return {
        f"{name} masses": {
            "mean": float(one.mean()),
            "99.9th percentile": float(np.quantile(one, 0.999)),
            "largest": float(one.max()),
            "cells with another state": float(np.mean(states[name])),
        }
        for name, one in found.items()
    }


def cost(scan: Scan, mount: Mount) -> dict[str, float]:
    """Return the least milliseconds of each model on a scan, and of what combining adds, measured in turns."""
    ray, found = load_model(RAY, SPEC, mount), networks(mount)
    both = CombinedISM([ray, found["8-bit"]], **COMBINATION)
    models: dict[str, Any] = {RAY: ray, LITE: found.pop("8-bit"), COMBINED: both}
    models |= {f"{LITE}, {name}": network for name, network in found.items()}
    masses = [models[name](scan).mass for name in (RAY, LITE)]
    calls = {name: Contender(lambda _, model=model: model(scan)) for name, model in models.items()}
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
