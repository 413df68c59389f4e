"""Sentences of docs/reproduction.md that hold measured numbers, made from the records alone."""

from collections.abc import Mapping
from typing import Any

from record_tables import mark, percent, value

__all__ = ["sentences"]

Record = Mapping[str, Any]
CLASSICAL, DEFAULTS, DEMPSTER = "classical Bayes", "EvidentialMapper, default", "Dempster, 2 s"
MEAN, RATIO = "mean and 95 % interval", "ratio to the classical filter"


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
        "quality": _sentences_of_town(quality["town"]) | {"quality: real": _sentence_of_real(quality["real"])},
    }
    return {key: text + mark(name) for name, texts in found.items() for key, text in texts.items()}


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
    return (
        f"Behind `combined`, ghosts per moving object: classical filter {area[CLASSICAL]:.2f} m², Dempster's rule "
        f"{area[DEMPSTER]:.2f}, default rule {area[DEFAULTS]:.2f},\n{area[DEFAULTS] / area[CLASSICAL]:.2f} times the "
        f"filter's. The default rule has {100 * (1 - free[DEFAULTS] / free[CLASSICAL]):.0f} %\nfewer occupied cells at "
        "P < 1/4."
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
        f"- **Ours** (`{record['command']}`, [table](results.md#time-of-the-network)): on two CPU cores, points to "
        f"grid, `lite`\n  {shipped:.3g} scans per second by ONNX Runtime, the network of the paper's size "
        f"{record['summary']['paper']['scans per second']:.3g} by torch; baseline "
        f"{times['HeightBandISM']}, `RayISM` {times['RayISM']}. No GPU was measured."
    )


def _sentences_of_town(town: Record) -> dict[str, str]:
    models, published = town["models"], town["as the released code would report"]
    claimed = {
        name: percent(1 - one["called unknown, free, occupied, of truly unknown, free, occupied"][0][0])
        for name, one in models.items()
    }
    return {
        "quality: unknown": (
            f"Of the truly unknown cells, `lite` predicts {claimed['lite']} known, `ray` {claimed['ray']}, the "
            f"baseline {claimed['height-band']} ([quality](quality.md))."
        ),
        "quality: divergence": (
            f"The released code would report a KL of {value(published['KL, deep'])} for `lite` and "
            f"{value(published['KL, geometric, mean of both'])} for its baseline (itself "
            f"{value(published['KL, geometric itself'])}),\nand accuracies of {value(published['accuracy, deep'])} and "
            f"{value(published['accuracy, geometric'])} ([quality](quality.md))."
        ),
    }


def _sentence_of_real(recordings: Record) -> str:
    best: dict[str, list[str]] = {"lite": [], "ray": [], "height-band": []}
    for name, one in recordings.items():
        models = one.get("alone", {}).get("models", {})
        values = {m: models[m]["mean"]["iou_occupied"][0] for m in best if m in models}
        if len(values) == len(best) and None not in values.values():
            best[max(values, key=lambda m: values[m])].append(name)
    count = sum(map(len, best.values()))
    others = "; ".join(f"`{m}` on {', '.join(names)}" for m, names in best.items() if names and m != "lite")
    return (
        f"IoU of occupied on labelled cells is highest for `lite` on {len(best['lite'])} of {count} sets"
        f"{', for ' + others if others else ''}\n([quality](quality.md#real-recordings); false alarms cost nothing on "
        "two sets)."
    )
