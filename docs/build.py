"""Make the tables of the documentation from the records of the benchmarks.

    python docs/build.py            # writes docs/results.md and fills the marked tables of other pages
    python docs/build.py --check    # writes nothing; exit code 1 if a page differs from its record

A marked table stands between ``<!-- name -->`` and ``<!-- /name -->``. Every number comes from
``benchmarks/results/*.json``, which the command named beside the table writes.
"""

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from data_store_tables import data_store_tables
from dynamic_tables import dynamic_tables
from quality_tables import tables
from radar_tables import far_tables, fusion_tables, radar_tables
from reliability_tables import reliability_tables
from reproduction_sentences import sentences
from world_tables import build_tables, cost_tables, rule_tables, world_tables

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
RECORDS = "../benchmarks/results"  # from docs/
MODELS = ("height-band", "ray", "lite")  # the released baseline predicts no cell: docs/quality.md
QUALITY = (
    *("nll", "brier", "iou_free", "iou_occupied", "iou_unknown", "iou_occupied_known", "false_free", "missed_occupied"),
    *("ece", "ece_relative", "auroc_unknown", "mean_unknown", "kl_e10"),
)
LOSSES = (  # titles of what is compared of trainings; the last is what the reverse KL minimises
    *("nll", "brier", "iou_free", "iou_occupied", "iou_unknown", "iou_free_known", "iou_occupied_known"),
    *("false_free", "missed_occupied", "ece", "auroc_unknown", "kl_e10"),
)
OLD_EXTENT = "100 frames of 10 drives in 1 town"  # of records that do not say it
MAPS = {  # name in the record -> title
    "scan alone": "scan alone",
    "classical Bayes": "classical Bayes (0.12 to 0.97, never forgets)",
    "cautious, dynamic decay, 0.04 s": "**`EvidentialMapper` with its defaults**",
    "Dempster, 2 s": "Dempster, 2 s",
    "Dempster, dynamic decay, 0.5 s": "Dempster, dynamic decay, 0.5 s",
    "Dempster, evidence fades, 0.5 s": "Dempster, evidence fades, 0.5 s",
    "Bayes, pignistic, 5 s": "Bayes, 5 s",
    "Bayes, plausibility, limits as Dempster, 0.5 s": "Bayes by plausibility, limits as Dempster, 0.5 s",
    "Yager, never forgets": "Yager, never forgets",
    "PCR6, 2 s": "PCR6, 2 s",
    "cumulative, 1 s": "cumulative, 1 s",
    "cumulative, dynamic decay, 0.2 s": "cumulative, dynamic decay, 0.2 s",
    "cumulative, evidence fades, 0.5 s": "cumulative, evidence fades, 0.5 s",
    "cautious, 1 s": "cautious, 1 s",
    "cautious, 2 s": "cautious, 2 s",
    "averaging, never forgets": "averaging, never forgets",
    "weighted, 2 s": "weighted, 2 s",
}
MAIN_MAPS = (  # those that docs/fusion.md compares
    *("scan alone", "classical Bayes", "cautious, dynamic decay, 0.04 s", "Dempster, 2 s"),
    *("Bayes, plausibility, limits as Dempster, 0.5 s", "Yager, never forgets", "cumulative, 1 s"),
    "cumulative, evidence fades, 0.5 s",
)
MAIN_COLUMNS = ("static_iou_occupied", "static_false_free", "appear_first", "body_recall", "view_ece")
MAP_COLUMNS = {
    "static_iou_occupied": "IoU occupied",
    "static_false_free": "false free (P < 1/4)",
    "static_brier": "Brier",
    "static_known": "known and right",
    "ghost_area": "ghosts [m²]",
    "ghost_1s": "... older than 1 s",
    "appear_first": "new obstacle seen at once",
    "body_recall": "moving cells occupied",
    "view_ece": "ECE",
}


