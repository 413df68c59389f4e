"""What fusing over time gives, by which rule, and against the classical Bayes filter.

    python benchmarks/fusion_quality.py --dev DIR [--data DIR] [--quick] [--keep]

Both folders hold drives of 10 s at 10 Hz that `ogm simulate --sequences N` made, DATA in other towns than DEV. All
rules run on DEV with several parameters; each rule's parameter is chosen there (least ghost area at the static
accuracy of the classical filter), and what was chosen is measured once on DATA (without it, on DEV again). Intervals
are 95 % bootstrap intervals over drives: the frames of a drive are not independent. Writes
benchmarks/results/fusion_quality.json, docs/pictures/fusion_quality.png and fusion_quality_moment.png.

Definitions, see `_sequences` and `_trails`:

* static: cells whose truth, over all frames of the drive and without whoever ever moves, is free (occupied in at most
  a tenth of the frames that see it) or occupied (in half of them and more); in the view of the frame, visible from
  some frame so far, and nobody moved there within 5 s. A cell is called by P(occupied) = occupied + unknown / 2;
* ghosts: cells that a moving (> 1 m/s), seen (10 returns and more) participant covered up to 5 s ago, that nobody
  covers or touches now, and that are static and free with all eight neighbours. Shares are of the cells in
  which a scan had said occupied while they were covered; areas are of all of them, per moving participant;
* clearing: time from leaving until P < 1/2 (until free > 1/2), by Kaplan and Meier, as cells are covered again or
  leave the view;
* appearing: time from the first scan that says occupied in a cell that a moving participant covers until P > 1/2;
* conflict: positive are cells that a moving, seen participant covers and did not 0.5 s ago (front) and
  those that it left within 0.5 s (back); cells that touch these are left out, and so is whoever moves unseen.
"""

from _run import PICTURES, RESULTS, caption, environment, write_json

# isort: split
import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _fusion_extras import (
    conflict_kinds,
    conflict_report,
    lost_by_cells,
    same_filter,
    unknown_report,
    what_half_means,
)
from _fusion_methods import BASELINE, DEFAULT, FAMILIES, PLAIN, SCAN, SLOW, chosen, make, named
from _fusion_pictures import AHEAD, curves, gallery
from _sequences import EGO_FOOTPRINT, PAPER, Drive, drives, read_drive, trails
from _trails import (
    WINDOW,
    Counts,
    completeness,
    conflict_scores,
    run_evaluation,
    quantile_of,
    summary,
    survival,
)
from numpy.typing import NDArray

from ogm import EvidentialGrid
from ogm.fusion import BinaryBayesMapper, EvidentialMapper, warp
from ogm.geometric import RayISM
from ogm.metrics import bootstrap_mean, bootstrap_ratio
from ogm.simulation.store import Split, Store

SEED = 0
TABLE = {  # what the main table shows, and in how many digits
    "static_iou_occupied": ("IoU occupied, static", 3),
    "static_false_free": ("static occupied, P < 1/4", 3),
    "static_brier": ("Brier, static", 3),
    "static_known": ("static known rightly", 3),
    "ghost_area": ("ghost area [m²]", 2),
    "ghost_share": ("ghosts 0.5-5 s", 4),
    "clear_90": ("90 % cleared [s]", 1),
    "appear_first": ("appears at once", 2),
    "body_recall": ("moving cells occupied", 2),
    "view_iou_occupied_known": ("IoU occupied, frame", 3),
    "view_iou_free_known": ("IoU free, frame", 3),
    "view_ece": ("ECE, frame", 3),
}
COMPARED = (
    *TABLE,
    "ghost_1s",
    "ghost_hidden",
    "ghost_unmeasured",
    "ghost_measured",
    "view_brier",
    "view_false_free",
)
DRAWN = (
    SCAN,
    "Bayes, pignistic",
    "Dempster",
    "Yager",
    "cumulative",
    "cautious",
    "cautious, what came leaves",
)
Method = tuple[str, float]


def say(words: str) -> None:
    """Report progress."""
    print(words, file=sys.stderr, flush=True)


def scans_of(drive: Drive, ism: Any) -> list[NDArray[np.float32]]:
    """Return the measurement grids of a drive."""
    return [ism(one).mass for one in drive.points]


def ray(drive: Drive) -> RayISM:
    """Return the geometric model for the sensor of a drive."""
    return RayISM(PAPER, sensor_height=drive.height, ego_footprint=EGO_FOOTPRINT)


