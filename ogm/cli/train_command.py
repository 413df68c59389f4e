"""``ogm train`` and ``ogm export``: train a network on a dataset, and write a network as ONNX."""

import importlib
import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Argument, Option

from ogm.cli.console import out, print_facts, report_errors, stderr
from ogm.storage.remote import as_path

if TYPE_CHECKING:
    from ogm.datasets import Dataset
    from ogm.deep.network import PillarNetwork


RESOLUTION = 0.16  # [m]


Preset = Literal["lite", "paper", "published"]
LossName = Literal["reverse-kl", "squares-printed", "squares-released", "log", "digamma"]  # see docs/deep.md


@report_errors
def train_command(
    data: Annotated[
        Any,
        Argument(
            parser=as_path,
            help="Dataset of `ogm simulate`, also in an object store (s3://bucket/data), or a recording with truth.",
            metavar="DATA",
        ),
    ],
    model: Annotated[
        Preset,
        Option(
            help="lite: small, for CPUs; the masses of RayISM are inputs. paper: PointPillars with these inputs, our "
            "recipe. published: PointPillars, the paper's recipe (100 epochs, batch 5, squared error, occupied cells "
            "x 100, rotation only)."
        ),
    ] = "lite",
    validation: Annotated[
        Any,
        Option(
            parser=as_path,
            metavar="DATA",
            help="Dataset to select the best weights by. [default: the validation split of DATA]",
        ),
    ] = None,
    out_folder: Annotated[Path | None, Option("--out", help="The run's folder. [default: runs/MODEL]")] = None,
    initial: Annotated[
        str | None, Option("--init", help="Initial weights: lite, a run's folder, or a .safetensors file.")
    ] = None,
    resume: Annotated[bool, Option("--resume", help="Continue the run in --out.")] = False,
    epochs: Annotated[int | None, Option(help="Passes over all frames.")] = None,
    batch: Annotated[int | None, Option(help="Frames per step and device.")] = None,
    learning_rate: Annotated[float | None, Option(help="Largest learning rate of AdamW.")] = None,
    loss: Annotated[LossName | None, Option(help="Loss function; see docs/deep.md.")] = None,
    samples: Annotated[int | None, Option(help="Number of training frames. [default: all]")] = None,
    seed: Annotated[int | None, Option(help="Random seed of weights, order and augmentation.", min=0)] = None,
    length: Annotated[float | None, Option(help="Extent along x [m]. [default: 81.92]")] = None,
    width: Annotated[float | None, Option(help="Extent along y [m]. [default: 56.32]")] = None,
    resolution: Annotated[float, Option(help="Side of a cell [m].")] = RESOLUTION,
    accelerator: Annotated[str, Option(help="cpu, cuda or auto.")] = "auto",
    devices: Annotated[int, Option(help="Accelerators, or CPU processes, per machine.")] = 1,
    nodes: Annotated[int, Option(help="Number of machines; start the command on each, see docs/cluster.md.")] = 1,
    precision: Annotated[str | None, Option(help="32-true or bf16-mixed. [default: bf16-mixed if supported]")] = None,
    workers: Annotated[int | None, Option(help="Processes that load frames. [default: cores / 2, up to 12]")] = None,
) -> None:
    """Train a network on frames with truth.

    Writes best.safetensors and best.json (weights, recipe, provenance), log.csv, a picture per epoch, and
    every two minutes state.pt for --resume. Address and credentials of an object store are taken from the
    environment (AWS_ENDPOINT_URL, AWS_ACCESS_KEY_ID, ...).
    """
    _need_torch()
    from ogm.deep.recipe import PRESETS
    from ogm.deep.training import train
    from ogm.grid import GridSpec

    spec = GridSpec.centered(length, width, resolution)
    given = {"epochs": epochs, "batch": batch, "learning_rate": learning_rate, "loss": loss, "seed": seed}
    changes: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    recipe = replace(PRESETS[model], **changes)
    folder = out_folder or Path("runs") / model
    parts = {"training": _open(data, "training")}
    if validation is None and "split" not in parts["training"].facts:
        raise ValueError(f"{data} has no validation split: give --validation DATA")
    parts["validation"] = _open(validation or data, "validation")
    if samples is not None:
        count = len(parts["training"])
        if not 1 <= samples <= count:
            raise ValueError(f"--samples must be 1 to {count}, the number of training frames, got {samples}")
        parts["training"] = parts["training"][:samples]
    _quiet()
    try:
        with _scans_unlogged():
            path = train(
                parts["training"],
                parts["validation"],
                spec,
                folder,
                recipe,
                initial=_network(initial),
                resume=resume,
                accelerator=accelerator,
                devices=devices,
                nodes=nodes,
                precision=precision,
                workers=workers,
                facts={"data": {name: _provenance(part) for name, part in parts.items()}},
            )
    except KeyboardInterrupt:
        saved = "the run is saved: the same command with --resume continues"
        state = saved if (folder / "state.pt").exists() else "nothing was saved yet"
        stderr.print(f"ogm: interrupted; {state} in {folder}", markup=False)
        raise typer.Exit(130) from None
    except FloatingPointError as error:
        stderr.print(f"ogm: {error}", markup=False)
        raise typer.Exit(1) from None
    if os.environ.get("LOCAL_RANK", "0") == "0":  # Lightning starts this command once per device
        out.print(f"weights {path}   curve {folder / 'log.csv'}", markup=False)