@cache
def record(name: str) -> Any:
    """Read a record."""
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown; the first column is text, the others are numbers."""
    lines = [f"| {' | '.join(head)} |", f"|---|{'---:|' * (len(head) - 1)}"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def source(name: str) -> str:
    """Return where a table comes from: command, date, machine, and what has changed since."""
    found = record(name)
    outdated = f" **Outdated:** {found['outdated']}" if "outdated" in found else ""
    found = found.get("environment", found)
    return (
        f"*`{found['command']}`, {found['date'].split()[0]}, {found['cpu']}, {found['cores used']} of {found['cores']} "
        f"cores; [record](../benchmarks/results/{name}.json).*{outdated}"
    )


def section(title: str, name: str, *parts: str) -> str:
    """Return a section of the page of results."""
    found = record(name)
    facts = found.get("environment", found)
    cpu = re.sub(r"\((R|TM)\)| Processor| @.*", "", facts["cpu"])
    cores = "1 core" if facts["cores used"] == 1 else f"{facts['cores used']} cores"
    made = f"*`{facts['command']}`, {facts['date'].split()[0]}, {cpu}, {cores}; [record]({RECORDS}/{name}.json).*"
    outdated = [f"**Outdated:** {found['outdated']}"] if "outdated" in found else []
    return "\n\n".join([f"## {title}", *parts, made, *outdated])


# --- One table each -------------------------------------------------------------------------------------


def headline() -> str:
    """Return the table of the README: three models on the simulated test drives."""
    means = record("deep_quality")["models"]
    titles = {
        "brier": "Brier score ↓",
        "iou_free": "IoU free ↑",
        "iou_occupied": "IoU occupied ↑",
        "false_free": "occupied cells predicted free ↓",
        "auroc_unknown": "finding unknown cells (AUROC) ↑",
    }
    models = ("height-band", "ray", "lite")
    rows = [
        [title, *(f"{means[model]['macro'][metric]['value']:.3f}" for model in models)]
        for metric, title in titles.items()
    ]
    return table([extent(), "paper's baseline", "`RayISM`", "`lite`"], rows)


def extent() -> str:
    """Return how many frames, drives and towns `deep_quality` is of."""
    return record("deep_quality").get("extent", OLD_EXTENT)


def speed() -> str:
    """Return the time per scan of ogm's models, of peers and of a copy."""
    times = {one["size"]: one["times"] for one in record("speed")["comparisons"] if one["scan"].startswith("KITTI")}
    octomap = min(
        (name for name in times["120k"] if name.startswith("OctoMap")),
        key=lambda name: times["120k"][name]["median [ms]"],
    )
    names = {
        "copy of the bytes it must read and write": "copying the bytes that must be read and written",
        "HeightBandISM": "**`HeightBandISM`**",
        "RayISM": "**`RayISM`**, with ground",
        "local_ground": "`local_ground` alone",
        "Patchwork++": "Patchwork++ (ground alone)",
        "KISS-SLAM mapper": "KISS-SLAM's native mapper (3D)",
        octomap: f"{octomap}, the fastest of five ways (3D)",
    }
    rows = []
    for name, title in names.items():
        cells = [times[size][name]["median [ms]"] if name in times[size] else None for size in times]
        copies = times["120k"]["copy of the bytes it must read and write"]["median [ms]"]
        ratio = "" if cells[-1] is None else f"{cells[-1] / copies:.3g}"
        rows.append([title, *("" if one is None else f"{one:.3g} ms" for one in cells), ratio])
    return table(["KITTI scan, HDL-64E", "57,600 points", "120,000 points", "x copy"], rows)


def speed_steps() -> str:
    """Return the time of each step of `RayISM`, and what two threads gain."""
    found = record("speed")
    timed, threads = found["steps of RayISM"], found["two threads"]
    rows = [[name, f"{one['median [ms]']:.2g} ms"] for name, one in timed["times"].items()]
    gain = f"Two threads map {threads['ratio']:.2f} times as many scans per second as one, with the same result."
    return "\n\n".join([table([f"step, {timed['scan']}, 120,000 points", "time"], rows), gain, source("speed")])


def steps() -> str:
    """Return what is predicted where a step's face returns beams, by its height and place."""
    found, places = record("scenes")["scenes"], ("at 8 m", "at 12 m", "at 15 m", "along")
    rows = []
    for height in sorted({name.split()[1] for name in found if name.startswith("step ")}):
        faces = [found[f"step {height} m {place}"]["face"] for place in places]
        rows.append([f"{height} m", *(f"{100 * one['free']:.0f} / {100 * one['occupied']:.0f}" for one in faces)])
    return table(["step, free / occupied [%]", *(place.replace("at", "ahead,") for place in places)], rows)


