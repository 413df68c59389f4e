"""``ogm evaluate``: compare sensor models, maps and precomputed grids with the truth, frame by frame."""

import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from rich.text import Text
from typer import Argument, Option

from ogm.cli.console import chosen_model, distinct, number_table, out, printable, report_errors, stderr, ticked
from ogm.cli.evaluate_agreement import evaluate_dataset_agreement
from ogm.cli.evaluate_beams import evaluate_dataset_beams
from ogm.cli.options import (
    First,
    FixedFrame,
    FolderAxes,
    Kerbs,
    Scheduler,
    Sensor,
    Topic,
    TruthSources,
    Workers,
    check_first,
    parsed_axes,
)
from ogm.cli.sensor_options import SensorOptions, sensor_options
from ogm.evidence.map_rules import MAP_RULES
from ogm.grid import GridSpec
from ogm.scan import Frame
from ogm.storage.locks import locked
from ogm.storage.remote import as_path

MODELS = ("height-band", "ray", "lite")  # evaluated with the default of other commands
PRINTED = (
    "nll", "brier", "iou_free", "iou_occupied", "iou_unknown", "iou_free_known", "iou_occupied_known",
    "false_free", "missed_occupied", "from50_false_free", "from50_missed_occupied", "ece", "ece_relative",
    "auroc_unknown", "mean_unknown", "kl_e10", "kl_e1", "kl_e1_scaled", "legacy_kl",
)  # fmt: skip
COMPARED = (
    "nll", "brier", "iou_free", "iou_occupied", "false_free", "missed_occupied", "ece", "ece_relative", "kl_e10",
    "kl_e1", "kl_e1_scaled", "legacy_kl",
)  # fmt: skip
BRIEF = ("nll", "brier", "iou_free", "iou_occupied", "false_free", "ece")  # printed for more than `MAX_COLUMNS` methods
MAX_COLUMNS = 6  # methods with a column each


Data = Annotated[
    Any,
    Argument(
        parser=as_path,
        help="Dataset with truth: a recording (KITTI, SemanticKITTI, nuScenes, Argoverse 2, ...), a dataset of "
        "`ogm simulate` (also s3://bucket/data), or a folder of truth grids.",
        metavar="DATA",
    ),
]
Fused = Annotated[
    str | None, Option(help=f"Also evaluate models fused over time: {', '.join(MAP_RULES)}.", metavar="RULE[,RULE]...")
]


Beams = Annotated[
    bool,
    Option("--beams", help="Evaluate planar maps without truth, by the beams of every 5th scan, held out in turn."),
]
Agreement = Annotated[
    bool, Option("--agreement", help="Compare methods without truth, by agreement, conflict and KL in both directions.")
]
SideOfCell = Annotated[
    float | None, Option("--resolution", help="With --beams: side of a cell [m]. [default: 0.05]", metavar="M")
]


