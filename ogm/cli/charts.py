"""What the page's script draws from a record, in few bytes: names become numbers, numbers get four digits."""

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

__all__ = ["GROUPS", "HEADLINE", "chart_data", "clean", "frame_keys", "grouped", "headline", "rounded"]

HEADLINE = (
    "kl_e10", "iou_free", "iou_occupied", "brier", "ece_relative", "auroc_unknown", "ause",
    "free_recall_1", "false_free", "missed_occupied", "missed_obstacles",
)  # fmt: skip
GROUPS = {  # beginnings of metrics' names, in the order of the page
    "Distance from the truth": ("kl_", "conflict"),
    "The three states": ("iou_",),
    "Probability and its calibration, on known cells": (
        "brier",
        "nll",
        "map_score",
        "ece",
        "ace",
        "interval",
    ),
    "Unknown: does it say where not to trust?": ("auroc_", "aupr_", "fpr", "aurc", "ause"),
    "Free space and obstacles": ("false_", "missed_", "free_", "ap_"),
    "What the grid holds: neither is better": ("mean_", "entropy", "dissonance"),
    "The released code's metrics: kept to reproduce its figures, not to rank by": ("legacy",),
}
REST = "Further"
MOST = 400_000  # per-frame values that the page carries; beyond this, those of the headline metrics only
DIGITS = 4
CHANCE = 0.05  # a p value below it is small
SOON = 2.0  # [s] after the frame before: lines of charts join them


def headline(metrics: Iterable[str]) -> list[str]:
    """Return the metrics that a person looks at first, of those that there are."""
    there = list(metrics)
    return [name for name in HEADLINE if name in there] or there[:8]


def grouped(metrics: Iterable[str]) -> dict[str, list[str]]:
    """Return metrics by what they are about; each is in one group."""
    found: dict[str, list[str]] = {title: [] for title in [*GROUPS, REST]}
    for name in metrics:
        title = next((title for title, starts in GROUPS.items() if name.startswith(starts)), REST)
        found[title].append(name)
    return {title: names for title, names in found.items() if names}


def clean(value: Any) -> str:
    """Return a name as text that can be written: file names may hold bytes that are no text."""
    return str(value).encode("utf-8", "replace").decode("utf-8")


