"""What a dynamic map knows of motion: cells that move, their velocities, predictions, against Nuss' filter.

    python benchmarks/dynamic.py DRIVES [--ism ray combined] [--first N] [--out FILE]
    python benchmarks/dynamic.py --kitti [FOLDER] [--out FILE]

DRIVES holds drives of 10 s at 10 Hz that `ogm simulate --sequences N` made; FOLDER is KITTI raw drive 0005, by default
that of OGM_DATA, with all of its 64 layers, 32 and 16 of them. All maps fuse the grids of the same sensor model, on the
same cells. Intervals are 95 % intervals over drives. Writes benchmarks/results/dynamic.json and
docs/pictures/dynamic.png.

Definitions, see `ogm.metrics.MOTION_METRICS`, `PREDICTION_METRICS` and `fusion_quality.py`:

* cells: those that the scan shows as occupied (> 1/2), from the tenth scan of a drive on; on KITTI within 35 m and the
  view in which objects are labelled. Moving is what is faster than 1 m/s in truth, static what is slower than 0.3 m/s;
* predicted moving: a score, belief in dynamic times min(speed, 2 m/s), above 0.6 m/s. Nuss' filter has no belief in
  static: there it is a velocity above 1 m/s and more than two standard deviations from 0, and for average precision
  and predictions belief in dynamic is 1 - exp(-m²/2), m being the number of standard deviations, which gives it twice
  the average precision of the speed alone (also in the tables);
* time to detect: from the first occupied cell of an object faster than 1 m/s until half of its occupied cells are
  predicted moving; the median over the objects of all drives;
* predictions, twice a second: recall and precision of the cells of moving objects, with one cell of tolerance.
  "Standing still" is the hybrid's own map, unchanged;
* static IoU, ghosts: as in fusion_quality.py.
"""

import _run as run  # first: it sets the number of threads

# isort: split
import sys
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from _charts import caption
from _dynamic_drives import HORIZONS, DriveSums, Recorder, over_drive, snapshots, with_layers
from _dynamic_filters import CONFLICT, FILTERS, HYBRID, PLAIN, READINGS, STANDING, Reading
from _dynamic_pictures import draw
from _dynamic_targets import targets
from _fusion_drives import PAPER, read_drive, trails
from fusion_quality import evaluate_map

from ogm.datasets import open_dataset
from ogm.evaluation import mean_interval
from ogm.fusion import map_scans
from ogm.metrics import MotionSums, PredictionSums, motion_curve, score_motion, score_prediction
from ogm.models import load_model

WITHOUT_VELOCITY = ("motion_ap", "motion_iou", "motion_precision", "motion_recall", "static_moving")
WITHIN = 35.0  # [m] of KITTI's cells that are evaluated
Results = dict[str, list[tuple[DriveSums, dict[str, float]]]]  # by map: of every drive


def simulated(path: Path, ism: str, first: int | None, maps: Mapping[str, Callable[[], Any]]) -> Results:
    """Run all maps over simulated drives, also with the scores of `fusion_quality`."""
    dataset = open_dataset(path, split="sequences")
    model, found = load_model(ism, PAPER), {}
    sequences = list(dataset.sequences.items())[:first]
    for name, numbers in sequences:
        drive = read_drive(dataset.select(numbers))
        grids = [grid for _, grid in map_scans(drive.frames, model)]
        left = list(trails(drive, [grid.mass for grid in grids]))
        truth = snapshots(drive.frames, drive.poses, grids)
        for method, make in maps.items():
            print(f"{ism}: {name} of {len(sequences)}, {method}", file=sys.stderr, flush=True)
            recorder = Recorder(make(), truth, READINGS.get(method, {method: Reading()}))
            scores, _ = evaluate_map(drive, recorder, grids, left)
            for reading, sums in recorder.results().items():
                found.setdefault(reading, []).append((sums, scores))
    return found


def kitti(path: Path, ism: str, share: int, maps: Mapping[str, Callable[[], Any]]) -> Results:
    """Run all maps over the recorded drive, with a share of its layers."""
    frames = list(with_layers(list(open_dataset(path)), share))
    model = load_model(ism, PAPER)
    poses = np.array([frame.T_map_sensor @ frame.mount.T_sensor_level for frame in frames])
    grids = [grid for _, grid in map_scans(frames, model)]
    truth = snapshots(frames, poses, grids, WITHIN)
    found: Results = {}
    for method, make in maps.items():
        print(f"KITTI, {ism}, 1 of {share} layers, {method}", file=sys.stderr, flush=True)
        sums = over_drive(make(), truth, grids, READINGS.get(method, {method: Reading()}))
        found |= {reading: [(one, {})] for reading, one in sums.items()}
    return found


