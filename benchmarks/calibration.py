"""The parameters of RayISM of greatest likelihood, how well they are known, and what they change on other drives.

    python benchmarks/calibration.py FIT TEST [--fitted ray.json] [--every N] [--quick]

FIT and TEST are what `ogm simulate` made: drives through training towns, and drives through other towns
(benchmarks/README.md). The fit is that of `ogm calibrate`; --fitted takes its result instead. The likelihood is drawn
around it, over two parameters at once and over each other one, the rest held. Then the model by default and as
fitted is evaluated on TEST, and on real recordings where they are there. Writes benchmarks/results/calibration.json and
docs/pictures/calibration.png.
"""

import _run as run  # first: it sets the number of threads
from _charts import caption, save_picture
from _evaluation_record import beliefs, differences, means_of
from _recordings import recordings

# isort: split
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from ogm import GridSpec
from ogm.calibration import calibrate
from ogm.calibration.fit import BOUNDS
from ogm.calibration.likelihood import Likelihood
from ogm.calibration.search import Axis
from ogm.datasets import Dataset, open_dataset
from ogm.evaluation import Evaluation, evaluate
from ogm.geometric import RayISM
from ogm.metrics import ConfusionSums
from ogm.models import Calibration
from ogm.models.fitted import default_parameters

SPEC = GridSpec.centered()
PAIR = "p_miss", "p_false_alarm"
METRICS = (
    *("nll", "brier", "ece", "false_free", "missed_occupied", "false_occupied"),
    *("iou_free", "iou_occupied", "free_recall_1"),
)
LEVELS = (0, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1, 3, 10)  # [nats] of the surface
COLOURS = {"default": "#8c8c8c", "fitted": "#b35806"}