def silence() -> str:
    """Return what maps of a lidar clear in fog: before silence was weighed, with it, and without silent beams."""
    found = record("silence")
    ways = (found["before"], "with silence"), (found["means over drives"], "with silence")
    ways = (*ways, (found["means over drives"], "echoes alone"))
    rows = []
    for sky in dict.fromkeys(key.rpartition(", ")[0] for key in found["before"]):
        for what in ("scan", "map"):
            cells = [
                " / ".join(f"{means[f'{sky}, {way}'][what][metric]:.3f}" for means, way in ways)
                for metric in ("false_free", "nll", "iou_free", "iou_occupied")
            ]
            rows.append([f"{sky}: {what}", *cells])
    head = ("before / now / echoes alone", "false free", "log loss", "IoU free", "IoU occupied")
    return "\n\n".join([table(head, rows), source("silence")])


def calibration() -> str:
    """Return the fitted parameters of `RayISM`, and what they change in unseen towns."""
    found = record("calibration")
    fitted, test = found["fitted"], found["test"]
    rows = []
    for name, value in fitted["parameters"].items():
        error = fitted["errors"].get(name)
        rows.append([f"`{name}`", f"{found['default'][name]:.3g}", f"{value:.3g}", f"{error:.2g}" if error else ""])
    parts = [table(["parameter", "default", "fitted", "standard error"], rows)]
    parts.append(f"Unseen towns, {test['frames']} frames of {test['drives']} drives:")
    names = {"nll": "NLL", "ece": "ECE", "false_free": "false free", "iou_free": "IoU free"}
    rows = [
        [
            title,
            *(f"{test['means'][which][name]:.3f}" for which in ("default", "fitted")),
            "{:.3f} ({:.3f} to {:.3f})".format(*test["fitted - default"][name]),
        ]
        for name, title in names.items()
    ]
    parts.append(table(["mean", "default", "fitted", "difference (95 %)"], rows))
    return "\n\n".join([*parts, source("calibration")])


def combined() -> str:
    """Return what the combination of `ray` and `lite` reaches, beside its parts."""
    found = record("combined")
    titles = {
        "nll": "log loss",
        "false_free": "false free",
        "brier": "Brier",
        "iou_free": "IoU free",
        "iou_occupied": "IoU occupied",
        "ece": "ECE",
    }
    simulated = {f"validation `{name}`": one for name, one in found["validation"].items()}
    rows = []
    for name, one in (simulated | found["real"]).items():
        place = f"{name}, frames: {one['frames']}, drives: {one['drives']}"
        for model, mean in one["means"].items():
            cells = ["–" if mean[metric] is None else f"{mean[metric]:.3f}" for metric in titles]
            rows.append([place if model == "ray" else "", f"`{model}`" if " " not in model else model, *cells])
    tables = [table(["", "", *titles.values()], rows).replace("|---|---:|", "|---|---|")]
    rows = []
    for name, one in simulated.items():  # with intervals; the others can be subtracted
        for other, compared in one["against"].items():
            differences = [compared[metric]["difference"] for metric in ("nll", "false_free", "brier")]
            cells = ["{:+.3f} ({:+.3f} to {:+.3f})".format(*values) for values in differences]
            rows.append([f"{name}: against `{other}`", *cells])
    tables.append(table(["`combined` minus a part (95 %)", "log loss", "false free", "Brier"], rows))
    cost = found["cost [ms]"]
    text = (
        f"Cost on one core, best of many calls ({found.get('cost measured', 'the same run')}): "
        f"`ray` {cost['ray']:.1f} ms, `lite` {cost['lite']:.1f} ms, `combined` "
        f"{cost['combined']:.1f} ms, of which combining {cost['combining alone']:.2f} ms (copying both grids: "
        f"{cost['copy of both grids']:.2f} ms)."
    )
    return "\n\n".join([*tables, text, source("combined")])


def ground() -> str:
    """Return precision, recall and F1 of ground and obstacle points."""
    rows = []
    for kind in ("obstacle", "ground"):
        for name, groups in record("ground")["labelled"].items():
            scores = groups["not seen while choosing"]["together"]
            cells = [
                " / ".join(f"{100 * scores[who][f'{kind} {what}']:.1f}" for what in ("precision", "recall", "F1"))
                for who in ("local_ground", "Patchwork++")
            ]
            rows.append([f"{kind}, {name}", *cells])
    return table(["precision / recall / F1 [%]", "`local_ground`", "Patchwork++"], rows)


