"""What `quality` compares, and on which data: models, maps, simulated and real data sets."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from ogm import GridSpec
from ogm.datasets import Dataset, open_dataset
from ogm.evaluation import FusedMethod, SingleScanMethod
from ogm.evidence import dempster
from ogm.evidence.map_rules import BAYES, RULES
from ogm.fusion import EvidentialMapper, rolling_window

BASELINE = "height-band"
AGAINST = (BASELINE, "ray")  # what every method is compared with, frame by frame
MODELS = (BASELINE, "height-band-released", "ray", "lite")
PLAIN = "dempster-plain"
SLOW = ("pcr6", "averaging", "weighted")  # run in numpy, ten times slower
REAL = {
    "KITTI, single scans": "kitti_object",
    "KITTI, drive 0005": "kitti_raw_0005",
    "KITTI, odometry 00": "kitti_odometry_00",
    "Argoverse 2": "argoverse2_adcf",
    "nuScenes": "nuscenes_n015",
    "SUSTechPOINTS": "sustechpoints",
    "SemanticKITTI, labelled scans": "labelled_range_images/semantic_kitti",
    "nuScenes, labelled scans": "labelled_range_images/nuscenes",
}
MIN_SCANS = 3  # of a sequence that is fused

Methods = dict[str, SingleScanMethod | FusedMethod]


def single_scan(spec: GridSpec, paper: Path | None = None) -> dict[str, SingleScanMethod]:
    """Return the sensor models; with the network of the paper's size if there are weights."""
    found = {name: SingleScanMethod.named(name, spec) for name in MODELS}
    if paper is not None:
        found["paper"] = SingleScanMethod.named(str(paper), spec)
        found["paper"].description = "A network of the paper's size (DeepISM)."
    return found


def all_maps(models: dict[str, SingleScanMethod], spec: GridSpec, quick: bool = False) -> Methods:
    """Return the models, and each of them fused by every rule and by plain Dempster.

    The rules that run in numpy are left to `ray` and the networks; `quick` takes fewer rules.
    """
    result: Methods = dict(models)
    window = rolling_window(spec)
    for name, one in models.items():
        for rule in ("cautious", "dempster", BAYES) if quick else (*RULES, BAYES):
            if rule not in SLOW or not name.startswith(BASELINE):
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


class QualityInput(NamedTuple):
    """A real recording, for single scans and for maps, or the reason why it is left out."""

    name: str
    alone: Dataset | None
    fused: Dataset | None
    reason: str = ""


def real(folder: Path) -> Iterator[QualityInput]:
    """Yield the recordings of `REAL`, opened for single scans and, with poses, for maps."""
    for name, place in REAL.items():
        if not (folder / place).exists():
            yield QualityInput(name, None, None, f"there is no {place}")
            continue
        try:
            alone = open_dataset(folder / place)
        except ValueError as error:
            yield QualityInput(name, None, None, str(error).replace(str(folder), "OGM_DATA"))
            continue
        yield QualityInput(name, alone, open_dataset(folder / place, others="later") if _is_drive(alone) else None)


def _is_drive(dataset: Dataset) -> bool:
    """Tell whether all frames belong to sequences, with stamps and poses."""
    posed = all(frame.sequence and frame.stamp is not None for frame in dataset)
    return posed and len(dataset) >= MIN_SCANS * len(dataset.sequences) and dataset[0].T_map_sensor is not None


def every(dataset: Dataset, step: int, drives: int | None = None) -> list[int]:
    """Return every N-th frame of each of some sequences, without the first ones."""
    chosen: Sequence[list[int]] = list(dataset.sequences.values())[:drives]
    return sorted(k for numbers in chosen for k in numbers[step - 1 :: step])
