"""Tables of the learned models: quality, losses, heads, training, combination, time."""

from collections.abc import Mapping
from typing import Any

from record_tables import change, marked, record, table, with_command

from ogm.metrics import METRICS

MODELS = {  # and titles in the README; the released baseline predicts no cell
    "height-band": "paper's baseline", "ray": "`RayISM`", "lite": "`lite`", "combined": "**`combined`, the default**",
}  # fmt: skip
QUALITY = (
    *("nll", "brier", "iou_free", "iou_occupied", "iou_unknown", "false_free", "missed_occupied", "ece"),
    *("ece_relative", "auroc_unknown"),
)
OLD_EXTENT = "100 frames of 10 drives in 1 town"  # of records that do not say it


def headline() -> str:
    """Return the table of the README: the models on the simulated test drives."""
    means = record("deep_quality")["models"]
    titles = {
        "brier": "Brier score ↓", "iou_free": "IoU free ↑", "iou_occupied": "IoU occupied ↑",
        "false_free": "occupied cells predicted free ↓", "auroc_unknown": "finding unknown cells (AUROC) ↑",
    }  # fmt: skip
    models = _models(means)
    rows = [
        [title, *(f"{means[model]['macro'][metric]['value']:.3f}" for model in models)]
        for metric, title in titles.items()
    ]
    return marked("deep_quality", table([extent(), *(MODELS[model] for model in models)], rows))


def _models(recorded: Mapping[str, Any]) -> list[str]:
    """Return the models that a record has, in the order of the tables."""
    return [model for model in MODELS if model in recorded]


def extent() -> str:
    """Return the numbers of frames, drives and towns of `deep_quality`."""
    return record("deep_quality").get("extent", OLD_EXTENT)


def combined() -> str:
    """Return the scores of the combination of `ray` and `lite`, and of its parts."""
    found = record("combined")
    titles = {
        "nll": "log loss", "false_free": "false free", "brier": "Brier", "iou_free": "IoU free",
        "iou_occupied": "IoU occupied", "ece": "ECE",
    }  # fmt: skip
    simulated = {f"validation `{name}`": one for name, one in found["validation"].items()}
    rows = []
    for name, one in (simulated | found["real"]).items():
        place = f"{name}, frames: {one['frames']}"
        for model, mean in one["means"].items():
            if model not in ("ray", "lite", "combined"):
                continue
            cells = ["–" if mean[metric] is None else f"{mean[metric]:.3f}" for metric in titles]
            rows.append([place if model == "ray" else "", f"`{model}`" if " " not in model else model, *cells])
    tables = [table(["", "", *titles.values()], rows, left=2)]
    rows = []
    for name, one in simulated.items():  # with intervals; the others can be subtracted
        for other in ("ray", "lite"):
            differences = [one["against"][other][metric]["difference"] for metric in ("nll", "false_free", "brier")]
            rows.append([f"{name}: `combined` minus `{other}`", *map(change, differences)])
    tables.append(table(["difference (95 %)", "log loss", "false free", "Brier"], rows))
    return with_command("combined", *tables)


def deep_quality() -> str:
    """Return means over frames of all models on the test frames."""
    found = record("deep_quality")
    models, rows = _models(found["models"]), []
    for metric in QUALITY:
        facts = found["metrics"][metric]
        arrow = {"lower": " ↓", "higher": " ↑"}.get(facts["better"] or "", "")
        cells = []
        for model in models:
            one = found["models"][model]["macro"][metric]
            ends = "" if one["low"] is None else f"\xa0({one['low']:.3f}–{one['high']:.3f})"
            cells.append(f"{one['value']:.3f}{ends}")
        rows.append([f"{facts['title']}{arrow}", *cells])
    return table(["mean (95 %)", *(f"`{model}`" for model in models)], rows)


def deep_occupied() -> str:
    """Return the predictions of occupied cells, by the objects in them."""
    found = record("deep_quality")["occupied cells by what stands there, pooled"]
    kinds = {
        "participants": "traffic participants with 50 returns or more",
        "thick": "all else, where 3 x 3 cells fit", "thin": "all else, thinner (fences, poles, edges)",
    }  # fmt: skip
    models, rows = _models(found), []
    for kind, title in kinds.items():
        keys = [key for state in ("free", "occupied") for key in found[models[0]][kind] if key.endswith(state)]
        shares = ([f"{100 * found[model][kind][key]:.1f}" for key in keys] for model in models)
        rows.append([title, *map(", ".join, shares)])
    return table(["occupied cells, predicted free, occupied [%]", *(f"`{model}`" for model in models)], rows)


def generations() -> str:
    """Return the scores of all generations of the network, and the shares of occupied cells by what is there."""
    found = record("generations")
    titles = {"ray": "`ray`", "first": "first", "second": "second", "lite": "third, `lite`", "combined": "`combined`"}
    metrics = ("nll", "false_free", "iou_free", "iou_occupied", "ece_relative", "auroc_unknown")
    heads, rows, kinds = [METRICS[metric].title for metric in metrics], [], []
    for name, one in found["data"].items():
        place = f"`{name}`, frames: {one['frames']}"
        for model in (model for model in titles if model in one["means"]):
            scores = (f"{one['means'][model][metric]:.3f}" for metric in metrics)
            rows.append(["" if model != "ray" else place, titles[model], *scores])
    models = [model for model in titles if model in found["data"][name]["means"]]
    for kind, shares in found["data"][name]["occupied cells"].items():
        cells = (f"{100 * shares[model]['free']:.0f}, {100 * shares[model]['occupied']:.0f}" for model in models)
        kinds.append([kind, f"{100 * shares['share']:.0f} %", *cells])
    first = f"occupied cells of `{name}`: predicted free, occupied [%]"
    shown = table([first, "share", *(titles[model] for model in models)], kinds)
    return with_command("generations", table(["", "", *heads], rows, left=2), shown)


