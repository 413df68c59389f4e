"""What do the generations of the shipped network reach? And what is still predicted wrong, by what is there.

    python benchmarks/generations.py DATA [DATA ...] [--new NAME=WEIGHTS ...] [--first N]

Evaluated are the validation frames of data sets that `ogm simulate` made; kerbs are left out. The weights of the
first and the second generation come from the history of this repository. `ray` and the default model are beside them.
Occupied cells are also counted by what is there, and by whether the scan has a return in the cell or next to it,
between 0.1 and 2 m above the ground: cells without one can only be guessed. Writes benchmarks/results/generations.json
and a picture of the worst frames of the last data set.
"""

import _run as run  # first: it sets the number of threads
from _evaluation_record import compared

# isort: split
import subprocess
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from deep_training import METRICS
from numpy.typing import NDArray
from quality import draw_some
from scipy.ndimage import binary_dilation

from ogm import Frame, GridSpec
from ogm.datasets import Dataset, open_dataset
from ogm.evaluation import Evaluation, SingleScanMethod, evaluate
from ogm.evaluation.figures import draw_frames, frame_panels
from ogm.metrics.motion import KINDS, object_kinds
from ogm.pose import transform_points
from ogm.scan import run_model
from ogm.state import CellState, predict_state
from ogm.truth import cells_in_boxes
from ogm.truth.boxes import MIN_RETURNS, count_returns

SPEC = GridSpec.centered()
HISTORY = {"first": "f76b9628", "second": "be532603"}  # commits with the weights of a generation
DRAWN, WORST = ("second", "lite", "combined"), 3  # methods in the picture, and frames of as many drives
NAMES = ("vehicles", "people and cyclists", "else, with a return", "else, without a return")
HEIGHTS = (0.1, 2.0)  # [m] of the returns


def earlier(folder: Path) -> dict[str, str]:
    """Write the weights of earlier generations to a folder, and return their files by name."""
    for name, commit in HISTORY.items():
        for end in ("safetensors", "json"):
            path = f"{commit}:ogm/data/lite.{end}"
            (folder / f"{name}.{end}").write_bytes(subprocess.check_output(["git", "show", path], cwd=run.ROOT))
    return {name: str(folder / f"{name}.safetensors") for name in HISTORY}


def kinds_of(frame: Frame) -> list[NDArray[np.bool_]]:
    """Return the truly occupied cells of each of `NAMES`."""
    truth = frame.truth.crop(SPEC)  # type: ignore[union-attr]
    occupied = truth.state == CellState.OCCUPIED
    x, y, z = transform_points(frame.mount.T_vehicle_sensor, frame.scan.points[:, :3]).T
    upright = SPEC.contains(*frame.scan.points[:, :2].T) & (z > HEIGHTS[0]) & (z < HEIGHTS[1])
    hit = np.zeros(SPEC.shape, bool)
    hit[SPEC.index(*frame.scan.points[upright, :2].T)] = True
    boxes = frame.boxes.select(count_returns(frame.scan.points, frame.boxes) >= MIN_RETURNS)  # type: ignore[union-attr]
    kind, inside = object_kinds(boxes.label), []
    for names in (("vehicle",), ("pedestrian", "cyclist")):
        inside.append(cells_in_boxes(boxes.select(np.isin(kind, [KINDS.index(name) for name in names])), SPEC))
    other, near = occupied & ~(inside[0] | inside[1]), binary_dilation(hit, np.ones((3, 3)))
    return [occupied & inside[0], occupied & inside[1], other & near, other & ~near]


def by_kind(dataset: Dataset, methods: Mapping[str, SingleScanMethod]) -> dict[str, Any]:
    """Return the number of occupied cells of each kind, and the shares predicted free and occupied."""
    counts, cells = {name: np.zeros((len(NAMES), 3)) for name in methods}, np.zeros(len(NAMES))
    for frame in dataset:
        kinds = kinds_of(frame)
        cells += [kind.sum() for kind in kinds]
        for name, method in methods.items():
            state = predict_state(run_model(method.model, frame).mass)
            counts[name] += [np.bincount(state[kind], minlength=3)[:3] for kind in kinds]
    shares = {name: table / np.maximum(cells, 1)[:, None] for name, table in counts.items()}
    return {
        kind: {"share": cells[k] / cells.sum()}
        | {name: {"free": table[k, 1], "occupied": table[k, 2]} for name, table in shares.items()}
        for k, kind in enumerate(NAMES)
    }


def draw_worst(path: Path, result: Evaluation, name: str) -> None:
    """Draw the frames of greatest log loss of a method, one of a drive, with its grid and the default model's."""
    order = np.argsort(-np.nan_to_num(result.of(name, "nll")), kind="stable").tolist()
    first = dict(reversed([(result.frames[k].sequence, k) for k in order]))  # the last entry stays: the worst
    few = result.select(DRAWN)
    rows = [
        (result.frames[k].name, frame_panels(result.pictures(k), few, k))
        for k in sorted(first.values(), key=order.index)[:WORST]
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    draw_frames(path, rows, f"Worst frames of {name} in simulated validation towns")


def main() -> None:
    parser = run.Parser(__doc__, picture=True)
    parser.add_argument("data", nargs="+", type=Path)
    parser.add_argument("--new", nargs="*", default=[], metavar="NAME=WEIGHTS", help="further weights")
    parser.add_argument("--first", type=int, help="evaluate the first N frames")
    given = parser.parse_args()
    with TemporaryDirectory() as folder:
        weights = {"ray": "ray", **earlier(Path(folder)), "lite": "lite", "combined": "combined"}
        weights |= dict(words.split("=", 1) for words in given.new)
        record: dict[str, Any] = {"environment": run.environment("ray", "lite", "combined"), "data": {}}
        for path in given.data:
            dataset = open_dataset(path, split="validation", kerbs="ignore")[: given.first]
            methods = {name: SingleScanMethod.named(model, SPEC) for name, model in weights.items()}
            draw = partial(draw_some, [list(methods).index(one) for one in DRAWN])
            result = evaluate(methods, dataset, SPEC, out=Path(folder) / path.name, draw=draw)
            scores = compared(result, "lite", METRICS)
            record["data"][path.name] = scores | {"occupied cells": by_kind(dataset, methods)}
            draw_worst(given.picture, result, "combined")
    run.write_record(given.out, record)


if __name__ == "__main__":
    main()
