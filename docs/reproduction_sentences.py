"""Sentences of docs/reproduction.md that hold measured numbers, made from the records alone."""

from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["sentences"]

Record = Mapping[str, Any]
CLASSICAL, DEFAULTS, DEMPSTER = "classical Bayes", "cautious, dynamic decay, 0.04 s", "Dempster, 2 s"
MEAN, RATIO = "mean and 95 % interval", "ratio to the classical filter"


def sentences(quality: Record, deep: Record, extent: str, fusion: Record) -> dict[str, str]:
    """Return all sentences by the names of their markers.

    Parameters
    ----------
    quality, deep, fusion : dict
        Records of `quality`, `deep_quality` and `fusion_quality`.
    extent : str
        How many frames, drives and towns `deep` is of.
    """
    found = _sentences_of_models(deep, extent) | {"ghosts": _sentence_of_ghosts(fusion)}
    if quality.get("town"):
        found |= _sentences_of_town(quality["town"])
    if quality.get("drives"):
        found["quality: fusion"] = _sentence_of_drives(quality["drives"])
    if quality.get("real"):
        found["quality: real"] = _sentence_of_real(quality["real"])
    return found


def _sentences_of_models(record: Record, extent: str) -> dict[str, str]:
    command = "(`python benchmarks/deep_quality.py DATA`)"
    models = record["models"]
    names = ("lite", "ray", "height-band", "height-band-released")
    mean = {name: {m: value(one["value"]) for m, one in models[name]["macro"].items()} for name in names}
    lite, ray, band, released = (mean[name] for name in names)
    unknown = record["truth per frame"]["unknown"]
    kinds = record["occupied cells by what stands there, pooled"]
    vehicles = {name: {k: percent(v) for k, v in kinds[name]["participants"].items() if k != "cells"} for name in names}
    pair = record["paired"]["lite against height-band"]
    wins = {m: f"{one['wins']} of {one['frames']}" for m, one in pair.items()}
    metrics = {"nll": "NLL", "brier": "Brier score", "iou_free": "IoU of free", "iou_occupied": "IoU of occupied"}
    better = ", ".join(
        f"{title} {lite[m]} against {band[m]} (better in {wins[m]} frames)" for m, title in metrics.items()
    )
    pooled, known = models["lite"]["micro"], record["occupied cells weighed more, 20 validation frames, pooled"]["1"]
    return {
        "masses": (
            f"On {extent}, mean unknown is {released['mean_unknown']} as released, {band['mean_unknown']} with "
            f"evidence 10, {lite['mean_unknown']} with `lite`,\nand {percent(sum(unknown) / len(unknown))} of the "
            f"cells are unknown in truth {command}."
        ),
        "vehicles": (
            f"Of such objects' cells in towns that were not in training, `lite` predicts "
            f"{vehicles['lite']['called occupied']} occupied and {vehicles['lite']['false free']} free;\nthe baseline "
            f"{vehicles['height-band']['called occupied']} and {vehicles['height-band']['false free']} {command}."
        ),
        "better": f"On {extent}:\n{better} {command}.",
        "second order": (
            f"`lite`'s unknown separates cells that cannot be known from others with an AUROC of "
            f"{lite['auroc_unknown']} (`RayISM` {ray['auroc_unknown']}, baseline {band['auroc_unknown']}); what it "
            f"claims to\nknow, occupied / (free + occupied), is calibrated to {lite['ece_relative']} "
            f"({ray['ece_relative']}, {band['ece_relative']}). P(occupied) itself is off by {lite['ece']}, because "
            f"evidence 10 allows 1/12 at best\n{command}."
        ),
        "places": (
            f"Pooled IoU there is {value(pooled['iou_free'])} for free and {value(pooled['iou_occupied'])} for "
            f"occupied ({extent}); in 20 validation frames, known towns with other traffic,\n"
            f"{value(known['iou_free'])} and {value(known['iou_occupied'])} "
            "([results](results.md#sensor-models-simulated-test-drive))."
        ),
    }


