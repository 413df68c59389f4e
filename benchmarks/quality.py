"""Which model should one use, how good is it, where does it fail? All models and rules in one command.

    python benchmarks/quality.py --single DATA --sequences SEQ [--single-old OLD] [--paper WEIGHTS] [--before FOLDER]

DATA, OLD and SEQ are data sets that `ogm simulate` made (see benchmarks/README.md): single frames of many drives in
towns that no training has seen, those of an older and smaller test, and drives of 10 s at 10 Hz. Compared are

* in the test towns, single frames, against the whole truth: the models of `deep_quality`, and paper if given; the
  same on OLD, so that figures of earlier versions can be read on;
* on the drives, against what each frame itself can observe: each of these alone and, but for the baselines, fused over
  time by every rule of `ogm evaluate --fused`, with the mappers' defaults, and by plain Dempster (half-life 2 s for
  everything). All frames are fused, every fifth is evaluated;
* on real recordings, labelled cells only: each alone, and fused where there are poses, against truth of later scans.

All by `ogm.metrics`; means over frames with 95 % intervals over drives (`ogm.evaluation.statistics`), none where there
are fewer than four; every method is compared with height-band and ray frame by frame. Beliefs are compared with how
often they are right; FOLDER, the finished frames of an earlier version, adds its `ray` to that picture. Frames are kept
in runs/quality-DIGEST, that of the models' checksums: an interrupted run resumes when it is repeated. Writes
benchmarks/results/quality.json and docs/pictures/quality*.png (docs/build.py makes tables of the record), and reports
beside the frames, also of the real recordings, whose scans may not be passed on. Nothing was chosen by the test data.
"""

import _run as run  # first: it sets the number of threads

# isort: split
import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

from _charts import caption
from _evaluation_record import beliefs, brief, earlier, published, record_of
from _quality_methods import MODELS, all_maps, every, single_scan
from _quality_pictures import by_distance, chosen, maps, papers_figures, recordings, reliability
from _recordings import real
from rich.progress import track

from ogm import GridSpec
from ogm.datasets import Dataset, open_dataset
from ogm.evaluation import Evaluation, SingleScanMethod, evaluate, write_report
from ogm.evaluation.figures import draw_frames, frame_panels
from ogm.evaluation.frame_pictures import draw_frame
from ogm.evaluation.text import as_json
from ogm.evidence.map_rules import BAYES, RULES
from ogm.metrics import METRICS, ConfusionSums

PAPER = GridSpec.centered()
DEEP = "lite"  # the shipped network, which is drawn
DEFAULT = "combined + cautious"  # the map of `ogm fuse`
DRAWN = ("ray", "combined", "combined + bayes", "ray + cautious", DEFAULT)  # of the maps
QUICK_FRAMES, QUICK_SCANS, QUICK_REAL = 4, 10, ("KITTI, single scans", "SUSTechPOINTS")


class Job(NamedTuple):
    """Options, models and places that all parts share."""

    options: argparse.Namespace
    models: dict[str, SingleScanMethod]
    folder: Path  # of frames and reports
    pictures: Path
    facts: Mapping[str, Any]  # machine, date, versions
    beliefs: dict[str, dict[str, ConfusionSums]]  # pooled, by place and method


def progress(words: str) -> None:
    """Report progress."""
    print(words, file=sys.stderr, flush=True)


def run_part(
    folder: Path, dataset: Dataset, numbers: Iterable[int], methods: Mapping[str, Any], draw: Callable[..., Any]
) -> Evaluation:
    """Evaluate methods on frames, or take what an earlier run has finished."""
    start, what = time.process_time(), f"{folder.name}, {len(methods)} methods"
    result = evaluate(
        methods, dataset, PAPER, frames=numbers, out=folder, progress=partial(track, description=what), draw=draw
    )
    progress(f"{what}: {len(result.frames)} frames, {time.process_time() - start:.0f} s of the processor")
    return result


def report(folder: Path, title: str, result: Evaluation, job: Job) -> None:
    """Write the report that `ogm evaluate` writes."""
    machine = f"{job.facts['cpu']}, {job.facts['system']}, Python {job.facts['python']}"
    write_report(folder, result, title=title, command=job.facts["command"], pictured=1000, machine=machine)


def pool(job: Job, place: str, folder: Path, result: Evaluation) -> None:
    """Add what beliefs are compared by, and that of an earlier run, to a place's sums."""
    found = dict(zip(result.methods, result.pooled, strict=True))
    if job.options.before and (job.options.before / folder.name / "report.json").exists():
        found["ray, before"] = earlier(job.options.before / folder.name, "ray")
    there = job.beliefs.setdefault(place, {})
    for name in ("height-band", "ray", "ray, before", DEEP, "combined"):
        if name in found:
            there[name] = there[name].plus(found[name]) if name in there else found[name]


def draw_some(places: Sequence[int], points: Any, state: Any, masses: Sequence[Any], *rest: Any) -> dict[str, bytes]:
    """Draw a frame with the masses of some methods only."""
    return draw_frame(points, state, [masses[k] for k in places], *rest)


def nothing(*frame: Any) -> dict[str, bytes]:
    """Draw nothing."""
    return {}


