"""``ogm simulate``: make a dataset of lidar scans with truth, from simulated towns and traffic."""

import errno
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from typer import Argument, Option

from ogm.cli.console import out, print_facts, progress_bar, report_errors, stderr, ticked

if TYPE_CHECKING:
    from ogm.simulation.plan import DatasetPlan
    from ogm.simulation.store import Store
    from ogm.simulation.workers import Estimate, Made


TruthMode = Literal["aimed", "hd", "none"]


@report_errors
def simulate(
    path: Annotated[Path | None, Argument(help="Folder for the dataset: new, or empty.")] = None,
    samples: Annotated[int | None, Option(help="Training samples, from --drives in turn. [default: 10000]")] = None,
    recipe: Annotated[
        str | None,
        Option(
            help="gen2: 4800 samples in 69 towns with country roads, many lidars, faults, weather; gen3: also crowds, "
            "sensors of few layers. Sets all options except seed, sizes and truth. [default: the paper's recipe]"
        ),
    ] = None,
    seed: Annotated[int | None, Option(help="Random seed. [default: 1]")] = None,
    validation: Annotated[int | None, Option(help="Samples of other traffic. [default: samples / 10, or 1]")] = None,
    test: Annotated[int | None, Option(help="Test samples, in another town. [default: samples / 100]")] = None,
    sequences: Annotated[int | None, Option(help="Sequences of 10 s at 10 Hz, 100 samples each. [default: 0]")] = None,
    lidar: Annotated[
        str | None,
        Option(
            help="Sensor of all samples: a lidar (vlp-32c), planar laser (utm-30lx, lds-01) or depth camera (d435), "
            "optionally with its height [m] (utm-30lx@0.5). [default: a mix of lidars, 85 % vlp-32c]",
            metavar="NAME[@HEIGHT]",
        ),
    ] = None,
    radar: Annotated[
        list[str] | None,
        Option(
            help="Additional radar: ars408, ars548 (in front), corner (one at each), or with a place, such as "
            "ars408@rear; may be repeated. [default: none]"
        ),
    ] = None,
    truth: Annotated[
        TruthMode | None,
        Option(
            help="Observe the truth by rays aimed at every cell (aimed), or by the paper's lidar of 3000 layers (hd). "
            "none makes scans without truth, for maps, in a sixth of the time. [default: aimed]"
        ),
    ] = None,
    bad_weather: Annotated[float | None, Option(help="Share of rain, fog or wet roads. [default: 0]")] = None,
    in_motion: Annotated[float | None, Option(help="Share of samples distorted by ego motion. [default: 0]")] = None,
    towns: Annotated[int | None, Option(help="Towns for training and validation. [default: 1]")] = None,
    test_towns: Annotated[int | None, Option(help="Towns for test samples. [default: 1]")] = None,
    drives: Annotated[int | None, Option(help="Drives per split, 10 samples each in turn. [default: 10]")] = None,
    spacing: Annotated[float | None, Option(help="Time between the samples of a drive [s]. [default: 1]")] = None,
    town_size: Annotated[float | None, Option(help="Side of the towns [m]. [default: 480]")] = None,
    workers: Annotated[int | None, Option(help="Number of processes. [default: by cores and memory]")] = None,
    scheduler: Annotated[str | None, Option(help="Use a Dask cluster instead: tcp://host:port.")] = None,
    resume: Annotated[bool, Option("--resume", help="Resume a dataset, or enlarge it (--samples ...).")] = False,
    preview: Annotated[
        Path | None,
        Option(
            help="Draw one sample to this .png (points, HD points, truth), and its town to a second one; without a "
            "folder, no dataset is made."
        ),
    ] = None,
    export: Annotated[Path | None, Option(help="Folder for a copy in the paper's format, PCD + PNG.")] = None,
) -> None:
    """Make a dataset: lidar scans of simulated towns with evidential truth grids.

    Sample i depends only on the seed and i: the same command gives the same bytes, for any number of workers.
    --resume continues an interrupted run.
    """
    _check_paths(path, resume, preview, export)
    from ogm.simulation.mounts import radars_at, single_sensor
    from ogm.simulation.plan import DatasetPlan

    before = None if path is None else _plan_of(path, resume)
    options = {
        **{"recipe": recipe, "seed": seed, "samples": samples, "validation": validation, "test": test},
        **{"sequences": sequences, "truth": truth, "bad_weather": bad_weather, "in_motion": in_motion},
        **{"towns": towns, "test_towns": test_towns, "drives": drives, "spacing": spacing, "town_size": town_size},
        **{"mounts": lidar and single_sensor(lidar), "radars": radar and radars_at(radar)},
    }
    plan = DatasetPlan.from_options(before, **{name: value for name, value in options.items() if value is not None})  # type: ignore[arg-type]
    if preview is not None:
        _preview(preview, plan)
    if path is None:
        return
    try:
        store = _make(path, plan, workers, scheduler, resume)
        _finish(store, path, export)
    except KeyboardInterrupt:
        from ogm.simulation.store import Store

        way = f"finished shards are complete: `ogm simulate {path} --resume` continues"
        message = way if Store.exists(path) else "the dataset was not begun yet"
        stderr.print(f"ogm: interrupted; {message}", markup=False)
        raise typer.Exit(130) from None


