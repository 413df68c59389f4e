"""What an evaluation says in plain words: who is best in what, and how sure that is."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any
from xml.etree.ElementTree import Element

from ogm.cli.charts import Leader, claimless, clean, headline, leaders
from ogm.cli.markup import counted, element, listed, metric_title, plain_table, told
from ogm.metrics.paired import FEWEST

__all__ = ["verdict"]

Record = Mapping[str, Any]
NOTHING = 0.05  # an IoU below it: next to nothing is claimed


def verdict(record: Record) -> Iterable[Element]:
    """Say in plain words who is best in what, and how sure that is; then tabulate it."""
    best = leaders(record)
    titles = {name: metric["title"] for name, metric in record["metrics"].items()}
    frames = counted(len(record["frames"]), "frame")
    if len(record["models"]) == 1:
        (name,) = record["models"]
        scores = "; ".join(f"{titles[one.metric]}: {told(one.value)}" for one in best[:4])
        said = f" was judged alone, on {frames}: {scores or 'no value'}."
        yield element("p", element("strong", clean(name)), said, _silence(record, best), class_="verdict")
        return
    words: list[Element | str] = [*_winners(titles, best), *_first(titles, best)]
    if alike := [titles[one.metric] for one in best if len(one.best) > 1]:
        words.append(f" The best are equal in {listed(alike)}.")
    for what, one, iou in claimless(record, best):
        who = f"{clean(one.best[0])} makes" if len(one.best) == 1 else f"{len(one.best)} methods make"
        why = "who claims nothing is never wrong" if iou < NOTHING else "who claims less is wrong less often"
        words.append(f" {who} the fewest false {what} cells at the lowest IoU {what} ({told(iou)}): {why}.")
    words.append(
        f" All were judged on the same {frames}. Clearly: the 95 % interval of the mean difference to the next best, "
        "frame by frame, leaves out zero and p is below 0.05; or, where two were not compared so, their own "
        "intervals lie apart."
    )
    if 0 < (drives := len({frame["sequence"] for frame in record["frames"]} - {""})) < FEWEST:
        words.append(
            f" The frames are of {counted(drives, 'drive')}, and those of a drive are alike: what is clear here need "
            "not be so elsewhere."
        )
    yield element("p", *words, _silence(record, best), class_="verdict")
    head = ("metric", "best", "mean", "next best", "mean", "better in", "")
    rows = (_verdict_row(record, leader) for leader in best)
    yield plain_table(head, rows)


def _winners(titles: Mapping[str, str], best: Sequence[Leader]) -> Iterable[Element | str]:
    """Name the method that is best most often, and the others that are best somewhere."""
    won: dict[str, list[Leader]] = {}
    for leader in best:
        if len(leader.best) == 1:
            won.setdefault(leader.best[0], []).append(leader)
    ordered = sorted(won.items(), key=lambda item: (-len(item[1]), -sum(one.clear for one in item[1])))
    for place, (name, led) in enumerate(ordered):
        clear = sum(one.clear for one in led)
        sure = f"{clear} of them clearly" if clear else "though not clearly"
        sure = "clearly" if clear == len(led) else sure
        if place == 0:
            where = f" is best in {len(led)} of {counted(len(best), 'headline metric')}, {sure}."
        else:
            yield " Best elsewhere: " if place == 1 else "; "
            few = listed([titles[one.metric] for one in led]) if len(led) <= 3 else f"{len(led)} metrics"
            where = f" in {few}, {sure}"
        yield from (element("strong", clean(name)), where)
    yield "." if len(ordered) > 1 else ""


def _first(titles: Mapping[str, str], best: Sequence[Leader]) -> Iterable[str]:
    """Give the numbers of the first metric."""
    for one in best[:1]:
        if len(one.best) == 1 and one.next_value is not None:
            won = f", and is better in {one.won}" if one.won else ""
            yield (
                f" In {titles[one.metric]}, {clean(one.best[0])} has {told(one.value)} and {clean(one.second)}, "
                f"the next best, {told(one.next_value)}{won}."
            )


def _silence(record: Record, best: Sequence[Leader]) -> str:
    """Name the headline metrics without a value."""
    spoken = {leader.metric for leader in best}
    metrics = record["metrics"]
    silent = [metrics[m]["title"] for m in headline(metrics) if metrics[m]["better"] and m not in spoken]
    return f" No method has a value for {listed(silent)}; why, stands below the scores." if silent else ""


def _verdict_row(record: Record, leader: Leader) -> Element:
    alone, word = len(leader.best) == 1, "clearly" if leader.clear else "not told apart"
    names = clean(leader.best[0]) if alone else f"{len(leader.best)} methods"
    second = [clean(leader.second), told(leader.next_value)] if alone and leader.second else ["", ""]
    return element(
        "tr",
        element("th", *metric_title(record, leader.metric), scope="row"),
        element("td", names, title=listed([clean(name) for name in leader.best]), class_="name"),
        element("td", told(leader.value), class_="number"),
        element("td", second[0], class_="name"),
        element("td", second[1], class_="number"),
        element("td", leader.won),
        element("td", word if alone and leader.second else "", class_="sure" if leader.clear else "unsure"),
    )