def frame_keys(frames: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a name for every frame that no other has: its own, or with its sequence, or with its number."""
    names = [clean(frame["name"]) for frame in frames]
    places = [clean(frame["sequence"]) for frame in frames]
    full = [f"{place}/{name}" if place else name for place, name in zip(places, names, strict=True)]
    keys = list(names)
    for tries in (full, [f"{name} #{k}" for k, name in enumerate(full)]):
        seen: dict[str, int] = {}
        for key in keys:
            seen[key] = seen.get(key, 0) + 1
        keys = [other if seen[key] > 1 else key for key, other in zip(keys, tries, strict=True)]
    return keys


def rounded(value: Any) -> Any:
    """Return numbers, in lists and dicts as deep as they come, with four digits; NaN and infinity as None."""
    if isinstance(value, Mapping):
        return {key: rounded(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(one) for one in value]
    if isinstance(value, float):
        if not math.isfinite(value):
            return None
        short = float(f"{value:.{DIGITS}g}")
        return int(short) if short.is_integer() and abs(short) < 1e9 else short
    return value


class Leader(NamedTuple):
    """Who is best in a metric, and how sure that is."""

    metric: str
    best: list[str]  # more than one where they are equal
    value: float
    second: str
    next_value: float | None
    won: str  # how often the best beats the second
    clear: bool


def leaders(record: Mapping[str, Any]) -> list[Leader]:
    """Return the leaders of the headline metrics, where methods have a value."""
    found = []
    for metric in headline(record["metrics"]):
        better = record["metrics"][metric]["better"]
        means = {name: model["macro"][metric]["value"] for name, model in record["models"].items()}
        ranking = [(name, value) for name, value in means.items() if value is not None]
        if not better or not ranking:
            continue
        ranking.sort(key=lambda item: item[1], reverse=better == "higher")
        best = [name for name, value in ranking if value == ranking[0][1]]
        second, next_value = ranking[1] if len(ranking) > 1 else ("", None)
        won, clear = _against(record, best[0], second, metric) if second and len(best) == 1 else ("", False)
        found.append(Leader(metric, best, ranking[0][1], second, next_value, won, clear))
    return found


def _against(record: Mapping[str, Any], first: str, second: str, metric: str) -> tuple[str, bool]:
    """Say in how many frames `first` beats `second`, and whether it is better by more than chance.

    The interval of the difference must leave out zero, and p be small: of few frames, an interval that is drawn from
    them alone is too narrow.
    """
    lower = record["metrics"][metric]["better"] == "lower"
    for a, b, won, gains in ((first, second, "wins", lower), (second, first, "losses", not lower)):
        if one := record["paired"].get(f"{a} against {b}", {}).get(metric):
            end = one["difference"]["high" if gains else "low"]
            p = one.get("p")
            clear = end is not None and (end < 0 if gains else end > 0) and p is not None and p < CHANCE
            ties = f", {one['ties']} tied" if one["ties"] else ""
            return f"{one[won]} of {one['frames']} frames{ties}", clear
    # Not compared: do their own intervals lie apart?
    spans = [record["models"][name]["macro"][metric] for name in (first, second)]
    if any(span["low"] is None or span["high"] is None for span in spans):
        return "", False
    return "", spans[0]["high"] < spans[1]["low"] if lower else spans[0]["low"] > spans[1]["high"]


def claimless(record: Mapping[str, Any], found: Iterable[Leader]) -> Iterable[tuple[str, Leader, float]]:
    """Yield what leads in few false claims of free, of occupied, and has the lowest IoU of them: it claims the least.

    Yields
    ------
    str
        "free" or "occupied".
    Leader
    float
        Its IoU.
    """
    for leader in found:
        what = leader.metric.removeprefix("false_")
        if leader.metric == what or f"iou_{what}" not in record["metrics"]:
            continue
        values = {name: model["macro"][f"iou_{what}"]["value"] for name, model in record["models"].items()}
        known = [value for value in values.values() if value is not None]
        if len(known) > 1 and {values[name] for name in leader.best} == {min(known)}:
            yield what, leader, min(known)


def chart_data(record: Mapping[str, Any], shown: Iterable[int]) -> dict[str, Any]:
    """Return what the page's script needs of a record, as JSON can hold it.

    Parameters
    ----------
    record : dict
        What `ogm.cli.report` wrote.
    shown : iterable of int
        Numbers of the frames that there are pictures of.

    Returns
    -------
    dict
        ``methods``, ``frames`` (key, sequence, whether it follows the one before), ``views``, ``metrics``,
        ``headline``, ``perFrame`` (metric -> method -> frame), ``truth``, ``curves``, ``byRange``, ``ranges``,
        ``paired`` ("method reference", by their numbers -> metric -> frames, wins, ties, losses, p, and difference
        and ratio each with its interval), ``grid``.
    """
    models, metrics, frames = record["models"], record["metrics"], record["frames"]
    names = list(models)
    first = headline(metrics)
    carried = list(metrics)
    if len(names) * len(frames) * len(carried) > MOST:
        kept = {*first, *(m for m in metrics if m.startswith(("kl_", "legacy", "mean_")))}
        carried = [name for name in metrics if name in kept]
    data = {
        "methods": [clean(name) for name in names],
        "frames": [
            [key, clean(frame["sequence"]), follows]
            for key, frame, follows in zip(frame_keys(frames), frames, _following(frames), strict=True)
        ],
        "views": sorted(shown),
        "metrics": metrics,
        "headline": first,
        "perFrame": {m: [models[name]["per frame"][m] for name in names] for m in carried},
        "truth": record["truth per frame"],
        "curves": [models[name].get("curves") or {} for name in names],
        "byRange": [models[name].get("by range") or {} for name in names],
        "ranges": record.get("ranges") or [],
        "paired": _paired(record["paired"], names),
    }
    return rounded(data) | {"grid": record["grid"]}


def _following(frames: Sequence[Mapping[str, Any]]) -> list[bool]:
    """Tell of every frame whether it was taken soon after the one before, in the same sequence."""
    joined = [False] * len(frames)
    for k, (before, here) in enumerate(pairwise(frames), start=1):
        times = before["stamp"], here["stamp"]
        if before["sequence"] == here["sequence"] and None not in times:
            joined[k] = 0 < times[1] - times[0] <= SOON
    return joined


def _paired(pairs: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Return comparisons by the numbers of the two methods, each as a short list."""
    found = {}
    for a, first in enumerate(names):
        for b, second in enumerate(names):
            if pair := pairs.get(f"{first} against {second}"):
                found[f"{a} {b}"] = {metric: _row(one) for metric, one in pair.items()}
    return found


def _row(one: Mapping[str, Any]) -> list[float | None]:
    counts = [one["frames"], one["wins"], one["ties"], one["losses"], one.get("p")]
    return counts + [one[what][end] for what in ("difference", "ratio") for end in ("value", "low", "high")]