def deep_quality() -> str:
    """Return means over frames of all models on the test frames."""
    found = record("deep_quality")
    rows = []
    for metric in QUALITY:
        facts = found["metrics"][metric]
        arrow = {"lower": " ↓", "higher": " ↑"}.get(facts["better"] or "", "")
        cells = []
        for model in MODELS:
            one = found["models"][model]["macro"][metric]
            ends = "" if one["low"] is None else f"\xa0({one['low']:.3f}–{one['high']:.3f})"
            cells.append(f"{one['value']:.3f}{ends}")
        rows.append([f"{facts['title']}{arrow}", *cells])
    return table(["mean (95 %)", *(f"`{model}`" for model in MODELS)], rows)


def deep_targets() -> str:
    """Return which targets `lite` reaches."""
    rows = [
        [row["what"], row["wanted"], f"{row['value']:.3f}", "reached" if row["met"] else "**missed**"]
        for row in sorted(record("deep_quality")["wanted"], key=lambda row: row["what"].startswith(("kl_", "legacy")))
    ]
    return table(["target of `lite`", "wanted", "measured", ""], rows)


def deep_occupied() -> str:
    """Return what models predict of occupied cells, by what stands in them."""
    found = record("deep_quality")["occupied cells by what stands there, pooled"]
    kinds = {
        "participants": "traffic participants with 50 returns or more",
        "thick": "all else, where 3 x 3 cells fit",
        "thin": "all else, thinner (kerbs, fences, poles, edges)",
    }
    rows = []
    for kind, title in kinds.items():
        for what, word in (("false free", "free"), ("called occupied", "occupied")):
            rows.append([f"{title}: {word}", *(f"{100 * found[model][kind][what]:.1f} %" for model in MODELS)])
    return table(["occupied cells, predicted", *(f"`{model}`" for model in MODELS)], rows)


def deep_losses() -> str:
    """Return what networks reach that were trained alike with other losses."""
    scores = record("deep_losses")["scores"]
    metrics = [metric for metric in LOSSES if metric in scores["reverse KL"]]
    titles = [record("deep_quality")["metrics"][metric]["title"] for metric in metrics]
    rows = [[name, *(f"{one[metric]['value']:.3f}" for metric in metrics)] for name, one in scores.items()]
    return table(["loss, one seed each", *titles], rows)


def losses_of_the_paper() -> str:
    """Return the losses of the paper, of its code, and our default."""
    scores = record("deep_losses")["scores"]
    names = {
        "squares as printed": "as printed, α / S",
        "squares as released": "as released, e / S",
        "squares as released, occupied x 100": "as released, occupied x 100",
        "reverse KL": "reverse KL, our default",
    }
    metrics = {
        "brier": "Brier",
        "iou_free": "IoU free",
        "iou_occupied": "IoU occupied",
        "auroc_unknown": "AUROC unknown",
        "ece": "ECE",
        "kl_e10": "KL, E = 10",
    }
    rows = [[title, *(f"{scores[name][metric]['value']:.3f}" for metric in metrics)] for name, title in names.items()]
    return table(["", *metrics.values()], rows)


def divergences() -> str:
    """Return the divergences of `lite` and of both baselines, with the frames that `lite` wins."""
    found = record("deep_quality")
    titles = {
        "kl_e10": "KL[grid ‖ truth], E = 10",
        "kl_e1": "KL[grid ‖ truth], E = 1, as the code's labels",
        "kl_e1_scaled": "the same, a tenth of every model's evidence",
        "legacy_kl": 'the released code\'s "KL", not averaged',
    }
    rows = []
    for metric, title in titles.items():
        cells = [f"{found['models']['lite']['macro'][metric]['value']:.3f}"]
        for other in ("height-band", "height-band-released"):
            cells.append(f"{found['models'][other]['macro'][metric]['value']:.3f}")
            cells.append(f"{found['paired'][f'lite against {other}'][metric]['wins']:.0f}")
        rows.append([title, *cells])
    return table(
        ["mean, and frames that `lite` wins", "`lite`", "baseline, evidence 10", "", "baseline as released", ""], rows
    )


def objects() -> str:
    """Return what share of annotated real objects the models predict occupied, and free."""
    found = record("objects")
    models = ("height-band", "ray", "first lite", "lite", "combined")
    sets = found["sets"] | {name if name == "all" else f"all, {name}": one for name, one in found["all"].items()}
    rows = []
    for name, one in sets.items():
        shares = (one["models"][model] for model in models)
        cells = [f"{100 * share['occupied']:.1f}, {100 * share['free']:.1f}" for share in shares]
        rows.append([name, f"{one['objects']}, {one['boxes']}", *cells])
    return table(["occupied, free [% of cells]", "objects, boxes", *models], rows)


