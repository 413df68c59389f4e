"""``ogm evaluate``: sensor models, maps and foreign grids against the truth, frame by frame."""

import shlex
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer
from rich.progress import track

from ogm.cli.console import out, report_errors, stderr
from ogm.fusion import BAYES, RULES

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ogm.cli.judging import ResultCache
    from ogm.cli.source import Source
    from ogm.metrics import Evaluation

WORST, BEST = 0.5, 0.25  # shares of the frames in the report; the rest is spread evenly over the ranks
ROWS = 6  # of the contact sheet
WRITTEN = ("report.html", "report.json", "frames.csv", "metrics.png", "frames.png")
HEADLINE = "kl_e10"  # by which frames are ranked


@report_errors
def evaluate(
    data: Annotated[
        Path,
        typer.Argument(
            help="Data set that `ogm simulate` made; a recording (KITTI, SemanticKITTI, nuScenes, Argoverse 2, ...); "
            "or a folder of truth grids.",
            metavar="DATA",
        ),
    ],
    more: Annotated[
        list[str] | None, typer.Argument(help="Further models, after --ism NAME.", metavar="[NAME]...")
    ] = None,
    ism: Annotated[
        list[str] | None,
        typer.Option(
            help="Models: height-band, height-band-released, ray, lite, or weights that `ogm train` wrote "
            "(a file or a run's folder). [default: height-band ray lite, unless --grids are given]",
            metavar="NAME [NAME]...",
        ),
    ] = None,
    fused: Annotated[
        str | None,
        typer.Option(
            help="Judge each model also fused over time, by one or more rules with commas between: "
            f"{', '.join(RULES)}, {BAYES}.",
            metavar="RULE[,RULE]...",
        ),
    ] = None,
    grids: Annotated[
        list[Path] | None,
        typer.Option(
            help="Folder of grids that somebody else made (.npz, .npy, .png), by the frames' names; may be repeated."
        ),
    ] = None,
    resample: Annotated[
        str | None,
        typer.Option(
            help="Bring --grids of other cells onto those judged: area, nearest or cautious. [default: refuse]"
        ),
    ] = None,
    split: Annotated[
        str | None,
        typer.Option(help="Part of a simulated data set. [default: validation; sequences with --fused]"),
    ] = None,
    truth: Annotated[
        str | None,
        typer.Option(
            help="Of a recording: what its truth is made from, with commas between: boxes, classes, map, aggregated. "
            "[default: all there is]",
            metavar="WHAT[,WHAT]...",
        ),
    ] = None,
    samples: Annotated[int | None, typer.Option(help="Frames, drawn at random. [default: all]")] = None,
    every: Annotated[int, typer.Option(help="Judge every so manieth frame; maps are shown all.")] = 1,
    frames: Annotated[int, typer.Option(help="Frames to look at in the report.")] = 100,
    seed: Annotated[int, typer.Option(help="Says which samples and which bootstrap draws.")] = 0,
    out_folder: Annotated[
        Path,
        typer.Option(
            "--out", help="Folder for report.html, report.json, frames.csv, metrics.png, frames.png."
        ),
    ] = Path("report"),
) -> None:
    """Judge sensor models, maps and foreign grids on the same frames, and write a report to look at.

    How far from the truth, how well calibrated, how safe, who wins how often, and where each fails. Cells that the
    truth ignores are left out; on recordings that is every cell that nobody labelled. Every model is told the
    sensor's height and tilt and where the own vehicle is, but for height-band-released, which has its own numbers
    built in. With --fused, what a simulated frame cannot see is left out too, as a map may know it, and the
    aggregated truth of a recording is made from later scans only, which no map has seen.
    What stands behind +- is half of the 95 % bootstrap interval of the mean: over drives where there are five or
    more, else over frames.

    Finished frames are kept in the folder frames of --out: an interrupted run goes on when the command is repeated.
    """
    import numpy as np

    from ogm.cli.judging import ResultCache, run_evaluation, state_of_code, state_of_files
    from ogm.cli.methods import Methods, methods_of
    from ogm.cli.page import write_page
    from ogm.cli.report import print_tables, report, versions, write_csv, write_report
    from ogm.cli.source import source_of
    from ogm.fusion.resample import ResampleMethod as Method
    from ogm.grid import GridSpec
    from ogm.recordings import SOURCES

    rules = _words(fused, "--fused", (*RULES, BAYES))
    given = _words(truth, "--truth", SOURCES)
    if resample not in (None, *get_args(Method)):
        raise ValueError(f"--resample must be one of {', '.join(get_args(Method))}, got {resample}")
    if frames < 1:
        raise ValueError(f"--frames must be at least 1, got {frames}")
    spec = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
    names = [*(ism or []), *(more or [])] or ([] if grids else ["height-band", "ray", "lite"])
    if rules and not names:
        raise ValueError("--fused fuses the scans of models; give --ism NAME too")
    if rules and split is None and (data / "zarr.json").exists():
        split = "sequences"
    source = source_of(data, spec, split, tuple(given), "maps" if rules else "scans")
    numbers = _numbers(source, samples, every, seed)
    methods = Methods(methods_of(names, rules, grids or [], spec), spec, resample)  # type: ignore[arg-type]
    methods.check([source.frames[k] for k in (range(len(source.frames)) if methods.remember else numbers)])
    if out_folder.exists() and not out_folder.is_dir():
        raise ValueError(f"--out writes a folder, but {out_folder} is a file")
    if out_folder.resolve() in {folder.resolve() for folder in (data, *(grids or []))}:
        raise ValueError(f"--out {out_folder} is what is judged: pictures of the report would mix with it")

    facts = {
        "data": {"kind": source.kind, "name": source.name, "truth": source.description, **source.facts},
        "methods": methods.facts(),
        "resample": resample,
        "versions": versions(),
    }
    settings = {
        "frames": [source.frames[k] for k in numbers],
        "numbers": numbers,
        "grid": [spec.resolution, spec.shape, spec.origin],
        "files": state_of_files([*source.files, *methods.files], out_folder),
        "code": state_of_code(),
    }
    archive = ResultCache(out_folder / "frames", facts | settings)
    kept = len(numbers) - len(archive.missing(numbers))
    if not kept:
        for name in WRITTEN:  # of another run: they would be taken for this one's if it ended early
            (out_folder / name).unlink(missing_ok=True)
    if kept:
        stderr.print(
            f"ogm: {kept} of {len(numbers)} frames are finished already, and are taken from {archive.folder}"
        )

    def ticked(numbers: Any) -> Any:
        return track(numbers, "judging", console=stderr, transient=True)

    try:
        result = run_evaluation(source, numbers, methods, archive, ticked)
    except KeyboardInterrupt:
        done = len(numbers) - len(archive.missing(numbers))
        stderr.print(
            f"ogm: interrupted; {done} of {len(numbers)} frames are finished and kept: repeat the command to go on"
        )
        raise typer.Exit(130) from None
    with stderr.status("writing the report ..."):
        named = [source.frames[k] for k in numbers]
        record = {
            "title": f"{source.name}: {', '.join(methods.names)}" if len(methods.names) < 5 else source.name,
            "command": shlex.join(["ogm", *sys.argv[1:]]),
            "date": datetime.now(UTC).date().isoformat(),
            "seed": seed,
            "data": facts["data"],
            "frames": [frame._asdict() for frame in named],
            **report(
                result, np.random.default_rng(seed), [frame.sequence for frame in named], methods.facts()
            ),
        }
        write_report(out_folder / "report.json", record)
        write_csv(out_folder / "frames.csv", result, [frame.name for frame in named])
        views = {int(k): one.views for k in _pictured(result, frames) if (one := archive.load(numbers[k]))}
        write_page(out_folder / "report.html", record, views)
        draw(out_folder, result, source, numbers, archive)
    archive.finish()
    print_tables(result, record, f"{source.name}, {result.frames} frames")
    written = "   ".join(str(out_folder / name) for name in WRITTEN)
    out.print(f"written {written}", markup=False, soft_wrap=True)


