"""How well do maps of buildings predict laser beams that are not in them? ogm beside OctoMap and a log-odds grid.

    python benchmarks/beams.py [--logs FOLDER] [--only NAME] [--quick]

FOLDER holds CARMEN logs of planar lasers with corrected poses (*.log.gz), by default carmen_2d in the folder of
recordings. All maps have cells of 0.05 m and the same scans and poses; each predicts the beams of the same scans that
are left out (`ogm.evaluation.evaluate_beams`). OctoMap maps all points at one height, with its own defaults; the
log-odds grid has OctoMap's two probabilities, and no limits. Intervals are over four parts of a log. Parameters of ogm
are defaults, and none was chosen on these logs. Writes benchmarks/results/beams.json.
"""

import _run as run  # first: it sets the number of threads

# isort: split
from pathlib import Path
from typing import Any

import numpy as np
from _beam_maps import LogOddsGrid, OctoMapPlane

from ogm import GridSpec
from ogm.datasets import open_dataset
from ogm.evaluation import BEAM_METRICS, compare_paired, evaluate_beams, named_maps
from ogm.evidence.map_rules import REVISE, SMOOTH

RESOLUTION = 0.05  # [m]
OURS, LOG_ODDS, OCTOMAP = f"planar, {SMOOTH}", "log-odds grid", "OctoMap"
MAX_ECE = 0.05


def evaluate_log(path: Path, first: int | None) -> dict[str, Any]:
    """Return the metrics of all maps of a log, and ogm's log likelihood against that of the others, scan by scan."""
    dataset = open_dataset(path)[:first]
    methods = named_maps(["planar"], [SMOOTH, REVISE], GridSpec.centered(resolution=RESOLUTION))
    result = evaluate_beams(dataset, {**methods, LOG_ODDS: LogOddsGrid(RESOLUTION), OCTOMAP: OctoMapPlane(RESOLUTION)})
    mean = {name: result.sums[name]["log_likelihood"] / np.maximum(result.echoes, 1) for name in result.methods}
    paired = {name: compare_paired(mean[OURS], mean[name], "higher", result.drives) for name in (LOG_ODDS, OCTOMAP)}
    for name in result.methods:
        print(path.name, name, {metric: round(result.interval(name, metric).value, 4) for metric in BEAM_METRICS})
    return {**result.record(), "log likelihood of ogm against": paired}


def verdicts(logs: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """Return what ogm's map reaches on each log, next to what it has to."""
    rows: list[tuple[str, float, str, float, str]] = []
    for name, record in logs.items():
        methods = record["methods"]
        for peer in (LOG_ODDS, OCTOMAP):
            ours, theirs = (methods[one]["log_likelihood"].value for one in (OURS, peer))
            rows.append((f"{name}: log likelihood, {peer}'s {theirs:.3f}", ours, ">=", theirs, "nats"))
            ours, theirs = (methods[one]["passes_through"].value for one in (OURS, peer))
            rows.append((f"{name}: beams through occupied cells, of {peer}'s", ours / theirs, "<=", 0.5, "x"))
        rows.append((f"{name}: ece of hits", methods[OURS]["ece"].value, "<=", MAX_ECE, ""))
    return run.verdicts(rows)


def main() -> None:
    parser = run.Parser(__doc__, quick=True)
    parser.add_argument("--logs", type=Path, default=run.DATA / "carmen_2d", help="folder of CARMEN logs")
    parser.add_argument("--only", help="logs whose name has this part")
    options = parser.parse_args()
    paths = [path for path in sorted(options.logs.glob("*.log.gz")) if (options.only or "") in path.name]
    if not paths:
        raise SystemExit(f"no *.log.gz in {options.logs}: give --logs FOLDER")
    record = run.environment("planar", SMOOTH)
    record["resolution [m]"] = RESOLUTION
    record["logs"] = {path.name.split(".")[0]: evaluate_log(path, 60 if options.quick else None) for path in paths}
    record["verdicts"] = verdicts(record["logs"])
    run.write_record(options.out, record)


if __name__ == "__main__":
    main()
