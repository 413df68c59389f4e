"""Which truth trains `lite` better, and what do the masses of `RayISM` add? Three trainings from random weights.

    python benchmarks/deep_training.py FOLDER [--samples N] [--epochs N] [--validation N]

The scans of all are the same, those of the recipe gen2; so are the seed, the order of the frames, the augmentation:

* aimed: truth by rays aimed at every cell;
* hd: truth by the paper's lidar of 3000 layers;
* no rays: as aimed, but the masses of `RayISM` are not among the inputs.

Evaluated are validation frames by both truths, and by a third one that none was trained on: that of a lidar of 12,000
layers; the intervals are 95 %, over drives. Data sets and runs lie in FOLDER; what is there already is used, and a run
that was stopped goes on. Writes benchmarks/results/deep_training.json.
"""

import _run as run  # first: it sets the number of threads
from _evaluation_record import compared

# isort: split
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from ogm import GridSpec
from ogm.datasets import open_dataset
from ogm.deep.recipe import LITE_RECIPE
from ogm.deep.training import train
from ogm.evaluation import SingleScanMethod, evaluate
from ogm.simulation.dataset import simulate
from ogm.simulation.plan import DatasetPlan
from ogm.simulation.store import Store

SPEC = GridSpec.centered()
METRICS = ("kl_e10", "nll", "brier", "false_free", "iou_free", "iou_occupied", "ece_relative", "auroc_unknown")
SEED = 29  # of the data: its towns are not those of the shipped weights
CHOOSING = 10  # validation frames that a run's epoch is chosen by
DENSE = 12_000  # layers


class Arm(NamedTuple):
    """One of the trainings: the truth, and whether the masses of `RayISM` are inputs."""

    truth: str
    rays: bool


ARMS = {"aimed": Arm("aimed", True), "hd": Arm("hd", True), "no rays": Arm("aimed", False)}


def make_data(folder: Path, samples: int, validation: int) -> dict[str, Path]:
    """Make the three data sets of the same scans, as far as they are not there."""
    plan = DatasetPlan.of_recipe("gen2", seed=SEED, samples=samples, validation=validation, test=0, sequences=0)
    plans = {
        "aimed": plan,
        "hd": replace(plan, truth="hd"),
        "dense": replace(plan, truth="hd", hd_layers=DENSE, samples=0),
    }
    for name, wanted in plans.items():
        path = folder / name
        store = Store.open(path) if Store.exists(path) else None
        missing = [k for k, count in wanted.counts.items() if not store or len(store[k].finished) < count]
        if missing:  # a larger data set serves too
            simulate(path, wanted, resume=True)
    return {name: folder / name for name in plans}


def trained(name: str, data: Mapping[str, Path], folder: Path, samples: int, epochs: int) -> Path:
    """Train an arm, or go on, and return its weights."""
    truth, rays = ARMS[name]
    recipe = replace(LITE_RECIPE, network=replace(LITE_RECIPE.network, rays=rays), epochs=epochs, seed=1)
    parts = [open_dataset(data[truth], split=split, kerbs="occupied") for split in ("training", "validation")]
    out = folder / "runs" / name.replace(" ", "-")
    return train(parts[0][:samples], parts[1][:CHOOSING], SPEC, out, recipe, resume=True, picture_every=0)


def main() -> None:
    parser = run.Parser(__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--samples", type=int, default=600, help="training frames")
    parser.add_argument("--epochs", type=int, default=8)
    parser.add_argument("--validation", type=int, default=70, help="frames that are evaluated")
    given = parser.parse_args()
    data = make_data(given.folder, given.samples, given.validation)
    weights = {name: trained(name, data, given.folder, given.samples, given.epochs) for name in ARMS}
    models = {name: SingleScanMethod.named(str(path), SPEC) for name, path in weights.items()}
    environment = run.environment("ray", **weights)
    record: dict[str, Any] = {"environment": environment, "samples": given.samples, "epochs": given.epochs}
    record["truth of validation"] = {}
    for name, path in data.items():
        validation = open_dataset(path, split="validation", kerbs="occupied")
        result = evaluate(models, validation, SPEC, frames=range(given.validation))
        record["truth of validation"][name] = compared(result, "aimed", METRICS)
        run.write_record(given.out, record)


if __name__ == "__main__":
    main()