def around(fitted: Calibration, likelihood: Likelihood, points: int) -> dict[str, Any]:
    """Return the NLL over `PAIR`, and over each other parameter, the rest held at the fitted values."""

    def nll(**changed: float) -> float:
        return float(likelihood(fitted.parameters | changed).mean())

    def values(name: str) -> list[float]:
        """From bound to bound, closer around the fitted value."""
        axis, at = Axis(name, *BOUNDS[name]), Axis(name, *BOUNDS[name]).coordinate(fitted.parameters[name])
        side = np.linspace(0, 1, points // 2 + 1) ** 2
        return sorted({axis.value(x) for x in (*(at - at * side), *(at + (1 - at) * side))})

    first, second = map(values, PAIR)
    surface = [[nll(**dict(zip(PAIR, (a, b), strict=True))) for b in second] for a in first]
    others = [name for name in fitted.parameters if name not in PAIR]
    profiles = {name: {"values": values(name), "nll": [nll(**{name: v}) for v in values(name)]} for name in others}
    return {"surface": {PAIR[0]: first, PAIR[1]: second, "nll": surface}, "profiles": profiles}


def defaults(fitted: Calibration) -> dict[str, float]:
    """Return the default values of the fitted parameters."""
    return {name: default_parameters(fitted.model)[name] for name in fitted.parameters}


def compared(dataset: Dataset, fitted: Calibration, every: int) -> Evaluation:
    """Evaluate the model by default and fitted."""
    methods = {
        name: RayISM(SPEC, **numbers)
        for name, numbers in (("default", defaults(fitted)), ("fitted", fitted.parameters))
    }
    return evaluate(methods, dataset, SPEC, frames=range(0, len(dataset), every))


def recorded(result: Evaluation) -> dict[str, Any]:
    """Return means by default and fitted, their differences with 95 % intervals, and how often beliefs are right."""
    found = means_of(result, METRICS)
    found["fitted - default"] = differences(result, "fitted", "default", METRICS)
    for name, sums in zip(result.methods, result.pooled, strict=True):
        found[f"beliefs {name}"] = beliefs(sums)
    return found


def added(results: Mapping[str, Evaluation], method: int) -> ConfusionSums:
    total = ConfusionSums.zeros()
    for result in results.values():
        total = total.plus(result.pooled[method])
    return total


def draw(path: Path, record: Mapping[str, Any], test: Evaluation, real: Mapping[str, Evaluation]) -> None:
    """Draw the likelihood around the fitted parameters, and how honest the beliefs are by default and fitted."""
    fitted, profiles = record["fitted"], record["likelihood"]["profiles"]
    figure = Figure(figsize=(16, 9), layout="constrained")
    top, bottom = figure.subfigures(2, 1)
    map_figure, profile_figure = top.subfigures(1, 2, width_ratios=(1, 2.6))
    first, rest = map_figure.subplots(), np.atleast_1d(profile_figure.subplots(1, len(profiles), sharey=True))
    surface = record["likelihood"]["surface"]
    values = np.array(surface["nll"])
    least = min(values.min(), *(min(one["nll"]) for one in profiles.values()))
    colours = colormaps["YlOrBr"](np.linspace(0, 1, len(LEVELS) - 1))
    drawn = first.contourf(surface[PAIR[1]], surface[PAIR[0]], values - least, LEVELS, colors=colours)
    map_figure.colorbar(drawn, ax=first, label="NLL above the least [nats]", format="%g")
    for name, marker in (("default", "o"), ("fitted", "*")):
        at = record["default"] if name == "default" else fitted["parameters"]
        first.plot(at[PAIR[1]], at[PAIR[0]], marker, color="black", ms=9, label=name)
    first.set(xlabel=PAIR[1], ylabel=PAIR[0], xscale="log", title="Likelihood on training towns")
    first.legend(frameon=False)
    for axes, (name, one) in zip(rest, profiles.items(), strict=True):
        axes.plot(one["values"], np.array(one["nll"]) - least, color=COLOURS["fitted"])
        axes.set_yscale("symlog", linthresh=1e-3)
        axes.axvline(record["default"][name], color=COLOURS["default"], ls="--")
        axes.axvline(fitted["parameters"][name], color=COLOURS["fitted"], ls=":")
        error = fitted["errors"].get(name)
        axes.set(xlabel=name, title=f"{fitted['parameters'][name]:.3g}" + (f" ± {error:.2g}" if error else ""))
    rest[0].set_ylabel("NLL above the least [nats]")
    places = {"unseen towns": list(test.pooled)}
    if real:
        places["real recordings"] = [added(real, k) for k in (0, 1)]
    panels = iter(np.ravel(bottom.subplots(1, 2 * len(places))))
    for place, pooled in places.items():
        for state in ("free", "occupied"):
            axes = next(panels)
            axes.fill_between([0, 1], [0, 1], [1, 1], color="#1b7837", alpha=0.07, lw=0)
            axes.plot([0, 1], [0, 1], color="black", lw=0.7)
            for name, sums in zip(test.methods, pooled, strict=True):
                found = beliefs(sums)[state]
                axes.plot(found["belief"], found["share"], "o-", color=COLOURS[name], ms=4, label=name)
            axes.set(xlim=(0, 1), ylim=(0, 1), xlabel=f"belief that a cell is {state}", ylabel=f"share that is {state}")
            axes.set_title(f"{place}: {state}")
            axes.legend(frameon=False)
    note = f"A belief is kept above the diagonal. Dashed: the default. {caption(record['environment'])}"
    save_picture(figure, path, note)


def main() -> None:
    parser = run.Parser(__doc__, picture=True, quick=True, real=True)
    parser.add_argument("fit", type=Path, metavar="FIT")
    parser.add_argument("test", type=Path, metavar="TEST")
    parser.add_argument("--fitted", type=Path, help="result of `ogm calibrate`, instead of a fit")
    parser.add_argument("--base-rate", default="data", help="of the fit, see `ogm calibrate`")
    parser.add_argument("--every", type=int, default=1, help="every N-th frame of FIT and TEST")
    parser.add_argument("--points", type=int, default=9, help="values of each parameter")
    given = parser.parse_args()
    every, points = (20, 3) if given.quick else (given.every, given.points)

    training = open_dataset(given.fit, split="train")[::every]
    if given.fitted is None:
        base = None if given.base_rate == "data" else float(given.base_rate)
        fitted = calibrate(
            training, "ray", SPEC, base_rate=base, progress=lambda n, nll: print(n, f"{nll:.4f}", end="\r")
        )
    else:
        fitted = Calibration.load(given.fitted)
    print("fitted:", ", ".join(f"{name} {value:g}" for name, value in fitted.parameters.items()))
    record: dict[str, Any] = {
        "environment": run.environment("ray"),
        "fitted": asdict(fitted),
        "default": defaults(fitted),
    }
    record["likelihood"] = around(fitted, Likelihood("ray", training, SPEC, base_rate=fitted.data["base_rate"]), points)
    test = compared(open_dataset(given.test, split="test"), fitted, every)
    step = every if given.quick else 1
    real = {name: compared(frames, fitted, step) for name, frames in recordings(given.real)}
    record |= {"test": recorded(test), "real": {name: recorded(result) for name, result in real.items()}}
    run.write_record(given.out, record)
    draw(given.picture, record, test, real)


if __name__ == "__main__":
    main()