def deep_heads() -> str:
    """Return what other heads of the network change."""
    found = record("deep_heads")["sets"]["validation"]
    areas = {name: f"{value:.2f}" for name, value in found["wrong cells"]["auroc"].items()}
    telling = {
        "shipped": f"unknown {areas['unknown']}, smaller mass {areas['smaller mass']}",
        "several": f"unknown {areas['unknown of several']}, spread {areas['spread of several']}",
    }
    titles = {"head": "last layer", "detail": "at full resolution too", "several": "five last layers"}
    shown = ("nll", "false_free", "iou_occupied")
    rows = [["shipped", *(f"{found['means']['shipped'][one]:.3f}" for one in shown), telling["shipped"]]]
    for name, title in titles.items():
        rows.append([title, *changes(found["minus shipped"][name], shown), telling.get(name, "")])
    heads = ["", "log loss", "false free", "IoU occupied", "telling wrong cells (AUROC) by"]
    return table(heads, rows) + "\n\n" + source("deep_heads")


def changes(found: dict, metrics: tuple[str, ...]) -> list[str]:
    """Return differences with their intervals."""
    return ["{:+.3f} ({:+.3f} to {:+.3f})".format(*found[one]) for one in metrics]


def deep_training() -> str:
    """Return how truth and inputs change a short training."""
    shown = ("nll", "false_free", "iou_free", "iou_occupied")
    titles = {"hd": "`hd`, minus `aimed`", "no rays": "`aimed` without rays, minus `aimed`"}
    rows = []
    for truth, found in record("deep_training")["truth of validation"].items():
        by = {"dense": "12,000 layers"}.get(truth, f"`{truth}`")
        rows.append([by, "`aimed`", *(f"{found['means']['aimed'][one]:.3f}" for one in shown)])
        rows += [["", title, *changes(found["minus aimed"][name], shown)] for name, title in titles.items()]
    heads = ["evaluated by", "trained on", "log loss", "false free", "IoU free", "IoU occupied"]
    return table(heads, rows) + "\n\n" + source("deep_training")


def deep_speed() -> str:
    """Return the time of the networks."""
    found = record("deep_speed")
    times, summary = found["times [ms]"], found["summary"]

    def ms(name: str) -> str:
        return f"{times[name]['median']:.3g} ms"

    parts = {
        "points to `EvidentialGrid`": ("lite, whole", "paper, whole"),
        "pillars": ("pillars", "pillars"),
        "features and feature map": ("lite, pillars to feature map", "paper, pillars to feature map"),
        "feature map to evidence": ("lite, feature map to evidence", "paper, feature map to evidence"),
        "its convolutions alone": ("lite, convolutions", "paper, convolutions"),
    }
    rows = [[title, *map(ms, names)] for title, names in parts.items()]
    networks = [summary[name] for name in ("lite", "paper")]
    rows += [
        ["scans per second", *(f"{one['scans per second']:.3g}" for one in networks)],
        ["share of the time outside convolutions", *(f"{one['share outside convolutions']:.0%}" for one in networks)],
        ["`RayISM`, `HeightBandISM` in the same run", f"{ms('RayISM')}, {ms('HeightBandISM')}", ""],
    ]
    networks_table = table(["57,600 points, two cores", "`lite`", "`paper`"], rows)
    return f"{networks_table}\n\n{deep_engines(found)}" if "differences in mass" in found else networks_table


def deep_engines(found: dict) -> str:
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


def fusion(part: str, names: Sequence[str] = tuple(MAPS), columns: Sequence[str] = tuple(MAP_COLUMNS)) -> str:
    """Return what maps reach on simulated test drives, behind a sensor model."""
    maps = record("fusion_quality")[part]
    rows = []
    for name in names:
        if name not in maps:
            continue
        means, ratio = (maps[name]["mean and 95 % interval"], maps[name]["ratio to the classical filter"]["ghost_area"])
        cells = [
            f"{means[key][0]:.{2 if key in ('ghost_area', 'appear_first', 'body_recall') else 3}f}" for key in columns
        ]
        cells.append(f"{ratio[0]:.2f}\xa0({ratio[1]:.2f}–{ratio[2]:.2f})")
        rows.append([MAPS[name], *cells])  # fmt: skip
    return table(["map", *(MAP_COLUMNS[key] for key in columns), "ghosts, x Bayes"], rows)


