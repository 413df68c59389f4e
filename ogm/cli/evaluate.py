"""``ogm evaluate``: sensor models against the truth of a data set, frame by frame."""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import track

from ogm.cli.console import complaints, out, tidy

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ogm.grid import GridSpec, InverseSensorModel
    from ogm.metrics import Evaluation, ModelFor
    from ogm.simulation.store import Split, Store

GEOMETRIC = ("height-band", "height-band-released", "ray")
OWN_BOX = (-2.5, 2.5, -1.1, 1.1)  # [m] the own vehicle around the sensor, the same for all geometric models
FRAMES = 6  # rows of the contact sheet


@tidy
def evaluate(
    data: Annotated[Path, typer.Argument(help="Data set that `ogm simulate` made.", metavar="DATA")],
    more: Annotated[
        list[str] | None, typer.Argument(help="Further models, after --ism NAME.", metavar="[NAME]...")
    ] = None,
    ism: Annotated[
        list[str] | None,
        typer.Option(
            help="Models: height-band, height-band-released, ray, lite, or weights that `ogm train` wrote "
            "(a file or a run's folder). [default: height-band ray lite]",
            metavar="NAME [NAME]...",
        ),
    ] = None,
    split: Annotated[str, typer.Option(help="Part of the data set.")] = "validation",
    samples: Annotated[
        int | None, typer.Option(help="Samples, drawn at random from the part. [default: all]")
    ] = None,
    seed: Annotated[int, typer.Option(help="Says which samples and which bootstrap draws.")] = 0,
    out_folder: Annotated[
        Path, typer.Option("--out", help="Folder for report.json, metrics.png, frames.png.")
    ] = Path("report"),
) -> None:
    """Judge sensor models on the same scans: how far from the truth, how well calibrated, who wins how often.

    Cells that the truth ignores are left out. Every model is told the sensor's height and tilt and where the own
    vehicle is, but for height-band-released, which has its own numbers built in. What stands behind +- is half
    of the 95 % bootstrap interval of the mean over frames.
    """
    import numpy as np

    from ogm.cli.report import print_tables, report, write_report
    from ogm.grid import GridSpec
    from ogm.metrics import evaluate as judge
    from ogm.simulation.store import Store

    names = [*(ism or []), *(more or [])] or ["height-band", "ray", "lite"]
    spec = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
    store = Store.open(data)
    part, numbers = _samples(store, split, samples, seed)
    models = models_of(names, spec)
    if out_folder.exists() and not out_folder.is_dir():
        raise ValueError(f"--out writes a folder, but {out_folder} is a file")
    out_folder.mkdir(parents=True, exist_ok=True)

    ticked = track(numbers.tolist(), "judging", console=complaints, transient=True)
    result = judge(models, (part[k] for k in ticked), spec)
    with complaints.status("writing the report ..."):
        rng = np.random.default_rng(seed)
        record = report(result, rng) | {
            "weights": {name: weights_facts(given) for name, given in zip(models, names, strict=True)},
            "data": {"plan": store.plan, "versions": store.versions, "split": split},
            "samples": numbers.tolist(),
            "seed": seed,
        }
        write_report(out_folder / "report.json", record)
        draw(out_folder, result, models, part, numbers)
    print_tables(result, record, f"{split}, {result.frames} frames")
    written = "   ".join(str(out_folder / name) for name in ("report.json", "metrics.png", "frames.png"))
    out.print(f"written {written}", markup=False, soft_wrap=True)


def models_of(names: Sequence[str], spec: "GridSpec") -> dict[str, "InverseSensorModel | ModelFor"]:
    """Return models by their names: those of the command line, or paths of weights.

    Parameters
    ----------
    names : sequence of str
    spec : GridSpec
        The cells to fill.

    Raises
    ------
    ValueError
        If a name is unknown or given twice.
    FileNotFoundError
        If there are no such weights.
    """
    models: dict[str, InverseSensorModel | ModelFor] = {}
    for name in names:
        path = Path(name)  # of a run, best.safetensors and so on go by the run's name
        shown = path.name.removesuffix(".safetensors")
        shown = path.parent.name if shown == "best" and path.parent.name else shown
        shown = name if name in GEOMETRIC else shown
        if shown in models:
            shown = name  # two runs have each a best.safetensors
        if shown in models:
            raise ValueError(f"{name} is given twice; give each model once")
        models[shown] = _geometric(name, spec) if name in GEOMETRIC else _deep(name, spec)
    return models


