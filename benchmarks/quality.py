"""Which model should one use, how good is it, where does it fail? Everything against everything, in one command.

    python benchmarks/quality.py --single DATA --sequences SEQ [--paper WEIGHTS] [--every 5] [--quick]

DATA and SEQ are data sets that `ogm simulate` made (see benchmarks/README.md): single frames, whose test split is
another town than that of training, and drives of 10 s at 10 Hz. Compared are

* in the test town, single frames, against the whole truth: height-band (the paper's baseline as its text has it,
  with evidence 10 and the own vehicle's returns taken out), height-band-released (what its code does, see
  `deep_quality`), ray, lite, and paper if weights are given;
* on the drives, against what each frame itself can see: each of these alone and fused over time by every rule of
  `ogm evaluate --fused`, with the mappers' defaults, and by plain Dempster (half-life 2 s for everything). All frames
  are fused, every fifth is judged. The rules that run in numpy are left to ray and the networks. Rules at operating
  points that were chosen for them, ghosts and clearing: see `fusion_quality`;
* on real recordings, labelled cells only: each alone, and fused where there are poses, then against truth that is
  made of later scans only.

All by `ogm.metrics`; means over frames, 95 % bootstrap intervals over drives where there are five or more, else over
frames; every method is compared with height-band and ray frame by frame. Finished frames are kept in runs/quality: an
interrupted run goes on when it is repeated. Writes benchmarks/results/quality.json, docs/pictures/quality*.png, the
tables in docs/quality.md, and in runs/quality reports to look at, also of the real recordings, whose scans may not be
passed on. Nothing was chosen by the test data.
"""

from _run import DATA, PICTURES, RESULTS, ROOT, caption, environment

# isort: split
import argparse
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from _quality_methods import alone, at_work, fused_over_time
from _quality_pictures import by_distance, chosen, maps, papers_figures, recordings
from _quality_record import brief, of_evaluation, published, write
from _quality_sources import drives, every, first_drives, real, town
from _quality_tables import fill, sentences, tables

from ogm import GridSpec
from ogm.cli.judging import ResultCache, run_evaluation, state_of_code, state_of_files
from ogm.cli.methods import Map, SingleScanMethod
from ogm.cli.page import write_page
from ogm.cli.pictures import frames_picture, panels_of
from ogm.cli.report import plain, report
from ogm.cli.source import Frame, Source
from ogm.cli.views import frame_view
from ogm.files import atomic_write
from ogm.metrics import METRICS, Evaluation

PAPER = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
PAGES = {ROOT / "docs" / "quality.md": tables, ROOT / "docs" / "reproduction.md": sentences}
KEEP = ROOT / "runs" / "quality"
SEED = 0
DEEP = "lite"  # what ships, and is drawn
LOOKED_AT = ("ray", "lite", "ray + bayes", "ray + cautious", "lite + cautious")  # of the maps, in the picture
QUICK_FRAMES, QUICK_SCANS, QUICK_REAL = 4, 10, ("KITTI, single scans", "SUSTechPOINTS")
Methods = Mapping[str, SingleScanMethod | Map]
View = Callable[..., dict[str, bytes]]


class Run(NamedTuple):
    """What all parts share."""

    options: argparse.Namespace
    models: dict[str, SingleScanMethod]
    folder: Path  # of frames and reports
    pictures: Path
    facts: Mapping[str, Any]  # machine, date, versions


def say(words: str) -> None:
    """Report progress."""
    print(words, file=sys.stderr, flush=True)


def ticked(what: str) -> Callable[[Iterable[int]], Iterator[int]]:
    """Return what says every half minute how far a part is."""

    def tick(numbers: Iterable[int]) -> Iterator[int]:
        listed, last = list(numbers), time.monotonic()
        for done, number in enumerate(listed):
            if time.monotonic() - last > 30:
                say(f"{what}: {done} of {len(listed)} frames")
                last = time.monotonic()
            yield number

    return tick