@report_errors
def export_command(
    source: Annotated[str, Argument(help="lite, a run's folder, or a .safetensors file.")] = "lite",
    out_path: Annotated[Path, Option("--out", help="Output file (.onnx).")] = Path("ogm.onnx"),
    int8: Annotated[
        str | None,
        Option(
            help="Also write NAME.int8.onnx, about twice as fast on a processor; scans of a recording or of simulated "
            "training data give the ranges.",
            metavar="DATA",
        ),
    ] = None,
) -> None:
    """Write a network as ONNX, for `ogm map --ism FILE.onnx` and other programs.

    Running the file does not need torch.
    """
    _need_torch()
    from ogm.datasets import open_dataset
    from ogm.deep.checkpoint import load_network
    from ogm.deep.engines import weights_of
    from ogm.deep.export import export_onnx
    from ogm.deep.quantize import quantize_onnx

    scans = None if int8 is None else open_dataset(int8, default_split="train")
    with weights_of(source) as path:
        network, description = load_network(path)
        _quiet()
        with stderr.status("exporting ..."):
            facts = export_onnx(network, out_path, description=description, weights=path)
            if scans is not None:
                facts |= quantize_onnx(out_path, out_path.with_suffix(".int8.onnx"), scans)
    print_facts({"file": str(out_path), **facts})


def _network(source: str | None) -> "PillarNetwork | None":
    """Return the network with initial weights; None for random weights."""
    if source is None:
        return None
    from ogm.deep.checkpoint import load_network
    from ogm.deep.engines import weights_of

    with weights_of(source) as path:
        return load_network(path)[0]


def _open(path: Any, split: str) -> "Dataset":
    """Open a split of a simulated dataset, or a recording; warn of missing samples."""
    from ogm.datasets import open_dataset

    dataset = open_dataset(path, default_split=split)
    planned = dataset.facts.get("plan", {}).get({"training": "samples"}.get(split, split), 0)
    made = dataset.facts.get("samples", ())
    if len(made) < planned:
        stderr.print(
            f"ogm: {len(made)} of {planned} {split} samples exist; `ogm simulate {path} --resume` makes the rest",
            markup=False,
        )
    return dataset


def _provenance(part: "Dataset") -> dict[str, Any]:
    """Return the facts about a dataset for the description of the weights."""
    facts = {name: value for name, value in part.facts.items() if name != "samples"}
    return {"name": part.name, "frames": len(part), **facts}


def _need_torch() -> None:
    """Raise an ImportError with the install command if torch is missing."""
    importlib.import_module("ogm.deep").PillarNetwork  # noqa: B018


@contextmanager
def _scans_unlogged() -> Iterator[None]:
    """Keep the messages of `RayISM` on single scans out of the log: training data hold scans of all kinds."""
    logger = logging.getLogger("ogm.geometric")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


def _quiet() -> None:
    """Silence warnings and log messages of the training libraries."""
    warnings.filterwarnings("ignore", module=r"(lightning|torch)(\.|$)")
    for name in ("lightning", "lightning.fabric", "torch.onnx", "onnxscript", "lightning.pytorch"):
        logging.getLogger(name).setLevel(logging.ERROR)