def fusion_real(without: Sequence[str] = ()) -> str:
    """Return what maps reach on a real drive, but for some rules and columns."""
    drive = record("fusion_real")["recordings"]["KITTI drive 0005"]
    moving, trails = drive["maps"]["moving boxes"]["models"], drive["trails"]["models"]
    columns = {"complete": "known", "iou_occupied": "IoU occupied", "false_free": "false free", "brier": "Brier"}
    columns = {key: title for key, title in columns.items() if title not in without}
    rows = []
    for name, means in drive["maps"]["mean"].items():
        if name not in trails or name.rpartition(", ")[2] in without:
            continue
        _, after, *_, ages = trails[name]["marked"].values()  # cells, share above P = 1/2 by age, ..., of all ages
        values = *(means[key] for key in columns), moving[name]["occupied"], moving[name]["free"], after[0]
        rows.append([name, *(f"{100 * value:.1f}" for value in (*values, next(iter(ages.values()))))])
    heads = *columns.values(), "moving: occupied", "moving: free", "trails after 0.1 s", "all trails"
    return table(["KITTI drive 0005 [%]", *heads], rows)


def fusion_speed() -> str:
    """Return the cost of an update."""
    times = record("fusion_speed")["times [ms]"]
    titles = {
        "copy": "copying the map, the conflict layers and the scan",
        "update, default": "**update with the defaults**",
        "update, numpy reference": "update, the reference in numpy",
        "scipy": "interpolating the map with scipy, combining in numpy",
        "RayISM + update": "**`RayISM` and update**",
    }
    rows = [
        [titles.get(name, name), f"{one['median']:.3g}", f"{one['median'] / times['copy']['median']:.3g}"]
        for name, one in times.items()
    ]
    return table(["one core, 512 x 352 cells", "time [ms]", "x copy"], rows)


def logs() -> str:
    """Return what it costs to open, read and map a log, per scan."""
    found = record("logs")
    formats = ("MCAP", "MCAP, zstd", "db3", "bag")
    ways = {
        "ogm, open": "open: place, time and pose of every scan",
        "ogm, read": "**read to `Scan`**",
        "rosbags, read": "`rosbags`, to an (N, 4) array",
        "mcap-ros2-support, read": "`mcap-ros2-support`, to an (N, 4) array",
        "ogm, RayISM, map, written": "**open, read, `RayISM`, map, map written to an MCAP**",
    }
    times = found["times per scan [ms]"]
    rows = [
        [title, *(f"{times[key]:.1f}" if (key := f"{way}: {name}") in times else "" for name in formats)]
        for way, title in ways.items()
    ]
    return table([f"one core, {found['points']:,} points; [ms] per scan", *formats], rows)


def live() -> str:
    """Return whether `ogm serve` keeps up."""
    found = record("live")["verdicts"]
    rows = [
        [
            one["what"],
            f"{one['got']:.3g} {one['unit']}".strip(),
            f"{one['wanted']:g}",
            "" if one["met"] else "**missed**",
        ]
        for one in found
    ]
    return table(["`ogm serve`, a viewer receives all", "measured", "at most", ""], rows)


def truth_modes() -> str:
    """Return what both truth modes of the simulator find."""
    modes = record("truth_modes")["against the reference"]
    rows = [[what.replace("called", "as"), *(f"{100 * modes[mode][what]:.1f} %" for mode in ("hd", "aimed"))]
            for what in modes["hd"] if not what.startswith("cells")]  # fmt: skip
    return table(["against 12,000 layers every 0.02 degrees", "`hd`", "`aimed`"], rows)


def simulation() -> str:
    """Return the cost of simulated samples."""
    cost = record("simulation")
    seconds, times = cost["one sample"]["seconds, median"], cost["one sample"]["times the rays alone, median"]
    worst = cost["one sample"]["times the rays alone, worst moment"]
    two, reading = cost["two workers"], cost["reading"]
    rows = [
        ["Open3D alone, the rays of a sample", f"{seconds['rays alone']:.2f} s"],
        ["a whole sample, `--truth hd`, written to disk", f"{seconds['hd']:.2f} s"],
        ["... in multiples of the rays alone (worst moment)", f"{times['hd']:.2f} ({worst['hd']:.2f})"],
        ["a whole sample, `--truth aimed`", f"{seconds['aimed']:.2f} s"],
        ["samples per second, one worker", f"{two['samples per second by one worker on one core']:.2f}"],
        ["... two workers", f"{two['samples per second by two workers on two']:.2f}"],
        ["bytes per sample", f"{two['bytes per sample']:,}"],
        ["samples read per second, one process", f"{reading['samples per second, 1 process']:.0f}"],
        ["... two processes", f"{reading['samples per second, 2 processes']:.0f}"],
    ]
    return table(["", "measured"], rows)


