"""``ogm simulate``: towns, traffic and lidars to a data set of points with their truth."""

import errno
from collections.abc import Iterable
from contextlib import closing
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn, track

from ogm.cli.console import out, report_errors, stderr

if TYPE_CHECKING:
    from ogm.simulation.farm import Estimate
    from ogm.simulation.plan import Plan
    from ogm.simulation.store import Store


class TruthMode(StrEnum):
    """Ways to look at the truth by their names on the command line."""

    aimed = "aimed"
    hd = "hd"


@report_errors
def simulate(
    path: Annotated[Path | None, typer.Argument(help="Folder for the data set: new, or empty.")] = None,
    samples: Annotated[
        int | None, typer.Option(help="Training samples, 1 Hz from ten drives. [default: 10000]")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Says all that is random. [default: 1]")] = None,
    validation: Annotated[
        int | None, typer.Option(help="Samples of other traffic in the same town. [default: samples / 10]")
    ] = None,
    test: Annotated[
        int | None, typer.Option(help="Samples of another town. [default: samples / 100]")
    ] = None,
    sequences: Annotated[
        int | None, typer.Option(help="Pieces of 10 s at 10 Hz, 100 samples each. [default: 0]")
    ] = None,
    lidar: Annotated[
        str | None,
        typer.Option(help="One lidar, such as vlp-32c, for all samples. [default: a mix, 85 % vlp-32c]"),
    ] = None,
    truth: Annotated[
        TruthMode | None,
        typer.Option(
            help="Look at the truth by rays aimed at every cell, or by the paper's lidar of 3000 layers. "
            "[default: aimed]"
        ),
    ] = None,
    bad_weather: Annotated[
        float | None, typer.Option(help="Share of samples in rain, fog or on wet roads. [default: 0]")
    ] = None,
    in_motion: Annotated[
        float | None, typer.Option(help="Share of samples that the own motion distorts. [default: 0]")
    ] = None,
    towns: Annotated[
        int | None,
        typer.Option(help="Towns for training and validation; that of the test is another. [default: 1]"),
    ] = None,
    town_size: Annotated[float | None, typer.Option(help="Side of the towns [m]. [default: 480]")] = None,
    workers: Annotated[
        int | None, typer.Option(help="Processes on this machine. [default: what cores and memory allow]")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler to use instead, tcp://host:port.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a data set, or let it grow (--samples ...).")
    ] = False,
    preview: Annotated[
        Path | None,
        typer.Option(
            help="Draw one sample to this .png (points, HD points, truth), and the town beside it; alone, "
            "no data set is made."
        ),
    ] = None,
    export: Annotated[
        Path | None, typer.Option(help="Write the data set to this folder too, in the paper's PCD + PNG.")
    ] = None,
) -> None:
    """Make a data set: lidar scans of simulated towns with evidential truth grids.

    Sample i depends on the seed and i alone: the same command gives the same bytes, for any number of workers.
    A run that was stopped goes on with --resume.
    """
    if path is None and (resume or export is not None):
        raise ValueError("--resume and --export want the data set's folder")
    if path is None and preview is None:
        raise ValueError("give a folder for the data set, or --preview PICTURE.png to look at one sample")
    if preview is not None and preview.suffix.lower() != ".png":
        raise ValueError(f"a picture is saved as .png, got --preview {preview}")
    if preview is not None and not preview.parent.is_dir():
        raise FileNotFoundError(
            f"there is no folder {preview.parent} for --preview {preview.name}; create it first"
        )
    if export is not None and export.exists() and not export.is_dir():
        raise ValueError(f"--export writes a folder, but {export} is a file")
    from ogm.simulation.plan import Plan, only
    from ogm.simulation.store import Store

    before = _before(path, resume)
    plan = before or Plan()
    if before is None and samples is not None:
        validation = samples // 10 if validation is None else validation
        test = samples // 100 if test is None else test
    given: dict[str, Any] = {
        "seed": seed,
        "samples": samples,
        "validation": validation,
        "test": test,
        "sequences": sequences,
        "truth": None if truth is None else truth.value,
        "mounts": None if lidar is None else only(lidar),
        "bad_weather": bad_weather,
        "in_motion": in_motion,
        "towns": towns,
        "town_size": town_size,
    }
    plan = replace(plan, **{name: value for name, value in given.items() if value is not None})
    if before is not None:
        plan = plan.grown(before)
    if preview is not None:
        from ogm.simulation import dataset, studio

        dataset.lidars(plan)  # or the complaint that there is no such lidar, before a town is built
        town = preview.with_name(f"{preview.stem}-town.png")
        with stderr.status("building a town ..."):
            studio.preview(preview, town, plan)
        out.print(f"pictures {preview} and {town}", markup=False)
    if path is None:
        return
    try:
        store = _make(path, plan, workers, scheduler)
        _finish(store, path, export)
    except KeyboardInterrupt:
        way = f"finished shards are whole: `ogm simulate {path} --resume` goes on"
        said = way if Store.exists(path) else "the data set was not begun yet"
        stderr.print(f"ogm: interrupted; {said}", markup=False)
        raise typer.Exit(130) from None


def _before(path: Path | None, resume: bool) -> "Plan | None":
    """Return the plan of the data set that is there, if it shall go on."""
    from ogm.simulation.plan import Plan
    from ogm.simulation.store import Store

    if path is None or not Store.exists(path):
        if resume:
            raise FileNotFoundError(
                errno.ENOENT, "no data set to go on with; leave out --resume to begin one", str(path)
            )
        return None
    store = Store.open(path)
    if not resume:
        raise ValueError(f"{path} holds a data set already; --resume goes on with it, or give a new folder")
    return Plan.from_dict(store.plan)


def _make(path: Path, plan: "Plan", workers: int | None, scheduler: str | None) -> "Store":
    from ogm.simulation import dataset, farm

    crew = farm.check_workers(farm.workers_that_fit() if workers is None else workers)
    store = farm.begin(path, plan, dataset.lidars(plan), dataset.versions())
    if store.versions != dataset.versions():
        stderr.print(
            "the data set was begun with other versions of libraries; new samples may differ in detail"
        )
    todo = sum(job.samples for job in farm.jobs(store))
    events = farm.make(
        store, plan, dataset.sample, dataset.threads_per_sample, workers=crew, scheduler=scheduler
    )
    columns = (TextColumn("simulating"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    status = stderr.status("building the town and measuring a sample ...")
    with closing(events):
        with status:
            estimate = next(events, None)
        if isinstance(estimate, farm.Estimate):
            stderr.print(_said(estimate), markup=False)
        with Progress(*columns, console=stderr, transient=True) as progress:
            task = progress.add_task("", total=todo)
            for event in events:
                if isinstance(event, farm.Made):
                    progress.advance(task, event.job.samples)
    return store


def _said(estimate: "Estimate") -> str:
    """Put an estimate in words."""
    minutes = estimate.seconds / 60
    time = (
        f"{estimate.seconds:.0f} s"
        if minutes < 2
        else f"{minutes:.0f} min"
        if minutes < 120
        else f"{minutes / 60:.1f} h"
    )
    by = f"{estimate.workers} worker{'s' if estimate.workers > 1 else ''}"
    return (
        f"{estimate.samples} samples: about {time} with {by} ({estimate.per_sample:.2f} s each), "
        f"{estimate.size / 1e6:.0f} MB ({estimate.size / estimate.samples / 1e3:.0f} kB each)"
    )


def _finish(store: "Store", path: Path, export: Path | None) -> None:
    """Draw the contact sheet, export, and say what there is."""
    from ogm.cli.console import print_facts
    from ogm.simulation import exchange
    from ogm.simulation.preview import contact_sheet

    sheet = path / "contact-sheet.png"
    contact_sheet(sheet, store)
    if export is not None:

        def ticked(numbers: Iterable[int], name: str) -> Iterable[int]:
            return track(numbers, f"exporting {name}", console=stderr, transient=True)

        exchange.export(store, export, tick=ticked)
    facts = store.describe()
    shown = ("training", "validation", "test", "sequences", "size")
    print_facts({name: facts[name] for name in shown if not facts.get(name, "0").startswith("0 ")})
    out.print(f"data set {path}   contact sheet {sheet}", markup=False)
    if export is not None:
        out.print(f"exported to {export}", markup=False)