@report_errors
@sensor_options
def evaluate(
    data: Data,
    more: Annotated[list[str] | None, Argument(help="Further models, after --ism NAME.", metavar="[NAME]...")] = None,
    ism: Annotated[
        list[str] | None,
        Option(
            help="Models: height-band, height-band-released, ray, lite, combined, radar, weights of `ogm "
            "train` (a file or a run's folder), or the .json of `ogm calibrate`. [default: height-band ray lite "
            "combined; planar or depth for such sensors; none with --grids]",
            metavar="NAME [NAME]...",
        ),
    ] = None,
    fused: Fused = None,
    beams: Beams = False,
    agreement: Agreement = False,
    resolution: SideOfCell = None,
    grids: Annotated[
        list[Path] | None,
        Option(help="Folder of precomputed grids (.npz, .npy, .png) named after the frames; may be repeated."),
    ] = None,
    resample: Annotated[
        Literal["area", "nearest", "cautious"] | None, Option(help="Resample other cells of --grids. [default: refuse]")
    ] = None,
    split: Annotated[
        str | None,
        Option(
            help="Part of a simulated dataset: train, val, test or sequences. [default: val, or the first part with "
            "samples; sequences with --fused]"
        ),
    ] = None,
    truth: TruthSources = None,
    kerbs: Kerbs = "ignore",
    axes: FolderAxes = "flu",
    topic: Topic = None,
    fixed_frame: FixedFrame = None,
    sensor: Sensor = None,
    sensors: SensorOptions = SensorOptions(),  # noqa: B008  it is immutable
    first: First = None,
    samples: Annotated[int | None, Option(help="Number of frames, drawn at random. [default: all]")] = None,
    every: Annotated[int, Option(help="Evaluate every N-th frame; maps fuse all.", metavar="N")] = 1,
    frames: Annotated[int, Option(help="Number of frames with pictures in the report.")] = 100,
    seed: Annotated[int, Option(help="Random seed of --samples.")] = 0,
    workers: Workers = 1,
    scheduler: Scheduler = None,
    out_folder: Annotated[Path, Option("--out", help="Folder for the report, its figures and tables.")] = Path(
        "report"
    ),
) -> None:
    """Evaluate sensor models, maps and precomputed grids on the same frames, and write a report.

    Metrics measure the distance from the truth, calibration, safety, and how often each method wins. Ignored cells of
    the truth are left out; on recordings these are all cells without a label. Every model gets the sensor's height
    and tilt and the ego footprint, except height-band-released, with fixed values. With --fused, unobserved cells of a
    simulated frame are left out too, as a map may know them, and the aggregated truth of a recording is made only from
    later scans, which are not yet in the map.
    The number after +- is half of the 95 % interval of the mean over drives, or over parts of one long drive, as
    scans of a drive are alike. It needs four drives or more.

    With --beams, the models (by default planar) are fused by the rules of --fused (by default smooth) into maps without
    forgetting, and tested by the beams of scans that are not in the map. Recordings need poses, but no truth.

    With --agreement, methods are compared pair by pair on the same frames; agreement.json contains every frame.

    Finished frames are kept in the folder frames of --out: repeat the command to resume an interrupted run, with any
    number of --workers. Workers share the frames, or with --fused the drives. Workers of --scheduler need DATA and
    --out under the same paths.
    """
    from ogm.datasets import SOURCES, open_dataset
    from ogm.evaluation import evaluate as run_evaluation
    from ogm.evaluation import write_report
    from ogm.evaluation.runner import REPORT_FILES, choose_frames, named_methods
    from ogm.extras import import_extra
    from ogm.workflows.buildings import first_readable

    for package in ("scipy", "matplotlib"):  # before hours of work
        import_extra(package, "evaluate")
    rules = _words(fused, "--fused", MAP_RULES)
    sources = _words(truth, "--truth", SOURCES)
    check_first(first)
    if frames < 1:
        raise ValueError(f"--frames must be at least 1, got {frames}")
    if beams and agreement:
        raise ValueError("--beams and --agreement exclude each other; give one of them")
    unused = {"truth": truth, "scheduler": scheduler}
    if beams:
        _check_needless(
            "--beams needs no truth and evaluates maps of models",
            grids=grids,
            resample=resample,
            split=split,
            samples=samples,
            **unused,
        )
    elif resolution is not None:
        raise ValueError("--resolution needs --beams: other evaluations use cells of 0.16 m")
    if agreement:
        _check_needless("--agreement needs no truth and compares methods with each other", **unused)
    spec = GridSpec.centered()
    names = [*(ism or []), *(more or [])]
    if rules and grids and not names and not beams:
        raise ValueError("--fused fuses the scans of models; give --ism NAME too")
    others = "later" if rules else "all"
    log = {"topic": topic or (), "frame": fixed_frame, "sensors": sensor or ()}
    dataset = open_dataset(
        data,
        axes=parsed_axes(axes),
        split=split,
        default_split="sequences" if rules or beams else None,
        truth=tuple(sources),
        others=others,
        kerbs=kerbs,
        spec=spec,
        **log,  # type: ignore
        **sensors._asdict(),
    )
    dataset = dataset[:first]
    if beams:
        evaluate_dataset_beams(dataset, names, rules, resolution, out_folder)
        return
    names = names or ([] if grids else usual_models(spec, first_readable(dataset)))
    numbers = choose_frames(dataset, samples, every, seed, truth=not agreement)
    methods = named_methods(names, rules, grids or [], spec, resample)
    if agreement:
        evaluate_dataset_agreement(dataset, methods, spec, numbers, out_folder)
        return
    result = run_evaluation(
        methods,
        dataset,
        spec,
        frames=numbers,
        out=out_folder,
        workers=workers,
        scheduler=scheduler,
        progress=lambda k: ticked(k, "evaluating (the first frame compiles kernels)"),
    )
    if result.reused:
        stderr.print(
            f"ogm: {result.reused} of {len(numbers)} frames were finished before and are reused from {out_folder}"
        )
    with locked(out_folder), stderr.status("writing the report ..."):
        command = shlex.join(["ogm", *sys.argv[1:]])
        record = write_report(out_folder, result, command=command, pictured=frames)
    _print_tables(record, f"{dataset.name}, {record['extent']}")
    _print_motion(record)
    written = "   ".join(str(out_folder / name) for name in REPORT_FILES)
    out.print(f"written {written}", markup=False, soft_wrap=True)


