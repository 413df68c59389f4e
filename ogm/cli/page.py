"""The report of an evaluation that people look at: one HTML file that needs nothing else, no network either."""

import json
import os
import re
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from typing import Any
from xml.etree.ElementTree import Element, tostring

from ogm.cli.charts import Leader, chart_data, claimless, clean, grouped, headline, leaders
from ogm.cli.views import ERRORS, HEIGHTS, STATES, Shade, height_colours
from ogm.files import atomic_write

__all__ = ["write_page"]

Record = Mapping[str, Any]
Views = Mapping[int, Mapping[str, bytes]]
MOST = 13_500_000  # bytes of pictures, so that the page stays under 15 MB
ARROWS = {"lower": "↓", "higher": "↑", "": ""}
STATES_OF_CELLS = ("unknown", "free", "occupied")
CONFUSION = "confusion [truth][call], unknown free occupied"
NOTHING = 0.05  # an IoU below it: next to nothing is claimed
DRIVES = 5  # the fewest that the bootstrap draws from, see `ogm.cli.report`
SHORT = 120  # characters of a nested fact that are shown without being asked for


def write_page(
    path: str | os.PathLike[str], record: Record, views: Views | None = None, most: int = MOST
) -> None:
    """Write a record of `ogm evaluate` as one HTML page, whole or not at all.

    Parameters
    ----------
    path : path
        Its folder must exist.
    record : dict
        What `ogm.cli.report` wrote as JSON.
    views : dict of int to dict of str to bytes, optional
        Pictures of some of the frames by their numbers, see `ogm.cli.views.frame_view`.
    most : int
        Bytes that the pictures may take in the page. Of more, frames are left out evenly, and the page says so.

    Raises
    ------
    ValueError
        If there are pictures of a frame that the record does not have.
    """
    found = views or {}
    views = _fitting(found, most)
    if strange := sorted(set(found) - set(range(len(record["frames"])))):
        raise ValueError(
            f"there are pictures of frame {strange[0]}, but the record has {len(record['frames'])} frames; "
            "number them as the record does"
        )
    files = resources.files("ogm") / "data"
    parts = {
        "title": _html(clean(record["title"])),
        "css": (files / "report.css").read_text("utf-8"),
        "js": (files / "report.js").read_text("utf-8"),
        "subtitle": _html(_subtitle(record)),
        "intervals": _html(clean(record.get("intervals", "95 %, bootstrap over frames"))),
        "verdict": _html(*_verdict(record)),
        "scores": _html(*_scores(record)),
        "confusions": _html(_confusions(record)),
        "shown": _html(_shown(record, found, views)),
        "legend": _html(*_legends(views)),
        "run": _html(*_run(record)),
        "data": _json(chart_data(record, views)),
        "views": "\n".join(_view(number, views[number]) for number in sorted(views)),
    }
    template = (files / "report.html").read_text("utf-8")
    page = re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], template)
    with atomic_write(path) as file:
        file.write(page.encode("utf-8", "replace"))


def _fitting(views: Views, most: int) -> Views:
    """Return pictures of as many frames as fit, evenly spread."""
    size = sum(len(data) for pictures in views.values() for data in pictures.values()) * 4 / 3  # in base64
    if size <= most:
        return views
    numbers, count = sorted(views), max(1, int(len(views) * most / size))
    places = {round(k * (len(numbers) - 1) / max(count - 1, 1)) for k in range(count)}
    return {number: views[number] for place, number in enumerate(numbers) if place in places}


def _shown(record: Record, found: Views, kept: Views) -> str:
    said = f"Pictures of {len(kept)} of {_count(len(record['frames']), 'frame')}"
    left = len(found) - len(kept)
    return f"{said}; those of {left} more were left out to keep the page small." if left else f"{said}."


def _view(number: int, pictures: Mapping[str, bytes]) -> str:
    found = {name: f"data:{_kind(data)};base64,{b64encode(data).decode()}" for name, data in pictures.items()}
    return f'<script type="application/json" id="view-{number}">{_json(found)}</script>'


def _kind(data: bytes) -> str:
    return "image/png" if data.startswith(b"\x89PNG") else "image/webp"