def lite(drive: Drive) -> Any:
    """Return the shipped network for the sensor of a drive."""
    from ogm.deep import DeepISM

    return DeepISM.load("lite", spec=PAPER, sensor_height=drive.height, ego_footprint=EGO_FOOTPRINT)


def run(
    drive: Drive, scans: Sequence[NDArray[np.float32]], methods: Sequence[Method]
) -> dict[Method, Counts]:
    """Run maps over a drive."""
    left = list(trails(drive, scans))
    return {(family, p): run_evaluation(drive, make(family, p), scans, left) for family, p in methods}


def read(part: Split, numbers: Sequence[int], what: str) -> Iterator[Drive]:
    """Read drives one after the other and say so."""
    for n, number in enumerate(numbers):
        say(f"{what}: drive {n + 1} of {len(numbers)}")
        yield read_drive(part, number)


def tabulated(counts: dict[Method, list[Counts]]) -> dict[Method, dict[str, NDArray[np.float64]]]:
    """Return every score of every map on every drive."""
    result = {}
    for method, ones in counts.items():
        rows = [summary(one) for one in ones]
        result[method] = {name: np.array([row.get(name, np.nan) for row in rows]) for name in rows[0]}
    return result


def pooled(ones: Sequence[Counts]) -> dict[str, Any]:
    """Return what is said of all drives' cells together: curves and latencies."""
    trail = np.sum([one.trail for one in ones], axis=0)
    clearing = np.sum([one.clearing for one in ones], axis=0)
    appearing = np.sum([one.appearing for one in ones], axis=0)
    touched = trail[1:, :, 1]
    result: dict[str, Any] = {
        "ghost share by age 0.1 s, 0.2 s, ...": _rounded(
            touched[..., 2].sum(axis=1) / np.maximum(touched[..., 0].sum(axis=1), 1)
        ),
        "not called free by age": _rounded(
            touched[..., 3].sum(axis=1) / np.maximum(touched[..., 0].sum(axis=1), 1)
        ),
        "cells that were left, by hidden, visible, measured": touched[..., 0].sum(axis=0).tolist(),
        "cleared (P < 1/2) [s]": {
            f"{q:g}": _or_none(quantile_of(clearing[0, 0], q)) for q in (0.5, 0.9, 0.99)
        },
        "free > 1/2 [s]": {f"{q:g}": _or_none(quantile_of(clearing[1, 0], q)) for q in (0.5, 0.9, 0.99)},
        "cleared, visible cells [s]": {
            f"{q:g}": _or_none(quantile_of(clearing[0, 1], q)) for q in (0.5, 0.9, 0.99)
        },
        "appeared (P > 1/2) by scans after the first": _rounded(1 - survival(appearing[0])[:6]),
        "appeared (occupied > 1/2) by scans after the first": _rounded(1 - survival(appearing[1])[:6]),
        "known rightly by frame": {
            name: _rounded(np.nanmean([completeness(one)[name] for one in ones], axis=0))
            for name in ("seen so far", "all", "ring")
        },
    }
    fill = np.nanmean([completeness(one)["seen so far"] for one in ones], axis=0)
    ring = np.nanmean([completeness(one)["ring"] for one in ones], axis=0)
    for name, curve in (("seen so far", fill), ("ring", ring)):
        end = np.nanmean(curve[-10:])
        result[f"time to 90 % of the end, {name} [s]"] = 0.1 * int(np.argmax(curve >= 0.9 * end))
        result[f"end, {name}"] = round(float(end), 4)
    if any(one.conflict.any() for one in ones):
        found = conflict_scores(np.sum([one.conflict for one in ones], axis=0))
        result["conflict"] = {name: round(value, 4) for name, value in found.items()}
    return result


def report(counts: dict[Method, list[Counts]], rng: np.random.Generator) -> dict[str, Any]:
    """Return what is measured of every map, with intervals, and against the classical filter."""
    values = tabulated(counts)
    result: dict[str, Any] = {}
    for method, scores in values.items():
        name = SCAN if method[0] == SCAN else named(*method)
        result[name] = {
            "mean and 95 % interval": {
                key: [_or_none(round(float(v), 5)) for v in bootstrap_mean(scores[key], rng)]
                for key in scores
            },
            "ratio to the classical filter": {
                key: [
                    _or_none(round(float(v), 4))
                    for v in bootstrap_ratio(scores[key], values[BASELINE][key], rng)
                ]
                for key in COMPARED
            },
            **pooled(counts[method]),
        }
    return result


