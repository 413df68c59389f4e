"""Sentences of docs/reproduction.md that hold measured numbers, made from the records alone."""

from collections.abc import Mapping
from typing import Any

from record_tables import outdated, percent, value

__all__ = ["sentences"]

Record = Mapping[str, Any]
CLASSICAL, DEFAULTS, DEMPSTER = "classical Bayes", "EvidentialMapper, default", "Dempster, 2 s"
COMPARED = ("combined", "lite", "ray", "height-band")  # on real recordings
MEAN = "mean and 95 % interval"


def sentences(quality: Record, deep: Record, fusion: Record, speed: Record, objects: Record) -> dict[str, str]:
    """Return all sentences by the names of their markers.

    Parameters
    ----------
    quality, deep, fusion, speed, objects : dict
        Records of `quality`, `deep_quality`, `fusion_quality`, `deep_speed` and `objects`.
    """
    found = {
        "deep_quality": _sentences_of_models(deep),
        "fusion_quality": {"ghosts": _sentence_of_ghosts(fusion)},
        "deep_speed": {"speed": _sentence_of_speed(speed)},
        "objects": {"objects": _sentence_of_objects(objects["all"]["all"])},
        "quality": {"recordings": _sentence_of_real(quality["real"])},
    }
    marks = {name: " **Outdated.**" if outdated(name) else "" for name in found}  # results.md has the reasons
    return {key: text + marks[name] for name, texts in found.items() for key, text in texts.items()}


def _sentences_of_models(record: Record) -> dict[str, str]:
    models = record["models"]
    names = ("lite", "ray", "height-band", "height-band-released")
    mean = {name: {m: value(one["value"]) for m, one in models[name]["macro"].items()} for name in names}
    lite, ray, band, released = (mean[name] for name in names)
    unknown = record["truth per frame"]["unknown"]
    kinds = record["occupied cells by what stands there, pooled"]
    vehicles = {name: {k: percent(v) for k, v in kinds[name]["participants"].items() if k != "cells"} for name in names}
    pair = record["paired"]["lite against height-band"]
    metrics = {"nll": "NLL", "brier": "Brier", "iou_free": "IoU free", "iou_occupied": "IoU occupied"}
    better = ", ".join(f"{title} {lite[m]} / {band[m]} ({pair[m]['wins']})" for m, title in metrics.items())
    pooled, known = models["lite"]["micro"], record["occupied cells weighed more, 20 validation frames, pooled"]["1"]
    return {
        "masses": (
            f"Mean unknown: {released['mean_unknown']} as released, {band['mean_unknown']} with evidence 10, "
            f"{lite['mean_unknown']} with `lite`, {sum(unknown) / len(unknown):.3f} in truth."
        ),
        "vehicles": (
            f"`lite` predicts {vehicles['lite']['called occupied']} of such cells occupied and "
            f"{vehicles['lite']['false free']} free in unseen towns,\nthe baseline "
            f"{vehicles['height-band']['called occupied']} and {vehicles['height-band']['false free']}."
        ),
        "better": f"`lite` / evidence 10 (frames won of {pair['nll']['frames']}): {better}.",
        "second order": (
            f"AUROC of unknown: `lite` {lite['auroc_unknown']}, `RayISM` {ray['auroc_unknown']}, baseline "
            f"{band['auroc_unknown']}. ECE of occupied / (free + occupied):\n{lite['ece_relative']}, "
            f"{ray['ece_relative']}, {band['ece_relative']}. ECE of P: {lite['ece']} for `lite`, as evidence 10 allows "
            "1/12 at best."
        ),
        "places": (
            f"Pooled IoU of free {value(pooled['iou_free'])}, of occupied {value(pooled['iou_occupied'])}; in known "
            f"towns with other traffic (20 validation frames)\n{value(known['iou_free'])} and "
            f"{value(known['iou_occupied'])}."
        ),
    }  # fmt: skip


def _sentence_of_ghosts(record: Record) -> str:
    maps = record["maps"]["combined"]
    area = {name: maps[name][MEAN]["ghost_area"][0] for name in (CLASSICAL, DEMPSTER, DEFAULTS)}
    free = {name: maps[name][MEAN]["static_false_free"][0] for name in area}
    fewer = 100 * (1 - free[DEFAULTS] / free[CLASSICAL])
    return (
        f"Behind `combined`, ghosts per moving object: classical filter {area[CLASSICAL]:.2f} m², Dempster's rule "
        f"{area[DEMPSTER]:.2f}, default rule {area[DEFAULTS]:.2f},\nwhich also has {fewer:.0f} % fewer occupied cells "
        "at P < 1/4 than the filter."
    )


def _sentence_of_objects(record: Record) -> str:
    names = {"lite": "`lite`", "combined": "`combined`", "ray": "`RayISM`", "height-band": "the baseline"}
    shares = (
        f"{title} {100 * one['occupied']:.1f} and {100 * one['free']:.1f} %"
        for name, title in names.items()
        for one in [record["models"][name]]
    )
    return (
        f"Of the cells under {record['objects']} annotated objects, hidden sides included, predicted occupied and "
        f"free\n([by set](results.md#objects-in-real-scans)): {', '.join(shares)}."
    )


def _sentence_of_speed(record: Record) -> str:
    times = {name: f"{one['median']:.3g} ms" for name, one in record["times [ms]"].items()}
    shipped = 1000 / record["times [ms]"]["lite by onnxruntime"]["median"]
    return (
        f"- **Ours** ([table](speed.md#the-network)): on two CPU cores `lite` maps\n  {shipped:.3g} scans "
        "per second by ONNX Runtime, the network of the paper's size "
        f"{record['summary']['paper']['scans per second']:.3g} by torch; baseline "
        f"{times['HeightBandISM']}, `RayISM` {times['RayISM']}. No GPU was measured."
    )


def _sentence_of_real(recordings: Record) -> str:
    best: dict[str, list[str]] = {}
    for name, recording in recordings.items():
        models = recording.get("alone", {}).get("models", {})
        values = {model: models[model]["mean"]["iou_occupied"][0] for model in COMPARED if model in models}
        if values and None not in values.values():
            best.setdefault(max(values, key=lambda model: values[model]), []).append(name)
    first, *others = sorted(best, key=lambda model: -len(best[model]))
    rest = "".join(f", for `{model}` on {', '.join(best[model])}" for model in others)
    return (
        f"IoU of occupied on labelled cells is highest for `{first}` on {len(best[first])} of "
        f"{sum(map(len, best.values()))} sets{rest}\n([recordings](results.md#real-recordings); false alarms cost "
        "nothing on two sets)."
    )