def _json(value: Any) -> str:
    """Return JSON that cannot end the script it stands in: ASCII, and no "<"."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


# What follows makes HTML of elements, so that every text is escaped when it is written.


def _e(tag: str, *children: Element | str, **attributes: str | None) -> Element:
    """Make an element; attributes that are None are left out, a trailing _ and - for _ as Python needs."""
    kept = {k.rstrip("_").replace("_", "-"): v for k, v in attributes.items() if v is not None}
    element = Element(tag, kept)
    for child in children:
        if not isinstance(child, str):
            element.append(child)
        elif len(element):
            element[-1].tail = (element[-1].tail or "") + child
        else:
            element.text = (element.text or "") + child
    return element


def _html(*parts: Element | str) -> str:
    """Write elements and texts as HTML, without those control characters that HTML has no place for."""
    text = tostring(_e("x", *parts), "unicode", "html").removeprefix("<x>").removesuffix("</x>")
    return re.sub(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]", "\N{REPLACEMENT CHARACTER}", text)


def _said(value: float | None) -> str:
    if value is None:
        return "–"
    size = abs(value)
    if size and (size < 1e-3 or size >= 1e5):
        return f"{value:.1e}"
    return f"{value:.3f}" if size < 10 else f"{value:.1f}" if size < 1000 else f"{value:.0f}"


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _listed(words: Sequence[str]) -> str:
    comma = "; " if any("," in word for word in words) else ", "
    return " and ".join([comma.join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)


def _subtitle(record: Record) -> str:
    data = record["data"]
    counts = f"{_count(len(record['models']), 'method')} on {_count(len(record['frames']), 'frame')}"
    return f"{counts} of {clean(data['name'])} ({data['kind']}), {record['date']}"


# The verdict


def _verdict(record: Record) -> Iterable[Element]:
    """Say in plain words who is best in what, and how sure that is; then tabulate it."""
    best = leaders(record)
    titles = {name: metric["title"] for name, metric in record["metrics"].items()}
    frames = _count(len(record["frames"]), "frame")
    if len(record["models"]) == 1:
        (name,) = record["models"]
        scores = _listed([f"{titles[one.metric]} {_said(one.value)}" for one in best[:4]])
        said = f" was judged alone, on {frames}: {scores or 'no value'}."
        yield _e("p", _e("strong", clean(name)), said, _silence(record, best), class_="verdict")
        return
    words: list[Element | str] = [*_winners(titles, best), *_first(titles, best)]
    if alike := [titles[one.metric] for one in best if len(one.best) > 1]:
        words.append(f" The best are equal in {_listed(alike)}.")
    for what, one, iou in claimless(record, best):
        who = f"{clean(one.best[0])} makes" if len(one.best) == 1 else f"{len(one.best)} methods make"
        why = "who claims nothing is never wrong" if iou < NOTHING else "who claims less is wrong less often"
        words.append(f" {who} the fewest false {what} cells at the lowest IoU {what} ({_said(iou)}): {why}.")
    words.append(
        f" All were judged on the same {frames}. Clearly: the 95 % interval of the mean difference to the next best, "
        "frame by frame, leaves out zero and p is below 0.05; or, where two were not compared so, their own "
        "intervals lie apart."
    )
    if 0 < (drives := len({frame["sequence"] for frame in record["frames"]} - {""})) < DRIVES:
        words.append(
            f" The frames are of {_count(drives, 'drive')}, and those of a drive are alike: what is clear here need "
            "not be so elsewhere."
        )
    yield _e("p", *words, _silence(record, best), class_="verdict")
    head = ("metric", "best", "mean", "next best", "mean", "better in", "")
    rows = (_verdict_row(record, leader) for leader in best)
    yield _plain_table(head, rows)


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
            where = f" is best in {len(led)} of {_count(len(best), 'headline metric')}, {sure}."
        else:
            yield " Best elsewhere: " if place == 1 else "; "
            few = _listed([titles[one.metric] for one in led]) if len(led) <= 3 else f"{len(led)} metrics"
            where = f" in {few}, {sure}"
        yield from (_e("strong", clean(name)), where)
    yield "." if len(ordered) > 1 else ""


def _first(titles: Mapping[str, str], best: Sequence[Leader]) -> Iterable[str]:
    """Give the numbers of the first metric."""
    for one in best[:1]:
        if len(one.best) == 1 and one.next_value is not None:
            won = f", and is better in {one.won}" if one.won else ""
            yield (
                f" In {titles[one.metric]}, {clean(one.best[0])} has {_said(one.value)} and {clean(one.second)}, "
                f"the next best, {_said(one.next_value)}{won}."
            )


def _silence(record: Record, best: Sequence[Leader]) -> str:
    """Name the headline metrics without a value."""
    spoken = {leader.metric for leader in best}
    metrics = record["metrics"]
    silent = [metrics[m]["title"] for m in headline(metrics) if metrics[m]["better"] and m not in spoken]
    return f" No method has a value for {_listed(silent)}; why, stands below the scores." if silent else ""


def _verdict_row(record: Record, leader: Leader) -> Element:
    alone, word = len(leader.best) == 1, "clearly" if leader.clear else "not told apart"
    names = clean(leader.best[0]) if alone else f"{len(leader.best)} methods"
    second = [clean(leader.second), _said(leader.next_value)] if alone and leader.second else ["", ""]
    return _e(
        "tr",
        _e("th", *_metric(record, leader.metric), scope="row"),
        _e("td", names, title=_listed([clean(name) for name in leader.best]), class_="name"),
        _e("td", _said(leader.value), class_="number"),
        _e("td", second[0], class_="name"),
        _e("td", second[1], class_="number"),
        _e("td", leader.won),
        _e("td", word if alone and leader.second else "", class_="sure" if leader.clear else "unsure"),
    )


def _plain_table(head: Iterable[str], rows: Iterable[Element]) -> Element:
    top = _e("thead", _e("tr", *(_e("th", text, scope="col") for text in head)))
    return _e("div", _e("table", top, _e("tbody", *rows), class_="plain"), class_="scroll")


def _metric(record: Record, name: str) -> list[Element | str]:
    metric = record["metrics"][name]
    better = f", {metric['better']} is better" if metric["better"] else ""
    return [_e("abbr", metric["title"], title=f"{metric['says']}{better}"), f" {ARROWS[metric['better']]}"]


# The tables of scores


def _scores(record: Record) -> Iterable[Element]:
    """Tabulate every metric of every method: the headline ones first, the rest folded."""
    first = headline(record["metrics"])
    yield _e("div", _table(record, first, "macro"), class_="scroll")
    yield from _reasons(record, first)
    for title, names in grouped(record["metrics"]).items():
        table = _e("div", _table(record, names, "macro"), class_="scroll")
        yield _e("details", _e("summary", title), table, *_reasons(record, names))
    pooled: list[Element] = []
    for title, names in grouped(record["metrics"]).items():
        pooled += [_e("h3", title), _e("div", _table(record, names, "micro"), class_="scroll")]
    yield _e("details", _e("summary", "Every metric of all frames' cells together (micro averages)"), *pooled)
    says = [
        _e("div", _e("dt", *_metric(record, name)), _e("dd", record["metrics"][name]["says"]))
        for name in record["metrics"]
    ]
    yield _e("details", _e("summary", "What each metric is"), _e("dl", *says, class_="says"))


def _table(record: Record, names: Sequence[str], kind: str) -> Element:
    head = [_e("th", _e("button", "method", type="button"), scope="col")]
    for name in names:
        metric = record["metrics"][name]
        better = f"; {metric['better']} is better" if metric["better"] else ""
        button = _e("button", f"{metric['title']} {ARROWS[metric['better']]}", type="button")
        head.append(_e("th", button, scope="col", title=f"{metric['says']}{better}"))
    best = {name: _best(record, name, kind) for name in names}
    rows = []
    for number, (method, model) in enumerate(record["models"].items()):
        cells = [_e("th", _swatch(number), clean(method), scope="row", data_v=clean(method))]
        for name in names:
            one = model[kind].get(name)
            one = one if isinstance(one, Mapping) else {"value": one, "low": None, "high": None}
            cells.append(_cell(one, best[name], model.get("missing", {}).get(name)))
        rows.append(_e("tr", *cells))
    return _e("table", _e("thead", _e("tr", *head)), _e("tbody", *rows), class_="scores sortable")


def _best(record: Record, metric: str, kind: str) -> float | None:
    better = record["metrics"][metric]["better"]
    found = [model[kind].get(metric) for model in record["models"].values()]
    values = [v["value"] if isinstance(v, Mapping) else v for v in found]
    kept = [v for v in values if v is not None]
    if not better or not kept or len(values) == 1:
        return None
    return min(kept) if better == "lower" else max(kept)


def _cell(one: Mapping[str, Any], best: float | None, reason: str | None) -> Element:
    value, low, high = one["value"], one["low"], one["high"]
    if value is None:
        return _e("td", "–", title=f"no value: {reason or 'no cell speaks for it'}", class_="number none")
    interval = [] if low is None or high is None else [_e("small", f"{_said(low)} – {_said(high)}")]
    mark = "number best" if value == best else "number"
    return _e("td", _said(value), *interval, class_=mark, data_v=repr(value))


def _reasons(record: Record, names: Sequence[str]) -> Iterable[Element]:
    """Say why metrics have no value, those with the same reason together."""
    found: dict[str, dict[str, list[str]]] = {}
    for method, model in record["models"].items():
        for name in names:
            if reason := model.get("missing", {}).get(name):
                found.setdefault(reason, {}).setdefault(record["metrics"][name]["title"], []).append(
                    clean(method)
                )
    for reason, titles in found.items():
        everyone = all(len(methods) == len(record["models"]) for methods in titles.values())
        whom = "" if everyone else " of " + _listed(sorted({m for ms in titles.values() for m in ms}))
        yield _e("p", f"– {_listed(list(titles))}{whom}: no value, {reason}.", class_="reason")


def _swatch(number: int) -> Element:
    return _e("i", class_=f"swatch s{number % 8} d{number // 8 % 5}", aria_hidden="true")


def _confusions(record: Record) -> Element:
    """Tabulate, for every method, what cells of each true state are called."""
    figures = []
    for number, (name, model) in enumerate(record["models"].items()):
        rows = []
        for truth, row in zip(STATES_OF_CELLS, model[CONFUSION], strict=True):
            total = sum(row)
            cells = [
                _e(
                    "td",
                    f"{100 * count / total:.1f} %" if total else "–",
                    style=f"--share:{count / total:.3f}" if total else None,
                    class_="right" if truth == call else "wrong",
                    title=f"{count:,} cells that are {truth} and called {call}",
                )
                for call, count in zip(STATES_OF_CELLS, row, strict=True)
            ]
            share = _e("td", f"{total:,}", class_="number")
            rows.append(_e("tr", _e("th", truth, scope="row"), *cells, share))
        head = _e(
            "tr",
            _e("td"),
            *(_e("th", s, scope="col") for s in STATES_OF_CELLS),
            _e("th", "cells", scope="col"),
        )
        caption = _e("caption", _swatch(number), clean(name))
        table = _e("table", caption, _e("thead", head), _e("tbody", *rows), class_="confusion")
        figures.append(_e("div", table, data_method=str(number)))
    return _e("div", *figures, class_="tiles wide")


# The legend, and what was run


def _legends(views: Views) -> Iterable[Element]:
    if any("points" in pictures for pictures in views.values()):
        heights = dict(zip(HEIGHTS, height_colours(), strict=True))
        yield _legend(
            "points", {f"{h} m": Shade(colour, "height over the ground") for h, colour in heights.items()}
        )
    yield _legend("truth", STATES)
    beliefs = {name: shade for name, shade in STATES.items() if name != "ignored"}
    yield _legend("masses", {name: shade._replace(says=f"mass of {name}") for name, shade in beliefs.items()})
    yield _legend("errors", dict(reversed(ERRORS.items())))


def _legend(title: str, shades: Mapping[str, Shade]) -> Element:
    entries = []
    for name, shade in shades.items():
        colour = f"background:rgb({','.join(map(str, shade.colour))})"
        says = "" if shade.says == name or title in ("points", "masses") else f": {shade.says}"
        entries.append(
            _e("li", _e("i", style=colour, class_="patch", aria_hidden="true"), _e("b", name), says)
        )
    return _e("div", _e("h3", title), _e("ul", *entries), class_="legend")


def _run(record: Record) -> Iterable[Element]:
    """Say what was run, so that it can be run again."""
    grid, data = record["grid"], record["data"]
    (nx, ny), side, (x, y) = grid["shape"], grid["resolution"], grid["origin"]
    area = f"x {x:g} to {x + nx * side:g} m (forward), y {y:g} to {y + ny * side:g} m (left)"
    facts = {
        "command": _e("code", clean(record["command"]), class_="command"),
        "date": record["date"],
        "machine": _facts(record["machine"]),
        "seed": _facts(record["seed"]),
        "intervals": _facts(record.get("intervals", "95 %, bootstrap over frames")),
        "grid": f"{nx} x {ny} cells of {side:g} m: {area}",
        "data": f"{clean(data['name'])} ({data['kind']}), {_count(len(record['frames']), 'frame')}",
        "truth": clean(data["truth"]),
        **{key: _facts(value) for key, value in data.items() if key not in ("kind", "name", "truth")},
        "versions": _facts(record["versions"]),
        "record": record["format"],
    }
    pairs = [
        _e("div", _e("dt", clean(key)), _e("dd", value)) for key, value in facts.items() if value is not None
    ]
    yield _e("dl", *pairs, class_="facts")
    rows = []
    for number, (name, model) in enumerate(record["models"].items()):
        weights = model.get("weights")
        said = [clean(weights["file"]), _e("code", f" SHA-256 {weights['sha256']}")] if weights else ["–"]
        cells = (_e("td", clean(model.get("what") or "")), _e("td", *said, class_="weights"))
        rows.append(_e("tr", _e("th", _swatch(number), clean(name), scope="row"), *cells))
    yield _plain_table(("method", "what it is", "weights"), rows)


def _facts(value: Any) -> Element | str:
    """Show whatever a record says: short as text, long folded."""
    if not isinstance(value, Mapping | list | tuple):
        return "–" if value is None else clean(value)
    if isinstance(value, Mapping) and not any(
        isinstance(one, Mapping | list | tuple) for one in value.values()
    ):
        return ", ".join(f"{clean(key)} {clean(one)}" for key, one in value.items())
    text = clean(json.dumps(value, ensure_ascii=False))
    if len(text) < SHORT:
        return text
    return _e(
        "details", _e("summary", "show"), _e("pre", clean(json.dumps(value, indent=1, ensure_ascii=False)))
    )