def _words(given: str | None, option: str, choices: Sequence[str]) -> list[str]:
    """Return what an option lists with commas, each once."""
    words = [word.strip() for word in (given or "").split(",") if word.strip()]
    for word in words:
        if word not in choices:
            raise ValueError(f"{option} knows {', '.join(choices)}, got {word!r}")
    if given is not None and not words:
        raise ValueError(f"{option} wants one or more of {', '.join(choices)}")
    return list(dict.fromkeys(words))


def _numbers(source: "Source", samples: int | None, every: int, seed: int) -> list[int]:
    """Return the numbers of the frames to judge, ascending."""
    import numpy as np

    if every < 1:
        raise ValueError(f"--every must be at least 1, got {every}")
    numbers = np.arange(0, len(source.frames), every)
    if samples is None:
        return numbers.tolist()
    if not 1 <= samples <= len(numbers):
        raise ValueError(f"--samples must be in 1 ... {len(numbers)}, what {source.name} has, got {samples}")
    return np.sort(np.random.default_rng(seed).choice(numbers, samples, replace=False)).tolist()


def _ranked(result: "Evaluation") -> "NDArray[np.int64]":
    """Return the frames from the best to the worst of the last method, without those that have no value, if any do."""
    import numpy as np

    values = result.of(result.models[-1], HEADLINE)
    order = np.argsort(values, kind="stable")  # those without a value come last
    return order[: np.count_nonzero(~np.isnan(values)) or None]


def _pictured(result: "Evaluation", most: int) -> list[int]:
    """Choose the frames that the report shows: the worst, the best, and others spread evenly over the ranks."""
    import numpy as np

    if result.frames <= most:
        return list(range(result.frames))
    order = _ranked(result)
    if len(order) <= most:
        return sorted(order.tolist())
    worst = max(round(WORST * most), 1)
    best = min(round(BEST * most), most - worst)
    between = order[best : len(order) - worst]
    places = np.linspace(0, len(between) - 1, most - worst - best).round().astype(int)
    return sorted({*order[len(order) - worst :].tolist(), *order[:best].tolist(), *between[places].tolist()})


def draw(
    folder: Path, result: "Evaluation", source: "Source", numbers: Sequence[int], archive: "ResultCache"
) -> None:
    """Draw the metrics, and frames from the best to the worst of the last method."""
    import numpy as np

    from ogm.cli import pictures

    title = f"{source.name}, {result.frames} frames: quartiles, 5 to 95 %, dot and number: mean"
    pictures.metrics_picture(folder / "metrics.png", result, title)
    order = _ranked(result)
    places = np.linspace(0, len(order) - 1, min(ROWS, len(order))).round().astype(int)
    rows = []
    for k in order[places].tolist():
        kept = archive.load(numbers[k])
        if kept is not None:
            panels = pictures.panels_of(kept.views, result, k)
            rows.append((source.frames[numbers[k]].name, panels))
    best = f"frames from the best to the worst of {result.models[-1]}"
    pictures.frames_picture(folder / "frames.png", rows, best)
