"""Cells that the evaluated scan takes out of the aggregated truth of recordings: their effect on the scores.

    python benchmarks/truth_mask.py [--quick]

Where the evaluated scan shows the opposite of what the other scans of its drive agree on, something without a label has
come or gone, and the cell is ignored (`ogm.truth.scans.contradicted`). Here every frame of two KITTI drives is
evaluated with and without that rule: scans by the truth of all other scans, scans and maps by that of later ones. The
drives cannot be shipped: see benchmarks/README.md. Writes benchmarks/results/truth_mask.json.
"""

import _run as run  # first: it sets the number of threads

# isort: split
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from ogm import GridSpec
from ogm.datasets import open_dataset
from ogm.evaluation import FusedMethod, MethodRunner, SingleScanMethod
from ogm.metrics import accumulate, score
from ogm.state import CellState

SPEC = GridSpec.centered()
DRIVES = {"KITTI, drive 0005": "kitti_raw_0005", "KITTI, odometry 00": "kitti_odometry_00"}
MODELS, RULE = ("height-band", "ray", "lite", "combined"), "cautious"
KEPT = ("iou_free", "iou_occupied", "false_free", "missed_occupied", "brier")


@contextmanager
def without_mask() -> Iterator[None]:
    """Leave the rule out."""

    def nothing(truth: Any, *scan: Any) -> NDArray[np.bool_]:
        return np.zeros(truth.spec.shape, bool)

    with mock.patch("ogm.datasets.neighbours.contradicted", nothing):
        yield


def truths(place: str, others: str, masked: bool) -> list[NDArray[np.uint8]]:
    """Return the truth of every frame of a drive."""
    with nullcontext() if masked else without_mask():
        return [frame.truth.crop(SPEC).state for frame in open_dataset(run.DATA / place, others=others)]


def taken_out(masked: list[NDArray[np.uint8]], whole: list[NDArray[np.uint8]]) -> dict[str, float]:
    """Return the shares of free and of occupied cells that the rule takes out."""
    shares = {}
    for name, state in (("free", CellState.FREE), ("occupied", CellState.OCCUPIED)):
        lost = sum(np.count_nonzero((b == state) & (a != b)) for a, b in zip(masked, whole, strict=True))
        shares[name] = lost / max(sum(np.count_nonzero(b == state) for b in whole), 1)
    return shares


def compared(place: str, frames: int | None) -> dict[str, Any]:
    """Evaluate every frame of a drive by four truths."""
    kinds = {others: (truths(place, others, True), truths(place, others, False)) for others in ("all", "later")}
    scans = {name: SingleScanMethod.named(name, SPEC) for name in MODELS}
    maps = {f"{name} + {RULE}": FusedMethod.by_rule(name, one.model, RULE, SPEC) for name, one in scans.items()}
    runner = MethodRunner(scans | maps, SPEC)
    rows: dict[tuple[str, str], list[list[list[float]]]] = {}
    for k, frame in enumerate(open_dataset(run.DATA / place, others="later")[:frames]):
        runner.update(frame)
        for name, grid in runner.grids().items():
            for others, pair in kinds.items():
                if others == "later" or name in scans:
                    scores = [score(accumulate(grid.mass, truth[k])) for truth in pair]
                    values = [[one[metric] for metric in KEPT] for one in scores]
                    rows.setdefault((others, name), []).append(values)
    found: dict[str, Any] = {}
    for others, pair in kinds.items():
        means = {name: np.nanmean(values, axis=0) for (which, name), values in rows.items() if which == others}
        gain = {name: one[0] - one[1] for name, one in means.items()}
        spread = np.ptp(list(gain.values()), axis=0)
        found[others] = {
            "share that is taken out": taken_out(*pair),
            "means, with and without": {
                name: {metric: one[:, n].tolist() for n, metric in enumerate(KEPT)} for name, one in means.items()
            },
            "by how much differences between methods move, at most": dict(zip(KEPT, spread.tolist(), strict=True)),
        }
    return found


def main() -> None:
    given = run.Parser(__doc__, quick=True).parse_args()
    record: dict[str, Any] = {"environment": run.environment(*MODELS, RULE), "drives": {}}
    for name, place in DRIVES.items():
        if not (run.DATA / place).is_dir():
            print(f"{name} is left out: there is no {place}", file=sys.stderr)
            continue
        record["drives"][name] = compared(place, 3 if given.quick else None)
    run.write_record(given.out, record)


if __name__ == "__main__":
    main()