def weights_facts(name: str) -> dict[str, str] | None:
    """Return the name and the SHA-256 of the weights that a name means; None for a geometric model."""
    if name in GEOMETRIC:
        return None
    from ogm.deep.ism import weights_of

    with weights_of(name) as path:
        return {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}


def _geometric(name: str, spec: "GridSpec") -> "InverseSensorModel | ModelFor":
    from ogm.geometric import HeightBandISM, RayISM
    from ogm.grid import GridSpec

    if name == "height-band-released":  # its mount is built in, its cells are twice as wide
        nx, ny = spec.shape
        return HeightBandISM.as_released(GridSpec(2 * spec.resolution, (nx // 2, ny // 2), spec.origin))
    model = RayISM if name == "ray" else HeightBandISM

    def of(T: "NDArray[np.float64]") -> "InverseSensorModel":
        return model(spec, T[2, 3], T_vehicle_sensor=T, own_box=OWN_BOX)

    return of


def _deep(name: str, spec: "GridSpec") -> "ModelFor":
    if name.isidentifier() and not Path(name).exists() and name != "lite":
        raise ValueError(
            f"there is no model {name!r}; there are {', '.join(GEOMETRIC)}, lite, and weights by their path"
        )
    from ogm.deep.checkpoint import load_network
    from ogm.deep.ism import DeepISM, weights_of

    with weights_of(name) as path:
        network, description = load_network(path)

    def of(T: "NDArray[np.float64]") -> "InverseSensorModel":
        return DeepISM(
            network, spec=spec, sensor_height=float(T[2, 3]), T_vehicle_sensor=T, description=description
        )

    return of


def _samples(store: "Store", split: str, count: int | None, seed: int) -> tuple["Split", "NDArray[np.int64]"]:
    """Return the part of the data set and the numbers of its samples to judge."""
    import numpy as np

    if split not in store.counts:
        raise ValueError(f"{store.path} has no split {split!r}; it has {', '.join(store.counts)}")
    part = store[split]
    numbers = part.finished
    if not len(numbers):
        way = f"; go on with `ogm simulate {store.path} --resume`" if len(part) else ""
        raise ValueError(f"{store.path} has no sample of {split}{way}")
    if count is None:
        return part, numbers
    if not 1 <= count <= len(numbers):
        raise ValueError(f"--samples must be in 1 ... {len(numbers)}, what {split} has, got {count}")
    return part, np.sort(np.random.default_rng(seed).choice(numbers, count, replace=False))


def draw(
    folder: Path,
    result: "Evaluation",
    models: Mapping[str, "InverseSensorModel | ModelFor"],
    part: "Split",
    numbers: "NDArray[np.int64]",
) -> None:
    """Draw the metrics, and frames from the best to the worst of the last model."""
    from ogm.cli import pictures

    title = f"{part.name}, {result.frames} frames: quartiles, 5 to 95 %, dot and number: mean"
    pictures.metrics_picture(folder / "metrics.png", result, title)
    rows = [
        (name, frame_panels(part[int(numbers[k])], models, result, k))
        for k, name in _chosen(result, part.name, numbers)
    ]
    best = f"frames from the best to the worst of {result.models[-1]} by kl_e10"
    pictures.frames_picture(folder / "frames.png", rows, best)


def _chosen(result: "Evaluation", split: str, numbers: "NDArray[np.int64]") -> Iterable[tuple[int, str]]:
    """Return frames spread evenly over the ranks of the last model, and their names."""
    import numpy as np

    order = np.argsort(result.of(result.models[-1], "kl_e10"), kind="stable")
    places = np.linspace(0, len(order) - 1, min(FRAMES, len(order))).round().astype(int)
    return [(int(k), f"{split} {numbers[k]}") for k in order[places]]


def frame_panels(
    sample: Any, models: Mapping[str, "InverseSensorModel | ModelFor"], result: "Evaluation", frame: int
) -> list[Any]:
    """Draw points, truth and every model's grid of one frame."""
    from ogm import plot
    from ogm.metrics.evaluation import model_for
    from ogm.simulation.preview import sample_panels

    panels = list(sample_panels(sample, result.spec))
    for name, model in models.items():
        grid = model_for(model, sample)(sample.points)
        panels.append(plot.masses(grid, f"{name}, KL {result.of(name, 'kl_e10')[frame]:.2f}"))
    return panels