def _check_paths(path: Path | None, resume: bool, preview: Path | None, export: Path | None) -> None:
    """Raise an error if paths do not fit together, before slow work."""
    if path is None and (resume or export is not None):
        raise ValueError("--resume and --export need the dataset's folder")
    if path is None and preview is None:
        raise ValueError("give a folder for the dataset, or --preview PICTURE.png for pictures of one sample")
    if preview is not None and preview.suffix.lower() != ".png":
        raise ValueError(f"--preview must end in .png, got {preview}")
    if preview is not None and not preview.parent.is_dir():
        raise FileNotFoundError(f"there is no folder {preview.parent} for --preview {preview.name}; create it first")
    if export is not None and export.exists() and not export.is_dir():
        raise ValueError(f"--export writes a folder, but {export} is a file")


def _plan_of(path: Path, resume: bool) -> "DatasetPlan | None":
    """Return the plan of the dataset to resume; None for a new dataset."""
    from ogm.simulation.plan import DatasetPlan
    from ogm.simulation.store import Store

    if Store.exists(path):
        store = Store.open(path)
        if not resume:
            raise ValueError(f"{path} contains a dataset already; give --resume to continue it, or a new folder")
        return DatasetPlan.from_dict(store.plan)
    if resume:
        raise FileNotFoundError(errno.ENOENT, "no dataset to resume; leave out --resume to begin one", str(path))
    return None


def _preview(picture: Path, plan: "DatasetPlan") -> None:
    from ogm.simulation import dataset, studio

    dataset.lidars(plan)  # an unknown lidar is refused before a town is built
    town = picture.with_name(f"{picture.stem}-town.png")
    with stderr.status("building a town ..."):
        studio.preview(picture, town, plan)
    out.print(f"pictures {picture} and {town}", markup=False)


def _make(path: Path, plan: "DatasetPlan", workers: int | None, scheduler: str | None, resume: bool) -> "Store":
    """Make the samples, with a progress bar."""
    from ogm.simulation import dataset
    from ogm.simulation import workers as crew

    with progress_bar() as display:
        task = display.add_task("building the town and measuring a sample ...", total=None)

        def show(event: "Estimate | Made") -> None:
            if isinstance(event, crew.Made):
                display.advance(task, event.job.samples)
            else:
                stderr.print(str(event), markup=False)
                display.update(task, description="simulating", total=event.samples)

        return dataset.simulate(path, plan, workers=workers, scheduler=scheduler, resume=resume, progress=show)


def _finish(store: "Store", path: Path, export: Path | None) -> None:
    """Draw the contact sheet, export the dataset, and print its contents."""
    from ogm.simulation import exchange
    from ogm.simulation.exchange import contact_sheet

    sheet = path / "contact-sheet.png"
    contact_sheet(sheet, store)
    if export is not None:
        exchange.export(store, export, tick=lambda numbers, name: ticked(numbers, f"exporting {name}"))
    facts = store.describe()
    shown = ("training", "validation", "test", "sequences", "radars", "size")
    print_facts({name: facts[name] for name in shown if not facts.get(name, "0 ").startswith("0 ")})
    out.print(f"dataset {path}   contact sheet {sheet}", markup=False)
    if export is not None:
        out.print(f"exported to {export}", markup=False)
