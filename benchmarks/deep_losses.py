"""Which loss trains the better network? The same network, frames, order and steps for each.

    python benchmarks/deep_losses.py DATA [--samples 200] [--epochs 10] [--frames 100] [--only NAME ...]

DATA is a data set of `ogm simulate`. The grid has cells of 0.32 m (256 x 176) and a small part of the frames is
used: the order of the losses is the result, not the level. Finished trainings are read again.
"""

# ruff: noqa: E402
import os

os.environ.setdefault("OGM_CORES", "2")

import _run as run

# isort: split
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ogm import GridSpec
from ogm.datasets import open_dataset
from ogm.deep import LITE
from ogm.deep.recipe import Recipe
from ogm.deep.training import train
from ogm.evaluation import evaluate

SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.32)
OTHER: dict[str, Any] = {"uniform_kl": 1.0}
RECIPES: dict[str, dict[str, Any]] = {
    "reverse KL": {},
    "squares as printed": {"loss": "squares-printed", **OTHER},
    "squares as released": {"loss": "squares-released", **OTHER},
    "squares as released, occupied x 100": {"loss": "squares-released", "occupied_weight": 100.0, **OTHER},
    "log": {"loss": "log", **OTHER},
    "digamma": {"loss": "digamma", **OTHER},
}
SHOWN = (
    *("nll", "brier", "iou_free", "iou_occupied", "iou_unknown", "iou_free_known", "iou_occupied_known"),
    *("false_free", "missed_occupied", "ece", "auroc_unknown", "kl_e10"),
)
NOTE = (
    "One seed each: intervals are over drives, not over trainings, which they cannot compare. All but the reverse KL "
    "are trained with the annealed KL to the uniform Dirichlet density (weight 0 to 1 over 10 epochs). kl_e10 is what "
    "the reverse KL minimises, and no proper score."
)


def main() -> None:
    parser = run.Parser(__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--samples", type=int, default=200)
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--frames", type=int, default=100, help="to evaluate, of the validation split")
    parser.add_argument("--runs", type=Path, default=run.RUNS / "losses", help="folder of the trainings")
    parser.add_argument("--only", nargs="+", choices=RECIPES, default=list(RECIPES))
    options = parser.parse_args()
    record = run.environment()
    training, validation = (
        open_dataset(options.data, split=name, kerbs="occupied") for name in ("training", "validation")
    )
    # Spread over all drives; weights are chosen by other validation frames than those that are evaluated.
    chosen = np.linspace(0, len(training) - 1, options.samples).astype(int)
    frames = np.linspace(0, len(validation) - 1, options.frames).astype(int).tolist()
    others = [i for i in range(len(validation)) if i not in set(frames)][:10]
    models, seconds = {}, {}
    for name in options.only:
        recipe = replace(Recipe(LITE, epochs=options.epochs, batch=4), **RECIPES[name])
        folder = options.runs / f"{options.samples}x{options.epochs}" / name.replace(" ", "-").replace(",", "")
        done, start = folder / "done", time.perf_counter()
        if not done.exists():
            data = training.select(chosen), validation.select(others)
            train(*data, SPEC, folder, recipe, resume=True, workers=1, picture_every=0)
            done.write_text(f"{time.perf_counter() - start:.1f}")
        seconds[name] = float(done.read_text())
        models[name] = str(folder / "best.safetensors")
    result = evaluate(models, validation, SPEC, frames=frames)
    record |= {
        "checksums": {name: run.describe(path) for name, path in models.items()},
        "note": NOTE,
        "samples": options.samples,
        "epochs": options.epochs,
        "frames": options.frames,
        "training [s]": seconds,
        "scores": {name: {metric: result.interval(name, metric)._asdict() for metric in SHOWN} for name in models},
        "against reverse KL": {
            name: {
                metric: {"wins": one.wins, "losses": one.losses, "difference": one.difference._asdict()}
                for metric, one in result.compare(name, "reverse KL").items()
                if metric in SHOWN
            }
            for name in models
            if name != "reverse KL" and "reverse KL" in models
        },
    }
    print(result)
    if options.only == list(RECIPES):
        run.write_record(options.out, record)


if __name__ == "__main__":
    main()