def levers() -> str:
    """Return what data, rays, size and combination each change."""
    shown, found = (
        ("nll", "false_free", "iou_free", "iou_occupied"),
        record("generations")["data"]["GEN3"]["minus lite"],
    )
    rays = record("deep_training")["truth of validation"]["aimed"]["minus aimed"]["no rays"]

    def reversed_signs(changes: Mapping[str, Any]) -> dict[str, Any]:
        return {metric: [-value, -high, -low] for metric, (value, low, high) in changes.items()}

    rows = {
        "data: `GEN3`, third minus second": reversed_signs(found["second"]),
        "combination: `GEN3`, `combined` minus third": found["combined"],
        "rays as inputs: minus none": reversed_signs(rays),
        "size: the paper's minus `LITE`": record("deep_size")["scores"]["minus LITE"]["PAPER"],
    }
    heads = ["lever", *(METRICS[metric].title for metric in shown)]
    return table(heads, [[name, *(change(one[m]) for m in shown)] for name, one in rows.items()])


def divergences() -> str:
    """Return the divergences of `lite` and of both baselines, with the frames that `lite` wins."""
    found = record("deep_quality")
    titles = {
        "kl_e10": "KL, E = 10", "kl_e1": "KL, E = 1, as the code's labels",
        "legacy_kl": 'the released code\'s "KL", not averaged',
    }  # fmt: skip
    rows = []
    for metric, title in titles.items():
        cells = [f"{found['models']['lite']['macro'][metric]['value']:.3f}"]
        for other in ("height-band", "height-band-released"):
            cells.append(f"{found['models'][other]['macro'][metric]['value']:.3f}")
            cells.append(f"{found['paired'][f'lite against {other}'][metric]['wins']:.0f}")
        rows.append([title, *cells])
    heads = ["mean, and frames that `lite` wins", "`lite`", "baseline, evidence 10", "", "baseline as released", ""]
    return marked("deep_quality", table(heads, rows))


def objects() -> str:
    """Return the shares of annotated real objects that the models predict occupied, and free."""
    found = record("objects")
    models = _models(found["all"]["all"]["models"])
    sets = found["sets"] | {name if name == "all" else f"all, {name}": one for name, one in found["all"].items()}
    rows = []
    for name, one in sets.items():
        shares = (one["models"][model] for model in models)
        cells = [f"{100 * share['occupied']:.1f}, {100 * share['free']:.1f}" for share in shares]
        rows.append([name, f"{one['objects']}, {one['boxes']}", *cells])
    return table(["occupied, free [% of cells]", "objects, boxes", *models], rows)


def deep_training() -> str:
    """Return the changes of a short training by truth and inputs."""
    shown = ("nll", "false_free", "iou_free", "iou_occupied")
    rows = []
    for truth, found in record("deep_training")["truth of validation"].items():
        by = {"dense": "12,000 layers"}.get(truth, f"`{truth}`")
        rows.append([by, "`aimed`", *(f"{found['means']['aimed'][one]:.3f}" for one in shown)])
        rows.append(["", "`hd`, minus `aimed`", *(change(found["minus aimed"]["hd"][m]) for m in shown)])
    heads = ["evaluated by", "trained on", "log loss", "false free", "IoU free", "IoU occupied"]
    return with_command("deep_training", table(heads, rows))


def deep_speed() -> str:
    """Return the time of the networks."""
    found = record("deep_speed")
    times, summary = found["times [ms]"], found["summary"]

    def ms(name: str) -> str:
        return f"{times[name]['median']:.3g} ms"

    parts = {
        "points to `EvidentialGrid`": ("lite, whole", "paper, whole"),
        "its convolutions alone": ("lite, convolutions", "paper, convolutions"),
    }
    rows = [[title, *map(ms, names)] for title, names in parts.items()]
    networks = [summary[name] for name in ("lite", "paper")]
    rows += [
        ["scans per second", *(f"{one['scans per second']:.3g}" for one in networks)],
        ["share of the time outside convolutions", *(f"{one['share outside convolutions']:.0%}" for one in networks)],
    ]
    models = {"RayISM": "`RayISM`", "HeightBandISM": "`HeightBandISM`", "CombinedISM": "**`combined`, the default**"}
    rows += [[title, ms(name), ""] for name, title in models.items() if name in times]
    networks_table = table(["57,600 points, two cores", "`lite`", "`paper`"], rows)
    return f"{networks_table}\n\n{deep_engines(found)}" if "differences in mass" in found else networks_table


def deep_engines(found: Mapping) -> str:
    """Return the times of the engines of the shipped network."""
    times, starts = found["times [ms]"], found["loading, first import to first grid"]
    rows = []
    for name, error in found["differences in mass"].items():
        engine = name.removeprefix("lite by ")
        faster = found["summary"]["engines, torch / engine"][name]["medians"]
        start = f"{starts[engine]['best [s]']:.2g} s" if engine in starts else ""
        rows.append([engine, f"{times[name]['median']:.3g} ms", f"{faster:.2f}", start, f"{error['largest']:.1e}"])
    heads = ["`lite`, points to `EvidentialGrid`", "time", "times as fast as torch", "import to first grid"]
    return table([*heads, "largest difference of a mass"], rows)
