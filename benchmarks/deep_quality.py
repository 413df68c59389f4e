"""How good is the shipped network? It and the geometric models on a town that none of them has seen.

    python benchmarks/deep_quality.py DATA [--split test] [--lite WEIGHTS] [--samples N]

DATA is the data set that `ogm simulate` made, whose test split is another town than that of training and
validation. Every frame is evaluated for every model, so that all comparisons are paired; intervals are of
95 %, over drives. Writes benchmarks/results/deep_quality.json and docs/pictures/deep_quality.png.

The models:

* height-band: `HeightBandISM`, the paper's baseline, with evidence 10 and without the ego vehicle's returns
  (the paper's text keeps them, and roof and mirrors then blind it);
* height-band-released: what the paper's code does, on its cells of 0.32 m. Each is repeated onto four cells of
  0.16 m, nothing is interpolated. Its evidence ends at 1, so that it predicts all cells unknown; its IoU on known
  cells, by P(occupied) alone, is the one to compare;
* ray: `RayISM`;
* lite: the weights in the package, or those given;
* combined: the default model, `ray` and the weights in the package.

All get the sensor's height and tilt, except height-band-released, whose mount is built in.
"""

import _run as run  # first: it sets the number of threads

# isort: split
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _charts import caption
from rich.progress import track
from scipy.ndimage import binary_opening

from ogm import GridSpec
from ogm.datasets import Dataset, open_dataset
from ogm.evaluation import Evaluation, SingleScanMethod, evaluate, evaluation_record
from ogm.evaluation.figures import draw_metrics
from ogm.evidence import evidence_to_mass
from ogm.fusion import resample_to
from ogm.metrics import ConfusionSums, accumulate, score
from ogm.models.named import COMBINED, short_names
from ogm.scan import run_model
from ogm.simulation.store import Store
from ogm.state import CellState, predict_state
from ogm.truth import cells_in_boxes
from ogm.truth.boxes import MIN_RETURNS

PAPER = GridSpec.centered()
MODELS = ("height-band", "height-band-released", "ray")
PER_FRAME = ("nll", "brier", "iou_free", "iou_occupied", "false_free", "kl_e10", "kl_e1", "kl_e1_scaled", "legacy_kl")
WEIGHTS = (1.0, 2.0, 5.0)  # of occupied cells
NOTE = (
    "Means over frames; those named micro are of all frames' cells together. Ignored cells are left out. A "
    "truth of evidence 1 punishes every model for being sure: a cell that is right with evidence 10 costs 0.89 nats, "
    "more than a vacuous one (0.31); kl_e1_scaled therefore takes a tenth of every model's evidence. Likewise "
    "P(occupied) of a cell with evidence 10 is 1/12 at best, which ece counts as an error and ece_relative does not."
)


def wanted(result: Evaluation, record: Mapping[str, Any], deep: str) -> list[dict[str, Any]]:
    """Return the figures of the network beside their limits."""
    mean = {name: result.macro(name) for name in result.methods}
    band, ray, own = (mean[name] for name in ("height-band", "ray", deep))
    pairs = record["paired"][f"{deep} against height-band"]
    least_bad = 1 - max(band["iou_free"], ray["iou_free"])
    limits = {"kl_e10": 0.4, "kl_e1": 0.4, "kl_e1_scaled": 0.4, "legacy_kl": 0.35}
    better = {name: own[name] / max(band[name], ray[name]) for name in ("iou_occupied", "iou_occupied_known")}
    rows = [
        ("kl_e10: share of frames won against height-band", pairs["kl_e10"]["wins"] / pairs["kl_e10"]["frames"], 1.0),
        *((f"{name}: ratio to height-band", own[name] / band[name], -limit) for name, limit in limits.items()),
        *((f"{name}: ratio to the better geometric model", ratio, 1.5) for name, ratio in better.items()),
        ("1 - iou_free: ratio to the better geometric model", (1 - own["iou_free"]) / least_bad, -0.6),
        ("auroc_unknown", own["auroc_unknown"], 0.95),
        ("ece", own["ece"], -0.03),
        ("ece_relative", own["ece_relative"], -0.03),
        ("false_free: ratio to height-band", own["false_free"] / band["false_free"], -0.5),
        ("false_free: ratio to ray", own["false_free"] / ray["false_free"], -0.5),
    ]  # a negative limit is an upper one
    return [
        {"what": what, "value": round(value, 4), "wanted": f"{sign} {abs(limit)}", "met": met}
        for what, value, limit in rows
        for sign, met in [(">=", value >= limit) if limit > 0 else ("<=", value <= -limit)]
    ]


