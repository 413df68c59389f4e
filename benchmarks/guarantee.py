"""Coverage and price of the guarantee of `ogm calibrate` on further drives, and its failure on other sensors.

    python benchmarks/guarantee.py TOWNS [--real FOLDER] [--draws N] [--quick]

TOWNS are drives that `ogm simulate` made in towns of no training (benchmarks/README.md). Coverage: N times, half of the
drives drawn at random are calibrated, and the share of the other half within the limit is counted; beside it the share
of truly free cells that are left free. Shift: all drives are calibrated, and compared with the limit are the same
drives seen by a worse lidar (every fourth of its layers; 10 cm more noise), and real recordings, of other sensors,
places and truth. Writes benchmarks/results/guarantee.json.
"""

import _run as run  # first: it sets the number of threads
from _recordings import recordings

# isort: split
from collections.abc import Callable
from dataclasses import replace
from math import floor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm import GridSpec, Scan
from ogm.calibration.drives import LEVELS, chosen_factor, curves_by_drive, largest_factor
from ogm.datasets import Dataset, open_dataset
from ogm.models.named import load_model, with_radar
from ogm.scan import Frame

SPEC = GridSpec.centered()
MODELS = "ray", "lite", "combined"
LIMITS = 0.01, 0.02, 0.05
CONFIDENCE = 0.9


def at(curves: NDArray[np.float64], factor: float) -> NDArray[np.float64]:
    """Return false free and found free of each drive, (drives, 2), with a factor for the mass of free."""
    return curves[..., floor(LEVELS / 2 / factor)]


def fewer_layers(scan: Scan) -> Scan:
    """Return a scan with every fourth layer."""
    kept = scan.ring % 4 == 0
    return replace(scan, points=scan.points[kept], ring=scan.ring[kept], time=scan.time[kept], no_returns=None)


def more_noise(scan: Scan) -> Scan:
    """Return a scan with 10 cm more noise of the range."""
    points = scan.points.copy()
    ranges = np.linalg.norm(points[:, :3], axis=1, keepdims=True)
    points[:, :3] *= 1 + np.random.default_rng(1).normal(0, 0.1, ranges.shape) / np.maximum(ranges, 1)
    return replace(scan, points=points)


WORSE = {"every fourth layer": fewer_layers, "10 cm more noise": more_noise}


def seen_by(worse: Callable[[Scan], Scan], frames: Dataset) -> list[Frame]:
    """Return frames with worse scans and the same truth."""
    return [
        Frame(worse(frame.scan), frame.mount, None, frame.truth, name=frame.name, sequence=frame.sequence)
        for frame in frames
    ]


def coverage(curves: NDArray[np.float64], limit: float, draws: int) -> dict[str, Any]:
    """Return how often further drives are within a limit, over random halves of the drives."""
    rng, drives = np.random.default_rng(0), len(curves)
    factors = np.array([largest_factor(occupied, limit) for occupied, _ in curves])
    within, found, chosen = [], [], []
    for _ in range(draws):
        order = rng.permutation(drives)
        fitted, further = order[: drives // 2], order[drives // 2 :]
        factor = chosen_factor(factors[fitted], CONFIDENCE)
        false_free, found_free = at(curves[further], factor).T
        within.append(float((false_free <= limit).mean()))
        found.append(float(found_free.mean()))
        chosen.append(factor)
    whole = at(curves, 1.0)
    return {
        "calibrated": drives // 2,
        "draws": draws,
        "confidence": CONFIDENCE,
        "expected within": 1 - floor((drives // 2 + 1) * (1 - CONFIDENCE) + 1e-9) / (drives // 2 + 1),
        "within": float(np.mean(within)),
        "within without": float((whole[:, 0] <= limit).mean()),
        "found free": float(np.mean(found)),
        "found free without": float(whole[:, 1].mean()),
        "factor": float(np.median(chosen)),
    }


def main() -> None:
    """Measure, print and write the record."""
    parser = run.Parser(description=__doc__, quick=True, real=True)
    parser.add_argument("data", type=Path, help="data set of drives")
    parser.add_argument("--draws", type=int, default=200)
    options = parser.parse_args()
    frames = open_dataset(options.data, split="test")
    real = dict(recordings(options.real))
    if options.quick:
        frames, real = frames[::5], dict(list(real.items())[:1])
    shifted = {title: seen_by(worse, frames) for title, worse in WORSE.items()} | real
    record: dict[str, Any] = {"environment": run.environment(*MODELS), "models": {}}
    for name in MODELS:
        model = load_model(with_radar(name), SPEC, drop_ego_returns=True)
        curves = np.array([*curves_by_drive(frames, model, SPEC)[0].values()])
        elsewhere = {title: curves_by_drive(others, model, SPEC)[0] for title, others in shifted.items()}
        record["models"][name] = rows = {}
        for limit in LIMITS:
            factor = chosen_factor([largest_factor(occupied, limit) for occupied, _ in curves], CONFIDENCE)
            shift = {title: at(np.array([*found.values()]), factor) for title, found in elsewhere.items() if found}
            rows[f"{limit:g}"] = coverage(curves, limit, options.draws) | {
                "drives": len(curves),
                "false free elsewhere": {title: found[:, 0].tolist() for title, found in shift.items()},
                "found free elsewhere": {title: float(found[:, 1].mean()) for title, found in shift.items()},
            }
            print(name, limit, {key: value for key, value in rows[f"{limit:g}"].items() if "elsewhere" not in key})
            print("   ", {title: round(float(found[:, 0].mean()), 4) for title, found in shift.items()})
    run.write_record(options.out, record)


if __name__ == "__main__":
    main()