def usual_models(spec: GridSpec, frame: Frame | None) -> list[str]:
    """Return the default models of an evaluation.

    For planar lasers, sonars and depth cameras this is the model for the kind of the first scan, else geometric models
    and the default of other commands.
    """
    from ogm.models.named import RAY, for_all_kinds, part_for

    if frame is not None and (part := part_for(for_all_kinds(RAY), frame.scan)) != RAY:
        return [part]
    usual = chosen_model(None, spec).partition("+")[0]
    return list(MODELS[:2]) if usual in MODELS else [*MODELS, usual]


def _check_needless(purpose: str, **options: Any) -> None:
    """Raise a ValueError for options without use in an evaluation without truth."""
    given = [f"--{name}" for name, value in options.items() if value is not None]
    if given:
        raise ValueError(f"{purpose}: leave out {', '.join(given)}")


def _words(given: str | None, option: str, choices: Sequence[str]) -> list[str]:
    """Return the distinct values of an option with commas."""
    values = [value.strip() for value in (given or "").split(",") if value.strip()]
    for value in values:
        if value not in choices:
            raise ValueError(f"{option} takes {', '.join(choices)}, got {value!r}")
    if given is not None and not values:
        raise ValueError(f"{option} needs one or more of {', '.join(choices)}")
    return list(dict.fromkeys(values))


def _print_tables(record: Mapping[str, Any], title: str) -> None:
    """Print the means of all methods, and pairwise comparisons of the last method."""
    names = list(record["methods"])
    out.print(printable(f"Means over {title}"), markup=False, soft_wrap=True)
    if len(names) <= MAX_COLUMNS:
        table = number_table("", *distinct(names))
        for metric in PRINTED:
            table.add_row(_heading(record, metric), *_column(record, metric))
    else:
        table = number_table("", *(_heading(record, metric) for metric in BRIEF))
        columns = [_column(record, metric) for metric in BRIEF]
        for name, *row in zip(names, *columns, strict=True):
            table.add_row(Text(printable(name)), *row)
    out.print(table)
    legend = f"- lower, + higher is better; +- half of the interval: {record['intervals']}"
    out.print(f"({legend}; report.html describes the metrics)", soft_wrap=True)
    for name in [pair for pair in record["paired"] if pair.startswith(f"{names[-1]} against ")][-MAX_COLUMNS:]:
        out.print(printable(f"\n{name}"), markup=False, soft_wrap=True)
        table = number_table("", "wins", "ties", "losses", "ratio of means")
        for metric in COMPARED:
            paired = record["paired"][name][metric]
            counts = (str(paired[key]) for key in ("wins", "ties", "losses"))
            table.add_row(record["metrics"][metric]["title"], *counts, _interval(paired["ratio"]))
        out.print(table)


def _print_motion(record: Mapping[str, Any]) -> None:
    """Print motion metrics over the cells of all frames, for methods with dynamic grids."""
    from ogm.evaluation.motion import MOTION_HEADLINE

    motion = record["motion"]
    if motion is None:
        return
    out.print("\nMotion of cells occupied in the scans, all frames together", soft_wrap=True)
    table = number_table("", *distinct(list(motion["methods"])))
    for metric in MOTION_HEADLINE:
        values = [method["micro"][metric] for method in motion["methods"].values()]
        cells = ["no value" if value is None else f"{value:.3f}" for value in values]
        table.add_row(_heading(motion, metric), *cells)
    out.print(table)


def _heading(record: Mapping[str, Any], metric: str) -> str:
    entry = record["metrics"][metric]
    return f"{ {'lower': '-', 'higher': '+', '': ' '}[entry['better']] } {entry['title']}"


def _column(record: Mapping[str, Any], metric: str) -> list[Text]:
    """Return a metric of all methods, the best value in bold."""
    from ogm.evaluation.summary import best_value

    row, best = [method["macro"][metric] for method in record["methods"].values()], best_value(record, metric)
    return [Text(_interval(interval), "bold" if interval["value"] == best else "") for interval in row]


def _interval(interval: Mapping[str, float | None]) -> str:
    value, low, high = (interval[key] for key in ("value", "low", "high"))
    if value is None:
        return "no value"
    kind = ".3f" if abs(value) < 1e5 else ".3g"
    return f"{value:{kind}}" if low is None or high is None else f"{value:{kind}} +-{(high - low) / 2:{kind}}"