def draw_three(path: Path, title: str, result: Evaluation, shown: Sequence[str], by: tuple[str, str]) -> None:
    """Draw the best, a middling and the worst frame of a method by a metric."""
    few = result.select(shown)
    rows = [
        (f"{word}: {result.frames[k].name}", frame_panels(result.pictures(k), few, k))
        for word, k in chosen(result, *by)
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    draw_frames(path, rows, title)


def evaluate_town(job: Job) -> dict[str, Any]:
    """Evaluate single frames of the simulated test towns."""
    dataset = open_dataset(job.options.single, split=job.options.split)
    numbers = range(len(dataset))[: QUICK_FRAMES if job.options.quick else None]
    result = run_part(job.folder / "town", dataset, numbers, job.models, draw_frame)
    names = list(job.models)
    record = record_of(result)
    record["as the released code would report"] = published(result, DEEP, "height-band-released")
    report(job.folder / "town", f"Simulated test towns: {', '.join(names)}", result, job)
    pool(job, f"unseen towns, {record['extent']}", job.folder / "town", result)
    papers_figures(job.pictures / "quality.png", result, DEEP, caption(job.facts))
    by_distance(job.pictures / "quality_range.png", record, caption(job.facts))
    title = f"Simulated test towns: best, middling and worst frame of {DEEP}"
    draw_three(job.pictures / "quality_frames.png", title, result, names, (DEEP, "nll"))
    return record


def evaluate_old(job: Job) -> dict[str, Any]:
    """Evaluate the older and smaller test: ten drives in one town."""
    dataset = open_dataset(job.options.single_old, split=job.options.split)
    numbers = range(len(dataset))[: QUICK_FRAMES if job.options.quick else None]
    return brief(record_of(run_part(job.folder / "old", dataset, numbers, job.models, nothing)))


def evaluate_drives(job: Job) -> dict[str, Any]:
    """Evaluate maps on simulated drives; what a frame itself cannot observe is left out of its truth."""
    dataset = open_dataset(job.options.sequences, split="sequences", others="later")
    numbers = every(dataset, job.options.every)
    if job.options.quick:
        numbers = every(dataset, job.options.every, drives=1)[: QUICK_SCANS // job.options.every]
    methods = all_maps(job.models, PAPER, job.options.quick)
    draw = partial(draw_some, [list(methods).index(name) for name in DRAWN])
    result = run_part(job.folder / "drives", dataset, numbers, methods, draw)
    record = record_of(result)
    maps(job.pictures / "quality_maps.png", record, caption(job.facts))
    title = f"Simulated test drives: best, middling and worst frame of {DEFAULT}"
    draw_three(job.pictures / "quality_maps_frames.png", title, result, DRAWN, (DEFAULT, "brier"))
    return record


def evaluate_real(job: Job) -> dict[str, Any]:
    """Evaluate models and maps on real recordings; their scans stay in runs/."""
    found: dict[str, Any] = {}
    for one in real(job.options.real):
        if job.options.quick and one.name not in QUICK_REAL:
            continue
        if one.alone is None:
            found[one.name] = {"left out": one.reason}
            progress(f"{one.name} is left out: {one.reason}")
            continue
        folder = job.folder / "".join(c if c.isalnum() else "-" for c in one.name)
        result = run_part(folder, one.alone, range(len(one.alone)), job.models, draw_frame)
        found[one.name] = {"alone": record_of(result)}
        report(folder, one.name, result, job)
        if (result.truth[:, 1:3].sum(axis=0) > 0).all():  # else every belief in one of the two is right
            pool(job, "real recordings with free and occupied labels", folder, result)
        if one.fused is not None:
            folder = folder.with_name(f"{folder.name}-fused")
            methods = all_maps(job.models, PAPER, job.options.quick)
            result = run_part(folder, one.fused, range(len(one.fused)), methods, nothing)
            found[one.name]["fused"] = brief(record_of(result))
    if any("alone" in one for one in found.values()):
        recordings(job.pictures / "quality_real.png", as_json(found), caption(job.facts))
    return found


def main() -> None:
    parser = run.Parser(__doc__, quick=True, real=True)
    parser.add_argument("--single", type=Path, help="data set of single frames")
    parser.add_argument("--single-old", type=Path, help="data set of single frames of an older test")
    parser.add_argument("--before", type=Path, help="finished frames of an earlier version, for the reliability of ray")
    parser.add_argument("--split", default="test", help="part of it (default test, for the final figure only)")
    parser.add_argument("--sequences", type=Path, help="data set of drives")
    parser.add_argument("--paper", type=Path, help="weights of a network of the paper's size")
    parser.add_argument("--every", type=int, default=5, help="evaluate every N-th frame of a drive")
    options = parser.parse_args()
    record = run.environment(*MODELS, *RULES, BAYES, **({"paper": options.paper} if options.paper else {}))
    record |= {"split": options.split, "metrics": {m: METRICS[m]._asdict() for m in METRICS}}
    digest = sha256(json.dumps(record["checksums"]).encode()).hexdigest()[:8]
    folder = run.RUNS / ("quality-quick" if options.quick else f"quality-{digest}")
    pictures = folder if options.quick else run.PICTURES
    job = Job(options, single_scan(PAPER, options.paper), folder, pictures, dict(record), {})
    parts = {
        "town": evaluate_town if options.single else None,
        "old": evaluate_old if options.single_old else None,
        "drives": evaluate_drives if options.sequences else None,
        "real": evaluate_real if options.real.is_dir() else None,
    }
    for name, part in parts.items():
        if part is None:
            progress(f"{name} is left out: no data given")
            continue
        record[name] = as_json(part(job))
        run.write_record(options.out, record)
    if job.beliefs:
        places = job.beliefs.items()
        record["reliability"] = {place: {name: beliefs(one) for name, one in sums.items()} for place, sums in places}
        run.write_record(options.out, as_json(record))
        reliability(pictures / "quality_reliability.png", record["reliability"], caption(job.facts))


if __name__ == "__main__":
    main()
