"""Maximum likelihood fit of the parameters of a geometric sensor model to labelled frames.

>>> from ogm.datasets import open_dataset
>>> from ogm.calibration import calibrate
>>> fitted = calibrate(open_dataset("data/", split="train"), "ray")                                # doctest: +SKIP
>>> fitted.save("ray.json")                                                                        # doctest: +SKIP

The file is a model name, as in ``evaluate({"mine": "ray.json"}, ...)``.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from math import inf
from typing import Any

from ogm.calibration.likelihood import Likelihood
from ogm.calibration.search import LikelihoodSearch
from ogm.grid import GridSpec
from ogm.models.fitted import Calibration, default_parameters
from ogm.scan import Frame

FITTED = {  # default parameters to fit, by model
    "ray": (*("p_miss", "p_false_alarm", "free_reliability_at_hits", "no_return_weight", "obstacle_height"),),
    "height-band": ("z_min", "z_max", "evidence"),
    "planar": ("range_noise", "p_miss", "p_false_alarm", "no_return_weight"),
}
BOUNDS = {  # default search bounds of the parameters
    **{"p_miss": (0.01, 0.999), "p_false_alarm": (1e-4, 0.8), "max_mass": (0.5, 0.9999)},
    **{"free_reliability_at_hits": (0.0, 1.0), "no_return_weight": (0.0, 1.0)},
    **{"obstacle_height": (0.03, 0.5), "clearance": (1.0, 3.0), "below_ground": (0.05, 2.0), "range_noise": (0.0, 0.2)},
    **{"max_range": (20.0, 200.0), "azimuth_step": (0.001, 0.05), "ground_cell": (0.2, 3.0)},
    **{"floor_margin": (0.0, 0.3)},
    **{"hidden_height": (0.1, 2.0), "hidden_depth": (0.5, 40.0)},
    **{"z_min": (0.05, 1.5), "z_max": (1.6, 3.0), "evidence": (0.1, 100.0)},
}
REPORTED = ("nll", "false_free", "missed_occupied", "false_occupied", "iou_free", "iou_occupied", "ece")


def calibrate(
    dataset: Sequence[Frame],
    model: str | Calibration = "ray",
    spec: GridSpec | None = None,
    *,
    fit: Mapping[str, tuple[float, float]] | None = None,
    base_rate: float | None = None,
    threads: int = 1,
    reading: Callable[[Iterable[int]], Iterable[int]] = iter,
    progress: Callable[[int, float], object] = lambda evaluations, nll: None,
) -> Calibration:
    """Fit the parameters of a geometric model to labelled frames (Thrun, Burgard, Fox 2005, Sec. 9.3).

    Minimises the mean over drives of `Likelihood`, the log loss on known cells, by Powell's method within bounds. The
    search is deterministic. An interrupt (Ctrl-C) ends it, and the best parameters so far are returned.

    Parameters
    ----------
    dataset : sequence of Frame
        Frames with truth, for example from `ogm.datasets.open_dataset`.
    model : str or Calibration
        "ray", "height-band" or "planar", or a calibration or its path to start from.
    spec : GridSpec, optional
        Cells; by default the 81.92 m x 56.32 m of the paper.
    fit : dict of str to (low, high), optional
        Parameters to fit with their bounds; by default `FITTED` within `BOUNDS`. Parameters without effect on these
        frames keep their values.
    base_rate : float, optional
        P(occupied) of an unknown cell, in (0, 1); by default the share of occupied cells among the known cells, so that
        masses hold the information of the rays beyond it. With 1/2, the metric ``nll`` is minimised; since few cells
        are occupied, the fit then compensates by more belief in free.
    threads : int
        Number of frames mapped in parallel. The result does not depend on it.
    reading : function
        Wrapper of the iterable of frame numbers during reading, for example a progress bar.
    progress : function
        Callback after each evaluation, with the number of evaluations and the least NLL.

    Raises
    ------
    ValueError
        If there are no labelled frames, a model or parameter is unknown, or bounds do not contain the start value.
    """
    if isinstance(model, str):
        model = Calibration.load(model) if model.endswith(".json") else Calibration(model, {})
    start = default_parameters(model.model) | model.parameters
    chosen = {name: BOUNDS[name] for name in FITTED[model.model]} if fit is None else dict(fit)
    _check_fit(model.model, chosen, start)
    frames = (dataset[k] for k in reading(range(len(dataset))))
    likelihood = Likelihood(model.model, frames, spec, base_rate=base_rate, threads=threads)

    search = LikelihoodSearch(likelihood, start, chosen, progress)
    errors: dict[str, float | None] = dict.fromkeys(chosen)
    finished = False
    try:
        search.drop_parameters_without_effect()
        search.minimise()
        errors |= search.newton_step()
        finished = True
    except KeyboardInterrupt:
        pass

    ends = start, search.parameters(search.best)
    before, after = (
        {name: found[name] for name in REPORTED if name in found} for found in map(likelihood.scores, ends)
    )
    names = dict.fromkeys([*model.parameters, *chosen])
    first, fitted = ({name: values[name] for name in names} for values in ends)
    data = facts_of(dataset) | {"frames": len(likelihood.frames), "drives": len(likelihood.drives)}
    data["base_rate"] = likelihood.base_rate
    return Calibration(model.model, fitted, first, errors, before, after, data, search.evaluations, finished)


def facts_of(dataset: Sequence[Frame]) -> dict[str, Any]:
    """Return name, format and description of a dataset, and split and plan of simulated data."""
    about = {"name": "frames", "format": "frames in Python", "description": ""}
    data = {key: getattr(dataset, key, default) for key, default in about.items()}
    return data | {key: value for key, value in getattr(dataset, "facts", {}).items() if key in ("split", "plan")}


def _check_fit(model: str, chosen: Mapping[str, tuple[float, float]], start: Mapping[str, float]) -> None:
    if not chosen:
        raise ValueError(f"fit must not be empty: give parameters of {model}, such as {', '.join(FITTED[model])}")
    for name, (low, high) in chosen.items():
        if name not in start:
            raise ValueError(f"{model} has no parameter {name!r}; it has {', '.join(start)}")
        if not (-inf < low < high < inf and low <= start[name] <= high):
            raise ValueError(f"bounds of {name} must contain its start value {start[name]:g}, got {low:g} to {high:g}")
