"""Best methods in the headline metrics, and the significance of their lead."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from ogm.evaluation.chart_data import HEADLINE

Record = Mapping[str, Any]
SMALL_IOU = 0.05  # a method with a lower IoU hardly ever predicts the state


def best_value(record: Record, metric: str, kind: str = "macro") -> float | None:
    """Return the best mean (or micro average) of a metric over methods; None for a single method or no values."""
    better = record["metrics"][metric]["better"]
    found = [method[kind][metric] for method in record["methods"].values()]
    values = [value["value"] if isinstance(value, Mapping) else value for value in found]
    kept: list[float] = [value for value in values if value is not None]
    if not better or not kept or len(values) == 1:
        return None
    return min(kept) if better == "lower" else max(kept)


class Leader(NamedTuple):
    """The best method in a metric."""

    metric: str
    best: list[str]  # several if they are equal
    value: float
    second: str
    next_value: float | None
    won: str  # frames in which the best beats the second
    significant: bool


def leaders(record: Record) -> list[Leader]:
    """Return the best methods in each headline metric that has values."""
    found = []
    for metric in HEADLINE:
        means = {name: method["macro"][metric]["value"] for name, method in record["methods"].items()}
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
    """Return the frames in which `first` beats `second` as text, and whether it is significantly better.

    For significance the interval of the difference must exclude zero; without a paired comparison, the intervals of
    both must not overlap.
    """
    lower = record["metrics"][metric]["better"] == "lower"
    for a, b, won, negative in ((first, second, "wins", lower), (second, first, "losses", not lower)):
        if paired := record["paired"].get(f"{a} against {b}", {}).get(metric):
            end = paired["difference"]["high" if negative else "low"]
            apart = end is not None and (end < 0 if negative else end > 0)
            ties = f", {paired['ties']} tied" if paired["ties"] else ""
            return f"{paired[won]} of {paired['frames']} frames{ties}", apart
    spans = [record["methods"][name]["macro"][metric] for name in (first, second)]
    if any(span["low"] is None or span["high"] is None for span in spans):
        return "", False
    return "", spans[0]["high"] < spans[1]["low"] if lower else spans[0]["low"] > spans[1]["high"]


def summarize(record: Record) -> dict[str, Any]:
    """Return the data of the page's summary.

    Returns
    -------
    dict
        ``leaders``; ``winners``: name, titles of won metrics and number of significant wins, most first; ``ties``:
        titles of metrics with several best methods; ``empty``: titles of metrics without values; ``cautious``: methods
        with fewest false free or occupied cells at the lowest IoU.
    """
    metrics, best = record["metrics"], leaders(record)
    won: dict[str, list[Leader]] = {}
    for leader in best:
        if len(leader.best) == 1:
            won.setdefault(leader.best[0], []).append(leader)
    winners = [
        (name, [metrics[leader.metric]["title"] for leader in led], sum(leader.significant for leader in led))
        for name, led in won.items()
    ]
    valued = {leader.metric for leader in best}
    return {
        "leaders": best,
        "winners": sorted(winners, key=lambda item: (-len(item[1]), -item[2])),
        "ties": [metrics[leader.metric]["title"] for leader in best if len(leader.best) > 1],
        "empty": [metrics[m]["title"] for m in HEADLINE if m not in valued],
        "cautious": _cautious(record, best),
    }


def _cautious(record: Record, best: Sequence[Leader]) -> list[tuple[str, Leader, float, bool]]:
    """Return methods that have fewest false cells only because they rarely predict the state.

    Returns
    -------
    list of (str, Leader, float, bool)
        "free" or "occupied", the leader, its IoU, and whether it hardly ever predicts that state.
    """
    found = []
    for leader in best:
        state = leader.metric.removeprefix("false_")
        if leader.metric == state or f"iou_{state}" not in record["metrics"]:
            continue
        values = {name: method["macro"][f"iou_{state}"]["value"] for name, method in record["methods"].items()}
        known = [value for value in values.values() if value is not None]
        if len(known) > 1 and {values[name] for name in leader.best} == {min(known)}:
            found.append((state, leader, min(known), min(known) < SMALL_IOU))
    return found