def table(counts: dict[Method, list[Counts]]) -> list[str]:
    """Return the main table, in Markdown."""
    values = tabulated(counts)
    lines = ["| map | " + " | ".join(title for title, _ in TABLE.values()) + " |"]
    lines.append("|---|" + "---:|" * len(TABLE))
    for method, scores in values.items():
        name = SCAN if method[0] == SCAN else named(*method)
        cells = []
        for key, (_, digits) in TABLE.items():
            kept = scores[key][~np.isnan(scores[key])]
            cells.append(f"{kept.mean():.{digits}f}" if len(kept) else "> 5")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return lines


def moment(many: Sequence[int], part: Split) -> tuple[int, int]:
    """Return the drive and frame of the picture: most returns of movers near ahead times their speed."""
    best, where = 0.0, (many[0], 60)
    for number in many:
        for frame in range(20, 100, 2):
            one = part[number * 100 + frame].objects
            speed = np.hypot(one["vx"], one["vy"])
            near = (np.abs(one["x"]) < 20) & (np.abs(one["y"]) < 14) & (one["returns"] >= 100)
            worth = float((np.minimum(speed, 10) * (near & (speed > 3)) * one["length"]).sum())
            if worth > best:
                best, where = worth, (number, frame)
    return where


def draw_moment(path: Path, part: Split, numbers: Sequence[int], note: str) -> dict[str, int]:
    """Draw the gallery."""
    number, frame = moment(numbers, part)
    drive = read_drive(part, number)
    scans = scans_of(drive, ray(drive))
    ours, theirs = EvidentialMapper(WINDOW), BinaryBayesMapper(WINDOW)
    for k in range(frame + 1):
        for mapper in (ours, theirs):
            mapper.update(
                EvidentialGrid.trusted(PAPER, scans[k]), drive.poses[k], stamp=float(drive.stamps[k])
            )
    scan = warp(EvidentialGrid.trusted(PAPER, scans[frame]), AHEAD, np.eye(4), "nearest")
    layers = ours.conflict_view(AHEAD)
    gallery(path, drive, frame, scan, ours.view(AHEAD), theirs.view(AHEAD), layers, note)
    return {"drive": number, "frame": frame}


def swept(part: Split, numbers: Sequence[int], quick: bool) -> dict[Method, dict[str, float]]:
    """Run every rule with every parameter on the drives that choices may be made on; return mean scores."""
    methods: list[Method] = [
        (family, p)
        for family, one in FAMILIES.items()
        if not (quick and family in SLOW)
        for p in (one.parameters[1::2] if quick and family != BASELINE[0] else one.parameters)
    ]
    methods = list(dict.fromkeys([(SCAN, 0.0), BASELINE, DEFAULT, PLAIN, *methods]))
    tried: dict[Method, list[Counts]] = {method: [] for method in methods}
    for drive in read(part, numbers, "dev"):
        for method, one in run(drive, scans_of(drive, ray(drive)), methods).items():
            tried[method].append(one)
    return {
        method: {name: float(np.nanmean(v)) for name, v in scores.items() if not np.isnan(v).all()}
        for method, scores in tabulated(tried).items()
    }


def kept(path: Path) -> dict[Method, dict[str, float]]:
    """Return what an earlier run found on the drives that choices may be made on."""
    rows = json.loads(path.read_text())["dev sweep"]
    return {(row.pop("family"), float(row.pop("parameter"))): row for row in rows}