def _sentence_of_ghosts(record: Record) -> str:
    maps = record["maps"]
    area = {name: maps[name][MEAN]["ghost_area"][0] for name in (CLASSICAL, DEMPSTER, DEFAULTS)}
    free = {name: maps[name][MEAN]["static_false_free"][0] for name in area}
    ratio, old = (_ratio(maps[DEFAULTS][RATIO][what]) for what in ("ghost_area", "ghost_1s"))
    return (
        f"The classical filter leaves {area[CLASSICAL]:.2f} m² of ghosts behind each mover, Dempster's rule "
        f"{area[DEMPSTER]:.2f}, the default rule {area[DEFAULTS]:.2f}: {ratio} the classical\nfilter's; of ghosts "
        f"older than 1 s {old}. It has {100 * (1 - free[DEFAULTS] / free[CLASSICAL]):.0f} % fewer occupied "
        "cells at P < 1/4 than the classical filter."
    )


def _ratio(interval: Sequence[float]) -> str:
    """Return a ratio with its interval, and whether it differs from 1."""
    middle, low, high = interval
    return f"{middle:.2f} times ({low:.2f} to {high:.2f}{'' if high < 1 or low > 1 else ', not significant'})"


def _sentences_of_town(town: Record) -> dict[str, str]:
    models, published = town["models"], town["as the released code would report"]
    claimed = {
        name: percent(1 - one["called unknown, free, occupied, of truly unknown, free, occupied"][0][0])
        for name, one in models.items()
    }
    mean = {m: {name: value(one["mean"][m][0]) for name, one in models.items()} for m in ("aurc", "ause")}
    return {
        "quality: unknown": (
            f"Of the cells that are unknown in truth, `lite` predicts {claimed['lite']} free or occupied, `ray` "
            f"{claimed['ray']}, the baseline {claimed['height-band']} (`python benchmarks/quality.py`, [all\nfigures]"
            "(quality.md))."
        ),
        "quality: divergence": (
            f"The released code would report {value(published['KL, deep'])} for `lite` and "
            f"{value(published['KL, geometric, mean of both'])} for the released baseline, whose own value is "
            f"{value(published['KL, geometric itself'])},\nand an accuracy of "
            f"{value(published['accuracy, deep'])} for `lite` and "
            f"{value(published['accuracy, geometric'])} for the baseline, which predicts no cell "
            "(`python benchmarks/quality.py`)."
        ),
        "quality: calibration": (
            f"Of the cells that it knows best `lite` gets more right: the area under risk over coverage is "
            f"{mean['aurc']['lite']} (`ray` {mean['aurc']['ray']}, baseline\n{mean['aurc']['height-band']}; "
            f"{mean['ause']['lite']}, {mean['ause']['ray']} and {mean['ause']['height-band']} above the best possible "
            "order) (`python benchmarks/quality.py`)."
        ),
    }


def _sentence_of_drives(part: Record) -> str:
    models = part["models"]
    shown = [name for name in ("ray", "ray + bayes", "ray + cautious", "lite", "lite + cautious") if name in models]
    values = "; ".join(
        f"`{name}` {value(models[name]['mean']['iou_occupied'][0])} and "
        f"{percent(models[name]['mean']['false_free'][0])}"
        for name in shown
    )
    return (
        f"On the cells that each frame itself observes, {part['drives']} drives, IoU of occupied cells and share of "
        f"them predicted free:\n{values} (`python benchmarks/quality.py`, [all rules](quality.md))."
    )


def _sentence_of_real(recordings: Record) -> str:
    rows = []
    for name, one in recordings.items():
        models = one.get("alone", {}).get("models", {})
        values = [models[m]["mean"]["iou_occupied"][0] for m in ("lite", "ray", "height-band") if m in models]
        if len(values) == 3 and None not in values:
            rows.append(f"{name} {' / '.join(map(value, values))}")
    return (
        "IoU of occupied on labelled cells, `lite` / `ray` / baseline, by truth from boxes, classes, maps and other\n"
        "scans: "
        f"{'; '.join(rows)} (`python benchmarks/quality.py`, [all figures](quality.md))."
    )


def value(number: float | None, digits: int = 3) -> str:
    """Return a number with some digits; nothing for None."""
    return "" if number is None else f"{number:.{digits}f}"


def percent(share: float) -> str:
    """Return a share in per cent."""
    return f"{100 * share:.1f} %"