def metrics() -> str:
    """Return what each metric is."""
    from ogm.metrics import METRICS

    def cell(text: str) -> str:
        return text.replace("|", "∣")

    rows = [
        [f"`{name}`", one.title, one.better or "-", cell(one.description)]
        for name, one in METRICS.items()
        if not name.startswith("from")
    ]
    lower = {"from10_": "0.10 m, such as low kerbs", "from50_": "0.50 m, such as kerbs, low walls and plants"}
    place = 1 + next(k for k, row in enumerate(rows) if row[0] == "`missed_obstacles`")
    rows[place:place] = [
        [f"`{prefix}...`", METRICS[f"{prefix}iou_free"].title.replace("IoU free", "..."), "",
         f"{', '.join(name.removeprefix(prefix) for name in METRICS if name.startswith(prefix))}, but occupied cells "
         f"whose obstacle is lower than {what} are left out"]
        for prefix, what in lower.items()
    ]  # fmt: skip
    return table(["key", "title", "better", "what it is"], rows).replace("---:", "---")


def pythons() -> str:
    """Return which extras have wheels on which Python."""
    found = record("pythons")
    names = list(found["without a wheel"])
    versions = list(found["without a wheel"][names[0]])
    rows = []
    for name in names:
        cells = []
        for version in versions:
            lacking = found["without a wheel"][name][version]
            texts = dict.fromkeys(", ".join(one) for one in lacking.values())
            by_system = [f"{', '.join(one)} ({system})" for system, one in lacking.items() if one]
            cells.append("yes" if not any(texts) else f"no: {next(iter(texts)) if len(texts) == 1 else by_system[0]}")
        rows.append([f"`{name}`" if name != "base" else "the base", *cells])
    note = f"*`{found['command']}`, {found['date'].split()[0]}, uv {found['uv']}; [record](../benchmarks/results/pythons.json).*"
    return table(["", *versions], rows).replace("---:", "---") + "\n\n" + note


def coverage() -> str:
    """Return how often intervals hold the truth, least and most over how alike frames are."""
    cases = record("interval_coverage")["cases"]
    columns = dict.fromkeys((case["drives"], case["frames"][1]) for case in cases)
    heads = [f"{drives} drives" if drives > 1 else f"one drive, {frames} frames" for drives, frames in columns]
    shapes = list(dict.fromkeys(case["shape"] for case in cases))
    kinds = [(f"mean: {shape}", "mean", (shape,)) for shape in shapes]
    kinds += [("ratio of two means: all of these", "ratio", shapes), ("p below 0.05: all", "p below 0.05", shapes)]
    kinds += [("mean, were frames independent: all", "mean, frames as independent", shapes)]
    rows = []
    for title, what, of in kinds:
        cells = []
        for drives, frames in columns:
            column = [one for one in cases if (one["drives"], one["frames"][1]) == (drives, frames)]
            found = [one[what] for one in column if one["shape"] in of]
            cells.append(f"{100 * min(found):.1f}–{100 * max(found):.1f}")
        rows.append([title, *cells])
    return table(["[%]", *heads], rows)


def results() -> str:
    """Return the page of results."""
    boxes = (
        "Cells of an annotated object with a mass above 1/2, means over objects with 50 returns or more. The hidden "
        "side counts. `first lite`: the weights up to commit 6d90c29. No weights were chosen by these recordings."
    )
    parts = [
        "# Results",
        "Made by `python docs/build.py` from the records of the [benchmarks](../benchmarks/README.md). "
        "[Models compared](quality.md); [what intervals are worth](evaluation.md#intervals).",
        section(
            "Sensor models, simulated test drive",
            "deep_quality",
            *(f"{extent()}; {record('deep_quality')['intervals']}.", deep_quality(), deep_targets()),
            deep_occupied(),
        ),
        section("Objects in real scans", "objects", boxes, objects()),
        section("Losses of the network", "deep_losses", deep_losses()),
        section("Time per scan", "speed", speed()),
        section("Time of the network", "deep_speed", deep_speed()),
        section("Ground estimates, labelled returns not used while parameters were chosen", "ground", ground()),
        section(
            "Maps over time, 12 simulated test drives",
            "fusion_quality",
            *("Behind `RayISM`:", fusion("maps"), "Behind the first generation of `lite`:", fusion("maps behind lite")),
        ),
        section("Maps over time, a real drive", "fusion_real", "First generation of `lite`.", fusion_real()),
        section("Time of a map update", "fusion_speed", fusion_speed()),
        section("Time of logs", "logs", logs()),
        section("Live, 10 minutes at 10 Hz", "live", live()),
        section("Truth of the simulator", "truth_modes", truth_modes()),
        section("Cost of simulated samples", "simulation", simulation()),
    ]  # fmt: skip
    return "\n\n".join(parts) + "\n"