def main() -> None:
    """Measure, print the table, write the record and the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--dev", type=Path, required=True, help="drives to choose parameters on")
    parser.add_argument("--data", type=Path, help="drives to measure on (default: those of --dev)")
    parser.add_argument("--quick", action="store_true", help="one drive each, few parameters, no numpy rules")
    parser.add_argument(
        "--keep", action="store_true", help="measure anew, but keep the choices of the last record"
    )
    parser.add_argument("--no-lite", action="store_true", help="without the network")
    parser.add_argument("--out", type=Path, default=RESULTS / "fusion_quality.json")
    parser.add_argument("--picture", type=Path, default=PICTURES / "fusion_quality.png")
    options = parser.parse_args()
    record = environment()
    words = [Path(word).name if Path(word).is_absolute() else word for word in sys.argv[1:]]
    record["command"] = " ".join(["python benchmarks/fusion_quality.py", *words])
    rng = np.random.default_rng(SEED)

    store = Store.open(options.dev)
    part = store["sequences"]
    numbers = drives(part, 1 if options.quick else None)
    count = len(numbers)
    rows = kept(options.out) if options.keep else swept(part, numbers, options.quick)
    points = chosen({method: row for method, row in rows.items() if method[0] != SCAN})

    # What was chosen, on the drives that nothing was chosen on
    judged_store, judged = store, "dev"
    finals: list[Method] = list(dict.fromkeys([(SCAN, 0.0), BASELINE, DEFAULT, PLAIN, *points.items()]))
    deep: list[Method] = list(dict.fromkeys([(SCAN, 0.0), BASELINE, DEFAULT, PLAIN, ("cautious", 2.0)]))
    if options.data:
        judged_store, judged = Store.open(options.data), "test"
        part = judged_store["sequences"]
        numbers = drives(part, 1 if options.quick else None)
    final: dict[Method, list[Counts]] = {method: [] for method in finals}
    network: dict[Method, list[Counts]] = {method: [] for method in deep}
    kinds: Any = 0
    found: Any = 0
    uncertain: list[dict[str, NDArray[np.float32]]] = []
    same: list[dict[str, float]] = []
    lost: list[dict[str, float]] = []
    for drive in read(part, numbers, judged):
        scans = scans_of(drive, ray(drive))
        for method, one in run(drive, scans, finals).items():
            final[method].append(one)
        histograms, levels = conflict_kinds(drive, scans, PLAIN[1])
        kinds, found = kinds + histograms, found + levels
        uncertain.append(what_half_means(drive, scans, PLAIN[1]))
        lost += lost_by_cells(drive)
        if len(same) < 3:
            same.append(same_filter(drive, scans))
        if not options.no_lite:
            for method, one in run(drive, scans_of(drive, lite(drive)), deep).items():
                network[method].append(one)
    frames = 100 * len(numbers)
    record |= {
        "definitions": __doc__,
        "dev": {"plan": store.plan, "drives": count},
        "judged": {"what": judged, "plan": judged_store.plan, "drives": len(numbers), "frames": frames},
        "bootstrap seed": SEED,
        "dev sweep": [
            {"family": family, "parameter": _parameter(p), **{key: round(v, 5) for key, v in row.items()}}
            for (family, p), row in rows.items()
        ],
        "chosen on dev": {family: _parameter(p) for family, p in points.items()},
        "moving, seen participants in view, frames times participants": sum(
            one.objects for one in final[BASELINE]
        ),
        "maps": report(final, rng),
        "maps behind lite": report(network, rng) if network[BASELINE] else {},
        "truth through the map's cells": {
            key: round(float(np.mean([one[key] for one in lost])), 4) for key in lost[0]
        },
        "conflict as a cue for motion": _clean(conflict_report(kinds, found, frames)),
        "where Bayes says 0.4 to 0.6": _clean(
            unknown_report({key: np.concatenate([one[key] for one in uncertain]) for key in uncertain[0]})
        ),
        "Dempster and Bayes by plausibility": {key: max(one[key] for one in same) for key in same[0]},
    }
    lines = table(final)
    if network[BASELINE]:
        lines += ["", "Behind lite:", "", *table(network)]
    record["table"] = lines
    write_json(options.out, record)
    print("\n".join(lines))

    sweep = [{"family": family, "parameter": p, **row} for (family, p), row in rows.items()]
    drawn = {
        (SCAN if method[0] == SCAN else named(*method)): (method[0], ones)
        for method, ones in final.items()
        if method[0] in DRAWN
    }
    ghosts = {
        name: (
            family,
            np.array(record["maps"][name]["ghost share by age 0.1 s, 0.2 s, ..."]),
        )
        for name, (family, _) in drawn.items()
    }
    filled = {
        name: (
            family,
            {
                kind: np.nanmean([completeness(one)[kind] for one in ones], axis=0)
                for kind in ("seen so far", "ring")
            },
        )
        for name, (family, ones) in drawn.items()
        if family in (SCAN, BASELINE[0], PLAIN[0], DEFAULT[0])
    }
    said = {
        "judged": f"{len(numbers)} {judged} drives",
        "dev": f"{count} dev drives",
    }
    curves(options.picture, ghosts, filled, sweep, points, said, caption(record))
    at = options.picture.with_name(options.picture.stem + "_moment.png")
    record["moment"] = draw_moment(at, part, numbers, caption(record))
    write_json(options.out, record)
    say(f"wrote {options.out}, {options.picture} and {at}")


def _rounded(values: NDArray[np.float64]) -> list[float | None]:
    return [_or_none(round(float(value), 5)) for value in values]


def _or_none(value: float) -> float | None:
    return None if np.isnan(value) or np.isinf(value) else float(value)


def _parameter(value: float) -> float | str:
    return "inf" if np.isinf(value) else value


def _clean(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _clean(one) for key, one in value.items()}
    return _or_none(round(float(value), 5))


if __name__ == "__main__":
    main()
