"""Sensor models and maps that `quality.py` compares."""

from collections.abc import Sequence
from pathlib import Path

from ogm import GridSpec
from ogm.datasets import Dataset
from ogm.evaluation import FusedMethod, SingleScanMethod
from ogm.evidence import dempster
from ogm.evidence.map_rules import BAYES, REVISE, RULES
from ogm.fusion import EvidentialMapper, rolling_window

BASELINE = "height-band"
AGAINST = (BASELINE, "ray")  # what every method is compared with, frame by frame
MODELS = (BASELINE, "height-band-released", "ray", "lite", "combined")
PLAIN = "dempster-plain"
Methods = dict[str, SingleScanMethod | FusedMethod]


def single_scan(spec: GridSpec, paper: Path | None = None) -> dict[str, SingleScanMethod]:
    """Return the sensor models; with the network of the paper's size if there are weights."""
    found = {name: SingleScanMethod.named(name, spec) for name in MODELS}
    if paper is not None:
        found["paper"] = SingleScanMethod.named(str(paper), spec)
        found["paper"].description = "A network of the paper's size (DeepISM)."
    return found


def all_maps(models: dict[str, SingleScanMethod], spec: GridSpec, quick: bool = False) -> Methods:
    """Return the models, and each but the baselines fused by every rule and by plain Dempster.

    `quick` takes fewer rules.
    """
    result: Methods = dict(models)
    window = rolling_window(spec)
    for name, one in models.items():
        if name.startswith(BASELINE):
            continue
        for rule in (REVISE, "dempster", BAYES) if quick else (*RULES, BAYES):
            result[f"{name} + {rule}"] = FusedMethod.by_rule(name, one.model, rule, spec)
        result[f"{name} + {PLAIN}"] = FusedMethod(
            one.model,
            lambda: EvidentialMapper(window, dempster, 2.0, moving_half_life=float("inf")),
            f"The scans of {name} fused over time by Dempster's rule, half-life 2 s for everything.",
        )
    return result


def model_of(name: str) -> str:
    """Return the sensor model of a method."""
    return name.partition(" + ")[0]


def every(dataset: Dataset, step: int, drives: int | None = None) -> list[int]:
    """Return every N-th frame of each of some sequences, without the first ones."""
    chosen: Sequence[list[int]] = list(dataset.sequences.values())[:drives]
    return sorted(k for numbers in chosen for k in numbers[step - 1 :: step])
