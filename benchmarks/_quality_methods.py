"""What `quality` compares: sensor models, each alone and fused over time by every rule."""

from pathlib import Path

from ogm import GridSpec
from ogm.cli.methods import Map, Methods, SingleScanMethod, fused, methods_of
from ogm.cli.models import models_of, weights_facts
from ogm.evidence import dempster
from ogm.fusion import BAYES, RULES, EvidentialMapper
from ogm.fusion import rolling_window as rolling

__all__ = ["AGAINST", "BASELINE", "alone", "at_work", "fused_over_time", "made_of"]

BASELINE = "height-band"
AGAINST = (BASELINE, "ray")  # what every method is compared with, frame by frame
GEOMETRIC = (BASELINE, "height-band-released", "ray")
PLAIN = "dempster-plain"
SLOW = ("pcr6", "averaging", "weighted")  # run in numpy, ten times slower


def alone(spec: GridSpec, paper: Path | None = None) -> dict[str, SingleScanMethod]:
    """Return the sensor models: geometric ones, `lite`, and the network of the paper's size if there are weights."""
    found = methods_of([*GEOMETRIC, "lite"], (), (), spec)
    if paper is not None:
        (model,) = models_of([str(paper)], spec).values()
        found["paper"] = SingleScanMethod(model, "A network of the paper's size (DeepISM).", weights_facts(str(paper)))
    return {name: one for name, one in found.items() if isinstance(one, SingleScanMethod)}


def fused_over_time(models: dict[str, SingleScanMethod], spec: GridSpec, quick: bool = False) -> dict[str, SingleScanMethod | Map]:
    """Return the models, and each of them fused by every rule of the command line and by plain Dempster.

    The rules that run in numpy are left to `ray` and the networks.

    Parameters
    ----------
    models : dict of str to Scans
    spec : GridSpec
    quick : bool
        Fewer rules, for trying out.
    """
    result: dict[str, SingleScanMethod | Map] = dict(models)
    rules = ("cautious", "dempster", BAYES) if quick else (*RULES, BAYES)
    for name in models:
        for rule in rules:
            if rule not in SLOW or not name.startswith(BASELINE):
                result |= fused(name, rule, spec)
        result[f"{name} + {PLAIN}"] = _plain(name, spec)
    return result


def made_of(name: str) -> str:
    """Return the sensor model of a method."""
    return name.partition(" + ")[0]


def _plain(name: str, spec: GridSpec) -> Map:
    window = rolling(spec)
    description = f"The scans of {name} fused over time by Dempster's rule, half-life 2 s for everything, as most would do."
    return Map(name, lambda: EvidentialMapper(window, dempster, 2.0, moving_half_life=float("inf")), description)


def at_work(methods: dict[str, SingleScanMethod | Map], spec: GridSpec) -> Methods:
    """Return methods that can be shown frames."""
    return Methods(dict(methods), spec)