class Part(NamedTuple):
    """A part of the comparison, judged."""

    result: Evaluation
    archive: ResultCache
    source: Source
    numbers: Sequence[int]
    methods: Methods

    @property
    def frames(self) -> list[Frame]:
        """What the judged frames are called."""
        return [self.source.frames[k] for k in self.numbers]

    @property
    def facts(self) -> dict[str, dict[str, Any]]:
        """What every method says of itself, and its weights."""
        return {
            name: {"says": one.description, "weights": getattr(one, "weights", None)}
            for name, one in self.methods.items()
        }

    @property
    def data(self) -> dict[str, Any]:
        """What was judged on, without the numbers of all samples."""
        source = self.source
        rest = {key: value for key, value in source.facts.items() if key != "samples"}
        return {"kind": source.kind, "name": source.name, "truth": source.description, **rest}

    def record(self) -> dict[str, Any]:
        """Return what is kept of it."""
        drives = [frame.sequence for frame in self.frames]
        kept = of_evaluation(self.result, np.random.default_rng(SEED), drives, self.facts)
        return {"data": self.data, **kept}


def judged(folder: Path, source: Source, numbers: Sequence[int], methods: Methods, view: View) -> Part:
    """Judge methods on frames, or take what an earlier run has finished."""
    settings = {
        "data": {"kind": source.kind, "name": source.name, **source.facts},
        "truth": source.description,
        "frames": [source.frames[k].name for k in numbers],
        "methods": {name: [one.description, getattr(one, "weights", None)] for name, one in methods.items()},
        "files": state_of_files(source.files),
        "code": state_of_code(),
    }
    archive = ResultCache(folder / "frames", settings)
    start = time.process_time()
    what = f"{folder.name}, {len(methods)} methods"
    result = run_evaluation(source, numbers, at_work(dict(methods), PAPER), archive, ticked(what), view)
    say(f"{what}: {len(numbers)} frames, {time.process_time() - start:.0f} s of the processor")
    return Part(result, archive, source, numbers, methods)


def look(path: Path, title: str, part: Part, run: Run) -> None:
    """Write the report that `ogm evaluate` writes."""
    drives = [frame.sequence for frame in part.frames]
    record = {
        "title": title,
        "command": run.facts["command"],
        "date": run.facts["date"][:10],
        "seed": SEED,
        "data": part.data,
        "frames": [frame._asdict() for frame in part.frames],
        **report(part.result, np.random.default_rng(SEED), drives, part.facts),
        "machine": f"{run.facts['cpu']}, {run.facts['system']}, Python {run.facts['python']}",
    }
    views = {
        place: one.views
        for place, number in enumerate(part.numbers)
        if (one := part.archive.load(number)) is not None
    }
    write_page(path, record, views)


def only(places: Sequence[int]) -> View:
    """Return a view of a few methods only."""

    def view(points: Any, state: Any, masses: Sequence[Any], *rest: Any) -> dict[str, bytes]:
        return frame_view(points, state, [masses[k] for k in places], *rest)

    return view


def nothing(*frame: Any) -> dict[str, bytes]:
    """Draw nothing."""
    return {}


def draw_frames(path: Path, title: str, part: Part, shown: Sequence[str], by: tuple[str, str]) -> None:
    """Draw the best, a middling and the worst frame of a method by a metric."""
    result = part.result
    few = Evaluation(
        tuple(shown),
        result.spec,
        {m: np.stack([result.of(name, m) for name in shown]) for m in METRICS},
        tuple(result.pooled[result.models.index(name)] for name in shown),
        result.truth,
    )
    rows = []
    for word, k in chosen(result, *by):
        one = part.archive.load(part.numbers[k])
        if one is not None:
            rows.append((f"{word}: {part.frames[k].name}", panels_of(one.views, few, k)))
    path.parent.mkdir(parents=True, exist_ok=True)
    frames_picture(path, rows, title)


def judge_town(run: Run) -> dict[str, Any]:
    """Judge single frames of the simulated test town."""
    source = town(run.options.single, PAPER, run.options.split)
    numbers = list(range(len(source.frames)))[: QUICK_FRAMES if run.options.quick else None]
    part = judged(run.folder / "town", source, numbers, run.models, frame_view)
    names = list(run.models)
    record = part.record()
    record["as the released code would report"] = published(part.result, DEEP, "height-band-released")
    look(run.folder / "town.html", f"Simulated test town: {', '.join(names)}", part, run)
    papers_figures(run.pictures / "quality.png", part.result, DEEP, caption(run.facts))
    by_distance(run.pictures / "quality_range.png", record, caption(run.facts))
    title = f"Simulated test town: best, middling and worst frame of {DEEP}"
    draw_frames(run.pictures / "quality_frames.png", title, part, names, (DEEP, "kl_e10"))
    return record


