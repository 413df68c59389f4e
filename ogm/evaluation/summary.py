"""Which method is best in each headline metric, and how significant that is."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from ogm.evaluation.chart_data import HEADLINE

Record = Mapping[str, Any]
SMALL_IOU = 0.05  # a method with a lower IoU hardly ever predicts the state


def best_value(record: Record, metric: str, kind: str = "macro") -> float | None:
    """Return the best mean (or micro average) of a metric over methods; None where there is nothing to compare."""
    better = record["metrics"][metric]["better"]
    found = [one[kind][metric] for one in record["methods"].values()]
    values = [one["value"] if isinstance(one, Mapping) else one for one in found]
    kept: list[float] = [value for value in values if value is not None]
    if not better or not kept or len(values) == 1:
        return None
    return min(kept) if better == "lower" else max(kept)


class Leader(NamedTuple):
    """The best method in a metric."""

    metric: str
    best: list[str]  # several where they are equal
    value: float
    second: str
    next_value: float | None
    won: str  # in how many frames the best beats the second
    significant: bool


def leaders(record: Record) -> list[Leader]:
    """Return the best methods in the headline metrics, where methods have a value."""
    found = []
    for metric in HEADLINE:
        means = {name: one["macro"][metric]["value"] for name, one in record["methods"].items()}
        valued = [name for name, value in means.items() if value is not None]
        if not valued:
            continue
        ranking = sorted(valued, key=means.__getitem__, reverse=record["metrics"][metric]["better"] == "higher")
        best = [name for name in ranking if means[name] == means[ranking[0]]]
        second = ranking[1] if len(ranking) > 1 else ""
        won, significant = _compared(record, best[0], second, metric) if second and len(best) == 1 else ("", False)
        found.append(Leader(metric, best, means[best[0]], second, means.get(second), won, significant))
    return found


def _compared(record: Record, first: str, second: str, metric: str) -> tuple[str, bool]:
    """Return in how many frames `first` beats `second`, and whether it is significantly better.

    The interval of the difference must leave out zero; without a paired comparison, their own must not overlap.
    """
    lower = record["metrics"][metric]["better"] == "lower"
    for a, b, won, negative in ((first, second, "wins", lower), (second, first, "losses", not lower)):
        if one := record["paired"].get(f"{a} against {b}", {}).get(metric):
            end = one["difference"]["high" if negative else "low"]
            apart = end is not None and (end < 0 if negative else end > 0)
            ties = f", {one['ties']} tied" if one["ties"] else ""
            return f"{one[won]} of {one['frames']} frames{ties}", apart
    spans = [record["methods"][name]["macro"][metric] for name in (first, second)]
    if any(span["low"] is None or span["high"] is None for span in spans):
        return "", False
    return "", spans[0]["high"] < spans[1]["low"] if lower else spans[0]["low"] > spans[1]["high"]


def summarize(record: Record) -> dict[str, Any]:
    """Return what the page's summary states.

    Returns
    -------
    dict
        ``leaders``; ``winners``: name, titles of won metrics, how many of them significantly, most first; ``ties`` and
        ``empty``: titles of metrics with several best methods, without any value; ``cautious``: methods with fewest
        false free or occupied cells at the lowest IoU.
    """
    metrics, best = record["metrics"], leaders(record)
    won: dict[str, list[Leader]] = {}
    for leader in best:
        if len(leader.best) == 1:
            won.setdefault(leader.best[0], []).append(leader)
    winners = [
        (name, [metrics[one.metric]["title"] for one in led], sum(one.significant for one in led))
        for name, led in won.items()
    ]
    valued = {leader.metric for leader in best}
    return {
        "leaders": best,
        "winners": sorted(winners, key=lambda item: (-len(item[1]), -item[2])),
        "ties": [metrics[one.metric]["title"] for one in best if len(one.best) > 1],
        "empty": [metrics[m]["title"] for m in HEADLINE if m not in valued],
        "cautious": _cautious(record, best),
    }


def _cautious(record: Record, best: Sequence[Leader]) -> list[tuple[str, Leader, float, bool]]:
    """Return methods with fewest false cells only because they predict the state least.

    Returns
    -------
    list of (str, Leader, float, bool)
        "free" or "occupied", the leader, its IoU, and whether it hardly ever predicts that state.
    """
    found = []
    for leader in best:
        what = leader.metric.removeprefix("false_")
        if leader.metric == what or f"iou_{what}" not in record["metrics"]:
            continue
        values = {name: one["macro"][f"iou_{what}"]["value"] for name, one in record["methods"].items()}
        known = [value for value in values.values() if value is not None]
        if len(known) > 1 and {values[name] for name in leader.best} == {min(known)}:
            found.append((what, leader, min(known), min(known) < SMALL_IOU))
    return found