def scores_of(
    motion: MotionSums, detections: Sequence[Any], predicted: Mapping[float, PredictionSums]
) -> dict[str, float]:
    """Return all scores of some sums by name; those of predictions end in their horizon."""
    times = [one.seconds for one in detections]
    started = [one.seconds for one in detections if one.from_rest]
    found = score_motion(motion)
    found["time_to_detect"] = float(np.median(times)) if times else float("nan")
    found["time_from_rest"] = float(np.median(started)) if started else float("nan")
    found["never_detected"] = float(np.mean(np.isinf(times))) if times else float("nan")
    for horizon, sums in predicted.items():
        found |= {f"{name}_{horizon:g}": value for name, value in score_prediction(sums).items()}
    return found


def summarize(results: Results) -> dict[str, dict[str, Any]]:
    """Return by map: every score of all drives together, of each drive, and its mean with the interval."""
    rows = dict(results)
    ours = next((name for name in (HYBRID, PLAIN) if name in rows), None)
    if ours:
        rows[STANDING] = [(one._replace(predicted=one.standing), {}) for one, _ in rows[ours]]
    record = {}
    for name, drives in rows.items():
        each = [{**scores_of(one.motion, one.detections, one.predicted), **scores} for one, scores in drives]
        motion, predicted = MotionSums.zeros(), {h: PredictionSums.zeros() for h in HORIZONS}
        for one, _ in drives:
            motion = motion.plus(one.motion)
            predicted = {h: predicted[h].plus(one.predicted[h]) for h in HORIZONS}
        pooled = scores_of(motion, [d for one, _ in drives for d in one.detections], predicted)
        columns = {key: np.array([row[key] for row in each]) for key in each[0]}
        finite = {key: np.where(np.isfinite(column), column, np.nan) for key, column in columns.items()}
        recall, precision, _ = motion_curve(motion)
        thin = np.linspace(0, len(recall) - 1, min(len(recall), 150)).astype(int)
        kept = {STANDING: tuple(f"_{h:g}" for h in HORIZONS), CONFLICT: WITHOUT_VELOCITY}.get(name)
        columns = {key: column for key, column in columns.items() if kept is None or key.endswith(kept)}
        record[name] = {
            "pooled": {key: value for key, value in pooled.items() if key in columns},
            "drives": columns,
            "mean and 95 % interval": {key: tuple(mean_interval(finite[key])) for key in columns},
            "curve": {"recall": recall[thin], "precision": precision[thin]},
            "moving cells": motion.cells[0, 0],
            "static cells": motion.cells[-1, 0],
            "objects": sum(len(one.detections) for one, _ in drives),
        }
    return record


def main() -> None:
    parser = run.Parser(__doc__, picture=True)
    parser.add_argument("drives", type=Path, nargs="?")
    parser.add_argument("--kitti", type=Path, nargs="?", const=run.DATA / "kitti_raw_0005")
    parser.add_argument("--ism", nargs="+", default=["ray", "combined"])
    parser.add_argument("--layers", nargs="+", type=int, default=[64, 32, 16], help="of KITTI's 64")
    parser.add_argument("--maps", nargs="+", choices=list(FILTERS), default=list(FILTERS))
    parser.add_argument("--first", type=int, help="take the first N drives")
    given = parser.parse_args()
    if not given.drives and not given.kitti:
        parser.error("give DRIVES, --kitti, or both")
    maps = {name: FILTERS[name] for name in given.maps}
    runs: dict[str, dict[str, Any]] = {}
    for ism in given.ism if given.drives else ():
        runs[ism] = summarize(simulated(given.drives, ism, given.first, maps))
    for n, ism in product(given.layers, given.ism) if given.kitti else ():
        runs[f"KITTI, {n} layers, {ism}"] = summarize(kitti(given.kitti, ism, 64 // n, maps))
    environment = run.environment(*given.ism, "dynamic", "cautious", "bayes")
    record: dict[str, Any] = {"environment": environment, "definitions": __doc__}
    record |= {"drives": open_dataset(given.drives, split="sequences").facts if given.drives else None}
    run.write_record(given.out, record | {"runs": runs, "targets": targets(runs)})
    draw(given.picture, runs, caption(record["environment"]))


if __name__ == "__main__":
    main()