def judge_drives(run: Run) -> dict[str, Any]:
    """Judge maps on simulated drives."""
    source = drives(run.options.sequences, PAPER)
    numbers = every(source, run.options.every)
    if run.options.quick:
        numbers = first_drives(source, numbers, 1)[: QUICK_SCANS // run.options.every]
    methods = fused_over_time(run.models, PAPER, run.options.quick)
    view = only([list(methods).index(name) for name in LOOKED_AT])
    part = judged(run.folder / "drives", source, numbers, methods, view)
    record = part.record()
    maps(run.pictures / "quality_maps.png", record, caption(run.facts))
    title = "Simulated test drives: best, middling and worst frame of lite + cautious"
    path = run.pictures / "quality_maps_frames.png"
    draw_frames(path, title, part, LOOKED_AT, ("lite + cautious", "brier"))
    return record


def judge_real(run: Run) -> dict[str, Any]:
    """Judge models and maps on real recordings; their scans stay in runs/."""
    found: dict[str, Any] = {}
    for one in real(run.options.real, PAPER):
        if run.options.quick and one.name not in QUICK_REAL:
            continue
        if one.alone is None:
            found[one.name] = {"left out": one.description}
            say(f"{one.name} is left out: {one.description}")
            continue
        place = run.folder / "".join(c if c.isalnum() else "-" for c in one.name)
        part = judged(place, one.alone, range(len(one.alone.frames)), run.models, frame_view)
        found[one.name] = {"alone": part.record()}
        look(place.with_suffix(".html"), one.name, part, run)
        if one.fused is not None:
            place = place.with_name(f"{place.name}-fused")
            methods = fused_over_time(run.models, PAPER, run.options.quick)
            part = judged(place, one.fused, range(len(one.fused.frames)), methods, nothing)
            found[one.name]["fused"] = brief(part.record())
    if any("alone" in one for one in found.values()):
        recordings(run.pictures / "quality_real.png", found, caption(run.facts))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--single", type=Path, help="data set of single frames")
    parser.add_argument(
        "--split", default="test", help="part of it (default test, for the final figure only)"
    )
    parser.add_argument("--sequences", type=Path, help="data set of drives")
    parser.add_argument(
        "--real", type=Path, default=DATA, help="folder of real recordings (default OGM_DATA)"
    )
    parser.add_argument("--paper", type=Path, help="weights of a network of the paper's size")
    parser.add_argument("--every", type=int, default=5, help="judge every so manieth frame of a drive")
    parser.add_argument("--quick", action="store_true", help="a few frames, into runs/quality-quick alone")
    parser.add_argument("--out", type=Path, help="where the figures go")
    options = parser.parse_args()
    folder = KEEP.with_name("quality-quick") if options.quick else KEEP
    pictures = folder if options.quick else PICTURES
    out = options.out or (folder if options.quick else RESULTS) / "quality.json"
    if options.every < 1 or (options.quick and options.every > QUICK_SCANS):
        parser.error(f"--every must be at least 1 (with --quick at most {QUICK_SCANS}), got {options.every}")

    record = environment()
    record["command"] = " ".join(["python benchmarks/quality.py", *_words()])
    record |= {"seed": SEED, "split": options.split, "metrics": {m: METRICS[m]._asdict() for m in METRICS}}
    run = Run(options, alone(PAPER, options.paper), folder, pictures, dict(record))
    parts = {
        "town": judge_town if options.single else None,
        "drives": judge_drives if options.sequences else None,
        "real": judge_real if options.real.is_dir() else None,
    }
    for name, part in parts.items():
        if part is None:
            say(f"{name} is left out: no data given")
            continue
        record[name] = plain(part(run))
        write(out, record)
    for page, made in PAGES.items():
        if options.quick:
            print("\n\n".join(f"{name}\n{text}" for name, text in made(record).items()))
            continue
        text = fill(page.read_text(), made(record))
        with atomic_write(page, "w") as file:
            file.write(text)
    say(f"wrote {out}, pictures in {pictures}, reports in {folder}")


def _words() -> list[str]:
    return [Path(word).name if Path(word).is_absolute() else word for word in sys.argv[1:]]


if __name__ == "__main__":
    main()
