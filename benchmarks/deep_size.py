"""What does the size of the paper's network give? `PAPER` and `LITE` trained alike, from random weights.

    python benchmarks/deep_size.py DATA VALIDATION [--samples N] [--epochs N] [--runs FOLDER]

Both take the masses of `RayISM`, the same frames of DATA (the recipe gen2) in the same order, the same augmentation and
loss. `PAPER` is trained without its dropout, whose random numbers take a third of a step on a processor. Evaluated are
the validation frames of VALIDATION, beside the shipped weights; intervals are 95 %, over drives. A stopped run goes on.
Writes benchmarks/results/deep_size.json.
"""

import _run as run  # first: it sets the number of threads
from _evaluation_record import compared

# isort: split
import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

from deep_training import CHOOSING, METRICS, SPEC

from ogm.datasets import open_dataset
from ogm.deep.network import LITE, PAPER
from ogm.deep.recipe import LITE_RECIPE
from ogm.deep.training import train
from ogm.evaluation import SingleScanMethod, evaluate

NETWORKS = {"LITE": replace(LITE, rays=True), "PAPER": replace(PAPER, rays=True, dropout=0.0)}


def main() -> None:
    parser = run.Parser(__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("validation", type=Path)
    parser.add_argument("--samples", type=int, default=1600, help="training frames")
    parser.add_argument("--epochs", type=int, default=2)
    parser.add_argument("--runs", type=Path, default=Path("runs/size"))
    given = parser.parse_args()
    training = open_dataset(given.data, split="training")
    validation = open_dataset(given.validation, split="validation", kerbs="occupied")
    weights, curves = {}, {}
    for name, network in NETWORKS.items():
        recipe, out = replace(LITE_RECIPE, network=network, epochs=given.epochs, seed=1), given.runs / name.lower()
        options: dict[str, Any] = {"resume": True, "workers": 1, "picture_every": 0}
        weights[name] = train(training[: given.samples], validation[:CHOOSING], SPEC, out, recipe, **options)
        with (out / "log.csv").open() as log:
            curves[name] = list(csv.DictReader(log))
    models = {name: SingleScanMethod.named(str(path), SPEC) for name, path in weights.items()}
    result = evaluate(models, validation, SPEC)
    record = {
        "environment": run.environment("ray", **weights),
        "samples": given.samples,
        "epochs": given.epochs,
        "learning curves": curves,
        "scores": compared(result, "LITE", METRICS),
    }
    run.write_record(given.out, record)


if __name__ == "__main__":
    main()
