"""Tables of docs/quality.md and sentences of docs/reproduction.md, made from the record alone."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

__all__ = ["sentences", "tables"]

Record = Mapping[str, Any]
TITLES = {
    "kl_e10": "KL, E = 10", "kl_e1": "KL, E = 1", "kl_e1_scaled": "KL, E = 1, e/10", "iou_free": "IoU free",
    "iou_occupied": "IoU occupied", "iou_unknown": "IoU unknown", "iou_free_known": "IoU free, known",
    "iou_occupied_known": "IoU occupied, known", "false_free": "false free", "missed_occupied": "missed occupied",
    "false_occupied": "false occupied", "missed_obstacles": "missed obstacles", "free_recall_1": "free recall at 1 %",
    "free_recall_01": "free recall at 0.1 %", "ap_occupied_near": "AP occupied, 1 cell", "brier": "Brier",
    "nll": "NLL", "ece": "ECE", "ece_relative": "ECE, relative", "ace": "ACE",
    "interval_violation": "outside [Bel, Pl]", "auroc_unknown": "AUROC unknown", "fpr95_unknown": "FPR at 95 %",
    "aurc": "AURC", "ause": "AUSE", "conflict": "conflict", "legacy_kl": "released code's KL",
    "legacy_accuracy": "released code's accuracy", "mean_free": "mean free", "mean_occupied": "mean occupied",
    "mean_unknown": "mean unknown",
}  # fmt: skip
TOWN = (
    *("iou_free", "iou_occupied", "iou_unknown", "iou_occupied_known", "false_free", "missed_occupied"),
    *("false_occupied", "missed_obstacles", "free_recall_1", "ap_occupied_near", "brier", "nll", "ece"),
    *("ece_relative", "interval_violation", "auroc_unknown", "aurc", "kl_e10", "kl_e1", "kl_e1_scaled", "legacy_kl"),
    "mean_unknown",
)
PAIRS = ("kl_e10", "kl_e1", "iou_free", "iou_occupied", "false_free", "missed_obstacles", "brier", "auroc_unknown")
RANGE = {"iou_occupied": 3, "false_free": 3, "missed_occupied": 3, "free_recall_1": 3}
DRIVES = (
    *("iou_free", "iou_occupied", "false_free", "missed_occupied", "missed_obstacles", "free_recall_1", "brier"),
    *("ece_relative", "kl_e10", "mean_unknown"),
)
FUSED = (
    "ray",
    "ray + cautious",
    "ray + dempster",
    "ray + bayes",
    "lite",
    "lite + cautious",
    "lite + dempster",
    "lite + bayes",
)
REAL = ("iou_free", "iou_occupied", "false_free", "missed_occupied", "brier", "mean_unknown")


def tables(record: Record) -> dict[str, str]:
    """Return all tables by the names of their markers."""
    found: dict[str, str] = {}
    if record.get("town"):
        found |= {
            "town": _town(record["town"]),
            "pairs": _pairs(record["town"], _reversed(record["town"]["models"]), PAIRS),
            "range": _range(record["town"]),
            "published": _published(record["town"]["as the released code would report"]),
        }
    if record.get("drives"):
        found |= {"drives": _list(record["drives"]["models"], DRIVES), "memory": _memory(record["drives"])}
    if record.get("real"):
        found |= {"real": _real(record["real"], "alone"), "real-fused": _real(record["real"], "fused")}
    return found


def sentences(record: Record) -> dict[str, str]:
    """Return the sentences of docs/reproduction.md on the comparison, by the names of their markers."""
    found: dict[str, str] = {}
    if record.get("town"):
        found |= _sentences_of_town(record["town"])
    if record.get("drives"):
        found["quality: fusion"] = _sentence_of_drives(record["drives"])
    if record.get("real"):
        found["quality: real"] = _sentence_of_real(record["real"])
    return found


def _sentences_of_town(town: Record) -> dict[str, str]:
    models, published = town["models"], town["as the released code would report"]
    claimed = {
        name: _percent(1 - one["called unknown, free, occupied, of truly unknown, free, occupied"][0][0])
        for name, one in models.items()
    }
    mean = {m: {name: _value(one["mean"][m][0]) for name, one in models.items()} for m in TITLES}
    return {
        "quality: unknown": (
            f"Of the cells that are unknown in truth, `lite` predicts {claimed['lite']} free or occupied, `ray` "
            f"{claimed['ray']}, the baseline {claimed['height-band']} (`python benchmarks/quality.py`, [all\nfigures]"
            "(quality.md))."
        ),
        "quality: divergence": (
            f"The released code would report {_value(published['KL, deep'])} for `lite` and "
            f"{_value(published['KL, geometric, mean of both'])} for the released baseline, whose own value is "
            f"{_value(published['KL, geometric itself'])},\nand an accuracy of "
            f"{_value(published['accuracy, deep'])} for `lite` and "
            f"{_value(published['accuracy, geometric'])} for the baseline, which predicts no cell "
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
        f"`{name}` {_value(models[name]['mean']['iou_occupied'][0])} and "
        f"{_percent(models[name]['mean']['false_free'][0])}"
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
            rows.append(f"{name} {' / '.join(map(_value, values))}")
    return (
        "IoU of occupied on labelled cells, `lite` / `ray` / baseline, by truth from boxes, classes, maps and other\n"
        "scans: "
        f"{'; '.join(rows)} (`python benchmarks/quality.py`, [all figures](quality.md))."
    )


def _town(part: Record) -> str:
    models = part["models"]
    rows = [[TITLES[m], *(_with_half(one["mean"][m]) for one in models.values())] for m in TOWN]
    return _markdown(["mean over frames", *models], rows)


def _list(models: Record, metrics: Sequence[str]) -> str:
    rows = [[f"`{name}`", *(_value(one["mean"][m][0]) for m in metrics)] for name, one in models.items()]
    return _markdown(["", *(TITLES[m] for m in metrics)], rows)


def _reversed(models: Record) -> list[str]:
    """Return pairs, the best models first."""
    names = list(models)
    order = [name for name in ("paper", "lite", "ray") if name in names]
    return [f"{name} against {other}" for name in order for other in ("ray", "height-band") if name != other]


def _pairs(part: Record, names: Iterable[str], metrics: Sequence[str]) -> str:
    rows = []
    for name in names:
        for m in metrics:
            one = part["paired"].get(name, {}).get(m)
            if one is None:
                continue
            wins, ties, losses = one["wins, ties, losses"]
            cells = [
                f"{wins} / {ties} / {losses}",
                _with_ends(one["difference"]),
                _with_ends(one["ratio"]),
                _p(one["p"]),
            ]
            rows.append([name if m == metrics[0] else "", TITLES[m], *cells])
    return _markdown(["", "", "wins / ties / losses", "difference (95 %)", "ratio (95 %)", "p"], rows, left=2)


def _range(part: Record) -> str:
    edges = part["ranges [m]"]
    bins = [
        f"{low:g} to {high:g} m" if high is not None else f"beyond {low:g} m"
        for low, high in zip(edges[:-1], edges[1:], strict=True)
    ]
    rows = []
    for m, digits in RANGE.items():
        for k, (name, one) in enumerate(part["models"].items()):
            values = [_value(value, digits) for value in one["by range"][m]]
            rows.append([TITLES[m] if k == 0 else "", f"`{name}`", *values])
    return _markdown(["", "", *bins], rows, left=2)


def _published(published: Record) -> str:
    lower = "frames in which the geometric one is lower"
    rows = [
        ["KL, deep", _value(published["KL, deep"])],
        ["KL, geometric, as plotted: the mean of both", _value(published["KL, geometric, mean of both"])],
        ["KL, geometric itself", _value(published["KL, geometric itself"])],
        [lower, str(published[lower])],
        ["accuracy, deep", _value(published["accuracy, deep"])],
        ["accuracy, geometric", _value(published["accuracy, geometric"])],
    ]
    return _markdown([f"as the released code reports `{published['deep']}` and `{published['geometric']}`", ""], rows)


def _memory(part: Record) -> str:
    """Compare each map with the scans that it is made of."""
    metrics = ("iou_occupied", "iou_free", "false_free", "missed_occupied", "brier")
    rows = []
    for name in part["models"]:
        scans, plus, _ = name.partition(" + ")
        one = part["paired"].get(f"{name} against {scans}") if plus else None
        if one is not None:
            rows.append([f"`{name}`", *(_with_ends(one[m]["ratio"]) for m in metrics)])
    return _markdown(["map against its scans: ratio of means (95 %)", *(TITLES[m] for m in metrics)], rows)


def _real(recordings: Record, kind: str) -> str:
    rows = []
    for name, one in recordings.items():
        part = one.get(kind)
        models = (part or {"models": {}})["models"]
        shown = {m: scores for m, scores in models.items() if kind == "alone" or m in FUSED}
        for k, (method, scores) in enumerate(shown.items()):
            rows.append([_what(name, part) if k == 0 else "", f"`{method}`"])
            rows[-1] += [_value(scores["mean"][m][0]) for m in REAL]
    return _markdown(["", "", *(TITLES[m] for m in REAL)], rows, left=2)


def _what(name: str, part: Record) -> str:
    shares, frames = part["truth, mean shares"], part["frames"]
    text = f"{_percent(shares['free'])} free, {_percent(shares['occupied'])} occupied"
    return f"{name}, {frames} {'frame' if frames == 1 else 'frames'}; {text}"


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> str:
    rule = "|" + "---|" * left + "---:|" * (len(head) - left)
    return "\n".join(["| " + " | ".join(head) + " |", rule, *("| " + " | ".join(row) + " |" for row in rows)])


def _value(value: float | None, digits: int = 3) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _percent(value: float) -> str:
    return f"{100 * value:.1f} %"


def _with_half(interval: Sequence[float | None]) -> str:
    value, low, high = interval
    if value is None or low is None or high is None:
        return _value(value)
    return f"{value:.3f} ± {(high - low) / 2:.3f}"


def _with_ends(interval: Sequence[float | None]) -> str:
    value, low, high = interval
    if value is None or low is None or high is None:
        return _value(value)
    return f"{value:.2f} ({low:.2f} to {high:.2f})" if abs(value) >= 1 else f"{value:.3f} ({low:.3f} to {high:.3f})"


def _p(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.3f}" if value >= 1e-3 else f"{value:.0e}"
