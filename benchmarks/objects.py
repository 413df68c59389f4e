"""How much of annotated objects in real scans do the models show? Shares predicted occupied, and free, per object.

    python benchmarks/objects.py [--real FOLDER]

Objects are the boxes of the recordings of `quality` that have 50 returns or more in the scan (van Kempen et al. 2021,
Sec. IV-B) and lie in the grid as a whole. All cells of a box count, those of the side that no beam met too. Per box and
model: the share of its cells with a mass of occupied above 1/2, and the same of free. An object that is in several
scans of a recording (the same track) counts once, with the mean of them. Without a track, each box is an object.

No weights were chosen by these recordings; one rule of `DeepISM`, on intensities of another calibration, was added
after a look at KITTI's. There are too few for intervals over drives: numbers of objects and boxes stand beside the
means. Writes benchmarks/results/objects.json; docs/build.py makes a table of it.
"""

import _run as run  # first: it sets the number of threads
from _recordings import recordings

# isort: split
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm import GridSpec
from ogm.datasets import Dataset
from ogm.datasets.truth import ABOVE_BOTTOM
from ogm.evaluation import SingleScanMethod
from ogm.metrics.motion import KINDS, object_kinds
from ogm.scan import Boxes, run_model
from ogm.truth import cells_in_boxes
from ogm.truth.boxes import MIN_RETURNS, count_returns

SPEC = GridSpec.centered()
MODELS = ("height-band", "ray", "lite", "combined")
MAJORITY = 0.5  # of the mass
GROUPS = {
    "all": KINDS,
    "vehicles": ("vehicle",),
    "people and cyclists": ("pedestrian", "cyclist"),
    "others": ("other",),
}


def inside(boxes: Boxes) -> NDArray[np.bool_]:
    """Return a mask of the boxes that lie in the grid with all four corners."""
    half, c, s = boxes.size[:, :2] / 2, np.cos(boxes.yaw), np.sin(boxes.yaw)
    result = np.ones(len(boxes), bool)
    for u, v in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        x, y = u * half[:, 0], v * half[:, 1]
        result &= SPEC.contains(boxes.center[:, 0] + c * x - s * y, boxes.center[:, 1] + s * x + c * y)
    return result


def boxes_of(dataset: Dataset, methods: Mapping[str, SingleScanMethod]) -> Iterator[dict[str, Any]]:
    """Yield what the models make of each box."""
    for i, frame in enumerate(dataset):
        if frame.boxes is None:
            continue
        returns = count_returns(frame.scan.points, frame.boxes, above_bottom=ABOVE_BOTTOM)
        chosen = np.flatnonzero((returns >= MIN_RETURNS) & inside(frame.boxes))
        if not len(chosen):
            continue
        grids = {name: run_model(one.model, frame) for name, one in methods.items()}
        kinds = object_kinds(frame.boxes.label)
        for k in chosen:
            cells = cells_in_boxes(frame.boxes.select([k]), SPEC)
            track = frame.boxes.track[k]
            yield {
                "object": f"{frame.sequence} {track}" if track else f"frame {i} box {k}",
                "frame": i,
                "kind": KINDS[kinds[k]],
                "distance [m]": round(float(np.hypot(*frame.boxes.center[k, :2])), 1),
                "returns": int(returns[k]),
                "cells": int(cells.sum()),
                "shares": {
                    name: [float((mass[cells] > MAJORITY).mean()) for mass in (grid.occupied, grid.free)]
                    for name, grid in grids.items()
                },
            }


def means(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the means over objects, each with the mean of its boxes."""
    objects: dict[str, list[Any]] = {}
    for one in rows:
        objects.setdefault(one["object"], []).append(one)
    names = rows[0]["shares"]
    each = {
        name: np.array([np.mean([one["shares"][name] for one in same], axis=0) for same in objects.values()])
        for name in names
    }
    return {
        "objects": len(objects),
        "boxes": len(rows),
        "models": {
            name: dict(zip(("occupied", "free"), map(float, values.mean(axis=0)), strict=True))
            for name, values in each.items()
        },
    }


def main() -> None:
    given = run.Parser(__doc__, real=True).parse_args()
    methods = {name: SingleScanMethod.named(name, SPEC) for name in MODELS}
    record: dict[str, Any] = {"environment": run.environment(*MODELS), "sets": {}, "all": {}, "boxes": {}}
    every: list[dict[str, Any]] = []
    for name, frames in recordings(given.real):
        if rows := list(boxes_of(frames, methods)):
            record["sets"][name] = {"scans": len({row["frame"] for row in rows}), **means(rows)}
            record["boxes"][name] = rows
            every += [row | {"object": f"{name} {row['object']}"} for row in rows]
    if not every:
        raise SystemExit(f"there are no recordings with boxes in {given.real}: see benchmarks/README.md")
    for name, kinds in GROUPS.items():
        if rows := [row for row in every if row["kind"] in kinds]:
            record["all"][name] = means(rows)
    run.write_record(given.out, record)


if __name__ == "__main__":
    main()
