"""Which loss trains the better network? The same network, samples, order and steps for each, judged on validation.

    python benchmarks/deep_losses.py DATA [--samples 200] [--epochs 10] [--frames 100] [--only NAME ...]

DATA is a data set of `ogm simulate`. To keep it to minutes per loss the grid has cells of 0.32 m (256 x 176) and a
small part of the samples is used: the order of the losses is the result, not the level. Writes
benchmarks/results/deep_losses.json and docs/pictures/deep_losses.png; runs that were made before are read again.
"""

import os

os.environ.setdefault("OGM_CORES", "2")

from _run import OURS, PEER, PICTURES, RESULTS, caption, environment, write_json  # noqa: E402

# isort: split
import argparse  # noqa: E402
import time  # noqa: E402
from collections.abc import Mapping  # noqa: E402
from dataclasses import replace  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from torch.utils.data import Subset  # noqa: E402

from ogm import GridSpec  # noqa: E402
from ogm.deep import LITE, DeepISM  # noqa: E402
from ogm.deep.checkpoint import load_network  # noqa: E402
from ogm.deep.recipe import Recipe  # noqa: E402
from ogm.deep.train import train  # noqa: E402
from ogm.files import atomic_write  # noqa: E402
from ogm.metrics import METRICS, Evaluation, evaluate  # noqa: E402
from ogm.simulation.store import Store  # noqa: E402

SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.32)
RECIPES: dict[str, dict[str, Any]] = {
    "reverse KL": {},
    "squares as printed": {"loss": "squares-printed", "uniform_kl": 1.0},
    "squares as released": {"loss": "squares-released", "uniform_kl": 1.0},
    "squares as released, occupied x 100": {
        "loss": "squares-released",
        "uniform_kl": 1.0,
        "occupied_weight": 100.0,
    },
    "log": {"loss": "log", "uniform_kl": 1.0},
    "digamma": {"loss": "digamma", "uniform_kl": 1.0},
}
SHOWN = ("kl_e10", "auroc_unknown", "iou_free", "iou_occupied", "iou_unknown", "ece", "brier", "false_free")
NOTE = (
    "One seed each: intervals are over frames, not over trainings. All but the reverse KL are trained with the "
    "annealed KL to the uniform Dirichlet density (weight 0 to 1 over 10 epochs). kl_e10 is what the reverse KL "
    "minimises."
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--samples", type=int, default=200)
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--frames", type=int, default=100, help="validation samples for the judgement")
    parser.add_argument("--runs", type=Path, default=Path("runs/losses"), help="folder of the trainings")
    parser.add_argument("--only", nargs="+", choices=RECIPES, default=list(RECIPES))
    options = parser.parse_args()
    record = environment()
    record["command"] = f"python benchmarks/deep_losses.py {options.data.name}"
    store = Store.open(options.data)
    # Spread over all drives; weights are chosen by other validation samples than those of the judgement.
    chosen = np.linspace(0, len(store["training"]) - 1, options.samples).astype(int).tolist()
    judged = np.linspace(0, len(store["validation"]) - 1, options.frames).astype(int).tolist()
    others = [i for i in range(len(store["validation"])) if i not in set(judged)][:10]
    models, seconds = {}, {}
    for name in options.only:
        recipe = replace(Recipe(LITE, epochs=options.epochs, batch=4), **RECIPES[name])
        folder = (
            options.runs / f"{options.samples}x{options.epochs}" / name.replace(" ", "-").replace(",", "")
        )
        start = time.perf_counter()
        path = folder / "best.safetensors"
        if not (folder / "done").exists():
            train(
                Subset(store["training"], chosen),
                Subset(store["validation"], others),
                SPEC,
                folder,
                recipe,
                resume=True,
                picture_every=0,
            )
            (folder / "done").write_text(f"{time.perf_counter() - start:.1f}")
        seconds[name] = float((folder / "done").read_text())
        network, _ = load_network(path)
        models[name] = lambda T, network=network: DeepISM(network, None, float(T[2, 3]))
    result = evaluate(models, (store["validation"][i] for i in judged))
    rng = np.random.default_rng(0)
    record |= {
        "note": NOTE,
        "samples": options.samples,
        "epochs": options.epochs,
        "frames": options.frames,
        "training [s]": seconds,
        "scores": {
            name: {metric: result.interval(name, metric, rng)._asdict() for metric in SHOWN}
            for name in models
        },
        "against reverse KL": {
            name: {
                metric: {"wins": one.wins, "losses": one.losses, "difference": one.difference._asdict()}
                for metric, one in result.compare(name, "reverse KL", rng).items()
                if metric in SHOWN
            }
            for name in models
            if name != "reverse KL" and "reverse KL" in models
        },
    }
    for name, scores in record["scores"].items():
        print(f"{name:38}", "  ".join(f"{metric} {value['value']:.3f}" for metric, value in scores.items()))
    if options.only == list(RECIPES):
        write_json(RESULTS / "deep_losses.json", record)
        picture(PICTURES / "deep_losses.png", result, record)


def picture(path: Path, result: Evaluation, record: Mapping[str, Any]) -> None:
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    names = list(record["scores"])
    for ax, metric in zip(figure.subplots(2, 4, sharey=True).ravel(), SHOWN, strict=True):
        ones = [record["scores"][name][metric] for name in names]
        values = np.array([one["value"] for one in ones])
        errors = np.abs(np.array([[one["low"], one["high"]] for one in ones]).T - values)
        colours = [OURS if name == "reverse KL" else PEER for name in names]
        ax.barh(range(len(names)), values, xerr=errors, color=colours, error_kw={"lw": 0.8})
        ax.set_title(f"{METRICS[metric].title} ({METRICS[metric].better} is better)", fontsize=8)
        ax.set_yticks(range(len(names)), names, fontsize=7)
        ax.tick_params(axis="x", labelsize=7)
    ax.invert_yaxis()  # of all: they share it
    figure.suptitle(caption(record), fontsize=6)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=130)


if __name__ == "__main__":
    main()