def missed_by_kind(methods: Mapping[str, SingleScanMethod], dataset: Dataset, samples: Iterable[Any]) -> dict[str, Any]:
    """Split the truly occupied cells by what stands there, and count how each model predicts them.

    Participants are traffic participants of 50 returns and more; all else is thick where a square of three by three
    occupied cells fits, and thin (fences, poles, edges) where none does.
    """
    kinds = ("participants", "thick", "thin")
    counts = {name: np.zeros((len(kinds), 3)) for name in methods}  # cells, false free, predicted occupied
    for frame, sample in zip(dataset, samples, strict=True):
        occupied = frame.truth.crop(PAPER).state == CellState.OCCUPIED
        there = cells_in_boxes(frame.boxes.select(sample.objects["returns"] >= MIN_RETURNS), PAPER)
        thick = binary_opening(occupied, np.ones((3, 3)))
        for name, method in methods.items():
            grid = resample_to(run_model(method.model, frame), PAPER)
            predicted = predict_state(grid.mass) == CellState.OCCUPIED
            for row, kind in enumerate((there, ~there & thick, ~there & ~thick)):
                cells = occupied & kind
                counts[name][row] += cells.sum(), (grid.free[cells] > 0.5).sum(), predicted[cells].sum()
    return {
        name: {
            kind: {"cells": int(cells), "false free": free / cells, "called occupied": found / cells}
            for kind, (cells, free, found) in zip(kinds, table, strict=True)
        }
        for name, table in counts.items()
    }


def weighed(method: SingleScanMethod, dataset: Dataset) -> dict[str, dict[str, float]]:
    """Score a network, pooled, as if occupied cells had weighed more in its training: in closed form, afterwards."""
    pooled: dict[float, ConfusionSums] = {}
    for frame in dataset:
        evidence = torch.from_numpy(run_model(method.model, frame).evidence)
        for weight in WEIGHTS:
            mass = evidence_to_mass(reweighted(evidence, weight).numpy())
            sums = accumulate(mass, frame.truth.crop(PAPER).state)
            pooled[weight] = pooled[weight].plus(sums) if weight in pooled else sums
    shown = ("nll", "iou_free", "iou_occupied", "ece_relative", "false_free")
    return {f"{weight:g}": {name: score(sums)[name] for name in shown} for weight, sums in pooled.items()}


def reweighted(evidence: torch.Tensor, occupied: float, strength: float = 10.0) -> torch.Tensor:
    """Return the evidence at the optimum of `reverse_kl` if occupied cells had had a weight; see docs/deep.md."""
    known = evidence.sum(-1, keepdim=True)
    total = known.clamp(min=strength)
    share = evidence / evidence.new_tensor([1.0, 1 / occupied])
    return total * share / (share.sum(-1, keepdim=True) + total - known)


def main() -> None:
    parser = run.Parser(__doc__, picture=True)
    parser.add_argument("data", type=Path, help="data set that `ogm simulate` made")
    parser.add_argument("--split", default="test", help="part of it (default test, for the final figure only)")
    parser.add_argument("--lite", default="lite", help="weights instead of the shipped ones: a file or a run")
    parser.add_argument("--samples", type=int, help="evaluate the first N only")
    options = parser.parse_args()

    names = short_names([*MODELS, options.lite, COMBINED])
    deep = list(names)[-2]
    record = run.environment(*MODELS, COMBINED, **{deep: options.lite})
    dataset = open_dataset(options.data, split=options.split)[: options.samples]
    part = Store.open(options.data)[dataset.facts["split"]]
    samples = [part[k] for k in dataset.facts["samples"][: options.samples]]
    methods = {short: SingleScanMethod.named(name, PAPER) for short, name in names.items()}
    result = evaluate(methods, dataset, PAPER, progress=lambda numbers: track(numbers, "evaluating"))
    found = evaluation_record(result)
    found["models"] = found.pop("methods")
    for one in found["models"].values():
        one["per frame"] = {name: one["per frame"][name] for name in PER_FRAME}
    facts = {key: dataset.facts[key] for key in ("plan", "versions", "split", "towns")}
    record |= {
        "data": {**facts, "frames": len(dataset), "drives": [frame.sequence for frame in result.frames]},
        "note": NOTE,
        "wanted": wanted(result, found, deep),
        "occupied cells by what stands there, pooled": missed_by_kind(methods, dataset, samples),
    }
    left = ("format", "versions", "data", "frames")
    record |= {key: value for key, value in found.items() if key not in left}
    print(result)
    others = open_dataset(options.data, split="validation")[::15]  # a choice that the test part must not be used for
    record["occupied cells weighed more, 20 validation frames, pooled"] = weighed(methods[deep], others)
    run.write_record(options.out, record)
    title = f"{options.split}, {record['extent']}: quartiles and 5 to 95 % over frames; dot and number: mean"
    draw_metrics(options.picture, result, title, note=caption(record))


if __name__ == "__main__":
    main()