def fill(page: str, made: Mapping[str, str]) -> str:
    """Put tables between their markers, indented as these.

    Raises
    ------
    ValueError
        If the page has no place for one of them.
    """
    for name, text in made.items():
        begin, end = f"<!-- {name} -->", f"<!-- /{name} -->"
        place = re.compile(rf"^([ \t]*){re.escape(begin)}\n.*?^[ \t]*{re.escape(end)}", re.DOTALL | re.MULTILINE)
        found = place.search(page)
        if found is None:
            raise ValueError(f"the page has no place for {name}: {begin} and {end}, each on a line of its own")
        lines = "\n".join(found[1] + line for line in (begin, *text.splitlines(), end))
        page = page[: found.start()] + lines + page[found.end() :]
    return page


PAGES: dict[str, Callable[[], Mapping[str, str]]] = {
    "README.md": lambda: {"results": headline()},
    "docs/lite.md": lambda: {"results": headline()},
    "docs/deep.md": lambda: {"heads": deep_heads(), "training": deep_training(), "combined": combined()},
    "docs/dynamic.md": lambda: {"dynamic": "\n\n".join([*dynamic_tables(record("dynamic")), source("dynamic")])},
    "docs/fusion.md": lambda: {
        "simulated": "\n\n".join(
            f"Behind {model}:\n\n{fusion(part, MAIN_MAPS, MAIN_COLUMNS)}"
            for model, part in (("`RayISM`", "maps"), ("`lite`", "maps behind lite"))
        ),
        "real": fusion_real(("Yager", "cumulative", "matched", "Brier")),
    },
    "docs/geometric.md": lambda: {
        "calibration": calibration(),
        "silence": silence(),
        "steps": steps(),
        "time": speed_steps(),
    },  # fmt: skip
    "docs/project.md": lambda: {"pythons": pythons()},
    "docs/quality.md": lambda: tables(record("quality")),
    "docs/radar.md": lambda: {
        "radar": "\n\n".join([*radar_tables(record("radar")), source("radar")]),
        "radar-far": "\n\n".join([*far_tables(record("radar_far")), source("radar_far")]),
        "radar-fusion": "\n\n".join([*fusion_tables(record("radar_fusion")), source("radar_fusion")]),
    },
    "docs/reliability.md": reliability_tables,
    "docs/reproduction.md": lambda: (
        sentences(*map(record, ("quality", "deep_quality", "fusion_quality", "deep_speed")))
        | {"losses": losses_of_the_paper(), "divergence": divergences()}
    ),
    "docs/simulation.md": lambda: {
        "data_store": "\n\n".join([*data_store_tables(record("data_store")), source("data_store")])
    },
    "docs/world.md": lambda: {
        "world": "\n\n".join([*world_tables(record("world")), source("world")]),
        "rules": "\n\n".join([*rule_tables(record("world_rules")), source("world_rules")]),
        "build": "\n\n".join([*build_tables(record("world_build")), source("world_build")]),
        "cost": "\n\n".join(cost_tables(record("world"), record("world_build"))),
    },
    "docs/evaluation.md": lambda: {"metrics": metrics(), "coverage": coverage()},
}


def main() -> int:
    """Write the pages, or compare them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if a page differs")
    check = parser.parse_args().check
    made = {"docs/results.md": results()}
    made |= {name: fill((ROOT / name).read_text(encoding="utf-8"), parts()) for name, parts in PAGES.items()}
    differing = []
    for name, text in made.items():
        path = ROOT / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            differing.append(name)
            if not check:
                path.write_text(text, encoding="utf-8")
    print(f"{'differing' if check else 'written'}: {', '.join(differing) or 'none'}")
    return int(check and bool(differing))


if __name__ == "__main__":
    sys.exit(main())
