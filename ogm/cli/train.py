"""``ogm train`` and ``ogm export``: a data set to a network's weights, and those to ONNX."""

import logging
import os
import warnings
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ogm.cli.console import out, print_facts, report_errors, stderr

if TYPE_CHECKING:
    from ogm.simulation.store import Store


class Preset(StrEnum):
    """Networks and recipes by their names on the command line."""

    lite = "lite"
    paper = "paper"
    published = "published"


class LossName(StrEnum):
    """Losses by their names on the command line."""

    reverse_kl = "reverse-kl"
    squares_printed = "squares-printed"
    squares_released = "squares-released"
    log = "log"
    digamma = "digamma"


@report_errors
def train(
    data: Annotated[Path, typer.Argument(help="Data set that `ogm simulate` made.")],
    model: Annotated[
        Preset,
        typer.Option(
            help="lite: small, for CPUs. paper: PointPillars, our recipe. published: the same by the paper's recipe "
            "(100 epochs, batch 5, squared error, occupied cells x 100, rotation only)."
        ),
    ] = Preset.lite,
    out_folder: Annotated[
        Path | None, typer.Option("--out", help="The run's folder. [default: runs/MODEL]")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where the run in --out stopped.")] = False,
    epochs: Annotated[int | None, typer.Option(help="Times that every sample is seen.")] = None,
    batch: Annotated[int | None, typer.Option(help="Samples per step and device.")] = None,
    learning_rate: Annotated[float | None, typer.Option(help="Largest step of AdamW.")] = None,
    loss: Annotated[LossName | None, typer.Option(help="What is minimised; see docs/deep.md.")] = None,
    samples: Annotated[int | None, typer.Option(help="Use so many training samples. [default: all]")] = None,
    seed: Annotated[int | None, typer.Option(help="Of weights, order and augmentation.")] = None,
    length: Annotated[float, typer.Option(help="Extent of the grid along x [m].")] = 81.92,
    width: Annotated[float, typer.Option(help="Extent of the grid along y [m].")] = 56.32,
    resolution: Annotated[float, typer.Option(help="Side of a cell [m].")] = 0.16,
    accelerator: Annotated[str, typer.Option(help="cpu, cuda or auto.")] = "auto",
    devices: Annotated[int, typer.Option(help="Accelerators, or processes, per machine.")] = 1,
    nodes: Annotated[int, typer.Option(help="Machines; start the command on each, as Lightning asks.")] = 1,
    precision: Annotated[
        str | None,
        typer.Option(help="32-true or bf16-mixed. [default: bf16-mixed on CUDA devices, else 32-true]"),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="Processes that prepare samples. [default: half the cores, 12 at most]")
    ] = None,
) -> None:
    """Train a network on simulated scans.

    Writes best.safetensors and best.json (weights, recipe, provenance), log.csv, a picture per epoch, and state.pt
    every two minutes, from which --resume goes on.
    """
    from ogm.deep import recipe as recipes  # first: it says what to install if torch is missing
    from ogm.deep import train as training
    from ogm.deep.network import PAPER
    from ogm.grid import GridSpec
    from ogm.simulation.store import Store

    spec = GridSpec.centered(length=length, width=width, resolution=resolution)
    recipe = {
        Preset.lite: recipes.LITE_RECIPE,
        Preset.paper: recipes.Recipe(PAPER),
        Preset.published: recipes.PAPER_RECIPE,
    }[model]
    given: dict[str, Any] = {
        "epochs": epochs,
        "batch": batch,
        "learning_rate": learning_rate,
        "loss": None if loss is None else loss.value,
        "seed": seed,
    }
    recipe = replace(recipe, **{name: value for name, value in given.items() if value is not None})
    folder = Path("runs") / model.value if out_folder is None else out_folder
    from torch.utils.data import Subset

    if seed is not None and seed < 0:
        raise ValueError(f"--seed must be at least 0, got {seed}")
    store = Store.open(data)
    splits = {name: _whole(store, name) for name in ("training", "validation")}
    if samples is not None:
        if not 1 <= samples <= len(splits["training"]):
            raise ValueError(
                f"--samples must be 1 to {len(splits['training'])}, which are there, got {samples}"
            )
        splits["training"] = splits["training"][:samples]
    _quiet()
    try:
        path = training.train(
            Subset(store["training"], splits["training"]),
            Subset(store["validation"], splits["validation"]),
            spec,
            folder,
            recipe,
            resume=resume,
            accelerator=accelerator,
            devices=devices,
            nodes=nodes,
            precision=precision or training.usual_precision(accelerator),
            workers=training.usual_workers() if workers is None else workers,
            facts=_provenance(store, splits),
        )
    except KeyboardInterrupt:
        saved = "the run is saved: the same command with --resume goes on"
        said = saved if (folder / "state.pt").exists() else "nothing was saved yet"
        stderr.print(f"ogm: interrupted; {said} in {folder}", markup=False)
        raise typer.Exit(130) from None
    except FloatingPointError as error:
        stderr.print(f"ogm: {error}", markup=False)
        raise typer.Exit(1) from None
    if os.environ.get("LOCAL_RANK", "0") == "0":  # Lightning starts this command once per device
        out.print(f"weights {path}   curve {folder / 'log.csv'}", markup=False)


@report_errors
def export(
    source: Annotated[str, typer.Argument(help="lite, a run's folder, or a .safetensors file.")] = "lite",
    out_path: Annotated[Path, typer.Option("--out", help="The file to write, .onnx.")] = Path("ogm.onnx"),
) -> None:
    """Write a network as ONNX: the points' features and cells in, belief masses out."""
    from ogm.deep.checkpoint import load_network
    from ogm.deep.export import export_onnx
    from ogm.deep.ism import weights_of

    with weights_of(source) as path:
        network, _ = load_network(path)
    _quiet()
    with stderr.status("exporting ..."):
        facts = export_onnx(network, out_path)
    print_facts({"file": str(out_path), **facts})


def _whole(store: "Store", name: str) -> list[int]:
    """Return the numbers of a split's finished samples, and say if some are missing."""
    if name not in store.counts:
        raise ValueError(
            f"{store.path} has no samples for {name}; `ogm simulate` makes them (--validation 30)"
        )
    finished = store[name].finished.tolist()
    if len(finished) < store.counts[name]:
        stderr.print(
            f"ogm: {len(finished)} of {store.counts[name]} {name} samples are made; "
            f"`ogm simulate {store.path} --resume` makes the rest",
            markup=False,
        )
    return finished


def _provenance(store: "Store", splits: dict[str, list[int]]) -> dict[str, Any]:
    """Return what the weights' description says of the data."""
    return {
        "data": {
            "plan": store.plan,
            "samples": {name: len(numbers) for name, numbers in splits.items()},
            "versions": store.versions,
        },
    }


def _quiet() -> None:
    """Keep the libraries' advice off the screen."""
    warnings.filterwarnings("ignore", module=r"(lightning|torch)(\.|$)")
    for name in ("lightning", "lightning.fabric", "torch.onnx", "lightning.pytorch"):
        logging.getLogger(name).setLevel(logging.ERROR)
