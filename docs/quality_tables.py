"""Tables of docs/results.md that compare sensor models and maps, made from the record of `quality`."""

from collections.abc import Mapping, Sequence
from typing import Any

from record_tables import percent, table, value, with_command

__all__ = ["quality_tables"]

Record = Mapping[str, Any]
Titles = Mapping[str, str]
TOWN = (
    *("nll", "brier", "iou_free", "iou_occupied", "iou_unknown", "false_free", "missed_obstacles", "free_recall_1"),
    *("ece", "auroc_unknown", "aurc"),
)
PAIRS = ("nll", "iou_free", "iou_occupied", "false_free")
RELEASED = "height-band-released"  # predicts no cell: left out
SHOWN_PAIRS = ("combined against ray", "combined against height-band", "lite against ray")
LOW = ("false_free", "iou_occupied")  # with and without low obstacles
HEIGHTS = {"": "0.15 m", "from50_": "0.50 m"}
RANGE = ("iou_occupied", "false_free", "free_recall_1")
DRIVES = ("brier", "iou_free", "iou_occupied", "false_free", "free_recall_1", "mean_unknown")
SHOWN_RULES = ("revise", "dempster", "bayes")  # of the fused maps
REAL = ("brier", "iou_free", "iou_occupied", "false_free", "mean_unknown")


def quality_tables(record: Record) -> dict[str, str]:
    """Return the tables of unseen towns, of fused drives and of recordings by the names of their markers."""
    titles = {name: metric["title"] for name, metric in record["metrics"].items()}
    town, drives, real = record["town"], record["drives"], record["real"]
    found = {
        "towns": (
            *(_extent(town), _town(town, titles), "Paired by frame:", _pairs(town, titles)),
            *("With and without low obstacles:", _low(town, titles), "By distance:", _range(town, titles)),
        ),
        "drives": (_extent(drives), _list(_shown(drives["models"]), titles)),
        "real": (_real(real, "alone", titles), "Fused:", _real(real, "fused", titles)),
    }
    return {name: with_command("quality", *parts) for name, parts in found.items()}


def _extent(part: Record) -> str:
    """Return the extent of the means of a part."""
    return f"Means over {part['extent']}. Intervals: {part['intervals']}."


def _town(part: Record, titles: Titles) -> str:
    models = _shown(part["models"])
    rows = [[titles[m], *(_with_ends(one["mean"][m]) for one in models.values())] for m in TOWN]
    return table(["mean (95 %)", *models], rows)


def _low(part: Record, titles: Titles) -> str:
    """Compare scores of all obstacles with those that leave low ones out."""
    models, rows = _shown(part["models"]), []
    for metric in LOW:
        for prefix, height in HEIGHTS.items():
            cells = [_with_ends(one["mean"][prefix + metric]) for one in models.values()]
            rows.append([titles[metric] if not prefix else "", height, *cells])
    return table(["mean (95 %)", "obstacles from", *models], rows, left=2)


def _shown(models: Record) -> Record:
    """Return the models that predict cells, alone and fused by the rules that are shown."""
    return {name: one for name, one in models.items() if name != RELEASED and _is_shown(*name.partition(" + "))}


def _is_shown(model: str, plus: str, rule: str) -> bool:
    return not plus or (rule in SHOWN_RULES and not model.startswith("height-band"))


def _list(models: Record, titles: Titles) -> str:
    rows = [[f"`{name}`", *(value(one["mean"][m][0]) for m in DRIVES)] for name, one in models.items()]
    return table(["", *(titles[m] for m in DRIVES)], rows)


def _pairs(part: Record, titles: Titles) -> str:
    rows = []
    for name in SHOWN_PAIRS:
        pair = part["paired"].get(name, {})
        there = [m for m in PAIRS if m in pair]
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
    for m in RANGE:
        for k, (name, one) in enumerate(_shown(part["models"]).items()):
            values = [value(score) for score in one["by range"][m]]
            rows.append([titles[m] if k == 0 else "", f"`{name}`", *values])
    return table(["", "", *bins], rows, left=2)


def _real(recordings: Record, kind: str, titles: Titles) -> str:
    rows = []
    for name, one in recordings.items():
        part = one.get(kind)
        title = name if kind == "fused" else _what(name, part)
        models = _shown((part or {"models": {}})["models"])
        for k, (method, scores) in enumerate(models.items()):
            rows.append([title if k == 0 else "", f"`{method}`"])
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
