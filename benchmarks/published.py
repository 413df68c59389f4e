"""Train a network by the paper's own recipe for as long as one can, and draw its curve beside the published value.

    python benchmarks/published.py DATA VALIDATION [--samples 240] [--epochs 8] [--runs runs/published]

The recipe is `ogm train --model published`: the paper's network, loss, annealing, weights and augmentation. The KL of
validation is to labels of evidence 1, as the paper's code computes it. An interrupted training goes on. Writes
benchmarks/results/published.json and docs/pictures/published.png.
"""

import _run as run  # first: it sets the number of threads
from _charts import caption, save_picture

# isort: split
import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from ogm import GridSpec
from ogm.datasets import open_dataset
from ogm.deep.recipe import PAPER_RECIPE
from ogm.deep.training import train

PAPERS_KL, PAPERS_EPOCHS = 0.357, 100  # van Kempen et al. 2021, Sec. V: the best of the validation
CHOOSING = 40  # validation frames


def draw(path: Path, record: dict[str, Any]) -> None:
    """Draw the KL of validation by epoch."""
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    axes = figure.subplots()
    axes.plot([row["epoch"] for row in record["curve"]], [row["kl"] for row in record["curve"]], "o-", label="ours")
    axes.axhline(PAPERS_KL, color="0.4", linestyle="--", label=f"the paper's, best of {PAPERS_EPOCHS} epochs")
    axes.set(xlabel="epoch", ylabel="KL to labels of evidence 1 [nats]", ylim=(0, None))
    axes.legend(frameon=False)
    save_picture(figure, path, caption(record["environment"]), dpi=110)


def main() -> None:
    parser = run.Parser(__doc__, picture=True)
    parser.add_argument("data", type=Path)
    parser.add_argument("validation", type=Path)
    parser.add_argument("--samples", type=int, default=240, help="training frames")
    parser.add_argument("--epochs", type=int, default=8)
    parser.add_argument("--runs", type=Path, default=Path("runs/published"))
    given = parser.parse_args()
    training = open_dataset(given.data, split="training", kerbs="occupied")[: given.samples]
    validation = open_dataset(given.validation, split="validation", kerbs="occupied")[:CHOOSING]
    recipe = replace(PAPER_RECIPE, strength=1.0, epochs=given.epochs, seed=1)  # its loss does not use the strength
    weights = train(training, validation, GridSpec.centered(), given.runs, recipe, resume=True, workers=0)
    with (given.runs / "log.csv").open() as log:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(log)]
    record = {
        "environment": run.environment(published=str(weights)),
        "samples": len(training),
        "paper": {"kl": PAPERS_KL, "epochs": PAPERS_EPOCHS, "samples": 10_000},
        "curve": rows,
    }
    run.write_record(given.out, record)
    draw(given.picture, record)


if __name__ == "__main__":
    main()
