"""Tables of docs/quality.md, made from the record alone."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from record_tables import marked, percent, table, value

__all__ = ["quality_tables"]

Record = Mapping[str, Any]
Titles = Mapping[str, str]
TOWN = (
    *("nll", "brier", "iou_free", "iou_occupied", "iou_unknown", "false_free", "missed_occupied", "missed_obstacles"),
    *("free_recall_1", "ece", "ece_relative", "auroc_unknown", "aurc", "mean_unknown", "kl_e10", "kl_e1"),
)
PAIRS = ("nll", "brier", "iou_free", "iou_occupied", "false_free", "missed_obstacles", "kl_e1")
RELEASED = "height-band-released"  # predicts no cell: left out of most tables
LOW = ("false_free", "missed_occupied", "iou_occupied", "iou_free")  # with and without low obstacles
HEIGHTS = {"": "0.05 m", "from10_": "0.10 m", "from50_": "0.50 m"}
RANGE = {"iou_occupied": 3, "false_free": 3, "missed_occupied": 3, "free_recall_1": 3}
DRIVES = ("brier", "iou_free", "iou_occupied", "false_free", "missed_occupied", "free_recall_1", "mean_unknown")
MEMORY = ("brier", "iou_occupied", "false_free")
FUSED = tuple(
    f"{model}{rule}" for model in ("ray", "lite", "combined") for rule in ("", " + cautious", " + dempster", " + bayes")
)
REAL = ("brier", "iou_free", "iou_occupied", "false_free", "missed_occupied", "mean_unknown")


def quality_tables(record: Record) -> dict[str, str]:
    """Return all tables by the names of their markers; those that the record has nothing for are left out."""
    found: dict[str, str] = {}
    titles = {name: one["title"] for name, one in record["metrics"].items()}
    if town := record.get("town"):
        found |= {
            "extent": _extent(town),
            "town": _town(town, TOWN, titles),
            "pairs": _pairs(town, _reversed(town["models"]), PAIRS, titles),
            "range": _range(town, titles),
        }
        if all("from10_false_free" in one["mean"] for one in town["models"].values()):
            found["low"] = _low(town, titles)
    if record.get("reliability"):
        found["reliability"] = (
            "![Share of cells that are free, and occupied, by the belief in it](pictures/quality_reliability.png)"
        )
    if drives := record.get("drives"):
        shown = _maps(drives)
        found["drives"] = f"{_extent(drives)}\n\n{_list(shown, DRIVES, titles)}"
        found["memory"] = _memory(drives, shown, titles)
    if real := record.get("real"):
        found |= {"real": _real(real, "alone", titles), "real-fused": _real(real, "fused", titles)}
    return {name: marked("quality", text) for name, text in found.items()}


def _extent(part: Record) -> str:
    """Return the extent of the means of a part."""
    return f"Means over {part['extent']}. Intervals: {part['intervals']}."


def _town(part: Record, metrics: Sequence[str], titles: Titles) -> str:
    models = part["models"]
    rows = [[titles[m], *(_with_ends(one["mean"][m]) for one in models.values())] for m in metrics]
    return table(["mean (95 %)", *models], rows)


def _low(part: Record, titles: Titles) -> str:
    """Compare scores of all obstacles with those that leave low ones out."""
    models, rows = _predicting(part["models"]), []
    for metric in LOW:
        for prefix, height in HEIGHTS.items():
            cells = [_with_ends(one["mean"][prefix + metric]) for one in models.values()]
            rows.append([titles[metric] if not prefix else "", height, *cells])
    return table(["mean (95 %)", "obstacles from", *models], rows, left=2)


def _predicting(models: Record) -> Record:
    return {name: one for name, one in models.items() if name != RELEASED}


def _maps(part: Record) -> Record:
    """Return the models and the maps that are shown: none of the baselines."""
    return {name: one for name, one in part["models"].items() if not name.startswith("height-band") or "+" not in name}


def _list(models: Record, metrics: Sequence[str], titles: Titles) -> str:
    rows = [[f"`{name}`", *(value(one["mean"][m][0]) for m in metrics)] for name, one in models.items()]
    return table(["", *(titles[m] for m in metrics)], rows)


def _reversed(models: Record) -> list[str]:
    """Return pairs, the best models first."""
    names = list(models)
    order = [name for name in ("paper", "combined", "lite", "ray") if name in names]
    return [f"{name} against {other}" for name in order for other in ("ray", "height-band") if name != other]


def _pairs(part: Record, names: Iterable[str], metrics: Sequence[str], titles: Titles) -> str:
    rows = []
    for name in names:
        pair = part["paired"].get(name, {})
        there = [m for m in metrics if m in pair]
        for m in there:
            one = pair[m]
            wins, ties, losses = one["wins, ties, losses"]
            cells = [f"{wins} / {ties} / {losses}", _with_ends(one["difference"]), _p(one["p"])]
            rows.append([name if m == there[0] else "", titles[m], *cells])
    return table(["", "", "wins / ties / losses", "difference (95 %)", "p"], rows, left=2)


def _range(part: Record, titles: Titles) -> str:
    edges = part["ranges [m]"]
    bins = [
        f"{low:g} to {high:g} m" if high is not None else f"beyond {low:g} m"
        for low, high in zip(edges[:-1], edges[1:], strict=True)
    ]
    rows = []
    for m, digits in RANGE.items():
        for k, (name, one) in enumerate(_predicting(part["models"]).items()):
            values = [value(score, digits) for score in one["by range"][m]]
            rows.append([titles[m] if k == 0 else "", f"`{name}`", *values])
    return table(["", "", *bins], rows, left=2)


def _memory(part: Record, names: Iterable[str], titles: Titles) -> str:
    """Compare each map with the scans that it is made of."""
    rows = []
    for name in names:
        scans, plus, _ = name.partition(" + ")
        one = part["paired"].get(f"{name} against {scans}") if plus else None
        if one is not None:
            rows.append([f"`{name}`", *(_with_ends(one[m]["ratio"]) for m in MEMORY)])
    return table(["map against its scans: ratio of means (95 %)", *(titles[m] for m in MEMORY)], rows)


def _real(recordings: Record, kind: str, titles: Titles) -> str:
    rows = []
    for name, one in recordings.items():
        part = one.get(kind)
        models = _predicting((part or {"models": {}})["models"])
        shown = {m: scores for m, scores in models.items() if kind == "alone" or m in FUSED}
        for k, (method, scores) in enumerate(shown.items()):
            rows.append([_what(name, part) if k == 0 else "", f"`{method}`"])
            rows[-1] += [value(scores["mean"][m][0]) for m in REAL]
    return table(["", "", *(titles[m] for m in REAL)], rows, left=2)


def _what(name: str, part: Record) -> str:
    shares, frames = part["truth, mean shares"], part["frames"]
    text = f"{percent(shares['free'])} free, {percent(shares['occupied'])} occupied"
    extent = part.get("extent", f"{frames} {'frame' if frames == 1 else 'frames'}")
    return f"{name}, {extent}; {text}"


def _with_ends(interval: Sequence[float | None]) -> str:
    mean, low, high = interval
    if mean is None or low is None or high is None:
        return value(mean)
    digits, to = 2 if abs(mean) >= 1 else 3, " to " if low < 0 else "–"
    return f"{mean:.{digits}f} ({low:.{digits}f}{to}{high:.{digits}f})".replace(" ", "\xa0")


def _p(p: float | None) -> str:
    if p is None:
        return ""
    return f"{p:.3f}" if p >= 1e-3 else f"{p:.0e}"
